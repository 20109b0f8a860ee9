"""Outside learners: the plain Gymnasium environment, automatic resets, time limits, and the examples themselves."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from maniskill_tomato.cli import main
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.learning.rl.gymnasium_env import (
    CENTRE,
    HALF_RANGE,
    Array,
    LearnableTask,
    make_gymnasium_env,
)
from maniskill_tomato.learning.rl.gymnasium_vec import make_gymnasium_vec
from maniskill_tomato.policies.registry import PolicyContext
from maniskill_tomato.tasks import THESIS_IDS
from maniskill_tomato.tasks.making import make_world

ROOT = Path(__file__).resolve().parent.parent
SCALE = (0.35, 0.35, 0.35, 0.6, 0.6, 0.6)


class Walk(gym.Env[Array, Array]):
    """x is the sum of the first actions, V_f is x; success (the end) above 0.85, out of time after `horizon` steps."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (9,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (6,), np.float32)

    def __init__(self, horizon: int = 3) -> None:
        self.horizon = horizon
        self.actions: list[Array] = []

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        super().reset(seed=seed)
        self.x, self.elapsed = 0.25, 0
        return self._observation(), self._info()

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        self.actions.append(action)
        self.x += float(action[0])
        self.elapsed += 1
        info = self._info()
        return self._observation(), 7.0, info["success"], self.elapsed >= self.horizon, info

    def _observation(self) -> Array:
        return np.array([self.x, self.elapsed, *[0.0] * 7], dtype=np.float32)

    def _info(self) -> dict[str, Any]:
        return {"visible_fraction": self.x, "success": self.x > 0.85, "reward_penalty": -0.25}


