"""The benchmark: figures of episodes made by hand, the store, resuming, processes, the page."""

import json
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from matplotlib.text import Text
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError, PolicyError, TomatoError
from maniskill_tomato.experiments import policy_runs
from maniskill_tomato.experiments.benchmark_report import BenchmarkInput, summarise_runs, write_benchmark
from maniskill_tomato.experiments.configs import BenchmarkConfig
from maniskill_tomato.experiments.episode_record import EpisodeRecord, RowSearch
from maniskill_tomato.experiments.metrics import compare_policies, summarise_policy
from maniskill_tomato.experiments.policy_runs import Condition, parse_policies, run_policies
from maniskill_tomato.experiments.result_store import ResultStore
from maniskill_tomato.experiments.rollout import run_batch, run_episode
from maniskill_tomato.experiments.stored_episodes import read_stored_episodes
from maniskill_tomato.experiments.viewpoint_benchmark import (
    SWEEPS,
    main_condition,
    run_benchmark,
    sweep_conditions,
)
from maniskill_tomato.plants.episode_list import load_episodes, write_episodes
from maniskill_tomato.report_plots import MOST_LINES, clipped_texts

HORIZON = 20


def episode(
    number: int,
    seen: list[float],
    *,
    success: bool,
    oracle_moves: int | None = None,
    contact: tuple[int, ...] = (),
    step: float = 0.1,
) -> EpisodeRecord:
    """An episode along x in steps of a given length, one joint turning by 0.2 rad a move."""
    moves = len(seen) - 1
    camera = np.zeros((moves + 1, 3))
    camera[:, 0] = step * np.arange(moves + 1)
    qpos = np.zeros((moves + 1, 7))
    qpos[:, 2] = 0.2 * np.arange(moves + 1)
    touched = np.zeros(moves, dtype=bool)
    touched[list(contact)] = True
    return EpisodeRecord(
        seed=number,
        success=success,
        visible_fraction=np.array(seen),
        viewpoints=np.hstack([camera, np.zeros((moves + 1, 3))]),
        camera=camera,
        qpos=qpos,
        target=np.tile([0.9, 0.0, 0.8], (moves + 1, 1)),
        rewards=np.full(moves, -0.125),
        reachability=np.where(np.arange(moves) == 1, 2, 0),
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
    after = EpisodeRecord.from_json(content)
    for name in EpisodeRecord.SHAPES:
        stored, given = getattr(after, name), getattr(before, name)
        if given is None:
            assert stored is None, name
        else:
            assert stored.dtype == given.dtype, name
            np.testing.assert_allclose(stored, given, atol=1e-5)
    assert (after.seed, after.success, after.oracle_moves, after.row) == (3, True, 2, None)
    with pytest.raises(InvalidInputError, match="cannot be read"):
        EpisodeRecord.from_json({**content, "camera": [[0.0, 0.0, 0.0]]})
    del content["qpos"]
    with pytest.raises(InvalidInputError, match="cannot be read"):
        EpisodeRecord.from_json(content)


def test_an_episode_with_arrays_of_different_lengths_is_refused() -> None:
    values = {**vars(episode(0, [0.1, 0.4, 0.9], success=True)), "rewards": np.zeros(3)}
    with pytest.raises(InvalidInputError, match=r"rewards of an episode with 2 steps must have shape \(2,\)"):
        EpisodeRecord(**values)


def test_the_search_of_a_row_survives_json() -> None:
    search = RowSearch(targets=(3, 8), seen=(8,), moves=12, transits=1, path_m=2.5, joint_path_rad=30.0)
    record = EpisodeRecord(**{**vars(episode(0, [0.1, 0.9], success=False)), "row": search})
    assert EpisodeRecord.from_json(json.loads(json.dumps(record.to_json()))).row == search


def test_unknown_clearance_survives_too() -> None:
    start = episode(0, [0.1, 0.9], success=True)
    values = {**vars(start), "clearance": np.array([math.nan])}
    after = EpisodeRecord.from_json(
        json.loads(json.dumps(EpisodeRecord(**values).to_json(), allow_nan=False))
    )
    assert after.clearance is not None and np.isnan(after.clearance).all()
    assert summarise_policy("p", [after], HORIZON)["mean_min_clearance_m"] is None


# ---------------------------------------------------------------- policies


def test_policies_are_read_from_the_command_line(tmp_path: Path) -> None:
    run = tmp_path / "general"
    run.mkdir()
    (run / "policy.pt").write_bytes(b"weights")
    (tmp_path / "other.onnx").write_bytes(b"weights")
    specs = parse_policies(f"nbv, {run / 'policy.pt'},best={tmp_path / 'other.onnx'}, oracle")
    assert [spec.label for spec in specs] == ["nbv", "general", "best", "oracle"]
    files = [str(run / "policy.pt"), str(tmp_path / "other.onnx")]
    assert [spec.source for spec in specs] == ["nbv", *files, "oracle"]
    before = specs[1].fingerprint
    (run / "policy.pt").write_bytes(b"others")
    assert specs[1].fingerprint != before


@pytest.mark.parametrize("text", ["", "best", "nbv,nbv", "a=missing.pt"])
def test_a_list_of_policies_that_cannot_be_used_is_refused(text: str) -> None:
    with pytest.raises((InvalidInputError, PolicyError)):
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

    device = torch.device("cpu")
    spec = None
    keeps_belief = True

    def __init__(self, num_envs: int = 1) -> None:
        self.num_envs = num_envs
        self.x = torch.zeros(num_envs)
        self.resets = 0

    @property
    def unwrapped(self) -> "LineWorld":
        return self

    @property
    def qpos(self) -> Tensor:
        return self.x[:, None].expand(-1, 7)

    @property
    def belief(self) -> Any:
        x, rows = self.x, self.num_envs
        return SimpleNamespace(
            camera_position=torch.stack([x, 0 * x, 0 * x], dim=-1),
            viewpoint=torch.stack([x, *[0 * x] * 5], dim=-1),
            target_position=torch.zeros(rows, 3),
            memory=SimpleNamespace(visits=torch.full((rows,), self.elapsed + 1)),
        )

    def reset(self, *, seed: Any, options: Any = None) -> tuple[None, dict[str, Any]]:
        self.resets += 1
        self.x, self.elapsed = torch.zeros(self.num_envs), 0
        self.far = 2 + torch.tensor([seed] if isinstance(seed, int) else seed) % 5
        return None, self._info()

    def step(self, action: Tensor) -> tuple[Any, ...]:
        self.x = self.x + action[:, 2]
        self.elapsed += 1
        info = self._info()
        reward = torch.full((self.num_envs,), -0.5)
        return None, reward, info["success"], torch.full((self.num_envs,), self.elapsed >= HORIZON), info

    def close(self) -> None:
        pass

    def _info(self) -> dict[str, Tensor]:
        seen = (self.x / self.far).clamp(0.0, 1.0)
        return {
            "visible_fraction": seen,
            "success": seen > 0.8,
            "reachability": torch.zeros(self.num_envs, dtype=torch.int64),
            "plant_contact": torch.full((self.num_envs,), self.elapsed == 1),
            "clearance": torch.full((self.num_envs,), 0.1),
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

    def begin(self, belief: Any, rows: Tensor) -> None:
        self.begun += rows.tolist()

    def act(self, belief: Any) -> Tensor:
        return torch.tensor([[0.0, 0.0, self._share]]).expand(len(belief.camera_position), 3)


def test_an_episode_is_recorded_from_its_first_view_to_its_last() -> None:
    world: Any = LineWorld()
    policy = Runner("runner", 1.0)
    found = run_episode(world, policy, 3, oracle_moves=4)
    # The good view is 5 away and V_f passes 0.8 at the fifth move.
    assert (found.steps, found.success, found.oracle_moves) == (5, True, 4)
    np.testing.assert_allclose(found.visible_fraction, np.arange(6) / 5, atol=1e-6)
    assert found.camera is not None and found.contact is not None
    np.testing.assert_allclose(found.camera[:, 0], np.arange(6))
    np.testing.assert_allclose(found.viewpoints[:, 0], np.arange(6))
    np.testing.assert_allclose(found.rewards, np.full(5, -0.5))
    assert found.joint_path_length == pytest.approx(5 * 7)
    assert found.contact.tolist() == [True, False, False, False, False]
    assert found.in_forbidden_zone is None and found.row is None
    assert policy.seeds == [3] and policy.begun == [0]


def test_several_environments_give_the_episodes_of_single_ones() -> None:
    together = run_batch(cast(Any, LineWorld(4)), Runner("runner", 0.7), range(3, 7))
    alone = [run_episode(cast(Any, LineWorld()), Runner("runner", 0.7), seed) for seed in range(3, 7)]
    assert [e.seed for e in together] == [3, 4, 5, 6]
    for one, other in zip(together, alone, strict=True):
        for name in EpisodeRecord.SHAPES:
            if name != "decision_ms":
                np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
        assert one.success and other.success


@pytest.mark.parametrize("name", ["view_quality", "random_viewpoint"])
def test_a_benchmark_of_several_environments_at_once_has_the_same_episodes(tmp_path: Path, name: str) -> None:
    condition = Condition(
        name="few",
        env_options={"episodes": load_episodes("held_out")[:3]},
    )
    found = {}
    for num_envs in (1, 2):
        store = ResultStore(tmp_path / str(num_envs), {})
        run_policies(store, [(condition, parse_policies(name), range(3))], 1, num_envs)
        found[num_envs] = store.episodes("few", name, range(3))
    assert len(found[2]) == 3
    for one, other in zip(found[1], found[2], strict=True):
        assert (one.seed, one.success, one.steps) == (other.seed, other.success, other.steps)
        np.testing.assert_allclose(one.viewpoints, other.viewpoints, atol=1e-4)
        np.testing.assert_allclose(one.visible_fraction, other.visible_fraction, atol=1e-4)


def test_a_single_episode_in_many_environments_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="num_envs=1"):
        run_episode(cast(Any, LineWorld(4)), Runner("runner", 1.0), 0)


def test_a_benchmark_runs_what_is_missing_and_nothing_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = LineWorld()
    runners = {"stay": Runner("stay", 0.5), "nbv": Runner("nbv", 1.0)}
    monkeypatch.setattr(
        policy_runs, "_opened", lambda spec, condition, num_envs: (world, runners[spec.label])
    )
    stay, nbv = parse_policies("stay,nbv")
    line = Condition(name="line")
    store = ResultStore(tmp_path, {})
    run_policies(store, [(line, [stay], range(10, 17))], 1)
    assert world.resets == 7
    run_policies(store, [(line, [stay, nbv], range(10, 22))], 1)
    assert world.resets == 7 + 5 + 12
    run_policies(store, [(line, [stay, nbv], range(10, 22))], 1)
    assert world.resets == 7 + 5 + 12
    for label in ("stay", "nbv"):
        assert [e.seed for e in store.episodes("line", label, range(30))] == list(range(10, 22))
    assert store.episodes("line", "nbv", [10])[0].steps < store.episodes("line", "stay", [10])[0].steps
    (kept,) = read_stored_episodes(tmp_path)
    assert (kept.name, kept.env_id, kept.env_options) == ("line", line.env_id, {})
    assert {label: list(found) for label, found in kept.episodes.items()} == {
        label: list(range(10, 22)) for label in ("stay", "nbv")
    }


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
    figures = summarise_runs({main.name: runs, swept.name: {"fast": runs["fast"]}}, (main, swept), HORIZON)
    content = BenchmarkInput(
        runs=runs,
        threshold=0.8,
        horizon=HORIZON,
        privileged=["fast"],
        facts={"processes": 2},
        replay=lambda policy, seed: f"again {policy} {seed}",
    )
    table, page = write_benchmark(figures, content, tmp_path)
    rows = json.loads((tmp_path / "benchmark.json").read_text())
    assert [row["policy"] for row in rows] == ["fast", "slow"]
    for key in ("success_rate", "mean_moves", "mean_path_m", "decision_ms"):
        assert isinstance(rows[0][key], float)
    details = json.loads((tmp_path / "benchmark_details.json").read_text())
    assert details["processes"] == 2
    assert details["tests"][0]["moves_difference"] < 0
    assert details["sweeps"][0]["axis"] == "leaf_density"
    text = page.read_text()
    assert "| fast * | 100.0 % |" in table
    assert '<th scope="row">fast *</th><td>100.0 %</td>' in text and "<td>25.0 %</td>" in text
    assert "<h2>Sweep: leaf density</h2>" in text and "n = 40 episodes a point" in text
    assert "<code>again slow 7</code>" in text and "<dt>processes</dt><dd>2</dd>" in text
    assert text.count("<svg") == 4
    for name in ("progress.png", "best_view.png", "thresholds.png", "sweep_leaf_density.png"):
        assert (tmp_path / name).stat().st_size > 5000


def test_plots_draw_the_best_policies_alone_and_cut_no_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[Figure] = []
    savefig = Figure.savefig

    def keep(self: Figure, *arguments: Any, **options: Any) -> None:
        drawn.append(self)
        savefig(self, *arguments, **options)

    monkeypatch.setattr(Figure, "savefig", keep)
    names = [f"a policy with a long name, number {k:02d}" for k in range(12)]
    runs = {
        name: [episode(i, [0.1] * 3 + [0.9 if i >= k else 0.2], success=i >= k) for i in range(20)]
        for k, name in enumerate(names)
    }
    main = main_condition()
    swept = [Condition(name=f"pose_{v}", axis="pose", value=v) for v in (0.0, 0.01)]
    every = {main.name: runs, **{condition.name: runs for condition in swept}}
    figures = summarise_runs(every, (main, *swept), HORIZON)
    _, page = write_benchmark(figures, BenchmarkInput(runs=runs, threshold=0.8, horizon=HORIZON), tmp_path)
    told = {figure: {t.get_text().replace("\n", " ") for t in figure.findobj(Text)} for figure in drawn}
    assert len(told) == 4
    for figure, texts in told.items():
        assert clipped_texts(figure) == []
        named = [name for name in names if name in texts]
        sweep = len(figure.axes) > 1
        assert named == (names if sweep else names[:MOST_LINES])
        for axes in figure.axes:
            lines = [line for line in axes.lines if len(np.asarray(line.get_xdata())) > 2]
            looks = [(str(vars(line)["_unscaled_dash_pattern"]), line.get_marker()) for line in lines]
            assert sweep or (len(looks) == MOST_LINES and len(set(looks)) == MOST_LINES)
            assert axes.get_legend() is None
    assert "The 8 best of 12 policies; the table names all." in page.read_text()


def test_sweeps_need_a_list_of_the_package(tmp_path: Path) -> None:
    path = tmp_path / "own.json"
    write_episodes(path, load_episodes("validation")[:2])
    with pytest.raises(InvalidInputError, match="--episode-list validation or held_out"):
        run_benchmark(
            BenchmarkConfig(
                policies="nbv", episodes=1, episode_list=str(path), sweeps="depth", out=tmp_path / "b"
            )
        )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"episodes": 0}, "--episodes must be"),
        ({"jobs": 0}, "--jobs must be"),
        ({"seed": -1}, "--seed 0 or more"),
        ({"seed": 195, "episodes": 20}, "at most 200"),
        ({"sweeps": "weather"}, "the sweep"),
        ({"sweep_policies": "oracle"}, "--sweep-policies"),
        ({"policies": "unheard_of"}, "no policy"),
    ],
)
def test_what_cannot_be_run_is_refused(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    options: dict[str, Any] = {"policies": "nbv", "episodes": 2, "out": tmp_path / "b"}
    with pytest.raises(TomatoError, match=message):
        run_benchmark(BenchmarkConfig(episode_list="validation", **{**options, **change}))
    assert not (tmp_path / "b").exists()
