"""The ManiSkill agent in an empty scene: loading, control modes, cameras."""

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import sapien
import torch
from mani_skill.agents.registration import REGISTERED_AGENTS
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.registration import register_env
from mani_skill.utils.structs import Pose

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot import d435, iiwa14
from maniskill_tomato.robot import robot_description as description
from maniskill_tomato.robot.kinematics import link_transforms
from maniskill_tomato.tasks.maniskill import iiwa14_agent as agent_module
from maniskill_tomato.tasks.maniskill.iiwa14_agent import READY_QPOS, REST_QPOS, D435CameraConfig, Iiwa14D435

ENV_ID = "TestEmptyIiwa-v0"
CUBE_AT = np.array([0.75, 0.10, 0.85])
"""Where the coloured cube stands, in the world frame, in [m]."""


@register_env(ENV_ID, max_episode_steps=1000)
class EmptyIiwaEnv(BaseEnv):  # type: ignore[misc]
    """The robot in its ready pose and, in front of it, a red cube without collisions."""

    SUPPORTED_ROBOTS = ["iiwa14_d435", "iiwa14_d435_raw_depth"]

    def _load_agent(self, options: dict[str, Any], *args: Any, **kwargs: Any) -> None:
        super()._load_agent(options, sapien.Pose())

    def _load_scene(self, options: dict[str, Any]) -> None:
        builder: Any = self.scene.create_actor_builder()
        builder.add_box_visual(
            half_size=[0.02, 0.02, 0.02],
            material=sapien.render.RenderMaterial(base_color=[1.0, 0.0, 0.0, 1.0]),
        )
        builder.initial_pose = sapien.Pose(CUBE_AT.tolist())
        self.cube = builder.build_static(name="cube")

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict[str, Any]) -> None:
        self.agent.reset(torch.tensor(READY_QPOS, dtype=torch.float32))

    def evaluate(self) -> dict[str, Any]:
        return {}


def make(**kwargs: Any) -> Any:
    options: dict[str, Any] = dict(
        robot_uids="iiwa14_d435", render_backend="none", obs_mode="state", reward_mode="none"
    )
    env = gym.make(ENV_ID, **(options | kwargs))
    env.reset(seed=0)
    return env


@pytest.fixture(scope="module")
def joint_env() -> Iterator[Any]:
    env = make(control_mode="pd_joint_pos")
    yield env
    env.close()


def flange_pose(env: Any) -> np.ndarray:
    return np.asarray(env.unwrapped.agent.ee_link.pose.to_transformation_matrix()[0].cpu(), dtype=np.float64)


def rotation_vector(rotation: np.ndarray) -> np.ndarray:
    """Axis times angle of a rotation below 180 degrees."""
    axis = np.array(
        [
            rotation[2, 1] - rotation[1, 2],
            rotation[0, 2] - rotation[2, 0],
            rotation[1, 0] - rotation[0, 1],
        ]
    )
    sine = np.linalg.norm(axis) / 2
    return axis / 2 if sine < 1e-9 else axis / (2 * sine) * np.arctan2(sine, (np.trace(rotation) - 1) / 2)


def test_both_agents_are_registered() -> None:
    assert REGISTERED_AGENTS["iiwa14_d435"].agent_cls is Iiwa14D435
    assert "iiwa14_d435_raw_depth" in REGISTERED_AGENTS


def test_sapien_and_the_closed_form_agree_on_every_link(joint_env: Any) -> None:
    robot = joint_env.unwrapped.agent.robot
    rng = np.random.default_rng(2)
    for qpos in rng.uniform(iiwa14.JOINT_LOWER, iiwa14.JOINT_UPPER, (20, 7)):
        robot.set_qpos(torch.tensor(qpos, dtype=torch.float32)[None])
        expected = link_transforms(torch.from_numpy(qpos)[None])[0].numpy()
        for name, pose in zip(iiwa14.LINK_NAMES, expected, strict=True):
            actual = robot.links_map[name].pose.to_transformation_matrix()[0].numpy()
            np.testing.assert_allclose(actual, pose, atol=1e-5, err_msg=name)
        color = robot.links_map["camera_color_frame"].pose.to_transformation_matrix()[0].numpy()
        np.testing.assert_allclose(color, expected[-1] @ d435.T_flange_camera_color, atol=1e-5)


