"""Episodes of the viewpoint tasks through the gym interface, without a renderer."""

import math
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

import maniskill_tomato  # noqa: F401
from maniskill_tomato.robot.iiwa14 import JOINT_UPPER
from maniskill_tomato.robot.inverse_kinematics import InverseKinematics, Reach
from maniskill_tomato.robot.kinematics import forward_kinematics
from maniskill_tomato.tasks import TASK_IDS

GUIDED = "TomatoViewpointGuided-v1"
SPARSE = "TomatoViewpointSparse-v1"
BOXES = {
    GUIDED: (
        [-0.1, -0.35, 0.65, 0.0, 0.45 * math.pi, 0.0],
        [0.2, 0.1, 1.15, 0.0, 0.7 * math.pi, 0.25 * math.pi],
    ),
    SPARSE: (
        [-0.1, -0.25, 0.65, 0.0, 0.45 * math.pi, -math.pi / 8],
        [0.2, 0.25, 1.15, 0.0, 0.7 * math.pi, math.pi / 8],
    ),
}


def rotation(rpy: torch.Tensor) -> torch.Tensor:
    """Rz(yaw) Ry(pitch) Rx(roll) of angles [rad]. Shape (3,) to (3, 3), float64."""
    return torch.from_numpy(Rotation.from_euler("xyz", rpy.double().numpy()).as_matrix())


def make(env_id: str, **kwargs: Any) -> Any:
    return gym.make(
        env_id, num_envs=1, obs_mode="state", reward_mode="dense", render_backend="none", **kwargs
    )


@pytest.fixture(scope="module", params=[GUIDED, SPARSE])
def env(request: pytest.FixtureRequest) -> Iterator[Any]:
    env = make(request.param)
    yield env
    env.close()


@pytest.fixture(scope="module")
def guided() -> Iterator[Any]:
    env = make(GUIDED)
    yield env
    env.close()


@pytest.fixture(scope="module")
def sparse() -> Iterator[Any]:
    env = make(SPARSE)
    yield env
    env.close()


def test_state_observation_is_the_nine_numbers_of_the_thesis(env: Any) -> None:
    obs, _ = env.reset(seed=3)
    assert obs.shape == (1, 9) and obs.dtype == torch.float32
    base = env.unwrapped
    T = forward_kinematics(base.agent.robot.get_qpos().double())[0]
    torch.testing.assert_close(obs[0, :3].double(), T[:3, 3], atol=1e-6, rtol=0)
    torch.testing.assert_close(rotation(obs[0, 3:6]), T[:3, :3], atol=1e-6, rtol=0)
    torch.testing.assert_close(obs[0, 6:], base.target_position_w[0])


def test_start_poses_fill_the_box_of_the_thesis_and_are_reached(env: Any) -> None:
    low, high = BOXES[env.unwrapped.spec.id]
    starts = torch.stack([env.reset(seed=s)[0][0, :6] for s in range(200)])
    assert (starts >= torch.tensor(low) - 1e-6).all() and (starts <= torch.tensor(high) + 1e-6).all()
    spread = (starts.amax(0) - starts.amin(0)) / (torch.tensor(high) - torch.tensor(low)).clamp(min=1e-9)
    assert (spread[[0, 1, 2, 4, 5]] > 0.85).all()


def test_increment_moves_the_end_effector_by_just_that(env: Any) -> None:
    obs, _ = env.reset(seed=0, options={"viewpoint": [0.15, -0.05, 0.85, 0.0, 1.6, 0.1]})
    action = torch.tensor([0.03, -0.02, 0.05, 0.04, -0.06, 0.08])
    after, _, _, _, info = env.step(action)
    assert int(info["reachability"]) == Reach.REACHABLE
    torch.testing.assert_close(after[0, :6], obs[0, :6] + action, atol=1e-6, rtol=0)
    T = forward_kinematics(env.unwrapped.agent.robot.get_qpos().double())[0]
    torch.testing.assert_close(T[:3, 3], after[0, :3].double(), atol=1e-6, rtol=0)
    torch.testing.assert_close(T[:3, :3], rotation(after[0, 3:6]), atol=1e-6, rtol=0)


