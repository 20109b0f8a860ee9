"""The augmentation of the thesis's Mask R-CNN: one of three or four changes, with a probability."""

from dataclasses import replace

import cv2
import numpy as np

from maniskill_tomato.segmentation.instances import Image
from maniskill_tomato.segmentation.training.detector_presets import ClassicAugmentation
from maniskill_tomato.segmentation.training.training_pictures import TrainingPicture


def classic_augmentation(
    picture: TrainingPicture, config: ClassicAugmentation, rng: np.random.Generator
) -> TrainingPicture:
    """The picture, changed in one way or not at all."""
    if rng.random() >= config.probability:
        return picture
    kinds = [name for name, used in _used(config).items() if used]
    kind = kinds[int(rng.integers(len(kinds)))]
    if kind == "flip":
        return mirrored(picture)
    if kind == "blur":
        return replace(
            picture, image=np.asarray(cv2.GaussianBlur(picture.image, (0, 0), config.blur_sigma), np.uint8)
        )
    if kind == "brightness" or config.contrast is None:
        return replace(picture, image=brighter(picture.image, float(rng.uniform(*config.brightness))))
    return replace(picture, image=contrasted(picture.image, float(rng.uniform(*config.contrast))))


def _used(config: ClassicAugmentation) -> dict[str, bool]:
    return {
        "flip": config.flip,
        "blur": config.blur_sigma > 0,
        "brightness": True,
        "contrast": config.contrast is not None,
    }


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
