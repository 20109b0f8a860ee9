"""Renders the README's picture: the robot in its row at the end of a search, and below what its camera saw on the way.

Usage:
    python tools/episode_picture.py --out docs/images/episode.jpg
"""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import gymnasium as gym
import imageio.v3 as iio
import numpy as np
import torch
import tyro
from numpy.typing import NDArray
from PIL import Image, ImageDraw

import maniskill_tomato  # noqa: F401
from maniskill_tomato.experiments.film import caption_font, make_film_options, wrist_picture
from maniskill_tomato.experiments.rollout import run_batch
from maniskill_tomato.policies.opening import open_policy, shipped_policy
from maniskill_tomato.report_design import INK, LEAF, TOMATO

TASK = "TomatoViewpoint-v1"
Picture = NDArray[np.uint8]


@dataclass(frozen=True, kw_only=True)
class Args:
    """Which episode, and where the picture goes."""

    out: Path = Path("docs/images/episode.jpg")
    """The JPEG file."""
    seed: int = 9
    """Which episode of the held-out list."""
    width: int = 1200
    """Of the picture, in [px]."""
    quality: int = 86
    """Of the JPEG file."""


class _Views:
    """A watcher that keeps the wrist's pictures with V_f, and the scene at the end."""

    def __init__(self, world: Any) -> None:
        self._world = world
        self.wrist: list[tuple[Picture, float]] = []
        self.outside: Picture | None = None

    def view(self, info: dict[str, Any], done: bool) -> None:
        fraction = float(info["visible_fraction"])
        self.wrist.append((_ringed(wrist_picture(self._world), self._world), fraction))
        self.outside = self._world.render_rgb_array()[0].cpu().numpy()


def main(args: Args) -> int:
    """Runs the shipped policy and writes the picture."""
    options = make_film_options({"episodes": "held_out", "plant": {"detail": "picture"}})
    height = args.width * 9 // 16
    options["human_render_camera_configs"] = {"width": args.width, "height": height}
    env: Any = gym.make(TASK, obs_mode="state", **options)
    views = _Views(env.unwrapped)
    run_batch(env, open_policy(shipped_policy(TASK), env_id=TASK), [args.seed], watcher=views)
    env.close()
    assert views.outside is not None
    gap = 6
    wide = (args.width - gap * (len(views.wrist) - 1)) // len(views.wrist)
    tall = wide * 3 // 4
    sheet = np.full((height + gap + tall, args.width, 3), 255, dtype=np.uint8)
    sheet[:height] = views.outside
    for k, (picture, fraction) in enumerate(views.wrist):
        small: Any = cv2.resize(picture, (wide, tall), interpolation=cv2.INTER_AREA)
        left = k * (wide + gap)
        sheet[height + gap :, left : left + wide] = _labelled(small, k, fraction)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    iio.imwrite(args.out, sheet, quality=args.quality)
    return 0


def _ringed(picture: Picture, world: Any) -> Picture:
    """The target marked by a ring round its place, whether it is hidden or not."""
    target_w = world.target_position_w[0].cpu().numpy()
    sensor = world.scene.sensors["d435"].camera
    extrinsic, intrinsic = (
        matrix[0].cpu().numpy() for matrix in (sensor.get_extrinsic_matrix(), sensor.get_intrinsic_matrix())
    )
    place = extrinsic[:, :3] @ target_w + extrinsic[:, 3]
    u, v = (intrinsic @ place)[:2] / place[2]
    radius = intrinsic[0, 0] * 0.045 / place[2]
    marked = picture.copy()
    for colour, thickness in (((255, 255, 255), 5), ((20, 20, 20), 2)):
        cv2.circle(marked, (round(u), round(v)), round(radius), colour, thickness, cv2.LINE_AA)
    return marked


def _labelled(picture: Picture, moves: int, fraction: float) -> Picture:
    image = Image.fromarray(picture)
    draw = ImageDraw.Draw(image, "RGBA")
    text = "first view" if moves == 0 else f"move {moves}"
    draw.rectangle((0, image.height - 34, image.width, image.height), fill=(255, 255, 255, 225))
    draw.text((10, image.height - 27), text, font=caption_font(17, bold=True), fill=INK)
    draw.text(
        (image.width - 10, image.height - 27),
        f"{100.0 * fraction:.0f} % visible",
        font=caption_font(17),
        fill=LEAF if fraction > 0.8 else TOMATO,
        anchor="ra",
    )
    return np.asarray(image)


if __name__ == "__main__":
    torch.set_num_threads(1)
    sys.exit(main(tyro.cli(Args)))
