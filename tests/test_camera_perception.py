"""The general task with everything from the camera image."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

import maniskill_tomato  # noqa: F401
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.tasks.camera_perception import COARSE_POSITION


def make(**options: Any) -> Any:
    return gym.make(
        "TomatoViewpoint-v1", episodes="validation", obs_mode="state", render_backend="none", **options
    ).unwrapped


def test_what_the_camera_measures_is_near_the_truth() -> None:
    env = make(perception="occlusion_model")
    measured, true, offsets = [], [], []
    for seed in range(3):
        env.reset(seed=seed)
        rng = np.random.default_rng(seed)
        for _ in range(5):
            action = torch.as_tensor(rng.uniform(-1, 1, 3), dtype=torch.float32)
            *_, info = env.step(action)
            measured.append(float(info["visible_fraction"][0]))
            true.append(float(info["true_visible_fraction"][0]))
            if bool(env._eyes.located[0]):
                offset = env.situation.target_position - env._target_position_w
                offsets.append(float(offset.norm()))
    errors = np.abs(np.array(measured) - np.array(true))
    assert max(true) > 0.3, "the views must not all be blind"
    assert errors.mean() < 0.1
    assert np.median(offsets) < 0.015
    env.close()


def test_the_same_seed_measures_the_same() -> None:
    runs = []
    for _ in range(2):
        env = make(perception="occlusion_model")
        observation, _ = env.reset(seed=4)
        after, reward, *_ = env.step(torch.tensor([0.5, 0.3, 0.1]))
        runs.append((observation, after, reward))
        env.close()
    for a, b in zip(*runs, strict=True):
        assert torch.equal(a, b)


def test_an_unseen_target_is_known_from_afar_only() -> None:
    env = make(perception="occlusion_model", start_visibility=(0.0, 0.001))
    env.reset(seed=1)
    if not bool(env._eyes.located[0]):
        offset = env.situation.target_position - env._target_position_w
        assert 0.0 < float(offset.norm()) < 5 * COARSE_POSITION
        assert float(env._eyes.visible_fraction[0]) == 0.0
    env.close()


def test_reward_goes_by_what_is_measured() -> None:
    env = make(perception="occlusion_model")
    env.reset(seed=2)
    _, reward, _, _, info = env.step(torch.tensor([1.0, 0.0, 0.0]))
    expected = float(info["visible_fraction_gain"][0]) - env.task.step_cost
    expected += env.task.success_reward * float(info["success"][0])
    if not bool(info["plant_contact"][0]):
        assert float(reward[0]) == pytest.approx(expected, abs=1e-5)
    env.close()


@pytest.mark.parametrize(
    "options",
    [{"perception": "eyes"}, {"perception": "occlusion_model", "sensor_noise": {"depth_noise": 1.0}}],
)
def test_options_that_make_no_sense_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(InvalidInputError, match="perception"):
        make(**options)
