"""Moves of the `pd_look_at` control mode: geometry by hand, and what the arm does when it cannot."""

import math
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

import maniskill_tomato  # noqa: F401
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot import look_at_move
from maniskill_tomato.robot.inverse_kinematics import Reach
from maniskill_tomato.robot.kinematics import forward_kinematics
from maniskill_tomato.robot.look_at import flange_to_camera
from maniskill_tomato.robot.look_at_move import (
    LARGEST_JOINT_STEP,
    MAX_MOVE,
    MIN_DISTANCE,
    LookAtMover,
    keeps_clear,
    moved_position,
)
from maniskill_tomato.tasks.maniskill.iiwa14_agent import READY_QPOS

TARGET = torch.tensor([[0.8, 0.0, 0.7]], dtype=torch.float64)


def vector(*values: float) -> torch.Tensor:
    return torch.tensor([values], dtype=torch.float64)


@pytest.mark.parametrize(
    ("action", "moved"),
    [
        # A camera at (0.3, 0, 0.7) looks along +x: right is -y, up is +z.
        ((1.0, 0.0, 0.0), (0.3, -0.12, 0.7)),
        ((0.0, 1.0, 0.0), (0.3, 0.0, 0.82)),
        ((0.0, 0.0, 1.0), (0.42, 0.0, 0.7)),
        ((0.0, 0.0, -0.5), (0.24, 0.0, 0.7)),
        # Longer than 1 is cut to 1, shorter is not.
        ((1.0, 1.0, 0.0), (0.3, -0.12 / math.sqrt(2), 0.7 + 0.12 / math.sqrt(2))),
        ((0.0, 0.0, 0.0), (0.3, 0.0, 0.7)),
    ],
)
def test_an_action_moves_the_camera_in_its_look_frame(
    action: tuple[float, ...], moved: tuple[float, ...]
) -> None:
    found = moved_position(vector(0.3, 0.0, 0.7), TARGET, vector(*action))
    torch.testing.assert_close(found, vector(*moved), atol=1e-12, rtol=0)


def test_the_camera_keeps_its_smallest_distance_even_through_the_target() -> None:
    near = moved_position(vector(0.55, 0.0, 0.7), TARGET, vector(0.0, 0.0, 1.0))
    torch.testing.assert_close(near, vector(0.8 - MIN_DISTANCE, 0.0, 0.7), atol=1e-12, rtol=0)
    onto = moved_position(vector(0.8 - MAX_MOVE, 0.0, 0.7), TARGET, vector(0.0, 0.0, 1.0))
    torch.testing.assert_close(onto, vector(0.8 - MIN_DISTANCE, 0.0, 0.7), atol=1e-9, rtol=0)


def start(mover: LookAtMover) -> tuple[torch.Tensor, torch.Tensor]:
    first = mover.look_from(
        torch.as_tensor(READY_QPOS)[None], vector(0.3, 0.1, 0.75), TARGET, largest_joint_step=10.0
    )
    assert int(first.reach[0]) == Reach.REACHABLE
    return first.qpos, first.T_world_camera[:, :3, 3]


def test_after_a_move_the_joints_hold_the_camera_where_it_should_be_looking_at_the_target() -> None:
    mover, rng = LookAtMover(), np.random.default_rng(0)
    reaches = []
    for _ in range(60):
        qpos, position = start(mover)
        for _ in range(4):
            action = torch.as_tensor(rng.normal(size=(1, 3)))
            move = mover.move(qpos, position, TARGET, action)
            reaches.append(int(move.reach[0]))
            T = flange_to_camera(forward_kinematics(move.qpos))
            if reaches[-1] == Reach.UNREACHABLE:
                assert torch.equal(move.qpos, qpos)
                continue
            torch.testing.assert_close(T, move.T_world_camera, atol=1e-6, rtol=0)
            towards = TARGET - T[:, :3, 3]
            forward = towards / towards.norm()
            torch.testing.assert_close(T[:, :3, 2], forward, atol=1e-6, rtol=0)
            asked = moved_position(position, TARGET, action)
            if reaches[-1] == Reach.REACHABLE:
                torch.testing.assert_close(T[:, :3, 3], asked, atol=1e-6, rtol=0)
            else:
                assert float((T[:, :3, 3] - position).norm()) <= 0.51 * MAX_MOVE + 1e-9
            assert float((move.qpos - qpos).abs().max()) <= LARGEST_JOINT_STEP
            assert bool(keeps_clear(forward_kinematics(move.qpos)).all())
            qpos, position = move.qpos, T[:, :3, 3]
    assert reaches.count(0) > 100


