import math
from dataclasses import replace
from typing import Any

import pytest
import torch

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.learning.rl.exploration import (
    CorrelatedNoise,
    DecayingGaussian,
    EpsilonGreedy,
    LookAtGoals,
    decaying_schedule,
    draw_look_at_goals,
    draw_noise_levels,
    epsilon_greedy_schedule,
    make_exploration,
)
from maniskill_tomato.learning.rl.presets import PRESETS, get_preset

EQUATION_5_6 = {
    "dx": (-0.07, 0.1),
    "dy": (-0.2, 0.1),
    "dz": (-0.1, 0.1),
    "dpitch": (-0.17, 0.17),
    "droll": (-0.17, 0.43),
    "dyaw": (-0.17, 0.26),
}
ACTION_ORDER = ("dx", "dy", "dz", "droll", "dpitch", "dyaw")
ONES = (1.0,) * 6
NEVER = torch.zeros(4000, dtype=torch.bool)
SEEN = torch.tensor([0.1, -0.1, 0.9, 0.0, 1.6, 0.2, 0.78, 0.2, 0.73]).expand(4000, 9)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_epsilon_of_the_guided_task_by_hand() -> None:
    assert epsilon_greedy_schedule(0, 1200) == 0.3
    assert epsilon_greedy_schedule(1, 1200) == pytest.approx(0.30025)
    assert epsilon_greedy_schedule(1278, 1200) == pytest.approx(
        0.6195
    )  # "almost 0.6195", thesis section 5-1-1.
    assert epsilon_greedy_schedule(2800, 1200) == pytest.approx(1.0)
    assert epsilon_greedy_schedule(2799, 1200) < 1.0
    assert epsilon_greedy_schedule(100_000, 1200) == 1.0


def test_epsilon_of_the_sparse_task_by_hand() -> None:
    assert decaying_schedule(0, 1800) == 1.0
    assert decaying_schedule(900, 1800) == pytest.approx(0.5)
    assert decaying_schedule(1799, 1800) == pytest.approx(1 / 1800)
    assert decaying_schedule(1800, 1800) == 0.0
    assert decaying_schedule(5000, 1800) == 0.0


def test_random_actions_fill_the_ranges_of_equation_5_6() -> None:
    noise = EpsilonGreedy(1200, ONES, generator())
    policy = torch.full((4000, 6), 0.9)
    actions = noise.explore(policy, SEEN, 0, NEVER)
    explored = (actions != 0.9).any(dim=1)
    assert explored.float().mean().item() == pytest.approx(0.7, abs=0.03)  # Four standard deviations.
    for index, name in enumerate(ACTION_ORDER):
        low, high = EQUATION_5_6[name]
        column = actions[explored, index]
        assert low <= column.min() < low + 0.01 * (high - low) + 1e-3
        assert high >= column.max() > high - 0.01 * (high - low) - 1e-3
        assert column.mean().item() == pytest.approx((low + high) / 2, abs=0.03 * (high - low))


def test_a_row_explores_as_a_whole_or_not_at_all() -> None:
    actions = EpsilonGreedy(1200, ONES, generator()).explore(torch.full((4000, 6), 0.9), SEEN, 0, NEVER)
    changed = actions != 0.9
    assert (changed.all(dim=1) | ~changed.any(dim=1)).all()


def test_epsilon_greedy_follows_the_policy_at_the_end() -> None:
    policy = torch.rand(4000, 6)
    torch.testing.assert_close(
        EpsilonGreedy(1200, ONES, generator()).explore(policy, SEEN, 2800, NEVER), policy
    )


def test_random_actions_keep_their_metres_with_another_action_scale() -> None:
    scale = (0.5, 0.5, 0.25, 0.5, 0.5, 0.5)
    actions = EpsilonGreedy(1200, scale, generator()).explore(
        torch.zeros(4000, 6), SEEN, 0, NEVER
    ) * torch.tensor(scale)
    assert actions[:, 1].min().item() == pytest.approx(-0.2, abs=0.005)
    assert actions[:, 3].max().item() == pytest.approx(0.43, abs=0.005)


def test_decaying_noise_has_the_standard_deviation_of_the_thesis() -> None:
    noise = DecayingGaussian(1800, 0.1, generator())
    policy = torch.full((4000, 6), 0.2)
    for step, deviation in ((0, 0.1), (900, 0.05), (1800, 0.0)):
        difference = noise.explore(policy, SEEN, step, NEVER) - policy
        assert difference.std().item() == pytest.approx(deviation, rel=0.03, abs=1e-8)
        assert difference.mean().item() == pytest.approx(0.0, abs=0.003)


def test_decaying_noise_stays_within_the_action_space() -> None:
    actions = DecayingGaussian(1800, 0.1, generator()).explore(torch.ones(4000, 6), SEEN, 0, NEVER)
    assert actions.max() == 1.0


