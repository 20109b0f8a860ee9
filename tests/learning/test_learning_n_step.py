"""Returns over several steps against a plain loop over whole episodes."""

from dataclasses import replace
from typing import Any

import pytest
import torch

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.learning.rl.agent import make_agent, td_targets
from maniskill_tomato.learning.rl.n_step import NStepReturns
from maniskill_tomato.learning.rl.presets import TrainConfig, get_preset
from maniskill_tomato.learning.rl.replay import Batch, ReplayBuffer

GAMMA = 0.9
STEPS = 60


def stream(rows: int, seed: int = 0) -> list[dict[str, torch.Tensor]]:
    """Steps of `rows` environments with episodes of random length, ended for good or by a time limit."""
    generator = torch.Generator().manual_seed(seed)
    steps = []
    observation = torch.randn(rows, 9, generator=generator)
    for _ in range(STEPS):
        reached = torch.randn(rows, 9, generator=generator)
        terminated = torch.rand(rows, generator=generator) < 0.15
        truncated = (torch.rand(rows, generator=generator) < 0.15) & ~terminated
        done = terminated | truncated
        steps.append(
            {
                "observation": observation,
                "action": torch.rand(rows, 6, generator=generator),
                "reward": torch.randn(rows, generator=generator),
                "reached": reached,
                "terminated": terminated,
                "done": done,
                "visible": torch.rand(rows, generator=generator),
            }
        )
        observation = torch.where(done[:, None], torch.randn(rows, 9, generator=generator), reached)
    return steps


def feed(windows: NStepReturns, steps: list[dict[str, torch.Tensor]]) -> list[Batch]:
    return [
        windows.add(
            Batch(s["observation"], s["action"], s["reward"], s["reached"], s["terminated"].float()),
            s["visible"],
            s["done"],
        )
        for s in steps
    ]


def expected(steps: list[dict[str, torch.Tensor]], n: int, row: int) -> dict[tuple[float, ...], Any]:
    """What must come out for every step of one environment, by its observation; from whole episodes in a loop."""
    episodes: list[list[dict[str, Any]]] = [[]]
    for step in steps:
        episodes[-1].append({name: value[row] for name, value in step.items()})
        if step["done"][row]:
            episodes.append([])
    result: dict[tuple[float, ...], Any] = {}
    for number, episode in enumerate(episodes):
        finished = number < len(episodes) - 1
        for t, first in enumerate(episode):
            window = episode[t : t + n]
            if len(window) < n and not finished:
                continue  # Still waiting for its end.
            total = 0.0
            for k, step in enumerate(window):
                total += GAMMA**k * float(step["reward"])
            result[tuple(first["observation"].tolist())] = (
                first["action"],
                total,
                window[-1]["reached"],
                float(window[-1]["terminated"]),
                GAMMA ** len(window),
                float(first["visible"]),
            )
    return result


@pytest.mark.parametrize(("n", "rows"), [(1, 1), (2, 1), (3, 4), (5, 3), (100, 2)])
def test_every_transition_leaves_once_with_the_return_of_its_window(n: int, rows: int) -> None:
    steps = stream(rows)
    out = feed(NStepReturns(n, GAMMA, rows, 9, 6), steps)
    wanted: dict[tuple[float, ...], Any] = {}
    for row in range(rows):
        wanted |= expected(steps, n, row)
    seen = 0
    ends = set()
    for batch in out:
        assert batch.discounts is not None and batch.visible_fractions is not None
        for i in range(len(batch.rewards)):
            action, total, reached, terminated, discount, visible = wanted.pop(
                tuple(batch.observations[i].tolist())
            )
            torch.testing.assert_close(batch.actions[i], action)
            torch.testing.assert_close(batch.next_observations[i], reached)
            assert float(batch.rewards[i]) == pytest.approx(total, abs=1e-5)
            assert float(batch.terminations[i]) == terminated
            assert float(batch.discounts[i]) == pytest.approx(discount, rel=1e-5)
            assert float(batch.visible_fractions[i]) == pytest.approx(visible)
            ends.add((terminated, round(discount, 6)))
            seen += 1
    assert not wanted and seen > STEPS * rows - n * rows - 1
    if n == 3:  # Terminated and bootstrapped windows of every length came by.
        assert {(flag, round(GAMMA**k, 6)) for flag in (0.0, 1.0) for k in (1, 2, 3)} <= ends


