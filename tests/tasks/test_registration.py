"""Gym registration: the promised IDs, lazily, as serialisable specs."""

import json
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import pytest
from gymnasium.envs.registration import EnvSpec, load_env_creator

import maniskill_tomato
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.task_registry import find_task, is_same_task
from maniskill_tomato.tasks import MAX_EPISODE_STEPS, TASK_IDS

EXPECTED_IDS = (
    "TomatoViewpointGuided-v1",
    "TomatoViewpointSparse-v1",
    "TomatoViewpoint-v1",
    "TomatoViewpointRow-v1",
)

HORIZONS: dict[str, int] = dict(zip(EXPECTED_IDS, (30, 30, 20, 120), strict=True))


def run_python(code: str, cwd: Path, *arguments: str) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-I", "-c", code, *arguments]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, timeout=300)


def test_importing_the_package_is_enough_to_register_the_tasks(tmp_path: Path) -> None:
    code = (
        "import gymnasium, json\n"
        "before = [i for i in gymnasium.registry if 'Tomato' in i]\n"
        "import maniskill_tomato\n"
        "print(json.dumps([before, sorted(i for i in gymnasium.registry if 'Tomato' in i)]))\n"
    )
    result = run_python(code, tmp_path)
    assert result.returncode == 0, result.stderr
    assert json.loads(result.stdout) == [[], sorted(EXPECTED_IDS)]


def test_the_list_of_ids_is_what_others_build_on() -> None:
    assert set(TASK_IDS) == set(EXPECTED_IDS)
    assert maniskill_tomato.tasks.TASK_IDS is TASK_IDS


@pytest.mark.parametrize("env_id", EXPECTED_IDS)
def test_a_spec_survives_json(env_id: str) -> None:
    spec = gym.spec(env_id)
    copy = EnvSpec.from_json(spec.to_json())
    assert copy == spec
    assert copy.max_episode_steps == HORIZONS[env_id]


def test_the_thesis_tasks_have_the_horizon_of_tables_5_1_and_5_2() -> None:
    assert MAX_EPISODE_STEPS == 30


@pytest.mark.parametrize("env_id", EXPECTED_IDS)
def test_a_spec_names_its_environment_by_a_string_inside_the_package(env_id: str) -> None:
    entry_point = gym.spec(env_id).entry_point
    assert isinstance(entry_point, str)
    assert entry_point.startswith("maniskill_tomato.tasks.")


@pytest.mark.parametrize("env_id", EXPECTED_IDS)
def test_the_entry_point_resolves_to_a_class_that_maniskill_knows_under_the_same_id(env_id: str) -> None:
    entry_point = gym.spec(env_id).entry_point
    assert isinstance(entry_point, str)
    environment = load_env_creator(entry_point)
    from mani_skill.utils.registration import REGISTERED_ENVS

    assert REGISTERED_ENVS[env_id].cls is environment


def test_reloading_the_registration_module_neither_warns_nor_duplicates(tmp_path: Path) -> None:
    code = (
        "import warnings; warnings.simplefilter('error')\n"
        "import importlib, gymnasium, maniskill_tomato.tasks as tasks\n"
        "n = len(gymnasium.registry); importlib.reload(tasks); assert len(gymnasium.registry) == n\n"
    )
    result = run_python(code, tmp_path)
    assert result.returncode == 0, result.stderr
    assert result.stderr == ""


def test_make_works_from_the_module_form_in_a_fresh_process(tmp_path: Path) -> None:
    code = (
        "import sys, gymnasium as gym\n"
        "for env_id in sys.argv[1:]:\n"
        "    env = gym.make('maniskill_tomato:' + env_id, obs_mode='state', render_backend='none')\n"
        "    observation, info = env.reset(seed=3)\n"
        "    size = 9 if 'Guided' in env_id or 'Sparse' in env_id else 786\n"
        "    assert tuple(observation.shape) == (1, size), observation.shape\n"
        "    assert env.spec.id == env_id, env.spec\n"
        "    env.close()\n"
    )
    # One of each family.
    result = run_python(code, tmp_path, EXPECTED_IDS[0], EXPECTED_IDS[3])
    assert result.returncode == 0, result.stderr


def test_an_unknown_version_is_refused_with_the_one_that_exists() -> None:
    with pytest.raises(gym.error.Error, match="TomatoViewpointGuided"):
        gym.spec("TomatoViewpointGuided-v9")


@pytest.mark.parametrize("env_id", EXPECTED_IDS)
def test_an_id_may_be_given_as_gymnasium_imports_it(env_id: str) -> None:
    assert find_task(f"maniskill_tomato:{env_id}") is find_task(env_id)
    assert is_same_task(f"maniskill_tomato:{env_id}", env_id)
    with pytest.raises(InvalidInputError, match="TomatoViewpoint"):
        find_task(f"other_package:{env_id}")
