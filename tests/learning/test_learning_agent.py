"""The update rules against references written out by hand."""

import copy
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.learning.rl.agent import (
    Agent,
    make_agent,
    polyak_update,
    td_targets,
    update,
    update_actor,
    update_critic,
)
from maniskill_tomato.learning.rl.presets import TrainConfig, get_preset
from maniskill_tomato.learning.rl.replay import Batch, ReplayBuffer

STATE_SPACE = gym.spaces.Box(-np.inf, np.inf, (9,), np.float32)

DDPG = get_preset("thesis-guided")
TD3 = replace(get_preset("td3"), target_noise=0.0, pre_tanh_penalty=0.0)


def random_batch(size: int = 16) -> Batch:
    generator = torch.Generator().manual_seed(1)
    return Batch(
        torch.randn(size, 9, generator=generator),
        torch.rand(size, 6, generator=generator) * 2 - 1,
        torch.randn(size, generator=generator),
        torch.randn(size, 9, generator=generator),
        (torch.rand(size, generator=generator) < 0.3).float(),
    )


def moved_agent(config: TrainConfig) -> Agent:
    """An agent whose targets differ from its networks."""
    torch.manual_seed(3)
    agent = make_agent(config, 9, 6)
    with torch.no_grad():
        for p in [*agent.target_actor.parameters(), *agent.target_critics.parameters()]:
            p.add_(0.05 * torch.randn_like(p))
    return agent


@pytest.mark.parametrize("config", [DDPG, TD3], ids=["ddpg", "td3"])
def test_targets_are_those_of_algorithm_2_row_by_row(config: TrainConfig) -> None:
    agent, batch = moved_agent(config), random_batch()
    targets = td_targets(agent, batch)
    assert 0 < batch.terminations.sum() < len(targets)
    for i in range(len(targets)):
        if batch.terminations[i]:
            expected = batch.rewards[i]
        else:
            s = agent.normalizer(batch.next_observations[i : i + 1])
            a = agent.target_actor(s)
            expected = batch.rewards[i] + config.gamma * min(q(s, a)[0] for q in agent.target_critics)
        torch.testing.assert_close(targets[i], expected)


def test_a_time_limit_bootstraps_and_a_termination_does_not() -> None:
    agent = moved_agent(DDPG)
    batch = random_batch()
    ran_out_of_time = batch._replace(terminations=torch.zeros(16))
    ended = batch._replace(terminations=torch.ones(16))
    torch.testing.assert_close(td_targets(agent, ended), batch.rewards)
    assert (td_targets(agent, ran_out_of_time) - batch.rewards).abs().min() > 0.0


def test_target_noise_is_clipped_and_fresh_for_every_row() -> None:
    config = replace(TD3, target_noise=5.0, target_noise_clip=0.1, gamma=0.5)
    agent, batch = moved_agent(config), random_batch(64)._replace(terminations=torch.zeros(64))
    seen: list[torch.Tensor] = []
    handle = agent.target_critics[0].register_forward_pre_hook(lambda module, inputs: seen.append(inputs[1]))
    td_targets(agent, batch)
    handle.remove()
    clean = agent.target_actor(agent.normalizer(batch.next_observations))
    difference = seen[0] - clean
    assert difference.abs().max() <= 0.1 + 1e-6
    assert difference.std(dim=0).min() > 0.03
    assert seen[0].abs().max() <= 1.0