def test_actions_are_clipped_to_one_metre_and_one_radian(guided: Any) -> None:
    start = [0.15, -0.05, 0.85, 0.0, 1.6, 0.1]
    results = []
    for yaw in (1.0, 7.0):
        guided.reset(seed=0, options={"viewpoint": start})
        results.append(guided.step(np.array([0, 0, 0, 0, 0, yaw], dtype=np.float32))[0])
    torch.testing.assert_close(results[0], results[1])


def test_info_has_the_names_and_shapes_that_others_build_on(env: Any) -> None:
    env.reset(seed=1)
    _, reward, terminated, truncated, info = env.step(np.zeros(6, dtype=np.float32))
    for key in (
        "success",
        "visible_fraction",
        "target_id",
        "reachability",
        "in_forbidden_zone",
        "reward_visual",
        "reward_penalty",
    ):
        assert info[key].shape == (1,), key
    assert reward.shape == terminated.shape == truncated.shape == (1,)
    target = env.unwrapped.segmentation_id_map[int(info["target_id"])]
    assert "fruit" in target.name


def test_reward_is_the_sum_of_its_terms_within_the_task_bounds(env: Any) -> None:
    env.action_space.seed(0)
    for seed in range(30):
        env.reset(seed=seed)
        for _ in range(3):
            _, reward, _, _, info = env.step(0.3 * env.action_space.sample())
            total = float(info["reward_visual"] + info["reward_penalty"])
            if env.unwrapped.spec.id == SPARSE:
                total = max(-1.0, min(1.0, total))
            assert float(reward) == pytest.approx(total, abs=1e-6)


def test_guided_sends_the_arm_home_from_outside_the_workspace(guided: Any) -> None:
    guided.reset(seed=0, options={"viewpoint": [0.15, -0.05, 0.85, 0.0, 1.6, 0.1]})
    obs, reward, terminated, _, info = guided.step(np.array([1.0, 1.0, 1.0, 0, 0, 0], dtype=np.float32))
    assert int(info["reachability"]) == Reach.UNREACHABLE
    assert not bool(terminated)
    torch.testing.assert_close(guided.unwrapped.agent.robot.get_qpos(), torch.zeros(1, 7))
    torch.testing.assert_close(obs[0, :6], torch.tensor([0.0, 0.0, 1.306, 0.0, 0.0, 0.0]), atol=1e-6, rtol=0)
    assert float(reward) == pytest.approx(-0.1 - 0.3)


def test_sparse_ends_outside_the_workspace_with_the_arm_where_it_was(sparse: Any) -> None:
    before, _ = sparse.reset(seed=0, options={"viewpoint": [0.15, -0.05, 0.85, 0.0, 1.6, 0.1]})
    after, reward, terminated, _, info = sparse.step(np.array([1.0, 1.0, 1.0, 0, 0, 0], dtype=np.float32))
    assert int(info["reachability"]) == Reach.UNREACHABLE
    assert bool(terminated) and not bool(info["success"])
    torch.testing.assert_close(after, before)
    assert -1.0 <= float(reward) <= -0.9


def overreach(distance: float) -> list[float]:
    """From (0.55, 0, 0.6), looking along +x, this far beyond the arm's reach along x."""
    # The wrist is 0.126 m behind the flange and 0.82 m from the shoulder (0, 0, 0.36) at full reach.
    limit = math.sqrt(0.82**2 - (0.6 - 0.36) ** 2) + 0.126
    return [limit + distance - 0.55, 0.0, 0.0, 0.0, 0.0, 0.0]


def test_pose_just_out_of_reach_becomes_a_neighbour_pose_in_the_guided_task_only(
    guided: Any, sparse: Any
) -> None:
    start = {"viewpoint": [0.55, 0.0, 0.6, 0.0, math.pi / 2, 0.0]}
    action = np.array(overreach(0.03), dtype=np.float32)
    guided.reset(seed=0, options=start)
    obs, _, _, _, info = guided.step(action)
    assert int(info["reachability"]) == Reach.NEIGHBOUR
    # x is beyond 0.7 m there, so the forbidden zone's penalty comes on top.
    assert float(info["reward_penalty"]) == pytest.approx(-0.1 - 1.5)
    assert float((obs[0, :3] - torch.tensor([0.55 + action[0], 0.0, 0.6])).norm()) <= 0.05 + 1e-6
    sparse.reset(seed=0, options=start)
    _, _, terminated, _, info = sparse.step(action)
    assert int(info["reachability"]) == Reach.UNREACHABLE and bool(terminated)


