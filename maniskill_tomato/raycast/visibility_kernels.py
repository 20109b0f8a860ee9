# mypy: ignore-errors
# pyright: reportArgumentType=false, reportAssignmentType=false, reportAttributeAccessIssue=false
# pyright: reportCallIssue=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportReturnType=false
# Warp's stubs describe calls from outside, not what stands inside a kernel.
"""Warp kernels that count which part of a fruit's silhouette a camera sees.

Their rays have a unit component along the optical axis. A point of the image plane is named by its tangents
(x / z, y / z).
"""

import warp as wp

from maniskill_tomato.raycast.kernels import (
    NEAR,
    SURFACE_GAP,
    FieldOfView,
    Scene,
    Views,
    bounding_rectangle,
    fruit_centre,
    fruit_distance,
    has_target,
    is_hidden,
    links_between,
)

wp.set_module_options({"enable_backward": False})

FAR = wp.constant(100.0)
"""Depth in [m] beyond which a target is not looked for."""

RESULTS = 4
"""Rows of the results: visible fraction, visible and total pixels, whether any ripe fruit is seen."""


@wp.struct
class Counts:
    """Rays by what became of them."""

    silhouette: wp.array[wp.int32]
    """Rays that the target's silhouette holds. Shape (B,)."""
    visible: wp.array[wp.int32]
    """Those that reach it inside the image. Shape (B,)."""
    any_seen: wp.array[wp.int32]
    """Whether another ripe fruit is seen. Shape (B,)."""


@wp.kernel
def trace_target(scene: Scene, views: Views, camera: FieldOfView, pattern: wp.array[wp.vec2], counts: Counts):
    """One ray through the target's rectangle: whether it belongs to the silhouette, and whether it is visible."""
    view, ray = wp.tid()
    if views.asked[view] == 0:
        return
    box = views.rectangles[view]
    if box[2] <= box[0] or box[3] <= box[1]:
        return
    x = box[0] + pattern[ray][0] * (box[2] - box[0])
    y = box[1] + pattern[ray][1] * (box[3] - box[1])
    tangents = wp.vec3(x, y, 1.0)
    depth = fruit_distance(scene, views, view, views.targets[view], tangents, NEAR, FAR)
    if depth < 0.0:
        return
    wp.atomic_add(counts.silhouette, view, 1)
    if x < camera.left or x > camera.right or y < camera.top or y > camera.bottom:
        return
    links = views.links_before_target[view]
    if not is_hidden(scene, views, view, links, tangents, NEAR, depth - NEAR - SURFACE_GAP):
        wp.atomic_add(counts.visible, view, 1)


@wp.kernel
def trace_others(scene: Scene, views: Views, camera: FieldOfView, pattern: wp.array[wp.vec2], counts: Counts):
    """Whether another ripe fruit is seen, asked only where nothing of the target is."""
    view, fruit = wp.tid()
    if views.asked[view] == 0:
        return
    env = views.environments[view]
    if counts.visible[view] > 0 or scene.fruit_is_ripe[env, fruit] == 0 or fruit == views.targets[view]:
        return
    sphere = scene.fruit_spheres[env, fruit]
    centre = fruit_centre(sphere, views, view)
    box = bounding_rectangle(centre, sphere[3])
    left = wp.max(box[0], camera.left)
    top = wp.max(box[1], camera.top)
    right = wp.min(box[2], camera.right)
    bottom = wp.min(box[3], camera.bottom)
    if left >= right or top >= bottom:
        return
    links = links_between(scene, views, view, centre, sphere[3])
    for ray in range(pattern.shape[0]):
        if counts.any_seen[view] != 0:
            return
        x = left + pattern[ray][0] * (right - left)
        y = top + pattern[ray][1] * (bottom - top)
        tangents = wp.vec3(x, y, 1.0)
        depth = fruit_distance(scene, views, view, fruit, tangents, NEAR, FAR)
        if depth >= 0.0:
            if not is_hidden(scene, views, view, links, tangents, NEAR, depth - NEAR - SURFACE_GAP):
                counts.any_seen[view] = 1


@wp.kernel
def summarise(
    scene: Scene,
    views: Views,
    camera: FieldOfView,
    rays: float,
    counts: Counts,
    results: wp.array2d[wp.float32],
):
    """Rays to fractions and pixels, for one view; the rows of `results` are those of `RESULTS`. Counts begin anew."""
    view = wp.tid()
    if views.asked[view] == 0:
        return
    seen = float(counts.visible[view])
    total = float(counts.silhouette[view])
    any_seen = counts.any_seen[view]
    counts.visible[view] = 0
    counts.silhouette[view] = 0
    counts.any_seen[view] = 0
    if not has_target(scene, views, view):
        for k in range(results.shape[0]):
            results[k, view] = wp.nan
        return
    if total > 0.0:
        box = views.rectangles[view]
        pixels = (box[2] - box[0]) * (box[3] - box[1]) * camera.square_pixels / rays
        results[0, view] = seen / total
        results[1, view] = seen * pixels
        results[2, view] = total * pixels
    else:
        # No silhouette in front of the camera: nothing is seen, and the size is the one it had if looked at.
        sphere = scene.fruit_spheres[views.environments[view], views.targets[view]]
        offset = wp.vec3(sphere[0], sphere[1], sphere[2]) - views.plant_positions[view]
        squared = sphere[3] * sphere[3]
        beyond = wp.max(wp.dot(offset, offset) - squared, 0.05 * squared)
        results[0, view] = 0.0
        results[1, view] = 0.0
        results[2, view] = 3.14159265 * squared / beyond * camera.square_pixels
    results[3, view] = 0.0
    if seen > 0.0 or any_seen != 0:
        results[3, view] = 1.0
