# mypy: ignore-errors
# pyright: reportArgumentType=false, reportAssignmentType=false, reportAttributeAccessIssue=false
# pyright: reportCallIssue=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportReturnType=false
# Warp's stubs describe calls from outside, not what stands inside a kernel.
"""Warp kernel of the distance between spheres on the arm and the plants' triangles."""

import warp as wp

from maniskill_tomato.raycast.kernels import rotation, translation

wp.set_module_options({"enable_backward": False})


@wp.kernel
def sphere_clearance(
    plant_meshes: wp.array[wp.uint64],
    environments: wp.array[wp.int32],
    plant_poses: wp.array[wp.mat44],
    link_poses: wp.array3d[wp.mat44],
    sphere_links: wp.array[wp.int32],
    spheres: wp.array[wp.vec4],
    furthest: float,
    clearance: wp.array[wp.float32],
):
    """The smallest distance of the spheres over all samples of a path, at most `furthest`."""
    path, sample, index = wp.tid()
    sphere = spheres[index]
    link = link_poses[path, sample, sphere_links[index]]
    centre_w = rotation(link) * wp.vec3(sphere[0], sphere[1], sphere[2]) + translation(link)
    pose = plant_poses[path]
    centre = wp.transpose(rotation(pose)) * (centre_w - translation(pose))
    mesh = plant_meshes[environments[path]]
    # Only what can make the result smaller is looked for.
    within = sphere[3] + wp.min(furthest, clearance[path])
    if within <= 0.0:
        return
    found = wp.mesh_query_point_no_sign(mesh, centre, within)
    if found.result:
        nearest = wp.mesh_eval_position(mesh, found.face, found.u, found.v)
        wp.atomic_min(clearance, path, wp.length(nearest - centre) - sphere[3])