def test_a_batch_gives_what_its_rows_give_alone() -> None:
    mover, rng = LookAtMover(), np.random.default_rng(3)
    qpos, position = start(mover)
    far = vector(0.0, 0.0, 0.75)
    actions = torch.as_tensor(rng.normal(size=(40, 3)))
    positions = torch.cat([position.expand(30, 3), far.expand(10, 3)])
    batch = mover.move(qpos.expand(40, 7), positions, TARGET.expand(40, 3), actions)
    for k in range(40):
        alone = mover.move(qpos, positions[k : k + 1], TARGET, actions[k : k + 1])
        assert int(alone.reach[0]) == int(batch.reach[k])
        torch.testing.assert_close(alone.qpos[0], batch.qpos[k])
    assert len(set(batch.reach.tolist())) > 1


def test_a_move_that_upright_pictures_forbid_is_made_with_a_turned_one() -> None:
    mover, rng = LookAtMover(), np.random.default_rng(1)
    qpos, _ = start(mover)
    turned = 0
    for _ in range(200):
        position = torch.as_tensor(rng.uniform([[0.2, -0.5, 0.3]], [[0.7, 0.5, 1.0]]))
        upright = mover.look_from(qpos, position, TARGET, rolls=1)
        free = mover.look_from(qpos, position, TARGET)
        if int(upright.reach[0]) == Reach.REACHABLE:
            # Where the upright picture is possible it is taken.
            torch.testing.assert_close(upright.qpos, free.qpos)
        elif int(free.reach[0]) == Reach.REACHABLE:
            turned += 1
            # The picture's x axis is turned by 30 degrees or more.
            cosine = float((free.T_world_camera[0, :3, 0] * upright.T_world_camera[0, :3, 0]).sum())
            assert cosine < math.cos(math.radians(29.0))
    assert turned > 3


def test_the_floor_and_the_base_are_kept_clear_of() -> None:
    T = torch.eye(4, dtype=torch.float64).repeat(4, 1, 1)
    T[:, :3, 3] = torch.tensor(
        [[0.5, 0.0, 0.1], [0.5, 0.0, 0.2], [0.1, 0.1, 0.2], [0.1, 0.1, 0.3]], dtype=torch.float64
    )
    assert keeps_clear(T).tolist() == [False, True, False, True]


def test_bad_shapes_are_refused() -> None:
    with pytest.raises(InvalidInputError, match="action"):
        LookAtMover().move(torch.zeros(1, 7), torch.zeros(1, 3), torch.zeros(1, 3), torch.zeros(1, 6))


@pytest.mark.parametrize("motion", ["kinematic", "dynamic"])
def test_the_control_mode_works_on_the_thesis_tasks_too(motion: str) -> None:
    env: Any = gym.make(
        "TomatoViewpointSparse-v1",
        num_envs=1,
        obs_mode="state",
        render_backend="none",
        control_mode="pd_look_at",
        motion=motion,
    )
    env.reset(seed=0)
    target = env.unwrapped.target_position_w
    obs, *_, info = env.step(np.zeros(3, dtype=np.float32))
    T = flange_to_camera(forward_kinematics(env.unwrapped.agent.robot.get_qpos().double()))
    towards = (target - T[:, :3, 3]) / (target - T[:, :3, 3]).norm()
    assert int(info["reachability"][0]) != Reach.UNREACHABLE
    # Joint drives settle to a milliradian.
    torch.testing.assert_close(T[0, :3, 2], towards[0].double(), atol=5e-3, rtol=0)
    env.close()


def test_nothing_moves_without_a_target() -> None:
    env: Any = gym.make(
        "Empty-v1", robot_uids="iiwa14_d435", control_mode="pd_look_at", render_backend="none"
    )
    env.reset(seed=0)
    with pytest.raises(InvalidInputError, match="target_position"):
        env.step(np.zeros(3, dtype=np.float32))
    env.close()


def test_the_published_numbers_are_those_of_the_task() -> None:
    assert (look_at_move.MAX_MOVE, look_at_move.MIN_DISTANCE) == (0.12, 0.2)