def test_sapien_has_the_limits_and_masses_of_the_urdf(joint_env: Any) -> None:
    robot = joint_env.unwrapped.agent.robot
    assert [joint.name for joint in robot.active_joints] == list(iiwa14.JOINT_NAMES)
    limits = robot.get_qlimits()[0].numpy()
    np.testing.assert_allclose(
        limits, np.deg2rad([[-a, a] for a in (170, 120, 170, 120, 170, 120, 175)]), atol=1e-6
    )
    masses = {link.name: float(link.mass[0]) for link in robot.links}
    assert sum(masses[f"link_{i}"] for i in range(8)) == pytest.approx(29.9, abs=1e-4)
    # Frames without a body must not weigh on the wrist.
    assert sum(masses.values()) == pytest.approx(29.9 + 0.072 + 0.030, abs=1e-3)


def test_keyframes_are_within_limits_and_where_they_say() -> None:
    frames = {name: np.asarray(k.qpos, dtype=np.float64) for name, k in Iiwa14D435.keyframes.items()}
    assert set(frames) == {"home", "ready", "rest"}
    for name, qpos in frames.items():
        assert (np.abs(qpos) < iiwa14.JOINT_UPPER).all(), name
    poses = {n: link_transforms(torch.from_numpy(q)[None])[0, -1].numpy() for n, q in frames.items()}
    np.testing.assert_allclose(poses["home"][:3, 3], [0, 0, 1.306], atol=1e-9)
    np.testing.assert_allclose(poses["ready"][:3, 3], [0.1, 0, 0.9], atol=1e-9)
    # Looking along +x, roll 0 and pitch pi/2: the flange's x axis points down, its y axis to the left.
    np.testing.assert_allclose(poses["ready"][:3, :3], [[0, 0, 1], [0, 1, 0], [-1, 0, 0]], atol=1e-9)
    np.testing.assert_allclose(poses["rest"][:3, 2], [0, 0, -1], atol=1e-9)
    assert poses["rest"][2, 3] > 0.5


def test_the_named_control_modes_are_the_ones_there_are(joint_env: Any) -> None:
    agent = joint_env.unwrapped.agent
    assert tuple(agent.supported_control_modes) == Iiwa14D435.CONTROL_MODES
    others = {"pd_joint_pos", "pd_joint_delta_pos", "pd_ee_delta_pos", "pd_ee_delta_pose", "pd_ee_pose"}
    assert others < set(Iiwa14D435.CONTROL_MODES)


def test_pd_joint_pos_settles_on_the_target_in_half_a_second(joint_env: Any) -> None:
    joint_env.reset(seed=0)
    robot = joint_env.unwrapped.agent.robot
    target = READY_QPOS + np.array([0.3, 0.2, -0.2, 0.2, 0.3, -0.3, 0.4])
    farthest = np.zeros(7)
    for _ in range(10):  # 20 Hz
        joint_env.step(target.astype(np.float32))
        share = (robot.get_qpos()[0].numpy() - READY_QPOS) / (target - READY_QPOS)
        farthest = np.maximum(farthest, share)
    np.testing.assert_allclose(robot.get_qpos()[0].numpy(), target, atol=2e-3)
    assert farthest.max() < 1.01, "the joints overshoot"


def test_the_stretched_arm_does_not_overshoot_either(joint_env: Any) -> None:
    joint_env.reset(seed=0)
    robot = joint_env.unwrapped.agent.robot
    start = np.array([0.0, 1.2, 0.0, -0.2, 0.0, 0.2, 0.0])
    robot.set_qpos(torch.tensor(start, dtype=torch.float32)[None])
    target = start + np.array([0.5, -0.5, 0, 0, 0, 0, 0])
    first = []
    for _ in range(20):
        joint_env.step(target.astype(np.float32))
        first.append(robot.get_qpos()[0, :2].numpy() - start[:2])
    assert max(f[0] for f in first) < 0.505 and min(f[1] for f in first) > -0.505
    np.testing.assert_allclose(robot.get_qpos()[0].numpy(), target, atol=2e-3)


