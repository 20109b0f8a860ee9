"""Categorical critics: the projection and the targets against plain loops and values worked out by hand."""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.learning.rl.agent import distribution_targets, make_agent, update, update_critic
from maniskill_tomato.learning.rl.critic import CategoricalCritic, project
from maniskill_tomato.learning.rl.presets import TrainConfig, get_preset
from maniskill_tomato.learning.rl.replay import Batch

CATEGORICAL = replace(
    get_preset("td3"), critic="categorical", value_atoms=21, value_range=(-2.0, 2.0), target_noise=0.0
)


def projected_in_a_loop(
    probabilities: list[float], atoms: list[float], reward: float, discount: float
) -> list[float]:
    """Algorithm 1 of Bellemare et al. (2017), atom by atom in double precision."""
    low, high, count = atoms[0], atoms[-1], len(atoms)
    spacing = (high - low) / (count - 1)
    result = [0.0] * count
    for p, atom in zip(probabilities, atoms, strict=True):
        place = (min(max(reward + discount * atom, low), high) - low) / spacing
        place = min(max(place, 0.0), count - 1.0)
        below, above = math.floor(place), math.ceil(place)
        if below == above:
            result[below] += p
        else:
            result[below] += p * (above - place)
            result[above] += p * (place - below)
    return result


@pytest.mark.parametrize(("count", "low", "high"), [(2, -1.0, 1.0), (21, -2.0, 2.0), (101, -10.0, 10.0)])
def test_the_projection_is_that_of_a_loop(count: int, low: float, high: float) -> None:
    generator = torch.Generator().manual_seed(count)
    atoms = torch.linspace(low, high, count)
    probabilities = torch.rand(60, count, generator=generator)
    probabilities /= probabilities.sum(dim=-1, keepdim=True)
    rewards = 2.0 * high * (torch.rand(60, generator=generator) - 0.5)  # Some values leave the range.
    discounts = torch.rand(60, generator=generator)
    discounts[::5], discounts[1::5] = 0.0, 1.0
    projected = project(probabilities, atoms, rewards, discounts)
    torch.testing.assert_close(projected.sum(dim=-1), torch.ones(60))
    for i in range(60):
        wanted = projected_in_a_loop(
            probabilities[i].tolist(), atoms.tolist(), float(rewards[i]), float(discounts[i])
        )
        torch.testing.assert_close(projected[i], torch.tensor(wanted), rtol=0.0, atol=2e-5)


@pytest.mark.parametrize(
    ("reward", "discount", "wanted"),
    [
        (0.0, 1.0, [0.2, 0.5, 0.3]),  # Nothing moves.
        (1.0, 1.0, [0.0, 0.2, 0.8]),  # One atom up; the last stays at the end.
        (0.25, 1.0, [0.15, 0.425, 0.425]),  # A quarter of each goes up.
        (0.5, 0.0, [0.0, 0.5, 0.5]),  # A termination: all of it at the reward, between two atoms.
        (0.0, 0.5, [0.1, 0.75, 0.15]),  # Halved: the outer atoms half way inwards.
        (-9.0, 1.0, [1.0, 0.0, 0.0]),  # Far below the range.
        (1.0, 0.0, [0.0, 0.0, 1.0]),
    ],
)
def test_projections_by_hand(reward: float, discount: float, wanted: list[float]) -> None:
    """Atoms -1, 0, 1 with probabilities 0.2, 0.5, 0.3."""
    atoms, probabilities = torch.tensor([-1.0, 0.0, 1.0]), torch.tensor([[0.2, 0.5, 0.3]])
    projected = project(probabilities, atoms, torch.tensor([reward]), torch.tensor([discount]))
    torch.testing.assert_close(projected, torch.tensor([wanted]))


def random_batch(size: int = 32) -> Batch:
    generator = torch.Generator().manual_seed(1)
    return Batch(
        torch.randn(size, 9, generator=generator),
        torch.rand(size, 6, generator=generator) * 2 - 1,
        torch.randn(size, generator=generator),
        torch.randn(size, 9, generator=generator),
        (torch.rand(size, generator=generator) < 0.3).float(),
    )