@pytest.mark.parametrize("config", [DDPG, TD3], ids=["ddpg", "td3"])
def test_the_critic_takes_an_adam_step_on_the_squared_error(config: TrainConfig) -> None:
    agent, batch = moved_agent(config), random_batch()
    reference = copy.deepcopy(agent.critics)
    targets = td_targets(agent, batch)
    logs = update_critic(agent, batch)
    total = torch.zeros(())
    for index, critic in enumerate(reference, start=1):
        values = torch.stack(
            [
                critic(agent.normalizer(s[None]), a[None])[0]
                for s, a in zip(batch.observations, batch.actions, strict=True)
            ]
        )
        loss = sum((y - q) ** 2 for y, q in zip(targets, values, strict=True)) / len(targets)
        assert isinstance(loss, torch.Tensor)
        torch.testing.assert_close(logs[f"qf{index}_loss"], loss.detach(), rtol=1e-4, atol=1e-5)
        total = total + loss
    torch.testing.assert_close(logs["qf_loss"], total.detach(), rtol=1e-4, atol=1e-5)
    gradients = torch.autograd.grad(total, list(reference.parameters()))
    for updated, before, gradient in zip(
        agent.critics.parameters(), reference.parameters(), gradients, strict=True
    ):
        # The first step of Adam is lr * g / (|g| + 1e-8).
        step = config.critic_learning_rate * gradient / (gradient.abs() + 1e-8)
        large = gradient.abs() > 1e-4
        torch.testing.assert_close(updated[large], (before - step)[large], rtol=1e-4, atol=1e-6)


def test_the_actor_climbs_the_sampled_policy_gradient() -> None:
    agent, batch = moved_agent(DDPG), random_batch()
    reference = copy.deepcopy(agent.actor)
    critics_before = copy.deepcopy(agent.critics.state_dict())
    update_actor(agent, batch.observations)
    # The chain rule of Algorithm 2 by hand: dQ/da at a = mu(s), then the vector-Jacobian product with mu.
    actions = reference(batch.observations).detach().requires_grad_()
    (slope,) = torch.autograd.grad(agent.critics[0](batch.observations, actions).sum(), actions)
    gradients = torch.autograd.grad(
        reference(batch.observations), list(reference.parameters()), grad_outputs=slope / len(actions)
    )
    for updated, before, gradient in zip(
        agent.actor.parameters(), reference.parameters(), gradients, strict=True
    ):
        large = gradient.abs() > 1e-4
        step = DDPG.actor_learning_rate * gradient / (gradient.abs() + 1e-8)
        torch.testing.assert_close(updated[large], (before + step)[large], rtol=1e-4, atol=1e-6)
    for name, value in agent.critics.state_dict().items():
        torch.testing.assert_close(value, critics_before[name], rtol=0.0, atol=0.0)


def test_the_pre_tanh_penalty_adds_its_mean_square() -> None:
    agent, batch = moved_agent(replace(TD3, pre_tanh_penalty=0.5)), random_batch()
    s = agent.normalizer(batch.observations)
    pre = agent.actor.pre_activation(s)
    expected = -agent.critics[0](s, torch.tanh(pre)).mean() + 0.5 * (pre**2).mean()
    torch.testing.assert_close(update_actor(agent, batch.observations)["actor_loss"], expected.detach())


def test_polyak_by_hand() -> None:
    target = [torch.tensor([1.0, 2.0]), torch.tensor([[0.0]])]
    polyak_update([torch.tensor([3.0, -2.0]), torch.tensor([[10.0]])], target, 0.25)
    torch.testing.assert_close(target[0], torch.tensor([0.25 * 3.0 + 0.75 * 1.0, 0.25 * -2.0 + 0.75 * 2.0]))
    torch.testing.assert_close(target[1], torch.tensor([[2.5]]))


def test_the_policy_and_the_targets_move_on_every_second_update_of_td3() -> None:
    agent, batch = moved_agent(TD3), random_batch()
    actors, targets = [], []
    for index in range(4):
        logs = update(agent, batch, index)
        assert ("actor_loss" in logs) == (index % 2 == 0)
        actors.append(agent.actor.output.weight.detach().clone())
        targets.append(next(agent.target_critics.parameters()).clone())
    for series in (actors, targets):
        torch.testing.assert_close(series[0], series[1], rtol=0.0, atol=0.0)
        assert not torch.equal(series[1], series[2])
        torch.testing.assert_close(series[2], series[3], rtol=0.0, atol=0.0)


