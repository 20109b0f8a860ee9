"""What ManiSkill promises of any environment holds for these: spaces, seeds, states, scenes, wrappers."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from mani_skill.utils.gym_utils import find_max_episode_steps_value
from mani_skill.utils.wrappers.action_repeat import ActionRepeatWrapper
from mani_skill.utils.wrappers.flatten import FlattenRGBDObservationWrapper
from mani_skill.utils.wrappers.frame_stack import FrameStack
from mani_skill.utils.wrappers.gymnasium import CPUGymWrapper
from mani_skill.utils.wrappers.record import RecordEpisode
from mani_skill.vector.wrappers.gymnasium import ManiSkillVectorEnv
from numpy.typing import NDArray

import maniskill_tomato  # noqa: F401
from maniskill_tomato.robot.kinematics import forward_kinematics
from maniskill_tomato.robot.look_at import flange_to_camera
from maniskill_tomato.task_registry import find_task
from maniskill_tomato.tasks import TASK_IDS
from maniskill_tomato.tasks.maniskill.iiwa14_agent import Iiwa14D435

GUIDED, SPARSE, GENERAL, ROW = TASK_IDS
MAX_STEPS = {env_id: find_task(env_id).max_episode_steps for env_id in TASK_IDS}
SIZE = {"width": 40, "height": 30}
FILM_SIZE = {"width": 320, "height": 240}
TEXTURES = {
    "rgb": ((30, 40, 3), torch.uint8),
    "depth": ((30, 40, 1), torch.int16),
    "segmentation": ((30, 40, 1), torch.int16),
    "position": ((30, 40, 3), torch.int16),
}


def make(env_id: str, **options: Any) -> Any:
    return gym.make(env_id, **{"obs_mode": "state", "render_backend": "none", **options})


def make_drawn(env_id: str, **options: Any) -> Any:
    return gym.make(env_id, **{"obs_mode": "rgb+depth+segmentation", "sensor_configs": dict(SIZE), **options})


@pytest.fixture(scope="module", params=TASK_IDS)
def env(request: pytest.FixtureRequest) -> Iterator[Any]:
    """Each task with state observations."""
    made = make(request.param)
    yield made
    made.close()


def moves(env: Any, count: int, seed: int = 0) -> NDArray[np.float32]:
    """Random actions that seldom leave the workspace. Shape (count, A)."""
    size = env.unwrapped.single_action_space.shape[0]
    return (0.1 * np.random.default_rng(seed).standard_normal((count, size))).astype(np.float32)


def as_numpy(tree: Any) -> Any:
    return {k: as_numpy(v) for k, v in tree.items()} if isinstance(tree, dict) else np.asarray(tree)


def assert_equal(found: Any, expected: Any) -> None:
    if isinstance(expected, dict):
        assert found.keys() == expected.keys()
        for name, value in expected.items():
            assert_equal(found[name], value)
    else:
        assert torch.equal(torch.as_tensor(found), torch.as_tensor(expected))


def test_resets_and_steps_give_batches_that_lie_in_the_spaces(env: Any) -> None:
    base = env.unwrapped
    observation, info = env.reset(seed=2)
    assert bool(info["reconfigure"]) is False and int(info["elapsed_steps"]) == 0
    for count, move in enumerate([None, *moves(env, 2)]):
        if move is not None:
            observation, reward, terminated, truncated, info = env.step(move)
            for value, dtype in (
                (reward, torch.float32),
                (terminated, torch.bool),
                (truncated, torch.bool),
                (info["success"], torch.bool),
                (info["fail"], torch.bool),
            ):
                assert value.shape == (1,) and value.dtype == dtype
            assert int(info["elapsed_steps"]) == count
        assert observation.dtype == torch.float32
        assert env.observation_space.contains(observation.numpy())
        assert base.single_observation_space.contains(observation[0].numpy())
    assert base.single_action_space.contains(base.single_action_space.sample())


def test_a_seed_gives_the_same_episode_again_whatever_came_before(env: Any) -> None:
    first, told = env.reset(seed=2000)
    trace = [env.step(move) for move in moves(env, 3)]
    env.reset()
    again, told_again = env.reset(seed=2000)
    assert_equal(again, first)
    assert_equal(told_again, told)
    for move, expected in zip(moves(env, 3), trace, strict=True):
        assert_equal(dict(enumerate(env.step(move))), dict(enumerate(expected)))


def test_unseeded_resets_follow_from_the_last_seed(env: Any) -> None:
    sequences = []
    for _ in range(2):
        env.reset(seed=11)
        sequences.append([env.reset()[0] for _ in range(3)])
    for one, two in zip(*sequences, strict=True):
        assert torch.equal(one, two)
    assert not torch.equal(sequences[0][0], sequences[0][1])


@pytest.mark.parametrize("flat", [True, False])
def test_a_state_is_taken_back_after_other_moves(env: Any, flat: bool) -> None:
    base = env.unwrapped
    env.reset(seed=1000)
    for move in moves(env, 2):
        env.step(move)
    saved = base.get_state() if flat else base.get_state_dict()
    expected = base.get_obs()
    last = moves(env, 1, seed=9)[0]
    following = env.step(last)
    for move in moves(env, 5, seed=1):
        env.step(move)
    assert not torch.equal(base.get_obs(), expected)
    if flat:
        base.set_state(saved)
    else:
        base.set_state_dict(as_numpy(saved))
    assert torch.equal(base.get_obs(), expected)
    assert_equal(base.get_state(), saved if flat else base.get_state())
    result = env.step(last)
    for one, two in zip(result[:3], following[:3], strict=True):
        assert torch.equal(one, two)


def test_actions_that_are_not_finite_raise_value_error(env: Any) -> None:
    env.reset(seed=0)
    before = env.unwrapped.get_state().clone()
    for bad in (np.nan, np.inf):
        with pytest.raises(ValueError, match="finite"):
            env.step(moves(env, 1)[0] * bad)
    assert torch.equal(env.unwrapped.get_state(), before)


def test_a_scene_built_anew_holds_the_same_episode(env: Any) -> None:
    observation, info = env.reset(seed=4)
    anew, info_anew = env.reset(seed=4, options={"reconfigure": True})
    assert bool(info_anew.pop("reconfigure")) and not bool(info.pop("reconfigure"))
    assert_equal(anew, observation)
    assert_equal(info_anew, info)
    assert_equal(env.step(moves(env, 1)[0])[0].shape, torch.Size(observation.shape))


def test_the_only_environment_can_be_reset_by_its_index(env: Any) -> None:
    expected, _ = env.reset(seed=6)
    env.step(moves(env, 1)[0])
    for index in (torch.tensor([0]), np.array([0]), [0]):
        observation, info = env.reset(seed=6, options={"env_idx": index})
        assert torch.equal(observation, expected) and int(info["elapsed_steps"]) == 0


def test_episodes_are_cut_off_at_the_tasks_length(env: Any) -> None:
    steps, move = MAX_STEPS[env.unwrapped.spec.id], np.zeros_like(moves(env, 1)[0])
    env.reset(seed=0)
    for count in range(1, steps + 1):
        _, _, terminated, truncated, _ = env.step(move)
        assert bool(truncated) == (count == steps)
        if bool(terminated):
            break


@pytest.mark.parametrize(
    "env_id",
    [SPARSE, *(pytest.param(env_id, marks=pytest.mark.slow) for env_id in (GUIDED, GENERAL, ROW))],
)
def test_every_control_mode_plays_every_task(env_id: str) -> None:
    for mode in Iiwa14D435.CONTROL_MODES:
        env = make(env_id, control_mode=mode)
        env.action_space.seed(0)
        env.reset(seed=0)
        for _ in range(3):
            observation, reward, *_ = env.step(env.action_space.sample())
            assert env.observation_space.contains(observation.numpy()) and bool(reward.isfinite().all()), mode
        assert env.unwrapped.control_mode == mode
        env.close()


# ---------------------------------------------------------------- pictures


@pytest.mark.render
@pytest.mark.parametrize(
    "env_id", [SPARSE, GENERAL, *(pytest.param(i, marks=pytest.mark.slow) for i in (GUIDED, ROW))]
)
def test_all_pictures_and_the_state_come_in_one_observation(env_id: str) -> None:
    env = make_drawn(env_id, obs_mode="+".join(("state", *TEXTURES)))
    base = env.unwrapped
    observation, _ = env.reset(seed=1)
    for move in (None, moves(env, 1)[0]):
        if move is not None:
            observation, *_ = env.step(move)
        assert env.observation_space.contains(as_numpy(observation))
        pictures = observation["sensor_data"]["d435"]
        assert {k: (tuple(v.shape[1:]), v.dtype) for k, v in pictures.items()} == TEXTURES
        # A picture's z coordinates are its depths, seen from behind the camera.
        torch.testing.assert_close(-pictures["position"][..., 2:], pictures["depth"], atol=1, rtol=0)
        T_cam_world = observation["sensor_param"]["d435"]["extrinsic_cv"][0].double()
        wrist = flange_to_camera(forward_kinematics(base.agent.robot.get_qpos().double()))[0]
        torch.testing.assert_close(-T_cam_world[:, :3].T @ T_cam_world[:, 3], wrist[:3, 3], atol=1e-5, rtol=0)
    env.close()


@pytest.mark.render
@pytest.mark.parametrize("env_id", [SPARSE, pytest.param(ROW, marks=pytest.mark.slow)])
def test_a_cloud_of_points_is_what_the_camera_sees_in_the_world(env_id: str) -> None:
    env = make_drawn(env_id, obs_mode="pointcloud")
    observation, _ = env.reset(seed=1)
    assert env.observation_space.contains(as_numpy(observation))
    cloud = observation["pointcloud"]
    assert cloud["xyzw"].shape == (1, 30 * 40, 4) and cloud["rgb"].shape == (1, 30 * 40, 3)
    camera = flange_to_camera(forward_kinematics(env.unwrapped.agent.robot.get_qpos().double()))[0]
    finite = cloud["xyzw"][0, :, 3] == 1
    depths = (cloud["xyzw"][0, finite, :3].double() - camera[:3, 3]).norm(dim=-1)
    assert int(finite.sum()) > 600 and 0.05 < float(depths.min()) < 1.5 and float(depths.max()) < 15
    classes = {int(i) for i in cloud["segmentation"].unique()}
    assert len(classes & set(env.unwrapped.semantic_classes())) >= 2
    env.close()


@pytest.mark.render
def test_a_robot_with_two_cameras_observes_with_both() -> None:
    env = make_drawn(SPARSE, robot_uids="iiwa14_d435_raw_depth", obs_mode="depth")
    observation, _ = env.reset(seed=1)
    assert set(observation["sensor_data"]) == {"d435", "d435_depth"}
    assert env.observation_space.contains(as_numpy(observation))
    near, far = (observation["sensor_data"][name]["depth"] for name in ("d435", "d435_depth"))
    assert near.shape == far.shape and not torch.equal(near, far)
    env.close()


# ---------------------------------------------------------------- wrappers


@pytest.mark.parametrize("env_id", TASK_IDS)
def test_maniskills_wrapper_for_one_environment_satisfies_gymnasiums_checks(
    env_id: str, recwarn: pytest.WarningsRecorder
) -> None:
    env: Any = CPUGymWrapper(make(env_id), record_metrics=True)
    check_env(env, skip_render_check=True, skip_close_check=True)
    said = [str(w.message) for w in recwarn if "gymnasium" in str(w.filename)]
    # Observations have no bounds, and what is checked is a wrapper.
    assert all("infinity" in text or "unwrapped version" in text for text in said), said
    observation, _ = env.reset(seed=3)
    assert isinstance(observation, np.ndarray) and env.observation_space.contains(observation)
    rewards, successes = [], []
    for move in moves(env, 4):
        _, reward, terminated, truncated, info = env.step(move)
        assert isinstance(reward, float) and isinstance(terminated, bool) and isinstance(truncated, bool)
        rewards.append(reward)
        successes.append(bool(info["success"]))
        assert info["episode"]["return"] == pytest.approx(sum(rewards), abs=1e-5)
        assert bool(info["episode"]["success_once"]) == any(successes)
        assert info["episode"]["episode_len"] == len(rewards)
        if terminated or truncated:
            break
    env.close()


def test_gymnasiums_vector_of_wrapped_environments_is_the_environments() -> None:
    def single() -> Any:
        return CPUGymWrapper(make(SPARSE, plant={"seed": "train", "pool": 2}))

    env: Any = SyncVectorEnv([single, single], autoreset_mode=AutoresetMode.SAME_STEP)
    alone = [single(), single()]
    observations, _ = env.reset(seed=[5, 6])
    for i, one in enumerate(alone):
        np.testing.assert_array_equal(observations[i], one.reset(seed=5 + i)[0])
    for move in moves(alone[0], 2):
        observations, rewards, *_ = env.step(np.stack([move, -move]))
        for i, one in enumerate(alone):
            observation, reward, terminated, truncated, _ = one.step((1 - 2 * i) * move)
            assert rewards[i] == pytest.approx(reward)
            if not (terminated or truncated):
                np.testing.assert_array_equal(observations[i], observation)
    for one in (env, *alone):
        one.close()


@pytest.mark.parametrize(("env_id", "ignore"), [(GUIDED, True), (GENERAL, False)])
def test_maniskills_vector_wrapper_counts_episodes(env_id: str, ignore: bool) -> None:
    env: Any = ManiSkillVectorEnv(
        make(env_id), auto_reset=True, ignore_terminations=ignore, record_metrics=True
    )
    env.reset(seed=0)
    returned, successes, ends, steps = 0.0, [], 0, 0
    for move in moves(env, 2 * MAX_STEPS[env_id]):
        _, reward, terminated, truncated, info = env.step(torch.from_numpy(move)[None])
        steps += 1
        returned += float(reward)
        told = info["final_info"] if "final_info" in info else info
        successes.append(bool(told["success"]))
        assert not (ignore and bool(terminated))
        if bool(terminated | truncated):
            ends += 1
            episode = told["episode"]
            assert float(episode["return"]) == pytest.approx(returned, abs=1e-5)
            assert int(episode["episode_len"]) == steps <= MAX_STEPS[env_id]
            assert bool(episode["success_once"]) == any(successes)
            assert int(info["elapsed_steps"]) == 0
            assert steps == MAX_STEPS[env_id] or not ignore
            returned, successes, steps = 0.0, [], 0
    assert ends >= 2
    env.close()


@pytest.mark.parametrize("env_id", [SPARSE])
def test_stacked_and_repeated_steps(env_id: str) -> None:
    plain = make(env_id)
    stacked: Any = FrameStack(make(env_id), 2)
    repeated: Any = ActionRepeatWrapper(make(env_id), 2)
    first, _ = plain.reset(seed=8)
    frames, _ = stacked.reset(seed=8)
    assert torch.equal(frames, torch.stack([first, first], dim=1))
    repeated.reset(seed=8)
    move = moves(plain, 1)[0]
    second, reward, *_ = plain.step(move)
    assert torch.equal(stacked.step(move)[0], torch.stack([first, second], dim=1))
    third, more, *_ = plain.step(move)
    observation, total, *_ = repeated.step(move)
    assert torch.equal(observation, third)
    torch.testing.assert_close(total, reward + more)
    for env in (plain, stacked, repeated):
        env.close()


@pytest.mark.render
@pytest.mark.parametrize(
    "env_id", [SPARSE, *(pytest.param(i, marks=pytest.mark.slow) for i in (GENERAL, ROW))]
)
def test_flat_pictures_hold_what_the_nested_ones_do(env_id: str) -> None:
    nested = make_drawn(env_id, obs_mode="rgb+depth")
    flat: Any = ManiSkillVectorEnv(
        FlattenRGBDObservationWrapper(make_drawn(env_id, obs_mode="rgb+depth"), sep_depth=False)
    )
    expected, _ = nested.reset(seed=5)
    observation, _ = flat.reset(seed=5)
    assert flat.single_observation_space.contains(as_numpy({k: v[0] for k, v in observation.items()}))
    pictures = expected["sensor_data"]["d435"]
    assert observation["rgbd"].shape == (1, 30, 40, 4)
    assert int((observation["rgbd"][..., :3].int() - pictures["rgb"].int()).abs().max()) <= 1
    assert torch.equal(observation["rgbd"][..., 3:].int(), pictures["depth"].int())
    numbers = [*expected["agent"].values(), *expected["extra"].values()]
    assert torch.equal(observation["state"], torch.cat([n.flatten(1) for n in numbers], dim=-1))
    nested.close()
    flat.close()


BASELINES: dict[str, dict[str, Any]] = {
    "ppo": {"obs_mode": "state", "control_mode": "pd_joint_delta_pos", "reconfiguration_freq": None},
    "sac": {
        "obs_mode": "state",
        "human_render_camera_configs": {"shader_pack": "default"},
        "reconfiguration_freq": 1,
    },
    "tdmpc2": {"obs_mode": "rgb", "sensor_configs": {"width": 64, "height": 64}, "disable_env_checker": True},
    "diffusion_policy": {
        "obs_mode": "state",
        "reward_mode": "sparse",
        "control_mode": "pd_ee_delta_pos",
        "max_episode_steps": 7,
        "reconfiguration_freq": 1,
    },
}
"""How ManiSkill's baselines make environments, beside their id and `render_mode`."""


