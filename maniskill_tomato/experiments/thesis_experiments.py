"""The thesis's two experiments (sections 5-1 and 5-2), and variants between their settings and those of `td3`."""

import dataclasses
from dataclasses import dataclass, field
from typing import Any, Literal

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.learning.rl.presets import PRESETS, PresetName, TrainConfig

ExperimentName = Literal["guided", "sparse"]

OTHER_POSE = (0.8, 0.1, 0.5)
"""Where the plant stands in the evaluations "at a pose other than the training pose": x, y [m], yaw [rad]. The
thesis shows its poses in Figures 5-5, 5-10 and 5-18 and prints no numbers."""

THESIS_EPISODES = 6
"""Length of the thesis's evaluations, in episodes."""


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Where a trained policy is judged."""

    name: str
    """Short name, part of file names."""
    title: str
    """What stands above its figures."""
    env_options: dict[str, Any] = field(default_factory=dict)
    """Options for `gymnasium.make`; none for the plant and the pose of the training."""


@dataclass(frozen=True, kw_only=True)
class ThesisNumbers:
    """What the thesis prints about the length of a training, to mark in its curves."""

    total_steps: int | None
    """Steps of the whole training, if it says."""
    exploration_ends: tuple[int, int] | None
    """Episode and step at which the exploration ends, if it does."""


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """One of the thesis's two."""

    name: ExperimentName
    env_id: str
    preset: PresetName
    """The exact settings: Table 5-1 or 5-2."""
    windows: tuple[int, int]
    """Moving-average windows of its training curves, in episodes and steps."""
    evaluations: tuple[Evaluation, ...]
    """The first is on the plant and at the pose of the training; the others are the thesis's."""
    thesis: ThesisNumbers


EXPERIMENTS: dict[ExperimentName, Experiment] = {
    "guided": Experiment(
        name="guided",
        env_id="TomatoViewpointGuided-v1",
        preset="thesis-guided",
        windows=(12, 75),
        evaluations=(
            Evaluation(name="training-pose", title="one tomato, as in training"),
            Evaluation(
                name="one-tomato",
                title="one tomato, another pose (Fig. 5-5 to 5-9)",
                env_options={"plant_pose": OTHER_POSE},
            ),
            Evaluation(
                name="three-tomatoes",
                title="three tomatoes, another pose (Fig. 5-10 to 5-13)",
                env_options={"plant": {"preset": "three_tomatoes", "seed": 4}, "plant_pose": OTHER_POSE},
            ),
        ),
        thesis=ThesisNumbers(total_steps=1278, exploration_ends=None),
    ),
    "sparse": Experiment(
        name="sparse",
        env_id="TomatoViewpointSparse-v1",
        preset="thesis-sparse",
        windows=(30, 180),
        evaluations=(
            Evaluation(name="training-pose", title="three tomatoes, as in training"),
            Evaluation(
                name="three-tomatoes",
                title="three tomatoes, another pose (Fig. 5-18 to 5-21)",
                env_options={"plant_pose": OTHER_POSE},
            ),
        ),
        thesis=ThesisNumbers(total_steps=None, exploration_ends=(238, 1800)),
    ),
}


@dataclass(frozen=True, kw_only=True)
class Variant:
    """Settings to train with: a preset's, or those with something changed."""

    name: str
    title: str
    """What differs, for tables."""
    changes: dict[str, Any]
    """Fields of `TrainConfig` and their new values; none for a preset as it is."""
    experiments: tuple[ExperimentName, ...] = ("guided", "sparse")
    """Where it applies."""
    preset: PresetName | None = None
    """What `changes` are made to; None stands for the exact settings of the experiment."""

    def config(self, experiment: Experiment) -> TrainConfig:
        """The training configuration of this variant."""
        return dataclasses.replace(PRESETS[self.preset or experiment.preset], **self.changes)


SMALL_ACTIONS = (0.35, 0.35, 0.35, 0.6, 0.6, 0.6)
"""The action scale of the preset `td3`, in [m] and [rad]."""

EXACT = Variant(name="exact", title="exactly Table 5-1 / 5-2", changes={})

