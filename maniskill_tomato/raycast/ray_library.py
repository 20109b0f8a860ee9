"""What `RayScene` asks of the library that traces its rays."""

from collections.abc import Mapping
from typing import Any, Protocol

from numpy.typing import NDArray
from torch import Tensor

from maniskill_tomato.plants.organs import Plant
from maniskill_tomato.raycast.images import CastImages, Picture
from maniskill_tomato.raycast.view_rays import ViewRays
from maniskill_tomato.raycast.visibility import Visibility
from maniskill_tomato.robot.d435 import CameraIntrinsics

LinkMeshes = Mapping[str, tuple[NDArray[Any], NDArray[Any]]]
"""Vertices in the link frame, in [m], Shape (V, 3), and faces, Shape (F, 3), by link name."""


class RayLibrary(Protocol):
    """The triangles of N environments and the queries about them, in terms of tensors alone.

    `RayScene` checks shapes and ranges before it asks, and its methods say what the arguments mean. All tensors live
    on the scene's device; what is given back stays as it is when the next query is made.
    """

    def show(self, env_index: int, plant: Plant) -> None:
        """Shows another plant in one environment, once all queries under way are done."""
        ...

    def visibility(
        self, T_w_camera: Tensor, target_fruit: Tensor, T_w_plant: Tensor, T_w_links: Tensor | None
    ) -> Visibility:
        """See `RayScene.visibility`."""
        ...

    def visible_fraction_from(
        self,
        T_w_camera: Tensor,
        target_fruit: int,
        T_w_plant: Tensor,
        T_w_links: Tensor | None,
        env_index: int,
    ) -> Tensor:
        """See `RayScene.visible_fraction_from`."""
        ...

    def view_rays(
        self,
        T_w_camera: Tensor,
        target_fruit: Tensor,
        target_position: Tensor,
        T_w_plant: Tensor,
        T_w_links: Tensor | None,
    ) -> ViewRays:
        """See `RayScene.view_rays`."""
        ...

    def image(
        self,
        intrinsics: CameraIntrinsics,
        T_w_camera: Tensor,
        target_fruit: Tensor,
        T_w_plant: Tensor,
        T_w_links: Tensor | None,
    ) -> CastImages:
        """See `RayScene.image`."""
        ...

    def picture(
        self,
        intrinsics: CameraIntrinsics,
        T_w_camera: Tensor,
        T_w_plant: Tensor,
        T_w_links: Tensor | None,
        env_index: int,
    ) -> Picture:
        """See `RayScene.picture`."""
        ...

    def clearance(
        self, T_w_links: Tensor, T_w_plant: Tensor, env_idx: Tensor | None, farthest: float
    ) -> Tensor:
        """The smallest distance between the arm's spheres (`robot.spheres`) and a plant over S postures of each path.

        Args:
            T_w_links: Poses of `iiwa14.LINK_NAMES`. Shape (P, S, 9, 4, 4).
            T_w_plant: Poses of the plants. Shape (P, 4, 4).
            env_idx: Whose plant each path is held against; None for one path in every environment. Shape (P,).
            farthest: Largest distance that is told apart, in [m].

        Returns:
            In [m], negative where a triangle cuts a sphere. Shape (P,).
        """
        ...
