"""Images with what was found in them drawn over."""

import colorsys
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.segmentation.datasets.annotations import is_fruit
from maniskill_tomato.segmentation.instances import Image, Instances


def draw_instances(image: Image, found: Instances, least_score: float = 0.0) -> Image:
    """The image with masks, boxes and scores over it, as in Fig. 4-21 to 4-27 of the thesis.

    Args:
        image: Red, green, blue. Shape (H, W, 3).
        found: What to draw.
        least_score: Leave out what is less certain.
    """
    drawn = image.copy()
    thickness = max(1, round(max(image.shape[:2]) / 500))
    for index in range(len(found)):
        if found.scores[index] < least_score:
            continue
        colour = tuple(int(255 * c) for c in colorsys.hsv_to_rgb((0.55 + 0.618 * index) % 1.0, 0.75, 1.0))
        mask = found.masks[index]
        drawn[mask] = (0.55 * drawn[mask] + 0.45 * np.array(colour)).astype(np.uint8)
        left, top, right, bottom = (round(float(v)) for v in found.boxes[index])
        cv2.rectangle(drawn, (left, top), (right - 1, bottom - 1), colour, thickness)
        kind = found.categories[index]
        label = f"{'' if is_fruit(kind) else f'{kind} '}{found.scores[index]:.2f}"
        place = left, max(top - 3, 9)
        cv2.putText(drawn, label, place, cv2.FONT_HERSHEY_SIMPLEX, 0.35 * thickness, (0, 0, 0), 2 * thickness)
        cv2.putText(
            drawn, label, place, cv2.FONT_HERSHEY_SIMPLEX, 0.35 * thickness, (255, 255, 255), thickness
        )
    return drawn


def mark_boxes(image: Image, boxes: NDArray[np.floating[Any]], word: str) -> Image:
    """The image with a white frame and a word at each box.

    Args:
        image: Red, green, blue. Shape (H, W, 3).
        boxes: Left, top, right, bottom, in [px]. Shape (N, 4).
        word: What the boxes are.
    """
    drawn = image.copy()
    thickness = max(1, round(max(image.shape[:2]) / 500))
    for left, top, right, bottom in np.rint(boxes).astype(int).tolist():
        for colour, width in (((0, 0, 0), 3 * thickness), ((255, 255, 255), thickness)):
            cv2.rectangle(drawn, (left, top), (right - 1, bottom - 1), colour, width)
            place = left, min(bottom + 9 * thickness, image.shape[0] - 2)
            cv2.putText(drawn, word, place, cv2.FONT_HERSHEY_SIMPLEX, 0.35 * thickness, colour, width)
    return drawn


def contact_sheet(images: Sequence[Image], columns: int = 4, tile: tuple[int, int] = (320, 320)) -> Image:
    """Images side by side, each fitted into a tile.

    Args:
        images: RGB images of any size.
        columns: In a row.
        tile: Width and height of a tile, in [px].

    Returns:
        RGB. Shape (rows * tile height, columns * tile width, 3).
    """
    width, height = tile
    rows = -(-len(images) // columns)
    sheet = np.full((rows * height, columns * width, 3), 255, np.uint8)
    for number, image in enumerate(images):
        factor = min(width / image.shape[1], height / image.shape[0])
        size = max(round(image.shape[1] * factor), 1), max(round(image.shape[0] * factor), 1)
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA if factor < 1 else cv2.INTER_LINEAR)
        top, left = number // columns * height, number % columns * width
        sheet[top : top + size[1], left : left + size[0]] = small
    return sheet
