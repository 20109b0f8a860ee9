"""Views that are kept, and read again when the target turns out to stand elsewhere."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from maniskill_tomato.raycast.view_rays import RayLabel
from maniskill_tomato.robot.d435 import color_intrinsics
from maniskill_tomato.robot.look_at import look_at_pose
from maniskill_tomato.segmentation.instances import Instances
from maniskill_tomato.sensing.camera_perception import CameraPerception
from maniskill_tomato.sensing.fruit_detector import FruitDetector
from maniskill_tomato.sensing.observation import ViewpointObserver
from maniskill_tomato.sensing.posed_frame import PosedFrame

INTRINSICS = color_intrinsics(160, 120)
TARGET = np.array([0.9, 0.0, 0.6])
BELIEVED = TARGET + [0.01, 0.03, -0.02]
RADIUS = 0.03


def frame(camera: tuple[float, float, float], hidden: bool = False) -> PosedFrame:
    """A sphere before a wall 0.3 m behind it; hidden by a leaf 8 cm before it."""
    position = torch.tensor([camera], dtype=torch.float64)
    pose: NDArray[np.float64] = look_at_pose(position, torch.as_tensor(TARGET)[None])[0].numpy()
    centre = pose[:3, :3].T @ (TARGET - pose[:3, 3])
    rays = INTRINSICS.ray_directions(INTRINSICS.pixel_centres())
    square = (rays**2).sum(-1)
    along = rays @ centre
    inside = along**2 - square * (centre @ centre - RADIUS**2)
    mask = inside > 0.0
    depth = np.where(mask, (along - np.sqrt(np.maximum(inside, 0.0))) / square, centre[2] + 0.3)
    if hidden:
        depth[40:80, 50:110] = centre[2] - 0.08
        mask[:] = False
    return PosedFrame(
        depth_m=depth.astype(np.float32),
        intrinsics=INTRINSICS,
        T_world_camera=pose,
        true_fruits=Instances.from_masks(mask[None], categories=("tomato_ripe",)),
    )


HIDDEN = frame((0.5, -0.1, 0.6), hidden=True)
OPEN = frame((0.5, 0.2, 0.7))


def observe(observer: ViewpointObserver, perception: Any, frames: list[PosedFrame], mask: Any) -> None:
    poses = torch.tensor(np.array([f.T_world_camera for f in frames]), dtype=torch.float32)
    n = len(frames)
    viewpoint, left = torch.zeros(n, 6), torch.full((n,), 5)
    observer.observe(viewpoint, poses, perception.rays(), perception.visible_fraction, left, mask)


def test_what_was_seen_before_is_taken_in_again_about_the_measured_position() -> None:
    perception = CameraPerception(2, FruitDetector(None))
    observer = ViewpointObserver(2, max_moves=5)
    observer.begin(torch.arange(2), torch.as_tensor(np.stack([BELIEVED] * 2), dtype=torch.float32))
    for k in range(2):
        perception.begin(k, BELIEVED)
    assert perception.look([HIDDEN, HIDDEN]).tolist() == [False, False]
    observe(observer, perception, [HIDDEN, HIDDEN], None)
    assert perception.visible_fraction.tolist() == [0.0, 0.0]
    kept = {name: tensor[0].clone() for name, tensor in observer.state_dict().items()}

    # The second environment's camera moves and sees the target; the first one's does not look.
    located = perception.look([None, OPEN])
    assert located.tolist() == [False, True] == perception.is_located.tolist()
    np.testing.assert_allclose(perception.position_w(1), TARGET, atol=0.004)
    perception.recall(observer, torch.tensor([1]))
    observe(observer, perception, [HIDDEN, OPEN], located)

    known = CameraPerception(2, FruitDetector(None))
    expected = ViewpointObserver(2, max_moves=5)
    expected.begin(torch.arange(2), perception.target_position)
    for k in range(2):
        known.begin(k, perception.position_w(k), place_error=0.001)
    for frames in ([HIDDEN, HIDDEN], [OPEN, OPEN]):
        known.look(frames)
        observe(expected, known, frames, None)
    for name, tensor in observer.state_dict().items():
        torch.testing.assert_close(
            tensor[1], expected.state_dict()[name][1], rtol=0.0, atol=0.0, equal_nan=True
        )
        torch.testing.assert_close(tensor[0], kept[name], rtol=0.0, atol=0.0, equal_nan=True)


def test_rays_can_be_read_about_any_position_and_fruit() -> None:
    measured = FruitDetector(None).measure(OPEN)
    assert len(measured.fruits) == 1
    fruit = measured.fruits[0]
    # A pixel is 4 mm there.
    assert fruit.visible_fraction > 0.97 and abs(fruit.radius_m - RADIUS) < 0.003
    about = measured.rays(TARGET, 0)
    assert int((about.label == int(RayLabel.TARGET)).sum()) > 9
    other = measured.rays(TARGET, None)
    assert int((other.label == int(RayLabel.TARGET)).sum()) == 0
    torch.testing.assert_close(other.distance, about.distance)
    aside = measured.rays(TARGET + [0.0, 0.15, 0.0], 0)
    assert 0 <= int((aside.label == int(RayLabel.TARGET)).sum()) < 9


def test_an_environment_that_has_not_looked_knows_nothing() -> None:
    perception = CameraPerception(2, FruitDetector(None))
    perception.begin(0, TARGET)
    perception.look([OPEN, None])
    rays = perception.rays()
    assert rays.label.shape == (2, 256)
    assert bool((rays.label[1] == int(RayLabel.OUTSIDE)).all()) and not bool(rays.distance[1].any())
    assert float(perception.visible_fraction[1]) == 0.0 and not perception.views(1)
