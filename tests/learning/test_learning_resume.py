"""Runs that are stopped in any way go on as if they never had been: a toy task in this process, the real one in
processes that are killed."""

import dataclasses
import importlib
import itertools
import math
import multiprocessing
import os
import random
import resource
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from torch import Tensor

from maniskill_tomato import cli
from maniskill_tomato.errors import CheckpointError, InvalidInputError, TrainingDivergedError
from maniskill_tomato.files import write_tensors
from maniskill_tomato.folder_lock import only_writer
from maniskill_tomato.learning.rl.env_state import env_state, set_env_state
from maniskill_tomato.learning.rl.envs import make_learner_env
from maniskill_tomato.learning.rl.presets import TrainConfig, get_preset
from maniskill_tomato.learning.rl.run_folder import checkpoints, clear_run
from maniskill_tomato.learning.rl.trainer import Trainer, TrainResult
from maniskill_tomato.policies.trained_actor import load_checkpoint

GUIDED = "TomatoViewpointGuided-v1"
HORIZON = 12
STEPS = 240


class Crash(BaseException):
    """Nobody catches this, as nobody catches a power failure."""


class Walk:
    """A point is to come near a target; nine observed values and six actions, as the real tasks. It draws from
    torch's, NumPy's and Python's global generators and from one of its own."""

    single_observation_space: gym.Space[Any] = gym.spaces.Box(-np.inf, np.inf, (9,), np.float32)
    single_action_space: gym.Space[Any] = gym.spaces.Box(-1.0, 1.0, (6,), np.float32)

    def __init__(self, num_envs: int = 1, before_step: Callable[[int], None] = lambda step: None) -> None:
        self.num_envs = num_envs
        self.broken_reward = False
        self._before_step = before_step
        self._step = 0
        self._generator = torch.Generator()
        self._place = torch.zeros(num_envs, 9)
        self._elapsed = torch.zeros(num_envs, dtype=torch.long)

    def reset(self, *, seed: int | list[int] | None = None) -> tuple[Tensor, dict[str, Any]]:
        assert seed is not None
        self._generator.manual_seed(seed if isinstance(seed, int) else seed[0])
        self._begin(torch.ones(self.num_envs, dtype=torch.bool))
        return self._place.clone(), self._info()

    def step(self, actions: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        self._before_step(self._step)
        self._step += 1
        wind = 0.01 * (random.random() + np.random.standard_normal()) + 0.01 * torch.randn(self.num_envs, 6)
        self._place[:, :6] = (self._place[:, :6] + actions + wind).clamp(-1.0, 1.0)
        self._elapsed += 1
        info = self._info()
        terminated = info["success"]
        truncated = (self._elapsed >= HORIZON) & ~terminated
        reward = terminated.float() + info["visible_fraction"]
        if self.broken_reward:
            reward = reward * math.nan
        done = terminated | truncated
        if bool(done.any()):
            final = self._place.clone()
            self._begin(done)
            info = self._info() | {"final_obs": final, "final_info": info}
        return self._place.clone(), reward, terminated, truncated, info

    def close(self) -> None:
        pass

    def get_run_state(self) -> dict[str, Any]:
        return {
            "step": self._step,
            "place": self._place.clone(),
            "elapsed": self._elapsed.clone(),
            "generator": self._generator.get_state(),
        }

    def set_run_state(self, state: dict[str, Any]) -> None:
        self._step = state["step"]
        self._place, self._elapsed = state["place"].clone(), state["elapsed"].clone()
        self._generator.set_state(state["generator"])

    def _begin(self, rows: Tensor) -> None:
        drawn = torch.rand(self.num_envs, 9, generator=self._generator) - 0.5
        self._place[rows] = drawn[rows]
        self._elapsed[rows] = 0

    def _info(self) -> dict[str, Any]:
        distance = (self._place[:, :3] - self._place[:, 6:]).norm(dim=-1)
        visible = torch.exp(-distance)
        others = self._place[:, None, 6:] + torch.tensor([[0.3, 0.0, 0.0], [0.0, -0.2, 0.1]])
        seen = torch.exp(-(self._place[:, None, :3] - others).norm(dim=-1))
        return {
            "visible_fraction": visible,
            "success": visible > 0.8,
            "fail": torch.zeros(self.num_envs, dtype=torch.bool),
            "reward_penalty": torch.zeros(self.num_envs),
            "other_visible_fraction": seen,
            "other_success": seen > 0.8,
            "other_reward": (seen > 0.8).float() + seen,
            "other_exists": torch.tensor([True, False]).expand(self.num_envs, 2).clone(),
            "other_position": others,
        }


def config(preset: str = "td3", **changes: Any) -> TrainConfig:
    """A preset, shrunk to a second."""
    small: dict[str, Any] = {
        "total_episodes": None,
        "total_timesteps": STEPS,
        "learning_starts": 40,
        "batch_size": 16,
        "buffer_size": 100,
        "exploration_steps": 200,
        "actor_hidden": (16, 16),
        "critic_hidden": (16, 16),
        "num_envs": 1,
        "checkpoint_every": 50,
        "checkpoint_seconds": None,
    }
    return dataclasses.replace(get_preset(preset), **{**small, **changes})


def train(
    run_dir: Path, settings: TrainConfig | None = None, env: Walk | None = None, resume: bool = False
) -> TrainResult:
    settings = settings or config()
    env = env or Walk(settings.num_envs)
    return Trainer(env, "Walk-v0", settings, run_dir, 3, show_progress=False, resume=resume).run()


def crash_at(step: int) -> Callable[[int], None]:
    def before_step(present: int) -> None:
        if present == step:
            raise Crash

    return before_step


def flat(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """The leaves of nested dictionaries and lists, with their paths."""
    if isinstance(value, dict | list | tuple):
        for key, part in value.items() if isinstance(value, dict) else enumerate(value):
            yield from flat(part, f"{name}/{key}")
    else:
        yield name, value


def scalars(run_dir: Path) -> dict[str, list[tuple[int, float]]]:
    """TensorBoard's curves without the speed, which is measured."""
    module = importlib.import_module("tensorboard.backend.event_processing.event_accumulator")
    curves: dict[str, list[tuple[int, float]]] = {}
    for path in (run_dir / "tensorboard").iterdir():
        events = module.EventAccumulator(str(path))
        events.Reload()
        for name in set(events.Tags()["scalars"]) - {"charts/SPS"}:
            curves.setdefault(name, []).extend((e.step, e.value) for e in events.Scalars(name))
    return {name: sorted(points) for name, points in curves.items()}


def assert_same_run(one: Path, other: Path) -> None:
    """Weights, optimisers, replay, random states, environment, counters, history: all exactly equal."""
    states = []
    for run_dir in (one, other):
        state = dict(flat(load_checkpoint(checkpoints(run_dir)[-1])))
        states.append({k: v for k, v in state.items() if k != "/counters/seconds" and "event_files" not in k})
    first, second = states
    assert first.keys() == second.keys()
    assert any("critic_optimizer/state" in k for k in first) and "/run/replay/rewards" in first
    for name, value in first.items():
        if isinstance(value, Tensor):
            assert torch.equal(value, second[name]), name
        else:
            assert value == second[name], name
    assert (one / "episodes.csv").read_bytes() == (other / "episodes.csv").read_bytes()
    with np.load(one / "history.npz") as a, np.load(other / "history.npz") as b:
        assert set(a.files) == set(b.files)
        for name in a.files:
            np.testing.assert_array_equal(a[name], b[name])
    assert scalars(one) == scalars(other)
    policies = [load_checkpoint(run_dir / "policy.pt")["actor"] for run_dir in (one, other)]
    assert all(torch.equal(policies[0][name], policies[1][name]) for name in policies[0])


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the toy task that nothing happened to."""
    run_dir = tmp_path_factory.mktemp("unbroken") / "run"
    train(run_dir)
    return run_dir


EVERYTHING: dict[str, Any] = {
    "critic": "categorical",
    "normalize_observations": "running",
    "hindsight_targets": 2,
    "aux_distance_weight": 0.1,
    "aux_visibility_weight": 0.1,
    "exploration_noise_per_env": True,
}
"""Every option that keeps a state of its own."""


@pytest.mark.parametrize(
    ("preset", "num_envs", "options"),
    [
        ("td3", 1, {}),
        ("td3", 3, {}),
        ("thesis-guided", 1, {}),
        ("thesis-sparse", 2, {}),
        ("td3", 2, EVERYTHING),
        ("fast-td3", 3, {"updates_per_step": 0.5}),
    ],
)
def test_a_run_that_crashed_twice_ends_as_the_unbroken_one(
    tmp_path: Path, preset: str, num_envs: int, options: dict[str, Any]
) -> None:
    settings = config(preset, num_envs=num_envs, checkpoint_every=18, **options)
    train(tmp_path / "a", settings)
    for steps, resume in ((23, False), (STEPS // num_envs - 5, True)):
        with pytest.raises(Crash):
            train(tmp_path / "b", settings, Walk(num_envs, crash_at(steps)), resume)
    result = train(tmp_path / "b", settings, resume=True)
    assert (result.steps, result.stop_reason) == (STEPS, "finished")
    assert_same_run(tmp_path / "a", tmp_path / "b")


def test_a_run_that_crashed_before_its_first_checkpoint_begins_again(tmp_path: Path, unbroken: Path) -> None:
    with pytest.raises(Crash):
        train(tmp_path / "run", env=Walk(before_step=crash_at(30)))
    train(tmp_path / "run", resume=True)
    assert_same_run(unbroken, tmp_path / "run")


def test_a_finished_run_can_be_made_longer(tmp_path: Path, unbroken: Path) -> None:
    train(tmp_path / "run", config(total_timesteps=101))
    train(tmp_path / "run", config(total_timesteps=STEPS), resume=True)
    first, second = (load_checkpoint(p / "policy.pt") for p in (unbroken, tmp_path / "run"))
    assert all(torch.equal(first["actor"][name], second["actor"][name]) for name in first["actor"])
    assert (tmp_path / "run/episodes.csv").read_bytes() == (unbroken / "episodes.csv").read_bytes()
    assert scalars(tmp_path / "run") == scalars(unbroken)


def test_training_time_adds_up_over_the_parts_of_a_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    moments = itertools.count(step=0.25)  # A clock of which every reading is a quarter of a second later.
    monkeypatch.setattr("maniskill_tomato.learning.rl.trainer.time.perf_counter", lambda: next(moments))
    first = train(tmp_path / "run", config(total_timesteps=100))
    second = train(tmp_path / "run", config(total_timesteps=101), resume=True)
    # One more step, between a dozen readings of the clock; the first part took a hundred steps.
    assert first.seconds < second.seconds < first.seconds + 5.0 < 2.0 * first.seconds
    budget = config(total_timesteps=None, max_minutes=0.5 * first.seconds / 60.0)
    third = train(tmp_path / "run", budget, resume=True)
    assert (third.stop_reason, third.steps) == ("time budget", 101)


@pytest.mark.parametrize(
    ("call", "times"), [*(("fsync", n) for n in range(8)), *(("replace", n) for n in range(1, 4))]
)
def test_a_crash_at_any_point_of_saving_costs_nothing_that_was_saved(
    tmp_path: Path, unbroken: Path, monkeypatch: pytest.MonkeyPatch, call: str, times: int
) -> None:
    remaining = times

    def fail(real: Callable[..., Any]) -> Callable[..., Any]:
        def or_crash(*arguments: Any) -> Any:
            nonlocal remaining
            remaining -= 1
            if remaining < 0:
                raise Crash
            return real(*arguments)

        return or_crash

    with monkeypatch.context() as patch:
        if call == "fsync":
            patch.setattr(os, "fsync", fail(os.fsync))
        else:
            patch.setattr(Path, "replace", fail(Path.replace))
        with pytest.raises(Crash):
            train(tmp_path / "run")
    resume = (tmp_path / "run/config.json").exists()
    train(tmp_path / "run", resume=resume)
    assert_same_run(unbroken, tmp_path / "run")
    assert not list((tmp_path / "run").rglob("*.tmp"))


def crashed(run_dir: Path) -> list[Path]:
    """A run that crashed after its checkpoints of steps 50, 100 and 150; returns these."""
    with pytest.raises(Crash):
        train(run_dir, env=Walk(before_step=crash_at(170)))
    paths = checkpoints(run_dir)
    assert [path.name for path in paths] == [f"step_{step:09d}.pt" for step in (50, 100, 150)]
    return paths


def flip_a_bit(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 16
    path.write_bytes(content)


@pytest.mark.parametrize(
    "damage",
    [
        lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
        lambda path: path.write_bytes(b""),
        lambda path: path.write_bytes(bytes(path.stat().st_size)),
        flip_a_bit,
    ],
    ids=["truncated", "empty", "zeros", "a flipped bit"],
)
def test_a_damaged_checkpoint_is_passed_over_for_the_one_before(
    tmp_path: Path, unbroken: Path, caplog: pytest.LogCaptureFixture, damage: Callable[[Path], Any]
) -> None:
    newest = crashed(tmp_path / "run")[-1]
    damage(newest)
    with caplog.at_level("INFO"):
        train(tmp_path / "run", resume=True)
    assert f"{newest} is not a readable checkpoint" in caplog.text
    assert "going back to the one before" in caplog.text and "goes on from step 100" in caplog.text
    assert_same_run(unbroken, tmp_path / "run")
    assert (newest.parent / f"damaged_{newest.name}").exists()
    clear_run(tmp_path / "run")
    assert not list((tmp_path / "run").rglob("*.pt"))


def test_when_all_checkpoints_are_damaged_the_run_is_not_begun_again_by_itself(tmp_path: Path) -> None:
    paths = crashed(tmp_path / "run")
    for path in paths:
        path.write_bytes(b"nothing")
    with pytest.raises(
        CheckpointError, match=r"all 3 checkpoints in .* are damaged; train again with --over"
    ):
        train(tmp_path / "run", resume=True)
    assert checkpoints(tmp_path / "run") == paths


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"env_id": "Other-v0"}, "a run on Other-v0, not on Walk-v0"),
        ({"package_version": "0.0.1"}, "written by version 0.0.1"),
        ({"format": 99}, "format 99.*upgrade"),
        ({"run": {"format": 99}}, "run state 3"),
        ({"run": None}, "run state 3"),
        ({"counters": {"seed": 8}}, "a run with seed 8, not 3"),
        ({"critics": {}}, "does not fit this run"),
    ],
)
def test_a_checkpoint_of_something_else_is_refused_and_left_alone(
    tmp_path: Path, change: dict[str, Any], message: str
) -> None:
    newest = crashed(tmp_path / "run")[-1]
    write_tensors(newest, {**load_checkpoint(newest), **change})
    before = newest.read_bytes()
    with pytest.raises(CheckpointError, match=message):
        train(tmp_path / "run", resume=True)
    assert newest.read_bytes() == before


def test_other_options_cannot_continue_a_run(tmp_path: Path) -> None:
    crashed(tmp_path / "run")
    with pytest.raises(CheckpointError, match=r"other options: gamma \(0.9, now 0.8\)"):
        train(tmp_path / "run", config(gamma=0.8), resume=True)


def test_an_environment_that_does_not_tell_its_state_cannot_be_continued(tmp_path: Path) -> None:
    newest = crashed(tmp_path / "run")[-1]
    data = load_checkpoint(newest)
    write_tensors(newest, {**data, "run": {**data["run"], "env": None}})
    with pytest.raises(CheckpointError, match="get_run_state and set_run_state"):
        train(tmp_path / "run", resume=True)


def test_a_folder_without_a_run_cannot_be_continued_and_one_with_a_run_not_begun(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="holds no run to continue"):
        train(tmp_path / "none", resume=True)
    crashed(tmp_path / "run")
    with pytest.raises(InvalidInputError, match="continue it with --resume"):
        train(tmp_path / "run")


def test_a_full_disk_keeps_the_last_checkpoint_and_the_run_goes_on_when_there_is_space(
    tmp_path: Path, unbroken: Path
) -> None:
    crashed(tmp_path / "other")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)

    def fill_the_disk(step: int) -> None:
        if step == 120:
            (size,) = (p.stat().st_size for p in checkpoints(tmp_path / "run")[-1:])
            resource.setrlimit(resource.RLIMIT_FSIZE, (size - 1, hard))

    try:
        with pytest.raises(CheckpointError, match=r"cannot write .*File too large.*--resume"):
            train(tmp_path / "run", env=Walk(before_step=fill_the_disk))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    kept = checkpoints(tmp_path / "run")
    assert [path.name for path in kept] == ["step_000000050.pt", "step_000000100.pt"]
    assert all(load_checkpoint(path) for path in kept)
    assert not list((tmp_path / "run").rglob("*.tmp"))
    train(tmp_path / "run", resume=True)
    assert_same_run(unbroken, tmp_path / "run")


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")  # of TensorBoard's writer
def test_a_disk_too_full_for_the_logs_is_told_in_words(tmp_path: Path) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)

    def fill_the_disk(step: int) -> None:
        if step == 120:
            resource.setrlimit(resource.RLIMIT_FSIZE, (10, hard))

    try:
        with pytest.raises(CheckpointError, match="File too large"):
            train(tmp_path / "run", env=Walk(before_step=fill_the_disk))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert checkpoints(tmp_path / "run")[-1].name == "step_000000100.pt"


def test_nothing_that_is_not_finite_reaches_a_checkpoint(tmp_path: Path) -> None:
    env = Walk()

    def break_reward(step: int) -> None:
        env.broken_reward = step == 149

    env._before_step = break_reward
    with pytest.raises(TrainingDivergedError, match=r"diverged at step 150: reward \[nan\]"):
        train(tmp_path / "run", config(reward="task"), env)
    newest = checkpoints(tmp_path / "run")[-1]
    assert newest.name == "step_000000100.pt"
    numbers = [v for _, v in flat(load_checkpoint(newest)) if isinstance(v, Tensor) and v.is_floating_point()]
    assert all(bool(v.isfinite().all()) for v in numbers)


def test_one_process_at_a_time_trains_in_a_folder(tmp_path: Path) -> None:
    crashed(tmp_path / "run")
    with only_writer(tmp_path / "run", "trains"):
        with pytest.raises(CheckpointError, match="another process trains in"):
            train(tmp_path / "run", resume=True)
        with pytest.raises(CheckpointError, match="another process trains in"):
            clear_run(tmp_path / "run")
    train(tmp_path / "run", resume=True)


def test_time_and_number_of_checkpoints_can_be_chosen(tmp_path: Path) -> None:
    seconds = config(total_timesteps=20, checkpoint_every=999, checkpoint_seconds=1e-9, checkpoints_kept=2)
    train(tmp_path / "run", seconds)
    assert [p.name for p in checkpoints(tmp_path / "run")] == ["step_000000019.pt", "step_000000020.pt"]
    with pytest.raises(InvalidInputError, match="checkpoint_seconds must be above 0"):
        config(checkpoint_seconds=0.0)
    with pytest.raises(InvalidInputError, match="checkpoints_kept must be 1 or more"):
        config(checkpoints_kept=0)


# ------------------------------------------------------------------------------------------ the real tasks


@pytest.mark.parametrize(
    ("env_id", "options"),
    [
        (GUIDED, {"plant_pose_noise": (0.02, 0.02, 0.1)}),
        ("TomatoViewpointSparse-v1", {"plant": {"seed": "train"}}),
    ],
    ids=["guided", "a new plant every episode"],
)
def test_an_environment_goes_on_from_the_middle_of_an_episode(env_id: str, options: dict[str, Any]) -> None:
    env, other = make_learner_env(env_id, **options), make_learner_env(env_id, **options)
    generator = torch.Generator().manual_seed(0)
    actions = 0.05 * torch.randn(70, 1, 6, generator=generator)
    env.reset(seed=5)
    other.reset(seed=6)
    for action in actions[:35]:
        env.step(action)
    set_env_state(other, env_state(env))
    episodes = 0
    for action in actions[35:]:
        expected, actual = env.step(action), other.step(action)
        for one, two in zip(expected[:4], actual[:4], strict=True):
            assert torch.equal(one, two)
        assert torch.equal(expected[4]["visible_fraction"], actual[4]["visible_fraction"])
        assert torch.equal(expected[4]["target_id"], actual[4]["target_id"])
        episodes += int((expected[2] | expected[3]).sum())
    assert episodes > 0
    first, second = dict(flat(env_state(env))), dict(flat(env_state(other)))
    spaces = {"/action_space", "/single_action_space"}
    for name in first.keys() - spaces:
        same = torch.equal(first[name], second[name]) if isinstance(first[name], Tensor) else None
        assert same or first[name] == second[name], name
    env.close()
    other.close()


def test_physics_goes_on_to_within_its_rounding(caplog: pytest.LogCaptureFixture) -> None:
    env, other = (make_learner_env(GUIDED, motion="dynamic") for _ in range(2))
    actions = 0.05 * torch.randn(12, 1, 6, generator=torch.Generator().manual_seed(0))
    env.reset(seed=5)
    other.reset(seed=6)
    for action in actions[:6]:
        env.step(action)
    set_env_state(other, env_state(env))
    assert "last digits may differ" in caplog.text
    for action in actions[6:]:
        torch.testing.assert_close(env.step(action)[0], other.step(action)[0], rtol=0.0, atol=1e-6)
    env.close()
    other.close()


def start(*arguments: str) -> Any:
    """The command in a process of its own, forked from one that has loaded the simulator already."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(
        ["maniskill_tomato.cli", "maniskill_tomato.learning.rl.trainer", "maniskill_tomato.tasks.vector_env"]
    )
    process = context.Process(target=cli.main, args=(list(arguments),))
    process.start()
    return process


REAL = (
    *("--total-timesteps", "300", "--learning-starts", "60", "--batch-size", "32"),
    *("--num-envs", "1", "--updates-per-step", "0.5", "--checkpoint-every", "41", "--seed", "2"),
)


@pytest.fixture(scope="module")
def real_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the guided task that nothing happened to."""
    run_dir = tmp_path_factory.mktemp("real") / "run"
    process = start("train", GUIDED, "--out", str(run_dir), *REAL)
    process.join(500)
    assert process.exitcode == 0
    return run_dir


@pytest.mark.parametrize(
    "number",
    [signal.SIGKILL, *(pytest.param(n, marks=pytest.mark.slow) for n in (signal.SIGTERM, signal.SIGINT))],
)
def test_a_killed_run_of_the_real_task_ends_as_the_unbroken_one(
    tmp_path: Path, real_run: Path, number: signal.Signals
) -> None:
    run_dir = tmp_path / "run"
    process = start("train", GUIDED, "--out", str(run_dir), *REAL)
    deadline = time.monotonic() + 300
    while not checkpoints(run_dir) and process.is_alive() and time.monotonic() < deadline:
        time.sleep(0.01)
    time.sleep(random.Random().uniform(0.0, 0.5))
    os.kill(process.pid, number)
    process.join(500)
    assert process.exitcode == (-signal.SIGKILL if number == signal.SIGKILL else 0)
    assert 41 <= load_checkpoint(checkpoints(run_dir)[-1])["counters"]["steps"] < 300
    assert (run_dir / "policy.pt").exists() == (number != signal.SIGKILL)
    process = start("train", "--resume", str(run_dir))
    process.join(500)
    assert process.exitcode == 0
    assert_same_run(real_run, run_dir)