def test_pd_joint_delta_pos_moves_each_joint_by_its_own_increment() -> None:
    env = make(control_mode="pd_joint_delta_pos")
    robot = env.unwrapped.agent.robot
    assert env.action_space.shape == (7,)
    for joint in range(7):
        env.reset(seed=0)
        action = np.zeros(7, dtype=np.float32)
        action[joint] = 1.0
        env.step(action)
        moved = robot.get_qpos()[0].numpy() - READY_QPOS
        assert moved.argmax() == joint
        assert 0.3 * agent_module.JOINT_STEP < moved[joint] < 1.01 * agent_module.JOINT_STEP
        assert np.abs(np.delete(moved, joint)).max() < 0.05 * agent_module.JOINT_STEP
    env.close()


def test_pd_ee_delta_pose_moves_and_turns_the_way_the_action_says() -> None:
    env = make(control_mode="pd_ee_delta_pose")
    assert env.action_space.shape == (6,)
    for axis in range(6):
        for sign in (1.0, -1.0):
            env.reset(seed=0)
            before = flange_pose(env)
            action = np.zeros(6, dtype=np.float32)
            action[axis] = sign
            env.step(action)
            after = flange_pose(env)
            moved = np.concatenate(
                [after[:3, 3] - before[:3, 3], rotation_vector(after[:3, :3] @ before[:3, :3].T)]
            )
            assert np.abs(moved).argmax() == axis, (axis, sign, moved)
            assert 0.03 < sign * moved[axis] < 0.105, (axis, sign, moved)
    env.close()


def test_pd_ee_delta_pos_drives_along_the_bases_axes_and_keeps_the_orientation() -> None:
    env = make(control_mode="pd_ee_delta_pos")
    assert env.action_space == gym.spaces.Box(-1.0, 1.0, (3,), np.float32)
    for axis in range(3):
        for sign in (1.0, -1.0):
            env.reset(seed=0)
            before = flange_pose(env)
            env.step(sign * np.eye(3, dtype=np.float32)[axis])
            after = flange_pose(env)
            moved = after[:3, 3] - before[:3, 3]
            assert np.abs(moved).argmax() == axis, (axis, sign, moved)
            assert 0.03 < sign * moved[axis] < 0.105, (axis, sign, moved)
            # 50 ms into the move the joints lag by different shares of their way; the tasks' tests put them there.
            assert np.linalg.norm(rotation_vector(after[:3, :3] @ before[:3, :3].T)) < 0.1
    env.close()


def test_pd_ee_pose_goes_to_the_pose_asked_for() -> None:
    env = make(control_mode="pd_ee_pose")
    # ManiSkill's angles are about the moving axes x, y, z: y by pi/2 - 0.2 looks along +x and 0.2 rad up.
    action = np.array([0.35, 0.1, 0.8, 0.0, np.pi / 2 - 0.2, 0.0], dtype=np.float32)
    for _ in range(15):
        env.step(action)
    pose = flange_pose(env)
    np.testing.assert_allclose(pose[:3, 3], [0.35, 0.1, 0.8], atol=2e-3)
    np.testing.assert_allclose(pose[:3, 2], [np.cos(0.2), 0.0, np.sin(0.2)], atol=5e-3)
    env.close()


def test_drives_are_limited_to_the_motors_torques(joint_env: Any) -> None:
    joints = joint_env.unwrapped.agent.robot.active_joints
    assert [float(j.force_limit[0]) for j in joints] == [320, 320, 176, 176, 110, 40, 40]


