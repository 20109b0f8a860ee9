"""Episodes, metrics, plots and the report, on episodes made by hand and on a small environment."""

import json
import math
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import gymnasium as gym
import imageio.v2 as imageio
import numpy as np
import pytest
import torch
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments import evaluation
from maniskill_tomato.experiments.configs import EvaluationConfig
from maniskill_tomato.experiments.episode_record import EpisodeRecord
from maniskill_tomato.experiments.evaluation import write_trajectories
from maniskill_tomato.experiments.evaluation_report import ReportInput, ReportPicture, write_report
from maniskill_tomato.experiments.metrics import make_metrics, summarise
from maniskill_tomato.experiments.plots import (
    default_windows,
    moving_average,
    plot_steps,
    plot_training_curves,
    plot_trajectories,
    plot_visible_fraction,
)
from maniskill_tomato.experiments.rollout import run_episodes
from maniskill_tomato.files import write_json
from maniskill_tomato.learning.rl.history import TrainingHistory, load_history
from maniskill_tomato.policies.adapters import as_policy
from maniskill_tomato.rendering import vulkan_probe

HORIZON = 6


class SeededTask:
    """Batched episodes that are a function of their seed: x grows by the action, V_f is x; success above
    0.85."""

    def __init__(self, num_envs: int) -> None:
        self.num_envs = num_envs
        self.resets: list[Any] = []

    @property
    def unwrapped(self) -> "SeededTask":
        return self

    def reset(self, *, seed: Any) -> tuple[Tensor, dict[str, Tensor]]:
        self.resets.append(seed)
        seeds = [seed] if isinstance(seed, int) else seed
        self.x = torch.tensor([0.1 * (s % 5) for s in seeds])
        self.elapsed = 0
        return self._observe()

    def step(self, actions: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Tensor]]:
        self.x = self.x + actions[:, 0]
        self.elapsed += 1
        observations, info = self._observe()
        truncated = torch.full((self.num_envs,), self.elapsed >= HORIZON)
        return observations, info["visible_fraction"] - 0.5, info["success"], truncated, info

    def close(self) -> None:
        pass

    def _observe(self) -> tuple[Tensor, dict[str, Tensor]]:
        observations = torch.zeros(self.num_envs, 9)
        observations[:, 0] = self.x
        observations[:, 6:] = torch.tensor([0.8, 0.2, 0.7])
        return observations, {
            "visible_fraction": self.x.clone(),
            "success": self.x > 0.85,
            "reachability": torch.full((self.num_envs,), self.elapsed % 3),
            "in_forbidden_zone": torch.full((self.num_envs,), self.elapsed == 2),
        }


class Forward:
    """Moves by a fifth along x."""

    def act(self, observations: Tensor) -> Tensor:
        return torch.tensor([0.2, 0, 0, 0, 0, 0]).expand(len(observations), 6)


def run(num_envs: int, episodes: int, seed: int = 3) -> list[EpisodeRecord]:
    return run_episodes(cast(gym.Env[Any, Any], SeededTask(num_envs)), Forward(), episodes, seed)


def episode(visible: list[float], success: bool, seed: int = 0, reach: int = 0) -> EpisodeRecord:
    """An episode that walks along x by 0.1 m a step."""
    steps = len(visible) - 1
    viewpoints = np.zeros((steps + 1, 6))
    viewpoints[:, 0] = 0.1 * np.arange(steps + 1)
    viewpoints[:, 4] = math.pi / 2
    return EpisodeRecord(
        seed=seed,
        success=success,
        viewpoints=viewpoints,
        target=np.tile([0.8, 0.2, 0.7], (steps + 1, 1)),
        visible_fraction=np.array(visible),
        rewards=np.array(visible[1:]) - 0.1,
        reachability=np.full(steps, reach),
        in_forbidden_zone=np.zeros(steps, dtype=np.bool_),
        decision_ms=np.ones(steps),
    )


EPISODES = [
    episode([0.0, 0.4, 0.9], True, seed=5),
    episode([0.3, 0.86], True, seed=6),
    episode([0.2, 0.6, 0.1, 0.0], False, seed=7, reach=2),
]


def test_episode_i_starts_from_seed_plus_i_and_is_recorded_until_it_ends() -> None:
    episodes = run(1, 3)
    assert [e.seed for e in episodes] == [3, 4, 5]
    first = episodes[0]  # x: 0.3, 0.5, 0.7, 0.9.
    np.testing.assert_allclose(first.visible_fraction, [0.3, 0.5, 0.7, 0.9], atol=1e-6)
    np.testing.assert_allclose(first.viewpoints[:, 0], [0.3, 0.5, 0.7, 0.9], atol=1e-6)
    np.testing.assert_allclose(first.rewards, [0.0, 0.2, 0.4], atol=1e-6)
    assert first.reachability.tolist() == [1, 2, 0]
    assert first.in_forbidden_zone is not None
    assert first.in_forbidden_zone.tolist() == [False, True, False]
    assert (first.steps, first.success) == (3, True)
    assert first.max_visible_fraction == pytest.approx(0.9)
    assert first.path_length == pytest.approx(0.6)
    np.testing.assert_allclose(first.target, np.tile([0.8, 0.2, 0.7], (4, 1)), atol=1e-6)


