"""Random states as plain data: numbers, text and tensors, which a checkpoint may hold and loading cannot run."""

import random
from typing import Any

import numpy as np
import torch

from maniskill_tomato.tasks.numpy_streams import numpy_state, random_state


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
    np.random.set_state(numpy_state(state["numpy"]))
    torch.set_rng_state(state["torch"].cpu())
    if state["cuda"] and torch.cuda.device_count() == len(state["cuda"]):
        torch.cuda.set_rng_state_all([s.cpu() for s in state["cuda"]])
