"""ManiSkill's Sim2RealEnv over the twin: the same spaces, wrappers and observations as in the simulation."""

import json
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

import maniskill_tomato  # noqa: F401
from maniskill_tomato.deploy.deploy_errors import NotConnectedError, ProfileError, RefusedError
from maniskill_tomato.deploy.interface import ArmState, Frame
from maniskill_tomato.deploy.profile import parse_profile
from maniskill_tomato.deploy.real_agent import IiwaRealAgent, depth_in_mm, fit_color, fit_depth
from maniskill_tomato.deploy.sim2real import TomatoSim2RealEnv
from maniskill_tomato.deploy.workcell import make_workcell
from maniskill_tomato.robot import d435
from maniskill_tomato.robot.d435 import CameraIntrinsics
from maniskill_tomato.robot.iiwa14 import READY_QPOS

TWIN = """
[arm]
driver = "mock"
[camera]
driver = "mock"
[twin]
width = 160
height = 120
depth_noise = 0.0
[perception]
segmenter = "ground_truth"
sight = "rays"
[target]
source = "twin"
"""


REAL = """
[arm]
driver = "sunrise"
host = "127.0.0.1"
[camera]
driver = "realsense"
{camera}
[perception]
segmenter = "light"
[target]
source = "seen"
"""


def test_a_real_arm_without_a_calibration_is_not_moved_by_a_policy_nor_by_maniskill() -> None:
    workcell = make_workcell(parse_profile(REAL.format(camera=""), Path("real.toml")))
    state = ArmState(joint_positions=READY_QPOS, joint_velocities=np.zeros(7), stamp=workcell.clock.now())
    arm: Any = workcell.arm
    arm.read = lambda max_age_s=0.5: state
    real = IiwaRealAgent(workcell)
    sent: list[Any] = []
    arm.command = sent.append
    with pytest.raises(RefusedError, match="not calibrated"):
        real.set_target_qpos(READY_QPOS + 0.05)
    assert sent == []


def test_maniskill_does_not_move_a_real_arm_by_a_bad_calibration(tmp_path: Path) -> None:
    file = tmp_path / "calibration.json"
    file.write_text(json.dumps({"T_flange_camera": np.eye(4).tolist(), "rms_px": 500.0}))
    text = REAL.format(camera="") + '[calibration]\nfile = "calibration.json"\n'
    workcell = make_workcell(parse_profile(text, tmp_path / "real.toml"))
    state = ArmState(joint_positions=READY_QPOS, joint_velocities=np.zeros(7), stamp=workcell.clock.now())
    arm: Any = workcell.arm
    arm.read = lambda max_age_s=0.5: state
    sent: list[Any] = []
    arm.command = sent.append
    with pytest.raises(RefusedError, match="is the identity.* rms_px is 500 px"):
        IiwaRealAgent(workcell).set_target_qpos(READY_QPOS + 0.05)
    assert sent == []


def test_a_recorded_camera_guides_no_real_arm() -> None:
    recorded = REAL.format(camera='recording = "old.db3"')
    with pytest.raises(ProfileError, match=r"recording of one, cannot guide a real arm"):
        make_workcell(parse_profile(recorded, Path("real.toml")))


def agent(seed: int = 0, extra: str = "") -> IiwaRealAgent:
    return IiwaRealAgent(make_workcell(parse_profile(TWIN + extra, Path("twin.toml")), seed))


@pytest.fixture(scope="module")
def simulation() -> Any:
    return gym.make("TomatoViewpoint-v1", obs_mode="state", episodes="held_out")


