"""Stored episodes that several tests of the viewer show."""

from pathlib import Path
from typing import Any

import pytest

from maniskill_tomato.experiments.episode_record import EpisodeRecord
from maniskill_tomato.experiments.rollout import run_episode
from maniskill_tomato.experiments.stored_episodes import store_episodes
from maniskill_tomato.policies.opening import open_policy
from maniskill_tomato.tasks.vector_env import make_vector_env

ENV_ID = "TomatoViewpoint-v1"
OPTIONS: dict[str, Any] = {"episodes": "held_out"}
SEEDS = (0, 1)


@pytest.fixture(scope="session")
def stored() -> dict[str, list[EpisodeRecord]]:
    """What two policies did in the same episodes."""
    env = make_vector_env(ENV_ID, auto_reset=False, **OPTIONS)
    return {
        name: [run_episode(env, open_policy(name, env_id=ENV_ID), seed) for seed in SEEDS]
        for name in ("nbv", "random_step")
    }


@pytest.fixture(scope="session")
def record_folder(tmp_path_factory: pytest.TempPathFactory, stored: dict[str, list[EpisodeRecord]]) -> Path:
    """Their folder."""
    folder = tmp_path_factory.mktemp("record") / "benchmark"
    store_episodes(folder, ENV_ID, OPTIONS, {name: name for name in stored}, stored)
    return folder
