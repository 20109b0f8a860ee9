"""What only training sees: true views for the critics, and sparse plants first."""

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from torch import Tensor

import maniskill_tomato  # noqa: F401
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.learning.rl.agent import make_agent, update
from maniskill_tomato.learning.rl.curriculum import LeafDensityCurriculum
from maniskill_tomato.learning.rl.presets import get_preset
from maniskill_tomato.learning.rl.replay import Batch
from maniskill_tomato.learning.rl.run import train
from maniskill_tomato.plants.row import leaf_density_of
from maniskill_tomato.policies.trained_actor import load_actor
from maniskill_tomato.robot.look_at import look_at_pose, look_frame
from maniskill_tomato.sensing.observation import MAP_SIDE, NEAR_MAP_SIDE, ObservationLayout
from maniskill_tomato.sensing.true_views import TRUE_VIEWS, TrueViews, map_positions
from maniskill_tomato.sensing.view_lattice import ViewLattice
from maniskill_tomato.tasks.row.search_game import SearchGame

SIZE = ObservationLayout().size
SMALL = replace(
    get_preset("general-td3"),
    total_timesteps=40,
    learning_starts=20,
    batch_size=16,
    buffer_size=100,
    actor_hidden=(16,),
    critic_hidden=(16,),
    privileged_critic=True,
)


@pytest.fixture(scope="module")
def env() -> Iterator[Any]:
    env = gym.make(
        "TomatoViewpoint-v1", obs_mode="state", render_backend="none", plant={"pool": 6}, privileged=True
    )
    yield env
    env.close()


