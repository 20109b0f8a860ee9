"""The view-quality policy: features, network, search, data, training, files, and its evaluation."""

import itertools
import json
import math
from collections.abc import Iterator
from dataclasses import astuple
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from maniskill_tomato.cli import main
from maniskill_tomato.errors import CheckpointError, InvalidInputError, PolicyError
from maniskill_tomato.experiments.metrics import summarise
from maniskill_tomato.experiments.rollout import run_episode, run_episodes
from maniskill_tomato.learning.rl.envs import make_env
from maniskill_tomato.learning.view_quality.quality_config import FitConfig, QualityTrainConfig
from maniskill_tomato.learning.view_quality.quality_episodes import QualityData, collect_episodes
from maniskill_tomato.learning.view_quality.quality_fit import fit, fit_blend, judge, mirrored
from maniskill_tomato.learning.view_quality.quality_training import train_view_quality
from maniskill_tomato.policies.adapters import as_state_policy
from maniskill_tomato.policies.followed_ways import WayFollower
from maniskill_tomato.policies.moves import move_towards, moves_needed
from maniskill_tomato.policies.next_best_view import NextBestView
from maniskill_tomato.policies.opening import open_policy
from maniskill_tomato.policies.quality_blend import Blend, blend_terms
from maniskill_tomato.policies.quality_features import FEATURES, MAP_CHANNELS, SCALARS, quality_features
from maniskill_tomato.policies.quality_network import Judgement, ViewQualityNetwork
from maniskill_tomato.policies.view_quality import (
    ViewQuality,
    ViewQualityConfig,
    load_view_quality,
    new_network,
    save_view_quality,
)
from maniskill_tomato.robot.look_at import look_at_pose
from maniskill_tomato.sensing.belief import Belief
from maniskill_tomato.sensing.view_lattice import AZIMUTHS, DISTANCES, ELEVATIONS

ONE = torch.zeros(1, dtype=torch.int64)
PLANT = {"seed": 7, "row": False, "leaf_density": 1.2}


@pytest.fixture(scope="module")
def env() -> Iterator[Any]:
    env = make_env("TomatoViewpoint-v1", plant=PLANT)
    yield env
    env.close()


@pytest.fixture
def belief(env: Any) -> Belief:
    env.reset(seed=3)
    env.step(torch.tensor([[0.6, 0.3, 0.0]]))
    return env.unwrapped.belief  # type: ignore[no-any-return]


class Oracle(ViewQualityNetwork):
    """Says what it is told."""

    def __init__(self, full: Tensor, touch: Tensor) -> None:
        super().__init__(MAP_CHANNELS, SCALARS, DISTANCES, width=4, blocks=1)
        shape = (1, AZIMUTHS, ELEVATIONS, DISTANCES)
        self._full, self._touch = (torch.logit(p, eps=1e-6).view(shape) for p in (full, touch))

    def forward(self, maps: Tensor, scalars: Tensor) -> Judgement:
        return Judgement(self._full, self._full.sigmoid(), self._touch)


def told(
    belief: Belief,
    full: dict[int, float],
    touch: dict[int, float] | None = None,
    *,
    patience: float = 16.0,
    touch_cost: float = 0.0,
) -> ViewQuality:
    """A policy that believes these candidates to be good, and no other; and that the arm touches the plant at these."""
    values = torch.zeros(2, belief.lattice.size)
    for row, probability in zip(values, (full, touch or {}), strict=True):
        for k, p in probability.items():
            row[k] = p
    policy = ViewQuality(Oracle(*values), ViewQualityConfig(patience=patience, touch_cost=touch_cost))
    policy.begin(belief, ONE)
    return policy


def by_distance(belief: Belief) -> list[int]:
    """The candidates that the arm gets to, but not in one move, nearest first."""
    assert belief.qpos is not None
    goals = belief.lattice.positions(belief.target_position)[0]
    now = (belief.qpos, belief.camera_position, belief.target_position)
    qpos, position, target = (row.expand(len(goals), -1) for row in now)
    moves = WayFollower().moves_along(qpos, position, target, goals)
    way = (goals - belief.camera_position).norm(dim=-1)
    gets_there = belief.reachable[0] & (moves == moves_needed(way))
    return [k for k in way.argsort().tolist() if bool(gets_there[k]) and float(way[k]) > 0.13]


# ---------------------------------------------------------------- features