@pytest.mark.parametrize("name", PRESETS)
def test_every_environment_and_every_axis_gets_its_own_noise(name: str) -> None:
    noise = make_exploration(get_preset(name), generator())
    starts = torch.zeros(4000, dtype=torch.bool)
    actions = noise.explore(torch.zeros(4000, 6), SEEN, 0, starts)
    moved = actions[(actions != 0).any(dim=1)]
    assert len(moved) > 2000
    assert len(torch.unique(moved, dim=0)) > 0.9 * len(moved)  # Some saturate on every axis.
    for axis in range(6):
        assert len(torch.unique(moved[:, axis])) > 100


def look_at_goals(**changes: Any) -> LookAtGoals:
    options: dict[str, Any] = {
        "exploration_steps": 1000,
        "noise": 0.0,
        "noise_end": 0.0,
        "goal_share": 0.0,
        "action_scale": ONES,
        "warmup_steps": 10,
        "generator": generator(),
    }
    return LookAtGoals(**(options | changes))


def test_look_at_noise_falls_linearly_to_its_end() -> None:
    noise = look_at_goals(noise=0.5, noise_end=0.1)
    assert [noise.amount(k) for k in (0, 500, 1000, 2000)] == pytest.approx([0.5, 0.3, 0.1, 0.1])


def test_every_episode_is_led_in_the_warm_up_and_fewer_later() -> None:
    noise = look_at_goals(goal_share=0.2)
    assert [noise.goal_share(k) for k in (0, 9)] == [1.0, 1.0]
    assert [noise.goal_share(k) for k in (500, 1000, 5000)] == pytest.approx([0.6, 0.2, 0.2])
    for step, share in ((0, 1.0), (500, 0.6), (1000, 0.2)):
        starts = torch.ones(4000, dtype=torch.bool)
        policy = torch.full((4000, 6), 0.123)
        led = (look_at_goals(goal_share=0.2).explore(policy, SEEN, step, starts) != policy).any(dim=1)
        assert led.float().mean().item() == pytest.approx(share, abs=0.03)


def test_an_episode_that_is_not_led_follows_the_policy_with_noise() -> None:
    policy = torch.full((4000, 6), 0.2)
    noise = look_at_goals(noise=0.3, noise_end=0.1, warmup_steps=0)
    difference = noise.explore(policy, SEEN, 1000, NEVER) - policy
    assert difference.std().item() == pytest.approx(0.1, rel=0.03)
    assert difference.mean().item() == pytest.approx(0.0, abs=0.003)


def test_a_led_episode_walks_to_its_goal_and_then_to_another() -> None:
    """The steps of one environment, followed by hand: towards one goal until it is near, then towards the next."""
    noise = look_at_goals(action_scale=(0.1,) * 6, warmup_steps=10**9)
    seen = SEEN[:1].clone()
    starts = torch.zeros(1, dtype=torch.bool)
    visited = []
    for step in range(60):
        action = noise.explore(torch.zeros(1, 6), seen, step, starts)
        assert action.abs().max() <= 1.0
        seen[:, :6] += 0.1 * action
        if action.abs().max() < 1.0:
            visited.append(seen[0, :6].clone())
    assert len(visited) >= 2
    assert (visited[0] - visited[-1]).norm() > 0.1
    for viewpoint in visited:
        towards = seen[0, 6:] - viewpoint[:3]
        roll, pitch, yaw = viewpoint[3:].tolist()
        axis = torch.tensor(
            [math.sin(pitch) * math.cos(yaw), math.sin(pitch) * math.sin(yaw), math.cos(pitch)]
        )
        assert roll == pytest.approx(0.0, abs=1e-5)
        assert torch.dot(axis, towards / towards.norm()).item() > 0.99


def test_a_new_episode_gets_a_new_goal() -> None:
    noise = look_at_goals(warmup_steps=10**9)
    first = noise.explore(torch.zeros(4000, 6), SEEN, 0, NEVER)
    far = (first.abs() > 0.25).any(dim=1)  # The others have reached their goal already.
    assert far.float().mean() > 0.9
    same = noise.explore(torch.zeros(4000, 6), SEEN, 1, NEVER)
    torch.testing.assert_close(same[far], first[far])
    started = torch.arange(4000) < 2000
    third = noise.explore(torch.zeros(4000, 6), SEEN, 2, started)
    torch.testing.assert_close(third[far & ~started], first[far & ~started])
    assert (third[started] != first[started]).any(dim=1).all()


