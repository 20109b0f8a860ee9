"""Policies of state vectors as policies of beliefs, and the reverse."""

import json
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from maniskill_tomato.errors import PolicyError
from maniskill_tomato.policies.layout import has_belief
from maniskill_tomato.policies.pixel_policy import PixelFollower, PixelPolicy
from maniskill_tomato.policies.protocol import Planner, Policy, StatePolicy, reseed
from maniskill_tomato.sensing.belief import Belief
from maniskill_tomato.sensing.image_layout import Sight
from maniskill_tomato.sensing.image_observation import Observation, images_of, state_of

if TYPE_CHECKING:
    from maniskill_tomato.policies.onnx_policy import OnnxPolicy


class ObservationPolicy(Planner):
    """A state policy as a policy: it decides from the belief's observation alone."""

    def __init__(self, policy: StatePolicy, name: str = "learned") -> None:
        """Keeps the policy.

        Args:
            policy: Decides; if it has `describe`, that says where it comes from.
            name: In reports.
        """
        self.policy = policy
        self.name = name

    def reseed(self, seed: int) -> None:
        reseed(self.policy, seed)

    def act(self, belief: Belief | Tensor) -> Tensor:
        """The actions for beliefs, or for observations of shape (B, D). Shape (B, A)."""
        return self.policy.act(belief if isinstance(belief, Tensor) else belief.observation)

    def describe(self) -> dict[str, Any]:
        """The state policy's own account, or its name."""
        describe = getattr(self.policy, "describe", None)
        return super().describe() if describe is None else describe()


class ExportedActor:
    """An `OnnxPolicy` that takes and gives tensors."""

    def __init__(self, exported: "OnnxPolicy") -> None:
        self.exported = exported

    @property
    def sight(self) -> Sight | None:
        """The images that it observes; None if it observes none."""
        return self.exported.description.sight

    def act(self, observations: Observation) -> Tensor:
        """Actions of shape (B, A) for observations of shape (B, D) or with images, in the task's units."""
        state = state_of(observations)
        images = {kind: image.cpu().numpy() for kind, image in images_of(observations).items()}
        actions = self.exported.act(state.detach().cpu().numpy(), images)
        return torch.from_numpy(actions).to(state.device)

    def describe(self) -> dict[str, Any]:
        """Where it comes from."""
        return self.exported.describe()


class BeliefFollower:
    """A policy as a state policy: it decides from the belief of an environment, whatever the observations are."""

    def __init__(self, policy: Policy, env: Any) -> None:
        """Ties a policy to an environment.

        Args:
            policy: Decides.
            env: Its `unwrapped` has a `belief`.
        """
        self._policy = policy
        self._world: Any = env.unwrapped
        self._begun: Tensor | None = None

    def act(self, observations: Tensor) -> Tensor:
        """The policy's moves. Shape (B, 3)."""
        belief: Belief = self._world.belief
        # One view: the episode has just begun, or the target has changed. A robot that keeps a map has seen something
        # of its next target before.
        is_fresh = belief.memory.visits == 1
        begun = getattr(self._world, "targets_begun", None)
        if begun is not None:
            if self._begun is not None:
                is_fresh = is_fresh | (begun != self._begun)
            self._begun = begun
        fresh = is_fresh.nonzero()[:, 0]
        if len(fresh):
            self._policy.begin(belief, fresh)
        return self._policy.act(belief)


def as_policy(policy: Policy | StatePolicy) -> Policy:
    """A state policy as a policy; a policy as it is."""
    if isinstance(policy, Policy):
        return policy
    return ObservationPolicy(policy, name=getattr(policy, "name", type(policy).__name__))


def as_state_policy(policy: Policy | StatePolicy, env: Any) -> StatePolicy:
    """What a loop that knows observations only can ask in an environment.

    Args:
        policy: Decides.
        env: Its `unwrapped` has a `belief` after a reset if it says so by an attribute `keeps_belief`.

    Raises:
        PolicyError: The policy needs a belief, which the environment has not, or its actions mean something else there.
    """
    if not isinstance(policy, Policy):
        return policy
    check_control_mode(policy, getattr(env.unwrapped, "control_mode", None))
    if getattr(env.unwrapped, "keeps_belief", False):
        return BeliefFollower(policy, env)
    if isinstance(policy, ObservationPolicy):
        return policy.policy
    if isinstance(policy, PixelPolicy):
        return PixelFollower(policy, env)
    raise PolicyError(f"{policy.name} decides from beliefs, which this environment does not have")


def check_control_mode(policy: Policy, control_mode: str | None) -> None:
    """Refuses a policy that was trained on actions of another meaning.

    Args:
        policy: Any.
        control_mode: What actions mean where it shall act; None accepts any.

    Raises:
        PolicyError: It was trained with another control mode.
    """
    facts: dict[str, Any] = describe(policy)
    if control_mode is None or "trained_on" not in facts:
        return
    own = "pd_look_at" if has_belief(str(facts["trained_on"])) else "pd_viewpoint"
    trained = (facts.get("trained_with") or {}).get("control_mode", own)
    if trained != control_mode:
        raise PolicyError(
            f"{policy.name} was trained with control_mode={trained!r} and cannot act with {control_mode!r}; make the "
            f"environment with control_mode={trained!r}, or train it again"
        )


def describe(policy: Policy) -> dict[str, Any]:
    """A policy's kind and where it comes from, for reports."""
    return policy.describe() if isinstance(policy, Planner) else {"kind": policy.name}


def origin(policy: Policy) -> str:
    """One line: by what, on which task and with which of its options a trained policy was trained."""
    facts: dict[str, Any] = describe(policy)
    if "trained_on" not in facts:
        return str(facts["kind"])
    options = facts["trained_with"]
    if options is None:
        trained_with = "with options that its file does not say"
    elif not options:
        trained_with = "with the task's own plant and options"
    else:
        trained_with = f"with {', '.join(f'{name}={json.dumps(value)}' for name, value in options.items())}"
    return f"{facts['kind']}, trained on {facts['trained_on']} {trained_with}"