def test_the_general_task_observes_on_the_twin_what_it_observes_in_simulation(simulation: Any) -> None:
    real = agent(seed=3)
    real.start()
    env: Any = TomatoSim2RealEnv(simulation, real, skip_data_checks=True)
    wanted, _ = simulation.reset(seed=3)
    got, _ = env.reset(seed=3)
    # The twin's arm gives way by microradians under its weight.
    torch.testing.assert_close(got, wanted, atol=5e-3, rtol=0.0)
    assert float((got - wanted).abs().mean()) < 1e-5
    actions = [np.array([0.3, 0.1, 0.0]), np.array([-0.2, 0.3, -0.2])]
    seen = [env.step(action) for action in actions]
    env.close()
    simulation.reset(seed=3)
    for action, (observation, reward, terminated, truncated, info) in zip(actions, seen, strict=True):
        wanted, wanted_reward, wanted_terminated, _, wanted_info = simulation.step(action)
        assert not bool(info["refused"])
        # The twin's arm comes to rest within a tenth of a milliradian of its goal.
        assert float((observation - wanted).abs().max()) < 0.02
        assert float((observation - wanted).abs().mean()) < 1e-3
        assert float(info["visible_fraction"]) == pytest.approx(
            float(wanted_info["visible_fraction"]), abs=0.01
        )
        assert float(reward) == pytest.approx(float(wanted_reward), abs=0.02)
        assert bool(terminated) == bool(wanted_terminated) and not bool(truncated)


def test_a_step_ends_where_the_arm_stands_and_a_refused_one_leaves_it(simulation: Any) -> None:
    real = agent(seed=3, extra="[safety]\nmax_joint_step = 0.001\n")
    real.start()
    env: Any = TomatoSim2RealEnv(simulation, real, skip_data_checks=True)
    env.reset(seed=3)
    before = real.get_qpos()
    _, _, _, _, info = env.step(np.array([0.5, 0.0, 0.0]))
    assert bool(info["refused"])
    torch.testing.assert_close(real.get_qpos(), before, atol=1e-4, rtol=0.0)
    torch.testing.assert_close(
        simulation.unwrapped.agent.robot.get_qpos(), real.get_qpos(), atol=1e-4, rtol=0.0
    )
    env.close()


def test_the_guided_task_runs_with_its_nine_numbers() -> None:
    sim: Any = gym.make("TomatoViewpointGuided-v1", obs_mode="state")
    real = agent()
    real.start()
    env: Any = TomatoSim2RealEnv(sim, real)  # With ManiSkill's own comparison of both observations.
    observation, _ = env.reset(seed=0)
    np.testing.assert_allclose(observation[0, 6:], env.target_position, atol=1e-6)
    position = observation[0, :3].clone()
    action = np.array([0.0, 0.03, 0.0, 0.0, 0.0, 0.0])
    observation, reward, _, _, info = env.step(action)
    assert not bool(info["refused"])
    np.testing.assert_allclose(observation[0, :3] - position, [0.0, 0.03, 0.0], atol=1e-3)
    assert np.isfinite(float(reward))
    env.close()
    assert not real.workcell.arm.is_connected


@pytest.mark.render
def test_pictures_have_the_simulations_shapes_and_poses() -> None:
    sim: Any = gym.make("TomatoViewpoint-v1", obs_mode="rgb+depth", episodes="held_out")
    real = agent(seed=2)
    real.start()
    env: Any = TomatoSim2RealEnv(sim, real)
    wanted, _ = sim.reset(seed=2)
    got, _ = env.reset(seed=2)
    sensor, simulated = got["sensor_data"]["d435"], wanted["sensor_data"]["d435"]
    for name in ("rgb", "depth"):
        assert sensor[name].shape == simulated[name].shape and sensor[name].dtype == simulated[name].dtype
    both = (sensor["depth"] > 0) & (simulated["depth"] > 0) & (simulated["depth"] < 2000)
    # Exact rays against the rasteriser: leaves' edges differ, the rest agrees to a millimetre.
    apart = (sensor["depth"] - simulated["depth"]).abs()[both].float()
    assert both.sum() > 2000 and float(apart.median()) <= 1.0
    for name in ("extrinsic_cv", "cam2world_gl", "intrinsic_cv"):
        torch.testing.assert_close(
            got["sensor_param"]["d435"][name], wanted["sensor_param"]["d435"][name], atol=1e-4, rtol=1e-4
        )
    torch.testing.assert_close(got["agent"]["qpos"], wanted["agent"]["qpos"], atol=1e-4, rtol=0.0)
    env.close()


