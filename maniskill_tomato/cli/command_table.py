"""Every command: its name, where its arguments are declared, and the line that the list shows.

The modules are imported when their command is asked for.
"""

import importlib
from dataclasses import dataclass
from typing import Any, Final

from maniskill_tomato.errors import did_you_mean

PROGRAM: Final = "maniskill-tomato"

PRINT_COMPLETION: Final = ("--print-completion", "--tyro-print-completion")
"""Followed by the name of a shell, prints a script by which it completes commands and options; tyro's own flag too."""

DESCRIPTION: Final = "Active perception for tomato harvesting: a robot arm learns where to look."


@dataclass(frozen=True)
class CommandEntry:
    """One command."""

    place: str
    """Module of `maniskill_tomato.cli` and its dataclass."""
    summary: str
    """What it does, in a line of the list."""

    def load(self) -> type[Any]:
        """The dataclass of its arguments, with a method `run`."""
        module, name = self.place.split(":")
        kind: type[Any] = getattr(importlib.import_module(f"maniskill_tomato.cli.{module}"), name)
        return kind


COMMANDS: Final[dict[str, CommandEntry]] = {
    "doctor": CommandEntry("doctor_command:Doctor", "Say what this machine lacks, and what mends it"),
    "demo": CommandEntry("demo_command:Demo", "Train, evaluate and report in one go"),
    "list": CommandEntry("list_command:List", "List policies, segmenters, plants and drivers by name"),
    "play": CommandEntry("play_command:Play", "Watch a policy look for tomatoes, in a browser"),
    "train": CommandEntry("train_command:Train", "Train a policy by reinforcement learning"),
    "train-imitation": CommandEntry(
        "learn_commands:TrainImitation", "Imitate a teacher that knows the truth"
    ),
    "train-view-quality": CommandEntry(
        "learn_commands:TrainViewQuality", "Learn how much candidate views would show"
    ),
    "train-ppo": CommandEntry("learn_commands:TrainPpo", "Train PPO (Stable-Baselines3), to compare with"),
    "train-deep-3dmts": CommandEntry(
        "learn_commands:TrainDeepMoveToSee", "Train the network of the planner deep_3dmts"
    ),
    "demonstrations": CommandEntry(
        "learn_commands:RecordDemonstrations", "Record a policy's episodes for other learners"
    ),
    "export": CommandEntry("learn_commands:Export", "Write a policy as ONNX, which runs without PyTorch"),
    "convert": CommandEntry(
        "convert_command:Convert", "Turn recordings or demonstrations into a LeRobot data set"
    ),
    "eval": CommandEntry("eval_command:Eval", "Evaluate a policy and write a report"),
    "benchmark": CommandEntry("measure_commands:Benchmark", "Compare policies on the same held-out episodes"),
    "benchmark-rows": CommandEntry("measure_commands:BenchmarkRows", "Compare policies on whole rows"),
    "compare": CommandEntry("measure_commands:Compare", "Compare training runs over their seeds"),
    "reproduce": CommandEntry("measure_commands:Reproduce", "Reproduce the thesis's experiments"),
    "ablate": CommandEntry("measure_commands:Ablate", "Measure what each option of the learner is worth"),
    "dataset": CommandEntry("image_commands:Dataset", "Render annotated images of tomato rows"),
    "compose-dataset": CommandEntry(
        "image_commands:ComposeDataset", "Mix rendered images and photos as the thesis did"
    ),
    "detect": CommandEntry("image_commands:Detect", "Find the tomatoes in images"),
    "train-segmenter light": CommandEntry("segmenter_commands:TrainLight", "The light segmenter, on a CPU"),
    "train-segmenter mask-rcnn": CommandEntry("segmenter_commands:TrainMaskRcnn", "Mask R-CNN"),
    "train-segmenter yolo": CommandEntry("segmenter_commands:TrainYolo", "YOLO, through Ultralytics"),
    "judge occlusion": CommandEntry(
        "judge_commands:JudgeOcclusion", "Occlusion models by their error in V_f on rendered images"
    ),
    "judge segmenter": CommandEntry(
        "judge_commands:JudgeSegmenter", "A segmenter on annotated images: precision, recall, AP"
    ),
    "judge perception": CommandEntry(
        "judge_commands:JudgePerception", "What a policy loses when it sees through the camera"
    ),
    "judge plants": CommandEntry(
        "judge_commands:JudgePlants", "Plants from mesh files, and what fewer triangles change"
    ),
    "judge twin": CommandEntry("judge_commands:JudgeTwin", "The twin of `deploy` beside the simulated task"),
    "deploy run": CommandEntry("deploy_commands:DeployRun", "Look at a tomato until it is fully visible"),
    "deploy inspect": CommandEntry(
        "deploy_commands:DeployInspect", "Look at every ripe tomato of a row and list them"
    ),
    "deploy check": CommandEntry("deploy_commands:DeployCheck", "Check everything; nothing moves"),
    "deploy calibrate": CommandEntry(
        "calibrate_command:DeployCalibrate", "Measure the camera's place on the flange"
    ),
    "deploy replay": CommandEntry("deploy_commands:DeployReplay", "Run a recording through today's code"),
    "deploy profiles": CommandEntry("deploy_commands:DeployProfiles", "List the profiles, or print one"),
}
"""The commands; those of a family have two words."""

