"""Planners on the general task with the real arm: the oracle's promises, demonstrations, benchmark episodes."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import numpy as np
import pytest
import torch

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments.policy_runs import PolicySpec, open_for
from maniskill_tomato.experiments.rollout import run_episode
from maniskill_tomato.learning.imitation.demonstrations import record_demonstrations
from maniskill_tomato.learning.rl.envs import make_env, make_simulated_env
from maniskill_tomato.policies.oracle import Oracle, OracleSearch

PLANTS = {"seed": "train", "pool": 2}


@pytest.fixture(scope="module")
def env() -> Iterator[gym.Env[Any, Any]]:
    made = make_env("TomatoViewpoint-v1", plant=PLANTS)
    yield made
    made.close()


def test_the_oracle_needs_as_many_moves_as_it_says(env: gym.Env[Any, Any]) -> None:
    world: Any = env.unwrapped
    truth = world.ground_truth
    search = OracleSearch(truth)
    solved = 0
    for seed in range(4):
        env.reset(seed=seed)
        belief = world.belief
        solution = search.solve(belief.camera_position[0], belief.target_position[0])
        episode = run_episode(env, Oracle(search), seed)
        assert episode.success == (solution is not None)
        if solution is not None:
            solved += 1
            # An earlier stop may happen to be good as well.
            assert episode.steps <= solution.moves
            assert not episode.refused.any()
            if episode.steps == solution.moves:
                last = solution.stops[-1].double().numpy()
                assert episode.camera is not None
                np.testing.assert_allclose(episode.camera[-1], last, atol=1e-3)
                assert episode.visible_fraction[-1] > truth.threshold
    assert solved >= 3


@pytest.mark.slow
def test_a_contact_free_oracle_touches_nothing(env: gym.Env[Any, Any]) -> None:
    free = open_for(PolicySpec.parse("oracle"), env, contact_free=True)
    episodes = [run_episode(env, free, seed) for seed in range(4)]
    assert sum(e.success for e in episodes) >= 2
    for episode in episodes:
        if episode.success:
            assert episode.contact is not None and not episode.contact.any()
            assert episode.clearance is not None and episode.clearance.min() > 0.0


def test_planners_act_on_the_real_arm(env: gym.Env[Any, Any]) -> None:
    for name in ("nbv", "gradient_nbv", "3dmts", "random_viewpoint"):
        policy = open_for(PolicySpec.parse(name), env)
        first, again = (run_episode(env, policy, 1) for _ in range(2))
        assert first.camera is not None and again.camera is not None and first.clearance is not None
        np.testing.assert_allclose(first.camera, again.camera, atol=1e-6)
        assert first.camera_path_length > 0.05
        assert np.all(np.linalg.norm(np.diff(first.camera, axis=0), axis=1) < 0.1201)
        assert np.isfinite(first.clearance).all()


def test_demonstrations_can_be_replayed(tmp_path: Path) -> None:
    made: Any = make_simulated_env("TomatoViewpoint-v1", plant=PLANTS)
    planner = open_for(PolicySpec.parse("nbv"), made)
    result = record_demonstrations(made, planner, range(4), tmp_path)
    assert result.tried == 4 and result.recorded >= 2
    description = json.loads(result.path.with_suffix(".json").read_text())
    assert description["env_info"]["env_id"] == "maniskill_tomato:TomatoViewpoint-v1"
    assert len(description["episodes"]) == result.recorded
    again: Any = make_simulated_env("TomatoViewpoint-v1", plant=PLANTS)
    with h5py.File(result.path) as file:
        for entry in description["episodes"]:
            group: Any = file[f"traj_{entry['episode_id']}"]
            actions = group["actions"][()]
            assert group["success"][-1] and entry["success"]
            assert group["obs"].shape[0] == len(actions) + 1
            observation, _ = again.reset(**entry["reset_kwargs"])
            np.testing.assert_allclose(observation[0].numpy(), group["obs"][0], atol=1e-5)
            info: dict[str, Any] = {}
            for step, action in enumerate(actions):
                observation, _, _, _, info = again.step(torch.from_numpy(action))
                np.testing.assert_allclose(observation[0].numpy(), group["obs"][step + 1], atol=1e-4)
            assert bool(info["success"][0])
    with pytest.raises(InvalidInputError, match="exists"):
        record_demonstrations(again, planner, range(1), tmp_path)
    again.close()
