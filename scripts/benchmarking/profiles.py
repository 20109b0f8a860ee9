"""Where the processor's time goes on each hot path, by Python's own profiler: shares of its stages, and what is left.

A stage is what functions take with all that they call, less the functions that are another stage's.
"""

import cProfile
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from inspect import unwrap
from pathlib import Path
from types import FunctionType
from typing import Any, Final, cast

import numpy as np
import torch

from benchmarking.simulator import GENERAL, GUIDED, POOL, make_vector
from maniskill_tomato.deploy.capture import Capture
from maniskill_tomato.deploy.clock import SimulatedClock
from maniskill_tomato.deploy.decision import TASK, decide
from maniskill_tomato.deploy.goal import OneFruit
from maniskill_tomato.deploy.guarded_arm import GuardedArm
from maniskill_tomato.deploy.loop import Loop
from maniskill_tomato.deploy.move_choice import MoveChooser
from maniskill_tomato.deploy.plant_points import PlantPoints
from maniskill_tomato.deploy.profile import parse_profile
from maniskill_tomato.deploy.robot_perception import RobotBelief
from maniskill_tomato.deploy.run_records import RunResult
from maniskill_tomato.deploy.stops import Stops
from maniskill_tomato.deploy.workcell import make_workcell
from maniskill_tomato.experiments.camera_views import rendered_views
from maniskill_tomato.learning.rl import agent, exploration, trainer
from maniskill_tomato.learning.rl.experience import Experience
from maniskill_tomato.learning.rl.history import TrainingHistory
from maniskill_tomato.learning.rl.presets import PresetName, get_preset
from maniskill_tomato.learning.rl.progress import TrainingLog
from maniskill_tomato.learning.rl.replay import ReplayBuffer
from maniskill_tomato.policies.opening import open_policy
from maniskill_tomato.raycast.scene import RayScene
from maniskill_tomato.segmentation import light_segmenter
from maniskill_tomato.segmentation.segmenter import make_segmenter
from maniskill_tomato.sensing.camera_perception import CameraPerception
from maniskill_tomato.sensing.fruit_detector import FruitDetector
from maniskill_tomato.sensing.observation import ViewpointObserver
from maniskill_tomato.sensing.occlusion_memory import OcclusionMemory
from maniskill_tomato.sensing.posed_frame import PosedFrame
from maniskill_tomato.sensing.view_lattice import ViewLattice
from maniskill_tomato.tasks.row.hidden_starts import HardStarts
from maniskill_tomato.tasks.row.search_game import SearchGame
from maniskill_tomato.tasks.thesis.starts import Starts
from maniskill_tomato.tasks.thesis.thesis_game import ThesisGame
from maniskill_tomato.tasks.vector_env import VectorEnv
from maniskill_tomato.tasks.world import World


@dataclass(frozen=True)
class Less:
    """A function whose time belongs to another stage, in the list of the stage that calls it."""

    function: Any


Stages = Mapping[str, Sequence[Any]]
"""Functions whose time belongs to a stage, by its name."""

REST: Final = "the rest"