FAMILIES: Final[dict[str, str]] = {
    "train-segmenter": "Train a segmenter on annotated images",
    "judge": "Judge a part: V_f, segmenters, perception, plants, twin",
    "deploy": "Run a policy on an arm and a camera, or on their twin",
}
"""Commands that have commands, and what the list says of them."""

GROUPS: Final[dict[str, tuple[str, ...]]] = {
    "Begin": ("doctor", "demo", "play", "list"),
    "Learn": (
        "train",
        "train-imitation",
        "train-view-quality",
        "train-ppo",
        "train-deep-3dmts",
        "demonstrations",
    ),
    "Measure": ("eval", "benchmark", "benchmark-rows", "compare", "reproduce", "ablate", "judge"),
    "See": ("dataset", "compose-dataset", "train-segmenter", "detect"),
    "Use": ("export", "convert", "deploy"),
}
"""The commands as the list shows them."""


def command_list() -> str:
    """What `maniskill-tomato` alone prints."""
    lines = [f"usage: {PROGRAM} COMMAND [OPTIONS]", "", DESCRIPTION]
    for title, names in GROUPS.items():
        lines += ["", f"{title}:"]
        lines += [f"  {name:<20}{_summary(name)}" for name in names]
    lines += [
        "",
        f"{PROGRAM} COMMAND --help shows the options of a command.",
        f"{PROGRAM} --version shows the version.",
        f"{PROGRAM} {PRINT_COMPLETION[0]} bash (zsh, fish): for the Tab key.",
        "Exit status: 0 done, 1 failed on its way, 2 cannot be done as asked.",
    ]
    return "\n".join(lines)


def family_list(family: str) -> str:
    """What a command that has commands prints."""
    lines = [f"usage: {PROGRAM} {family} COMMAND [OPTIONS]", "", f"{FAMILIES[family]}.", ""]
    lines += [f"  {name:<20}{COMMANDS[f'{family} {name}'].summary}" for name in members(family)]
    lines += ["", f"{PROGRAM} {family} COMMAND --help shows the options of each."]
    return "\n".join(lines)


def members(family: str) -> tuple[str, ...]:
    """The commands of a family."""
    return tuple(name.split()[1] for name in COMMANDS if name.startswith(f"{family} "))


def unknown(word: str, family: str = "") -> str:
    """The message for a word that is no command."""
    known = members(family) if family else tuple(name for names in GROUPS.values() for name in names)
    before = f"{PROGRAM} {family}" if family else PROGRAM
    return f"{before} has no command {word!r} ({before} --help lists them){did_you_mean(word, known)}"


def _summary(name: str) -> str:
    return FAMILIES[name] if name in FAMILIES else COMMANDS[name].summary
