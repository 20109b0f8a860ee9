"""The light segmenter that ships: one small network, boxes, masks, ripeness and whole boxes in one pass on a CPU."""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

import cv2
import numpy as np
import onnxruntime
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from maniskill_tomato.assets import asset_path
from maniskill_tomato.errors import CheckpointError, InvalidInputError, MissingPackageError
from maniskill_tomato.network_weights import fill_network
from maniskill_tomato.segmentation.detector_configs import FruitNetworkConfig
from maniskill_tomato.segmentation.fruit_network import (
    SIZE_MULTIPLE,
    STRIDE,
    FruitMaps,
    FruitNetwork,
    place_centres,
)
from maniskill_tomato.segmentation.instances import (
    FRUIT_CATEGORIES,
    TOMATO,
    Image,
    Instances,
    box_ellipse,
    check_image,
)
from maniskill_tomato.segmentation.weights import load_weights

_Number = TypeVar("_Number", bound=np.generic)

SHIPPED_WEIGHTS = "perception/light_segmenter.pt"

MOST_FRUITS = 300
"""Most fruits that are returned for one image; the best ones are kept."""

PADDING_COLOUR = 110.0

THOROUGH: dict[str, Any] = {"scales": (1.5, 0.75, 0.4), "mirrored": True}
"""Options that find more of the small fruits, in 4.5 times the time."""

COARSE_SIDES = (32.0, 192.0)
"""Bounds on a fruit's sides where one image is searched at several sizes, in [px] of the network's input.

Fruits with a side longer than the second bound are taken from the next smaller size instead. At that size fruits with a
side shorter than the first bound are left out."""


VOTE_SPREAD = 0.1
"""Standard deviation of the weights of the places that vote for a box, in sizes of the box.

Chosen on the photos that the shipped weights were trained on: 0.05 to 0.2 all raise AP50-95."""


class FruitSession:
    """A trained `FruitNetwork` in ONNX Runtime, for looking at one image at a time.

    On one core it is 1.8 times as quick as in PyTorch, where convolutions of single channels are slow.
    """

    def __init__(self, network: FruitNetwork) -> None:
        """Translates the network as it is now; it uses as many threads as PyTorch does.

        Args:
            network: It is set to evaluation mode.
        """
        network = network.eval().requires_grad_(False)
        example = torch.zeros(1, 3, 2 * SIZE_MULTIPLE, 2 * SIZE_MULTIPLE)
        with warnings.catch_warnings(), TemporaryDirectory() as folder:
            path = Path(folder) / "fruit.onnx"
            # The exporter by tracing is called old; the new one would need two more packages.
            warnings.simplefilter("ignore")
            torch.onnx.export(
                network,
                (example,),
                path,
                dynamo=False,
                input_names=["image"],
                output_names=list(FruitMaps._fields),
                dynamic_axes={"image": {2: "height", 3: "width"}},
            )
            translated = path.read_bytes()
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = torch.get_num_threads()
        options.log_severity_level = 3
        self._session = onnxruntime.InferenceSession(translated, options, providers=["CPUExecutionProvider"])

    def __call__(self, image: Tensor) -> FruitMaps:
        """The maps for one image of colours from 0 to 255. Shape (1, 3, H, W), multiples of `SIZE_MULTIPLE`."""
        outputs = self._session.run(None, {"image": image.contiguous().numpy()})
        return FruitMaps(*(torch.from_numpy(output) for output in outputs))


