"""Weights of strangers: a network takes those of its own kind or is left as it was."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from maniskill_tomato.assets import asset_path
from maniskill_tomato.errors import InvalidInputError, PolicyError
from maniskill_tomato.files import read_tensors, write_tensors
from maniskill_tomato.network_weights import fill_network
from maniskill_tomato.policies.opening import open_policy

HOSTILE: dict[str, tuple[Callable[[Tensor], Tensor], str]] = {
    "complex": (lambda t: t.to(torch.complex64) + 1j, "complex64"),
    "half": (lambda t: t.half(), "float16"),
    "double": (lambda t: t.double(), "float64"),
    "huge": (lambda t: t + 1e30, "beyond 1e"),
    "not finite": (lambda t: t * float("nan"), "not finite"),
    "another shape": (lambda t: t.flatten()[:-1], "shape"),
    "sparse": (lambda t: t.to_sparse(), "plain tensor"),
    "no tensor": (lambda t: 5, "plain tensor"),  # type: ignore[dict-item,return-value]
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_weights_of_another_kind_are_refused_and_change_nothing(kind: str) -> None:
    change, reason = HOSTILE[kind]
    network = nn.Linear(4, 3)
    before = network.weight.detach().clone()
    state = {"bias": torch.ones(3), "weight": change(torch.ones(3, 4))}
    with pytest.raises(InvalidInputError, match=reason):
        fill_network(network, state)
    assert torch.equal(network.weight, before) and not torch.equal(network.bias, torch.ones(3))
    fill_network(network, {"bias": torch.ones(3), "weight": torch.ones(3, 4)})
    assert torch.equal(network.weight, torch.ones(3, 4))


@pytest.mark.parametrize("state", [{}, {"weight": torch.ones(3, 4)}, {"a": 1}, [1], None])
def test_weights_with_other_names_are_refused(state: object) -> None:
    with pytest.raises(InvalidInputError, match="other names"):
        fill_network(nn.Linear(4, 3), state)  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", ["complex", "half", "huge"])
@pytest.mark.parametrize("name", ["TomatoViewpointGuided-v1", "TomatoViewpoint-v1", "deep_3dmts"])
def test_a_policy_with_such_weights_does_not_open(tmp_path: Path, name: str, kind: str) -> None:
    data = read_tensors(asset_path(f"policies/{name}.pt"))
    weights = data["actor" if "actor" in data else "weights"]
    first = next(iter(weights))
    weights[first] = HOSTILE[kind][0](weights[first])
    write_tensors(tmp_path / "policy.pt", data)
    with pytest.raises(PolicyError, match=f"policy.pt does not fit itself: {first}"):
        open_policy(str(tmp_path / "policy.pt"), env_id=None)
