"""Speed and memory of the environments, their images, a camera's look and the inverse kinematics."""

import math
import os
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Final, cast

import gymnasium as gym
import numpy as np
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs.types import SimConfig

import maniskill_tomato.tasks.maniskill.iiwa14_agent  # noqa: F401
from benchmarking.turns import Measurement, per_second
from maniskill_tomato.experiments.camera_views import rendered_views
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

GUIDED: Final = "TomatoViewpointGuided-v1"
GENERAL: Final = "TomatoViewpoint-v1"
EMPTY: Final = "TomatoBenchmarkEmpty-v1"
MIB: Final = 2**20
POOL: Final[dict[str, Any]] = {"pool": 16}
"""Plants of the general task where growing them is not what is measured."""
IMAGE_SIZES: Final = ((64, 48), (84, 63), (128, 96))
"""Of policies' images, in [px]."""
PLAIN: Final[dict[str, Any]] = {"num_envs": 1, "obs_mode": "state", "render_backend": "none"}
"""Options of ManiSkill's environments without images."""


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


@contextmanager
def simulated(can_render: bool) -> Iterator[dict[str, Measurement]]:
    """Rates of ManiSkill's environments, one each, by name; resets are not counted as steps.

    Args:
        can_render: Whether there is a Vulkan device.
    """
    empty = gym.make(
        EMPTY, control_mode="pd_joint_pos", robot_uids="iiwa14_d435", reward_mode="dense", **PLAIN
    )
    guided = gym.make(GUIDED, **PLAIN)
    general = gym.make(GENERAL, plant=POOL, **PLAIN)
    new_plants = gym.make(GUIDED, plant={"seed": "train"}, **PLAIN)
    envs = [empty, guided, general, new_plants]
    rates: dict[str, Measurement] = {
        "empty/steps": lambda: steps_per_second(empty, 600, np.zeros((1, 7), dtype=np.float32)),
        "guided/steps": lambda: steps_per_second(guided, 600, small_actions(6)),
        "guided/resets": lambda: per_second(guided.reset, 100),
        "guided/resets_with_new_plant": lambda: per_second(new_plants.reset, 5),
        "general/steps": lambda: steps_per_second(general, 120, small_actions(3)),
    }
    if can_render:
        size = {"width": 128, "height": 128}
        rendered = gym.make(GUIDED, num_envs=1, obs_mode="rgb+segmentation", sensor_configs=size)
        envs.append(rendered)
        rates["guided/rendered_128_steps"] = lambda: steps_per_second(rendered, 20, small_actions(6))
    yield rates
    for env in envs:
        env.close()


def steps_per_second(env: Any, steps: int, actions: np.ndarray[Any, Any]) -> float:
    """Rate of `env.step` alone, resets left out; episodes end after at most 30 steps."""
    spent, done = 0.0, 0
    while done < steps:
        env.reset()
        for _ in range(min(30, steps - done)):
            action = actions[done % len(actions)]
            start = time.process_time()
            _, _, terminated, _, _ = env.step(action)
            spent += time.process_time() - start
            done += 1
            if bool(terminated):
                break
    return done / spent


def small_actions(size: int) -> np.ndarray[Any, Any]:
    """Increments of up to 5 cm and 0.05 rad, which keep the arm in its workspace."""
    return np.random.default_rng(0).uniform(-0.05, 0.05, (512, size)).astype(np.float32)


def make_vector(env_id: str, envs: int, device: str, **options: Any) -> Any:
    """Environments without a simulator, begun, that the caller resets; tensors in and out.

    Args:
        env_id: The task.
        envs: At once.
        device: The torch device.
        options: Of the task; the general one has the plants of `POOL` unless they say otherwise.
    """
    if env_id == GENERAL:
        options = {"plant": POOL, **options}
    env = gym.make_vec(
        env_id,
        envs,
        "vector_entry_point",
        device=device,
        arrays="torch",
        autoreset_mode="Disabled",
        **options,
    )
    env.reset(seed=0)
    return env


def vector_steps_per_second(env: Any, calls: int) -> float:
    """Rate of single environments' steps in a vector of them, with moves as of `small_actions`."""
    rng = np.random.default_rng(0)
    moves = rng.uniform(-0.05, 0.05, (calls + 1, *env.action_space.shape)).astype(np.float32)
    given = iter(torch.from_numpy(moves).to(env.world.device))
    return float(env.num_envs * per_second(lambda: env.step(next(given)), calls))


