# mypy: ignore-errors
# pyright: reportArgumentType=false, reportAssignmentType=false, reportAttributeAccessIssue=false
# pyright: reportCallIssue=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportReturnType=false
# Warp's stubs describe calls from outside, not what stands inside a kernel.
"""Warp kernel of a whole depth image with labels."""

import warp as wp

from maniskill_tomato.raycast.kernels import NEAR, SURFACE_GAP, Scene, View

wp.set_module_options({"enable_backward": False})

NOTHING = wp.constant(wp.int8(0))
TARGET = wp.constant(wp.int8(1))
PLANT = wp.constant(wp.int8(2))
ROBOT = wp.constant(wp.int8(3))


@wp.kernel
def trace_image(
    scene: Scene,
    view: View,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    farthest: float,
    targets: wp.array[wp.int32],
    depths: wp.array3d[wp.float32],
    labels: wp.array3d[wp.int8],
):
    """One pixel: the depth of what its centre shows and which kind of thing that is."""
    env, row, column = wp.tid()
    # With a unit component along the optical axis, a ray's parameter is a depth.
    direction_c = wp.vec3((float(column) + 0.5 - cx) / fx, (float(row) + 0.5 - cy) / fy, 1.0)
    direction = view.plant_rotations[env] * direction_c
    start = view.plant_positions[env] + NEAR * direction
    label = NOTHING
    depth = farthest
    hit = wp.mesh_query_ray(scene.plant_meshes[env], start, direction, farthest - NEAR)
    if hit.result:
        label = PLANT
        depth = hit.t + NEAR
        if targets[env] >= 0 and targets[env] < scene.fruit_counts[env]:
            sphere = scene.fruit_spheres[env, targets[env]]
            offset = wp.vec3(sphere[0], sphere[1], sphere[2]) - start
            if wp.length(wp.cross(offset, wp.normalize(direction))) <= sphere[3]:
                mesh = scene.fruit_meshes[env, targets[env]]
                if wp.mesh_query_ray_anyhit(mesh, start, direction, hit.t + SURFACE_GAP):
                    label = TARGET
    remaining = view.links_in_the_way[env]
    link = wp.int32(0)
    while remaining != 0:
        if remaining & 1:
            link_start = view.link_positions[env, link] + NEAR * (
                view.link_rotations[env, link] * direction_c
            )
            link_direction = view.link_rotations[env, link] * direction_c
            met = wp.mesh_query_ray(scene.link_meshes[link], link_start, link_direction, depth - NEAR)
            if met.result:
                label = ROBOT
                depth = met.t + NEAR
        remaining = remaining >> 1
        link += 1
    depths[env, row, column] = depth
    labels[env, row, column] = label