def critics_of(modules: torch.nn.ModuleList) -> list[CategoricalCritic]:
    found = [critic for critic in modules if isinstance(critic, CategoricalCritic)]
    assert len(found) == len(modules)
    return found


def test_targets_take_the_distribution_of_the_smaller_mean_row_by_row() -> None:
    torch.manual_seed(0)
    agent, batch = make_agent(CATEGORICAL, 9, 6), random_batch()
    with torch.no_grad():
        for parameter in agent.target_critics.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
    targets = distribution_targets(agent, batch)
    first, second = critics_of(agent.target_critics)
    chosen = []
    for i in range(len(targets)):
        s = agent.normalizer(batch.next_observations[i : i + 1])
        a = agent.target_actor(s)
        choices = [critic.logits(s, a).softmax(-1)[0] for critic in (first, second)]
        means = [float((p * first.atoms).sum()) for p in choices]
        chosen.append(means[1] < means[0])
        wanted = projected_in_a_loop(
            choices[chosen[-1]].tolist(),
            first.atoms.tolist(),
            float(batch.rewards[i]),
            CATEGORICAL.gamma * (1.0 - float(batch.terminations[i])),
        )
        torch.testing.assert_close(targets[i], torch.tensor(wanted), rtol=0.0, atol=2e-5)
    assert 0 < sum(chosen) < len(chosen)


def test_the_loss_is_the_cross_entropy_and_the_value_the_mean() -> None:
    torch.manual_seed(0)
    agent, batch = make_agent(CATEGORICAL, 9, 6), random_batch()
    targets = distribution_targets(agent, batch)
    s = agent.normalizer(batch.observations)
    wanted: list[Tensor] = []
    for critic in critics_of(agent.critics):
        p = critic.logits(s, batch.actions).softmax(-1)
        torch.testing.assert_close(critic(s, batch.actions), (p * torch.linspace(-2.0, 2.0, 21)).sum(-1))
        wanted.append(-(targets * p.log()).sum(-1).mean())
    logs = update_critic(agent, batch)
    torch.testing.assert_close(logs["qf1_loss"], wanted[0].detach())
    torch.testing.assert_close(logs["qf2_loss"], wanted[1].detach())
    torch.testing.assert_close(logs["qf_loss"], (wanted[0] + wanted[1]).detach())


def test_a_categorical_agent_finds_the_best_action_of_a_known_reward() -> None:
    torch.manual_seed(0)
    config = replace(CATEGORICAL, value_range=(-6.0, 1.0), normalize_observations="none")
    agent = make_agent(config, 9, 6)
    best = torch.tensor([0.5, -0.5, 0.25, 0.0, -0.25, 0.75])
    generator = torch.Generator().manual_seed(0)
    for index in range(1200):
        s = torch.rand(64, 9, generator=generator)
        a = torch.rand(64, 6, generator=generator) * 2 - 1
        r = -((a - best) ** 2).sum(dim=-1)
        update(agent, Batch(s, a, r, s, torch.ones(64)), index, generator)
    actions = agent.policy(torch.rand(200, 9, generator=generator))
    assert -((actions - best) ** 2).sum(dim=-1).mean() > -0.7  # Random actions get -3.2 on average.


def test_atoms_are_checked() -> None:
    wrong: list[dict[str, Any]] = [
        {"value_atoms": 1},
        {"value_range": (1.0, 1.0)},
        {"value_range": (2.0, -2.0)},
    ]
    for changes in wrong:
        with pytest.raises(InvalidInputError, match="2 or more value_atoms over a rising value_range"):
            TrainConfig(total_timesteps=1, **changes)
    with pytest.raises(
        InvalidInputError, match="critic must be one of 'scalar', 'categorical'; got 'quantile'"
    ):
        TrainConfig(total_timesteps=1, critic="quantile")  # type: ignore[arg-type]
