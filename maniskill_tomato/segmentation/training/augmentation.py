"""Augmentation of training pictures: the light segmenter's (scale, place, light, mosaics) and the thesis's."""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.segmentation.detector_configs import AugmentationConfig, ClassicAugmentation
from maniskill_tomato.segmentation.instances import Image, mask_box
from maniskill_tomato.segmentation.training.training_pictures import TrainingPicture


def augmented(
    draw: Callable[[], TrainingPicture], config: AugmentationConfig, rng: np.random.Generator
) -> TrainingPicture:
    """A training picture of `config.size`.

    Args:
        draw: Gives an annotated picture; called four times for a mosaic.
        config: What to vary.
        rng: Where the variation comes from.
    """
    size = config.size
    if rng.random() >= config.mosaic_probability:
        return _coloured(_placed(draw(), (0, 0, size, size), config, rng), config, rng)
    x, y = (int(v) for v in rng.integers(size // 4, 3 * size // 4, 2))
    regions = [(0, 0, x, y), (x, 0, size, y), (0, y, x, size), (x, y, size, size)]
    parts = [_coloured(_placed(draw(), region, config, rng), config, rng) for region in regions]
    return _joined(parts, regions, size)


def _placed(
    picture: TrainingPicture,
    region: tuple[int, int, int, int],
    config: AugmentationConfig,
    rng: np.random.Generator,
) -> TrainingPicture:
    """The picture scaled, mirrored and cut to the size of a region, with its boxes and labels."""
    width, height = region[2] - region[0], region[3] - region[1]
    rows, columns = picture.image.shape[:2]
    scale = float(np.exp(rng.uniform(*np.log(config.scale))))
    flip = rng.random() < config.flip_probability
    # A larger picture covers the region, a smaller one lies inside it.
    slack = np.array([width - columns * scale, height - rows * scale])
    offset = rng.uniform(np.minimum(slack, 0), np.maximum(slack, 0))
    factor = -scale if flip else scale
    start = offset[0] + (columns * scale if flip else 0.0)
    matrix = np.array([[factor, 0, start], [0, scale, offset[1]]])
    # OpenCV counts from the centres of pixels, boxes from their edges.
    centred = matrix.copy()
    centred[:, 2] += matrix[:, :2] @ (0.5, 0.5) - 0.5
    how = cv2.INTER_AREA if scale < 0.5 else cv2.INTER_LINEAR
    grey = tuple(float(v) for v in rng.uniform(60, 200, 3))
    image = cv2.warpAffine(picture.image, centred, (width, height), flags=how, borderValue=grey)
    labels: NDArray[np.int16] | None = None
    if picture.labels is not None:
        warped = cv2.warpAffine(picture.labels, centred, (width, height), flags=cv2.INTER_NEAREST)
        labels = np.asarray(warped, np.int16)
    boxes = _moved(picture.boxes, matrix)
    whole = None if picture.whole_boxes is None else _moved(picture.whole_boxes, matrix)
    clipped = np.clip(boxes, 0, [width, height, width, height]).astype(np.float32)
    if labels is not None:
        for index in np.flatnonzero((clipped != boxes).any(axis=1)).tolist():
            clipped[index] = _visible_box(labels, index + 1, clipped[index])
    sides = clipped[:, 2:] - clipped[:, :2]
    share = sides.prod(axis=1) / np.maximum((boxes[:, 2:] - boxes[:, :2]).prod(axis=1), 1e-6)
    ignored = (
        picture.ignored
        | (sides.min(axis=1, initial=np.inf) < config.smallest_side)
        | (share < config.smallest_share)
    )
    kept = np.flatnonzero((sides > 0.5).all(axis=1))
    return TrainingPicture(
        image=image.astype(np.uint8),
        boxes=clipped[kept],
        ignored=ignored[kept],
        labels=None if labels is None else _renumbered(labels, kept, len(boxes)),
        whole_boxes=None if whole is None else whole[kept],
        categories=None if picture.categories is None else picture.categories[kept],
    )


def _moved(boxes: NDArray[np.float32], matrix: NDArray[np.float64]) -> NDArray[np.float32]:
    """Boxes under an affine map without rotation."""
    corners = boxes.reshape(-1, 2, 2) @ matrix[:, :2].T + matrix[:, 2]
    return np.concatenate([corners.min(axis=1), corners.max(axis=1)], axis=1).astype(np.float32)


def _visible_box(labels: NDArray[np.int16], number: int, box: NDArray[np.float32]) -> NDArray[np.float32]:
    """The box around what a cut box still has of a fruit's pixels; empty if it has none. Shape (4,)."""
    left, top = np.floor(box[:2]).astype(int)
    right, bottom = np.ceil(box[2:]).astype(int)
    inside = labels[top:bottom, left:right] == number
    if not inside.any():
        return np.array([left, top, left, top], np.float32)
    found = np.array(mask_box(inside), np.float32) + np.array([left, top, left, top], np.float32)
    # The edges that were not cut stay where they were, to a fraction of a pixel.
    return np.array([*np.maximum(found[:2], box[:2]), *np.minimum(found[2:], box[2:])], np.float32)


def _renumbered(labels: NDArray[np.int16], kept: NDArray[np.int64], count: int) -> NDArray[np.int16]:
    """Labels by the new indices of the fruits that are kept; those of the others become unknown."""
    table = np.full(count + 2, -1, np.int16)  # The last entry is that of the label -1.
    table[0] = 0
    table[kept + 1] = np.arange(1, len(kept) + 1)
    return table[labels]


def _coloured(
    picture: TrainingPicture, config: AugmentationConfig, rng: np.random.Generator
) -> TrainingPicture:
    """The picture in another light, through another camera."""
    image = picture.image.astype(np.float32)
    image *= rng.uniform(*config.brightness) * rng.uniform(*config.channel_gain, 3).astype(np.float32)
    mean = image.mean()
    image = mean + (image - mean) * rng.uniform(*config.contrast)
    grey = image.mean(axis=2, keepdims=True)
    image = grey + (image - grey) * rng.uniform(*config.saturation)
    if rng.random() < config.blur_probability:
        image = cv2.GaussianBlur(image, (0, 0), rng.uniform(0.3, 1.5)).astype(np.float32)
    if rng.random() < config.noise_probability:
        image += rng.normal(0, rng.uniform(1, 10), image.shape[:2])[:, :, None]
    table = (np.linspace(0, 1, 256) ** rng.uniform(*config.gamma) * 255).astype(np.uint8)
    return replace(picture, image=table[np.clip(image, 0, 255).astype(np.uint8)])


def _joined(
    parts: list[TrainingPicture], regions: list[tuple[int, int, int, int]], size: int
) -> TrainingPicture:
    """Pictures side by side in one; where one has no masks, labels are unknown."""
    image = np.zeros((size, size, 3), np.uint8)
    labels = np.full((size, size), -1, np.int16)
    count = 0
    for part, (left, top, right, bottom) in zip(parts, regions, strict=True):
        image[top:bottom, left:right] = part.image
        if part.labels is not None:
            labels[top:bottom, left:right] = np.where(part.labels > 0, part.labels + count, part.labels)
        count += len(part.boxes)
    offsets = [np.array([left, top, left, top], np.float32) for left, top, _, _ in regions]
    unknown = [np.full_like(p.boxes, np.nan) if p.whole_boxes is None else p.whole_boxes for p in parts]
    kinds = [np.full(len(p.boxes), -1) if p.categories is None else p.categories for p in parts]
    return TrainingPicture(
        image=image,
        boxes=np.concatenate([p.boxes + o for p, o in zip(parts, offsets, strict=True)]),
        ignored=np.concatenate([p.ignored for p in parts]),
        labels=labels,
        whole_boxes=np.concatenate([w + o for w, o in zip(unknown, offsets, strict=True)]),
        categories=np.concatenate(kinds),
    )


def classic_augmentation(
    picture: TrainingPicture, config: ClassicAugmentation, rng: np.random.Generator
) -> TrainingPicture:
    """The thesis's augmentation for Mask R-CNN: the picture changed in one way, or not at all (4-2-3)."""
    if rng.random() >= config.probability:
        return picture
    kinds = [
        *(["flip"] if config.flip else []),
        *(["blur"] if config.blur_sigma > 0 else []),
        "brightness",
        *(["contrast"] if config.contrast is not None else []),
    ]
    kind = kinds[int(rng.integers(len(kinds)))]
    if kind == "flip":
        return mirrored(picture)
    if kind == "blur":
        blurred = cv2.GaussianBlur(picture.image, (0, 0), config.blur_sigma)
        return replace(picture, image=np.asarray(blurred, np.uint8))
    if kind == "brightness" or config.contrast is None:
        return replace(picture, image=brighter(picture.image, float(rng.uniform(*config.brightness))))
    return replace(picture, image=contrasted(picture.image, float(rng.uniform(*config.contrast))))


def mirrored(picture: TrainingPicture) -> TrainingPicture:
    """Left and right exchanged, in the annotation too."""
    width = picture.image.shape[1]

    def flipped(boxes: np.ndarray) -> np.ndarray:
        return np.stack([width - boxes[:, 2], boxes[:, 1], width - boxes[:, 0], boxes[:, 3]], axis=1)

    return replace(
        picture,
        image=np.ascontiguousarray(picture.image[:, ::-1]),
        boxes=flipped(picture.boxes),
        labels=None if picture.labels is None else np.ascontiguousarray(picture.labels[:, ::-1]),
        whole_boxes=None if picture.whole_boxes is None else flipped(picture.whole_boxes),
    )


def brighter(image: Image, factor: float) -> Image:
    """Every pixel times a factor."""
    changed: Image = np.clip(image.astype(np.float32) * factor, 0, 255).astype(np.uint8)
    return changed


def contrasted(image: Image, alpha: float) -> Image:
    """Every pixel v as 127 + alpha (v - 127)."""
    changed: Image = np.clip(127 + alpha * (image.astype(np.float32) - 127), 0, 255).astype(np.uint8)
    return changed