def load_example(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, ROOT / "examples" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # Dataclasses look their module up.
    spec.loader.exec_module(module)
    return module


def move(x: float) -> Array:
    return np.array([x, 0, 0, 0, 0, 0], dtype=np.float32)


def test_observations_are_normalised_actions_scaled_and_clipped() -> None:
    walk = Walk()
    task = LearnableTask(walk, action_scale=SCALE)
    observation, _ = task.reset(seed=0)
    np.testing.assert_allclose(observation[0], (0.25 - 0.2) / 0.5, rtol=1e-6)
    np.testing.assert_allclose(observation * HALF_RANGE + CENTRE, [0.25, *[0.0] * 8], atol=1e-6)
    task.step(np.array([2.0, -0.5, 0, 0, 0, -9.0], dtype=np.float32))
    np.testing.assert_allclose(walk.actions[0], [0.35, -0.175, 0, 0, 0, -0.6], rtol=1e-6)


def test_the_potential_reward_is_the_documented_sum_and_the_task_reward_is_kept() -> None:
    task = LearnableTask(Walk(), action_scale=(1.0,) * 6, gamma=0.5, step_cost=0.125)
    task.reset(seed=0)
    _, reward, terminated, truncated, info = task.step(move(0.25))
    # 0.5 * 0.5 - 0.25 for V_f, -0.25 for the pose, -0.125 for the step.
    assert (reward, terminated, truncated, info["task_reward"]) == (-0.375, False, False, 7.0)
    _, reward, terminated, _, _ = task.step(move(0.5))
    # 1 for success, and the potential is 0 after the end: 1 + 0 - 0.5 - 0.25 - 0.125.
    assert (reward, terminated) == (0.125, True)
    task.reset()
    assert float(task.step(move(0.0))[1]) == 0.5 * 0.25 - 0.25 - 0.25 - 0.125  # The start counts anew.


def test_the_task_reward_can_be_learnt_from() -> None:
    task = LearnableTask(Walk(), reward="task")
    task.reset(seed=0)
    assert task.step(move(0.1))[1] == 7.0


def test_wrong_options_are_refused() -> None:
    for scale in ((0.5,) * 5, (0.0,) * 6, (1.5,) * 6):
        with pytest.raises(InvalidInputError, match="action_scale must hold one value"):
            LearnableTask(Walk(), action_scale=scale)
    with pytest.raises(InvalidInputError, match="'task', 'potential'"):
        LearnableTask(Walk(), reward="other")  # type: ignore[arg-type] # pyright: ignore[reportArgumentType]
    with pytest.raises(InvalidInputError, match="the task must be one of .*got"):
        make_gymnasium_env("CartPole-v1")


@pytest.mark.parametrize("env_id", THESIS_IDS)
def test_the_real_tasks_pass_an_outside_check_and_run_out_of_time_without_terminating(
    env_id: str,
) -> None:
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    env = make_gymnasium_env(env_id)
    try:
        checker.check_env(env, warn=False)
        observation, info = env.reset(seed=1)
        np.testing.assert_array_equal(observation, env.reset(seed=1)[0])
        assert observation.dtype == np.float32 and observation.shape == (9,)
        ends: list[tuple[bool, bool]] = []
        while len(ends) < 30 and not any(ends[-1:] and ends[-1]):
            _, _, terminated, truncated, info = env.step(np.zeros(6, dtype=np.float32))
            ends.append((terminated, truncated))
        assert ends == [*[(False, False)] * 29, (False, True)]
        assert not info["success"]
    finally:
        env.close()


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP])
def test_both_ways_to_reset_give_the_transitions_of_a_plain_loop(mode: AutoresetMode) -> None:
    example = load_example("cleanrl_style")
    horizons = (3, 5)
    expected: list[list[tuple[float, float]]] = []
    for horizon in horizons:
        env = LearnableTask(Walk(horizon), reward="task", action_scale=(1.0,) * 6)
        ways: list[tuple[float, float]] = []
        done = True
        before: Any = None
        for _ in range(12):
            if done:
                before, _ = env.reset()
            after, _, terminated, truncated, _ = env.step(move(0.01))
            ways.append((float(before[1]), float(after[1])))
            before, done = after, terminated or truncated
        expected.append(ways)

    def maker(horizon: int) -> LearnableTask:
        return LearnableTask(Walk(horizon), reward="task", action_scale=(1.0,) * 6)

    envs = SyncVectorEnv([lambda h=h: maker(h) for h in horizons], autoreset_mode=mode)  # type: ignore[misc]
    observations, _ = envs.reset(seed=0)
    done_before = np.zeros(2, dtype=np.bool_)
    found: list[list[tuple[float, float]]] = [[], []]
    while min(len(ways) for ways in found) < 12:
        following, _, terminations, truncations, infos = envs.step(np.stack([move(0.01)] * 2))
        real, reached = example.learnable_steps(following, infos, done_before, mode)
        for row in np.flatnonzero(real):
            found[row].append((float(observations[row, 1]), float(reached[row, 1])))
        observations, done_before = following, terminations | truncations
    assert [ways[:12] for ways in found] == expected


def test_stable_baselines_bootstraps_an_episode_that_ran_out_of_time_and_no_other() -> None:
    pytest.importorskip("stable_baselines3")
    example = load_example("sb3_td3")
    task = LearnableTask(Walk(horizon=3), action_scale=(0.5,) * 6)
    arguments = example.Args(learning_starts=1000)
    model = example.make_model(task, arguments)
    model.learn(200)
    buffer = model.replay_buffer
    ends, timeouts = buffer.dones[:200, 0] == 1.0, buffer.timeouts[:200, 0] == 1.0
    # The buffer keeps normalised observations; the second entry counts steps, the first is x, V_f.
    reached = buffer.next_observations[:200, 0] * HALF_RANGE + CENTRE
    solved = reached[:, 0] > 0.85
    np.testing.assert_array_equal(ends, solved | (reached[:, 1] > 2.5))
    np.testing.assert_array_equal(timeouts, ends & ~solved)
    assert timeouts.any() and (ends & ~timeouts).any()


