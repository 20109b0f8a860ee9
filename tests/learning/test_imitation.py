"""Imitation: the teacher, what is collected, the loss, actors of one observation and of sequences, and files."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn
from torch.nn.utils.rnn import pack_sequence, unpack_sequence

from maniskill_tomato.errors import InvalidInputError, PolicyError
from maniskill_tomato.experiments.rollout import run_episode
from maniskill_tomato.learning.imitation.imitation_config import ImitationConfig, ImitationFitConfig
from maniskill_tomato.learning.imitation.imitation_fit import (
    direction_loss,
    fit_actor,
    fit_recurrent,
)
from maniskill_tomato.learning.imitation.imitation_training import train_imitation
from maniskill_tomato.learning.imitation.teacher_episodes import ImitationData, collect_demonstrations
from maniskill_tomato.learning.rl.envs import make_env
from maniskill_tomato.policies.lattice_oracle import LatticeOracle
from maniskill_tomato.policies.opening import open_policy
from maniskill_tomato.policies.recurrent import RecurrentActor, RecurrentPolicy, columns_of, save_recurrent
from maniskill_tomato.robot.look_at import look_at_pose
from maniskill_tomato.robot.look_at_move import MAX_MOVE
from maniskill_tomato.sensing.perception_kinds import Part

PLANT = {"seed": 7, "row": False, "leaf_density": 1.2}
ONE = torch.zeros(1, dtype=torch.int64)


@pytest.fixture(scope="module")
def env() -> Iterator[Any]:
    env = make_env("TomatoViewpoint-v1", plant=PLANT)
    yield env
    env.close()


def test_the_lattice_oracle_goes_to_the_nearest_candidate_that_shows_the_target(env: Any) -> None:
    world = env.unwrapped
    truth = world.ground_truth
    env.reset(seed=3)
    belief = world.belief
    oracle = LatticeOracle(truth)
    oracle.begin(belief, ONE)
    target, camera = belief.target_position[0], belief.camera_position[0]
    best, fewest = -1, (math.inf, math.inf)
    for k in range(belief.lattice.size):
        place = target + belief.lattice.offsets[k]
        way = float((place - camera).norm())
        if not bool(belief.reachable[0, k]) or way < 0.25 * MAX_MOVE:
            continue
        if float(truth.visible_fraction(look_at_pose(place[None], target), 0)[0]) > 0.8:
            needed = max(math.ceil(way / MAX_MOVE - 1e-4), 1), way
            if needed < fewest:
                best, fewest = k, needed
    oracle.act(belief)
    assert int(oracle.tried.chosen[0]) == best
    episode = run_episode(env, oracle, 3)
    assert episode.success and episode.steps <= fewest[0] + 1


def test_what_is_collected_is_what_was_seen_and_what_the_teacher_does(env: Any) -> None:
    data = collect_demonstrations(env, range(3, 5), None, 0.0)
    assert data.lengths.sum() == len(data.actions) == len(data.observations) and len(data.lengths) == 2
    teacher = LatticeOracle(env.unwrapped.ground_truth)
    observation, _ = env.reset(seed=4)
    teacher.begin(env.unwrapped.belief, ONE)
    first = int(data.lengths[0])
    torch.testing.assert_close(data.observations[first], observation[0].half())
    torch.testing.assert_close(data.actions[first], teacher.act(env.unwrapped.belief)[0])
    joined = ImitationData.join([data, data])
    assert len(joined.actions) == 2 * len(data.actions) and len(joined.lengths) == 4


def test_the_student_leads_and_the_teacher_is_asked(env: Any) -> None:
    class Stays:
        name = "stays"
        needs_truth = False

        def begin(self, belief: Any, rows: Any) -> None:
            pass

        def act(self, belief: Any) -> torch.Tensor:
            return torch.zeros(1, 3)

    data = collect_demonstrations(env, range(3, 4), Stays(), 1.0)
    assert data.lengths.tolist() == [20]  # The student gets nowhere.
    assert bool((data.actions.norm(dim=1) > 0.5).all())  # The teacher would.


def test_the_loss_is_worked_out_by_hand() -> None:
    moves = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.5, 0.0]])
    wanted = torch.tensor([[0.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
    # Turned by 90 degrees, of the right length; of the right direction, half as long: 0.2 x 0.25.
    assert float(direction_loss(moves, wanted)) == pytest.approx((1.0 + 0.05) / 2)
    assert float(direction_loss(wanted, wanted)) == pytest.approx(0.0, abs=1e-6)
    # No direction to learn where the teacher stays; only that it stays.
    assert float(direction_loss(moves[:1], torch.zeros(1, 3))) == pytest.approx(0.2)


def test_between_two_minds_the_loss_keeps_moves_long() -> None:
    left = torch.tensor([[-1.0, 0.3, 0.0]])
    right = torch.tensor([[1.0, 0.3, 0.0]])

    def of(move: torch.Tensor) -> float:
        return float(direction_loss(move, left) + direction_loss(move, right))

    middle, forward = torch.tensor([[0.0, 0.3, 0.0]]), torch.tensor([[0.0, 1.044, 0.0]])
    assert of(forward) < of(middle)


def toy() -> ImitationData:
    """The move repeats the first observation of the episode, which later ones do not show."""
    generator = torch.Generator().manual_seed(0)
    first = torch.nn.functional.normalize(torch.randn(300, 3, generator=generator), dim=1)
    lengths = 1 + torch.arange(300) % 4
    observations, actions = [], []
    for direction, length in zip(first, lengths.tolist(), strict=True):
        seen = torch.zeros(length, 3)
        seen[0] = direction
        observations.append(seen)
        actions.append(direction.expand(length, 3))
    return ImitationData(
        observations=torch.cat(observations).half(), actions=torch.cat(actions), lengths=lengths
    )


def test_only_a_recurrent_actor_learns_what_must_be_remembered() -> None:
    config = ImitationFitConfig(steps=300, batch_size=256, learning_rate=1e-2)
    torch.manual_seed(0)
    recurrent = fit_recurrent(RecurrentActor(3, width=32), toy(), config)
    actor = nn.Sequential(nn.Linear(3, 32), nn.ReLU(), nn.Linear(32, 3), nn.Tanh())
    forgetful = fit_actor(actor, toy(), config)
    # 450 of the 750 moves come after the first: their cosine can be 0 at most in the mean.
    assert forgetful > 0.4 and recurrent < 0.5 * forgetful


def test_step_by_step_a_recurrent_actor_says_what_it_says_at_once() -> None:
    torch.manual_seed(0)
    actor = RecurrentActor(5, width=8).eval()
    sequences = [torch.randn(4, 5), torch.randn(2, 5)]
    with torch.no_grad():
        at_once = unpack_sequence(actor(pack_sequence(sequences, enforce_sorted=False)))
        for sequence, wanted in zip(sequences, at_once, strict=True):
            state = torch.zeros(1, 1, 8)
            for row, move in zip(sequence, wanted, strict=True):
                said, state = actor.step(row[None], state)
                torch.testing.assert_close(said[0], move)


def test_a_recurrent_policy_begins_anew_and_survives_its_file(env: Any, tmp_path: Path) -> None:
    parts: tuple[Part, ...] = ("pose", "visible_fraction")
    torch.manual_seed(0)
    policy = RecurrentPolicy(RecurrentActor(8, width=16), parts, {"steps": 3})
    env.reset(seed=3)
    belief = env.unwrapped.belief
    policy.begin(belief, ONE)
    first, second = policy.act(belief), policy.act(belief)
    assert not torch.equal(first, second)
    save_recurrent(tmp_path / "policy.pt", policy)
    loaded = open_policy(tmp_path / "policy.pt", env_id="TomatoViewpointRow-v1")
    assert isinstance(loaded, RecurrentPolicy) and loaded.facts == {"steps": 3}
    loaded.begin(belief, ONE)
    torch.testing.assert_close(loaded.act(belief), first)
    with pytest.raises(PolicyError, match="Sparse"):
        open_policy(tmp_path / "policy.pt", env_id="TomatoViewpointSparse-v1")
    with pytest.raises(InvalidInputError, match="8 numbers"):
        RecurrentPolicy(RecurrentActor(9, width=16), parts)
    with pytest.raises(InvalidInputError, match="viewpoint"):
        columns_of(("viewpoint",))


@pytest.mark.parametrize("student", ["actor", "recurrent"])
def test_a_training_goes_on_where_it_was(student: Any, tmp_path: Path) -> None:
    config = ImitationConfig(
        student=student,
        rounds=(2, 1),
        block=1,
        pool=1,
        fit=ImitationFitConfig(steps=2, batch_size=8),
    )
    options: dict[str, Any] = {"plant": {"row": False, "pool": 1}}
    lines: list[str] = []
    path = train_imitation(tmp_path / "run", config, env_options=options, report=lines.append)
    assert sum("blocks)" in line for line in lines) == 3
    (tmp_path / "run" / "round-1.pt").unlink()
    lines.clear()
    assert train_imitation(tmp_path / "run", config, env_options=options, report=lines.append) == path
    assert not any("blocks)" in line for line in lines)
    env = make_env("TomatoViewpoint-v1", **options)
    try:
        episode = run_episode(env, open_policy(path, env_id="TomatoViewpoint-v1"), 0)
    finally:
        env.close()
    assert 1 <= episode.steps <= 20
    with pytest.raises(InvalidInputError, match="other settings"):
        train_imitation(tmp_path / "run", ImitationConfig(), env_options=options)
