"""Perception in the loop: V_f, the target's place and the rays' labels from a camera image instead of the simulator.

Depth is the D435's with its faults; masks are a perfect segmenter's or, rendered colours given, a trained one's; V and
T come from an occlusion model. Depth and labels are cast, so that without colours no Vulkan device is needed.
"""

from collections.abc import Callable
from typing import Final, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from maniskill_tomato.raycast.images import PixelLabel
from maniskill_tomato.raycast.scene import RayScene
from maniskill_tomato.raycast.view_rays import DEPTH_MODE, ViewRays
from maniskill_tomato.robot.d435 import CameraIntrinsics, color_intrinsics
from maniskill_tomato.robot.depth_noise import DepthNoise, measure_depth
from maniskill_tomato.segmentation.instances import TOMATO
from maniskill_tomato.segmentation.masks import BinaryMask
from maniskill_tomato.segmentation.segmenter import Segmenter, make_segmenter
from maniskill_tomato.sensing.target_tracker import TargetTracker
from maniskill_tomato.sensing.view_pattern import sample_view
from maniskill_tomato.sensing.visible_fraction.estimate import (
    Estimate,
    Float64,
    OcclusionModel,
    TomatoView,
    UInt8,
    fruit_depth,
)
from maniskill_tomato.sensing.visible_fraction.improved import ImprovedModel
from maniskill_tomato.sensing.visible_fraction.sphere import SphereConfig, SphereModel
from maniskill_tomato.sensing.visible_fraction.thesis import ThesisModel

Perception = Literal["ground_truth", "occlusion_model", "thesis_model", "improved_model", "segmenter"]
"""What reward, observation and the target's position come from.

`occlusion_model`: `SphereModel` on a perfect mask and noisy depth. `thesis_model`, `improved_model`: those models on
the same and rendered colours. `segmenter`: the light segmenter's masks in rendered colours, then `SphereModel`."""

RENDERED: Final[tuple[Perception, ...]] = ("thesis_model", "improved_model", "segmenter")
"""Those that need colours, and so a renderer."""

IMAGE_SIZE: Final = (320, 240)
"""Width and height of cast images, in [px]."""

RENDERED_SIZE: Final = (640, 480)
"""Width and height of rendered ones unless `sensor_configs` says otherwise, in [px]: the camera's own."""

MIN_SEEN: Final = 12
"""Pixels of the target in which it counts as seen."""

COARSE_POSITION: Final = 0.03
"""Standard deviation of each coordinate of a target's position before it was first seen, in [m]: that of a map of the
row made from further away."""

USUAL_RADIUS: Final = 0.029
"""Median radius of the tasks' tomatoes, in [m]."""


