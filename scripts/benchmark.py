"""Measures the speed and the memory of the simulator on this machine, all in one run, as one JSON.

Usage:
    python scripts/benchmark.py --out benchmark.json
"""

import json
import logging
import math
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
import torch
import tyro
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs.types import SimConfig

import maniskill_tomato  # noqa: F401
from maniskill_tomato.experiments.camera_views import rendered_views
from maniskill_tomato.plants.generator import generate_plant
from maniskill_tomato.raycast.scene import RayScene
from maniskill_tomato.rendering.vulkan_probe import rendering_available
from maniskill_tomato.robot.d435 import color_intrinsics
from maniskill_tomato.robot.iiwa14 import JOINT_LOWER, JOINT_UPPER
from maniskill_tomato.robot.inverse_kinematics import InverseKinematics
from maniskill_tomato.robot.kinematics import forward_kinematics
from maniskill_tomato.segmentation.fruit_network import SIZE_MULTIPLE
from maniskill_tomato.segmentation.instances import Instances
from maniskill_tomato.segmentation.light_segmenter import FruitSession
from maniskill_tomato.segmentation.segmenter import make_segmenter
from maniskill_tomato.sensing.camera_perception import CameraPerception
from maniskill_tomato.sensing.fruit_detector import FruitDetector
from maniskill_tomato.sensing.image_layout import ImageLayout
from maniskill_tomato.sensing.posed_frame import PosedFrame
from maniskill_tomato.tasks.making import make_world

GUIDED = "TomatoViewpointGuided-v1"
GENERAL = "TomatoViewpoint-v1"
EMPTY = "TomatoBenchmarkEmpty-v1"
MIB = 2**20
VECTOR_SIZES = (1, 64, 256)
"""Environments at once that `gymnasium.make_vec` is measured with."""
POOL: dict[str, Any] = {"pool": 16}
"""Plants of the general task where growing them is not what is measured."""
IMAGE_SIZES = ((64, 48), (84, 63), (128, 96))
"""Of policies' images, in [px]."""


@dataclass(frozen=True, kw_only=True)
class Args:
    """What to measure and where to write it."""

    out: Path = Path("benchmark.json")
    """The JSON file."""
    repeats: int = 5
    """Each rate is the median of this number of measurements, taken in turns."""
    memory_steps: int = 10_000
    """Steps over which memory must not grow."""
    memory_resets: int = 500
    """Resets with new plants over which memory must not grow."""
    look_episodes: int = 5
    """Episodes whose rendered views a camera's look is timed on, four views each."""


@register_env(EMPTY, max_episode_steps=10**9)
class EmptyEnv(BaseEnv):  # type: ignore[misc]
    """This robot and nothing else: ManiSkill's own step with one physics step per action, the yardstick for
    ours."""

    SUPPORTED_ROBOTS = ["iiwa14_d435"]

    @property
    def _default_sim_config(self) -> SimConfig:
        return SimConfig(sim_freq=20, control_freq=20)

    def compute_dense_reward(self, obs: Any, action: Any, info: Any) -> torch.Tensor:
        return torch.zeros(self.num_envs)


def steps_per_second(env: Any, steps: int, actions: np.ndarray[Any, Any]) -> float:
    """Rate of `env.step` alone, resets left out; episodes end after at most 30 steps."""
    spent, done = 0.0, 0
    while done < steps:
        env.reset()
        for _ in range(min(30, steps - done)):
            action = actions[done % len(actions)]
            start = time.perf_counter()
            _, _, terminated, _, _ = env.step(action)
            spent += time.perf_counter() - start
            done += 1
            if bool(terminated):
                break
    return done / spent


def per_second(function: Callable[[], object], calls: int) -> float:
    """Rate of a call."""
    function()
    start = time.perf_counter()
    for _ in range(calls):
        function()
    return calls / (time.perf_counter() - start)


