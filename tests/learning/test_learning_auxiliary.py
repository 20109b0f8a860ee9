"""Auxiliary heads learn what they are asked, and shape the layers below them."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.learning.rl.agent import Agent, make_agent, update
from maniskill_tomato.learning.rl.presets import TrainConfig, get_preset
from maniskill_tomato.learning.rl.replay import Batch, ReplayBuffer

TD3 = replace(get_preset("td3"), normalize_observations="none", actor_hidden=(64, 64), critic_hidden=(64, 64))


def batch(generator: torch.Generator, size: int = 128) -> Batch:
    """Random views whose V_f after the action is a smooth function of both."""
    s = torch.rand(size, 9, generator=generator) - 0.5
    a = torch.rand(size, 6, generator=generator) * 2 - 1
    visible = torch.sigmoid(3.0 * s[:, 0] - 2.0 * a[:, 1] + a[:, 2] * s[:, 7])
    return Batch(s, a, torch.zeros(size), s, torch.ones(size), visible)


def trained(config: TrainConfig, updates: int) -> tuple[Agent, dict[str, float]]:
    torch.manual_seed(0)
    agent = make_agent(config, 9, 6)
    generator = torch.Generator().manual_seed(0)
    logs: dict[str, float] = {}
    for index in range(updates):
        logs |= {
            name: float(value) for name, value in update(agent, batch(generator), index, generator).items()
        }
    return agent, logs


def test_the_heads_learn_the_distance_and_the_next_visible_fraction() -> None:
    config = replace(TD3, aux_distance_weight=1.0, aux_visibility_weight=1.0)
    agent, logs = trained(config, 1500)
    held_out = batch(torch.Generator().manual_seed(99), 500)
    s, a = held_out.observations, held_out.actions
    distance = (s[:, 6:9] - s[:, :3]).norm(dim=-1)
    assert agent.heads.distance is not None and agent.heads.visible_fraction is not None
    predicted = agent.heads.distance(agent.actor.features(s))[:, 0]
    assert (predicted - distance).square().mean() < 0.1 * distance.var()
    assert held_out.visible_fractions is not None
    for critic, head in zip(agent.critics, agent.heads.visible_fraction, strict=True):
        visible = head(critic.features(s, a))[:, 0]  # type: ignore[operator]
        assert (visible - held_out.visible_fractions).square().mean() < 0.1 * held_out.visible_fractions.var()
    assert logs["aux_distance_loss"] < 0.01 and logs["aux_visibility_loss"] < 0.02


def test_weight_zero_leaves_the_training_as_it_is() -> None:
    """With a weight the same seed gives other networks; without, heads and their losses do not exist."""
    plain, logs = trained(TD3, 30)
    assert not list(plain.heads.parameters()) and not any(name.startswith("aux") for name in logs)
    for changes in ({"aux_distance_weight": 0.5}, {"aux_visibility_weight": 0.5}):
        other, _ = trained(replace(TD3, **changes), 30)  # type: ignore[arg-type]
        assert list(other.heads.parameters())
        changed = [not torch.equal(p, q) for p, q in zip(_all(plain), _all(other), strict=True)]
        assert any(changed)


def _all(agent: Agent) -> list[torch.Tensor]:
    return [*agent.actor.parameters(), *agent.critics.parameters()]


def test_each_head_reaches_only_its_own_network() -> None:
    """The error of V_f trains the critics' hidden layers and not the actor's; that of the distance the reverse."""
    torch.manual_seed(0)
    agent = make_agent(replace(TD3, aux_distance_weight=1.0, aux_visibility_weight=1.0), 9, 6)
    data = batch(torch.Generator().manual_seed(0))
    distance = agent.heads.distance_loss(agent.actor.features(data.observations), data.observations)
    visibility = agent.heads.visibility_loss(
        0,
        agent.critics[0].features(data.observations, data.actions),  # type: ignore[operator]
        data,
    )
    actor, critic = list(agent.actor.hidden.parameters()), list(agent.critics[0].hidden.parameters())  # type: ignore[union-attr]
    for loss, near, far in ((distance, actor, critic), (visibility, critic, actor)):
        gradients = torch.autograd.grad(loss, [*near, *far], allow_unused=True)
        assert all(g is not None and g.abs().max() > 0.0 for g in gradients[: len(near)])
        assert all(g is None for g in gradients[len(near) :])


def test_what_cannot_be_predicted_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="aux_distance_weight must be 0 or more, got -1"):
        replace(TD3, aux_distance_weight=-1.0)
    with pytest.raises(InvalidInputError, match="needs an observation that holds the target's position"):
        make_agent(replace(TD3, aux_distance_weight=1.0), 4, 6)


def test_a_buffer_that_keeps_visible_fractions_refuses_transitions_without() -> None:
    buffer = ReplayBuffer(10, gym.spaces.Box(-np.inf, np.inf, (9,), np.float32), 6, visible_fractions=True)
    step = Batch(torch.zeros(2, 9), torch.zeros(2, 6), torch.zeros(2), torch.zeros(2, 9), torch.zeros(2))
    with pytest.raises(InvalidInputError, match="keeps visible_fractions"):
        buffer.add(step)
    buffer.add(step._replace(visible_fractions=torch.tensor([0.5, 0.25])))
    drawn = buffer.sample(50).visible_fractions
    assert drawn is not None and set(drawn.tolist()) == {0.5, 0.25}
