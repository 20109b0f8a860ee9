"""Cast depth images against the pattern of rays and the visible fraction, which know nothing of pixels."""

import numpy as np
import pytest
import torch
import trimesh

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.generator import generate_plant
from maniskill_tomato.plants.organs import Role
from maniskill_tomato.raycast.images import BACKGROUND_DEPTH, FIRST_ORGAN_LABEL, ROBOT_LABEL
from maniskill_tomato.raycast.scene import RayScene
from maniskill_tomato.raycast.view_rays import RayLabel
from maniskill_tomato.robot.d435 import CameraIntrinsics
from maniskill_tomato.robot.iiwa14 import LINK_NAMES
from maniskill_tomato.sensing.view_pattern import sample_view

pytestmark = pytest.mark.usefixtures("backend")

INTRINSICS = CameraIntrinsics.from_fov(width=160, height=120, fov_y=np.deg2rad(42.5))


def camera_towards(point: np.ndarray, distance: float) -> torch.Tensor:
    pose = np.eye(4)
    pose[:3, :3] = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    pose[:3, 3] = point - [distance, 0, 0]
    return torch.from_numpy(pose.astype(np.float32))[None]


def test_a_cast_image_shows_what_the_rays_say() -> None:
    plant = generate_plant("full", 3)
    scene = RayScene([plant], INTRINSICS, rays_per_side=24)
    stand, agreeing, seen_some = torch.eye(4)[None], [], 0
    for k in range(6):
        centre = torch.from_numpy(plant.fruits[k].centre)[None]
        camera, target = camera_towards(plant.fruits[k].centre, 0.35), torch.tensor([k])
        image = scene.image(INTRINSICS, camera, target, stand)
        visible = scene.visibility(camera, target, stand)
        pixels = int((image.role == int(Role.TARGET)).sum())
        seen_some += pixels > 0
        assert pixels == pytest.approx(float(visible.visible[0]), abs=0.06 * float(visible.total[0]) + 3)
        mask = image.role[0] == int(Role.TARGET)
        read = sample_view(image.depth[0], mask, INTRINSICS, camera[0], centre[0])
        cast = scene.view_rays(camera, target, centre, stand)
        both = (read.label != RayLabel.OUTSIDE) & (cast.label != RayLabel.OUTSIDE)
        agreeing.append((read.label == cast.label)[both].float().mean())
        near = both & (read.label == cast.label) & (read.label != RayLabel.FREE)
        assert float((read.distance - cast.distance)[near].abs().median()) < 0.003
    assert seen_some >= 4
    # A pixel's centre and the ray through that pixel can fall on two sides of an edge.
    assert float(torch.stack(agreeing).mean()) > 0.93


def test_where_nothing_stands_the_background_is_seen() -> None:
    plant = generate_plant("one_tomato", 0)
    scene = RayScene([plant], INTRINSICS)
    away = camera_towards(np.array([-2.0, 0.0, 0.5]), 0.5)
    away[0, :3, :3] = away[0, :3, :3] @ torch.diag(torch.tensor([-1.0, 1.0, -1.0]))
    image = scene.image(INTRINSICS, away, torch.tensor([0]), torch.eye(4)[None])
    assert bool((image.role == int(Role.BACKGROUND)).all())
    assert float(image.depth.min()) == BACKGROUND_DEPTH


def test_wrong_shapes_are_refused() -> None:
    scene = RayScene([generate_plant("one_tomato", 0)], INTRINSICS)
    with pytest.raises(InvalidInputError, match="target_fruit"):
        scene.image(INTRINSICS, torch.eye(4)[None], torch.zeros(2, dtype=torch.int64), torch.eye(4)[None])


def test_a_picture_shows_the_organs_that_an_image_labels() -> None:
    plant = generate_plant("full", 3)
    cube = trimesh.creation.box(extents=(0.05, 0.05, 0.05))
    meshes = {"link_3": (np.asarray(cube.vertices), np.asarray(cube.faces))}
    scene = RayScene([plant], INTRINSICS, robot_meshes=meshes)
    stand, organs = torch.eye(4)[None], []
    for k in range(3):
        camera = camera_towards(plant.fruits[k].centre, 0.35)
        links = torch.eye(4).repeat(1, len(LINK_NAMES), 1, 1)
        links[..., :3, 3] = camera[0, :3, 3] + torch.tensor([0.2, 0.06, 0.0])
        image = scene.image(INTRINSICS, camera, torch.tensor([k]), stand, links)
        picture = scene.picture(INTRINSICS, camera[0], stand[0], links[0])
        label, depth = image.role[0].numpy(), image.depth[0].numpy()
        assert np.array_equal(picture.labels == ROBOT_LABEL, label == int(Role.ROBOT))
        assert np.array_equal(
            picture.labels == FIRST_ORGAN_LABEL + plant.fruits[k].organ_index, label == int(Role.TARGET)
        )
        # A picture reaches farther than an image does.
        near = label != int(Role.BACKGROUND)
        for row, column in np.argwhere(
            near & (picture.labels >= FIRST_ORGAN_LABEL) & (label != int(Role.TARGET))
        ):
            organ = plant.organs[picture.labels[row, column] - FIRST_ORGAN_LABEL]
            expected = (
                "OTHER_FRUIT" if organ.semantic_class.name.startswith("FRUIT") else organ.semantic_class.name
            )
            assert Role(int(label[row, column])).name == expected
        assert np.count_nonzero(label == int(Role.ROBOT)) > 100
        np.testing.assert_array_equal(picture.depth[near], depth[near])
        assert picture.facing.min() >= 0.0 and picture.facing.max() <= 1.0 + 1e-6
        # The cube's face looks straight at the camera: along its depth the rays open by their own angle.
        x, y = np.meshgrid(*(np.arange(n) + 0.5 for n in (INTRINSICS.width, INTRINSICS.height)))
        angle = np.hypot((x - INTRINSICS.cx) / INTRINSICS.fx, (y - INTRINSICS.cy) / INTRINSICS.fy)
        front = (label == int(Role.ROBOT)) & (np.abs(depth - 0.175) < 1e-4)
        np.testing.assert_allclose(picture.facing[front], 1 / np.hypot(1, angle)[front], atol=1e-4)
        organs.append(set(np.unique(picture.labels[picture.labels >= FIRST_ORGAN_LABEL])))
    assert all(len(seen) > 3 and max(seen) < FIRST_ORGAN_LABEL + len(plant.organs) for seen in organs)


def test_each_environment_has_its_own_image() -> None:
    plants = [generate_plant("full", 3), generate_plant("one_tomato", 1)]
    both, stand = RayScene(plants, INTRINSICS), torch.eye(4)[None]
    cameras = torch.cat([camera_towards(plant.fruits[0].centre, 0.4) for plant in plants])
    together = both.image(INTRINSICS, cameras, torch.tensor([0, 0]), stand.repeat(2, 1, 1))
    for k, plant in enumerate(plants):
        alone = RayScene([plant], INTRINSICS).image(INTRINSICS, cameras[k : k + 1], torch.tensor([0]), stand)
        torch.testing.assert_close(together.depth[k : k + 1], alone.depth, atol=0, rtol=0)
        torch.testing.assert_close(together.role[k : k + 1], alone.role, atol=0, rtol=0)
