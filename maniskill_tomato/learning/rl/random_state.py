"""Random states as plain data: numbers, text and tensors, which a checkpoint may hold and loading cannot run."""

import json
import random
from typing import Any

import numpy as np
import torch


def random_state(rng: np.random.RandomState) -> dict[str, Any]:
    """The state of one of NumPy's Mersenne twisters."""
    _, key, position, has_gauss, cached = rng.get_state(legacy=True)
    return {
        "key": torch.as_tensor(np.asarray(key, dtype=np.int64)),
        "position": int(position),
        "has_gauss": int(has_gauss),
        "cached_gaussian": float(cached),
    }


def set_random_state(rng: np.random.RandomState, state: dict[str, Any]) -> None:
    """Puts `rng` into the state that `random_state` gave."""
    rng.set_state(_numpy_state(state))


def generator_state(generator: np.random.Generator) -> str:
    """The state of a NumPy generator as JSON; its integers are too wide for tensors."""
    return json.dumps(generator.bit_generator.state, default=int)


def set_generator_state(generator: np.random.Generator, state: str) -> None:
    """Puts `generator` into the state that `generator_state` gave."""
    generator.bit_generator.state = json.loads(state)


def seed_global_random_state(seed: int) -> None:
    """Seeds Python's, NumPy's and torch's global generators."""
    random.seed(seed)
    np.random.seed(seed % 2**32)
    torch.manual_seed(seed)


def global_random_state() -> dict[str, Any]:
    """The states of Python's, NumPy's and torch's global generators, CUDA's included."""
    version, numbers, gauss = random.getstate()
    legacy: Any = np.random.mtrand._rand
    return {
        "python": {"version": version, "numbers": torch.tensor(numbers), "gauss": gauss},
        "numpy": random_state(legacy),
        "torch": torch.get_rng_state(),
        "cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
    }


def set_global_random_state(state: dict[str, Any]) -> None:
    """Puts them back as `global_random_state` found them."""
    python = state["python"]
    random.setstate((python["version"], tuple(python["numbers"].tolist()), python["gauss"]))
    np.random.set_state(_numpy_state(state["numpy"]))
    torch.set_rng_state(state["torch"].cpu())
    if state["cuda"] and torch.cuda.device_count() == len(state["cuda"]):
        torch.cuda.set_rng_state_all([s.cpu() for s in state["cuda"]])


def _numpy_state(state: dict[str, Any]) -> tuple[str, Any, int, int, float]:
    key = state["key"].cpu().numpy().astype(np.uint32)
    return "MT19937", key, state["position"], state["has_gauss"], state["cached_gaussian"]
