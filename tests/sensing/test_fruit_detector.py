"""Fruits measured in cast images of held-out plants against what the plants are."""

import numpy as np
import pytest
import torch

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.episode_list import load_episodes
from maniskill_tomato.plants.spec import ROW_PLANT
from maniskill_tomato.raycast.scene import RayScene
from maniskill_tomato.robot.d435 import color_intrinsics
from maniskill_tomato.robot.iiwa14 import LINK_NAMES
from maniskill_tomato.robot.look_at import look_at_pose
from maniskill_tomato.segmentation.instances import Instances
from maniskill_tomato.sensing.fruit_detector import FEWEST_PIXELS, LEAST_SCORE, FruitDetector
from maniskill_tomato.sensing.posed_frame import PosedFrame
from maniskill_tomato.sensing.simulated_camera import SimulatedCamera

AWAY = torch.eye(4).repeat(1, len(LINK_NAMES), 1, 1)
AWAY[..., :3, 3] = 1e6


def test_visible_fraction_position_and_radius_are_near_the_truth() -> None:
    episodes = load_episodes("held_out")
    stand, rng = torch.eye(4)[None], np.random.default_rng(3)
    scene, fractions, positions, radii = None, [], [], []
    for episode in (episodes[i] for i in (21, 34, 55)):
        plant = ROW_PLANT.grow(episode.plant_seed)
        scene = scene or RayScene([plant], color_intrinsics(320, 240), rays_per_side=48)
        scene.replace_plants({0: plant})
        camera, detector = SimulatedCamera(scene), FruitDetector(None)
        fruit = plant.fruits[episode.target]
        centre = torch.as_tensor(np.asarray(fruit.centre, np.float64))[None]
        for _ in range(4):
            turn, rise = rng.uniform(-0.6, 0.6, 2)
            from_target = -0.35 * np.array([np.cos(turn), np.sin(turn), -np.sin(rise)])
            pose = look_at_pose(centre + torch.as_tensor(from_target), centre).float()
            target = torch.tensor([episode.target])
            (frame,) = camera.take(pose, stand, AWAY)
            assert frame is not None
            truth = float(scene.visibility(pose, target, stand).visible_fraction[0])
            measured = detector.measure(frame)
            if truth < 0.3:
                continue
            shown = [frame.shown_fruit(measured.mask(k)) for k in range(len(measured.fruits))]
            found = measured.fruits[shown.index(episode.target)]
            assert found.is_depth_measured
            assert found.centre_w is not None
            fractions.append(abs(found.visible_fraction - truth))
            positions.append(float(np.linalg.norm(found.centre_w - centre[0].numpy())))
            radii.append(abs(found.radius_m / float(fruit.radius) - 1.0))
    assert len(fractions) >= 5
    assert np.mean(fractions) < 0.06
    assert np.median(positions) < 0.006
    assert np.median(radii) < 0.12


def frame(rgb: bool = True) -> PosedFrame:
    return PosedFrame(
        depth_m=np.full((60, 80), 0.5, np.float32),
        intrinsics=color_intrinsics(80, 60),
        T_world_camera=np.eye(4),
        rgb=np.zeros((60, 80, 3), np.uint8) if rgb else None,
    )


def test_small_and_unsure_fruits_are_left_out() -> None:
    masks = np.zeros((3, 60, 80), np.bool_)
    masks[0, 10:20, 10:20] = True
    masks[1, 30:40, 30:40] = True
    masks[2, 50, 50 : 50 + FEWEST_PIXELS - 1] = True
    scores = np.array([0.9, LEAST_SCORE - 0.01, 0.9], np.float32)
    kinds = ("tomato_unripe", "tomato_ripe", "tomato_ripe")
    found = Instances.from_masks(masks, scores, kinds)
    measured = FruitDetector(lambda image, depth_m=None: found).measure(frame())
    (fruit,) = measured.fruits
    assert (fruit.category, fruit.is_ripe, fruit.pixels) == ("tomato_unripe", False, 100)
    np.testing.assert_array_equal(measured.mask(0), masks[0])
    assert not measured.mask(None).any()