@pytest.mark.render
@pytest.mark.parametrize(
    "baseline",
    ["tdmpc2", *(pytest.param(b, marks=pytest.mark.slow) for b in ("ppo", "sac", "diffusion_policy"))],
)
def test_baselines_get_the_environments_that_they_ask_for(baseline: str) -> None:
    options = BASELINES[baseline]
    env: Any = gym.make(f"maniskill_tomato:{GENERAL}", render_mode="rgb_array", num_envs=1, **options)
    assert find_max_episode_steps_value(env) == options.get("max_episode_steps", MAX_STEPS[GENERAL])
    vector: Any = ManiSkillVectorEnv(env, ignore_terminations=True, record_metrics=True)
    vector.reset(seed=1)
    observation, *_ = vector.step(torch.from_numpy(moves(vector, 1)))
    assert vector.observation_space.contains(as_numpy(observation))
    assert np.asarray(env.render()).std() > 10
    vector.close()


@pytest.mark.render
def test_a_video_tells_the_info_of_each_step(tmp_path: Path) -> None:
    """Around `CPUGymWrapper`, whose rewards are plain numbers; NumPy 2.4 turns no array of one into a number."""
    frames = []
    for told in (True, False):
        made = gym.make(SPARSE, render_mode="rgb_array", human_render_camera_configs=FILM_SIZE)
        unbatched: Any = CPUGymWrapper(made)
        env: Any = RecordEpisode(
            unbatched,
            str(tmp_path / str(told)),
            save_trajectory=False,
            info_on_video=told,
            video_fps=5,
        )
        env.reset(seed=0)
        for move in moves(env, 2):
            env.step(move)
        env.close()
        (film,) = (tmp_path / str(told)).glob("*.mp4")
        video = cv2.VideoCapture(str(film))
        shown = [frame for ok, frame in iter(video.read, (False, None)) if ok]
        assert len(shown) == 3
        frames.append(np.stack(shown).astype(int))
    written = np.abs(frames[0] - frames[1]).mean(axis=(1, 2, 3))
    # The first picture is of the start, of which there is no info yet.
    assert written[0] < 1 < 3 < written[1:].min()
