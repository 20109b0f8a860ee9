"""The digital twin against the simulated task, and what it shows of itself."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import gymnasium as gym
import numpy as np
import pytest
import torch
import trimesh

from maniskill_tomato.deploy.clock import SimulatedClock
from maniskill_tomato.deploy.deploy_errors import NotConnectedError, PerceptionError, ProfileError
from maniskill_tomato.deploy.drivers import DriverContext, make_arm, make_camera
from maniskill_tomato.deploy.interface import JointMove
from maniskill_tomato.deploy.mock.dynamics import ArmDynamics
from maniskill_tomato.deploy.mock.episode import load_episode
from maniskill_tomato.deploy.robot_perception import TRUE_MASKS, ImagePerception, RobotBelief, TruthPerception
from maniskill_tomato.plants.episode_list import Episode, write_episodes
from maniskill_tomato.raycast.images import FIRST_ORGAN_LABEL, ROBOT_LABEL
from maniskill_tomato.raycast.view_rays import DEPTH_MODE, RayLabel
from maniskill_tomato.robot.d435 import (
    T_flange_camera_color_optical,
    depth_noise_std,
    min_depth,
)
from maniskill_tomato.robot.iiwa14 import READY_QPOS, VELOCITY_LIMITS
from maniskill_tomato.robot.look_at_move import LookAtMover
from maniskill_tomato.segmentation.instances import Instances
from maniskill_tomato.sensing.inspection import STALE_AFTER

SIZE = {"width": 424, "height": 240}
EPISODE = 4
"""One whose start posture is clear of the table, so that the twin begins with the task's own joints."""


def devices(seed: int = EPISODE, **options: Any) -> tuple[Any, Any]:
    context = DriverContext(clock=SimulatedClock(100.0), seed=seed)
    twin = {**SIZE, **options}
    arm, camera = make_arm("mock", twin, context), make_camera("mock", twin, context)
    arm.connect()
    camera.connect()
    return arm, camera


@pytest.fixture(scope="module")
def env() -> Any:
    made = gym.make(
        "TomatoViewpoint-v1",
        num_envs=1,
        obs_mode="state",
        episodes="held_out",
        render_backend="none",
        sensor_configs=dict(d435=dict(SIZE)),
    )
    yield made
    made.close()


def test_the_loops_observations_are_those_of_the_environment(env: Any) -> None:
    """Same episode, same actions: the observation vectors differ by less than 1e-6 in every entry."""
    arm, camera = devices(depth_noise=0.0)
    robot_belief = RobotBelief(T_flange_camera_color_optical, 20)
    mover, perception = LookAtMover(), TruthPerception()
    expected, info = env.reset(seed=EPISODE)
    joints = arm.read().joint_positions
    np.testing.assert_allclose(joints, env.unwrapped.agent.robot.get_qpos()[0].numpy(), atol=1e-7)
    target = load_episode("held_out", EPISODE).target_position.double().numpy()
    perception.begin(target)
    actions = [(0.4, 0.3, 0.2), (0.5, -0.2, 0.6), (-0.3, 0.6, 0.3), (0.9, 0.1, -0.2), (0.1, 0.2, 0.7)]
    for k in range(len(actions) + 1):
        frame = camera.read()
        joints = arm.read().joint_positions
        view = perception.look(frame, robot_belief.camera_pose(joints))
        assert view is not None
        belief = robot_belief.observe(joints, view, 20 - k)
        assert float((belief.observation - expected).abs().max()) <= 1e-6, k
        assert view.visible_fraction == pytest.approx(float(info["visible_fraction"][0]), abs=1e-6)
        if k == len(actions):
            break
        expected, _, _, _, info = env.step(torch.tensor([actions[k]]))
        position = torch.as_tensor(robot_belief.camera_position(joints)[None])
        solved = mover.move(
            torch.tensor(joints[None], dtype=torch.float32),
            position,
            torch.as_tensor(target[None]),
            torch.tensor([actions[k]]),
        )
        goal = solved.qpos[0].float().double().numpy()
        arm.command(JointMove(joint_positions=goal, speed_fraction=0.3))
        while not arm.wait(0.5):
            pass
        np.testing.assert_allclose(arm.read().joint_positions, goal, atol=1e-8)


def pose_of(arm: Any) -> Any:
    return RobotBelief(T_flange_camera_color_optical, 20).camera_pose(arm.read().joint_positions)


def looked(perception: Any, frame: Any, pose: Any, target: Any = None) -> Any:
    perception.begin(target)
    return perception.look(frame, pose)


