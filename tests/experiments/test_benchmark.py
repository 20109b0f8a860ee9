"""The benchmark: figures of episodes made by hand, the store, resuming, processes, the page."""

import json
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from maniskill_tomato.cli import parse
from maniskill_tomato.cli.benchmark_command import Benchmark
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments import benchmark
from maniskill_tomato.experiments.benchmark import BenchmarkConfig, run_benchmark
from maniskill_tomato.experiments.benchmark_conditions import (
    SWEEPS,
    Condition,
    main_condition,
    sweep_conditions,
)
from maniskill_tomato.experiments.benchmark_metrics import compare_policies, summarise_policy
from maniskill_tomato.experiments.benchmark_policies import PolicySpec, parse_policies
from maniskill_tomato.experiments.benchmark_report import evaluate_runs, write_benchmark
from maniskill_tomato.experiments.benchmark_store import EpisodeStore
from maniskill_tomato.experiments.view_episode import ViewEpisode
from maniskill_tomato.experiments.view_rollout import run_view_episode
from maniskill_tomato.plants.episode_list import load_episodes, write_episodes

HORIZON = 20


def episode(
    number: int,
    seen: list[float],
    *,
    success: bool,
    oracle_moves: int | None = None,
    contact: tuple[int, ...] = (),
    step: float = 0.1,
) -> ViewEpisode:
    """An episode along x in steps of a given length, one joint turning by 0.2 rad a move."""
    moves = len(seen) - 1
    camera = np.zeros((moves + 1, 3))
    camera[:, 0] = step * np.arange(moves + 1)
    qpos = np.zeros((moves + 1, 7))
    qpos[:, 2] = 0.2 * np.arange(moves + 1)
    touched = np.zeros(moves, dtype=bool)
    touched[list(contact)] = True
    return ViewEpisode(
        episode=number,
        success=success,
        visible_fraction=np.array(seen),
        camera=camera,
        qpos=qpos,
        target=np.array([0.9, 0.0, 0.8]),
        refused=np.arange(moves) == 1,
        contact=touched,
        clearance=np.where(touched, -0.01, 0.05),
        decision_ms=np.full(moves, 2.0),
        oracle_moves=oracle_moves,
    )


def test_the_figures_of_three_episodes_by_hand() -> None:
    episodes = [
        episode(0, [0.1, 0.4, 0.9], success=True, oracle_moves=1),
        episode(1, [0.2, 0.1, 0.3, 0.7, 0.85], success=True, oracle_moves=4, contact=(2,)),
        episode(2, [0.0] + [0.55] * 20, success=False, oracle_moves=2),
    ]
    figures = summarise_policy("p", episodes, HORIZON)
    assert figures["success_rate"] == pytest.approx(2 / 3)
    assert figures["mean_moves"] == pytest.approx((2 + 4 + 20) / 3)
    assert figures["mean_moves_success"] == 3.0
    assert figures["success_rate_within_moves"] == pytest.approx(
        {"1": 0.0, "3": 1 / 3, "5": 2 / 3, "10": 2 / 3, "20": 2 / 3}
    )
    at = figures["success_rate_at_threshold"]
    assert at["0.50"] == pytest.approx(1.0)
    assert at["0.55"] == pytest.approx(2 / 3)
    assert at["0.85"] == pytest.approx(1 / 3)
    assert at["0.95"] == 0.0
    assert figures["mean_path_m"] == pytest.approx((0.2 + 0.4 + 2.0) / 3)
    assert figures["mean_joint_path_rad"] == pytest.approx((0.4 + 0.8 + 4.0) / 3)
    assert figures["mean_best_visible_fraction"] == pytest.approx((0.9 + 0.85 + 0.55) / 3)
    assert figures["mean_final_visible_fraction"] == pytest.approx((0.9 + 0.85 + 0.55) / 3)
    # Best so far after move 1, 2, ...: the second one holds its start's 0.2 through move 1.
    auc = [(0.4 + 19 * 0.9) / 20, (0.2 + 0.3 + 0.7 + 17 * 0.85) / 20, 0.55]
    assert figures["auc"] == pytest.approx(np.mean(auc))
    assert figures["regret_moves"] == pytest.approx((1 + 0 + 18) / 3)
    assert figures["spl"] == pytest.approx((1 / 2 + 1 + 0) / 3)
    assert figures["moves_over_oracle"] == pytest.approx(26 / 7)
    assert figures["contact_episode_rate"] == pytest.approx(1 / 3)
    assert figures["contact_move_rate"] == pytest.approx(1 / 26)
    assert figures["contact_free_success_rate"] == pytest.approx(1 / 3)
    assert figures["refused_move_rate"] == pytest.approx(3 / 26)
    assert figures["decision_ms"] == 2.0
    assert figures["mean_min_clearance_m"] == pytest.approx((0.05 - 0.01 + 0.05) / 3)


