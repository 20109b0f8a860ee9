"""Episodes in pictures: the first and last views, and a film of the scene beside what the wrist camera sees."""

import contextlib
import functools
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import imageio.v2 as imageio
import imageio_ffmpeg
import numpy as np
import torch
from matplotlib import font_manager
from numpy.typing import NDArray
from PIL import Image as PillowImage
from PIL import ImageDraw, ImageFont

from maniskill_tomato import report_design as design
from maniskill_tomato.errors import NotWrittenError
from maniskill_tomato.experiments.rollout import run_episode
from maniskill_tomato.policies.protocol import Policy, StatePolicy
from maniskill_tomato.rendering import vulkan_probe
from maniskill_tomato.report_design import rgb
from maniskill_tomato.sensing.perception_kinds import RENDERED

Image = NDArray[np.uint8]

FRAMES_PER_SECOND = 15
VIEW_SIZE = (640, 480)
"""Width and height of each of the two pictures, in [px]."""

JOINT_SPEED = 0.9
"""Speed of the fastest joint between two viewpoints as shown, in [rad/s]; the film only, not the task."""

HOLD_SECONDS = 0.8
"""How long the film rests at a viewpoint."""

MAX_MOVE_FRAMES = 60

BAND = 64
"""Height of the caption under the pictures, in [px]."""

PAPER, INK, MUTED, TRACK, TOMATO, LEAF = (
    rgb(colour)
    for colour in (design.PAPER, design.INK, design.MUTED, design.GRID, design.TOMATO, design.LEAF)
)


@dataclass(frozen=True, eq=False, kw_only=True)
class Snapshot:
    """Both pictures at one view."""

    outside: Image
    """The scene. Shape (480, 640, 3)."""
    wrist: Image
    """What the wrist camera sees. Shape (480, 640, 3)."""
    visible_fraction: float


@dataclass(frozen=True, eq=False, kw_only=True)
class Film:
    """What was recorded of one episode."""

    seed: int
    success: bool
    steps: int
    first: Snapshot
    last: Snapshot
    threshold: float
    """V_f above which the target counts as fully visible."""