def test_a_missing_urdf_raises_instead_of_asking(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing() -> str:
        raise FileNotFoundError("asset 'iiwa14/iiwa14.urdf' not found")

    monkeypatch.setattr(agent_module, "urdf_path", missing)
    with pytest.raises(FileNotFoundError, match="iiwa14.urdf"):
        make()


def config(**kwargs: Any) -> D435CameraConfig:
    options: dict[str, Any] = dict(uid="d435", pose=sapien.Pose(), width=640, height=480)
    return D435CameraConfig(**(options | kwargs))


def test_a_camera_config_follows_changes_of_its_size() -> None:
    camera = config()
    assert camera.fov == pytest.approx(np.deg2rad(42.5))
    depth = config(stream="depth")
    assert depth.fov == pytest.approx(2 * np.arctan(240 / 384))
    depth.width = 848  # As ManiSkill does it: change the attributes, then call __post_init__ again.
    depth.__post_init__()
    assert depth.fov == pytest.approx(2 * np.arctan(240 / 424))


def test_a_users_field_of_view_or_intrinsics_win() -> None:
    camera = config()
    camera.fov = 1.0
    camera.__post_init__()
    camera.width = 320
    camera.__post_init__()
    assert camera.fov == 1.0 and camera.intrinsic is None
    camera.intrinsic = np.eye(3)
    camera.__post_init__()
    assert camera.fov is None


def test_the_measured_calibration_becomes_an_intrinsic_matrix() -> None:
    camera = config(calibration="measured")
    assert camera.fov is None
    np.testing.assert_allclose(camera.intrinsic, [[612.4, 0.0, 314.8], [0.0, 610.6, 238.3], [0.0, 0.0, 1.0]])
    camera.calibration = "nominal"
    camera.__post_init__()
    assert camera.intrinsic is None and camera.fov == pytest.approx(np.deg2rad(42.5))


def test_a_depth_camera_has_no_measured_calibration() -> None:
    with pytest.raises(InvalidInputError, match="colour stream only"):
        config(stream="depth", calibration="measured")


def centre_of_red(rgb: np.ndarray) -> np.ndarray:
    rows, columns = np.nonzero((rgb[..., 0] > 60) & (rgb[..., 1] < 40) & (rgb[..., 2] < 40))
    assert len(rows) > 20, "the cube is not in the picture"
    return np.array([columns.mean() + 0.5, rows.mean() + 0.5])


@pytest.mark.render
@pytest.mark.parametrize(
    "sensor_configs",
    [
        {"width": 320, "height": 240},
        {"width": 128, "height": 128},
        {"d435": {"calibration": "measured", "width": 320, "height": 240}},
    ],
)
def test_the_camera_sees_a_cube_where_projection_says(sensor_configs: dict[str, Any]) -> None:
    env = make(
        obs_mode="rgb+depth+segmentation",
        render_backend="cpu",
        sensor_configs=sensor_configs,
        control_mode="pd_joint_pos",
    )
    observation, _ = env.reset(seed=0)
    picture = {k: v[0].cpu().numpy() for k, v in observation["sensor_data"]["d435"].items()}
    options = sensor_configs.get("d435", sensor_configs)
    calibration = options.get("calibration", "nominal")
    intrinsics = d435.color_intrinsics(options["width"], options["height"], calibration)

    flange = link_transforms(torch.from_numpy(READY_QPOS)[None])[0, -1].numpy()
    world_to_optical = np.linalg.inv(flange @ d435.T_flange_camera_color_optical)
    corners = CUBE_AT + 0.02 * np.array([[-1, y, z] for y in (-1, 1) for z in (-1, 1)])
    front = corners @ world_to_optical[:3, :3].T + world_to_optical[:3, 3]
    expected = intrinsics.project(front)
    seen = centre_of_red(picture["rgb"])
    np.testing.assert_allclose(seen, expected.mean(axis=0), atol=2.0)
    # The cube is left of and below the camera's axis in the world: left and low in the picture.
    assert seen[0] < options["width"] / 2 and seen[1] > options["height"] / 2

    column, row = np.floor(expected.mean(axis=0)).astype(int)
    assert picture["depth"][row, column, 0] == pytest.approx(1000 * front[0, 2], abs=2)
    cube = int(env.unwrapped.cube.per_scene_id[0])
    ids = picture["segmentation"][..., 0]
    assert ids[row, column] == cube
    # The edges of the cube's front face, to a pixel.
    rows, columns = np.nonzero(ids == cube)
    assert (
        abs(columns.min() - expected[:, 0].min()) < 1.5 and abs(rows.max() + 1 - expected[:, 1].max()) < 1.5
    )
    robot_ids = {int(link.per_scene_id[0]) for link in env.unwrapped.agent.robot.links}
    assert not robot_ids & set(np.unique(ids).tolist()), "the camera sees its own robot"
    env.close()


@pytest.mark.render
def test_intrinsics_scale_with_the_size_asked_for() -> None:
    env = make(
        robot_uids="iiwa14_d435_raw_depth",
        obs_mode="rgb+depth",
        render_backend="cpu",
        control_mode="pd_joint_pos",
        sensor_configs=dict(width=848, height=480, d435=dict(width=640, height=480)),
    )
    params = env.unwrapped.get_sensor_params()
    color = params["d435"]["intrinsic_cv"][0].cpu().numpy()
    depth = params["d435_depth"]["intrinsic_cv"][0].cpu().numpy()
    np.testing.assert_allclose(
        color, [[617.159, 0.0, 320.0], [0.0, 617.159, 240.0], [0.0, 0.0, 1.0]], rtol=1e-4
    )
    np.testing.assert_allclose(depth, [[424, 0, 424], [0, 424, 240], [0, 0, 1]], rtol=1e-4)
    env.close()


@pytest.mark.render
def test_raw_depth_sees_the_cube_further_left_than_the_colour_camera() -> None:
    env = make(
        robot_uids="iiwa14_d435_raw_depth",
        obs_mode="rgb+segmentation",
        render_backend="cpu",
        control_mode="pd_joint_pos",
        sensor_configs=dict(width=320, height=240),
    )
    observation, _ = env.reset(seed=0)
    cube = int(env.unwrapped.cube.per_scene_id[0])
    flange = link_transforms(torch.from_numpy(READY_QPOS)[None])[0, -1].numpy()
    world_to_optical = np.linalg.inv(flange @ d435.T_flange_camera_depth_optical)
    point = world_to_optical[:3, :3] @ (CUBE_AT - [0.02, 0, 0]) + world_to_optical[:3, 3]
    ids = observation["sensor_data"]["d435_depth"]["segmentation"][0, ..., 0].cpu().numpy()
    rows, columns = np.nonzero(ids == cube)
    expected = d435.depth_intrinsics(320, 240).project(point)
    np.testing.assert_allclose([columns.mean() + 0.5, rows.mean() + 0.5], expected, atol=1.5)
    env.close()


@pytest.mark.render
def test_sapien_renders_the_triangles_that_link_meshes_returns() -> None:
    env = make(render_backend="cpu", control_mode="pd_joint_pos")
    expected = description.link_meshes()
    for name in iiwa14.LINK_NAMES[:-1]:
        entity = env.unwrapped.agent.robot.links_map[name]._objs[0].entity
        body = entity.find_component_by_type(sapien.render.RenderBodyComponent)
        parts = [part for shape in body.render_shapes for part in shape.parts]
        vertices = np.concatenate([np.asarray(part.vertices) for part in parts])
        assert sum(len(part.triangles) for part in parts) == len(expected[name][1]), name
        np.testing.assert_allclose(vertices.min(axis=0), expected[name][0].min(axis=0), atol=1e-6)
        np.testing.assert_allclose(vertices.max(axis=0), expected[name][0].max(axis=0), atol=1e-6)
        colors = {tuple(np.round(part.material.base_color[:3], 2)) for part in parts}
        assert len(colors) >= 2, f"{name} is rendered in one colour"
    env.close()


def test_the_pose_of_the_rest_keyframe_can_be_set(joint_env: Any) -> None:
    agent = joint_env.unwrapped.agent
    agent.reset(torch.tensor(REST_QPOS, dtype=torch.float32))
    assert isinstance(agent.ee_link.pose, Pose)
    np.testing.assert_allclose(agent.ee_link.pose.p[0].numpy()[1], 0.0, atol=1e-5)
    joint_env.reset(seed=0)
