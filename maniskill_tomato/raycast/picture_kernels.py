# mypy: ignore-errors
# pyright: reportArgumentType=false, reportAssignmentType=false, reportAttributeAccessIssue=false
# pyright: reportCallIssue=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportReturnType=false
# Warp's stubs describe calls from outside, not what stands inside a kernel.
"""Warp kernels that draw a picture of one environment by one ray through the middle of every pixel."""

import warp as wp

from maniskill_tomato.raycast.kernels import NEAR, Scene, rotation, segment_meets_box, translation

wp.set_module_options({"enable_backward": False})

ROBOT = wp.constant(1)
FIRST_FACE_LABEL = wp.constant(2)


@wp.kernel
def draw_picture(
    scene: Scene,
    face_labels: wp.array[wp.int32],
    camera_pose: wp.mat44,
    plant_pose: wp.mat44,
    link_poses: wp.array[wp.mat44],
    focal: wp.vec2,
    principal: wp.vec2,
    farthest: float,
    depth: wp.array2d[wp.float32],
    labels: wp.array2d[wp.int32],
    facing: wp.array2d[wp.float32],
):
    """Depth, label and the cosine between the surface and the ray of one pixel."""
    row, column = wp.tid()
    direction_c = wp.vec3(
        (float(column) + 0.5 - principal[0]) / focal[0], (float(row) + 0.5 - principal[1]) / focal[1], 1.0
    )
    turn = rotation(camera_pose)
    position = translation(camera_pose)
    to_plant = wp.transpose(rotation(plant_pose))
    direction = to_plant * (turn * direction_c)
    start = to_plant * (position - translation(plant_pose)) + NEAR * direction
    nearest = farthest
    label = wp.int32(0)
    cosine = wp.float32(0.0)
    hit = wp.mesh_query_ray(scene.plant_meshes[0], start, direction, farthest - NEAR)
    if hit.result:
        nearest = hit.t + NEAR
        label = FIRST_FACE_LABEL + face_labels[hit.face]
        cosine = wp.abs(wp.dot(wp.normalize(hit.normal), wp.normalize(direction)))
    for link in range(scene.link_lows.shape[0]):
        pose = link_poses[scene.link_indices[link]]
        to_link = wp.transpose(rotation(pose))
        ray = to_link * (turn * direction_c)
        origin = to_link * (position - translation(pose))
        first = origin + NEAR * ray
        last = origin + nearest * ray
        if segment_meets_box(first, last, scene.link_lows[link], scene.link_highs[link]):
            touched = wp.mesh_query_ray(scene.link_meshes[link], first, ray, nearest - NEAR)
            if touched.result:
                nearest = touched.t + NEAR
                label = ROBOT
                cosine = wp.abs(wp.dot(wp.normalize(touched.normal), wp.normalize(ray)))
    labels[row, column] = label
    facing[row, column] = cosine
    if label == 0:
        depth[row, column] = 0.0
    else:
        depth[row, column] = nearest