def make_film_options(options: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Options for `gymnasium.make` under which an environment can be filmed on this machine.

    It stands in a glasshouse, unless its perception works on colour pictures, which that would change.

    Args:
        options: Those of the environment, which are kept.
    """
    width, height = VIEW_SIZE
    options = options or {}
    return {
        "render_backend": vulkan_probe.render_backend(),
        "render_mode": "rgb_array",
        "scenery": "plain" if options.get("perception") in RENDERED else "greenhouse",
        "sensor_configs": {"width": width, "height": height},
        "human_render_camera_configs": {"width": width, "height": height},
        **options,
    }


def film_episodes(
    env: gym.Env[Any, Any], policy: Policy | StatePolicy, seeds: list[int], path: Path
) -> list[Film]:
    """Films one episode after the other into one mp4 file.

    Args:
        env: One environment made with `make_film_options`.
        policy: Chooses the actions.
        seeds: Seed of each episode.
        path: The file to write.

    Returns:
        One entry per episode.

    Raises:
        NotWrittenError: The disk does not take it.
    """
    part = path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        writer: Any = imageio.get_writer(
            part,
            fps=FRAMES_PER_SECOND,
            codec="libx264",
            quality=7,
            macro_block_size=16,
            ffmpeg_log_level="error",
        )
        with contextlib.closing(writer):
            films = [
                photograph(env, policy, seed, _Camera(env, f"episode {number} of {len(seeds)}", writer))
                for number, seed in enumerate(seeds, start=1)
            ]
        _check_film(part)
        part.replace(path)
    except OSError as error:
        raise NotWrittenError(
            f"cannot write the film {path}: {str(error).splitlines()[0]}; free some space, choose another --out, or "
            "leave the film out"
        ) from error
    finally:
        part.unlink(missing_ok=True)
    return films


def _check_film(path: Path) -> None:
    """Refuses a film that FFmpeg, which says nothing of a full disk, left unfinished.

    Raises:
        OSError: It cannot be played.
    """
    try:
        imageio_ffmpeg.count_frames_and_secs(str(path))
    except RuntimeError as error:
        raise OSError("the disk did not take all of it") from error


def photograph(
    env: gym.Env[Any, Any], policy: Policy | StatePolicy, seed: int, camera: "Photographer | None" = None
) -> Film:
    """Runs an episode and keeps pictures of its first and last view.

    Args:
        env: One environment made with `make_film_options`.
        policy: Chooses the actions.
        seed: Seed of the episode.
        camera: What takes the pictures; a `Photographer` if None.
    """
    camera = camera or Photographer(env)
    record = run_episode(env, policy, seed, watcher=camera)
    first, last = camera.snapshots
    world: Any = env.unwrapped
    return Film(
        seed=seed,
        success=record.success,
        steps=record.steps,
        first=first,
        last=last,
        threshold=float(world.task.full_visibility),
    )


def poster_of(films: Sequence[Film]) -> Image:
    """What a film shows before it plays: the end of the first episode that was solved, else of the first one.

    Args:
        films: One or more.
    """
    film = next((film for film in films if film.success), films[0])
    return annotate(
        film.last.outside,
        film.last.wrist,
        title=f"episode {film.seed}",
        step=film.steps,
        visible_fraction=film.last.visible_fraction,
        threshold=film.threshold,
        moving=False,
        success=film.success,
    )


class Photographer:
    """A `Watcher` that takes pictures of the first and last view."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        """Follows one environment made with `make_film_options`."""
        self._world: Any = env.unwrapped
        self.snapshots: list[Snapshot] = []

    def view(self, info: dict[str, Any], done: bool) -> None:
        if done or not self.snapshots:
            self.snapshots.append(self._snapshot(float(info["visible_fraction"])))

    def _snapshot(self, visible_fraction: float) -> Snapshot:
        outside = self._world.render_rgb_array()[0].cpu().numpy()
        return Snapshot(outside=outside, wrist=wrist_picture(self._world), visible_fraction=visible_fraction)


class _Camera(Photographer):
    """Also films every move and rests at every view."""

    def __init__(self, env: gym.Env[Any, Any], title: str, writer: Any) -> None:
        super().__init__(env)
        self._title, self._writer = title, writer
        self._threshold = float(self._world.task.full_visibility)
        self._qpos: torch.Tensor | None = None
        self._steps = -1
        self._success = False

    def view(self, info: dict[str, Any], done: bool) -> None:
        qpos = self._world.agent.robot.get_qpos().clone()
        if self._qpos is not None:
            self._move(self._qpos, qpos)
        self._qpos = qpos
        self._steps += 1
        self._success = self._success or (self._steps > 0 and bool(info["success"]))
        frame = self._frame(float(info["visible_fraction"]), moving=False)
        self._append([frame] * int((3.0 if done else 1.0) * HOLD_SECONDS * FRAMES_PER_SECOND))
        super().view(info, done)

    def _move(self, before: torch.Tensor, after: torch.Tensor) -> None:
        """The arm on its way from the joints `before` to the present ones, which are put back at the end."""
        robot = self._world.agent.robot
        frames = int(float((after - before).abs().max()) / JOINT_SPEED * FRAMES_PER_SECOND)
        count = min(frames, MAX_MOVE_FRAMES)
        try:
            for k in range(1, count):
                robot.set_qpos(torch.lerp(before, after, 0.5 - 0.5 * float(np.cos(np.pi * k / count))))
                seen = float(self._world.evaluate()["visible_fraction"])
                self._append([self._frame(seen, moving=True)])
        finally:
            robot.set_qpos(after)

    def _frame(self, visible_fraction: float, moving: bool) -> Image:
        shown = self._snapshot(visible_fraction)
        return annotate(
            shown.outside,
            shown.wrist,
            title=self._title,
            step=self._steps,
            visible_fraction=visible_fraction,
            threshold=self._threshold,
            moving=moving,
            success=self._success,
        )

    def _append(self, frames: Iterable[Image]) -> None:
        for frame in frames:
            self._writer.append_data(frame)


def wrist_picture(world: Any) -> Image:
    """What the wrist camera of an environment sees. Shape (H, W, 3)."""
    (sensor,) = world.get_sensor_images().values()
    picture: Image = sensor["rgb"][0].cpu().numpy()
    return picture


def annotate(
    outside: Image,
    wrist: Image,
    *,
    title: str,
    step: int,
    visible_fraction: float,
    threshold: float,
    moving: bool,
    success: bool,
) -> Image:
    """Both pictures side by side with a caption below.

    Args:
        outside: The scene. Shape (H, W, 3).
        wrist: The wrist camera's view. Shape (H, W, 3).
        title: What the film shows.
        step: Steps taken so far.
        visible_fraction: V_f at this moment.
        threshold: V_f above which the target counts as fully visible.
        moving: Whether the arm is between two viewpoints.
        success: Whether the target became fully visible.

    Returns:
        Shape (H + BAND, 2 W, 3).
    """
    height, width = outside.shape[:2]
    canvas = PillowImage.new("RGB", (2 * width, height + BAND), PAPER)
    canvas.paste(PillowImage.fromarray(outside), (0, 0))
    canvas.paste(PillowImage.fromarray(wrist), (width, 0))
    draw = ImageDraw.Draw(canvas)
    draw.line((width, 0, width, height), fill=PAPER, width=4)
    top = height + 11
    draw.text((20, top), title, font=caption_font(19, bold=True), fill=INK)
    state = "target fully visible" if success else ("moving" if moving else "looking")
    draw.text((20, top + 24), f"step {step}, {state}", font=caption_font(15), fill=LEAF if success else MUTED)
    _draw_gauge(draw, width + 20, top, width - 40, visible_fraction, threshold)
    return np.asarray(canvas)


def _draw_gauge(
    draw: ImageDraw.ImageDraw, left: int, top: int, width: int, visible_fraction: float, threshold: float
) -> None:
    """A bar from 0 to 1 with a mark at the threshold."""
    draw.text((left, top), "visible fraction of the target", font=caption_font(15), fill=MUTED)
    value = f"{visible_fraction:.2f}"
    draw.text((left + width, top - 3), value, font=caption_font(19, bold=True), fill=INK, anchor="ra")
    y0, y1 = top + 26, top + 40
    draw.rounded_rectangle((left, y0, left + width, y1), radius=7, fill=TRACK)
    end = left + max(14, int(width * visible_fraction))
    draw.rounded_rectangle(
        (left, y0, end, y1), radius=7, fill=LEAF if visible_fraction > threshold else TOMATO
    )
    mark = left + int(width * threshold)
    draw.line((mark, y0 - 4, mark, y1 + 4), fill=INK, width=2)


@functools.cache
def caption_font(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    """DejaVu Sans, which comes with matplotlib."""
    properties = font_manager.FontProperties(family="DejaVu Sans", weight="bold" if bold else "normal")
    return ImageFont.truetype(font_manager.findfont(properties), size)