SINGLE_CHANGES: tuple[Variant, ...] = (
    Variant(
        name="small-actions",
        title="actions of at most 0.35 m and 0.6 rad, not 1",
        changes={"action_scale": SMALL_ACTIONS},
    ),
    Variant(
        name="small-start",
        title="output weights of the actor within 0.003, not Glorot",
        changes={"actor_output_init": "small"},
    ),
    Variant(
        name="pre-tanh-penalty",
        title="penalty of 0.01 on the squared outputs before tanh",
        changes={"pre_tanh_penalty": 0.01},
    ),
    Variant(
        name="normalised",
        title="observations scaled to about [-1, 1]",
        changes={"normalize_observations": "fixed"},
    ),
    Variant(
        name="buffer-100k",
        title="buffer of 100,000 transitions, not 1000 / 1500",
        changes={"buffer_size": 100_000},
    ),
    Variant(name="tau-0.005", title="tau 0.005, not 0.001", changes={"tau": 0.005}),
    Variant(name="tau-0.01", title="tau 0.01, not 0.001", changes={"tau": 0.01}),
    Variant(name="gamma-0.9", title="gamma 0.9, not 0.99", changes={"gamma": 0.9}),
    Variant(
        name="potential-reward", title="potential reward, not the task's", changes={"reward": "potential"}
    ),
    Variant(
        name="actor-lr-1e-3",
        title="actor's learning rate 0.001, not 0.0001",
        changes={"actor_learning_rate": 1e-3},
    ),
    Variant(
        name="critic-lr-1e-4",
        title="critic's learning rate 0.0001, not 0.001",
        changes={"critic_learning_rate": 1e-4},
    ),
    Variant(name="batch-256", title="256 transitions per update, not 32", changes={"batch_size": 256}),
    Variant(
        name="slow-exploration",
        title="EXP 4800, not 1200",
        changes={"exploration_steps": 4800},
        experiments=("guided",),
    ),
    Variant(
        name="slow-exploration-sparse",
        title="EXP 7200, not 1800",
        changes={"exploration_steps": 7200},
        experiments=("sparse",),
    ),
    Variant(
        name="wide-noise",
        title="noise of standard deviation 0.32 (0.1 read as the variance)",
        changes={"exploration_noise": 0.32},
        experiments=("sparse",),
    ),
    Variant(
        name="double-episodes",
        title="480 episodes, not 240",
        changes={"total_episodes": 480},
        experiments=("guided",),
    ),
    Variant(
        name="six-fold-episodes",
        title="3000 episodes, not 500",
        changes={"total_episodes": 3000},
        experiments=("sparse",),
    ),
)
"""One field each."""


def _of_td3(*fields: str) -> dict[str, Any]:
    """Fields of the preset `td3` with their values."""
    return {name: getattr(PRESETS["td3"], name) for name in fields}


IDEAS: tuple[Variant, ...] = (
    Variant(
        name="look-at-goals",
        title="exploration that looks at the target (`td3`'s)",
        changes=_of_td3(
            "exploration",
            "exploration_steps",
            "exploration_noise",
            "exploration_noise_end",
            "exploration_goal_share",
        ),
    ),
    Variant(
        name="15000-steps",
        title="15,000 steps of training, not 240 / 500 episodes",
        changes=_of_td3("total_episodes", "total_timesteps"),
    ),
    Variant(
        name="twin-critics",
        title="TD3's twin critics, delay and target noise",
        changes=_of_td3("twin_critics", "policy_frequency", "target_noise"),
    ),
    Variant(
        name="fewer-updates",
        title="one update per two steps, the first after 1500",
        changes=_of_td3("learning_starts", "updates_per_step"),
    ),
    Variant(
        name="wide-networks",
        title="128 units a layer, the action into the critic's first",
        changes=_of_td3("actor_hidden", "critic_hidden", "critic_action_layer"),
    ),
)
"""What else tells `td3` from the exact settings; one idea each, of several fields."""

TD3 = Variant(name="td3", title="the preset `td3`", changes={}, preset="td3")

PARTS_OF_TD3 = (
    "look-at-goals",
    "15000-steps",
    "small-actions",
    "potential-reward",
    "gamma-0.9",
    "tau-0.01",
    "normalised",
    "small-start",
    "pre-tanh-penalty",
    "actor-lr-1e-3",
    "batch-256",
    "buffer-100k",
    "twin-critics",
    "fewer-updates",
    "wide-networks",
)
"""The changes that together lead from the exact settings to `td3`; they leave two weights to it, the cost of a step
and that of the outputs before tanh."""

TOGETHER = "+"
WITHOUT = "td3-without-"


def variants_of(experiment: Experiment) -> dict[str, Variant]:
    """The exact settings, every single change of them, and `td3`, by name."""
    known = (EXACT, *SINGLE_CHANGES, *IDEAS, TD3)
    return {v.name: v for v in known if experiment.name in v.experiments}


def find_variant(experiment: Experiment, name: str) -> Variant:
    """The variant called `name`.

    Beside those of `variants_of`, `A+B` is the exact settings with the changes A and B, and `td3-without-A+B` the
    preset `td3` with what A and B change put back to the exact settings.

    Raises:
        InvalidInputError: The experiment has none of this name, the message lists them; or two changes of one name
            contradict each other.
    """
    variants = variants_of(experiment)
    if name.startswith(WITHOUT):
        return _td3_without(experiment, name)
    if name in variants:
        return variants[name]
    if TOGETHER not in name:
        raise InvalidInputError.choice(f"variant of {experiment.name}", name, variants)
    parts = [find_variant(experiment, part) for part in name.split(TOGETHER)]
    changes: dict[str, Any] = {}
    for part in parts:
        if not part.changes or part.preset is not None or changes.keys() & part.changes.keys():
            raise InvalidInputError(
                f"{name} cannot be combined: {part.name} changes nothing, or what another part changes already"
            )
        changes |= part.changes
    return Variant(name=name, title="; ".join(part.title for part in parts), changes=changes)


def _td3_without(experiment: Experiment, name: str) -> Variant:
    """The preset `td3` with some of its parts put back."""
    parts: list[Variant] = []
    for part in name.removeprefix(WITHOUT).split(TOGETHER):
        if part not in PARTS_OF_TD3:
            raise InvalidInputError.choice("part of td3", part, PARTS_OF_TD3)
        parts.append(variants_of(experiment)[part])
    exact = PRESETS[experiment.preset]
    return Variant(
        name=name,
        title=f"`td3` without: {'; '.join(part.title for part in parts)}",
        changes={field: getattr(exact, field) for part in parts for field in part.changes},
        preset="td3",
    )
