"""The simulator's route from frames to an observation against the robot's, on the same frames."""

from typing import Any

import numpy as np
import pytest
import torch

from maniskill_tomato.deploy.interface import Frame, FrameTruth
from maniskill_tomato.deploy.mock.episode import load_episode
from maniskill_tomato.deploy.robot_perception import PLACE_ERROR, TRUE_MASKS, ImagePerception, RobotBelief
from maniskill_tomato.raycast.images import FIRST_ORGAN_LABEL, ROBOT_LABEL
from maniskill_tomato.raycast.scene import RayScene
from maniskill_tomato.raycast.view_rays import ViewRays
from maniskill_tomato.robot.d435 import T_flange_camera_color_optical, color_intrinsics
from maniskill_tomato.robot.kinematics import link_transforms
from maniskill_tomato.robot.look_at import carried_pose
from maniskill_tomato.robot.look_at_move import LookAtMover
from maniskill_tomato.robot.robot_description import link_meshes
from maniskill_tomato.robot.rotations import FORWARD_RPY, matrix_to_rpy
from maniskill_tomato.segmentation.instances import Instances
from maniskill_tomato.sensing.camera_perception import CameraPerception
from maniskill_tomato.sensing.fruit_detector import FruitDetector
from maniskill_tomato.sensing.fruit_map import FruitMap
from maniskill_tomato.sensing.observation import ViewpointObserver
from maniskill_tomato.sensing.posed_frame import PosedFrame
from maniskill_tomato.sensing.simulated_camera import SimulatedCamera

SEEDS = (4, 9)
MOVES = ((0.4, 0.3, 0.2), (0.5, -0.2, 0.6), (-0.3, 0.6, 0.3))
RED = np.full((240, 320, 3), (200, 40, 30), np.uint8)
"""The picture that all frames have: its fruits are as red as ripe ones."""
NO_RAYS = ViewRays(torch.zeros(1, 256, 3), torch.zeros(1, 256), torch.zeros(1, 256, dtype=torch.int8))


def robot_frame(frame: PosedFrame, number: int) -> Frame:
    """The same picture from a robot's camera; the truth has the same masks, under labels of a driver's choice."""
    assert frame.true_fruits is not None and frame.robot_mask is not None
    labels = np.zeros(frame.depth_m.shape, np.int32)
    labels[frame.robot_mask] = ROBOT_LABEL
    for k, mask in enumerate(frame.true_fruits.masks):
        labels[mask] = FIRST_ORGAN_LABEL + k
    categories = enumerate(frame.true_fruits.categories)
    ripe = tuple(FIRST_ORGAN_LABEL + k for k, category in categories if category == "tomato_ripe")
    return Frame(
        color=RED,
        depth=frame.depth_m,
        intrinsics=frame.intrinsics,
        stamp=float(number),
        number=number,
        truth=FrameTruth(
            labels=labels,
            target_label=FIRST_ORGAN_LABEL,
            target_position=np.full(3, np.nan),
            visible_fraction=float("nan"),
            ripe_labels=ripe,
            rays=NO_RAYS,
        ),
    )


class FrameSegmenter:
    """A segmenter that knows every frame by its depth image: the same masks for both sides."""

    def __init__(self) -> None:
        self.known: list[PosedFrame] = []

    def __call__(self, image: Any, depth_m: Any = None) -> Instances:
        frame = next(f for f in self.known if f.depth_m is depth_m)
        assert frame.true_fruits is not None
        fruits = frame.true_fruits
        return Instances.from_masks(fruits.masks, np.full(len(fruits), 0.7, np.float32), fruits.categories)


def assert_same_map(robot: FruitMap, simulated: FruitMap) -> None:
    assert robot.tracks.keys() == simulated.tracks.keys()
    for number, track in robot.tracks.items():
        np.testing.assert_allclose(track.mean, simulated.tracks[number].mean, atol=1e-9)
        np.testing.assert_allclose(track.covariance, simulated.tracks[number].covariance, atol=1e-12)
        assert track.is_ripe == simulated.tracks[number].is_ripe