class CameraPerception:
    """What a wrist camera tells of the targets of B environments."""

    def __init__(
        self,
        scene: RayScene,
        *,
        intrinsics: CameraIntrinsics | None = None,
        noise: DepthNoise | None = None,
        model: OcclusionModel | None = None,
        segmenter: Segmenter | None = None,
        picture: Callable[[int], UInt8] | None = None,
    ) -> None:
        """Begins with all targets where they are.

        Args:
            scene: The environments' plants and links.
            intrinsics: Of the images; `IMAGE_SIZE` of the colour camera if None.
            noise: Faults of the depth, the defaults if None.
            model: Estimates V_f; if None a sphere model that knows the size of the tasks' tomatoes.
            segmenter: Finds fruits in colours; if None masks are perfect.
            picture: Renders the colours of an environment by its index, shape (height, width, 3); if None they are
                black.
        """
        self._scene = scene
        self._intrinsics = intrinsics or color_intrinsics(*IMAGE_SIZE)
        self._noise = noise or DepthNoise()
        self._model = model or SphereModel(SphereConfig(radius_m=USUAL_RADIUS, radius_spread=0.14))
        self._segmenter, self._picture = segmenter, picture
        b, device = scene.num_envs, scene.device
        self._rng = [np.random.default_rng(0) for _ in range(b)]
        self._hidden_below: list[float | None] = [None] * b
        self._choices = [TargetTracker() for _ in range(b)]
        self._offset = torch.zeros(b, 3, device=device)
        self.located = torch.zeros(b, dtype=torch.bool, device=device)
        """Whether the camera has seen where the target is. Shape (B,)."""
        self.visible_fraction = torch.zeros(b, device=device)
        """V_f of the last look as the model estimates it, 0 for a target that is not seen. Shape (B,)."""
        self._seen_at = torch.zeros(b, 3, device=device)
        self._depth: list[Float64] = []
        self._mask: list[BinaryMask] = []
        self._robot: list[BinaryMask] = []

    def begin(self, env_index: int, rng: np.random.RandomState, hidden_below: float | None = None) -> None:
        """Begins an episode; `forget` comes next.

        Args:
            env_index: Which environment's.
            rng: Where the number that its errors follow from is drawn.
            hidden_below: Its first view shows less of its first target than this V_f; None if that is not known.
        """
        self._rng[env_index] = np.random.default_rng(int(rng.randint(2**31 - 1)))
        self._hidden_below[env_index] = hidden_below

    def forget(self, env_idx: Tensor) -> None:
        """Begins with other targets, which are known from afar only. Shape (b,)."""
        for k in (int(i) for i in env_idx):
            offset = self._rng[k].normal(0.0, COARSE_POSITION, 3)
            self._offset[k] = torch.as_tensor(offset).to(self._offset)
            self._choices[k], self._hidden_below[k] = TargetTracker(self._hidden_below[k]), None
        self.located[env_idx] = False

    def known_target(self, target_position: Tensor) -> Tensor:
        """Where targets are believed to be, given where they are. Shape (B, 3)."""
        return target_position + self._offset

    def look(
        self, T_world_camera: Tensor, target: Tensor, known: Tensor, T_world_plant: Tensor, links: Tensor
    ) -> None:
        """Takes images and estimates V_f.

        Args:
            T_world_camera: Poses of the optical frames. Shape (B, 4, 4).
            target: Indices of the targets in `Plant.fruits`. Shape (B,).
            known: Where the targets are believed to be. Shape (B, 3).
            T_world_plant: Poses of the plants. Shape (B, 4, 4).
            links: World poses of the links. Shape (B, 9, 4, 4).
        """
        i = self._intrinsics
        images = self._scene.image(i, T_world_camera, target, T_world_plant, links)
        self._depth, self._mask, self._robot = [], [], []
        for k in range(len(self._rng)):
            true = images.depth[k].cpu().numpy().astype(np.float64)
            depth = measure_depth(true, i, self._noise, self._rng[k], stereo=DEPTH_MODE)
            pose = T_world_camera[k].double().cpu().numpy()
            rgb = np.zeros((i.height, i.width, 3), np.uint8) if self._picture is None else self._picture(k)
            masks, kinds = self._found(rgb, depth, (images.label[k] == int(PixelLabel.TARGET)).cpu().numpy())
            estimates = self._model(TomatoView(rgb=rgb, depth_m=depth, masks=tuple(masks), intrinsics=i))
            centres = [
                _in_world(estimate, mask, depth, i, pose)
                for estimate, mask in zip(estimates, masks, strict=True)
            ]
            if self._segmenter is None:
                chosen = 0 if masks else None
            else:
                fractions = [estimate.visible_fraction for estimate in estimates]
                believed = known[k].double().cpu().numpy()
                chosen = self._choices[k].choose(centres, fractions, kinds, believed, bool(self.located[k]))
            self._depth.append(depth)
            self._robot.append((images.label[k] == int(PixelLabel.ROBOT)).cpu().numpy())
            self._mask.append(np.zeros(depth.shape, bool) if chosen is None else masks[chosen])
            fraction = 0.0 if chosen is None else estimates[chosen].visible_fraction
            self.visible_fraction[k] = fraction if np.isfinite(fraction) else 0.0
            self._seen_at[k] = float("nan")
            if chosen is not None and (centre := centres[chosen]) is not None:
                self._seen_at[k] = torch.as_tensor(centre).to(self._seen_at)

    def _found(
        self, rgb: UInt8, depth_m: Float64, target_mask: BinaryMask
    ) -> tuple[list[BinaryMask], list[str]]:
        """Masks and kinds of the fruits that can be seen; of the target alone where masks are perfect."""
        masks, kinds = [target_mask], [TOMATO]
        if self._segmenter is not None:
            found = self._segmenter(rgb, depth_m.astype(np.float32))
            masks, kinds = list(found.masks), list(found.categories)
        seen = [n for n, mask in enumerate(masks) if np.count_nonzero(mask) >= MIN_SEEN]
        return [masks[n] for n in seen], [kinds[n] for n in seen]

    def locate(self, target_position: Tensor) -> Tensor:
        """Takes the position from the last look for the targets that were first seen in it.

        Args:
            target_position: Where targets are, in the world frame, in [m]. Shape (B, 3).

        Returns:
            Which targets these are. Shape (B,), bool.
        """
        new = ~self.located & self._seen_at.isfinite().all(-1)
        self._offset = torch.where(new[:, None], self._seen_at - target_position, self._offset)
        self.located = self.located | new
        return new

    def rays(self, T_world_camera: Tensor, target_position: Tensor) -> ViewRays:
        """The pattern read from the last images.

        Args:
            T_world_camera: As for `look`. Shape (B, 4, 4).
            target_position: Where the targets are believed to be. Shape (B, 3).
        """
        parts = [
            sample_view(
                self._depth[k],
                self._mask[k],
                self._intrinsics,
                T_world_camera[k],
                target_position[k],
                self._robot[k],
            )
            for k in range(len(self._depth))
        ]
        return ViewRays(
            torch.cat([p.direction_c for p in parts]),
            torch.cat([p.distance for p in parts]),
            torch.cat([p.label for p in parts]),
        )


def make_perception(
    perception: Perception,
    scene: RayScene,
    intrinsics: CameraIntrinsics,
    picture: Callable[[int], UInt8],
) -> CameraPerception | None:
    """The camera of a kind of perception; None for ground truth.

    Args:
        perception: Which.
        scene: The environments' plants and links.
        intrinsics: Of rendered pictures.
        picture: Renders them, by the index of an environment.
    """
    if perception == "ground_truth":
        return None
    if perception == "occlusion_model":
        return CameraPerception(scene)
    if perception == "segmenter":
        return CameraPerception(
            scene, intrinsics=intrinsics, segmenter=make_segmenter("light"), picture=picture
        )
    model = ThesisModel() if perception == "thesis_model" else ImprovedModel()
    return CameraPerception(scene, intrinsics=intrinsics, model=model, picture=picture)


def _in_world(
    estimate: Estimate, mask: BinaryMask, depth_m: Float64, intrinsics: CameraIntrinsics, pose: Float64
) -> Float64 | None:
    """Where a fruit is, in [m], shape (3,): as the model says, or a usual radius behind the middle of its mask."""
    optical: NDArray[np.float64]
    if estimate.centre_optical is not None:
        optical = np.array(estimate.centre_optical)
    else:
        z = fruit_depth(depth_m, mask)
        if not np.isfinite(z):
            return None
        rows, columns = np.nonzero(mask)
        pixel = np.array([columns.mean() + 0.5, rows.mean() + 0.5])
        optical = intrinsics.ray_directions(pixel) * (z + 0.7 * USUAL_RADIUS)
    return np.asarray(pose[:3, :3] @ optical + pose[:3, 3])