def resident_mib() -> float:
    """Memory of this process that is in RAM, in [MiB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / MIB


def growth(work: Callable[[], object], times: int) -> dict[str, float]:
    """Memory before, during and after `times` calls, once the store of plants is full, in [MiB]."""
    for _ in range(256):
        work()
    readings = [resident_mib()]
    for _ in range(5):
        for _ in range(times // 5):
            work()
        readings.append(resident_mib())
    return {
        "calls": times,
        "before_mib": round(readings[0], 1),
        "after_mib": round(readings[-1], 1),
        "growth_mib": round(readings[-1] - readings[0], 1),
        "growth_in_last_fifth_mib": round(readings[-1] - readings[-2], 1),
    }


def small_actions(size: int) -> np.ndarray[Any, Any]:
    """Increments of up to 5 cm and 0.05 rad, which keep the arm in its workspace."""
    return np.random.default_rng(0).uniform(-0.05, 0.05, (512, size)).astype(np.float32)


def vector_steps_per_second(env: Any, steps: int) -> float:
    """Rate of single environments' steps in a vector of them, with moves as of `small_actions`."""
    rng = np.random.default_rng(0)
    moves = iter(rng.uniform(-0.05, 0.05, (steps + 1, *env.action_space.shape)).astype(np.float32))
    return float(env.num_envs * per_second(lambda: env.step(next(moves)), steps))


