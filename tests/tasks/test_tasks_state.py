"""Seeds, saved states and ManiSkill's wrappers around the tasks, without a renderer."""

import multiprocessing
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import numpy as np
import pytest
import torch

import maniskill_tomato  # noqa: F401
from maniskill_tomato.errors import InvalidInputError

GUIDED = "TomatoViewpointGuided-v1"
SPARSE = "TomatoViewpointSparse-v1"


def make(env_id: str = GUIDED, **kwargs: Any) -> Any:
    options: dict[str, Any] = {
        "num_envs": 1,
        "obs_mode": "state",
        "reward_mode": "dense",
        "render_backend": "none",
    }
    return gym.make(env_id, **(options | kwargs))


def rollout(env: Any, seed: int, steps: int = 12) -> list[torch.Tensor]:
    """Observations, rewards and V_f of a random episode."""
    rng = np.random.default_rng(seed)
    obs, info = env.reset(seed=seed)
    trace = [obs, info["visible_fraction"]]
    for _ in range(steps):
        obs, reward, *_, info = env.step(rng.uniform(-0.15, 0.15, 6).astype(np.float32))
        trace += [obs, reward, info["visible_fraction"], info["target_id"]]
    return trace


@pytest.mark.parametrize("env_id", [GUIDED, SPARSE])
def test_one_seed_gives_one_episode_in_two_environments(env_id: str) -> None:
    first, second = make(env_id), make(env_id)
    rollout(second, 99)
    for seed in range(3):
        for a, b in zip(rollout(first, seed), rollout(second, seed), strict=True):
            assert torch.equal(a, b)
    first.close()
    second.close()


def test_different_seeds_give_different_starts() -> None:
    env = make()
    assert not torch.equal(env.reset(seed=0)[0], env.reset(seed=1)[0])
    env.close()


@pytest.mark.parametrize("env_id", [GUIDED, SPARSE])
@pytest.mark.parametrize("flat", [True, False])
def test_restored_state_continues_exactly(env_id: str, flat: bool) -> None:
    env = make(env_id, plant_pose_noise=(0.02, 0.05, 0.2))
    base: Any = env.unwrapped
    rng = np.random.default_rng(1)
    env.reset(seed=5)
    for _ in range(3):
        env.step(rng.uniform(-0.1, 0.1, 6).astype(np.float32))
    saved = base.get_state() if flat else base.get_state_dict()
    actions = rng.uniform(-0.1, 0.1, (5, 6)).astype(np.float32)
    expected = [env.step(a) for a in actions]
    env.reset(seed=17)
    (base.set_state if flat else base.set_state_dict)(saved)
    restored = base.get_state()
    torch.testing.assert_close(restored, saved if flat else restored, atol=0, rtol=0)
    for action, (obs, reward, terminated, _, info) in zip(actions, expected, strict=True):
        obs_2, reward_2, terminated_2, _, info_2 = env.step(action)
        assert (
            torch.equal(obs, obs_2)
            and torch.equal(reward, reward_2)
            and torch.equal(terminated, terminated_2)
        )
        assert torch.equal(info["visible_fraction"], info_2["visible_fraction"])
    env.close()


def test_state_of_another_plant_is_refused_before_anything_changes() -> None:
    env, other = make(plant={"seed": 1}), make(plant={"seed": 2})
    env.reset(seed=0)
    other.reset(seed=1)
    base: Any = env.unwrapped
    before = base.get_state().clone()
    with pytest.raises(InvalidInputError, match="seed"):
        base.set_state(other.unwrapped.get_state())
    assert torch.equal(base.get_state(), before)
    with pytest.raises(InvalidInputError, match="shape"):
        base.set_state(before[:, :-1])
    with pytest.raises(InvalidInputError, match="finite"):
        base.set_state(before * torch.nan)
    incomplete = base.get_state_dict()
    del incomplete["task"]["viewpoint"]
    with pytest.raises(InvalidInputError, match="task/viewpoint"):
        base.set_state_dict(incomplete)
    assert torch.equal(base.get_state(), before)
    env.close()
    other.close()