@pytest.mark.parametrize("masks", ["true", "segmented"])
def test_the_same_frames_give_the_same_observation_in_the_simulator_and_on_the_robot(masks: str) -> None:
    """Two environments at once against a robot before each plant: fruits, V_f, position, rays, observation."""
    episodes = [load_episode("held_out", seed) for seed in SEEDS]
    n, mount = len(episodes), torch.tensor(T_flange_camera_color_optical, dtype=torch.float64)
    scene = RayScene([e.plant for e in episodes], color_intrinsics(320, 240), robot_meshes=link_meshes())
    camera = SimulatedCamera(scene, picture=lambda k: RED)
    segmenter = None if masks == "true" else FrameSegmenter()
    targets = torch.stack([e.target_position for e in episodes])
    T_world_plant = torch.stack([e.T_world_plant for e in episodes])

    perception = CameraPerception(n, FruitDetector(segmenter))
    observer = ViewpointObserver(n, max_moves=20)
    observer.begin(torch.arange(n), targets)
    robots = [ImagePerception(TRUE_MASKS, segmenter) for _ in episodes]
    beliefs = [RobotBelief(T_flange_camera_color_optical, 20) for _ in episodes]
    for k, episode in enumerate(episodes):
        camera.seed(k, k)
        place = episode.target_position.double().numpy()
        perception.begin(k, place, place_error=PLACE_ERROR)
        robots[k].begin(place)

    qpos = torch.tensor(np.array([e.start_joints for e in episodes]), dtype=torch.float32)
    rpy = torch.tensor([FORWARD_RPY] * n)
    mover, seen, recalled = LookAtMover(), 0, 0
    for step in range(len(MOVES) + 1):
        links = link_transforms(qpos)
        T_world_camera = carried_pose(links[:, -1], mount)
        frames = camera.take(T_world_camera, T_world_plant, links)
        if segmenter is not None:
            segmenter.known = [frame for frame in frames if frame is not None]
        moved = perception.look(frames)
        rpy = matrix_to_rpy(links[:, -1, :3, :3], rpy)
        viewpoint = torch.cat([links[:, -1, :3, 3], rpy], dim=-1)
        left = torch.full((n,), 20 - step)
        if bool(moved.any()):
            perception.recall(observer, moved.nonzero()[:, 0])
            recalled += int(moved.sum()) if step else 0
        rays, fractions = perception.rays(), perception.visible_fraction
        observation = observer.observe(viewpoint, T_world_camera, rays, fractions, left)
        for k, frame in enumerate(frames):
            assert frame is not None
            joints = qpos[k].double().numpy()
            pose = beliefs[k].camera_pose(joints)
            sighting = robots[k].look(robot_frame(frame, step), pose)
            assert sighting is not None
            mine = perception.views(k)[-1]
            assert sighting.fruits_seen == sum(found.is_ripe for found in mine.fruits)
            assert_same_map(robots[k].map, perception.map(k))
            np.testing.assert_array_equal(sighting.mask, mine.mask(perception.target_fruit(k)))
            assert sighting.visible_fraction == pytest.approx(float(fractions[k]), abs=1e-6)
            assert sighting.sure_fraction == pytest.approx(float(perception.sure_fraction[k]), abs=1e-6)
            np.testing.assert_allclose(sighting.target_position, perception.position_w(k), atol=1e-6)
            torch.testing.assert_close(sighting.rays.label[0], rays.label[k])
            torch.testing.assert_close(sighting.rays.distance[0], rays.distance[k], rtol=0.0, atol=1e-6)
            told = beliefs[k].observe(joints, sighting, 20 - step)
            torch.testing.assert_close(told.observation[0], observation[k], rtol=0.0, atol=1e-6)
            seen += sighting.target_seen
        if step < len(MOVES):
            position = T_world_camera[:, :3, 3].double()
            solved = mover.move(qpos, position, targets.double(), torch.tensor([MOVES[step]] * n))
            qpos = solved.qpos.float()
    assert seen >= n * len(MOVES) / 2, "the target must be seen in most of the views"


def test_warming_up_has_the_segmenter_look_once_at_a_picture_of_the_cameras_size_and_maps_nothing() -> None:
    seen: list[Any] = []

    def segmenter(image: Any, depth_m: Any = None) -> Instances:
        seen.append((image.shape, image.dtype, image.max(), depth_m.shape))
        return Instances.from_masks(np.zeros((0, *depth_m.shape), np.bool_), categories=())

    perception = ImagePerception("counting", segmenter)
    perception.warm_up(color_intrinsics(320, 240))
    assert seen == [((240, 320, 3), np.dtype(np.uint8), 0, (240, 320))]
    assert list(perception.map.tracks) == []
    ImagePerception(TRUE_MASKS, None).warm_up(color_intrinsics(320, 240))
