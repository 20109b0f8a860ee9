"""A run that begins with an actor that was trained before, by imitation or by another run."""

from maniskill_tomato.errors import CheckpointError
from maniskill_tomato.learning.rl.agent import Agent
from maniskill_tomato.learning.rl.train_config import TrainConfig
from maniskill_tomato.policies.trained_actor import TrainedActor


def check_fits(policy: TrainedActor, config: TrainConfig, observation_dim: int) -> None:
    """Refuses a policy that the configured actor cannot take over.

    Raises:
        CheckpointError: Its observations, its layers, its normaliser or its action scale are other ones.
        InvalidInputError: It was trained with options that this version does not know.
    """
    given_config = TrainConfig.from_dict(policy.config)
    for name, given, wanted in (
        ("observation length", policy.observation_dim, observation_dim),
        ("actor_hidden", tuple(given_config.actor_hidden), tuple(config.actor_hidden)),
        ("normalize_observations", given_config.normalize_observations, config.normalize_observations),
        ("action_scale", tuple(given_config.action_scale), tuple(config.action_scale)),
    ):
        if given != wanted:
            raise CheckpointError(
                f"initial_policy has {name} {given}, but the run is configured for {wanted}; give the same"
            )


def begin_with(agent: Agent, policy: TrainedActor) -> None:
    """Gives the agent's actor, target actor and normaliser the weights of a policy that fits."""
    agent.actor.load_state_dict(policy.actor.state_dict())
    agent.target_actor.load_state_dict(policy.actor.state_dict())
    agent.normalizer.load_state_dict(policy.normalizer.state_dict())