def vector_rates(repeats: int, singles: dict[str, Any]) -> dict[str, Any]:
    """Environments' steps and resets a second of `gymnasium.make_vec`, by task and number of environments.

    Steps are taken without resets, as by `steps_per_second`; a reset begins an episode in every environment at once,
    with plants that were grown before.

    Args:
        repeats: Of which each rate is the median, taken in turns.
        singles: By the task's name, ManiSkill's environment of it, for the ratios.
    """
    rates: dict[str, list[float]] = {}
    kinds: dict[str, tuple[str, dict[str, Any]]] = {
        "guided": (GUIDED, {}),
        "general": (GENERAL, {"plant": POOL}),
    }
    plain: dict[str, Any] = {"arrays": "torch", "autoreset_mode": "Disabled"}
    envs: dict[tuple[str, int], Any] = {
        (name, n): gym.make_vec(env_id, n, "vector_entry_point", **plain, **options)
        for name, (env_id, options) in kinds.items()
        for n in VECTOR_SIZES
    }
    for env in envs.values():
        env.reset(seed=0)
    for _ in range(repeats):
        for name, env in singles.items():
            actions = small_actions(env.action_space.shape[-1])
            rates.setdefault(f"{name}_simulated_steps", []).append(steps_per_second(env, 120, actions))
        for (name, n), env in envs.items():
            rates.setdefault(f"{name}_resets_{n}", []).append(n * per_second(env.reset, max(1, 16 // n)))
            rates.setdefault(f"{name}_steps_{n}", []).append(vector_steps_per_second(env, 20))
    medians = {name: statistics.median(values) for name, values in rates.items()}
    most = VECTOR_SIZES[-1]
    return {
        "per_second": {name: round(value, 1) for name, value in medians.items()},
        "ratios": {
            f"{name}_steps_{most}_over_simulated": round(
                medians[f"{name}_steps_{most}"] / medians[f"{name}_simulated_steps"], 2
            )
            for name in singles
        },
    }


def inverse_kinematics_rate(batch: int) -> float:
    """Poses solved per second, in batches of this size, for poses made from random joints."""
    rng = np.random.default_rng(0)
    qpos = torch.as_tensor(rng.uniform(JOINT_LOWER, JOINT_UPPER, (batch, 7)))
    poses, reference = forward_kinematics(qpos), torch.zeros(batch, 7, dtype=torch.float64)
    solver = InverseKinematics()
    return batch * per_second(lambda: solver.solve(poses, reference), max(1, 20_000 // batch))


def rays_rate(rays_per_side: int) -> float:
    """Rays per second towards fruits of a full plant, the caller's overhead included."""
    plant = generate_plant("full", 0)
    scene = RayScene([plant], color_intrinsics(640, 480), rays_per_side=rays_per_side)
    ripe = [j for j, fruit in enumerate(plant.fruits) if fruit.ripeness == "ripe"]
    pose = torch.eye(4).repeat(1, 1, 1)
    pose[0, :3, :3] = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    pose[0, :3, 3] = torch.as_tensor(plant.fruits[ripe[0]].centre) - torch.tensor([0.5, 0.0, 0.0])
    target, plant_pose = torch.tensor([ripe[0]]), torch.eye(4)[None]
    return rays_per_side**2 * per_second(lambda: scene.visibility(pose, target, plant_pose), 400)


def image_rates(repeats: int, can_render: bool) -> dict[str, float]:
    """Images of depth and segmentation a second in the general task, by how they are made and by their width.

    Cast ones are taken of 1 and of 16 environments at once, rendered ones of one, which is all that a CPU simulates.
    """
    worlds = {count: make_world(GENERAL, count) for count in (1, 16)}
    makers: dict[str, Callable[[], object]] = {}
    for world in worlds.values():
        world.reset(0)
    rendered = []
    for width, height in IMAGE_SIZES:
        layout = ImageLayout(kinds=("depth", "segmentation"), width=width, height=height)
        for count, world in worlds.items():
            makers[f"cast_{width}_batch_{count}"] = partial(world.images, layout)
        if can_render:
            size = {"width": width, "height": height}
            env = gym.make(GENERAL, obs_mode="depth+segmentation", sensor_configs=size)
            env.reset(seed=0)
            rendered.append(env)
            makers[f"rendered_{width}"] = cast(Any, env.unwrapped).get_obs
    rates: dict[str, list[float]] = {}
    for _ in range(repeats):
        for name, make in makers.items():
            images = 16 if name.endswith("_16") else 1
            rates.setdefault(name, []).append(images * per_second(make, 20))
    for env in rendered:
        env.close()
    return {name: round(statistics.median(values), 1) for name, values in rates.items()}


def look_times(episodes: int, views: int) -> dict[str, Any]:
    """Processor time of a look at 640 x 480 by its parts, in [ms], and over that of the segmenter's network alone.

    Medians over rendered views of validation episodes.

    Args:
        episodes: Of the validation list, from its first.
        views: Of each.
    """
    frames: dict[int, list[PosedFrame]] = {}
    for view in rendered_views(range(episodes), views):
        frames.setdefault(view.episode, []).append(view.frame)
    segmenter: Any = make_segmenter("light")
    found: list[Instances] = []
    network = FruitSession(segmenter.network)
    detector = FruitDetector(lambda image, depth_m=None: found[-1])
    times: dict[str, list[float]] = {name: [] for name in ("segment", "fit", "map", "observe", "network")}
    fruits = []
    for seen in frames.values():
        perception = CameraPerception(1, detector)
        perception.begin(0)
        for frame in seen:
            start = time.process_time()
            found.append(segmenter(frame.rgb, frame.depth_m))
            segmented = time.process_time()
            measurement = detector.measure(frame)
            fitted = time.process_time()
            perception.add(0, measurement)
            mapped = time.process_time()
            perception.rays()
            observed = time.process_time()
            for scale in segmenter.scales:
                sides = (math.ceil(side * scale / SIZE_MULTIPLE) * SIZE_MULTIPLE for side in (480, 640))
                network(torch.zeros(1, 3, *sides))
            spent = np.diff([start, segmented, fitted, mapped, observed, time.process_time()])
            for name, value in zip(times, 1e3 * spent, strict=True):
                times[name].append(float(value))
            fruits.append(len(measurement.fruits))
    whole = [sum(parts[:4]) for parts in zip(*times.values(), strict=True)]
    medians = {name: statistics.median(values) for name, values in times.items()}
    return {
        "views": len(whole),
        "fruits": statistics.median(fruits),
        **{f"{name}_ms": round(value, 1) for name, value in medians.items()},
        "look_ms": round(statistics.median(whole), 1),
        "look_over_network": round(statistics.median(whole) / medians["network"], 2),
    }


def main(args: Args) -> int:
    """Runs every measurement and writes the file."""
    logging.getLogger("mani_skill").setLevel(logging.ERROR)
    torch.set_num_threads(1)
    plain: dict[str, Any] = {"num_envs": 1, "obs_mode": "state", "render_backend": "none"}
    empty = gym.make(
        EMPTY, control_mode="pd_joint_pos", robot_uids="iiwa14_d435", reward_mode="dense", **plain
    )
    guided = gym.make(GUIDED, **plain)
    new_plants = gym.make(GUIDED, plant={"seed": "train"}, **plain)
    general = gym.make(GENERAL, plant=POOL, **plain)
    rendered = None
    if rendering_available():
        rendered = gym.make(
            GUIDED, num_envs=1, obs_mode="rgb+segmentation", sensor_configs={"width": 128, "height": 128}
        )

    measurements: dict[str, Callable[[], float | None]] = {
        "empty_environment_steps": lambda: steps_per_second(empty, 1000, np.zeros((1, 7), dtype=np.float32)),
        "guided_state_steps": lambda: steps_per_second(guided, 1000, small_actions(6)),
        "guided_resets": lambda: per_second(guided.reset, 100),
        "guided_resets_with_new_plant": lambda: per_second(new_plants.reset, 5),
        "inverse_kinematics_solves_batch_1": lambda: inverse_kinematics_rate(1),
        "inverse_kinematics_solves_batch_1024": lambda: inverse_kinematics_rate(1024),
        "rays_16_per_side": lambda: rays_rate(16),
        "rays_64_per_side": lambda: rays_rate(64),
        "guided_rendered_128_steps": lambda: (
            steps_per_second(rendered, 20, small_actions(6)) if rendered else None
        ),
    }
    rates: dict[str, list[float]] = {}
    for _ in range(args.repeats):
        for name, measure in measurements.items():
            if (rate := measure()) is not None:
                rates.setdefault(name, []).append(rate)
    medians = {name: statistics.median(values) for name, values in rates.items()}

    actions = iter(np.tile(small_actions(6), (2 + (args.memory_steps * 11 // 10) // 512, 1)))

    def step_or_reset() -> None:
        _, _, terminated, truncated, _ = guided.step(next(actions))
        if bool(terminated) or bool(truncated):
            guided.reset()

    guided.reset()
    result = {
        "machine": {
            "processor": _processor(),
            "cores": os.cpu_count(),
            "python": platform.python_version(),
            "torch_threads": torch.get_num_threads(),
            **{
                name: version(name)
                for name in ("mani-skill", "sapien", "torch", "warp-lang", "maniskill-tomato")
            },
        },
        "per_second": {name: round(value, 1) for name, value in medians.items()},
        "spread": {name: [round(min(v), 1), round(max(v), 1)] for name, v in rates.items()},
        "ratios": {
            "guided_state_over_empty": round(
                medians["guided_state_steps"] / medians["empty_environment_steps"], 3
            ),
            "guided_state_over_rendered": (
                round(medians["guided_state_steps"] / medians["guided_rendered_128_steps"], 1)
                if rendered
                else None
            ),
        },
        "memory": {
            "steps": growth(step_or_reset, args.memory_steps),
            "resets_with_new_plants": growth(new_plants.reset, args.memory_resets),
        },
        "vector": vector_rates(args.repeats, {"guided": guided, "general": general}),
        "images_per_second": image_rates(args.repeats, rendered is not None),
        "look": look_times(args.look_episodes, 4) if rendered else None,
        "left_out": []
        if rendered
        else [
            "guided_rendered_128_steps, rendered images, look: no Vulkan device; `make vulkan` installs one"
        ],
    }
    for env in (empty, guided, new_plants, general, rendered):
        if env is not None:
            env.close()
    text = json.dumps(result, indent=2)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(text + "\n")
    sys.stdout.write(text + "\n")
    return 0


def _processor() -> str:
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.processor()


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Args)))
