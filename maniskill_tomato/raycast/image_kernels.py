# mypy: ignore-errors
# pyright: reportArgumentType=false, reportAssignmentType=false, reportAttributeAccessIssue=false
# pyright: reportCallIssue=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportReturnType=false
# Warp's stubs describe calls from outside, not what stands inside a kernel.
"""Warp kernels of whole images: one ray through the middle of every pixel."""

import warp as wp

from maniskill_tomato.raycast.kernels import (
    LINK,
    NEAR,
    PLANT,
    Scene,
    Views,
    first_hit,
    is_target,
)

wp.set_module_options({"enable_backward": False})

NO_FACE = wp.constant(-1)
FACE_OF_ROBOT = wp.constant(-2)
FACE_OF_TARGET = wp.constant(-3)


@wp.struct
class Pinhole:
    """Intrinsics, in [px]."""

    fx: wp.float32
    fy: wp.float32
    cx: wp.float32
    cy: wp.float32


@wp.func
def pixel_direction(pinhole: Pinhole, row: int, column: int) -> wp.vec3:
    """Through the middle of a pixel, in the optical frame; with a unit z component a ray's parameter is a depth."""
    x = (float(column) + 0.5 - pinhole.cx) / pinhole.fx
    y = (float(row) + 0.5 - pinhole.cy) / pinhole.fy
    return wp.vec3(x, y, 1.0)


@wp.kernel
def trace_image(
    scene: Scene,
    views: Views,
    pinhole: Pinhole,
    farthest: float,
    depths: wp.array3d[wp.float32],
    faces: wp.array3d[wp.int32],
):
    """One pixel: the depth of what its centre shows, `farthest` without anything, and which triangle of the plant that
    is, unless it is the target or none."""
    view, row, column = wp.tid()
    direction_c = pixel_direction(pinhole, row, column)
    hit = first_hit(scene, views, view, direction_c, NEAR, farthest)
    face = NO_FACE
    if hit.kind == LINK:
        face = FACE_OF_ROBOT
    elif hit.kind == PLANT:
        face = hit.face
        if is_target(scene, views, view, direction_c, NEAR, hit.distance):
            face = FACE_OF_TARGET
    depths[view, row, column] = hit.distance
    faces[view, row, column] = face


@wp.kernel
def trace_picture(
    scene: Scene,
    views: Views,
    pinhole: Pinhole,
    farthest: float,
    depths: wp.array3d[wp.float32],
    faces: wp.array3d[wp.int32],
    facings: wp.array3d[wp.float32],
):
    """One pixel: depth, 0 without anything; triangle of the plant; cosine between the surface and the ray."""
    view, row, column = wp.tid()
    hit = first_hit(scene, views, view, pixel_direction(pinhole, row, column), NEAR, farthest)
    depth = wp.float32(0.0)
    face = NO_FACE
    if hit.kind == LINK:
        depth = hit.distance
        face = FACE_OF_ROBOT
    elif hit.kind == PLANT:
        depth = hit.distance
        face = hit.face
    depths[view, row, column] = depth
    faces[view, row, column] = face
    facings[view, row, column] = hit.facing