def test_goals_lie_on_the_robots_side_within_reach_and_look_at_the_target() -> None:
    targets = torch.tensor([0.78, 0.2, 0.73]) + 0.1 * torch.randn(4000, 3, generator=generator(1))
    goals = draw_look_at_goals(targets, generator())
    position, (_, pitch, yaw) = goals[:, :3], goals[:, 3:].T
    axis = torch.stack((pitch.sin() * yaw.cos(), pitch.sin() * yaw.sin(), pitch.cos()), dim=-1)
    distance = (targets - position).norm(dim=-1)
    torch.testing.assert_close(position + distance[:, None] * axis, targets, rtol=0.0, atol=1e-5)
    assert (position[:, 0] <= targets[:, 0]).all()
    assert 0.25 <= distance.min() and distance.max() <= 0.6 + 1e-6
    shoulder_to_wrist = (position - 0.126 * axis - torch.tensor([0.0, 0.0, 0.36])).norm(dim=-1)
    allowed = (
        (position[:, 0] <= 0.7)
        & (position[:, 2] >= 0.25)
        & (shoulder_to_wrist > 0.45)
        & (shoulder_to_wrist < 0.8)
    )
    assert allowed.float().mean() > 0.98  # Sixteen draws are not always enough.
    assert position[:, 1].std() > 0.1 and position[:, 2].std() > 0.1


def test_noise_levels_are_uniform_each_environments_own_and_last_for_an_episode() -> None:
    starts = torch.ones(20_000, dtype=torch.bool)
    levels = draw_noise_levels(None, starts, 0.1, 0.5, generator())
    assert levels.shape == (20_000, 1)
    assert 0.1 <= levels.min() and levels.max() <= 0.5
    counts = torch.histc(levels, bins=4, min=0.1, max=0.5)
    assert (counts - 5000).abs().max() < 300  # Five standard deviations.
    some = torch.arange(20_000) % 2 == 0
    later = draw_noise_levels(levels, some, 0.1, 0.5, generator(1))
    assert torch.equal(later[~some], levels[~some])
    assert (later[some] != levels[some]).float().mean() > 0.99


@pytest.mark.parametrize("kind", ["decaying-gaussian", "look-at-goals", "correlated"])
def test_every_environment_explores_with_its_own_noise(kind: Any) -> None:
    """Over one long episode the spread of each environment's actions is its level, and it differs between them."""
    config = replace(
        get_preset("td3"),
        exploration=kind,
        exploration_noise=0.3,
        exploration_noise_end=0.02,
        exploration_noise_per_env=True,
        exploration_goal_share=0.0,
        exploration_correlation=0.0,
        exploration_steps=1,
        learning_starts=0,
    )
    noise = make_exploration(config, generator())
    policy, seen = torch.zeros(8, 6), SEEN[:1].expand(8, -1)
    tried = [noise.explore(policy, seen, 10, torch.full((8,), step == 0)) for step in range(400)]
    spread = torch.stack(tried).std(dim=(0, 2))
    levels = noise._levels[:, 0]  # type: ignore[attr-defined]
    torch.testing.assert_close(spread, levels, rtol=0.1, atol=0.0)
    assert levels.std() > 0.03 and levels.min() >= 0.02 and levels.max() <= 0.3
    assert noise.amount(10) == pytest.approx(0.16)


def test_noise_levels_need_noise() -> None:
    with pytest.raises(InvalidInputError, match="needs an exploration with noise"):
        replace(get_preset("thesis-guided"), exploration_noise_per_env=True)


def test_correlated_noise_keeps_its_spread_and_forgets_at_its_rate() -> None:
    noise = CorrelatedNoise(1000, 0.2, 0.1, 0.8, generator())
    policy = torch.zeros(4000, 3)
    tried = torch.stack([noise.explore(policy, SEEN, 0, NEVER) for _ in range(4)])
    torch.testing.assert_close(tried.std(dim=(1, 2)), torch.full((4,), 0.2), rtol=0.02, atol=0.0)
    for lag, wanted in ((1, 0.8), (2, 0.64)):
        pair = torch.stack([tried[0].flatten(), tried[lag].flatten()])
        assert float(torch.corrcoef(pair)[0, 1]) == pytest.approx(wanted, abs=0.02)
    assert [noise.amount(step) for step in (0, 500, 1000, 5000)] == pytest.approx([0.2, 0.15, 0.1, 0.1])


def test_correlated_noise_begins_anew_with_an_episode() -> None:
    noise = CorrelatedNoise(1000, 0.2, 0.2, 0.99, generator())
    starts = torch.arange(4000) < 2000
    first = noise.explore(torch.zeros(4000, 3), SEEN, 0, NEVER)
    second = noise.explore(torch.zeros(4000, 3), SEEN, 0, starts)

    def correlation(rows: slice) -> float:
        return float(torch.corrcoef(torch.stack([first[rows].flatten(), second[rows].flatten()]))[0, 1])

    assert abs(correlation(slice(0, 2000))) < 0.05 and correlation(slice(2000, 4000)) > 0.97
