"""How often a step waits for a GPU: what counts it, and how often it is now."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from benchmarking.synchronisations import synchronisations
from maniskill_tomato.tasks.vector_env import make_vector_env

REFUSALS = {
    "TomatoViewpointGuided-v1": "maniskill_tomato/robot/inverse_kinematics.py solve",
    "TomatoViewpointSparse-v1": "maniskill_tomato/robot/inverse_kinematics.py solve",
    "TomatoViewpoint-v1": "maniskill_tomato/robot/look_at_move.py _made",
}
"""Where the one answer is fetched that a step cannot do without: whether a move is refused."""

NUMBERS, MASK = torch.arange(4.0), torch.tensor([True, False, True, False])


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def device(request: pytest.FixtureRequest) -> str:
    name: str = request.param
    return name


@pytest.mark.parametrize(
    ("work", "count"),
    [
        (lambda x, m: x.sum().item(), 1),
        (lambda x, m: float(x[2]) + int(x[1]), 2),
        (lambda x, m: bool(m.any()), 1),
        (lambda x, m: m.nonzero(), 1),
        (lambda x, m: x[m], 1),
        (lambda x, m: x.tolist(), 1),
        (lambda x, m: x.cpu().numpy() if x.is_cuda else x.numpy(), 1),
        (lambda x, m: torch.equal(x, x + 1), 1),
        (lambda x, m: torch.tensor([1.0, 2.0], device=x.device), 1),
        (lambda x, m: torch.as_tensor(np.zeros(3), device=x.device), 1),
        (lambda x, m: x.new_tensor([0.3, 0.4]), 1),
        (lambda x, m: torch.where(m, x, 0.0).clamp(-1.0, 1.0).index_fill(0, m.long(), 2.0), 0),
        (lambda x, m: x.clone().masked_fill_(m, 3.0), 0),
        (lambda x, m: x[m.long()] + torch.full((4,), 0.5, device=x.device), 0),
    ],
)
def test_what_the_host_must_wait_for_is_counted(work: Callable[..., Any], count: int, device: str) -> None:
    x, mask = NUMBERS.to(device), MASK.to(device)
    assert sum(synchronisations(lambda: work(x, mask), device).values()) == count


def test_each_is_told_where_it_is_asked_for() -> None:
    def asks_twice() -> None:
        assert float(NUMBERS[1]) < float(NUMBERS[2])

    assert synchronisations(asks_twice, "cpu") == {"tests/test_synchronisations.py asks_twice": 2}


@pytest.mark.parametrize("mode", ["Disabled", "NextStep", "SameStep"])
@pytest.mark.parametrize("env_id", REFUSALS)
def test_a_step_waits_to_learn_what_is_refused_and_with_autoreset_what_is_over(
    env_id: str, mode: str, device: str
) -> None:
    options: dict[str, Any] = {"plant": {"seed": 3}}
    env = make_vector_env(env_id, 4, device, arrays="torch", autoreset_mode=mode, **options)
    env.reset(seed=0)
    still = torch.zeros(4, env.single_action_space.shape[0], device=device)  # type: ignore[index]
    for _ in range(2):
        env.step(still)
    wanted = {REFUSALS[env_id]: 1}
    if mode == "NextStep":
        wanted["tasks/vector_env.py _ended"] = 1
    if mode == "SameStep":
        wanted["tasks/vector_env.py step"] = 1
    assert synchronisations(lambda: env.step(still), device) == wanted