def test_without_an_oracle_there_is_no_regret() -> None:
    figures = summarise_policy("p", [episode(0, [0.1, 0.9], success=True)], HORIZON)
    assert figures["regret_moves"] is None and figures["spl"] is None
    json.dumps(figures, allow_nan=False)
    with pytest.raises(InvalidInputError, match="no episode"):
        summarise_policy("p", [], HORIZON)


def test_policies_are_compared_on_the_episodes_that_both_have() -> None:
    fast = [episode(i, [0.1, 0.9], success=True) for i in range(30)]
    slow = [episode(i, [0.1, 0.2, 0.3, 0.9], success=True) for i in range(5, 40)]
    (test,) = compare_policies({"fast": fast, "slow": slow}, HORIZON)
    assert (test["a"], test["b"], test["episodes"]) == ("fast", "slow", 25)
    assert test["moves_difference"] == -2.0
    assert test["moves_p"] < 0.01
    assert test["success_p"] == 1.0


def test_an_episode_survives_json_and_bad_ones_are_refused() -> None:
    before = episode(3, [0.1, 0.4, 0.9], success=True, contact=(0,), oracle_moves=2)
    content = json.loads(json.dumps(before.to_json(), allow_nan=False))
    after = ViewEpisode.from_json(content)
    for name in ("visible_fraction", "camera", "qpos", "contact", "refused", "clearance", "decision_ms"):
        np.testing.assert_allclose(getattr(after, name), getattr(before, name), atol=1e-5)
    assert (after.episode, after.success, after.oracle_moves) == (3, True, 2)
    with pytest.raises(InvalidInputError, match="cannot be read"):
        ViewEpisode.from_json({**content, "camera": [[0.0, 0.0, 0.0]]})
    del content["qpos"]
    with pytest.raises(InvalidInputError, match="cannot be read"):
        ViewEpisode.from_json(content)


def test_unknown_clearance_survives_too() -> None:
    start = episode(0, [0.1, 0.9], success=True)
    values = {**vars(start), "clearance": np.array([math.nan])}
    after = ViewEpisode.from_json(json.loads(json.dumps(ViewEpisode(**values).to_json(), allow_nan=False)))
    assert np.isnan(after.clearance).all()
    assert summarise_policy("p", [after], HORIZON)["mean_min_clearance_m"] is None


# ------------------------------------------------------------------- store


def test_the_store_goes_on_after_a_line_was_cut_short(tmp_path: Path) -> None:
    store = EpisodeStore(tmp_path, {"env_id": "x"}, {"nbv": "a"})
    store.add("held_out", "nbv", [episode(i, [0.1, 0.9], success=True) for i in (4, 2)])
    path = tmp_path / "episodes" / "held_out" / "nbv.jsonl"
    whole = path.read_bytes()
    path.write_bytes(whole + whole[:40])
    again = EpisodeStore(tmp_path, {"env_id": "x"}, {"nbv": "a", "oracle": "b"})
    assert [e.episode for e in again.read("held_out", "nbv")] == [2, 4]
    assert again.missing("held_out", "nbv", range(6)) == [0, 1, 3, 5]
    again.add("held_out", "nbv", [episode(3, [0.1, 0.9], success=True)])
    assert [e.episode for e in again.read("held_out", "nbv")] == [2, 3, 4]


def test_a_folder_of_another_benchmark_or_policy_is_refused(tmp_path: Path) -> None:
    EpisodeStore(tmp_path, {"env_id": "x"}, {"mine": "a"})
    with pytest.raises(InvalidInputError, match="env_id differ"):
        EpisodeStore(tmp_path, {"env_id": "y"}, {})
    with pytest.raises(InvalidInputError, match="policy mine differ"):
        EpisodeStore(tmp_path, {"env_id": "x"}, {"mine": "b"})


# ---------------------------------------------------------------- policies


def test_policies_are_read_from_the_command_line(tmp_path: Path) -> None:
    run = tmp_path / "general"
    run.mkdir()
    (run / "policy.pt").write_bytes(b"weights")
    (tmp_path / "other.onnx").write_bytes(b"weights")
    specs = parse_policies(f"nbv, {run / 'policy.pt'},best={tmp_path / 'other.onnx'}, oracle")
    assert [spec.label for spec in specs] == ["nbv", "general", "best", "oracle"]
    assert [spec.planner for spec in specs] == ["nbv", None, None, "oracle"]
    deep = PolicySpec.parse(f"deep_3dmts={run / 'policy.pt'}")
    assert deep.planner == "deep_3dmts" and deep.path is not None
    before = specs[1].fingerprint()
    (run / "policy.pt").write_bytes(b"others")
    assert specs[1].fingerprint() != before


