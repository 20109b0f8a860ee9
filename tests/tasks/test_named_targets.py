"""Naming a target to a robot that sees through a camera: which detections can be named, and which cannot."""

from typing import Any

import torch

from maniskill_tomato.learning.rl.envs import make_env


def test_what_only_a_second_picture_from_one_place_shows_is_not_named_and_does_no_harm() -> None:
    env: Any = make_env(
        "TomatoViewpoint-v1",
        perception="simulated_segmenter",
        plant={"preset": "full", "seed": "validation"},
        target="track",
    )
    # In these episodes the masks of a repeated look, whose errors are drawn anew, show the target for the first time.
    for seed in (14, 17):
        _, info = env.reset(seed=seed)
        for _ in range(3):
            assert bool(info["tomato_seen"]) and not bool(info["target_named"])
            _, _, _, _, info = env.step(torch.zeros(1, 3))
    env.close()