def test_forbidden_zone_is_told_and_punished(guided: Any) -> None:
    guided.reset(seed=0, options={"viewpoint": [0.65, 0.0, 0.6, 0.0, math.pi / 2, 0.0]})
    _, _, _, _, info = guided.step(np.array([0.1, 0, 0, 0, 0, 0], dtype=np.float32))
    assert bool(info["in_forbidden_zone"])
    assert float(info["reward_penalty"]) == pytest.approx(-1.5)


def test_episode_is_truncated_after_thirty_steps(guided: Any) -> None:
    # Looking straight up the target is never seen.
    guided.reset(seed=0, options={"viewpoint": [0.3, 0.0, 1.0, 0.0, 0.2, 0.0]})
    for step in range(1, 31):
        _, reward, terminated, truncated, _ = guided.step(np.zeros(6, dtype=np.float32))
        assert float(reward) == pytest.approx(-0.5)
        assert not bool(terminated)
        assert bool(truncated) is (step == 30)


def test_success_ends_the_episode(env: Any) -> None:
    base = env.unwrapped
    threshold = {GUIDED: 0.85, SPARSE: 0.8}[base.spec.id]
    rng = np.random.default_rng(0)
    outcomes = set()
    for seed in range(400):
        obs, _ = env.reset(seed=seed)
        goal = sample_view(obs[0, 6:], rng)
        _, reward, terminated, _, info = env.step((goal - obs[0, :6]).numpy())
        if int(info["reachability"]) != Reach.REACHABLE:
            continue
        success = bool(info["visible_fraction"] > threshold)
        assert bool(info["success"]) is success and bool(terminated) is success
        outcomes.add(success)
        if success and not bool(info["in_forbidden_zone"]):
            assert float(reward) == pytest.approx(
                float(info["visible_fraction"]) + 0.5 if base.spec.id == GUIDED else 1.0
            )
    assert outcomes == {True, False}


def sample_view(target: Tensor, rng: np.random.Generator) -> Tensor:
    """A random viewpoint 0.3 to 0.5 m from the target that looks at it."""
    azimuth, elevation, distance = rng.uniform(-1.3, 1.3), rng.uniform(-0.8, 0.5), rng.uniform(0.3, 0.5)
    direction = np.array(
        [
            math.cos(elevation) * math.cos(azimuth),
            math.cos(elevation) * math.sin(azimuth),
            -math.sin(elevation),
        ]
    )
    position = target.numpy() - distance * direction
    return torch.tensor([*position, 0.0, math.pi / 2 + elevation, azimuth], dtype=torch.float32)


def test_target_differs_by_episode_and_is_a_ripe_fruit(sparse: Any) -> None:
    base = sparse.unwrapped
    targets = []
    for seed in range(60):
        sparse.reset(seed=seed)
        targets.append(int(base.target_fruit[0]))
    assert set(targets) == set(base.plant_batch.ripe_fruits[0]) and len(set(targets)) == 3
    assert min(targets.count(t) for t in set(targets)) >= 8


def test_target_can_be_chosen_at_reset(sparse: Any) -> None:
    ids = set()
    for target in sparse.unwrapped.plant_batch.ripe_fruits[0]:
        _, info = sparse.reset(seed=0, options={"target": target})
        assert int(sparse.unwrapped.target_fruit[0]) == target
        ids.add(int(info["target_id"]))
    assert len(ids) == 3


def test_home_looks_at_the_sky(guided: Any) -> None:
    guided.reset(seed=0)
    _, _, _, _, info = guided.step(np.array([1.0, 1.0, 1.0, 0, 0, 0], dtype=np.float32))
    assert float(info["visible_fraction"]) == 0.0 and not bool(info["success"])