def test_masks_and_depth_tell_nearly_what_exact_rays_tell() -> None:
    """The route of hardware against the route of the task, on the same views: labels, distances and V_f agree."""
    agreeing, distances, fractions = [], [], []
    for seed, noise in ((1, 0.0), (9, 0.0), (1, 1.0), (9, 1.0)):
        arm, camera = devices(seed, depth_noise=noise)
        frame = camera.read()
        pose = pose_of(arm)
        target = frame.truth.target_position
        exact = looked(TruthPerception(), frame, pose, target)
        seen = looked(ImagePerception(TRUE_MASKS, None), frame, pose, target)
        # A fruit that is measured farther from where it is said to be has its rays about another place.
        np.testing.assert_array_equal(seen.target_position, target)
        same = exact.rays.label == seen.rays.label
        if (
            noise
        ):  # Then many rays have no depth: shadows of the stereo baseline and holes, which count as unknown.
            same |= seen.rays.label == int(RayLabel.OUTSIDE)
        agreeing.append(float(same.float().mean()))
        solid = same & (seen.rays.label > int(RayLabel.FREE)) & (exact.rays.label > int(RayLabel.FREE))
        distances.append((exact.rays.distance - seen.rays.distance)[solid].abs().numpy())
        fractions.append(abs(exact.visible_fraction - seen.visible_fraction))
    assert min(agreeing) > 0.95
    assert float(np.median(np.concatenate(distances))) < 0.005
    assert max(fractions) < 0.1, "the sphere model's own error is 0.04 in the mean"


def test_a_picture_agrees_with_the_truth_that_comes_with_it() -> None:
    """V counted in the picture over the area of the fruit's sphere is near V_f by ray casting."""
    _, camera = devices(6)
    frame = camera.read()
    truth = frame.truth
    episode = load_episode("held_out", 6)
    fruit = episode.plant.fruits[episode.target]
    visible = int((truth.labels == truth.target_label).sum())
    pose = camera._world.camera_pose()
    centre = pose[:3, :3].T @ (truth.target_position - pose[:3, 3])
    rays = frame.intrinsics.ray_directions(frame.intrinsics.pixel_centres())
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    area = int((centre @ centre - (rays @ centre) ** 2 < (float(fruit.radius) * 0.95) ** 2).sum())
    assert visible / area == pytest.approx(truth.visible_fraction, abs=0.08)
    assert set(np.unique(truth.labels)) <= {0, ROBOT_LABEL, *range(2, 2 + len(episode.plant.organs))}


def test_plants_of_mesh_files_stand_before_the_twin(tmp_path: Path) -> None:
    meshes = {
        "fruit_0": trimesh.creation.icosphere(subdivisions=1, radius=0.03).apply_translation(
            (-0.1, 0.0, 0.8)
        ),
        "stem": trimesh.creation.box((0.02, 0.02, 1.2)).apply_translation((0.0, 0.0, 0.6)),
    }
    folder = tmp_path / "set" / "held_out"
    folder.mkdir(parents=True)
    arrays: dict[str, Any] = {name: mesh.triangles for name, mesh in meshes.items()}
    np.savez(folder / "a.npz", **arrays)
    episode = Episode(
        plant_seed=2_000_000,
        leaf_density=1.0,
        plant_pose=(0.9, 0.05, 0.1),
        target=0,
        camera_position=(0.4, -0.1, 0.8),
        start_visibility=0.0,
    )
    write_episodes(tmp_path / "list.json", [episode])
    twin = {"episodes": str(tmp_path / "list.json"), "plants": str(tmp_path / "set")}
    _, camera = devices(0, **twin)
    truth = camera.read().truth
    expected = [0.9 - 0.1 * np.cos(0.1), 0.05 - 0.1 * np.sin(0.1), 0.8]
    np.testing.assert_allclose(truth.target_position, expected, atol=1e-6)
    assert truth.visible_fraction == 1.0  # Nothing hangs before it.
    with pytest.raises(ProfileError, match="plants needs a list of its own"):
        devices(0, plants=str(tmp_path / "set"))
    with pytest.raises(ProfileError, match="episodes must be one of 'validation', 'held_out'"):
        devices(0, episodes="test")


class GivenMasks:
    """A segmenter that finds what a test gives it, whatever the picture shows."""

    def __init__(self, *masks: Any, scores: tuple[float, ...] = (1.0,)) -> None:
        self.found = Instances.from_masks(np.array(masks), np.array(scores, np.float32))

    def __call__(self, image: Any, depth_m: Any = None) -> Instances:
        return self.found


