"""The policies of a benchmark: planners by name, trained policies by file."""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.policies.opening import find_policy, open_policy
from maniskill_tomato.policies.protocol import Policy
from maniskill_tomato.policies.registry import PLANNERS, SHIPPED_FILES, policy_names


@dataclass(frozen=True, kw_only=True)
class PolicySpec:
    """One policy as the command line names it."""

    label: str
    """Its name in tables and files."""
    planner: str | None = None
    """One of `registry.policy_names`; None for a trained policy."""
    path: Path | None = None
    """File of a trained policy, or of the planner's network."""

    @classmethod
    def parse(cls, text: str) -> "PolicySpec":
        """Reads `NAME`, `FILE` or `LABEL=FILE`; a label may be the name of a policy whose network the file replaces.

        Raises:
            PolicyError: There is no such policy.
            InvalidInputError: The label is the name of another policy.
        """
        label, _, file = text.rpartition("=")
        found = find_policy(file)
        if isinstance(found, str):
            if label:
                raise InvalidInputError(f"{text!r} gives the policy {found} another name; write {found}")
            return cls(label=found, planner=found)
        if not label:
            label = found.parent.name if found.stem == "policy" and found.parent.name else found.stem
        planner = label if label in SHIPPED_FILES else None
        if planner is None and label in policy_names():
            raise InvalidInputError(f"{label!r} is a planner's name; give the policy {file} another label")
        return cls(label=label, planner=planner, path=found.resolve())

    def fingerprint(self) -> str:
        """Says whether stored episodes are of this policy: its planner, and the hash of its file."""
        content = b"" if self.path is None else self.path.read_bytes()
        return f"{self.planner or 'policy'}:{hashlib.sha256(content).hexdigest()[:16]}"

    def make(self, env: gym.Env[Any, Any], contact_free: bool = False) -> Policy:
        """The policy for an environment.

        Args:
            env: Where it acts.
            contact_free: Whether the oracle avoids the plant.

        Raises:
            CheckpointError: Its file cannot be used.
        """
        spec = env.unwrapped.spec
        return open_policy(
            str(self.planner if self.path is None else self.path),
            env_id=None if spec is None else spec.id,
            ground_truth=getattr(env.unwrapped, "ground_truth", None),
            contact_free=contact_free,
            device=getattr(env.unwrapped, "device", "cpu"),
        )


def parse_policies(text: str) -> list[PolicySpec]:
    """Reads a list with commas.

    Raises:
        InvalidInputError: It is empty, one of them cannot be used, or two have the same label.
    """
    specs = [PolicySpec.parse(part.strip()) for part in text.split(",") if part.strip()]
    if not specs:
        raise InvalidInputError(
            f"give one policy or more, with commas between them, such as {', '.join(PLANNERS)}"
        )
    labels = [spec.label for spec in specs]
    for label in labels:
        if labels.count(label) > 1:
            raise InvalidInputError(f"two policies are called {label!r}; name them as LABEL=FILE")
    return specs
