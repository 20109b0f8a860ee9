import pytest
import torch

from maniskill_tomato.learning.exploration import (
    Autoregressive,
    DecayingGaussian,
    EpsilonGreedy,
    decaying_schedule,
    epsilon_greedy_schedule,
    make_exploration,
)
from maniskill_tomato.learning.presets import PRESETS, get_preset

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
    actions = noise.explore(policy, 0, NEVER)
    explored = (actions != 0.9).any(dim=1)
    assert explored.float().mean().item() == pytest.approx(0.7, abs=0.03)  # Four standard deviations.
    for index, name in enumerate(ACTION_ORDER):
        low, high = EQUATION_5_6[name]
        column = actions[explored, index]
        assert low <= column.min() < low + 0.01 * (high - low) + 1e-3
        assert high >= column.max() > high - 0.01 * (high - low) - 1e-3
        assert column.mean().item() == pytest.approx((low + high) / 2, abs=0.03 * (high - low))


def test_a_row_explores_as_a_whole_or_not_at_all() -> None:
    actions = EpsilonGreedy(1200, ONES, generator()).explore(torch.full((4000, 6), 0.9), 0, NEVER)
    changed = actions != 0.9
    assert (changed.all(dim=1) | ~changed.any(dim=1)).all()


def test_epsilon_greedy_follows_the_policy_at_the_end() -> None:
    policy = torch.rand(4000, 6)
    torch.testing.assert_close(EpsilonGreedy(1200, ONES, generator()).explore(policy, 2800, NEVER), policy)


def test_random_actions_keep_their_metres_with_another_action_scale() -> None:
    scale = (0.5, 0.5, 0.25, 0.5, 0.5, 0.5)
    actions = EpsilonGreedy(1200, scale, generator()).explore(torch.zeros(4000, 6), 0, NEVER) * torch.tensor(
        scale
    )
    assert actions[:, 1].min().item() == pytest.approx(-0.2, abs=0.005)
    assert actions[:, 3].max().item() == pytest.approx(0.43, abs=0.005)


def test_decaying_noise_has_the_standard_deviation_of_the_thesis() -> None:
    noise = DecayingGaussian(1800, 0.1, generator())
    policy = torch.full((4000, 6), 0.2)
    for step, deviation in ((0, 0.1), (900, 0.05), (1800, 0.0)):
        difference = noise.explore(policy, step, NEVER) - policy
        assert difference.std().item() == pytest.approx(deviation, rel=0.03, abs=1e-8)
        assert difference.mean().item() == pytest.approx(0.0, abs=0.003)


def test_decaying_noise_stays_within_the_action_space() -> None:
    actions = DecayingGaussian(1800, 0.1, generator()).explore(torch.ones(4000, 6), 0, NEVER)
    assert actions.max() == 1.0


@pytest.mark.parametrize("name", PRESETS)
def test_every_environment_and_every_axis_gets_its_own_noise(name: str) -> None:
    noise = make_exploration(get_preset(name), generator())
    starts = torch.zeros(4000, dtype=torch.bool)
    actions = noise.explore(torch.zeros(4000, 6), 0, starts)
    moved = actions[(actions != 0).any(dim=1)]
    assert len(torch.unique(moved, dim=0)) == len(moved)
    correlation = torch.corrcoef(moved.T) - torch.eye(6)
    assert correlation.abs().max() < 0.1


def test_autoregressive_noise_has_its_deviation_and_correlation() -> None:
    noise = Autoregressive(10**9, 0.2, 0.2, 0.8, warmup_steps=0, generator=generator())
    samples = torch.stack([noise.explore(torch.zeros(4000, 6), k, NEVER) for k in range(3)])
    for sample in samples:
        assert sample.std().item() == pytest.approx(0.2, rel=0.03)
    for lag in (1, 2):
        pair = torch.corrcoef(torch.stack((samples[0].flatten(), samples[lag].flatten())))
        assert pair[0, 1].item() == pytest.approx(0.8**lag, abs=0.02)


def test_autoregressive_noise_forgets_at_the_start_of_an_episode() -> None:
    noise = Autoregressive(10**9, 0.2, 0.2, 0.99, warmup_steps=0, generator=generator())
    first = noise.explore(torch.zeros(4000, 6), 0, NEVER)
    starts = torch.arange(4000) < 2000
    second = noise.explore(torch.zeros(4000, 6), 1, starts)
    new = torch.corrcoef(torch.stack((first[:2000].flatten(), second[:2000].flatten())))[0, 1]
    kept = torch.corrcoef(torch.stack((first[2000:].flatten(), second[2000:].flatten())))[0, 1]
    assert abs(new) < 0.05
    assert kept > 0.95


def test_autoregressive_noise_falls_linearly_to_its_end() -> None:
    noise = Autoregressive(1000, 0.5, 0.1, 0.0, warmup_steps=0)
    assert [noise.amount(k) for k in (0, 500, 1000, 2000)] == pytest.approx([0.5, 0.3, 0.1, 0.1])


def test_warm_up_keeps_one_direction_for_an_episode_and_does_not_ask_the_policy() -> None:
    noise = Autoregressive(1000, 0.0, 0.0, 0.0, warmup_steps=10, generator=generator())
    policy = torch.full((4000, 6), 0.123)
    first, second = noise.explore(policy, 0, NEVER), noise.explore(policy, 9, NEVER)
    torch.testing.assert_close(first, second)
    assert first.min() < -0.99 and first.max() > 0.99
    third = noise.explore(policy, 9, torch.arange(4000) < 2000)
    torch.testing.assert_close(third[2000:], first[2000:])
    assert (third[:2000] != first[:2000]).any(dim=1).all()
    torch.testing.assert_close(noise.explore(policy, 10, NEVER), policy)