def test_a_time_limit_by_hand() -> None:
    """Two steps of reward 1 and 2, then the time is up: the first bootstraps with gamma^2, the second with gamma."""
    windows = NStepReturns(3, 0.5, 1, 1, 1)
    no, yes = torch.tensor([False]), torch.tensor([True])

    def step(seen: float, reward: float, reached: float, end: torch.Tensor) -> Batch:
        one = torch.tensor([[seen]])
        batch = Batch(one, one, torch.tensor([reward]), torch.tensor([[reached]]), torch.zeros(1))
        return windows.add(batch, torch.zeros(1), end)

    assert len(step(10.0, 1.0, 11.0, no).rewards) == 0
    last = step(11.0, 2.0, 12.0, yes)
    assert last.observations[:, 0].tolist() == [10.0, 11.0]
    assert last.rewards.tolist() == [1.0 + 0.5 * 2.0, 2.0]
    assert last.next_observations[:, 0].tolist() == [12.0, 12.0]
    assert last.discounts is not None and last.discounts.tolist() == [0.25, 0.5]
    after = [step(20.0 + k, 0.0, 21.0 + k, no) for k in range(3)]
    assert [len(b.rewards) for b in after] == [0, 0, 1]  # Nothing of the old episode is left.


def test_rows_without_a_transition_give_none() -> None:
    steps = stream(4)
    exists = torch.tensor([True, False, True, False])
    windows, kept = NStepReturns(3, GAMMA, 4, 9, 6), NStepReturns(3, GAMMA, 2, 9, 6)
    for s in steps:
        batch = Batch(s["observation"], s["action"], s["reward"], s["reached"], s["terminated"].float())
        out = windows.add(batch, s["visible"], s["done"], exists)
        rows = [part[exists] for part in batch[:5] if part is not None]
        alone = kept.add(Batch(*rows), s["visible"][exists], s["done"][exists])
        for one, two in zip(out, alone, strict=True):
            assert one is not None and two is not None and torch.equal(one, two)


def test_what_is_held_back_survives_a_checkpoint() -> None:
    steps = stream(3)
    whole, first, second = (NStepReturns(4, GAMMA, 3, 9, 6) for _ in range(3))
    wanted = feed(whole, steps)[31:]
    feed(first, steps[:31])
    second.load_state_dict(first.state_dict())
    for one, two in zip(wanted, feed(second, steps[31:]), strict=True):
        assert all(
            torch.equal(a, b) for a, b in zip(one, two, strict=True) if a is not None and b is not None
        )


def test_targets_bootstrap_with_the_discount_of_each_window() -> None:
    torch.manual_seed(0)
    agent = make_agent(get_preset("thesis-guided"), 9, 6)
    buffer = ReplayBuffer(300, 9, 6, discounts=True)
    for complete in feed(NStepReturns(3, GAMMA, 4, 9, 6), stream(4)):
        buffer.add(complete)
    batch = buffer.sample(40, torch.Generator().manual_seed(0))
    assert batch.discounts is not None and len(set(batch.discounts.tolist())) == 3
    targets = td_targets(agent, batch)
    for i in range(len(targets)):
        s = batch.next_observations[i : i + 1]
        value = agent.target_critics[0](s, agent.target_actor(s))[0]
        wanted = batch.rewards[i] + batch.discounts[i] * (1.0 - batch.terminations[i]) * value
        torch.testing.assert_close(targets[i], wanted)


def test_a_buffer_that_keeps_discounts_refuses_transitions_without() -> None:
    buffer = ReplayBuffer(10, 9, 6, discounts=True)
    batch = Batch(torch.zeros(2, 9), torch.zeros(2, 6), torch.zeros(2), torch.zeros(2, 9), torch.zeros(2))
    with pytest.raises(InvalidInputError, match="keeps discounts"):
        buffer.add(batch)
    buffer.add(batch._replace(discounts=torch.tensor([0.9, 0.81])))
    drawn = buffer.sample(50).discounts
    assert drawn is not None and set(drawn.tolist()) == set(torch.tensor([0.9, 0.81]).tolist())


def test_the_number_of_steps_is_checked() -> None:
    with pytest.raises(InvalidInputError, match="n_step must be 1 or more, got 0"):
        TrainConfig(total_timesteps=1, n_step=0)
    with pytest.raises(InvalidInputError, match="num_envs x n_step x hindsight_targets"):
        replace(get_preset("td3"), buffer_size=300, num_envs=64, n_step=5)