def measured_nearby(belief: Belief, position: Tensor) -> list[float]:
    """How alike the most similar of two views is, by 8 degrees and 0.1 m, times its V_f, and that itself."""
    target = belief.target_position[0]
    alike = []
    for visit, fraction in zip(belief.memory.visited[0, :2], belief.memory.fractions[0, :2], strict=True):
        there, taken = position - target, visit - target
        angle = math.degrees(math.acos(min(float(there @ taken / (there.norm() * taken.norm())), 1.0)))
        gap = float(there.norm() - taken.norm())
        alike.append((math.exp(-0.5 * ((angle / 8.0) ** 2 + (gap / 0.1) ** 2)), float(fraction)))
    weight, fraction = max(alike)
    return [weight * fraction, weight]


def test_features_are_those_of_each_candidate(belief: Belief) -> None:
    maps, scalars = quality_features(belief)
    assert maps.shape == (1, MAP_CHANNELS, AZIMUTHS, ELEVATIONS) and scalars.shape == (1, SCALARS)
    table = maps.view(len(FEATURES), DISTANCES, AZIMUTHS, ELEVATIONS)
    target, camera = belief.target_position[0], belief.camera_position[0]
    for a, e, d in ((0, 0, 0), (6, 4, 1), (12, 8, 3), (3, 5, 2)):
        k = int(belief.lattice.index(a, e, d))
        position = target + belief.lattice.offsets[k]
        expected, unknown = belief.memory.predict(position[None, None])[0, 0]
        gaps = [float((position - v).norm()) for v in belief.memory.visited[0, :2]]
        wanted = [
            float(expected),
            float(unknown),
            math.exp(-((min(gaps) / 0.06) ** 2)),
            float(belief.reachable[0, k]),
            float((position - camera).norm()) / 1.2,
            *measured_nearby(belief, position),
        ]
        torch.testing.assert_close(table[:, d, a, e], torch.tensor(wanted), rtol=1e-4, atol=1e-5)


def test_scalars_tell_where_the_camera_and_the_target_are(belief: Belief) -> None:
    _, scalars = quality_features(belief)
    offset = belief.camera_position[0] - belief.target_position[0]
    distance = float(offset.norm())
    middle, half = torch.tensor([0.7, 0.0, 0.8]), torch.tensor([0.5, 0.5, 0.6])
    wanted = torch.cat(
        [
            belief.visible_fraction,
            torch.tensor([distance]),
            offset / distance,
            (belief.target_position[0] - middle) / half,
            torch.tensor([19 / 20]),
        ]
    )
    torch.testing.assert_close(scalars[0], wanted)


def test_a_mirror_image_exchanges_left_and_right_and_nothing_else() -> None:
    maps, scalars = torch.randn(3, MAP_CHANNELS, AZIMUTHS, ELEVATIONS), torch.randn(3, SCALARS)
    flip = torch.tensor([True, False, True])
    there, numbers = mirrored(maps, scalars, flip)
    torch.testing.assert_close(there[0, :, 0], maps[0, :, -1])
    torch.testing.assert_close(there[1], maps[1])
    assert numbers[0, 3] == -scalars[0, 3] and numbers[0, 6] == -scalars[0, 6]
    assert numbers[0, 0] == scalars[0, 0] and numbers[1, 3] == scalars[1, 3]
    back, same = mirrored(there, numbers, flip)
    torch.testing.assert_close(back, maps)
    torch.testing.assert_close(same, scalars)


# ------------------------------------------------------------------ search


def test_the_policy_moves_towards_the_one_good_view(belief: Belief) -> None:
    k = by_distance(belief)[20]
    action = told(belief, {k: 0.9}).act(belief)
    goal = belief.lattice.positions(belief.target_position)[:, k]
    wanted = move_towards(belief.camera_position, belief.target_position, goal)
    torch.testing.assert_close(action, wanted)


def test_patience_decides_between_a_near_guess_and_a_far_certainty(belief: Belief) -> None:
    order = by_distance(belief)
    near, far = order[0], order[-1]
    goals = belief.lattice.positions(belief.target_position)[0]
    for patience, chosen in ((2.0, near), (200.0, far)):
        action = told(belief, {near: 0.5, far: 1.0}, patience=patience).act(belief)
        wanted = move_towards(belief.camera_position, belief.target_position, goals[None, chosen])
        torch.testing.assert_close(action, wanted)