STEP: Final[dict[str, Sequence[Any]]] = {
    "where the arms go (inverse kinematics)": [World.plan],
    "forward kinematics": [World.place_arms],
    "rays for V_f": [RayScene.visibility],
}
OF_TASK: Final[Mapping[str, Stages]] = {
    "guided": {
        **STEP,
        "judging the view": [ThesisGame._judge],
        "info, reward and observation": [World.info, World.reward, World.observation],
    },
    "general": {
        **STEP,
        "rays of the view": [RayScene.view_rays],
        "clearance": [RayScene.clearance_along],
        "the map's new hits and passes": [OcclusionMemory.integrate],
        "the map's densities": [OcclusionMemory.estimate],
        "the observation (predicted views)": [
            ViewpointObserver.observe,
            Less(OcclusionMemory.integrate),
            Less(OcclusionMemory.estimate),
        ],
        "info, reward and observation": [World.info, World.reward, World.observation],
    },
}
RESETS: Final[Mapping[str, Stages]] = {
    "guided": {
        "starts": [Starts.draw],
        "other plants": [World.show_plants],
        "placing plants": [World.place_plants],
        "the first look": [ThesisGame.recall],
    },
    "general": {
        "hard starts": [HardStarts.draw],
        "other plants": [World.show_plants],
        "placing plants": [World.place_plants],
        "which of 468 views the arm reaches": [ViewLattice.reachable],
        "the first look": [SearchGame._look],
    },
}
TRAINING: Final[Stages] = {
    "making the environments": [trainer.make_training_env],
    "environment steps": [VectorEnv.step],
    "exploration": [getattr(exploration, name).explore for name in ("LookAtGoals", "CorrelatedNoise")],
    "the policy's actions": [agent.Agent.policy],
    "storing": [Experience.add],
    "drawing batches": [ReplayBuffer.sample],
    "the critics' updates": [agent.update_critic],
    "the actor's updates": [agent.update_actor],
    "the targets' updates": [agent.update_targets],
    "history and log": [TrainingHistory.add_step, TrainingHistory.add_loss, TrainingLog.step],
    "checkpoints": [trainer.Trainer._save],
}
LOOK: Final[Stages] = {
    "the network": [light_segmenter.FruitSession.__call__],
    "scaling images": [torch.nn.functional.interpolate],
    "boxes": [light_segmenter.find_fruits, light_segmenter.voted_boxes],
    "masks": [light_segmenter.full_maps, light_segmenter.split_by_votes],
    "measuring each fruit": [FruitDetector.measure],
    "the map of fruits": [CameraPerception.add],
    "rays from the picture": [CameraPerception.rays],
}
DEPLOY: Final[Stages] = {
    "capture (the twin renders)": [Capture.take],
    "perceive": [OneFruit.look],
    "observe": [RobotBelief.observe],
    "plant points": [PlantPoints.add],
    "policy": [decide],
    "kinematics": [MoveChooser.own_goal],
    "safety": [MoveChooser.choose, GuardedArm.command],
    "ways to other views": [Loop._hand_over, Loop._set_out],
    "move (the twin's physics)": [Loop._arrive],
}

RUNS: Final = 3
"""That `profiled` does of one call: once before, once timed, once profiled."""


@dataclass(frozen=True, kw_only=True)
class Profile:
    """Where the time of one path goes."""

    path: str
    """What was done."""
    ms: float
    """Of once, in [ms] of processor time, without the profiler."""
    shares: dict[str, float]
    """Of each stage under the profiler, the rest at the end."""


def profiled(path: str, work: Callable[[], object], calls: int, stages: Stages, parts: int = 1) -> Profile:
    """Times calls, and profiles as many.

    Args:
        path: What a call, or a part of it, does.
        work: Called; once before, which is not counted.
        calls: How often.
        stages: See `Stages`.
        parts: By which the time of a call is divided.
    """
    work()
    start = time.process_time()
    for _ in range(calls):
        work()
    ms = 1e3 * (time.process_time() - start) / (calls * parts)
    profiler = cProfile.Profile(time.process_time)
    profiler.enable()
    for _ in range(calls):
        work()
    profiler.disable()
    entries = profiler.getstats()
    spent = {entry.code: entry.totaltime for entry in entries}
    whole = sum(entry.inlinetime for entry in entries)
    shares = {
        name: sum(_signed(function, spent) for function in functions) / whole
        for name, functions in stages.items()
    }
    shares[REST] = 1.0 - sum(shares.values())
    return Profile(path=path, ms=ms, shares=shares)


def _signed(function: Any, spent: Mapping[Any, float]) -> float:
    if isinstance(function, Less):
        return -_signed(function.function, spent)
    return spent.get(cast(FunctionType, unwrap(function)).__code__, 0.0)


