"""A run that begins with an actor that was trained before, by imitation or by another run."""

from maniskill_tomato.errors import CheckpointError
from maniskill_tomato.learning.rl.agent import Agent
from maniskill_tomato.learning.rl.policy import Policy
from maniskill_tomato.learning.rl.train_config import TrainConfig


def check_fits(policy: Policy, config: TrainConfig, observation_dim: int) -> None:
    """Refuses a policy that the configured actor cannot take over.

    Raises:
        CheckpointError: Its observations, its layers, its normaliser or its action scale are other ones.
    """
    for name, given, wanted in (
        ("observation length", policy.observation_dim, observation_dim),
        ("actor_hidden", tuple(policy.config.actor_hidden), tuple(config.actor_hidden)),
        ("normalize_observations", policy.config.normalize_observations, config.normalize_observations),
        ("action_scale", tuple(policy.config.action_scale), tuple(config.action_scale)),
    ):
        if given != wanted:
            raise CheckpointError(
                f"initial_policy has {name} {given}, but the run is configured for {wanted}; give the same"
            )


def begin_with(agent: Agent, policy: Policy) -> None:
    """Gives the agent's actor, target actor and normaliser the weights of a policy that fits."""
    agent.actor.load_state_dict(policy.actor.state_dict())
    agent.target_actor.load_state_dict(policy.actor.state_dict())
    agent.normalizer.load_state_dict(policy.normalizer.state_dict())