@pytest.mark.parametrize("reward", ["task", "potential"])
@pytest.mark.parametrize("mode", list(AutoresetMode)[:2])
def test_many_prepared_environments_are_those_that_are_prepared_alone(
    mode: AutoresetMode, reward: Literal["task", "potential"]
) -> None:
    options: dict[str, Any] = {"plant": {"seed": "train", "pool": 2}, "reward": reward, "gamma": 0.8}
    envs = make_gymnasium_vec(THESIS_IDS[1], 3, autoreset_mode=mode, max_episode_steps=3, **options)

    def alone() -> gym.Env[Any, Any]:
        return gym.wrappers.TimeLimit(make_gymnasium_env(THESIS_IDS[1], **options), 3)

    reference: Any = SyncVectorEnv([alone] * 3, autoreset_mode=mode)
    assert envs.action_space == reference.action_space
    np.testing.assert_allclose(envs.reset(seed=2)[0], reference.reset(seed=2)[0], atol=1e-4)
    rng, ends = np.random.default_rng(0), 0
    for _ in range(12):
        actions = 0.7 * rng.standard_normal((3, 6)).astype(np.float32)
        found, expected = envs.step(actions), reference.step(actions)
        for one, two in zip(found[:4], expected[:4], strict=True):
            np.testing.assert_allclose(one, two, atol=1e-4)
        np.testing.assert_allclose(found[4]["task_reward"], expected[4]["task_reward"], atol=1e-4)
        for i in np.flatnonzero(expected[4].get("_final_obs", ())):
            ends += 1
            np.testing.assert_allclose(found[4]["final_obs"][i], expected[4]["final_obs"][i], atol=1e-4)
            told, wanted = found[4]["final_info"], expected[4]["final_info"]
            np.testing.assert_allclose(told["task_reward"][i], wanted["task_reward"][i], atol=1e-4)
    assert (ends > 5) == (mode == AutoresetMode.SAME_STEP)
    reference.close()


def test_stable_baselines_is_told_where_an_episode_ended_and_why() -> None:
    pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.vec_env import VecMonitor

    from maniskill_tomato.learning.rl.sb3_vec import GymnasiumVecEnv

    options: dict[str, Any] = {"max_episode_steps": 3, "autoreset_mode": "SameStep"}
    own = make_gymnasium_vec(THESIS_IDS[1], 4, **options)
    theirs: Any = VecMonitor(GymnasiumVecEnv(make_gymnasium_vec(THESIS_IDS[1], 4, **options)))
    theirs.seed(7)
    np.testing.assert_array_equal(theirs.reset(), own.reset(seed=7)[0])
    rng, kinds = np.random.default_rng(1), set()
    for _ in range(9):
        actions = 0.7 * rng.standard_normal((4, 6)).astype(np.float32)
        observations, rewards, dones, infos = theirs.step(actions)
        expected, rewards_own, terminated, truncated, told = own.step(actions)
        np.testing.assert_array_equal(observations, expected)
        np.testing.assert_array_equal(rewards, rewards_own)
        np.testing.assert_array_equal(dones, terminated | truncated)
        for i, info in enumerate(infos):
            assert bool(info) == dones[i]
            if dones[i]:
                np.testing.assert_array_equal(info["terminal_observation"], told["final_obs"][i])
                assert info["is_success"] == told["final_info"]["success"][i]
                assert info["TimeLimit.truncated"] == (truncated[i] and not terminated[i])
                assert info["episode"]["l"] <= 3
                kinds.add(info["TimeLimit.truncated"])
    assert kinds == {True, False}
    assert (
        theirs.get_attr("max_steps", [1, 2]) == [3, 3] and theirs.env_is_wrapped(gym.Wrapper) == [False] * 4
    )
    with pytest.raises(InvalidInputError, match="autoreset_mode='SameStep'"):
        GymnasiumVecEnv(make_gymnasium_vec(THESIS_IDS[1], 2))


def test_a_vector_of_tensors_is_not_prepared_for_learners_of_arrays() -> None:
    with pytest.raises(InvalidInputError, match="arrays='numpy'"):
        make_gymnasium_vec(THESIS_IDS[0], 2, arrays="torch")
    with pytest.raises(InvalidInputError, match="the task must be one of .*got"):
        make_gymnasium_vec("CartPole-v1", 2)