def test_the_cost_of_a_touch_decides_between_a_near_view_and_one_that_touches_nothing(belief: Belief) -> None:
    order = by_distance(belief)
    near, far = order[0], order[-1]
    goals = belief.lattice.positions(belief.target_position)[0]
    way = (goals - belief.camera_position).norm(dim=-1)
    more = float(moves_needed(way[far]) - moves_needed(way[near]))
    for cost, chosen in (
        (2.0 * more - 0.2, near),
        (2.0 * more + 0.2, far),
    ):  # Of a touch that is half certain.
        action = told(belief, {near: 0.9, far: 0.9}, {near: 0.5}, touch_cost=cost).act(belief)
        wanted = move_towards(belief.camera_position, belief.target_position, goals[None, chosen])
        torch.testing.assert_close(action, wanted)


def test_log_odds_of_network_and_memory_are_weighed_term_by_term(belief: Belief) -> None:
    maps, scalars = quality_features(belief)
    network = new_network(8, 1)
    full = network(maps, scalars).full.detach()
    blended = Blend(0.5, 0.4, -0.3, -2.0, 0.1).log_odds(maps, full)[0]
    table = maps.view(len(FEATURES), DISTANCES, AZIMUTHS, ELEVATIONS)
    assert float(table[FEATURES.index("alike")].max()) > 0.4
    for a, e, d in itertools.product(range(AZIMUTHS), range(ELEVATIONS), range(DISTANCES)):
        feature = {name: float(table[i, d, a, e]) for i, name in enumerate(FEATURES)}
        expected = (1.0 - feature["alike"]) * feature["expected"] + feature["measured"]
        expected = min(max(expected, 0.01), 0.99)
        wanted = (
            0.5 * float(full[0, a, e, d])
            + 0.4 * math.log(expected / (1.0 - expected))
            - 0.3 * feature["unknown"]
            - 2.0 * feature["alike"]
            + 0.1
        )
        assert float(blended[int(belief.lattice.index(a, e, d))]) == pytest.approx(wanted, abs=1e-4)
    torch.testing.assert_close(Blend().log_odds(maps, full), full.flatten(1))


def test_views_out_of_reach_are_not_chosen(belief: Belief) -> None:
    outside = int((~belief.reachable[0]).nonzero()[0, 0])
    k = by_distance(belief)[5]
    action = told(belief, {outside: 1.0, k: 0.6}).act(belief)
    goal = belief.lattice.positions(belief.target_position)[:, k]
    wanted = move_towards(belief.camera_position, belief.target_position, goal)
    torch.testing.assert_close(action, wanted)


def test_a_view_towards_which_the_arm_did_not_move_is_given_up(belief: Belief) -> None:
    order = by_distance(belief)
    policy = told(belief, {order[4]: 0.9, order[9]: 0.8}, patience=1000.0)
    goals = belief.lattice.positions(belief.target_position)
    for chosen in (order[4], order[9]):  # The camera stays where it is.
        wanted = move_towards(belief.camera_position, belief.target_position, goals[:, chosen])
        torch.testing.assert_close(policy.act(belief), wanted)


def test_settings_out_of_range_are_refused() -> None:
    for value in (0.0, -1.0, math.inf, math.nan):
        with pytest.raises(InvalidInputError, match="patience"):
            ViewQualityConfig(patience=value)
    for value in (-1.0, math.inf, math.nan):
        with pytest.raises(InvalidInputError, match="touch_cost"):
            ViewQualityConfig(touch_cost=value)
    with pytest.raises(InvalidInputError, match="blend"):
        ViewQualityConfig(blend=Blend(network=math.nan))
    with pytest.raises(InvalidInputError, match="blocks"):
        ViewQualityNetwork(4, 4, 4, blocks=0)
    with pytest.raises(InvalidInputError, match="learning_rate"):
        FitConfig(learning_rate=0.0)
    with pytest.raises(InvalidInputError, match="rounds"):
        QualityTrainConfig(rounds=())


# ------------------------------------------------------------ data, training