@pytest.mark.parametrize("text", ["", "best", "nbv,nbv", "a=missing.pt"])
def test_a_list_of_policies_that_cannot_be_used_is_refused(text: str) -> None:
    with pytest.raises(InvalidInputError):
        parse_policies(text)


def test_sweeps_have_conditions_with_names_of_their_own() -> None:
    names = [condition.name for axis in SWEEPS for condition in sweep_conditions(axis)]
    assert len(names) == len(set(names)) >= 20
    assert main_condition().name not in names
    own = main_condition("runs/fresh.json")
    assert own.name == "fresh" and own.episode_list == own.env_options["episodes"] == "runs/fresh.json"
    with pytest.raises(InvalidInputError, match="the sweep"):
        sweep_conditions("weather")


# ----------------------------------------------------------------- running


class LineWorld:
    """A camera on a line: V_f grows with the way along forward; the seed says how far the good view is."""

    num_envs = 1
    device = torch.device("cpu")
    spec = None

    def __init__(self) -> None:
        self.x = torch.zeros(1)
        self.agent = SimpleNamespace(robot=SimpleNamespace(get_qpos=lambda: self.x * torch.ones(1, 7)))
        self.resets = 0

    @property
    def unwrapped(self) -> "LineWorld":
        return self

    @property
    def belief(self) -> Any:
        position = torch.tensor([[float(self.x), 0.0, 0.0]])
        return SimpleNamespace(camera_position=position, target_position=torch.zeros(1, 3))

    def reset(self, *, seed: int, options: Any = None) -> tuple[None, dict[str, Any]]:
        self.resets += 1
        self.x, self.elapsed, self.far = torch.zeros(1), 0, 2 + seed % 5
        return None, self._info()

    def step(self, action: Tensor) -> tuple[Any, ...]:
        self.x = self.x + action[0, 2]
        self.elapsed += 1
        info = self._info()
        return None, 0.0, info["success"], torch.tensor([self.elapsed >= HORIZON]), info

    def close(self) -> None:
        pass

    def _info(self) -> dict[str, Tensor]:
        seen = (self.x / self.far).clamp(0.0, 1.0)
        return {
            "visible_fraction": seen,
            "success": seen > 0.8,
            "reachability": torch.tensor([0]),
            "plant_contact": torch.tensor([self.elapsed == 1]),
            "clearance": torch.tensor([0.1]),
        }


class Runner:
    """Moves forward by a fixed share."""

    needs_truth = False

    def __init__(self, name: str, share: float) -> None:
        self.name = name
        self._share = share
        self.begun: list[int] = []
        self.seeds: list[int] = []

    def reseed(self, seed: int) -> None:
        self.seeds.append(seed)

    def begin(self, belief: Any, env_idx: Tensor) -> None:
        self.begun.append(int(env_idx[0]))

    def act(self, belief: Any) -> Tensor:
        return torch.tensor([[0.0, 0.0, self._share]])


def test_an_episode_is_recorded_from_its_first_view_to_its_last() -> None:
    world: Any = LineWorld()
    policy = Runner("runner", 1.0)
    found = run_view_episode(world, policy, 3, oracle_moves=4)
    # The good view is 5 away and V_f passes 0.8 at the fifth move.
    assert (found.moves, found.success, found.oracle_moves) == (5, True, 4)
    np.testing.assert_allclose(found.visible_fraction, np.arange(6) / 5)
    np.testing.assert_allclose(found.camera[:, 0], np.arange(6))
    assert found.joint_path_length == pytest.approx(5 * 7)
    assert found.contact.tolist() == [True, False, False, False, False]
    assert policy.seeds == [3] and policy.begun == [0]


def test_many_environments_at_once_are_refused() -> None:
    world: Any = LineWorld()
    world.num_envs = 4
    with pytest.raises(InvalidInputError, match="num_envs=1"):
        run_view_episode(world, Runner("runner", 1.0), 0)