def test_a_sliver_is_not_a_whole_fruit() -> None:
    """A segmenter that finds a few rows of a fruit in full view has not found a small fruit in full view."""
    # Without its depth no fruit is taken for the one whose place is told.
    arm, camera = devices(6, depth_noise=0.0)
    frame, pose = camera.read(), pose_of(arm)
    label = max(frame.truth.ripe_labels, key=lambda label: int((frame.truth.labels == label).sum()))
    whole = frame.truth.labels == label
    episode = load_episode("held_out", 6)
    fruit = next(fruit for fruit in episode.plant.fruits if FIRST_ORGAN_LABEL + fruit.organ_index == label)
    target = (episode.T_world_plant.double().numpy() @ [*fruit.centre, 1.0])[:3]
    rows = np.flatnonzero(whole.any(axis=1))
    sliver = whole.copy()
    sliver[rows[0] + 2 :] = False
    assert 12 <= sliver.sum() < 0.1 * whole.sum()
    seen = looked(ImagePerception("given", GivenMasks(whole)), frame, pose, target)
    assert seen.visible_fraction > 0.7 and (seen.mask == whole).all()
    view = looked(ImagePerception("given", GivenMasks(sliver)), frame, pose, target)
    assert view.visible_fraction < 0.25


def test_an_unsure_fruit_is_found_again_but_not_chosen_as_the_target() -> None:
    arm, camera = devices(6, depth_noise=0.0)
    frame, pose = camera.read(), pose_of(arm)
    sizes = {label: int((frame.truth.labels == label).sum()) for label in frame.truth.ripe_labels}
    large, small = (frame.truth.labels == n for n in sorted(sizes, key=lambda label: -sizes[label])[:2])
    wavering = ImagePerception("given", GivenMasks(large, small, scores=(0.35, 0.8)))
    chosen = looked(wavering, frame, pose)
    np.testing.assert_array_equal(chosen.mask, small)
    unsure = looked(ImagePerception("given", GivenMasks(large)), frame, pose).target_position
    again = looked(wavering, frame, pose, unsure)
    np.testing.assert_array_equal(again.mask, large)
    assert again.visible_fraction > 0.0


def test_a_target_that_was_not_named_is_given_up_for_another_when_no_view_shows_more_of_it() -> None:
    arm, camera = devices(5, depth_noise=0.0)
    frame, pose = camera.read(), pose_of(arm)
    truth = frame.truth
    hidden = [
        label
        for label, fraction in zip(truth.ripe_labels, truth.ripe_fractions, strict=True)
        if 0.3 < fraction < 0.7
    ]
    sizes = {label: int((truth.labels == label).sum()) for label in hidden}
    large, small = (truth.labels == n for n in sorted(sizes, key=lambda label: -sizes[label])[:2])
    perception = ImagePerception("given", GivenMasks(large, small, scores=(0.8, 0.8)))
    perception.begin(None)
    views = [perception.look(frame, pose) for _ in range(STALE_AFTER + 2)]
    # The look after the choice is compared with nothing; the six after it show no more.
    for view in views[:-1]:
        np.testing.assert_array_equal(view.mask, large)
        assert not view.is_new_target or view is views[0]
    assert views[-1].is_new_target and views[-1].recall is not None
    np.testing.assert_array_equal(views[-1].mask, small)
    named = looked(perception, frame, pose, views[0].target_position)
    for _ in range(STALE_AFTER + 2):
        named = perception.look(frame, pose)
    np.testing.assert_array_equal(named.mask, large)


def test_fruits_are_located_to_a_centimetre_where_enough_is_seen() -> None:
    errors = []
    for seed in (4, 9):
        arm, camera = devices(seed)
        # Without light no fruit is told to be unripe, so that all of them count.
        frame, pose = camera.read(), pose_of(arm)
        frame = replace(frame, color=np.zeros_like(frame.color))
        episode = load_episode("held_out", seed)
        T = episode.T_world_plant.double().numpy()
        for fruit in episode.plant.fruits:
            mask = frame.truth.labels == FIRST_ORGAN_LABEL + fruit.organ_index
            if mask.sum() < 12:
                continue
            centre = T[:3, :3] @ np.asarray(fruit.centre, dtype=np.float64) + T[:3, 3]
            found = looked(ImagePerception("given", GivenMasks(mask)), frame, pose)
            depth = float((np.linalg.inv(pose) @ [*centre, 1.0])[2])
            if found is not None and depth < 0.9 and found.visible_fraction > 0.6:
                errors.append(float(np.linalg.norm(found.target_position - centre)))
    assert len(errors) >= 5
    assert float(np.median(errors)) < 0.010 and max(errors) < 0.03


def test_a_camera_without_truth_needs_a_segmenter() -> None:
    arm, camera = devices()
    frame = replace(camera.read(), truth=None)
    with pytest.raises(PerceptionError, match="choose a segmenter"):
        looked(ImagePerception(TRUE_MASKS, None), frame, pose_of(arm), np.array([0.7, 0.0, 0.8]))