def test_what_is_collected_is_the_truth(env: Any) -> None:
    data = collect_episodes(env, range(5, 7))
    assert len(data.visible_fraction) == 2 and set(data.episode.tolist()) == {0, 1}
    assert len(data.maps) == len(data.scalars) == len(data.episode)
    env.reset(seed=6)
    belief: Belief = env.unwrapped.belief
    torch.testing.assert_close(data.reachable[1], belief.reachable[0])
    target = belief.target_position[0]
    for k in (100, 250, 400):
        pose = look_at_pose(target + belief.lattice.offsets[k], target)[None]
        truth = float(env.unwrapped.ground_truth.visible_fraction(pose)[0])
        assert float(data.visible_fraction[1, k]) == pytest.approx(truth, abs=1e-3)
    first = data.scalars[data.episode == 1][0]
    torch.testing.assert_close(first, quality_features(belief)[1][0])
    env.reset(seed=5)
    for look in range(int((data.episode == 0).sum())):
        # The scalars tell where the camera stood, and so where it came by the move before.
        if look:
            offset = data.scalars[look, 1] * data.scalars[look, 2:5]
            gaps = (env.unwrapped.belief.lattice.offsets - offset).norm(dim=-1)
            assert data.came_to[look - 1] in (-1, int(gaps.argmin()))
    again = collect_episodes(env, range(5, 7))
    assert torch.equal(again.touched, data.touched) and torch.equal(again.came_to, data.came_to)
    torch.testing.assert_close(again.maps, data.maps, rtol=0.0, atol=0.0)
    joined = QualityData.join([data, again])
    assert joined.episode.max() == 3 and len(joined.maps) == 2 * len(data.maps)


def test_a_camera_that_corrects_the_target_moves_the_candidates_that_are_judged() -> None:
    env: Any = make_env("TomatoViewpoint-v1", plant=PLANT, perception="occlusion_model", target="map")
    world = env.unwrapped
    data = collect_episodes(env, range(3))
    # An episode whose target was located on the way has a table for each belief.
    assert 3 < len(data.visible_fraction) == int(data.episode.max()) + 1 <= 6
    assert bool((data.episode.diff() >= 0).all()) and bool((data.episode.diff() <= 1).all())
    env.reset(seed=0)
    belief = world.belief
    target = belief.target_position[0]
    assert not torch.equal(target, world.target_position_w[0])
    pose = look_at_pose(target + belief.lattice.offsets[250], target)[None]
    truth = float(world.ground_truth.visible_fraction(pose)[0])
    assert float(data.visible_fraction[0, 250]) == pytest.approx(truth, abs=1e-3)
    env.close()


def test_the_network_learns_what_the_maps_tell() -> None:
    """V_f of a candidate is the first feature at it, full views are those above the threshold, and the arm touches
    where the second feature is above 1."""
    generator = torch.Generator().manual_seed(0)
    truth = torch.rand(400, AZIMUTHS, ELEVATIONS, DISTANCES, generator=generator)
    maps = torch.randn(400, MAP_CHANNELS, AZIMUTHS, ELEVATIONS, generator=generator)
    maps[:, :DISTANCES] = truth.permute(0, 3, 1, 2)
    came_to = torch.randint(truth[0].numel(), (400,), generator=generator)
    second = maps[:, DISTANCES : 2 * DISTANCES].permute(0, 2, 3, 1).flatten(1)
    data = QualityData(
        came_to=came_to,
        touched=second.gather(1, came_to[:, None])[:, 0] > 1.0,
        maps=maps.half(),
        scalars=torch.randn(400, SCALARS, generator=generator),
        episode=torch.arange(400),
        visible_fraction=truth.reshape(400, -1).half(),
        reachable=torch.ones(400, AZIMUTHS * ELEVATIONS * DISTANCES, dtype=torch.bool),
    )
    config = FitConfig(steps=300, batch_size=32, learning_rate=1e-2, width=16, blocks=1)
    told: list[int] = []
    network = fit(data, config, data, lambda step, values: told.append(step))
    errors = judge(network, data, 0.8)
    assert told == [200, 300]
    assert errors["squared_error"] < 0.25 / 12  # A quarter of the variance of a uniform number.
    assert errors["cross_entropy"] < 0.5 * 0.5004  # Half the entropy of a fifth: -0.2 ln 0.2 - 0.8 ln 0.8.
    assert errors["touch_entropy"] < 0.8 * 0.438  # Of the 0.159 of a normal number above 1.