def test_parallel_environments_give_the_same_episodes() -> None:
    for one, other in zip(run(1, 7), run(3, 7), strict=True):
        assert (one.seed, one.success, one.steps) == (other.seed, other.success, other.steps)
        np.testing.assert_array_equal(one.visible_fraction, other.visible_fraction)
        np.testing.assert_array_equal(one.rewards, other.rewards)


def test_the_horizon_ends_an_episode_without_success() -> None:
    class Still:
        def act(self, observations: Tensor) -> Tensor:
            return torch.zeros(len(observations), 6)

    (only,) = run_episodes(cast(gym.Env[Any, Any], SeededTask(1)), Still(), 1, 0)
    assert (only.success, only.steps) == (False, HORIZON)


@pytest.mark.parametrize(("episodes", "seed"), [(0, 0), (-1, 0), (1, -1), (10, 2**31 - 5)])
def test_impossible_numbers_of_episodes_and_seeds_are_refused(episodes: int, seed: int) -> None:
    with pytest.raises(InvalidInputError, match="must be"):
        run(1, episodes, seed)


def test_metrics_by_hand(tmp_path: Path) -> None:
    metrics = make_metrics(
        "Task-v1",
        EPISODES,
        seed=5,
        success_threshold=0.85,
        policy={"path": "p"},
        wall_seconds=1.0,
        baseline=EPISODES[2:],
    )
    write_json(tmp_path / "deep/metrics.json", metrics)
    read = json.loads((tmp_path / "deep/metrics.json").read_text())
    assert (read["env_id"], read["episodes"], read["seed"]) == ("Task-v1", 3, 5)
    assert read["success_rate"] == pytest.approx(2 / 3)
    assert read["mean_steps"] == pytest.approx((2 + 1 + 3) / 3)
    assert read["mean_steps_success"] == pytest.approx(1.5)
    assert read["mean_max_visible_fraction"] == pytest.approx((0.9 + 0.86 + 0.6) / 3)
    assert read["mean_initial_visible_fraction"] == pytest.approx((0.0 + 0.3 + 0.2) / 3)
    assert read["mean_final_visible_fraction"] == pytest.approx((0.9 + 0.86 + 0.0) / 3)
    assert read["mean_return"] == pytest.approx((0.3 + 0.8 + 0.76 + 0.5 + 0.0 - 0.1) / 3)
    assert read["mean_path_length_m"] == pytest.approx((0.2 + 0.1 + 0.3) / 3)
    assert read["unreachable_step_share"] == pytest.approx(3 / 6)
    assert read["success_rate_within_steps"] == pytest.approx(
        {"1": 1 / 3, "3": 2 / 3, "5": 2 / 3, "10": 2 / 3}
    )
    assert read["per_episode"]["seed"] == [5, 6, 7]
    assert read["per_episode"]["success"] == [True, True, False]
    assert read["per_episode"]["steps"] == [2, 1, 3]
    assert read["random_actions"]["success_rate"] == 0.0
    assert read["random_actions"]["mean_steps_success"] is None


def test_the_start_view_does_not_count_as_the_largest() -> None:
    assert summarise([episode([0.99, 0.1, 0.2], False)])["mean_max_visible_fraction"] == pytest.approx(0.2)


def test_trajectories_can_be_taken_apart_again(tmp_path: Path) -> None:
    write_trajectories(tmp_path / "t.npz", EPISODES)
    with np.load(tmp_path / "t.npz") as data:
        starts = [*data["first_view"].tolist(), len(data["viewpoints"])]
        for index, expected in enumerate(EPISODES):
            part = slice(starts[index], starts[index + 1])
            np.testing.assert_array_equal(data["viewpoints"][part], expected.viewpoints)
            np.testing.assert_array_equal(data["visible_fraction"][part], expected.visible_fraction)
        assert data["seed"].tolist() == [5, 6, 7]


def test_moving_averages_by_hand() -> None:
    np.testing.assert_allclose(moving_average([1, 2, 3, 6], 2), [1.5, 2.5, 4.5])
    np.testing.assert_allclose(moving_average([1, 2, 3, 6], 4), [3.0])
    np.testing.assert_allclose(moving_average([1, 2], 12), [1.5])
    assert len(moving_average([], 3)) == 0
    values = np.random.default_rng(0).normal(size=200)
    plain = [values[i : i + 75].mean() for i in range(126)]
    np.testing.assert_allclose(moving_average(values, 75), plain, atol=1e-12)


def test_default_windows_are_those_of_the_guided_thesis_run() -> None:
    assert default_windows(240, 1278) == (12, 75)


def make_history(folder: Path, steps: int) -> Path:
    history = TrainingHistory(1)
    for step in range(1, steps + 1):
        history.add_loss(1.0 / step)
        history.add_step(step, [0.01 * step], [0.5], [False], [step % 10 == 0])
    history.save(folder)
    return folder