def vectors(counts: tuple[int, ...], device: str) -> dict[str, Measurement]:
    """Rates of `gymnasium.make_vec`: single environments' steps, and resets of all at once with grown plants.

    Args:
        counts: Environments at once.
        device: The torch device.
    """
    rates: dict[str, Measurement] = {}
    for name, env_id in (("guided", GUIDED), ("general", GENERAL)):
        for n in counts:
            env = make_vector(env_id, n, device)
            rates[f"{name}/vector_{n}_steps"] = partial(vector_steps_per_second, env, max(4, 64 // n))
            rates[f"{name}/vector_{n}_resets"] = partial(
                _times, n, partial(per_second, env.reset, max(1, 16 // n))
            )
    return rates


def _times(factor: float, measure: Measurement) -> float:
    return factor * measure()


def kinematics() -> dict[str, Measurement]:
    """Poses solved by this package's inverse kinematics, singly and 1024 at once."""
    return {f"inverse_kinematics/batch_{n}": partial(inverse_kinematics_rate, n) for n in (1, 1024)}


def inverse_kinematics_rate(batch: int) -> float:
    """Poses solved per second, in batches of this size, for poses made from random joints."""
    rng = np.random.default_rng(0)
    qpos = torch.as_tensor(rng.uniform(JOINT_LOWER, JOINT_UPPER, (batch, 7)))
    poses, reference = forward_kinematics(qpos), torch.zeros(batch, 7, dtype=torch.float64)
    solver = InverseKinematics()
    return batch * per_second(lambda: solver.solve(poses, reference), max(1, 20_000 // batch))


@contextmanager
def images(can_render: bool) -> Iterator[dict[str, Measurement]]:
    """Images of depth and segmentation in the general task, by how they are made and by their width.

    Cast ones are taken of 1 and of 16 environments at once, rendered ones of one, which is all that a CPU simulates.

    Args:
        can_render: Whether there is a Vulkan device.
    """
    worlds = {count: make_world(GENERAL, count) for count in (1, 16)}
    for world in worlds.values():
        world.reset(0)
    rates: dict[str, Measurement] = {}
    rendered = []
    for width, height in IMAGE_SIZES:
        layout = ImageLayout(kinds=("depth", "segmentation"), width=width, height=height)
        for count, world in worlds.items():
            look = partial(per_second, partial(world.images, layout), 20)
            rates[f"images/cast_{width}_batch_{count}"] = partial(_times, count, look)
        if can_render:
            size = {"width": width, "height": height}
            env = gym.make(GENERAL, obs_mode="depth+segmentation", sensor_configs=size)
            env.reset(seed=0)
            rendered.append(env)
            rates[f"images/rendered_{width}"] = partial(per_second, cast(Any, env.unwrapped).get_obs, 20)
    yield rates
    for env in rendered:
        env.close()


def resident_mib() -> float:
    """Memory of this process that is in RAM, in [MiB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / MIB


def growth(work: Callable[[], object], calls: int) -> dict[str, float]:
    """Memory before, during and after calls, once the store of plants is full, in [MiB]."""
    for _ in range(256):
        work()
    readings = [resident_mib()]
    for _ in range(5):
        for _ in range(calls // 5):
            work()
        readings.append(resident_mib())
    return {
        "calls": calls,
        "before_mib": round(readings[0], 1),
        "after_mib": round(readings[-1], 1),
        "growth_mib": round(readings[-1] - readings[0], 1),
        "growth_in_last_fifth_mib": round(readings[-1] - readings[-2], 1),
    }


def memory(steps: int, vector_steps: int, resets: int, device: str) -> dict[str, dict[str, float]]:
    """What the memory grows by over many steps and resets, episodes begun anew where they end.

    Args:
        steps: Of ManiSkill's guided environment.
        vector_steps: Of single guided environments in a vector of 64.
        resets: Of ManiSkill's guided environment with a new plant each.
        device: The torch device of the vector.
    """
    guided, new_plants = gym.make(GUIDED, **PLAIN), gym.make(GUIDED, plant={"seed": "train"}, **PLAIN)
    vector = gym.make_vec(GUIDED, 64, "vector_entry_point", device=device, arrays="torch")
    vector.reset(seed=0)
    guided.reset()
    actions, taken = small_actions(6), iter(range(10**9))

    def step_or_reset() -> None:
        _, _, terminated, truncated, _ = guided.step(actions[next(taken) % len(actions)])
        if bool(terminated) or bool(truncated):
            guided.reset()

    moves = torch.from_numpy(small_actions(6)).to(device).reshape(8, 64, 6)
    grown = {
        "guided_steps": growth(step_or_reset, steps),
        "guided_vector_64_steps": growth(lambda: vector.step(moves[next(taken) % 8]), vector_steps // 64),
        "guided_resets_with_new_plants": growth(new_plants.reset, resets),
    }
    for env in (guided, new_plants, vector):
        env.close()
    return grown


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