class LightSegmenter:
    """A `Segmenter` over `FruitNetwork`; colours only, depth is not used."""

    def __init__(
        self,
        network: FruitNetwork,
        boxes_only: bool = False,
        score_threshold: float = 0.3,
        overlap_threshold: float = 0.55,
        longest_side: int = 640,
        scales: tuple[float, ...] = (1.0, 0.5),
        mirrored: bool = False,
    ) -> None:
        """Takes a trained network.

        Args:
            network: Its present weights are used; it is set to evaluation mode.
            boxes_only: The network was trained on boxes alone. Then masks are the ellipses in the boxes, all
                fruits have the category `tomato`, and there are no whole boxes.
            score_threshold: Fruits below this are left out.
            overlap_threshold: Of two centres that say boxes with a larger intersection over union only the better
                one stays. The boxes that are returned are votes of several places and may overlap a little more.
            longest_side: Larger images are made smaller first, in [px].
            scales: Factors on the image's size, falling; the network runs once for each. It was trained on fruits of
                limited size, so a fruit close to the camera is found in a smaller image.
            mirrored: Run on the mirror images too and average the outputs, in twice the time.

        Raises:
            InvalidInputError: A threshold is not between 0 and 1, or the side is too short.
        """
        for name, value in (("score_threshold", score_threshold), ("overlap_threshold", overlap_threshold)):
            if not 0 <= value <= 1:
                raise InvalidInputError(f"{name} must be between 0 and 1, got {value}")
        if longest_side < SIZE_MULTIPLE:
            raise InvalidInputError(f"longest_side must be at least {SIZE_MULTIPLE} px, got {longest_side}")
        if not scales or min(scales) <= 0 or list(scales) != sorted(scales, reverse=True):
            raise InvalidInputError(f"scales must be positive and fall, got {scales}")
        self.network = network
        self._session = FruitSession(network)
        self.boxes_only = boxes_only
        self.score_threshold = score_threshold
        self.overlap_threshold = overlap_threshold
        self.longest_side = longest_side
        self.scales = scales
        self.mirrored = mirrored

    def __call__(self, image: Image, depth_m: NDArray[np.float32] | None = None) -> Instances:
        """The fruits in an image; see `Segmenter`."""
        check_image(image, depth_m)
        height, width = image.shape[:2]
        largest = min(1.0, self.longest_side / max(height, width))
        x = torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1)[None].float()
        passes, kept = [], []
        with torch.inference_mode():
            for number, scale in enumerate(self.scales):
                found = self._found_at(x, largest * scale)
                sides = (found.boxes[:, 2:] - found.boxes[:, :2]) * largest * scale
                chosen = np.ones(len(sides), bool)
                if number > 0:
                    chosen &= sides.min(axis=1, initial=np.inf) >= COARSE_SIDES[0]
                if number + 1 < len(self.scales):
                    chosen &= sides.max(axis=1, initial=0) <= COARSE_SIDES[1]
                passes.append(found)
                kept.append(np.flatnonzero(chosen))
        # Which fruits are the same, and their masks, keep to the boxes at the peaks: fruits that touch stay two.
        of_pass = np.repeat(np.arange(len(passes)), [len(indices) for indices in kept])
        index = np.concatenate(kept)
        scores = _picked([part.scores for part in passes], kept)
        order = np.argsort(-scores, kind="stable")
        boxes = _picked([part.boxes for part in passes], kept)
        best = best_apart(
            torch.from_numpy(boxes[order]), torch.from_numpy(scores[order]), self.overlap_threshold
        )
        order = order[best.numpy()]
        masks = np.empty((len(order), height, width), np.bool_)
        for number, part in enumerate(passes):
            mine = of_pass[order] == number
            masks[mine] = part.masks(index[order][mine])
        kinds = _picked([part.kinds for part in passes], kept)[order].tolist()
        return Instances(
            boxes=_picked([part.voted for part in passes], kept)[order],
            scores=scores[order],
            categories=tuple(TOMATO if self.boxes_only else FRUIT_CATEGORIES[kind] for kind in kinds),
            masks=masks,
            amodal_boxes=None if self.boxes_only else _picked([part.whole for part in passes], kept)[order],
        )

    def _found_at(self, x: Tensor, factor: float) -> "_Pass":
        """The fruits in an image (1, 3, H, W) that is scaled by a factor."""
        height, width = x.shape[2:]
        size = max(round(height * factor), 1), max(round(width * factor), 1)
        if size != (height, width):
            x = functional.interpolate(x, size, mode="bilinear", antialias=True, align_corners=False)
        padding = [-size[1] % SIZE_MULTIPLE, -size[0] % SIZE_MULTIPLE]
        x = functional.pad(x, (0, padding[0], 0, padding[1]), value=PADDING_COLOUR)
        maps = self._session(x)
        if self.mirrored:
            maps = mean_of(maps, mirror(self._session(x.flip(3))))
        found = find_fruits(maps, self.score_threshold, self.overlap_threshold)
        scale = torch.tensor([width / size[1], height / size[0]] * 2)
        limit = torch.tensor([width, height] * 2, dtype=torch.float32)
        boxes, voted = (
            (part * scale).clamp(min=torch.zeros(4), max=limit)
            for part in (found["boxes"], voted_boxes(maps, found["boxes"]))
        )
        kept = ((boxes[:, 2:] - boxes[:, :2]) >= 1).all(1)
        boxes, voted = boxes[kept], voted[kept]

        def masks(chosen: NDArray[np.int64]) -> NDArray[np.bool_]:
            if self.boxes_only:
                return ellipses(voted[torch.from_numpy(chosen)], height, width)
            fruit, votes = full_maps(maps, size, (height, width))
            return split_by_votes(fruit, votes, boxes.numpy(), chosen=chosen)

        return _Pass(
            boxes=boxes.numpy(),
            voted=voted.numpy(),
            whole=enclosing(found["whole"][kept] * scale, voted).numpy(),
            scores=found["scores"][kept].numpy(),
            kinds=found["category"][kept].numpy(),
            masks=masks,
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class _Pass:
    """The fruits that one size of an image shows, in the image's pixels."""

    boxes: NDArray[np.float32]
    """Of the peaks. Shape (N, 4)."""
    voted: NDArray[np.float32]
    """`voted_boxes` of them. Shape (N, 4)."""
    whole: NDArray[np.float32]
    """Of the whole fruits. Shape (N, 4)."""
    scores: NDArray[np.float32]
    """Shape (N,)."""
    kinds: NDArray[np.int64]
    """Indices of `FRUIT_CATEGORIES`. Shape (N,)."""
    masks: Callable[[NDArray[np.int64]], NDArray[np.bool_]]
    """Makes the masks of some of them, by their indices."""


def _picked(parts: Sequence[NDArray[_Number]], indices: Sequence[NDArray[np.int64]]) -> NDArray[_Number]:
    return np.concatenate([part[i] for part, i in zip(parts, indices, strict=True)])


def mirror(maps: FruitMaps) -> FruitMaps:
    """The output for a mirror image, mapped back to the image itself."""
    centre, box, whole, category, fruit, vote = (part.flip(3) for part in maps)
    sides = [2, 1, 0, 3]  # Left and right change places.
    return FruitMaps(
        centre,
        box[:, sides],
        whole[:, sides],
        category,
        fruit,
        vote * torch.tensor([-1.0, 1.0])[:, None, None],
    )


def mean_of(a: FruitMaps, b: FruitMaps) -> FruitMaps:
    """The mean of two outputs for one image."""
    return FruitMaps(*((one + other) / 2 for one, other in zip(a, b, strict=True)))


def full_maps(
    maps: FruitMaps, size: tuple[int, int], full: tuple[int, int]
) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
    """Fruit pixels (H, W) and the centres they vote for (2, H, W), in the image's pixels.

    Args:
        maps: The network's output for the image scaled to `size` and padded.
        size: Height and width without the padding, in [px].
        full: Height and width of the image, in [px].
    """
    x, y = place_centres(maps.vote.shape[2], maps.vote.shape[3])
    votes = torch.stack([x, y]) + maps.vote[0]
    scales = 1.0, full[1] / size[1], full[0] / size[0]
    resized = []
    for channel, scale in zip(torch.cat([maps.fruit[0], votes]).numpy(), scales, strict=True):
        # The same as PyTorch's bilinear interpolation, in a fraction of its time.
        wide = cv2.resize(channel, (channel.shape[1] * STRIDE, channel.shape[0] * STRIDE))
        wide = wide[: size[0], : size[1]]
        resized.append((wide if size == full else cv2.resize(wide, full[::-1])) * np.float32(scale))
    return resized[0] > 0, np.stack(resized[1:])


def open_light(weights: Path | str | None = None, **options: Any) -> LightSegmenter:
    """Opens the shipped weights, or those in a file, with the options of `LightSegmenter`.

    Raises:
        CheckpointError: The file is missing, damaged or of something else.
        InvalidInputError: A threshold is out of its range.
        MissingPackageError: torchvision is not installed.
    """
    if find_spec("torchvision") is None:
        raise MissingPackageError.extra("torchvision", "perception")
    try:
        path = Path(weights) if weights is not None else asset_path(SHIPPED_WEIGHTS)
    except FileNotFoundError as error:
        raise CheckpointError(
            f"the shipped weights are missing: {error}; install the package again"
        ) from error
    data = load_weights(path, "light")
    try:
        sizes = {field.name: data["config"][field.name] for field in fields(FruitNetworkConfig)}
        network = FruitNetwork(FruitNetworkConfig(**sizes))
        fill_network(network, data["state"])
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise CheckpointError(
            f"{path} does not fit this version's network ({str(error).splitlines()[0]})"
        ) from error
    return LightSegmenter(network, bool(data["training"].get("boxes_only", False)), **options)


def find_fruits(maps: FruitMaps, score_threshold: float, overlap_threshold: float) -> dict[str, Tensor]:
    """Fruits at the local maxima of the first image's heat map, best first.

    Returns:
        boxes (N, 4) and whole (N, 4) as left, top, right, bottom in the network's [px], scores (N,), category (N,).
    """
    heat = maps.centre[0, 0].sigmoid()
    # Eight times as quick as PyTorch's pooling.
    peak = torch.from_numpy(cv2.dilate(heat.numpy(), np.ones((3, 3), np.uint8))) == heat
    scores = torch.where(peak, heat, torch.zeros_like(heat)).flatten()
    scores, places = scores.topk(min(MOST_FRUITS, scores.numel()))
    chosen = scores >= max(score_threshold, 1e-6)
    scores, places = scores[chosen], places[chosen]
    x, y = (c.flatten()[places] for c in place_centres(heat.shape[0], heat.shape[1]))

    def corners(distances: Tensor) -> Tensor:
        left, top, right, bottom = distances[0].flatten(1)[:, places]
        return torch.stack([x - left, y - top, x + right, y + bottom], dim=1)

    boxes = corners(maps.box)
    kept = best_apart(boxes, scores, overlap_threshold)
    return {
        "boxes": boxes[kept],
        "whole": corners(maps.whole)[kept],
        "scores": scores[kept],
        "category": maps.category[0].flatten(1)[:, places].argmax(0)[kept],
    }


def best_apart(boxes: Tensor, scores: Tensor, overlap_threshold: float) -> Tensor:
    """Indices of the boxes (N, 4) that no better one overlaps by more than the threshold, best first."""
    from torchvision.ops import nms  # An extra, which `open_light` asks for.

    kept: Tensor = nms(boxes, scores, overlap_threshold)
    return kept


def voted_boxes(maps: FruitMaps, boxes: Tensor) -> Tensor:
    """The mean of the boxes that places around the centres of boxes say; it scatters less than that of one place.

    The places form a grid over the middle half of each box, with Gaussian weights of `VOTE_SPREAD`.

    Args:
        maps: The network's output for one image.
        boxes: Left, top, right, bottom in the network's [px]. Shape (N, 4).

    Returns:
        Boxes of shape (N, 4).
    """
    height, width = maps.box.shape[2:]
    x, y = place_centres(height, width)
    left, top, right, bottom = maps.box[0]
    corners = torch.stack([x - left, y - top, x + right, y + bottom])
    steps = torch.linspace(-0.24, 0.24, 9)
    weights = torch.exp(-(steps**2) / (2 * VOTE_SPREAD**2))
    weights = torch.outer(weights, weights) / weights.sum() ** 2
    offsets = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), dim=2)
    middles, sizes = (boxes[:, :2] + boxes[:, 2:]) / 2, boxes[:, 2:] - boxes[:, :2]
    places = middles[:, None, None] + offsets * sizes[:, None, None]
    # From -1 to 1 over the map, as `grid_sample` counts.
    places = places / torch.tensor([width * STRIDE, height * STRIDE]) * 2 - 1
    said = functional.grid_sample(
        corners[None], places.flatten(1, 2)[None], padding_mode="border", align_corners=False
    )
    return (said[0] * weights.flatten()).sum(dim=2).T