def test_ddpg_finds_the_best_action_of_a_known_reward() -> None:
    """With every transition terminal, Q(s, a) must become the reward and mu(s) must climb it."""
    torch.manual_seed(0)
    agent = make_agent(replace(DDPG, actor_learning_rate=1e-3), 9, 6)
    best = torch.tensor([0.5, -0.5, 0.25, 0.0, -0.25, 0.75])
    generator = torch.Generator().manual_seed(0)
    logs: dict[str, torch.Tensor] = {}
    for index in range(2000):
        s = torch.rand(64, 9, generator=generator)
        a = torch.rand(64, 6, generator=generator) * 2 - 1
        r = -((a - best) ** 2).sum(dim=-1)
        logs = update(agent, Batch(s, a, r, s, torch.ones(64)), index, generator)
    assert logs["qf1_loss"] < 0.1  # The variance of the rewards is 2.1.
    actions = agent.policy(torch.rand(200, 9, generator=generator))
    assert -((actions - best) ** 2).sum(dim=-1).mean() > -0.7  # Random actions get -3.2 on average.


def rows(values: list[float]) -> Batch:
    column = torch.tensor(values)
    return Batch(
        column[:, None].expand(-1, 9),
        column[:, None].expand(-1, 6),
        column,
        column[:, None].expand(-1, 9) + 1,
        column,
    )


def held(buffer: ReplayBuffer) -> set[float]:
    return set(buffer.sample(2000, torch.Generator().manual_seed(0)).rewards.tolist())


def test_replay_overwrites_the_oldest_first() -> None:
    buffer = ReplayBuffer(5, STATE_SPACE, 6)
    buffer.add(rows([0.0, 1.0, 2.0]))
    assert (len(buffer), held(buffer)) == (3, {0.0, 1.0, 2.0})
    buffer.add(rows([3.0, 4.0, 5.0, 6.0]))
    assert (len(buffer), held(buffer)) == (5, {2.0, 3.0, 4.0, 5.0, 6.0})
    buffer.add(rows([7.0]))
    assert held(buffer) == {3.0, 4.0, 5.0, 6.0, 7.0}


def test_replay_keeps_the_parts_of_a_transition_together() -> None:
    buffer = ReplayBuffer(7, STATE_SPACE, 6)
    for start in range(0, 30, 3):
        buffer.add(rows([float(start + k) for k in range(3)]))
    batch = buffer.sample(100)
    for i in range(6):
        torch.testing.assert_close(batch.actions[:, i], batch.rewards)
    torch.testing.assert_close(batch.next_observations[:, 0], batch.observations[:, 0] + 1)
    torch.testing.assert_close(batch.terminations, batch.rewards)


def test_replay_samples_uniformly_and_repeatably() -> None:
    buffer = ReplayBuffer(4, STATE_SPACE, 6)
    buffer.add(rows([0.0, 1.0, 2.0, 3.0]))
    drawn = buffer.sample(8000, torch.Generator().manual_seed(5)).rewards
    assert torch.bincount(drawn.long()).float().sub(2000).abs().max() < 200  # Five standard deviations.
    torch.testing.assert_close(drawn, buffer.sample(8000, torch.Generator().manual_seed(5)).rewards)


def test_replay_refuses_what_it_cannot_do() -> None:
    buffer = ReplayBuffer(3, STATE_SPACE, 6)
    with pytest.raises(InvalidInputError, match="empty"):
        buffer.sample(1)
    with pytest.raises(InvalidInputError, match="4 transitions at once do not fit a replay buffer of 3"):
        buffer.add(rows([0.0, 1.0, 2.0, 3.0]))
    with pytest.raises(InvalidInputError, match="1 or more"):
        ReplayBuffer(0, STATE_SPACE, 6)
