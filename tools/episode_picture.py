"""Renders the README's picture: the arm from outside, its camera's first view and the last one of an episode.

Usage:
    python tools/episode_picture.py --out docs/images/episode.png
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

import maniskill_tomato  # noqa: F401
from maniskill_tomato.policies.adapters import as_state_policy
from maniskill_tomato.policies.opening import open_policy, shipped_policy

TASK = "TomatoViewpointGuided-v1"


@dataclass(frozen=True, kw_only=True)
class Args:
    """Which episode, and where the picture goes."""

    out: Path = Path("docs/images/episode.png")
    """The PNG file."""
    seed: int = 1000
    """Seed of the episode."""
    scale: float = 0.75
    """Size of each of the three pictures as a share of 640 x 480 px."""


def main(args: Args) -> int:
    """Runs the shipped policy and writes the picture."""
    size = {"width": 640, "height": 480, "shader_pack": "default"}
    env: Any = gym.make(
        TASK,
        obs_mode="rgb",
        render_mode="rgb_array",
        plant={"detail": "picture"},
        sensor_configs=dict(size),
        human_render_camera_configs=dict(size),
        enable_shadow=True,
    )
    policy = as_state_policy(open_policy(shipped_policy(TASK), env_id=TASK), env)
    obs, info = env.reset(seed=args.seed)
    first, first_fraction = _wrist(obs), float(info["visible_fraction"])
    moves, done = 0, False
    while not done:
        names = ("ee_position", "ee_rpy", "target_position")
        state = torch.cat([obs["extra"][name] for name in names], dim=-1)
        obs, _, terminated, truncated, info = env.step(policy.act(state))
        moves, done = moves + 1, bool(terminated) or bool(truncated)
    outside = env.render()[0].numpy()
    last = _labelled(_wrist(obs), f"after {moves} move(s)  V_f = {float(info['visible_fraction']):.2f}")
    env.close()
    gap = np.full((480, 6, 3), 255, dtype=np.uint8)
    strip = np.concatenate(
        [outside, gap, _labelled(first, f"first view  V_f = {first_fraction:.2f}"), gap, last], axis=1
    )
    args.out.parent.mkdir(parents=True, exist_ok=True)
    iio.imwrite(args.out, cv2.resize(strip, None, fx=args.scale, fy=args.scale, interpolation=cv2.INTER_AREA))
    return 0


def _wrist(obs: dict[str, Any]) -> NDArray[np.uint8]:
    picture: NDArray[np.uint8] = obs["sensor_data"]["d435"]["rgb"][0].cpu().numpy().copy()
    return picture


def _labelled(picture: NDArray[np.uint8], text: str) -> NDArray[np.uint8]:
    labelled = picture.copy()
    cv2.putText(labelled, text, (16, 462), cv2.FONT_HERSHEY_SIMPLEX, 0.85, (255, 255, 255), 2, cv2.LINE_AA)
    return labelled


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Args)))
