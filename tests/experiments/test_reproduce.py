"""The thesis's experiments over seeds: definitions, resuming, tables, figure data, all from end to end."""

import dataclasses
import json
import math
import re
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
import pytest
import torch
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments.configs import ReproductionConfig
from maniskill_tomato.experiments.episode_record import EpisodeRecord
from maniskill_tomato.experiments.plots import (
    averaged_curve,
    camera_opacities,
    frustum_faces,
    frustum_points,
    marked_views,
    plot_trajectories,
)
from maniskill_tomato.experiments.reproduction import plan_trials, run_reproduction, untrained_first_steps
from maniskill_tomato.experiments.thesis_figures import (
    episode_to_show,
    most_successful,
    plot_evaluation,
    plot_plant_positions,
)
from maniskill_tomato.experiments.training_runs import find_runs, load_run
from maniskill_tomato.experiments.training_study import SATURATED, ReachCounter, Trial, saturated_share
from maniskill_tomato.experiments.variants import Experiment, experiments, find_variant, variants_of
from maniskill_tomato.learning.rl.agent import make_actor, make_normalizer
from maniskill_tomato.learning.rl.presets import PRESETS, get_preset
from maniskill_tomato.policies.trained_actor import TrainedActor

EXPERIMENTS = experiments()
GUIDED = EXPERIMENTS["guided"]
PARTS_OF_TD3 = [name for name, variant in variants_of(GUIDED).items() if variant.part_of_td3]


def make_episode(seed: int, steps: int, success: bool) -> EpisodeRecord:
    """An episode whose V_f climbs evenly to 0.9 if it is a success, to 0.4 otherwise."""
    rng = np.random.default_rng(seed)
    viewpoints = rng.uniform(-0.2, 0.2, (steps + 1, 6)) + np.array([0.1, 0.0, 0.9, 0.0, math.pi / 2, 0.0])
    return EpisodeRecord(
        seed=seed,
        success=success,
        viewpoints=viewpoints,
        target=np.tile([0.8, 0.1, 0.8], (steps + 1, 1)),
        visible_fraction=np.linspace(0.0, 0.9 if success else 0.4, steps + 1),
        rewards=rng.uniform(size=steps),
        reachability=np.array([2] + [0] * (steps - 1)),
        in_forbidden_zone=np.array([False] * (steps - 1) + [True]),
        decision_ms=np.ones(steps),
    )


def differing_fields(a: Any, b: Any) -> set[str]:
    return {f.name for f in dataclasses.fields(a) if getattr(a, f.name) != getattr(b, f.name)}


@pytest.mark.parametrize("experiment", EXPERIMENTS.values(), ids=lambda e: e.name)
def test_every_variant_changes_what_it_says_and_nothing_else(experiment: Experiment) -> None:
    preset = get_preset(experiment.preset)
    variants = variants_of(experiment)
    assert len(variants) >= 20
    assert find_variant(experiment, "exact").config(experiment.preset) == preset
    for name, variant in variants.items():
        if variant.preset is None:
            changed = differing_fields(variant.config(experiment.preset), preset)
            assert changed <= set(variant.changes), name
            assert changed or name == "exact", name


def test_some_variants_are_for_one_experiment_only() -> None:
    own = [set(variants_of(experiment)) for experiment in EXPERIMENTS.values()]
    assert own[0] - own[1] == {"slow-exploration", "double-episodes"}
    assert own[1] - own[0] == {"slow-exploration-sparse", "wide-noise", "six-fold-episodes"}


@pytest.mark.parametrize("experiment", EXPERIMENTS.values(), ids=lambda e: e.name)
def test_the_parts_lead_from_the_exact_settings_to_td3_and_back(experiment: Experiment) -> None:
    exact, td3 = get_preset(experiment.preset), PRESETS["td3"]
    there = find_variant(experiment, "+".join(PARTS_OF_TD3)).config(experiment.preset)
    assert differing_fields(there, td3) == {"step_cost", "pre_tanh_penalty"}
    back = find_variant(experiment, "td3-without-" + "+".join(PARTS_OF_TD3)).config(experiment.preset)
    assert differing_fields(back, exact) == {"step_cost"}
    assert find_variant(experiment, "td3").config(experiment.preset) == td3