@pytest.mark.parametrize(
    "arguments",
    [
        ("sb3_td3.py", "--total-timesteps", "300", "--learning-starts", "150"),
        ("sb3_ppo.py", "--total-timesteps", "400", "--n-steps", "50", "--num-envs", "4"),
        ("cleanrl_style.py", "--total-timesteps", "400", "--learning-starts", "256", "--num-envs", "8"),
        pytest.param(
            (
                "cleanrl_style.py",
                *("--total-timesteps", "400", "--learning-starts", "256"),
                *("--autoreset-mode", "NextStep", "--env-id", "TomatoViewpoint-v1"),
            ),
            marks=pytest.mark.slow,
        ),
    ],
    ids=lambda arguments: arguments[0],
)
def test_an_example_trains_and_prints_its_success(arguments: tuple[str, ...]) -> None:
    if arguments[0].startswith("sb3"):
        pytest.importorskip("stable_baselines3")
    script, *options = arguments
    done = subprocess.run(
        [sys.executable, f"examples/{script}", *options, "--eval-episodes", "2"],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    assert " of 2 episodes, " in done.stdout
    assert "success" in done.stdout.splitlines()[-1]


def test_ap_gym_takes_a_prediction_of_what_is_visible_with_every_move() -> None:
    pytest.importorskip("ap_gym", reason="ap_gym is not installed")
    env = load_example("ap_gym_env").VisibleFraction(image_size=(36, 28))
    plain = make_gymnasium_env("TomatoViewpoint-v1", obs_mode="depth+segmentation", image_size=(36, 28))
    check_env(env, skip_render_check=True, skip_close_check=True)
    seen, info = env.reset(seed=3)
    expected, told = plain.reset(seed=3)
    for guess in (0.0, 0.5, 1.0):
        assert {name: part.tolist() for name, part in seen.items()} == {
            n: p.tolist() for n, p in expected.items()
        }
        visible = told["visible_fraction"]
        step = np.full(3, 0.3 - 0.6 * guess, np.float32)
        seen, reward, terminated, truncated, info = env.step(
            {"action": step, "prediction": np.full(1, guess, np.float32)}
        )
        expected, earned, *ended, told = plain.step(step)
        # Its loss is the squared error by the variance of a uniform target.
        assert reward == pytest.approx(earned - 12.0 * (guess - visible) ** 2, abs=1e-5)
        assert info["prediction"]["target"][0] == pytest.approx(visible)
        assert [terminated, truncated] == ended
    env.close()
    plain.close()


def test_other_criteria_of_the_greedy_search_prefer_what_is_not_known_yet() -> None:
    """Round the target, of views that the arm can take: what a look tells of is worth less afterwards."""
    example = load_example("greedy_criteria")
    world = make_world("TomatoViewpoint-v1", 1, plant={"seed": 3})
    world.reset(0)
    belief = world.belief
    views = belief.lattice.positions(belief.target_position)
    nearest = (views - belief.camera_position[:, None]).norm(dim=-1).argmin(dim=1)
    far = (views - belief.camera_position[:, None]).norm(dim=-1) > 0.3
    for name in ("coverage", "entropy"):
        search = getattr(example, name)(PolicyContext())
        gain = search.gain(belief, views)
        assert gain.shape == views.shape[:2]
        assert not bool(gain[~belief.reachable].any())
        told = gain[belief.reachable]
        assert bool((told >= 0).all()) and 0.0 < float(told.max()) <= 2 * example.STEPS
        # The camera stands near one of them and has looked from there.
        open_views = gain[belief.reachable & far]
        assert float(gain[0, nearest]) < float(open_views.mean())


def test_the_greedy_search_with_other_criteria_runs_in_the_benchmark(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(ROOT / "examples")
    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    policies = "greedy_criteria:coverage,greedy_criteria:entropy"
    main(
        ["benchmark", "--policies", policies, "--episodes", "2", "--jobs", "1", "--no-pictures"]
        + ["--out", str(tmp_path)]
    )
    text = capsys.readouterr().out
    assert "| greedy_criteria:coverage |" in text and "| greedy_criteria:entropy |" in text
