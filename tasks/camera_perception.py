"""Perception in the loop: V_f, the target's place and the rays' labels from a camera image instead of the simulator.

The image is the D435's depth with its faults and the target's mask as a perfect segmenter gives it; V and T come from
the occlusion model. The image is cast, not rendered, so that no Vulkan device is needed.
"""

from typing import Final, Literal

import numpy as np
import torch
from torch import Tensor

from maniskill_tomato.perception.occlusion.estimate import TomatoView
from maniskill_tomato.perception.occlusion.sphere import SphereConfig, SphereModel
from maniskill_tomato.robot.d435 import CameraIntrinsics, color_intrinsics
from maniskill_tomato.robot.depth_noise import DepthNoise, measure_depth
from maniskill_tomato.visibility.cast_image import ImageCaster, PixelLabel
from maniskill_tomato.visibility.caster import VisibilityCaster
from maniskill_tomato.visibility.view_rays import DEPTH_MODE, ViewRays, sample_view

Perception = Literal["ground_truth", "occlusion_model"]
"""What reward, observation and the target's position come from."""

IMAGE_SIZE: Final = (320, 240)
"""Width and height of the images, in [px]."""

MIN_SEEN: Final = 12
"""Pixels of the target in which it counts as seen."""

COARSE_POSITION: Final = 0.03
"""Standard deviation of each coordinate of a target's position before it was first seen, in [m]: that of a map of the
row made from further away."""


class CameraPerception:
    """What a wrist camera tells of the targets of B environments."""

    def __init__(
        self,
        caster: VisibilityCaster,
        *,
        intrinsics: CameraIntrinsics | None = None,
        noise: DepthNoise | None = None,
        model: SphereModel | None = None,
    ) -> None:
        """Begins with all targets where they are.

        Args:
            caster: The environments' plants and links.
            intrinsics: Of the images; `IMAGE_SIZE` of the colour camera if None.
            noise: Faults of the depth, the defaults if None.
            model: Estimates V_f; if None one that knows the size of the tasks' tomatoes.
        """
        self._images = ImageCaster(caster, intrinsics or color_intrinsics(*IMAGE_SIZE))
        self._noise = noise or DepthNoise()
        self._model = model or SphereModel(SphereConfig(radius_spread=0.14))
        b, device = caster.num_envs, caster.device
        self._rng = [np.random.default_rng(0) for _ in range(b)]
        self._offset = torch.zeros(b, 3, device=device)
        self.located = torch.zeros(b, dtype=torch.bool, device=device)
        """Whether the camera has seen where the target is. Shape (B,)."""
        self.visible_fraction = torch.zeros(b, device=device)
        """V_f of the last look as the model estimates it, 0 for a target that is not seen. Shape (B,)."""
        self._seen_at = torch.zeros(b, 3, device=device)
        self._depth: list[np.ndarray[tuple[int, ...], np.dtype[np.float64]]] = []
        self._label = torch.zeros(0, device=device)

    def begin(self, env_index: int, rng: np.random.RandomState) -> None:
        """Draws the numbers that an episode's errors come from."""
        self._rng[env_index] = np.random.default_rng(int(rng.randint(2**31 - 1)))

    def forget(self, env_idx: Tensor) -> None:
        """Begins with other targets, which are known from afar only. Shape (b,)."""
        for k in (int(i) for i in env_idx):
            offset = self._rng[k].normal(0.0, COARSE_POSITION, 3)
            self._offset[k] = torch.as_tensor(offset).to(self._offset)
        self.located[env_idx] = False

    def known_target(self, target_position: Tensor) -> Tensor:
        """Where targets are believed to be, given where they are. Shape (B, 3)."""
        return target_position + self._offset

    def look(self, T_world_camera: Tensor, target: Tensor, T_world_plant: Tensor, links: Tensor) -> None:
        """Takes images and estimates V_f.

        Args:
            T_world_camera: Poses of the optical frames. Shape (B, 4, 4).
            target: Indices of the targets in `Plant.fruits`. Shape (B,).
            T_world_plant: Poses of the plants. Shape (B, 4, 4).
            links: World poses of the links. Shape (B, 9, 4, 4).
        """
        images = self._images.cast(T_world_camera, target, T_world_plant, links)
        self._label = images.label
        self._depth = []
        i = self._images.intrinsics
        for k in range(len(self._rng)):
            true = images.depth[k].cpu().numpy().astype(np.float64)
            depth = measure_depth(true, i, self._noise, self._rng[k], stereo=DEPTH_MODE)
            self._depth.append(depth)
            mask = (images.label[k] == int(PixelLabel.TARGET)).cpu().numpy()
            self.visible_fraction[k] = 0.0
            self._seen_at[k] = float("nan")
            if np.count_nonzero(mask) < MIN_SEEN:
                continue
            blank = np.zeros((i.height, i.width, 3), dtype=np.uint8)
            (estimate,) = self._model(TomatoView(rgb=blank, depth_m=depth, masks=(mask,), intrinsics=i))
            if np.isfinite(estimate.visible_fraction):
                self.visible_fraction[k] = estimate.visible_fraction
            if estimate.centre_optical is not None:
                centre = torch.tensor([*estimate.centre_optical, 1.0], dtype=torch.float64)
                self._seen_at[k] = (T_world_camera[k].double().cpu() @ centre)[:3].to(self._seen_at)

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
                self._label[k] == int(PixelLabel.TARGET),
                self._images.intrinsics,
                T_world_camera[k],
                target_position[k],
                self._label[k] == int(PixelLabel.ROBOT),
            )
            for k in range(len(self._depth))
        ]
        return ViewRays(
            torch.cat([p.direction_c for p in parts]),
            torch.cat([p.distance for p in parts]),
            torch.cat([p.label for p in parts]),
        )
