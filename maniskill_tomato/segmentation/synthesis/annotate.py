"""Annotations from the thing that each pixel shows: masks, amodal masks, boxes, visible fractions."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.robot.d435 import CameraIntrinsics
from maniskill_tomato.segmentation.datasets.annotations import Instance
from maniskill_tomato.segmentation.masks import EncodedMask
from maniskill_tomato.segmentation.synthesis.greenhouse import Thing
from maniskill_tomato.segmentation.synthesis.silhouette import draw_silhouette

Float64 = NDArray[np.float64]

MIN_VISIBLE: Final = 40
"""Pixels that must show a thing for it to have a visible mask, in an image of 640 x 480."""

MIN_WHOLE: Final = 120
"""Pixels that a fruit's whole silhouette must have inside the image for it to be annotated at all."""


def annotate(
    thing: NDArray[np.int32], things: Sequence[Thing], T_plant_optical: Float64, intrinsics: CameraIntrinsics
) -> tuple[Instance, ...]:
    """The annotations of one image.

    Fruits have visible and amodal masks and V_f; those of the row in front also where nothing of them is visible.
    Leaves, stems and the robot have visible masks.

    Args:
        thing: Which thing each pixel shows, -1 for others. Shape (height, width).
        things: What the numbers mean.
        T_plant_optical: The camera's pose. Shape (4, 4).
        intrinsics: Its numbers.
    """
    height, width = thing.shape
    scale = width * height / (640 * 480)
    counts = np.bincount(thing[thing >= 0], minlength=len(things))
    T_optical_plant = np.asarray(np.linalg.inv(T_plant_optical), dtype=np.float64)
    instances = []
    for k, what in enumerate(things):
        visible = int(counts[k])
        if what.vertices is None or what.faces is None:
            if visible >= MIN_VISIBLE * scale:
                mask = EncodedMask.encode(thing == k)
                instances.append(
                    Instance(
                        category=what.category, box_xywh=mask.box_xywh, visible_mask=mask, name=what.name
                    )
                )
            continue
        if visible < MIN_VISIBLE * scale and not what.in_front:
            continue
        instance = _fruit(what, thing == k, visible, T_optical_plant, intrinsics, scale)
        if instance is not None:
            instances.append(instance)
    return tuple(instances)


def _fruit(
    what: Thing,
    seen: NDArray[np.bool_],
    visible: int,
    T_optical_plant: Float64,
    intrinsics: CameraIntrinsics,
    scale: float,
) -> Instance | None:
    assert what.vertices is not None and what.faces is not None
    height, width = seen.shape
    optical = what.vertices.astype(np.float64) @ T_optical_plant[:3, :3].T + T_optical_plant[:3, 3]
    centre = optical.mean(0)
    if centre[2] <= 0:
        return None
    # Most of a row lies outside the image; a bounding box says so at once.
    reach = np.abs(optical - centre).max() * 1.8 * intrinsics.fx / max(centre[2], 0.05)
    u = intrinsics.fx * centre[0] / centre[2] + intrinsics.cx
    v = intrinsics.fy * centre[1] / centre[2] + intrinsics.cy
    if not (-reach < u < width + reach and -reach < v < height + reach):
        return None
    silhouette = draw_silhouette(optical, what.faces, intrinsics)
    if silhouette is None:
        return None
    # The renderer's edge and ours differ by parts of a pixel: what is seen belongs to the whole.
    inside = silhouette.in_image(width, height)
    whole = inside | seen
    if np.count_nonzero(whole) < MIN_WHOLE * scale:
        return None
    enough = visible >= MIN_VISIBLE * scale
    mask = EncodedMask.encode(seen) if enough else None
    total = silhouette.total + int(np.count_nonzero(seen & ~inside))
    return Instance(
        category=what.category,
        box_xywh=mask.box_xywh if mask is not None else (0.0, 0.0, 0.0, 0.0),
        visible_mask=mask,
        amodal_mask=EncodedMask.encode(whole),
        amodal_box_xywh=silhouette.box_xywh,
        visible_fraction=visible / total,
        name=what.name,
    )