def test_every_plot_is_a_picture_with_something_on_it(tmp_path: Path) -> None:
    curves = load_history(make_history(tmp_path, 300))
    plot_training_curves(curves, tmp_path / "curves.png", (3, 20))
    plot_training_curves(load_history(make_history(tmp_path, 3)), tmp_path / "short.png")
    plot_steps(EPISODES, tmp_path / "steps.png")
    plot_visible_fraction(EPISODES, 0.85, tmp_path / "visible.png")
    plot_trajectories(EPISODES, "some", tmp_path / "ways.png")
    plot_trajectories(EPISODES[:1], "one", tmp_path / "way.png")
    for name in ("curves", "short", "steps", "visible", "ways", "way"):
        picture = imageio.imread(tmp_path / f"{name}.png")[..., :3]
        assert picture.shape[1] == 1350
        assert len(np.unique(picture.astype(np.int32) @ (1 << 16, 1 << 8, 1))) > 20


def report(tmp_path: Path, **changes: Any) -> str:
    metrics = make_metrics("Task-v1", EPISODES, seed=5, success_threshold=0.85, policy={}, wall_seconds=1.0)
    plot_steps(EPISODES, tmp_path / "steps.png")
    options: dict[str, Any] = {
        "title": "A <report>",
        "metrics": metrics,
        "evaluation": [ReportPicture(path=tmp_path / "steps.png", caption="Steps & more")],
    }
    write_report(tmp_path / "report.html", ReportInput(**(options | changes)))
    return (tmp_path / "report.html").read_text()


def test_the_report_needs_no_other_file_for_its_pictures(tmp_path: Path) -> None:
    (tmp_path / "video.mp4").write_bytes(b"film")
    page = report(tmp_path, video=tmp_path / "video.mp4", policy=tmp_path / "run/policy.pt")
    assert "A &lt;report&gt;" in page and "Steps &amp; more" in page and "<svg" in page
    assert set(re.findall(r'src="([^"]{0,15})', page)) == {"data:video/mp4;"}
    assert not re.search(r"(src|href)=.(https?:|//|/)", page)
    assert 'href="video.mp4"' in page and "<dd>run/policy.pt</dd>" in page
    assert "67%" in page and "95 % interval 21% to 94%" in page and page.count("n = 3 episodes") >= 5


def test_the_report_says_what_was_left_out(tmp_path: Path) -> None:
    assert 'class="notice"' not in report(tmp_path)
    page = report(tmp_path, left_out="no pictures; run `make vulkan`")
    assert "no pictures; run `make vulkan`" in page
    assert "<video" not in page


def test_without_vulkan_an_evaluation_still_reports_and_names_the_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Task(SeededTask):
        task = SimpleNamespace(full_visibility=0.85)

    monkeypatch.setattr(evaluation, "make_env", lambda env_id, num_envs, **options: Task(1))
    monkeypatch.setattr(evaluation, "find_policy", lambda policy, env_id: "forward")
    monkeypatch.setattr(evaluation, "open_policy", lambda policy, **options: as_policy(Forward()))
    monkeypatch.setattr(vulkan_probe, "render_backend", lambda: "none")
    # Without its memory of an answer that an earlier test got.
    monkeypatch.setattr(vulkan_probe, "_ask_for_a_picture", vulkan_probe._ask_for_a_picture.__wrapped__)
    monkeypatch.setenv("VK_DRIVER_FILES", "/nonexistent")
    monkeypatch.setenv("VK_ICD_FILENAMES", "/nonexistent")
    config = EvaluationConfig(
        env_id="TomatoViewpointGuided-v1",
        policy="forward",
        episodes=4,
        seed=0,
        out=tmp_path,
        show_progress=False,
    )
    result = evaluation.evaluate(config)
    assert result.origin == "Forward"
    assert result.video is None
    assert result.left_out is not None and "make vulkan" in result.left_out
    assert "make vulkan" in result.report.read_text()
    assert json.loads((tmp_path / "metrics.json").read_text())["success_rate"] == 1.0
    assert not list(tmp_path.glob("*.mp4"))


@pytest.mark.parametrize("reseeds", [True, False])
def test_an_episode_of_random_actions_is_the_same_by_itself_as_after_others(reseeds: bool) -> None:
    class Draws:
        """Random actions, seeded anew for every episode or not."""

        def __init__(self) -> None:
            self._random = np.random.default_rng(0)
            if reseeds:
                self.reseed = self._begin_anew

        def _begin_anew(self, seed: int) -> None:
            self._random = np.random.default_rng(seed)

        def act(self, observations: Tensor) -> Tensor:
            return torch.from_numpy(self._random.uniform(-0.05, 0.2, (len(observations), 6))).float()

    def rewards(first: int, count: int) -> list[float]:
        env = cast("gym.Env[Any, Any]", SeededTask(1))
        return [float(e.rewards.sum()) for e in run_episodes(env, as_policy(Draws()), count, first)]

    assert (rewards(3, 1)[0] == rewards(1, 3)[2]) == reseeds