def test_dynamic_motion_arrives_where_kinematic_motion_puts_the_arm() -> None:
    start = {"viewpoint": [0.15, -0.05, 0.85, 0.0, 1.6, 0.1]}
    action = np.array([0.1, -0.1, 0.05, 0.1, -0.1, 0.2], dtype=np.float32)
    seen = {}
    for motion in ("kinematic", "dynamic"):
        env = make(GUIDED, motion=motion)
        env.reset(seed=0, options=start)
        obs, _, _, _, info = env.step(action)
        seen[motion] = (obs[0, :6].clone(), float(info["visible_fraction"]))
        env.close()
    torch.testing.assert_close(seen["dynamic"][0], seen["kinematic"][0], atol=2e-3, rtol=0)
    assert seen["dynamic"][1] == pytest.approx(seen["kinematic"][1], abs=0.05)
    assert not torch.equal(seen["dynamic"][0], seen["kinematic"][0])


@pytest.mark.parametrize(
    "control_mode",
    ["pd_joint_pos", "pd_joint_delta_pos", "pd_ee_delta_pos", "pd_ee_delta_pose", "pd_ee_pose"],
)
@pytest.mark.parametrize("motion", ["kinematic", "dynamic"])
def test_usual_control_modes_work_on_the_task(control_mode: str, motion: str) -> None:
    env = make(GUIDED, control_mode=control_mode, motion=motion)
    obs, _ = env.reset(seed=0)
    assert env.action_space.shape is not None
    qpos = env.unwrapped.agent.robot.get_qpos()[0].numpy()
    action = np.zeros(env.action_space.shape, dtype=np.float32)
    if control_mode == "pd_joint_pos":
        action[:] = qpos
        action[0] += 0.1
    elif control_mode == "pd_ee_pose":
        action[:3] = obs[0, :3].numpy() + np.array([0.0, 0.02, 0.0])
        action[3:6] = obs[0, 3:6].numpy()
    else:
        action[1] = 0.5
    for _ in range(5):
        obs, _, _, _, _ = env.step(action)
    T = forward_kinematics(env.unwrapped.agent.robot.get_qpos().double())[0]
    torch.testing.assert_close(obs[0, :3].double(), T[:3, 3], atol=1e-5, rtol=0)
    assert float((env.unwrapped.agent.robot.get_qpos()[0] - torch.as_tensor(qpos)).abs().max()) > 0.005
    env.close()


@pytest.mark.parametrize("control_mode", ["pd_joint_delta_pos", "pd_ee_delta_pos", "pd_ee_delta_pose"])
def test_no_control_mode_puts_a_joint_beyond_its_limit(control_mode: str) -> None:
    env = make(GUIDED, control_mode=control_mode)
    robot, limits = env.unwrapped.agent.robot, torch.tensor(JOINT_UPPER, dtype=torch.float32)
    env.action_space.seed(0)
    close = 0.0
    for seed in (10, 30, 33, 35):
        env.reset(seed=seed)
        action = env.action_space.sample()
        for _ in range(29):
            env.step(action)
            close = max(close, float((robot.get_qpos().abs() / limits).max()))
            assert close <= 1.0 + 1e-6
    assert close > 0.9
    env.close()


@pytest.mark.parametrize("env_id", TASK_IDS)
def test_pd_ee_delta_pos_moves_the_flange_in_tenths_of_a_metre_or_not_at_all(env_id: str) -> None:
    """Against the closed-form inverse kinematics, which says what the arm can reach, and forward kinematics."""
    env: Any = gym.make(env_id, control_mode="pd_ee_delta_pos", obs_mode="state", render_backend="none")
    robot = env.unwrapped.agent.robot
    exact = InverseKinematics()
    rng = np.random.default_rng(0)
    reached = stayed = 0
    for seed in range(12):
        env.reset(seed=seed)
        qpos = robot.get_qpos().double()
        wanted = forward_kinematics(qpos)
        action = rng.uniform(-1.5, 1.5, 3).astype(np.float32)
        wanted[0, :3, 3] += 0.1 * torch.from_numpy(action.clip(-1.0, 1.0)).double()
        env.step(action)
        there = forward_kinematics(robot.get_qpos().double())
        if torch.equal(robot.get_qpos().double(), qpos):
            stayed += 1
            continue
        # ManiSkill's solver stops at an error of 1e-4.
        torch.testing.assert_close(there, wanted, atol=1e-3, rtol=0)
        assert int(exact.solve(wanted, qpos, neighbour=False).reach[0]) == Reach.REACHABLE
        reached += 1
    assert reached >= 6, (reached, stayed)
    env.close()