def test_changes_can_be_made_together_and_parts_of_td3_left_out() -> None:
    both = find_variant(GUIDED, "small-actions+gamma-0.9").config(GUIDED.preset)
    assert differing_fields(both, PRESETS["thesis-guided"]) == {"action_scale", "gamma"}
    assert (both.gamma, both.action_scale[0]) == (0.9, 0.35)
    less = find_variant(GUIDED, "td3-without-gamma-0.9+15000-steps").config(GUIDED.preset)
    assert differing_fields(less, PRESETS["td3"]) == {"gamma", "total_episodes", "total_timesteps"}
    assert (less.gamma, less.total_episodes, less.total_timesteps) == (0.99, 240, None)


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("tau-0.005+tau-0.01", "tau-0.01 changes nothing, or what another part changes already"),
        ("gamma-0.9+exact", "exact changes nothing"),
        ("gamma-0.9+td3", "td3 changes nothing"),
        ("gamma-0.9+nonsense", "variant of guided must be one of 'exact'"),
        ("td3-without-double-episodes", "part of td3 must be one of 'small-actions'"),
    ],
)
def test_variants_that_contradict_themselves_are_refused(name: str, problem: str) -> None:
    with pytest.raises(InvalidInputError, match=problem):
        find_variant(GUIDED, name)


def test_the_experiments_have_the_numbers_of_the_thesis() -> None:
    guided, sparse = EXPERIMENTS["guided"], EXPERIMENTS["sparse"]
    for experiment, episodes, buffer, exploration in ((guided, 240, 1000, 1200), (sparse, 500, 1500, 1800)):
        config = find_variant(experiment, "exact").config(experiment.preset)
        assert (config.total_episodes, config.buffer_size) == (episodes, buffer)
        assert config.exploration_steps == exploration
        assert (config.gamma, config.batch_size, config.tau) == (0.99, 32, 0.001)
        assert (config.actor_learning_rate, config.critic_learning_rate) == (1e-4, 1e-3)
    assert guided.windows == (12, 75)
    assert sparse.windows == (30, 180)
    # The thesis's last epsilon, 0.6195, follows from its 1278 steps (Eq. 5-5).
    assert guided.total_steps is not None
    assert 0.3 + 0.3 * guided.total_steps / 1200 == pytest.approx(0.6195)


def test_an_unknown_variant_is_refused_with_the_known_ones() -> None:
    with pytest.raises(InvalidInputError, match="small-actions"):
        find_variant(GUIDED, "big-actions")
    with pytest.raises(InvalidInputError, match="wide-noise"):
        find_variant(EXPERIMENTS["sparse"], "slow-exploration")


@pytest.mark.parametrize("window", [1, 4, 12, 50])
def test_averaged_curves_agree_with_a_plain_loop(window: int) -> None:
    values = np.random.default_rng(0).normal(size=20)
    ends, average = averaged_curve(values, window)
    width = min(window, len(values))
    expected = [(end, sum(values[end - width : end]) / width) for end in range(width, len(values) + 1)]
    assert ends.tolist() == [end for end, _ in expected]
    np.testing.assert_allclose(average, [mean for _, mean in expected], rtol=0, atol=1e-12)


def test_saturated_share_counts_outputs_near_one() -> None:
    config = PRESETS["thesis-guided"]
    actor = make_actor(config, 9, 6)
    with torch.no_grad():
        actor.output.weight.zero_()
        # tanh(3) = 0.995 is saturated, tanh(1.5) = 0.905 is not.
        actor.output.bias.copy_(torch.tensor([3.0, -3.0, 1.5, -1.5, 0.0, 0.0]))
    policy = TrainedActor(
        actor=actor,
        normalizer=make_normalizer(config, 9),
        action_scale=torch.ones(6),
        action_low=-torch.ones(6),
        action_high=torch.ones(6),
        config=config.to_dict(),
        env_id=GUIDED.env_id,
        package_version="0",
        counters={},
    )
    assert math.tanh(1.5) < SATURATED < math.tanh(3.0)
    assert saturated_share(policy, [make_episode(0, 3, True), make_episode(1, 4, False)]) == pytest.approx(
        1 / 3
    )