def environment_profiles() -> Iterator[Profile]:
    """Steps and resets without a simulator, with plants that were grown before."""
    for name, env_id in (("guided", GUIDED), ("general", GENERAL)):
        for n, steps, resets in ((64, 30, 3), (1, 300, 30)):
            env = make_vector(env_id, n, "cpu")
            for seed in range(128 // n if env_id == GENERAL else 1):
                env.reset(seed=seed)
            shape = (64, *cast(tuple[int, ...], env.action_space.shape))
            moves = torch.from_numpy(np.random.default_rng(0).uniform(-0.05, 0.05, shape).astype(np.float32))
            given = iter(range(10**9))

            def step(env: Any = env, moves: torch.Tensor = moves, given: Iterator[int] = given) -> None:
                env.step(moves[next(given) % 64])

            yield profiled(f"{name} step, {n} at once", step, steps, OF_TASK[name])
            yield profiled(f"{name} reset, {n} at once", env.reset, resets, RESETS[name])


def training_profiles(steps: int) -> Iterator[Profile]:
    """Trainings as the presets have them, but of this many steps, with updates from a quarter of them on.

    Args:
        steps: Of the environment.
    """
    presets: tuple[tuple[PresetName, str], ...] = (("td3", GUIDED), ("general-td3", GENERAL))
    for preset, env_id in presets:
        config = replace(get_preset(preset), total_timesteps=steps, learning_starts=steps // 4)

        def run(env_id: str = env_id, config: Any = config) -> None:
            options = {"plant": POOL} if env_id == GENERAL else {}
            with tempfile.TemporaryDirectory() as folder:
                trainer.train(env_id, config, Path(folder) / "run", 0, options, show_progress=False)

        yield profiled(f"{preset}, a step of training", run, 1, TRAINING, steps)


def look_profile(episodes: int) -> Profile:
    """Looks at 640 x 480 with the light segmenter at rendered views; it needs a renderer.

    Args:
        episodes: Of the validation list, four views each.
    """
    frames: dict[int, list[PosedFrame]] = {}
    for view in rendered_views(range(episodes), 4):
        frames.setdefault(view.episode, []).append(view.frame)
    segmenter: Any = make_segmenter("light")
    found: list[Any] = []
    detector = FruitDetector(lambda image, depth_m=None: found[-1])

    def looks() -> None:
        for seen in frames.values():
            perception = CameraPerception(1, detector)
            perception.begin(0)
            for frame in seen:
                found.append(segmenter(frame.rgb, frame.depth_m))
                perception.add(0, detector.measure(frame))
                perception.rays()

    return profiled("camera look, 640 x 480", looks, 1, LOOK, 4 * episodes)


TWIN: Final = """
[arm]
driver = "mock"
[camera]
driver = "mock"
[target]
source = "twin"
[perception]
segmenter = "light"
[loop]
max_moves = 12
"""


def deploy_profile(seed: int) -> Profile:
    """The loop over the twin, whose clock is simulated, with the light segmenter; by look.

    Args:
        seed: Of the run.
    """
    with ExitStack() as stack:
        runs = []
        for _ in range(RUNS):
            workcell = make_workcell(parse_profile(TWIN, Path("twin.toml")), seed, SimulatedClock())
            stack.enter_context(workcell.arm)
            stack.enter_context(workcell.camera)
            workcell.perception.warm_up(workcell.camera.intrinsics)
            policy = open_policy("nbv", env_id=TASK)
            runs.append(Loop(workcell, policy, stack.enter_context(Stops()), "unattended"))
        results: list[RunResult] = []
        waiting = iter(runs)
        whole = profiled(
            "deploy loop on the twin, a look", lambda: results.append(next(waiting).run()), 1, DEPLOY
        )
    return replace(whole, ms=whole.ms / len(results[0].visible_fractions))
