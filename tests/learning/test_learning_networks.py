import math
from typing import Any

import numpy as np
import pytest
import torch

from maniskill_tomato.learning.rl.agent import make_agent
from maniskill_tomato.learning.rl.critic import CRITIC_OUTPUT_BOUND, Critic
from maniskill_tomato.learning.rl.presets import (
    OBSERVATION_CENTRE,
    OBSERVATION_HALF_RANGE,
    PRESETS,
    get_preset,
)
from maniskill_tomato.policies.actor import ACTOR_SMALL_OUTPUT_BOUND, Actor, ObservationNormalizer
from maniskill_tomato.sensing.image_layout import ImageLayout


def parameter_count(module: torch.nn.Module) -> int:
    return sum(p.numel() for p in module.parameters())


def test_the_thesis_networks_have_the_parameters_counted_by_hand() -> None:
    agent = make_agent(get_preset("thesis-guided"), 9, 6)
    assert parameter_count(agent.actor) == (9 * 100 + 100) + (100 * 100 + 100) + (100 * 6 + 6)
    assert parameter_count(agent.critics) == (9 * 100 + 100) + (106 * 100 + 100) + (100 + 1)


def test_the_default_preset_has_two_critics_that_start_differently() -> None:
    agent = make_agent(get_preset("td3"), 9, 6)
    first, second = agent.critics
    assert not torch.allclose(next(first.parameters()), next(second.parameters()))


def test_targets_start_as_copies() -> None:
    agent = make_agent(get_preset("td3"), 9, 6)
    for source, target in ((agent.actor, agent.target_actor), (agent.critics, agent.target_critics)):
        for a, b in zip(source.parameters(), target.parameters(), strict=True):
            torch.testing.assert_close(a, b, rtol=0.0, atol=0.0)
            assert a.data_ptr() != b.data_ptr()


def test_hidden_weights_have_the_he_variance_and_biases_are_zero() -> None:
    torch.manual_seed(0)
    critic = Critic(200, 56, (300, 300), action_layer=1)
    for layer, fan_in in zip(critic.hidden, (200, 356), strict=True):
        assert isinstance(layer, torch.nn.Linear)
        assert layer.weight.std().item() == pytest.approx(math.sqrt(2.0 / fan_in), rel=0.02)
        # A normal distribution reaches beyond three standard deviations, a uniform one does not.
        assert layer.weight.abs().max() > 3.0 * math.sqrt(2.0 / fan_in)
        assert layer.bias.abs().max() == 0.0


def test_the_critic_output_is_uniform_within_its_bound() -> None:
    torch.manual_seed(0)
    weights = Critic(9, 6, (100, 20_000)).output.weight
    assert weights.abs().max() <= CRITIC_OUTPUT_BOUND
    assert weights.std().item() == pytest.approx(CRITIC_OUTPUT_BOUND / math.sqrt(3.0), rel=0.02)


def test_the_actor_output_is_glorot_uniform() -> None:
    torch.manual_seed(0)
    weights = Actor(9, 50, (100, 2000)).output.weight
    bound = math.sqrt(6.0 / (2000 + 50))
    assert bound * 0.999 < weights.abs().max().item() <= bound
    assert weights.std().item() == pytest.approx(bound / math.sqrt(3.0), rel=0.02)


def test_the_small_actor_output_starts_near_zero() -> None:
    actor = Actor(9, 6, output_init="small")
    assert actor.output.weight.abs().max() <= ACTOR_SMALL_OUTPUT_BOUND
    assert actor(torch.randn(50, 9)).abs().max() < 0.2


def test_the_networks_compute_what_their_layers_say() -> None:
    actor, critic = Actor(9, 6), Critic(9, 6)
    s, a = torch.randn(4, 9), torch.randn(4, 6)
    w = actor.state_dict()
    h = (s @ w["hidden.0.weight"].T + w["hidden.0.bias"]).clamp(min=0)
    h = (h @ w["hidden.1.weight"].T + w["hidden.1.bias"]).clamp(min=0)
    torch.testing.assert_close(actor(s), torch.tanh(h @ w["output.weight"].T + w["output.bias"]))
    w = critic.state_dict()
    h = (s @ w["hidden.0.weight"].T + w["hidden.0.bias"]).clamp(min=0)
    h = (torch.cat((h, a), 1) @ w["hidden.1.weight"].T + w["hidden.1.bias"]).clamp(min=0)
    torch.testing.assert_close(critic(s, a), (h @ w["output.weight"].T + w["output.bias"])[:, 0])


def test_the_action_can_enter_the_first_layer() -> None:
    critic = Critic(9, 6, (32, 16), action_layer=0)
    assert critic.hidden[0].weight.shape == (32, 15)
    assert critic(torch.randn(7, 9), torch.randn(7, 6)).shape == (7,)


def test_normalisation_maps_the_documented_ranges_to_one() -> None:
    normalizer = ObservationNormalizer(OBSERVATION_CENTRE, OBSERVATION_HALF_RANGE)
    centre, half = torch.tensor(OBSERVATION_CENTRE), torch.tensor(OBSERVATION_HALF_RANGE)
    torch.testing.assert_close(normalizer((centre + half)[None]), torch.ones(1, 9), rtol=0.0, atol=1e-6)
    torch.testing.assert_close(normalizer((centre - half)[None]), -torch.ones(1, 9), rtol=0.0, atol=1e-6)
    same = torch.randn(3, 9)
    torch.testing.assert_close(ObservationNormalizer.identity(9)(same), same)


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_builds_an_agent(name: str) -> None:
    agent = make_agent(get_preset(name), 9, 6)
    config, observations = agent.config, torch.randn(5, 9)
    layout = ImageLayout.parse(config.obs_mode, config.image_size)
    spaces = {} if layout is None else layout.spaces()
    images = {kind: np.stack([box.sample() for _ in range(5)]) for kind, box in spaces.items()}
    seen: Any = {"state": observations, **{kind: torch.from_numpy(image) for kind, image in images.items()}}
    actions = agent.policy(seen if images else observations)
    assert actions.shape == (5, 6)
    assert actions.abs().max() <= 1.0