def test_the_blend_finds_the_weights_that_made_the_truth(belief: Belief) -> None:
    torch.manual_seed(0)
    generator = torch.Generator().manual_seed(0)
    maps = quality_features(belief)[0].expand(60, -1, -1, -1).clone()
    maps += 0.3 * torch.rand(maps.shape, generator=generator)
    scalars = torch.randn(60, SCALARS, generator=generator)
    network = new_network(8, 1)
    for parameter in network.parameters():
        parameter.data *= 3.0
    wanted = Blend(0.6, 0.3, -0.5, -1.4, -0.2)
    maps = maps.half()
    with torch.no_grad():
        odds = wanted.log_odds(maps.float(), network(maps.float(), scalars).full)
    full = torch.rand(odds.shape, generator=generator) < odds.sigmoid()
    data = QualityData(
        maps=maps,
        scalars=scalars,
        episode=torch.arange(60),
        visible_fraction=full.half(),
        reachable=torch.ones(full.shape, dtype=torch.bool),
        came_to=torch.zeros(60, dtype=torch.int64),
        touched=torch.zeros(60, dtype=torch.bool),
    )
    found = fit_blend(network, data, 0.8)
    # 28,080 candidates; twice the standard error of each weight, by the curvature of the likelihood.
    terms = blend_terms(maps.float(), network(maps.float(), scalars).full).detach().flatten(0, 1).double()
    chance = odds.sigmoid().flatten().double()
    information = terms.T @ (terms * (chance * (1.0 - chance))[:, None])
    errors = information.inverse().diagonal().sqrt()
    gaps = torch.tensor(astuple(found)).double() - torch.tensor(astuple(wanted)).double()
    assert bool((gaps.abs() < 4.0 * errors + 0.02).all()), (found, errors)


def test_a_training_goes_on_where_it_was(tmp_path: Path) -> None:
    config = QualityTrainConfig(
        rounds=(2, 2),
        block=1,
        episodes_a_plant=1,
        validation_episodes=1,
        fit=FitConfig(steps=3, batch_size=4, width=4, blocks=1),
    )
    options = {"plant": {"row": False}}
    lines: list[str] = []
    path = train_view_quality(tmp_path / "run", config, env_options=options, report=lines.append)
    assert sum("blocks)" in line for line in lines) == 5
    content = path.read_bytes()
    (tmp_path / "run" / "round-1.pt").unlink()
    lines.clear()
    assert train_view_quality(tmp_path / "run", config, env_options=options, report=lines.append) == path
    assert not any("blocks)" in line for line in lines)  # No episode was run again.
    assert load_view_quality(path).facts["looks"] > 0 and len(path.read_bytes()) == len(content)
    with pytest.raises(InvalidInputError, match="other settings"):
        train_view_quality(tmp_path / "run", QualityTrainConfig(), env_options=options)


def test_a_training_begins_with_the_network_that_it_is_given(tmp_path: Path) -> None:
    torch.manual_seed(3)
    given = ViewQuality(new_network(4, 1))
    for parameter in given.network.parameters():
        parameter.data += 0.1
    save_view_quality(tmp_path / "given.pt", given)
    config = QualityTrainConfig(
        rounds=(1,),
        block=1,
        episodes_a_plant=1,
        validation_episodes=1,
        fit=FitConfig(steps=1, batch_size=2, learning_rate=1e-9, weight_decay=0.0, width=8, blocks=2),
    )
    arguments: dict[str, Any] = {"env_options": {"plant": {"row": False}}}
    path = train_view_quality(tmp_path / "run", config, start_from=tmp_path / "given.pt", **arguments)
    for a, b in zip(given.network.parameters(), load_view_quality(path).network.parameters(), strict=True):
        torch.testing.assert_close(a, b, atol=1e-6, rtol=0.0)
    with pytest.raises(InvalidInputError, match="other settings"):
        train_view_quality(tmp_path / "run", config, **arguments)
    with pytest.raises(CheckpointError):
        train_view_quality(tmp_path / "other", config, start_from=tmp_path / "missing.pt", **arguments)