def test_vector_wrapper_resets_by_itself_and_hands_out_final_observations() -> None:
    from mani_skill.vector.wrappers.gymnasium import ManiSkillVectorEnv

    env: Any = ManiSkillVectorEnv(make(), auto_reset=True, ignore_terminations=False, record_metrics=True)
    obs, _ = env.reset(seed=0)
    ends = 0
    for _ in range(95):
        previous = obs
        obs, _, terminated, truncated, info = env.step(torch.zeros(1, 6))
        if bool(terminated | truncated):
            ends += 1
            assert "final_info" in info and "episode" in info["final_info"]
            torch.testing.assert_close(info["final_observation"], previous)
            assert not torch.equal(obs, previous)
    assert ends >= 3
    env.close()


def test_async_vector_env_runs_one_environment_per_process() -> None:
    def cpu_env() -> Any:
        # A worker process knows nothing of this file, so everything is imported here.
        import gymnasium
        from mani_skill.utils.wrappers.gymnasium import CPUGymWrapper

        env_id = "maniskill_tomato.tasks:TomatoViewpointGuided-v1"
        return CPUGymWrapper(gymnasium.make(env_id, num_envs=1, obs_mode="state", render_backend="none"))

    # Both processes begin where one has loaded the simulator.
    multiprocessing.get_context("forkserver").set_forkserver_preload(["mani_skill.envs"])
    env = gym.vector.AsyncVectorEnv([cpu_env, cpu_env], context="forkserver")
    try:
        obs, _ = env.reset(seed=[0, 1])
        assert obs.shape == (2, 9)
        alone = make()
        torch.testing.assert_close(torch.as_tensor(obs[1:]), alone.reset(seed=1)[0], atol=1e-6, rtol=0)
        alone.close()
        obs, reward, terminated, truncated, _ = env.step(np.zeros((2, 6), dtype=np.float32))
        assert reward.shape == terminated.shape == truncated.shape == (2,)
    finally:
        env.close()


def test_stable_baselines3_learns_on_the_task_through_gymnasium() -> None:
    stable_baselines3 = pytest.importorskip("stable_baselines3")
    from mani_skill.utils.wrappers.gymnasium import CPUGymWrapper

    env = CPUGymWrapper(make())
    model = stable_baselines3.TD3(
        "MlpPolicy",
        env,
        learning_starts=50,
        batch_size=32,
        seed=0,
        device="cpu",
        policy_kwargs={"net_arch": [32, 32]},
    )
    model.learn(120)
    action, _ = model.predict(env.reset(seed=0)[0], deterministic=True)
    assert action.shape == (6,) and np.abs(action).max() <= 1.0
    env.close()


def test_recorded_trajectory_replays_to_the_same_states(tmp_path: Path) -> None:
    from mani_skill.trajectory.utils import index_dict
    from mani_skill.utils.wrappers.record import RecordEpisode

    env = RecordEpisode(
        make(SPARSE), str(tmp_path), trajectory_name="run", save_video=False, save_on_reset=True
    )
    rng = np.random.default_rng(0)
    observations = []
    for seed in (3, 4):
        env.reset(seed=seed)
        for _ in range(5):
            obs, *_ = env.step(rng.uniform(-0.05, 0.05, 6).astype(np.float32))
            observations.append(obs)
    env.close()
    replayed = make(SPARSE)
    base: Any = replayed.unwrapped
    seen = []
    file: Any
    with h5py.File(tmp_path / "run.h5") as file:
        for episode, seed in enumerate((3, 4)):
            trajectory = file[f"traj_{episode}"]
            states = trajectory["env_states"]
            assert {"articulations", "task"} <= set(states)
            replayed.reset(seed=seed)
            for k, action in enumerate(trajectory["actions"]):
                obs, *_ = replayed.step(action)
                seen.append(obs)
                stored = _to_dict(states, k + 1, index_dict)
                here = base.get_state_dict()
                for key, value in stored["task"].items():
                    torch.testing.assert_close(here["task"][key][0], torch.as_tensor(value), atol=0, rtol=0)
                base.set_state_dict(
                    {g: {n: torch.as_tensor(v)[None] for n, v in d.items()} for g, d in stored.items()}
                )
                torch.testing.assert_close(base.get_obs(), obs, atol=0, rtol=0)
    for a, b in zip(observations, seen, strict=True):
        torch.testing.assert_close(a, b, atol=0, rtol=0)
    replayed.close()


def _to_dict(states: Any, index: int, index_dict: Any) -> dict[str, dict[str, Any]]:
    return {
        group: {name: values[index] for name, values in members.items()} for group, members in states.items()
    }