def test_the_same_seed_gives_the_same_run_and_another_one_another() -> None:
    def pictures(seed: int) -> list[Any]:
        arm, camera = devices(seed)
        frames = [camera.read()]
        arm.command(JointMove(joint_positions=arm.read().joint_positions + 0.05, speed_fraction=0.2))
        arm.wait(10.0)
        return [*frames, camera.read()]

    first, again, other = pictures(6), pictures(6), pictures(7)
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a.color, b.color)
        np.testing.assert_array_equal(a.depth, b.depth)
        assert a.stamp == b.stamp
    assert not np.array_equal(first[0].color, first[1].color)
    assert not np.array_equal(first[0].color, other[0].color)


def test_a_move_keeps_the_speed_it_is_given_and_arrives() -> None:
    arm = ArmDynamics(READY_QPOS)
    goal = READY_QPOS + np.array([0.3, -0.2, 0.4, 0.3, -0.5, 0.2, 0.6])
    duration = arm.start(goal, 0.2)
    fastest = np.zeros(7)
    while arm.moving:
        arm.advance(arm.time + 0.02)
        fastest = np.maximum(fastest, np.abs(arm.joint_velocities))
    assert (fastest < 0.2 * VELOCITY_LIMITS * 1.01).all()
    assert (fastest / VELOCITY_LIMITS).max() > 0.19
    assert duration == pytest.approx(1.875 * np.abs((goal - READY_QPOS) / (0.2 * VELOCITY_LIMITS)).max())
    np.testing.assert_allclose(arm.joint_positions, goal, atol=1e-8)


def test_depth_is_what_the_d435_model_of_the_package_makes_of_it() -> None:
    _, clean = devices(9, depth_noise=0.0)
    _, noisy = devices(9)
    _, worse = devices(9, depth_noise=3.0)
    exact, measured, wild = (camera.read().depth for camera in (clean, noisy, worse))
    assert exact[exact > 0.0].min() >= min_depth(DEPTH_MODE)
    np.testing.assert_array_equal(
        measured, (np.round(measured.astype(np.float64) * 1e3) / 1e3).astype(np.float32)
    )
    both = (exact > 0.0) & (measured > 0.0) & (wild > 0.0)
    assert 0.5 < both.mean() < 0.95, "shadows of the baseline and holes"
    # Noise in the middle of surfaces, as the formula has it: half of all normal errors are within 0.674 deviations.
    smooth = both & (cv2.dilate(exact, np.ones((7, 7))) - cv2.erode(exact, np.ones((7, 7))) < 0.01)
    for depth, factor in ((measured, 1.0), (wild, 3.0)):
        ratio = np.abs(depth - exact)[smooth] / (factor * depth_noise_std(exact[smooth], DEPTH_MODE))
        assert float(np.median(ratio)) == pytest.approx(0.674, rel=0.2)


def test_devices_want_to_be_connected_and_options_to_be_known() -> None:
    context = DriverContext(clock=SimulatedClock(), seed=0)
    arm, camera = make_arm("mock", SIZE, context), make_camera("mock", SIZE, context)
    for use in (arm.read, camera.read, lambda: camera.intrinsics, lambda: arm.wait(0.1)):
        with pytest.raises(NotConnectedError, match="connect"):
            use()
    with pytest.raises(ProfileError, match=r"twin\.widht is unknown"):
        make_arm("mock", {"widht": 3}, context)
    with pytest.raises(ProfileError, match=r"twin\.depth_noise must be a finite number"):
        make_arm("mock", {"depth_noise": "much"}, context)
    with pytest.raises(ProfileError, match=r"arm\.driver must be one of libiiwa, mock, sunrise"):
        make_arm("mok", {}, context)


@pytest.mark.render
def test_sapiens_pictures_lie_on_the_ray_casters() -> None:
    """The textured picture shows the plant where labels say: ripe fruits are red, nothing is the clear colour."""
    _, camera = devices(3, renderer="sapien")
    frame = camera.read()
    flat = camera._world.color(camera._world.picture())
    ripe = np.isin(frame.truth.labels, frame.truth.ripe_labels)
    inner = ripe & np.roll(ripe, 2, 0) & np.roll(ripe, -2, 0) & np.roll(ripe, 2, 1) & np.roll(ripe, -2, 1)
    red = frame.color[..., 0].astype(int) - frame.color[..., 1]
    assert inner.sum() > 200
    assert (red[inner] > 40).mean() > 0.9
    assert not np.array_equal(frame.color, flat)
    empty = frame.truth.labels == 0
    assert frame.color[empty].std(axis=0).max() < 25.0