def test_a_benchmark_runs_what_is_missing_and_nothing_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = LineWorld()
    runners = {"stay": Runner("stay", 0.5), "nbv": Runner("nbv", 1.0)}
    monkeypatch.setattr(benchmark, "_environment", lambda env_id, options: world)
    monkeypatch.setattr(benchmark, "_policy", lambda spec, env, contact_free: runners[spec.label])
    specs = tuple(parse_policies("stay,nbv"))
    condition = Condition(name="line")

    def config(episodes: int, policies: tuple[PolicySpec, ...] = specs) -> BenchmarkConfig:
        return BenchmarkConfig(
            policies=policies, conditions=(condition,), episodes={"line": episodes}, seed=10
        )

    store = EpisodeStore(tmp_path, config(1).settings(), {})
    run_benchmark(config(7, specs[:1]), store)
    assert world.resets == 7
    run_benchmark(config(12), store)
    assert world.resets == 7 + 5 + 12
    run_benchmark(config(12), store)
    assert world.resets == 7 + 5 + 12
    for label in ("stay", "nbv"):
        assert [e.episode for e in store.read("line", label)] == list(range(10, 22))
    assert store.read("line", "nbv")[0].moves < store.read("line", "stay")[0].moves


def test_bad_numbers_are_refused() -> None:
    base: dict[str, Any] = {"policies": (), "conditions": (Condition(name="a"),), "episodes": {"a": 1}}
    changes: list[dict[str, Any]] = [{"jobs": 0}, {"seed": -1}, {"episodes": {}}]
    for change in changes:
        with pytest.raises(InvalidInputError):
            BenchmarkConfig(**{**base, **change})


def test_the_results_are_written(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    runs = {
        label: [
            episode(i, [0.1] * k + [0.9], success=True, oracle_moves=1, contact=(0,) if i % 4 == 0 else ())
            for i, k in enumerate(rng.integers(1, most, 40))
        ]
        for label, most in (("fast", 4), ("slow", 9))
    }
    swept = Condition(name="leaf_density_1", axis="leaf_density", value=1.0)
    main = main_condition()
    result = evaluate_runs({main.name: runs, swept.name: {"fast": runs["fast"]}}, (main, swept), HORIZON)
    page = write_benchmark(
        result, runs, tmp_path, threshold=0.8, horizon=HORIZON, privileged=["fast"], facts={"processes": 2}
    )
    rows = json.loads((tmp_path / "benchmark.json").read_text())
    assert [row["policy"] for row in rows] == ["fast", "slow"]
    for key in ("success_rate", "mean_moves", "mean_path_m", "decision_ms"):
        assert isinstance(rows[0][key], float)
    details = json.loads((tmp_path / "benchmark_details.json").read_text())
    assert details["processes"] == 2
    assert details["tests"][0]["moves_difference"] < 0
    assert details["sweeps"][0]["axis"] == "leaf_density"
    text = page.read_text()
    assert "| fast * | 100.0 % |" in text
    assert "25.0 %" in text
    assert "## Sweep: leaf density" in text
    for name in ("progress.png", "thresholds.png", "sweeps.png"):
        assert f"({name})" in text
        assert (tmp_path / name).stat().st_size > 5000


# ----------------------------------------------------------------- command


def test_the_command_line_names_policies_list_and_sweeps(tmp_path: Path) -> None:
    command = parse(
        ["benchmark", "--policies", "nbv,oracle", "--episodes", "7", "--seed", "3", "--out", str(tmp_path)]
        + ["--sweeps", "depth,pose", "--episode-list", "validation", "--jobs", "2"]
    )
    assert isinstance(command, Benchmark)
    assert (command.policies, command.episodes, command.seed, command.jobs) == ("nbv,oracle", 7, 3, 2)
    assert (command.sweeps, command.episode_list, command.out) == ("depth,pose", "validation", tmp_path)


def test_sweeps_need_a_list_of_the_package(tmp_path: Path) -> None:
    path = tmp_path / "own.json"
    write_episodes(path, load_episodes("validation")[:2])
    with pytest.raises(InvalidInputError, match="--episode-list validation or held_out"):
        Benchmark(
            policies="nbv", episodes=1, episode_list=str(path), sweeps="depth", out=tmp_path / "b"
        ).run()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"episodes": 0}, "--episodes must be"),
        ({"seed": 195, "episodes": 20}, "at most 200"),
        ({"sweeps": "weather"}, "the sweep"),
        ({"sweep_policies": "oracle"}, "--sweep-policies"),
        ({"policies": "unheard_of"}, "no policy"),
    ],
)
def test_the_command_refuses_what_it_cannot_run(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    options: dict[str, Any] = {"policies": "nbv", "episodes": 2, "out": tmp_path / "b"}
    with pytest.raises(InvalidInputError, match=message):
        Benchmark(episode_list="validation", **{**options, **change}).run()
    assert not (tmp_path / "b").exists()