@pytest.mark.parametrize("verb", ["train-view-quality", "train-imitation"])
def test_the_command_offers_every_setting(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main([verb, "--help"])
    assert stop.value.code == 0
    told = capsys.readouterr().out
    for flag in ("--jobs", "--rounds", "--fit.learning-rate", "--fit.seed", "--seed", "--env-options"):
        assert flag in told


# ------------------------------------------------------------ files, evaluation


def test_a_saved_policy_says_the_same(belief: Belief, tmp_path: Path) -> None:
    torch.manual_seed(0)
    config = ViewQualityConfig(patience=5.0, touch_cost=2.0, blend=Blend(0.5, 0.4, -0.3, -2.0, 0.1))
    policy = ViewQuality(new_network(8, 1), config, {"env_id": "TomatoViewpoint-v1"})
    save_view_quality(tmp_path / "p.pt", policy)
    loaded = load_view_quality(tmp_path / "p.pt")
    assert loaded.config == policy.config and loaded.facts == policy.facts
    torch.testing.assert_close(loaded.success_probability(belief), policy.success_probability(belief))
    assert isinstance(open_policy(tmp_path / "p.pt", env_id="TomatoViewpointRow-v1"), ViewQuality)
    with pytest.raises(PolicyError, match="Sparse"):
        open_policy(tmp_path / "p.pt", env_id="TomatoViewpointSparse-v1")


def test_files_that_hold_no_such_policy_are_refused(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="no checkpoint at"):
        load_view_quality(tmp_path / "none.pt")
    torch.save({"format": "something"}, tmp_path / "other.pt")
    with pytest.raises(CheckpointError, match="no view-quality policy"):
        load_view_quality(tmp_path / "other.pt")
    (tmp_path / "cut.pt").write_bytes((tmp_path / "other.pt").read_bytes()[:100])
    with pytest.raises(CheckpointError, match="not a readable"):
        load_view_quality(tmp_path / "cut.pt")
    network = new_network(4, 1)
    with torch.no_grad():
        next(network.parameters()).fill_(math.nan)
    save_view_quality(tmp_path / "nan.pt", ViewQuality(network))
    with pytest.raises(CheckpointError, match="not finite"):
        load_view_quality(tmp_path / "nan.pt")


def test_eval_runs_the_same_episodes_as_the_benchmark(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--policy", "nbv", "--episodes", "2", "--seed", "4", "--no-video", "--no-baseline"]
    main(["eval", "TomatoViewpoint-v1", *options, "--out", str(tmp_path), "--episode-list", "validation"])
    assert "success" in capsys.readouterr().out
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    env = make_env("TomatoViewpoint-v1", episodes="validation")
    try:
        episodes = [run_episode(env, NextBestView(), i) for i in (4, 5)]
    finally:
        env.close()
    assert metrics["per_episode"]["steps"] == [e.steps for e in episodes]
    assert metrics["per_episode"]["success"] == [e.success for e in episodes]
    contacts = sum(int(e.contact.sum()) for e in episodes if e.contact is not None) / sum(
        e.steps for e in episodes
    )
    assert metrics["plant_contact_step_share"] == pytest.approx(contacts)


@pytest.mark.parametrize("episodes", [6, pytest.param(20, marks=pytest.mark.slow)])
def test_the_shipped_policy_finds_tomatoes_on_plants_never_seen_before(tmp_path: Path, episodes: int) -> None:
    options = ["--episodes", str(episodes), "--no-video", "--no-baseline", "--episode-list", "held_out"]
    main(["eval", "TomatoViewpoint-v1", *options, "--out", str(tmp_path)])
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["success_rate"] >= 0.9 and metrics["mean_steps"] <= 6.0


def test_without_a_policy_eval_says_how_to_get_one(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("maniskill_tomato.assets.ASSETS_DIR", tmp_path)
    with pytest.raises(SystemExit) as stopped:
        main(["eval", "TomatoViewpoint-v1"])
    told = capsys.readouterr().err
    assert stopped.value.code == 2 and "nbv" in told and "maniskill-tomato train-view-quality" in told


def test_the_evaluation_of_a_row_counts_the_tomatoes_that_were_seen() -> None:
    env: Any = make_env("TomatoViewpointRow-v1", plant={"seed": 7})
    try:
        policy = as_state_policy(open_policy("nbv", env_id="TomatoViewpointRow-v1"), env)
        (episode,) = run_episodes(env, policy, 1, seed=3, show_progress=False)
        env.reset(seed=3)
        info: dict[str, Any] = {}
        steps, done = 0, False
        while not done:
            _, _, terminated, truncated, info = env.step(policy.act(torch.zeros(1, 1)))
            steps, done = steps + 1, bool(terminated) or bool(truncated)
    finally:
        env.close()
    assert episode.row is not None
    seen, wanted = len(episode.row.seen), len(episode.row.targets)
    assert (seen, wanted) == (int(info["seen_count"]), int(info["target_count"]))
    figures = summarise([episode, episode])
    assert 0 < seen <= wanted and figures["target_seen_share"] == pytest.approx(seen / wanted)
    moves = int(info["moves"])
    assert episode.row.moves == moves >= steps == episode.steps
    assert figures["moves_per_seen_target"] == pytest.approx(moves / seen)
