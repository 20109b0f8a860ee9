"""The interface of a segmenter, which finds fruits in an image, and the opener by name or by file of weights.

The segmenter that knows, from a label image that a renderer gives, stands here too.
"""

import inspect
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.errors import CheckpointError, InvalidInputError
from maniskill_tomato.extension_points import ExtensionPoint
from maniskill_tomato.segmentation.instances import Image, Instances, check_image

SEGMENTERS: Final = ExtensionPoint(
    "segmenter",
    "maniskill_tomato.segmenters",
    {
        "light": "maniskill_tomato.segmentation.light_segmenter:open_light",
        "colour": "maniskill_tomato.segmentation.colour_segmenter:ColourSegmenter",
        "ground_truth": "maniskill_tomato.segmentation.segmenter:GroundTruthSegmenter",
        "mask_rcnn": "maniskill_tomato.segmentation.mask_rcnn:open_mask_rcnn",
        "yolo": "maniskill_tomato.segmentation.yolo:open_yolo",
    },
)
"""Each kind of segmenter by name, and what opens it. What another package adds is a callable that returns a
`Segmenter`; if it takes `score_threshold`, it leaves out detections below."""

DEFAULT_SEGMENTER = "light"


class Segmenter(Protocol):
    """Finds fruits in images."""

    def __call__(self, image: Image, depth_m: NDArray[np.float32] | None = None) -> Instances:
        """The fruits in an image.

        Args:
            image: Colours red, green, blue. Shape (H, W, 3).
            depth_m: Depth of each pixel in [m], 0 or NaN where unknown. Shape (H, W).

        Raises:
            InvalidInputError: The image or the depth has another shape or type.
        """
        ...


@runtime_checkable
class ThingSegmenter(Segmenter, Protocol):
    """A segmenter that tells more than fruits: the robot, leaves, stems."""

    categories: tuple[str, ...]
    """What it tells apart."""

    def things(self, image: Image, depth_m: NDArray[np.float32] | None = None) -> Instances:
        """The fruits and other things in an image; see `Segmenter`."""
        ...


class GroundTruthSegmenter:
    """A `Segmenter` that returns what the label image of the same view says."""

    def __init__(self, labels: Callable[[], NDArray[np.integer]], categories: Mapping[int, str]) -> None:
        """Takes the renderer's side.

        Args:
            labels: Gives the label image of the present view, a number for each thing. Shape (H, W).
            categories: Kind of each number that is a fruit; other numbers are no fruit.
        """
        self.labels = labels
        self.categories = dict(categories)

    def __call__(self, image: Image, depth_m: NDArray[np.float32] | None = None) -> Instances:
        """The fruits of which a pixel is visible, each with score 1; see `Segmenter`."""
        check_image(image, depth_m)
        labels = self.labels()
        if labels.shape != image.shape[:2]:
            raise InvalidInputError(
                f"labels must have the image's shape {image.shape[:2]}, got {labels.shape}; are they of this view?"
            )
        present = [number for number in np.unique(labels).tolist() if number in self.categories]
        masks = labels[None] == np.array(present, labels.dtype)[:, None, None]
        return Instances.from_masks(masks, categories=tuple(self.categories[n] for n in present))


def make_segmenter(name_or_path: str | Path = DEFAULT_SEGMENTER, **options: Any) -> Segmenter:
    """Opens a segmenter.

    Args:
        name_or_path: A name from `SEGMENTERS`, `package.module:callable`, or a file of weights (`.pt`), which names its
            segmenter.
        **options: Options of this kind of segmenter, for instance `score_threshold`.

    Raises:
        InvalidInputError: There is neither a segmenter nor a file of this name, or the segmenter has no such
            option.
        CheckpointError: The file of weights is missing or damaged.
        MissingPackageError: It needs a package that is not installed.
    """
    name = str(name_or_path)
    if not SEGMENTERS.has(name):
        path = Path(name)
        if not path.suffix and not path.exists():
            raise InvalidInputError.choice("segmenter", name, segmenter_choices())
        from maniskill_tomato.segmentation.weights import read_kind

        options["weights"] = path
        name = read_kind(path)
        if name not in SEGMENTERS.names():
            raise CheckpointError(f"{path} is for a segmenter {name!r}, which this version does not know")
    opener: Callable[..., Segmenter] = SEGMENTERS.load(name)
    try:
        return opener(**options)
    except TypeError as error:
        if "unexpected keyword" not in str(error) and "required" not in str(error):
            raise
        raise InvalidInputError(f"segmenter {name!r}: {str(error).split('() ', 1)[-1]}") from error


def segmenter_choices() -> tuple[str, ...]:
    """What a user may write for a segmenter of image files."""
    names = (name for name in SEGMENTERS.names() if name != "ground_truth")
    return (*names, "FILE.pt", "package.module:callable")


def open_for_files(name: str, score_threshold: float, thorough: bool) -> Segmenter:
    """Opens a segmenter for images in files, where time matters less than on a robot.

    Args:
        name: Name of a segmenter, or a file of weights.
        score_threshold: Least score; ignored by segmenters without scores.
        thorough: Run the light segmenter on more sizes and on mirror images (`THOROUGH`).

    Raises:
        InvalidInputError: There is no such segmenter, or the threshold is out of its range.
        CheckpointError: The weights are missing or damaged.
        MissingPackageError: The segmenter needs a package that is not installed.
    """
    scored = not SEGMENTERS.has(name) or _takes_threshold(SEGMENTERS.load(name))
    options: dict[str, Any] = {"score_threshold": score_threshold} if scored else {}
    if thorough:
        from maniskill_tomato.segmentation.light_segmenter import THOROUGH
        from maniskill_tomato.segmentation.weights import read_kind

        if name == "light" or (Path(name).is_file() and read_kind(Path(name)) == "light"):
            options |= THOROUGH
    return make_segmenter(name, **options)


def _takes_threshold(opener: Callable[..., Segmenter]) -> bool:
    parameters = inspect.signature(opener).parameters.values()
    return any(p.name == "score_threshold" or p.kind is p.VAR_KEYWORD for p in parameters)