class ScriptedEnv:
    """A learner's environment whose steps have given outcomes; the last step of an episode resets."""

    num_envs = 1
    single_observation_space = None
    single_action_space = None

    def __init__(self, reachability: list[int], ends: list[bool]) -> None:
        self._script = iter(zip(reachability, ends, strict=True))

    def reset(self, *, seed: int | list[int] | None = None) -> tuple[Tensor, dict[str, Any]]:
        return torch.zeros(1, 9), {}

    def step(self, actions: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        reached, end = next(self._script)
        info: dict[str, Any] = {"reachability": torch.tensor([reached])}
        if end:
            info = {"reachability": torch.tensor([0]), "final_info": info}
        return torch.zeros(1, 9), torch.zeros(1), torch.tensor([end]), torch.tensor([False]), info

    def close(self) -> None:
        pass


def test_reach_is_counted_in_the_step_that_ends_an_episode_too() -> None:
    env = ReachCounter(ScriptedEnv([0, 1, 2, 2, 0], [False, False, True, True, False]))  # type: ignore[arg-type] # pyright: ignore[reportArgumentType]
    env.reset(seed=0)
    for _ in range(5):
        env.step(torch.zeros(1, 6))
    assert env.counts.tolist() == [2, 1, 2]


def test_the_frustum_is_a_pyramid_around_the_viewing_direction() -> None:
    # Looking along +x from (0, 0, 1): pitch pi/2 turns the tool's z axis there.
    points = frustum_points(np.array([0.0, 0.0, 1.0, 0.0, math.pi / 2, 0.0]), depth=0.2)
    assert points.shape == (5, 3)
    np.testing.assert_allclose(points[1:, 0] - points[0, 0], 0.2, atol=1e-9)
    centre = points[1:].mean(axis=0) - points[0]
    np.testing.assert_allclose(centre, [0.2, 0.0, 0.0], atol=1e-9)
    # 42.5 degrees one way and 4:3 times its tangent the other way.
    half = 0.2 * math.tan(math.radians(42.5) / 2)
    spans = sorted(np.ptp(points[1:], axis=0)[1:])
    np.testing.assert_allclose(spans, [2 * half, 2 * half * 4 / 3], rtol=1e-6)
    assert [face.shape for face in frustum_faces(points)] == [(3, 3)] * 4 + [(4, 3)]


def test_cameras_stand_at_the_first_middle_and_last_view() -> None:
    assert marked_views(make_episode(0, 8, True)) == [0, 4, 8]
    assert marked_views(make_episode(0, 2, True)) == [0, 1, 2]
    assert marked_views(make_episode(0, 1, True)) == [0, 1]
    first, middle, last = camera_opacities(3)
    assert first > last > middle
    assert camera_opacities(2) == [first, last]


def test_the_best_seed_and_the_first_solved_episode_are_shown() -> None:
    failing, mixed = [make_episode(7, 2, False)] * 2, [make_episode(8, 2, False), make_episode(9, 2, True)]
    assert most_successful({0: failing, 4: mixed, 5: mixed}) == 4
    assert episode_to_show(mixed) == 9
    assert episode_to_show(failing) == 7


def test_figures_are_drawn_for_one_seed_and_for_several(tmp_path: Path) -> None:
    episodes = [make_episode(i, 1 + i % 4, i % 2 == 0) for i in range(8)]
    plot_evaluation({0: episodes}, 0.85, "one", tmp_path / "one.png")
    plot_evaluation({s: episodes for s in range(9)}, 0.85, "nine", tmp_path / "nine.png")
    plot_trajectories(episodes, "ways", tmp_path / "ways.png")
    plot_plant_positions(GUIDED, tmp_path / "plants.png")
    for path in tmp_path.glob("*.png"):
        assert path.with_suffix(".svg").is_file()
        assert np.asarray(imageio.imread(path)).std() > 5.0, path.name
    with pytest.raises(InvalidInputError):
        plot_trajectories([], "none", tmp_path / "none.png")


def test_untrained_actors_of_small_scale_move_less() -> None:
    exact = PRESETS["thesis-sparse"]
    still = dataclasses.replace(exact, actor_output_init="small")
    wild = untrained_first_steps(EXPERIMENTS["sparse"].env_id, exact, 8)
    calm = untrained_first_steps(EXPERIMENTS["sparse"].env_id, still, 8)
    assert wild["mean_move_m"] > 0.3 > 0.05 > calm["mean_move_m"] > 0.0
    assert calm["unreachable_share"] < wild["unreachable_share"] <= 1.0
    assert calm["saturated_output_share"] == 0.0


def reproduction(out: Path, **changes: Any) -> ReproductionConfig:
    short = {"seeds": (3,), "episodes": 2, "training_episodes": 2, "untrained": 2, "progress": False}
    return ReproductionConfig(**{"experiment": "guided", "out": out, **short, "views": False, **changes})


def plan(out: Path, variant: str = "small-actions", **changes: Any) -> Trial:
    (trial,) = plan_trials(reproduction(out, **changes), GUIDED, find_variant(GUIDED, variant))
    return trial


def test_a_finished_seed_is_kept_and_other_settings_are_refused(tmp_path: Path) -> None:
    short = plan(tmp_path, ablate=True)
    assert short.result() is None
    first = short.run()
    assert first["training"]["episodes"] == 2
    assert set(first["evaluations"]) == {"training-pose"}
    written = (short.folder / "policy.pt").stat().st_mtime_ns
    again = plan(tmp_path, episodes=3).run()
    assert (short.folder / "policy.pt").stat().st_mtime_ns == written
    assert again["training"] == first["training"]
    assert set(again["evaluations"]) == {"training-pose", "one-tomato", "three-tomatoes"}
    assert again["evaluations"]["training-pose"]["episodes"] == 3
    assert short.run() == short.result() == first
    with pytest.raises(InvalidInputError, match=r"another experiment \(config differ\)"):
        plan(tmp_path, training_episodes=3).run()


def test_a_training_that_was_cut_off_starts_anew(tmp_path: Path) -> None:
    trial = plan(tmp_path, "exact", ablate=True, episodes=1, training_episodes=1)
    first = trial.run()
    (figures,) = (trial.folder / "results" / "training").iterdir()
    figures.unlink()
    assert trial.result() is None
    again = trial.run()
    for result in (first, again):
        for name in ("seconds", "cpu_seconds"):
            result["training"].pop(name)
    assert again == first


def test_a_reproduction_runs_from_end_to_end_and_its_runs_can_be_compared(tmp_path: Path) -> None:
    lines: list[str] = []
    run_reproduction(reproduction(tmp_path, experiment="sparse", seeds=(0, 1)), lines.append)
    folder = tmp_path / "sparse" / "exact"
    assert lines[-3:] == [
        f"summary {folder / 'summary.json'}",
        f"figures {folder / 'figures'}",
        f"report  {folder / 'report.html'}",
    ]
    page = (folder / "report.html").read_text()
    assert page.count("<svg") == 7 and page.count("n = 2 training seeds") >= 8
    assert "exactly Table 5-1 / 5-2" in lines[0]
    figures = {path.name for path in (folder / "figures").glob("*.png")}
    assert figures == {
        "training.png",
        "plants.png",
        "evaluation_training-pose.png",
        "evaluation_three-tomatoes.png",
        "trajectories_training-pose.png",
        "trajectories_three-tomatoes.png",
    }
    summaries = json.loads((folder / "summary.json").read_text())
    assert [s["seed"] for s in summaries] == [0, 1]
    assert set(summaries[0]["evaluations"]) == {"training-pose", "three-tomatoes"}
    for path, summary in zip(find_runs([folder]), summaries, strict=True):
        metrics = load_run(path).metrics
        assert metrics is not None and metrics["policy"]["kind"] == "DDPG"
        assert metrics["success_rate"] == summary["evaluations"]["training-pose"]["success_rate"]


def test_an_ablation_writes_a_table_and_names_unknown_variants(tmp_path: Path) -> None:
    variants = ("exact", "tau-0.01+gamma-0.9")
    run_reproduction(reproduction(tmp_path, ablate=True, variant=variants))
    page = (tmp_path / "guided" / "report.html").read_text()
    rows = re.findall(r'<th scope="row"[^>]*>(.*?)</th>', page)
    assert len(rows) == 2 and rows[1] == "tau 0.01, not 0.001; gamma 0.9, not 0.99"
    assert [path.name for path in tmp_path.rglob("*.png")] == ["success.png"]
    with pytest.raises(InvalidInputError, match="variant of guided must be one of 'exact'"):
        run_reproduction(reproduction(tmp_path, variant=("nonsense",)))
