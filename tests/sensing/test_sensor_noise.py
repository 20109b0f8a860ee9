"""Errors of camera, segmenter and calibration in the general task."""

from typing import Any, cast

import numpy as np
import pytest
import torch

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.learning.rl.envs import make_env
from maniskill_tomato.raycast.view_rays import RayLabel, ViewRays
from maniskill_tomato.sensing.sensor_noise import SensorErrors, SensorNoise

PLANT = {"seed": 3, "pool": None}


def world(**noise: float) -> Any:
    return make_env("TomatoViewpoint-v1", plant=PLANT, sensor_noise=noise)


def test_errors_repeat_with_the_seed_and_leave_the_truth_alone() -> None:
    clean, noisy = world(), world(depth_noise=2.0, missed_target=0.5, target_position=0.02)
    first: list[torch.Tensor] = []
    again: list[torch.Tensor] = []
    for kept in (first, again):
        observation, info = noisy.reset(seed=5)
        kept.append(observation)
        observation, _, _, _, moved = noisy.step(torch.tensor([[0.5, 0.0, 0.0]]))
        kept.append(observation)
    torch.testing.assert_close(first, again, rtol=0.0, atol=0.0)
    clean_observation, clean_info = clean.reset(seed=5)
    torch.testing.assert_close(info["visible_fraction"], clean_info["visible_fraction"])
    assert not torch.equal(first[0], clean_observation)
    assert not torch.equal(moved["visible_fraction"], info["visible_fraction"])


def test_the_known_target_is_off_by_what_was_asked_for() -> None:
    env = world(target_position=0.03)
    offsets = []
    for seed in range(40):
        env.reset(seed=seed)
        base = env.unwrapped
        offsets.append((base.belief.target_position - base.target_position_w)[0].numpy())
    # 120 draws: the standard deviation is known to 6.5 %, three times which is 20 %.
    assert np.std(offsets) == pytest.approx(0.03, rel=0.2)


def test_missed_rays_shrink_the_measured_share() -> None:
    options: Any = {"plant": PLANT, "start_visibility": (0.4, 0.95)}
    clean = make_env("TomatoViewpoint-v1", **options)
    noisy = make_env("TomatoViewpoint-v1", sensor_noise={"missed_target": 0.4}, **options)
    counts = np.zeros(2)
    for seed in range(20):
        for k, env in enumerate((clean, noisy)):
            _, info = env.reset(seed=seed)
            belief = cast(Any, env.unwrapped).belief
            counts[k] += int((belief.rays.label == int(RayLabel.TARGET)).sum())
            share = (1.0, 0.6)[k] * float(info["visible_fraction"][0])
            assert float(belief.visible_fraction[0]) == pytest.approx(share, abs=1e-6)
    # 200 rays or more: the share is known to 3.5 %.
    assert counts[0] > 200
    assert counts[1] / counts[0] == pytest.approx(0.6, abs=0.1)


def test_noise_that_makes_no_sense_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="a key of sensor_noise"):
        SensorNoise.parse({"fog": 0.1})
    for name, value in (("dropout", 1.5), ("depth_noise", -1.0), ("target_position", float("nan"))):
        with pytest.raises(InvalidInputError, match=name):
            SensorNoise.parse({name: value})


def test_every_environment_has_its_own_errors() -> None:
    """What one environment measures follows from its own seed, not from the others' or from how often they look."""
    there = ViewRays(
        torch.tensor([0.0, 0.0, 1.0]).expand(2, 64, 3),
        torch.full((2, 64), 0.5),
        torch.full((2, 64), int(RayLabel.OTHER), dtype=torch.int8),
    )
    noise = SensorNoise(depth_noise=1.0, dropout=0.2, false_target=0.1)
    errors = SensorErrors(noise, torch.device("cpu"))
    both, other = errors.rays(there, {0: 1, 1: 2}), errors.rays(there, {0: 1, 1: 3})
    assert torch.equal(both.distance[0], other.distance[0]) and torch.equal(both.label[0], other.label[0])
    assert not torch.equal(both.distance[1], other.distance[1])
    alone = errors.rays(there, {1: 2})
    assert torch.equal(alone.distance[0], there.distance[0])
    assert torch.equal(alone.distance[1], both.distance[1])
