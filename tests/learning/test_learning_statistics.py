"""The running normaliser against the mean and standard deviation of everything at once."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.learning.rl.agent import SMALLEST_SPREAD, RunningStatistics, make_agent
from maniskill_tomato.learning.rl.presets import TrainConfig, get_preset
from maniskill_tomato.policies.actor import ObservationNormalizer
from maniskill_tomato.policies.trained_actor import load_actor
from maniskill_tomato.tasks import THESIS_IDS


@pytest.mark.parametrize("pieces", [[1] * 50, [7, 1, 30, 12], [50]])
def test_pieces_add_up_to_the_whole(pieces: list[int]) -> None:
    generator = torch.Generator().manual_seed(0)
    data = torch.randn(50, 4, generator=generator) * torch.tensor([0.5, 1.0, 20.0, 0.3]) + torch.tensor(
        [100.0, -3.0, 0.0, 1.0]
    )
    statistics, normalizer = RunningStatistics(4), ObservationNormalizer.identity(4)
    for piece in torch.split(data, pieces):
        statistics.update(piece, normalizer)
    exact = data.double().numpy()
    assert float(statistics.count) == 50
    np.testing.assert_allclose(normalizer.centre, exact.mean(axis=0), rtol=1e-6)
    np.testing.assert_allclose(normalizer.half_range, exact.std(axis=0), rtol=1e-5)
    scaled = normalizer(data)
    torch.testing.assert_close(scaled.mean(dim=0), torch.zeros(4), rtol=0.0, atol=1e-4)
    torch.testing.assert_close(scaled.std(dim=0, correction=0), torch.ones(4), rtol=1e-4, atol=0.0)


def test_what_never_varied_is_not_blown_up() -> None:
    statistics, normalizer = RunningStatistics(2), ObservationNormalizer.identity(2)
    for k in range(10):
        statistics.update(torch.tensor([[0.7, float(k)]]), normalizer)
    assert float(normalizer.half_range[0]) == pytest.approx(SMALLEST_SPREAD)
    assert float(normalizer(torch.tensor([[0.75, 0.0]]))[0, 0]) == pytest.approx(
        0.05 / SMALLEST_SPREAD, rel=1e-4
    )


def test_only_a_running_normaliser_follows_what_is_seen() -> None:
    for kind, follows in (("none", False), ("fixed", False), ("running", True)):
        agent = make_agent(replace(get_preset("td3"), normalize_observations=kind), 9, 6)  # type: ignore[arg-type]
        before = agent.normalizer.centre.clone()
        agent.observe(torch.full((5, 9), 3.0))
        assert (not torch.equal(before, agent.normalizer.centre)) == follows
        assert (agent.normalizer.centre == 3.0).all() == follows


def test_options_of_older_runs_still_mean_what_they_meant() -> None:
    values = get_preset("td3").to_dict()
    for old, new in ((True, "fixed"), (False, "none")):
        assert TrainConfig.from_dict({**values, "normalize_observations": old}).normalize_observations == new
    with pytest.raises(
        InvalidInputError, match="normalize_observations must be one of 'none', 'fixed', 'running'"
    ):
        TrainConfig.from_dict({**values, "normalize_observations": "always"})


def test_removed_options_may_be_named_where_they_were_off() -> None:
    config = get_preset("general-td3")
    off = {
        "n_step": 1,
        "privileged_critic": False,
        "leaf_density_start": None,
        "success_threshold_steps": 5000,
    }
    assert TrainConfig.from_dict({**config.to_dict(), **off}) == config
    for used in ({"n_step": 3}, {"privileged_critic": True}, {"leaf_density_start": 1.0}):
        with pytest.raises(InvalidInputError, match=f"that were removed: {next(iter(used))}"):
            TrainConfig.from_dict({**config.to_dict(), **off, **used})


def test_policies_that_ship_still_scale_as_they_were_trained() -> None:
    root = Path(__file__).resolve().parents[2]
    for env_id in THESIS_IDS:
        policy = load_actor(root / "assets/policies" / f"{env_id}.pt")
        assert policy.config["normalize_observations"] == "fixed"
        assert float(policy.normalizer.half_range[0]) == 0.5
