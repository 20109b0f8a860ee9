"""Draws and films what a policy of images sees in a search, and draws the curves of its trainings.

Usage:
    python tools/pixel_pictures.py --runs runs/pixels-0 runs/pixels-1 --out docs/images
"""

import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import imageio.v3 as iio
import matplotlib as mpl
import numpy as np
import tyro
from numpy.typing import NDArray
from PIL import Image

from maniskill_tomato.experiments.film import (
    FRAMES_PER_SECOND,
    film_episodes,
    make_film_options,
    wrist_picture,
)
from maniskill_tomato.experiments.rollout import run_batch
from maniskill_tomato.learning.rl.envs import make_env
from maniskill_tomato.learning.rl.history import load_history
from maniskill_tomato.plants.organs import Role
from maniskill_tomato.policies.opening import open_policy
from maniskill_tomato.policies.pixel_policy import PixelPolicy

mpl.use("Agg")
import matplotlib.pyplot as plt

TASK = "TomatoViewpoint-v1"
Picture = NDArray[np.uint8]

COLOURS = {
    Role.BACKGROUND: (238, 240, 242),
    Role.ROBOT: (90, 95, 100),
    Role.STEM: (150, 110, 60),
    Role.LEAF: (90, 150, 90),
    Role.OTHER_FRUIT: (240, 170, 90),
    Role.TARGET: (200, 30, 30),
    Role.OBJECT: (120, 120, 160),
}
"""Of the roles, sRGB."""

AVERAGED = 100
"""Training episodes that a point of the curves averages over."""

LINES = ("-", "--", ":", "-.")
SIDE = 320
"""Width of a picture, in [px]."""

FILM_WIDTH = 800
"""Of the film, in [px]."""
EVERY = 2
"""Of the frames of the film that this package makes, every second one is kept, to be shown for twice as long."""


@dataclass(frozen=True, kw_only=True)
class Args:
    """Which trainings, which episode, and where the pictures go."""

    runs: tuple[Path, ...]
    """Folders of the trainings; the first one's policy is shown."""
    out: Path = Path("docs/images")
    """Folder of `pixel_search.jpg`, `pixel_search.webp` and `pixel_training.png`."""
    seed: int = 9
    """Which episode of the held-out list."""
    curves: bool = True
    """Whether to draw the curves."""


class _Views:
    """Keeps what the policy saw, as columns of pictures."""

    def __init__(self, world: Any, policy: PixelPolicy) -> None:
        self._world = world
        self._layout = policy.sight.images
        self.columns: list[Picture] = []

    def view(self, info: dict[str, Any], done: bool) -> None:
        images = self._world.images(self._layout)
        role = images["segmentation"][0, ..., 0].numpy()
        painted = np.array([COLOURS[Role(number)] for number in range(len(Role))], np.uint8)[role]
        depth = np.clip(images["depth"][0].numpy() / 1500.0, 0.0, 1.0)
        grey = np.repeat((255 * (1.0 - depth)).astype(np.uint8), 3, axis=-1)
        size = (SIDE, SIDE * self._layout.height // self._layout.width)
        parts = [cv2.resize(wrist_picture(self._world), size, interpolation=cv2.INTER_AREA)]
        parts += [cv2.resize(image, size, interpolation=cv2.INTER_NEAREST) for image in (painted, grey)]
        text = f"V_f {float(info['visible_fraction']):.2f}"
        cv2.putText(parts[0], text, (8, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.7, (255, 255, 255), 4, cv2.LINE_AA)
        cv2.putText(parts[0], text, (8, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.7, (20, 20, 20), 1, cv2.LINE_AA)
        self.columns.append(np.concatenate(parts).astype(np.uint8))


def film(env: Any, policy: PixelPolicy, seed: int, path: Path) -> None:
    """Films the search as an animated picture, which pages show without a player."""
    with tempfile.TemporaryDirectory() as folder:
        whole = Path(folder) / "film.mp4"
        film_episodes(env, policy, [seed], whole)
        frames = iio.imread(whole)[::EVERY]
    height = round(FILM_WIDTH * frames.shape[1] / frames.shape[2])
    shown = [
        Image.fromarray(cv2.resize(f, (FILM_WIDTH, height), interpolation=cv2.INTER_AREA)) for f in frames
    ]
    milliseconds = round(1000 * EVERY / FRAMES_PER_SECOND)
    shown[0].save(
        path, save_all=True, append_images=shown[1:], duration=milliseconds, loop=0, quality=55, method=6
    )


def main(args: Args) -> int:
    """Draws the pictures."""
    args.out.mkdir(parents=True, exist_ok=True)
    policy = open_policy(args.runs[0] / "policy.pt", env_id=TASK)
    assert isinstance(policy, PixelPolicy)
    env = make_env(TASK, **make_film_options({"episodes": "held_out"}))
    views = _Views(env.unwrapped, policy)
    run_batch(env, policy, [args.seed], watcher=views)
    iio.imwrite(args.out / "pixel_search.jpg", np.concatenate(views.columns, axis=1), quality=88)
    film(env, policy, args.seed, args.out / "pixel_search.webp")
    env.close()
    if not args.curves:
        return 0
    figure, (success, steps) = plt.subplots(1, 2, figsize=(9.0, 3.2), layout="constrained")
    for run, line in zip(args.runs, LINES, strict=False):
        episodes = load_history(run).episodes
        window = np.ones(AVERAGED) / AVERAGED
        ends = episodes["end_step"][AVERAGED - 1 :]
        for axes, name in ((success, "success"), (steps, "steps")):
            axes.plot(ends, np.convolve(episodes[name], window, "valid"), line, label=run.name)
    success.set(ylabel=f"success, mean of {AVERAGED} episodes", ylim=(0.0, 1.0))
    steps.set(ylabel=f"moves, mean of {AVERAGED} episodes", ylim=(0.0, None))
    for axes in (success, steps):
        axes.set_xlabel("environment steps, with exploration noise")
        axes.grid(alpha=0.3)
    success.legend(loc="lower right")
    figure.savefig(args.out / "pixel_training.png", dpi=120)
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Args)))
