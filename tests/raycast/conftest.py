"""The libraries that can trace rays on a CPU; modules that use `backend` run once with each."""

from typing import get_args

import pytest
import torch

from maniskill_tomato.raycast import scene
from maniskill_tomato.raycast.embree import Backend, choose_backend


@pytest.fixture(params=get_args(Backend))
def backend(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Backend:
    """What traces the rays of scenes that name no backend."""
    name: Backend = request.param

    def choose(device: torch.device, wanted: Backend | None) -> Backend:
        return choose_backend(device, wanted or (name if device.type == "cpu" else "warp"))

    monkeypatch.setattr(scene, "choose_backend", choose)
    return name