def test_a_mask_that_spills_over_to_neighbours_keeps_the_pixels_of_its_own_surface() -> None:
    rows, columns = np.mgrid[:60, :80]
    disc = (rows - 30) ** 2 + (columns - 40) ** 2 < 15**2
    depth = np.full((60, 80), 0.6, np.float32)
    depth[disc] = 0.36 - 0.02 * np.sqrt(1.0 - ((rows - 30) ** 2 + (columns - 40) ** 2)[disc] / 15**2)
    nearer, farther = disc & (columns < 30), np.zeros_like(disc)
    farther[25:35, 55:62] = True
    depth[nearer], depth[farther] = 0.3, 0.42
    unmeasured = disc & (rows > 40)
    depth[rows > 40] = 0.0
    spilled = Instances.from_masks((disc | farther)[None], np.ones(1, np.float32), ("tomato_ripe",))
    seen = PosedFrame(
        depth_m=depth,
        intrinsics=color_intrinsics(80, 60),
        T_world_camera=np.eye(4),
        rgb=np.zeros((60, 80, 3), np.uint8),
    )
    mask = FruitDetector(lambda image, depth_m=None: spilled).measure(seen).mask(0)
    own = disc & ~nearer & ~unmeasured
    spill = (nearer | farther) & ~unmeasured
    assert np.count_nonzero(mask & spill) < 0.1 * np.count_nonzero(spill)
    assert mask[own].all()
    # Rows without any depth say nothing against the mask.
    assert mask[unmeasured].all()


def test_a_fruit_keeps_its_pixels_in_the_stereo_shadow_of_a_leaf() -> None:
    rows, columns = np.mgrid[:60, :80]
    square = (rows - 30) ** 2 + (columns - 40) ** 2
    disc = square < 15**2
    depth = np.full((60, 80), 0.9, np.float32)
    depth[disc] = 0.40 - 0.029 * np.sqrt(1.0 - square[disc] / 15**2)
    # The shadow reaches from inside the fruit to what stands far behind it.
    depth[(columns > 44) & (columns < 62)] = 0.0
    found = Instances.from_masks(disc[None], np.ones(1, np.float32), ("tomato_ripe",))
    seen = PosedFrame(
        depth_m=depth,
        intrinsics=color_intrinsics(80, 60),
        T_world_camera=np.eye(4),
        rgb=np.zeros((60, 80, 3), np.uint8),
    )
    measured = FruitDetector(lambda image, depth_m=None: found).measure(seen)
    np.testing.assert_array_equal(measured.mask(0), disc)
    assert measured.fruits[0].visible_fraction > 0.9


def test_what_segmentation_needs_must_be_in_the_frame() -> None:
    with pytest.raises(InvalidInputError, match="choose a segmenter"):
        FruitDetector(None).measure(frame())
    with pytest.raises(InvalidInputError, match="colours"):
        FruitDetector(lambda image, depth_m=None: Instances.empty(60, 80)).measure(frame(rgb=False))
    with pytest.raises(InvalidInputError, match="robot_mask must have shape"):
        PosedFrame(
            depth_m=np.zeros((60, 80), np.float32),
            intrinsics=color_intrinsics(80, 60),
            T_world_camera=np.eye(4),
            robot_mask=np.zeros((60, 81), np.bool_),
        )


def test_pieces_of_one_fruit_are_measured_as_one_and_two_that_touch_are_not() -> None:
    rows, columns = np.mgrid[:60, :80]
    camera, radius = color_intrinsics(80, 60), 0.027
    rays = camera.ray_directions(camera.pixel_centres())
    depth = np.full((60, 80), 0.6, np.float32)
    discs = []
    for centre in (np.array([-0.03, 0.0, 0.3]), np.array([0.023, 0.0, 0.3])):
        along, square = rays @ centre, (rays**2).sum(-1)
        inside = along**2 - square * (centre @ centre - radius**2)
        hit = np.where(inside > 0.0, (along - np.sqrt(np.maximum(inside, 0.0))) / square, np.inf)
        disc = hit < depth
        depth = np.minimum(depth, hit).astype(np.float32)
        discs.append(disc)
    middle = int(columns[discs[0]].mean())
    masks = np.stack([discs[0] & (columns <= middle), discs[0] & (columns > middle), discs[1]])
    scores, kinds = np.array([0.5, 0.8, 0.9], np.float32), ("tomato_ripe",) * 3
    found = Instances.from_masks(masks, scores, kinds)
    view = PosedFrame(
        depth_m=depth,
        intrinsics=camera,
        # Looked down on, a flat fruit has a round outline.
        T_world_camera=np.diag([1.0, -1.0, -1.0, 1.0]),
        rgb=np.zeros((60, 80, 3), np.uint8),
    )
    measured = FruitDetector(lambda image, depth_m=None: found).measure(view)
    assert len(measured.fruits) == 2
    for k, (disc, score) in enumerate(zip(reversed(discs), (0.9, 0.8), strict=True)):
        np.testing.assert_array_equal(measured.mask(k), disc)
        fruit = measured.fruits[k]
        assert fruit.visible_fraction > 0.9
        assert (fruit.score, fruit.radius_m) == pytest.approx((score, radius), abs=0.003)
