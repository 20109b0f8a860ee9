"""An episode as a film: the scene from outside and through the wrist camera, side by side."""

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import imageio.v2 as imageio
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from maniskill_tomato.experiments.overlay import annotate
from maniskill_tomato.policies.protocol import StatePolicy

logger = logging.getLogger(__name__)

Image = NDArray[np.uint8]

FRAMES_PER_SECOND = 20
VIEW_SIZE = (640, 480)
"""Width and height of each of the two pictures, in [px]."""

JOINT_SPEED = 0.9
"""Speed of the fastest joint between two viewpoints as shown, in [rad/s]; the film only, not the task."""

HOLD_SECONDS = 0.8
"""How long the film rests at a viewpoint."""

MAX_MOVE_FRAMES = 60


@dataclass(frozen=True, eq=False, kw_only=True)
class Film:
    """What was recorded of one episode."""

    seed: int
    success: bool
    steps: int
    first_wrist: Image
    """The wrist camera's first view. Shape (480, 640, 3)."""
    last_wrist: Image
    """Its last view. Shape (480, 640, 3)."""
    first_outside: Image
    """The scene at the start. Shape (480, 640, 3)."""
    last_outside: Image
    """The scene at the end. Shape (480, 640, 3)."""
    first_visible_fraction: float
    last_visible_fraction: float


def make_film_options() -> dict[str, Any]:
    """Options for `gymnasium.make` under which an environment can be filmed."""
    width, height = VIEW_SIZE
    return {
        "render_mode": "rgb_array",
        "sensor_configs": {"width": width, "height": height},
        "human_render_camera_configs": {"width": width, "height": height},
    }


def film_episodes(env: gym.Env[Any, Any], policy: StatePolicy, seeds: list[int], path: Path) -> list[Film]:
    """Films one episode after the other into one mp4 file.

    Args:
        env: One environment made with `make_film_options`.
        policy: Chooses the actions.
        seeds: Seed of each episode.
        path: The file to write.

    Returns:
        One entry per episode.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    films: list[Film] = []
    writer = imageio.get_writer(
        path, fps=FRAMES_PER_SECOND, codec="libx264", quality=7, macro_block_size=16, ffmpeg_log_level="error"
    )
    try:
        for number, seed in enumerate(seeds, start=1):
            recorder = _Recorder(env, f"episode {number} of {len(seeds)}")
            for frame in recorder.run(policy, seed):
                writer.append_data(frame)
            films.append(recorder.film())
    finally:
        writer.close()
    return films


class _Recorder:
    """Steps one episode and yields its frames."""

    def __init__(self, env: gym.Env[Any, Any], title: str) -> None:
        self._env = env
        self._base = cast(Any, env.unwrapped)
        self._title = title
        self._threshold = float(self._base.task.full_visibility)

    def run(self, policy: StatePolicy, seed: int) -> Iterator[Image]:
        """The frames of the episode that starts from `seed`."""
        self._seed = seed
        observations, info = self._env.reset(seed=seed)
        self._steps = 0
        self._success = False
        self._first = self._look()
        self._first_visible_fraction = float(info["visible_fraction"])
        yield from self._hold(self._first_visible_fraction)
        done = False
        while not done:
            before = self._base.agent.robot.get_qpos().clone()
            observations, _, terminated, truncated, info = self._env.step(policy.act(observations))
            yield from self._move(before)
            self._steps += 1
            self._success = self._success or bool(info["success"])
            done = bool(terminated) or bool(truncated)
            yield from self._hold(float(info["visible_fraction"]), 3.0 if done else 1.0)
        self._last = self._look()
        self._last_visible_fraction = float(info["visible_fraction"])

    def film(self) -> Film:
        """What `run` left behind."""
        return Film(
            seed=self._seed,
            success=self._success,
            steps=self._steps,
            first_wrist=self._first[1],
            last_wrist=self._last[1],
            first_outside=self._first[0],
            last_outside=self._last[0],
            first_visible_fraction=self._first_visible_fraction,
            last_visible_fraction=self._last_visible_fraction,
        )

    def _look(self) -> tuple[Image, Image]:
        """The scene from outside and from the wrist, as it stands."""
        outside = self._base.render_rgb_array()[0].cpu().numpy()
        (sensor,) = self._base.get_sensor_images().values()
        return outside, sensor["rgb"][0].cpu().numpy()

    def _move(self, before: Tensor) -> Iterator[Image]:
        """The arm on its way from the joints `before` to the present ones, which are put back at the end."""
        robot = self._base.agent.robot
        after = robot.get_qpos().clone()
        frames = int(float((after - before).abs().max()) / JOINT_SPEED * FRAMES_PER_SECOND)
        try:
            for k in range(1, min(frames, MAX_MOVE_FRAMES)):
                share = 0.5 - 0.5 * np.cos(np.pi * k / min(frames, MAX_MOVE_FRAMES))
                robot.set_qpos(torch.lerp(before, after, float(share)))
                yield self._frame(float(self._base.evaluate()["visible_fraction"]), moving=True)
        finally:
            robot.set_qpos(after)

    def _hold(self, visible_fraction: float, factor: float = 1.0) -> Iterator[Image]:
        frame = self._frame(visible_fraction, moving=False)
        for _ in range(int(factor * HOLD_SECONDS * FRAMES_PER_SECOND)):
            yield frame

    def _frame(self, visible_fraction: float, moving: bool) -> Image:
        outside, wrist = self._look()
        return annotate(
            outside,
            wrist,
            title=self._title,
            step=self._steps,
            visible_fraction=visible_fraction,
            threshold=self._threshold,
            moving=moving,
            success=self._success,
        )