def split_by_votes(
    fruit: NDArray[np.bool_],
    votes: NDArray[np.float32],
    boxes: NDArray[np.float32],
    margin: float = 0.1,
    chosen: NDArray[np.int64] | None = None,
) -> NDArray[np.bool_]:
    """Gives each fruit pixel to the fruit, among those whose box it lies in, whose centre its vote is nearest to.

    Distances count in sizes of the box. A fruit without a pixel gets the ellipse in its box.

    Args:
        fruit: Pixels of any fruit. Shape (H, W).
        votes: Where each says that its fruit is centred, x and y in [px]. Shape (2, H, W).
        boxes: Left, top, right, bottom of each fruit in [px]. Shape (N, 4).
        margin: Share of its size by which a box is widened on each side.
        chosen: Indices of those whose masks are wanted; all if None. Shape (K,).

    Returns:
        Masks of shape (K, H, W).
    """
    height, width = fruit.shape
    nearest = np.full((height, width), np.inf, np.float32)
    owner = np.full((height, width), -1, np.int16)
    windows = []
    for index, (left, top, right, bottom) in enumerate(boxes):
        size_x, size_y = right - left, bottom - top
        rows = slice(max(int(top - margin * size_y), 0), min(int(np.ceil(bottom + margin * size_y)), height))
        columns = slice(
            max(int(left - margin * size_x), 0), min(int(np.ceil(right + margin * size_x)), width)
        )
        to_x = (votes[0, rows, columns] - (left + right) / 2) / size_x
        to_y = (votes[1, rows, columns] - (top + bottom) / 2) / size_y
        distance = to_x**2 + to_y**2
        closer = distance < nearest[rows, columns]
        nearest[rows, columns][closer] = distance[closer]
        owner[rows, columns][closer] = index
        windows.append((rows, columns))
    wanted = np.arange(len(boxes)) if chosen is None else chosen
    masks = np.zeros((len(wanted), height, width), np.bool_)
    for mask, index in zip(masks, wanted.tolist(), strict=True):
        window = windows[index]
        mask[window] = (owner[window] == index) & fruit[window]
        if not mask[window].any():
            mask[...] = box_ellipse(boxes[index], height, width)
    return masks


def ellipses(boxes: Tensor, height: int, width: int) -> NDArray[np.bool_]:
    """The ellipses in boxes. Shape (N, H, W)."""
    return np.array([box_ellipse(box, height, width) for box in boxes.numpy()], bool).reshape(
        -1, height, width
    )


def enclosing(whole: Tensor, visible: Tensor) -> Tensor:
    """Whole boxes, widened where the visible ones reach further. Shape (N, 4)."""
    return torch.cat(
        [torch.minimum(whole[:, :2], visible[:, :2]), torch.maximum(whole[:, 2:], visible[:, 2:])], dim=1
    )