def test_the_agent_alone_moves_looks_and_refuses() -> None:
    real = agent()
    with pytest.raises(NotConnectedError):
        real.get_qpos()
    real.start()
    start = real.get_qpos()
    goal = start + torch.tensor([[0.0, 0.02, 0.0, -0.02, 0.0, 0.01, 0.05]])
    real.set_target_qpos(goal)
    torch.testing.assert_close(real.get_qpos(), goal, atol=1e-3, rtol=0.0)
    real.reset(start[0])
    torch.testing.assert_close(real.get_qpos(), start, atol=1e-3, rtol=0.0)
    with pytest.raises(RefusedError):
        real.set_target_qpos(torch.full((1, 7), float("nan")))
    with pytest.raises(RefusedError, match="positions only"):
        real.set_target_qvel(torch.zeros(1, 7))
    real.capture_sensor_data(["d435"])
    data = real.get_sensor_data(["d435"])["d435"]
    assert data["rgb"].shape == (1, 120, 160, 3) and data["rgb"].dtype == torch.uint8
    assert data["depth"].shape == (1, 120, 160, 1) and data["depth"].dtype == torch.int16
    with pytest.raises(NotConnectedError, match="d435_depth"):
        real.capture_sensor_data(["d435", "d435_depth"])
    real.stop()


def test_other_control_modes_are_refused(simulation: Any) -> None:
    sim: Any = gym.make("TomatoViewpointGuided-v1", obs_mode="state", control_mode="pd_ee_delta_pose")
    with pytest.raises(ProfileError, match="pd_viewpoint or pd_look_at"):
        TomatoSim2RealEnv(sim, agent())


def frame_of(intrinsics: CameraIntrinsics) -> Frame:
    """Colour and depth that say where each pixel looks: red and green are the slopes of its ray."""
    u, v = np.moveaxis(intrinsics.pixel_centres(), -1, 0)
    x, y = (u - intrinsics.cx) / intrinsics.fx, (v - intrinsics.cy) / intrinsics.fy
    color = np.stack([128 + 150 * x, 128 + 150 * y, np.zeros_like(x)], axis=-1)
    return Frame(
        color=np.clip(np.rint(color), 0, 255).astype(np.uint8),
        depth=(1.0 + x + 0.5 * y).astype(np.float32),
        intrinsics=intrinsics,
        stamp=0.0,
        number=0,
    )


@pytest.mark.parametrize("size", [(160, 120), (320, 320), (640, 480), (128, 128)])
def test_a_fitted_picture_looks_where_the_simulated_camera_would(size: tuple[int, int]) -> None:
    have = d435.color_intrinsics(640, 480, "measured")
    wanted = d435.color_intrinsics(*size)
    frame = frame_of(have)
    exact = frame_of(wanted)
    inside = np.zeros((wanted.height, wanted.width), dtype=bool)
    u, v = np.moveaxis(wanted.pixel_centres(), -1, 0)
    columns = have.fx * (u - wanted.cx) / wanted.fx + have.cx
    rows = have.fy * (v - wanted.cy) / wanted.fy + have.cy
    inside = (columns > 4) & (columns < 636) & (rows > 4) & (rows < 476)
    assert inside.mean() > 0.9
    difference = fit_color(frame, wanted)[inside].astype(int) - exact.color[inside].astype(int)
    assert np.abs(difference).max() <= 1
    # The nearest pixel is at most 0.71 pixels off, 0.0012 in slope.
    assert np.abs(fit_depth(frame, wanted)[inside] - exact.depth[inside]).max() < 0.0015


def test_depth_in_millimetres_is_rounded_and_ends_where_int16_does() -> None:
    depth = np.array([[0.0, 0.0004, 0.0006, 1.2345, 32.767, 32.769, 100.0]], np.float32)
    np.testing.assert_array_equal(depth_in_mm(depth), [[0, 0, 1, 1234, 32767, 0, 0]])
