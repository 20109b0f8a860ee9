"""Buffers of the ray-casting kernels."""

from typing import Any

import warp as wp

from maniskill_tomato.raycast import kernels


def make_view(batch: int, links: int, warp_device: str) -> Any:
    """A `kernels.View` with its arrays.

    Args:
        batch: Number of views B.
        links: Number of link meshes.
        warp_device: A Warp device name.
    """

    def empty(shape: int | tuple[int, ...], dtype: Any) -> Any:
        return wp.empty(shape, dtype=dtype, device=warp_device)

    view: Any = kernels.View()
    view.plant_rotations = empty(batch, wp.mat33)
    view.plant_positions = empty(batch, wp.vec3)
    view.rectangles = empty(batch, wp.vec4)
    view.link_rotations = empty((batch, links), wp.mat33)
    view.link_positions = empty((batch, links), wp.vec3)
    view.links_in_the_way = empty(batch, wp.int32)
    view.counters = empty((batch, int(kernels.OUTCOMES)), wp.int32)
    view.any_seen = empty(batch, wp.int32)
    return view