def test_maps_stand_where_a_plain_loop_puts_them() -> None:
    camera, target = torch.tensor([0.3, 0.1, 0.6]), torch.tensor([0.8, -0.1, 0.9])
    right, up, forward = look_frame(camera, target).unbind(-1)
    distance = float((camera - target).norm())
    places: list[Tensor] = []
    for side, step, away in ((MAP_SIDE, 10.0, distance), (NEAR_MAP_SIDE, 15.0, max(0.6 * distance, 0.22))):
        for row in range(side):
            for column in range(side):
                across, above = (
                    math.radians(step) * (column - side // 2),
                    math.radians(step) * (side // 2 - row),
                )
                angle = math.hypot(across, above)
                sideways = (across * right + above * up) / angle if angle else torch.zeros(3)
                places.append(target + away * (math.sin(angle) * sideways - math.cos(angle) * forward))
    found = map_positions(camera[None], target[None])[0]
    torch.testing.assert_close(found, torch.stack(places), atol=1e-6, rtol=0)
    torch.testing.assert_close(found[MAP_SIDE**2 // 2], camera)


def test_the_truth_is_read_off_the_lattice_round_the_target() -> None:
    lattice = ViewLattice()
    truth = TrueViews(1, lattice)
    target = torch.tensor([[0.8, 0.1, 0.9]])
    truth.begin(torch.tensor([0]), target, lambda poses, i: (poses[:, 2, 3] - 0.5).clamp(0.0, 1.0))
    candidate = int(lattice.index(6, 5, 1))
    camera = lattice.positions(target)[:, candidate]
    told = truth.describe(camera, target)
    assert told.shape == (1, TRUE_VIEWS)
    centre = 2.0 * float((camera[0, 2] - 0.5).clamp(0.0, 1.0)) - 1.0
    assert float(told[0, MAP_SIDE**2 // 2]) == pytest.approx(centre, abs=1e-5)
    above, below = told[0, : MAP_SIDE**2].view(MAP_SIDE, MAP_SIDE)[[0, -1], MAP_SIDE // 2].tolist()
    assert above > centre > below


def test_the_observation_ends_with_the_truth_and_the_belief_never_has_it(env: Any) -> None:
    base = env.unwrapped
    obs, _ = env.reset(seed=0)
    assert obs.shape == (1, SIZE + TRUE_VIEWS) and base.belief.observation.shape == (1, SIZE)
    assert torch.equal(obs[:, :SIZE], base.belief.observation)
    for _ in range(2):
        # Half-way between candidates the table is interpolated, so that single views differ a little.
        places = map_positions(base.belief.camera_position, base.target_position_w)[0]
        poses = look_at_pose(places, base.target_position_w[0].expand_as(places))
        seen = 2.0 * base.ground_truth.visible_fraction(poses) - 1.0
        told = obs[0, SIZE:]
        inside = told > -1.0
        assert int(inside.sum()) > 30
        assert float((told - seen)[inside].abs().mean()) < 0.25
        assert float(np.corrcoef(told[inside], seen[inside])[0, 1]) > 0.8
        obs, *_ = env.step(np.array([0.5, 0.5, 0.2], dtype=np.float32))


def test_the_actor_is_blind_to_what_the_critics_see() -> None:
    torch.manual_seed(0)
    agent = make_agent(SMALL, SIZE + TRUE_VIEWS, 3)
    a, b = torch.randn(2, 8, SIZE + TRUE_VIEWS).unbind(0)
    b[:, :SIZE] = a[:, :SIZE]
    actions = torch.rand(8, 3) * 2 - 1
    assert torch.equal(agent.policy(a), agent.policy(b))
    values = [agent.critics[0](agent.critic_input(x), actions) for x in (a, b)]
    assert not torch.allclose(*values)
    assert torch.equal(agent.actor_input(a), a[:, :SIZE])


def test_critics_learn_a_value_that_only_the_truth_tells() -> None:
    torch.manual_seed(0)
    config = replace(SMALL, critic_hidden=(64, 64), critic_learning_rate=3e-3)
    errors = {}
    for privileged in (True, False):
        agent = make_agent(replace(config, privileged_critic=privileged), 12 + TRUE_VIEWS * privileged, 3)
        generator = torch.Generator().manual_seed(1)
        logs: dict[str, Tensor] = {}
        for index in range(400):
            truth = torch.rand(128, TRUE_VIEWS, generator=generator)
            seen = torch.rand(128, 12, generator=generator)
            obs = torch.cat([seen, truth], dim=-1) if privileged else seen
            a = torch.rand(128, 3, generator=generator) * 2 - 1
            logs = update(agent, Batch(obs, a, truth[:, 0], obs, torch.ones(128)), index, generator)
        errors[privileged] = float(logs["qf1_loss"])
    # A uniform number has the variance 1/12.
    assert errors[True] < 0.25 / 12 < errors[False]


def test_a_run_with_privileged_critics_leaves_a_policy_of_the_common_observation(
    tmp_path: Path, env: Any
) -> None:
    options = {"plant": {"pool": 2}}
    result = train("TomatoViewpoint-v1", SMALL, tmp_path / "run", 0, options, show_progress=False)
    policy = load_actor(result.policy_path)
    assert policy.observation_dim == SIZE
    env.reset(seed=0)
    assert policy.act(env.unwrapped.belief.observation).shape == (1, 3)
    longer = replace(SMALL, total_timesteps=50)
    again = train(
        "TomatoViewpoint-v1", longer, tmp_path / "run", 0, options, resume=True, show_progress=False
    )
    assert again.steps == 50
    with pytest.raises(InvalidInputError, match="general task"):
        train(
            "TomatoViewpointGuided-v1",
            replace(get_preset("td3"), privileged_critic=True),
            tmp_path / "no",
            0,
            {},
        )


def test_the_limit_of_leaf_density_rises_to_the_tasks() -> None:
    told: list[float] = []
    world = SimpleNamespace(leaf_density_range=(0.8, 1.8), limit_leaf_density=told.append)
    learner: Any = SimpleNamespace(base_env=world)
    curriculum = LeafDensityCurriculum(
        replace(SMALL, leaf_density_start=1.0, leaf_density_steps=100), learner
    )
    for step in (0, 25, 100, 1000):
        curriculum.apply(step)
    assert told == pytest.approx([1.0, 1.2, 1.8, 1.8])
    none = LeafDensityCurriculum(SMALL, learner)
    none.apply(3)
    assert none.limit(3) is None and len(told) == 4
    with pytest.raises(InvalidInputError, match=r"0\.8 to 1\.8"):
        LeafDensityCurriculum(replace(SMALL, leaf_density_start=0.7), learner)
    nothing: Any = SimpleNamespace()
    with pytest.raises(InvalidInputError, match="leaf density"):
        LeafDensityCurriculum(replace(SMALL, leaf_density_start=1.0), nothing)


def test_plants_keep_to_the_limit_of_leaf_density(env: Any) -> None:
    base = env.unwrapped
    assert base.leaf_density_range == (0.8, 1.8)
    of_pool = {seed: leaf_density_of((0.8, 1.8), seed) or 0.0 for seed in range(6)}
    limit = sorted(of_pool.values())[2]
    base.limit_leaf_density(limit)
    drawn = set()
    for seed in range(12):
        env.reset(seed=seed)
        drawn.add(int(base.planting.seeds[0]))
    assert drawn == {seed for seed, density in of_pool.items() if density <= limit}
    base.limit_leaf_density(1.8)
    assert {_plant(env, seed) for seed in range(30)} == set(of_pool)
    with pytest.raises(InvalidInputError, match="above"):
        base.limit_leaf_density(0.5)
    base.limit_leaf_density(0.5 * (0.8 + min(of_pool.values())))
    with pytest.raises(InvalidInputError, match="raise the limit"):
        env.reset(seed=0)
    base.limit_leaf_density(1.8)


def test_a_run_with_a_curriculum_meets_sparse_plants_first(tmp_path: Path, monkeypatch: Any) -> None:
    asked: list[float] = []
    monkeypatch.setattr(SearchGame, "limit_leaf_density", lambda self, highest: asked.append(highest))
    config = replace(SMALL, privileged_critic=False, leaf_density_start=1.3, leaf_density_steps=20)
    train("TomatoViewpoint-v1", config, tmp_path / "run", 0, {"plant": {"pool": 2}}, show_progress=False)
    # Before the first reset, then before each of the 40 steps.
    assert asked == pytest.approx([1.3, *(1.3 + 0.5 * min(k / 20, 1.0) for k in range(40))])


def _plant(env: Any, seed: int) -> int:
    env.reset(seed=seed)
    return int(env.unwrapped.planting.seeds[0])
