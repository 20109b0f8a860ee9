"""Exported policies in the evaluation, beside those of the trainer."""

import json
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from maniskill_tomato.learning.rl.policy import Policy, load_policy
from maniskill_tomato.policies.description import PolicyDescription
from maniskill_tomato.policies.onnx_policy import OnnxPolicy


class ExportedPolicy:
    """An `OnnxPolicy` that takes and gives tensors."""

    def __init__(self, policy: OnnxPolicy) -> None:
        self._policy = policy

    @property
    def description(self) -> PolicyDescription:
        """What the policy says about itself."""
        return self._policy.description

    def act(self, observations: Tensor) -> Tensor:
        """Actions of shape (B, A) for observations of shape (B, D), in the task's units."""
        actions = self._policy.act(observations.detach().cpu().numpy())
        return torch.from_numpy(actions).to(observations.device)


def open_policy(path: Path, env_id: str | None = None) -> Policy | ExportedPolicy:
    """Reads a policy, exported if the file's ending is .onnx, otherwise of the trainer.

    Args:
        path: The file.
        env_id: The task that it must have been trained on; None accepts any.

    Raises:
        CheckpointError: A file of the trainer is missing, damaged or made for another task.
        PolicyError: The same of an exported one.
    """
    if path.suffix.lower() == ".onnx":
        return ExportedPolicy(OnnxPolicy.load(path, env_id))
    return load_policy(path, env_id=env_id)


def describe_policy(policy: Policy | ExportedPolicy) -> dict[str, Any]:
    """Where a policy comes from, for metrics.json."""
    if isinstance(policy, Policy):
        counters = policy.counters
        return {
            "kind": policy.algorithm,
            "trained_on": policy.env_id,
            "trained_with": policy.env_options,
            "training_steps": counters.get("steps"),
            "training_episodes": counters.get("episodes"),
            "training_seconds": round(float(counters.get("seconds", 0.0)), 1),
            "training_seed": counters.get("seed"),
            "package_version": policy.package_version,
        }
    description = policy.description
    training = description.training
    return {
        "kind": f"{training.get('algorithm')}, ONNX",
        "trained_on": description.env_id,
        "trained_with": description.trained_with,
        "training_steps": training.get("steps"),
        "training_episodes": training.get("episodes"),
        "training_seed": training.get("seed"),
        "package_version": description.package_version,
    }


def origin(policy: Policy | ExportedPolicy) -> str:
    """One line that says by what, on which task and with which of its options a policy was trained."""
    facts = describe_policy(policy)
    options = facts["trained_with"]
    if options is None:
        trained_with = "with options that its file does not say"
    elif not options:
        trained_with = "with the task's own plant and options"
    else:
        trained_with = f"with {', '.join(f'{name}={json.dumps(value)}' for name, value in options.items())}"
    return f"{facts['kind']}, trained on {facts['trained_on']} {trained_with}"
