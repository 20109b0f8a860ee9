"""`gymnasium.make_vec` against Gymnasium's own vector environments of single ones, and against ManiSkill's shell."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import vector as vector_wrappers
from numpy.typing import NDArray

import maniskill_tomato  # noqa: F401
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.learning.rl.envs import make_env
from maniskill_tomato.learning.rl.gymnasium_env import ArrayTask
from maniskill_tomato.sensing.image_layout import ImageLayout
from maniskill_tomato.tasks import TASK_IDS
from maniskill_tomato.tasks.observed_world import LearnerEyes

GUIDED, SPARSE, GENERAL, ROW = TASK_IDS
OPTIONS: dict[str, dict[str, Any]] = {
    GUIDED: {"plant_pose_noise": (0.02, 0.02, 0.1)},
    SPARSE: {"plant": {"seed": "train", "pool": 3}},
    GENERAL: {"plant": {"pool": 3}, "sensor_noise": {"depth_noise": 1.0, "target_position": 0.01}},
    ROW: {"plant": {"pool": 3}},
}
IMAGES = "depth+segmentation"
ROUNDING = 2e-5
"""Torch rounds some sums otherwise in a batch than alone; see `test_world`."""


def make(env_id: str, num_envs: int = 1, **options: Any) -> Any:
    return gym.make_vec(
        env_id, num_envs=num_envs, vectorization_mode="vector_entry_point", **{**OPTIONS[env_id], **options}
    )


def single(env_id: str, max_steps: int, images: bool = False) -> Callable[[], gym.Env[Any, Any]]:
    eyes = LearnerEyes(images=ImageLayout(kinds=("depth", "segmentation"), width=36, height=28))

    def made() -> gym.Env[Any, Any]:
        task = ArrayTask(make_env(env_id, eyes=eyes if images else None, **OPTIONS[env_id]))
        return gym.wrappers.TimeLimit(task, max_steps)

    return made


def moves(env: Any, steps: int, seed: int = 0) -> NDArray[np.float32]:
    """Random moves, wide enough that some are refused. Shape (steps, N, A)."""
    rng = np.random.default_rng(seed)
    shape = env.action_space.shape
    return ((0.15 if shape[-1] == 6 else 0.8) * rng.standard_normal((steps, *shape))).astype(np.float32)


def assert_same(found: Any, expected: Any, mask: NDArray[np.bool_] | None = None) -> None:
    """Numbers to within rounding, in the rows of `mask` where it is given; dictionaries entry by entry."""
    if isinstance(expected, dict):
        assert found.keys() >= expected.keys()
        for name, value in expected.items():
            own = expected.get(f"_{name}", mask) if not name.startswith("_") else None
            assert_same(found[name], value, own)
        return
    if isinstance(expected, np.ndarray) and expected.dtype == object:
        for one, two in zip(found, expected, strict=True):
            assert (one is None) == (two is None)
            if two is not None:
                assert_same(one, two)
        return
    assert found.shape == expected.shape
    rows = slice(None) if mask is None else mask
    np.testing.assert_allclose(
        np.asarray(found[rows], np.float64), np.asarray(expected[rows], np.float64), atol=ROUNDING, rtol=0
    )


@pytest.mark.parametrize("env_id", TASK_IDS)
@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_it_does_what_gymnasiums_own_vector_environment_of_single_ones_does(
    env_id: str, mode: AutoresetMode
) -> None:
    compare_with_sync_vector_env(env_id, mode, images=False)


@pytest.mark.parametrize("mode", list(AutoresetMode))
def test_images_are_reset_as_gymnasium_does(mode: AutoresetMode) -> None:
    compare_with_sync_vector_env(GENERAL, mode, images=True)


def compare_with_sync_vector_env(env_id: str, mode: AutoresetMode, images: bool) -> None:
    steps = 4
    seen: dict[str, Any] = {"obs_mode": IMAGES, "image_size": (36, 28)} if images else {}
    env = make(env_id, 3, max_episode_steps=steps, autoreset_mode=mode, **seen)
    reference: Any = SyncVectorEnv([single(env_id, steps, images)] * 3, autoreset_mode=mode)
    assert env.observation_space == reference.observation_space
    assert env.action_space == reference.action_space
    assert env.metadata["autoreset_mode"] is mode
    env.reset(seed=5)
    reference.reset(seed=5)
    observation, info = env.reset(seed=[7, None, 2])
    assert_same(
        {"o": observation, "i": info}, dict(zip("oi", reference.reset(seed=[7, None, 2]), strict=True))
    )
    assert observation in env.observation_space
    ends = 0
    for move in moves(env, 14):
        found, expected = env.step(move), reference.step(move)
        for one, two in zip(found, expected, strict=True):
            assert_same(one, two)
        assert found[0] in env.observation_space
        assert all(isinstance(part, np.ndarray) and part.shape == (3,) for part in found[1:4])
        assert found[2].dtype == found[3].dtype == np.bool_
        done = found[2] | found[3]
        ends += int(done.sum())
        if mode == AutoresetMode.DISABLED and done.any():
            with pytest.raises(InvalidInputError, match=f"{np.flatnonzero(done)[0]}.*reset_mask"):
                env.step(move)
            assert_same(
                dict(zip("oi", env.reset(seed=3, options={"reset_mask": done}), strict=True)),
                dict(zip("oi", reference.reset(seed=3, options={"reset_mask": done.copy()}), strict=True)),
            )
    assert ends >= 6
    env.close()
    reference.close()


@pytest.mark.parametrize("env_id", TASK_IDS)
def test_four_environments_give_what_four_simulated_ones_give(env_id: str) -> None:
    env = make(env_id, 4, autoreset_mode="Disabled")
    shells: list[Any] = [
        gym.make(env_id, obs_mode="state", render_backend="none", **OPTIONS[env_id]) for _ in range(4)
    ]
    observation, _ = env.reset(seed=[3, 4, 5, 6])
    for i, shell in enumerate(shells):
        assert_same(observation[i : i + 1], shell.reset(seed=3 + i)[0].numpy())
    playing = np.ones(4, dtype=np.bool_)
    for move in moves(env, 4):
        *found, info = env.step(move)
        for i in np.flatnonzero(playing).tolist():
            *expected, told = shells[i].step(move[i : i + 1])
            for one, two in zip(found, expected, strict=True):
                assert_same(one[i : i + 1], two.numpy())
            for name, value in told.items():
                assert_same(info[name][i : i + 1], value.numpy())
        playing &= ~(found[2] | found[3])
        if not playing.all():
            break
    for shell in shells:
        shell.close()


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP])
def test_tensors_are_the_same_numbers_in_a_form_without_objects(mode: AutoresetMode) -> None:
    arrays = make(SPARSE, 3, max_episode_steps=3, autoreset_mode=mode)
    tensors = make(SPARSE, 3, max_episode_steps=3, autoreset_mode=mode, arrays="torch")
    assert np.array_equal(arrays.reset(seed=1)[0], tensors.reset(seed=1)[0])
    finals = 0
    for move in moves(arrays, 9):
        found, expected = tensors.step(torch.as_tensor(move)), arrays.step(move)
        assert all(isinstance(part, torch.Tensor) for part in found[:4])
        for one, two in zip(found[:4], expected[:4], strict=True):
            assert np.array_equal(one, two)
        done = expected[4].get("_final_obs", np.zeros(3, dtype=np.bool_))
        assert ("final_obs" in found[4]) == bool(done.any())
        for i in np.flatnonzero(done).tolist():
            finals += 1
            assert bool(found[4]["_final_obs"][i])
            assert np.array_equal(found[4]["final_obs"][i], expected[4]["final_obs"][i])
            told = found[4]["final_info"]["visible_fraction"][i]
            assert float(told) == float(expected[4]["final_info"]["visible_fraction"][i])
    assert (finals > 0) == (mode == AutoresetMode.SAME_STEP)


def test_an_ignored_action_may_be_anything_and_changes_nothing() -> None:
    made = [make(GENERAL, 2, max_episode_steps=2) for _ in range(2)]
    for env in made:
        env.reset(seed=4)
        first, last = moves(env, 2)
        env.step(first)
        assert env.step(last)[3].all()
    nothing = np.zeros((2, 3), np.float32)
    begun = made[0].step(nothing)
    assert_same(
        dict(zip("ortui", made[1].step(nothing * np.nan), strict=True)),
        dict(zip("ortui", begun, strict=True)),
    )
    assert (begun[1] == 0.0).all() and not (begun[2] | begun[3]).any()
    assert (begun[4]["elapsed_steps"] == 0).all()
    with pytest.raises(InvalidInputError, match="finite"):
        made[0].step(nothing * np.nan)


def test_others_keep_their_stacked_views_when_one_is_reset() -> None:
    layout = ImageLayout(kinds=("depth",), width=36, height=28)
    env = make(GENERAL, 2, eyes=LearnerEyes(images=layout, frames=2), autoreset_mode="Disabled")
    env.reset(seed=2)
    before = env.step(moves(env, 1)[0])[0]
    depth = before["depth"].copy()
    assert not np.array_equal(depth[1, ..., 0], depth[1, ..., 1])
    after, info = env.reset(options={"reset_mask": np.array([True, False])})
    assert np.array_equal(after["depth"][1], depth[1])
    assert np.array_equal(after["depth"][0, ..., 0], after["depth"][0, ..., 1])
    assert info["_success"].tolist() == [True, False]


def test_a_specification_makes_the_same_environment_again() -> None:
    env = make(GENERAL, 2, max_episode_steps=3, autoreset_mode="SameStep")
    again: Any = gym.make_vec(env.spec)
    after_text: Any = gym.make_vec(EnvSpec.from_json(env.spec.to_json()))
    first = env.reset(seed=9)[0]
    for other in (again, after_text):
        assert other.num_envs == 2 and other.call("_max_episode_steps") == (3, 3)
        assert other.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
        assert np.array_equal(other.reset(seed=9)[0], first)


def test_attributes_of_every_environment_and_of_the_world() -> None:
    env = make(GUIDED, 3)
    assert env.unwrapped is env
    assert env.call("_max_episode_steps") == env.get_attr("max_steps") == (30, 30, 30)
    assert env.qpos.shape == (3, 7) and env.task.full_visibility == 0.85
    with pytest.raises(AttributeError, match="belief"):
        _ = env.belief
    assert repr(env) == "VectorEnv(TomatoViewpointGuided-v1, num_envs=3)"
    env.close()
    assert env.closed


@pytest.mark.parametrize("mode", ["SameStep", "NextStep"])
def test_gymnasiums_statistics_count_whole_episodes(mode: str) -> None:
    env: Any = vector_wrappers.RecordEpisodeStatistics(
        make(SPARSE, 2, max_episode_steps=3, autoreset_mode=mode)
    )
    env.reset(seed=0)
    sums, lengths = np.zeros(2), []
    waiting = np.zeros(2, dtype=np.bool_)
    for move in 0.3 * moves(env, 12):
        _, reward, terminated, truncated, info = env.step(move)
        sums += reward
        for i in np.flatnonzero(terminated | truncated).tolist():
            told = info["episode"]
            assert told["r"][i] == pytest.approx(sums[i])
            lengths.append(int(told["l"][i]))
            sums[i] = 0.0
        waiting = terminated | truncated
    assert len(lengths) >= 5 and set(lengths) <= {1, 2, 3} and not waiting.all()


def test_gymnasiums_wrappers_of_observations_take_it() -> None:
    options: dict[str, Any] = {"obs_mode": IMAGES, "image_size": (36, 28), "max_episode_steps": 2}
    plain = make(GENERAL, 2, **options)
    flat: Any = vector_wrappers.FlattenObservation(make(GENERAL, 2, **options))
    pairs = [(plain.reset(seed=1)[0], flat.reset(seed=1)[0])]
    pairs += [(plain.step(move)[0], flat.step(move)[0]) for move in moves(plain, 3)]
    for expected, found in pairs:
        for i in range(2):
            own = {name: value[i] for name, value in expected.items()}
            wanted: Any = gym.spaces.flatten(plain.single_observation_space, own)
            assert np.array_equal(found[i], wanted)


def test_single_environments_keep_maniskills_time_limit() -> None:
    for most, steps in ((None, 30), (2, 2)):
        env: Any = gym.make(GUIDED, max_episode_steps=most, obs_mode="state", render_backend="none")
        assert "TimeLimitWrapper" in str(env)
        env.reset(seed=0)
        for step in range(steps):
            *_, truncated, _ = env.step(torch.zeros(1, 6))
            assert isinstance(truncated, torch.Tensor) and bool(truncated) == (step == steps - 1)
        env.close()


@pytest.mark.parametrize(
    ("env_id", "options", "message"),
    [
        (GENERAL, {"percepton": "occlusion_model"}, "did you mean 'perception'"),
        (GENERAL, {"obs_mod": "state"}, "did you mean 'obs_mode'"),
        (GENERAL, {"render_mode": "rgb_array"}, "gymnasium.make"),
        (GENERAL, {"scene": "thesis"}, "option of TomatoViewpointGuided-v1"),
        (GENERAL, {"obs_mode": "rgb+depth"}, "needs a renderer"),
        (GENERAL, {"obs_mode": "dept"}, "obs_mode must be"),
        (GENERAL, {"autoreset_mode": "SameSteps"}, "did you mean 'SameStep'"),
        (GENERAL, {"arrays": "jax"}, "'numpy', 'torch'"),
        (GENERAL, {"control_mode": "pd_joint_pos"}, "pd_look_at"),
        (GENERAL, {"control_mode": "pd_ee_delta_pos"}, "'pd_look_at'.*gymnasium.make"),
        (GENERAL, {"max_episode_steps": 0}, "1 or more"),
        (GENERAL, {"num_envs": 0}, "1 or more"),
        (GENERAL, {"device": "mps"}, "'cpu', 'cuda'"),
        pytest.param(
            GUIDED,
            {"device": "cuda"},
            "NVIDIA GPU",
            marks=pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU"),
        ),
    ],
)
def test_what_cannot_be_made_is_refused_in_words(env_id: str, options: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidInputError, match=message):
        make(env_id, **{"num_envs": 2, **options})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"options": {"reset_mask": np.array([1, 0])}}, "array of bool"),
        ({"options": {"reset_mask": np.array([True])}}, r"shape \(2,\)"),
        ({"options": {"reset_mask": np.array([False, False])}}, "at least once"),
        ({"options": {"reset_mask": [True, False]}}, "array of bool"),
        ({"options": {"reset_mask": np.array([True, False]), "env_idx": [0]}}, "not both"),
        ({"seed": [1, 2, 3]}, "one number or 2"),
        ({"seed": [1], "options": {"reset_mask": np.array([True, False])}}, "one number or 2"),
    ],
)
def test_what_cannot_be_reset_is_refused_in_words(arguments: dict[str, Any], message: str) -> None:
    env = make(GUIDED, 2)
    with pytest.raises(InvalidInputError, match=message):
        env.reset(**arguments)


def test_no_simulator_is_loaded_nor_needs_to_be_installed() -> None:
    code = (
        "import sys\n"
        "sys.modules['sapien'] = sys.modules['mani_skill'] = None\n"  # An import of them raises.
        "import gymnasium, maniskill_tomato\n"
        "for env_id in maniskill_tomato.tasks.TASK_IDS:\n"
        "    env = gymnasium.make_vec(env_id, num_envs=2)\n"
        "    env.reset(seed=0)\n"
        "    env.step(env.action_space.sample())\n"
    )
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, cwd=root, timeout=300
    )
    assert done.returncode == 0, done.stderr
