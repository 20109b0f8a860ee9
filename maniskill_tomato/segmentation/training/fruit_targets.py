"""Targets of the light network for an annotated picture, and the loss of its output.

Heat map, sampling weights and box loss are those of TTFNet (Liu et al., 2020): Gaussians of 0.54 of the box, focal
loss of CornerNet (Law and Deng, 2018), generalised IoU weighted by the logarithm of the box's area.
"""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from maniskill_tomato.segmentation.fruit_network import STRIDE, FruitMaps, place_centres
from maniskill_tomato.segmentation.training.training_pictures import TrainingPicture

GAUSSIAN_SHARE = 0.54
"""Share of the box that three standard deviations to both sides span (TTFNet's alpha and beta)."""

LOSS_WEIGHTS = {"centre": 1.0, "box": 5.0, "whole": 2.0, "category": 0.5, "fruit": 2.0, "vote": 2.0}
"""Weight of each term; the first two are TTFNet's."""

EVEN_SIDE = 32.0
"""Side below which a fruit weighs more in the mask terms, as the root of its box's area in [px].

The weight is this over the side. Without it the many places of large fruits would decide alone."""

MOST_WEIGHT = 4.0
"""Largest such weight."""


@dataclass(frozen=True, kw_only=True)
class FruitTargets:
    """Targets of a batch, at the network's places."""

    heat: Tensor
    """1 at centres, falling off around them. Shape (B, 1, h, w)."""
    heat_weight: Tensor
    """0 where the centre term is left out. Shape (B, 1, h, w)."""
    box: Tensor
    """Left, top, right, bottom of the fruit that a place belongs to, in [px]. Shape (B, 4, h, w)."""
    whole: Tensor
    """The same for the whole fruit. Shape (B, 4, h, w)."""
    box_weight: Tensor
    """Weight of the box terms. Shape (B, 1, h, w)."""
    whole_weight: Tensor
    """Weight of the whole-box term, 0 where it is not known. Shape (B, 1, h, w)."""
    category: Tensor
    """Kind, -1 where it is left out. Shape (B, h, w)."""
    fruit: Tensor
    """Share of fruit pixels. Shape (B, 1, h, w)."""
    fruit_weight: Tensor
    """0 where masks are not known, more than 1 in the boxes of small fruits. Shape (B, 1, h, w)."""
    vote: Tensor
    """Centre of the fruit at each place, x and y in [px]. Shape (B, 2, h, w)."""
    vote_size: Tensor
    """Width and height of its box in [px]. Shape (B, 2, h, w)."""
    vote_weight: Tensor
    """The same weight on fruit, 0 elsewhere. Shape (B, 1, h, w)."""
    inside_place: Tensor
    """Places in the boxes of fruits with masks, except places on other fruits, as indices of the flattened batch.
    Shape (M,)."""
    inside_fruit: Tensor
    """The fruit of the batch that each of these places belongs to. Shape (M,)."""


def make_targets(pictures: list[TrainingPicture]) -> FruitTargets:
    """The targets of pictures of one size."""
    each = [_picture_targets(picture) for picture in pictures]
    targets = {name: torch.from_numpy(np.stack([t[name] for t in each])) for name in each[0]}
    insides = [_inside(picture) for picture in pictures]
    rows, columns = targets["heat"].shape[2:]
    places = [place + number * rows * columns for number, pair in enumerate(insides) for place in pair]
    counts = [len(place) for place in places]
    return FruitTargets(
        **targets,
        inside_place=torch.from_numpy(np.concatenate([*places, np.zeros(0, np.int64)])),
        inside_fruit=torch.from_numpy(np.repeat(np.arange(len(places)), counts)),
    )


def _picture_targets(picture: TrainingPicture) -> dict[str, NDArray[np.float32] | NDArray[np.int64]]:
    """The targets of one picture; see `FruitTargets`."""
    rows, columns = picture.image.shape[0] // STRIDE, picture.image.shape[1] // STRIDE
    heat = np.zeros((rows, columns), np.float32)
    heat_weight = np.ones((rows, columns), np.float32)
    owner = np.full((rows, columns), -1)
    weight = np.zeros((rows, columns), np.float32)
    sizes = picture.boxes[:, 2:] - picture.boxes[:, :2]
    areas = sizes.prod(axis=1)
    # Large ones first, so that places inside several boxes belong to the smallest.
    for index in np.argsort(-areas):
        (left, top), (width, height) = picture.boxes[index, :2] / STRIDE, sizes[index] / STRIDE
        x, y = left + width / 2, top + height / 2
        column, row = min(max(int(x), 0), columns - 1), min(max(int(y), 0), rows - 1)
        if picture.ignored[index]:
            inside = _span(top, top + height, rows), _span(left, left + width, columns)
            heat_weight[inside] = 0
            continue
        sigma_x, sigma_y = (max(s * GAUSSIAN_SHARE / 6, 1e-3) for s in (width, height))
        reach_x, reach_y = int(3 * sigma_x), int(3 * sigma_y)
        area = (
            slice(max(row - reach_y, 0), min(row + reach_y + 1, rows)),
            slice(max(column - reach_x, 0), min(column + reach_x + 1, columns)),
        )
        dy = np.arange(area[0].start, area[0].stop)[:, None] - row
        dx = np.arange(area[1].start, area[1].stop)[None] - column
        gaussian = np.exp(-(dx**2) / (2 * sigma_x**2) - dy**2 / (2 * sigma_y**2)).astype(np.float32)
        heat[area] = np.maximum(heat[area], gaussian)
        owner[area] = index
        weight[area] = gaussian / gaussian.sum() * np.log(max(areas[index], np.e))
        heat_weight[row, column] = 1
    owned = owner >= 0
    index = np.maximum(owner, 0)
    count = len(picture.boxes)
    boxes = picture.boxes if count else np.zeros((1, 4), np.float32)
    whole = np.full_like(boxes, np.nan) if picture.whole_boxes is None or not count else picture.whole_boxes
    known_fruits: NDArray[np.bool_] = np.asarray(np.isfinite(whole).all(axis=1))
    whole_known = owned & known_fruits[index]
    kinds = np.full(max(count, 1), -1) if picture.categories is None or not count else picture.categories
    return {
        "heat": heat[None],
        "heat_weight": heat_weight[None],
        "box": boxes[index].transpose(2, 0, 1).astype(np.float32),
        "whole": np.nan_to_num(whole)[index].transpose(2, 0, 1).astype(np.float32),
        "box_weight": (weight * owned)[None].astype(np.float32),
        "whole_weight": (weight * whole_known)[None].astype(np.float32),
        "category": np.where(owned, kinds[index], -1).astype(np.int64),
        **_mask_targets(picture, rows, columns),
    }


def _mask_targets(picture: TrainingPicture, rows: int, columns: int) -> dict[str, NDArray[np.float32]]:
    """The targets of the mask terms of one picture; see `FruitTargets`."""
    if picture.labels is None:
        one, two = np.zeros((1, rows, columns), np.float32), np.zeros((2, rows, columns), np.float32)
        return {"fruit": one, "fruit_weight": one, "vote": two, "vote_size": two + 1, "vote_weight": one}
    labels = picture.labels[: rows * STRIDE, : columns * STRIDE]
    cells = labels.reshape(rows, STRIDE, columns, STRIDE).transpose(0, 2, 1, 3).reshape(rows, columns, -1)
    fruit = np.asarray((cells > 0).mean(axis=2), np.float32)
    known = np.asarray((cells >= 0).all(axis=2), np.float32)
    # The fruit in the middle of a cell stands for the cell.
    middle = cells[:, :, STRIDE * STRIDE // 2 + STRIDE // 2]
    on_fruit = middle > 0
    boxes = picture.boxes if len(picture.boxes) else np.zeros((1, 4), np.float32)
    centres, sizes = (boxes[:, :2] + boxes[:, 2:]) / 2, np.maximum(boxes[:, 2:] - boxes[:, :2], 1)
    weights = np.clip(EVEN_SIDE / np.sqrt(sizes.prod(axis=1)), 1, MOST_WEIGHT)
    weight = np.ones((rows, columns), np.float32)
    for index in np.argsort(weights):
        (left, top), (right, bottom) = boxes[index, :2] / STRIDE, boxes[index, 2:] / STRIDE
        weight[_span(top - 1, bottom + 1, rows), _span(left - 1, right + 1, columns)] = weights[index]
    owner = np.maximum(middle - 1, 0)
    return {
        "fruit": fruit[None],
        "fruit_weight": (weight * known)[None],
        "vote": centres[owner].transpose(2, 0, 1).astype(np.float32),
        "vote_size": sizes[owner].transpose(2, 0, 1).astype(np.float32),
        "vote_weight": (weights[owner] * on_fruit * known)[None].astype(np.float32),
    }


def _inside(picture: TrainingPicture) -> list[NDArray[np.int64]]:
    """For each fruit that is not ignored and has a mask: the places in its box, except places on other fruits."""
    if picture.labels is None:
        return []
    rows, columns = picture.image.shape[0] // STRIDE, picture.image.shape[1] // STRIDE
    middle = picture.labels[STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE][:rows, :columns]
    insides = []
    for index in np.flatnonzero(~picture.ignored).tolist():
        left, top, right, bottom = picture.boxes[index] / STRIDE
        area = _span(top - 1, bottom + 1, rows), _span(left - 1, right + 1, columns)
        own = middle[area] == index + 1
        if own.any():
            y, x = np.nonzero(own | (middle[area] == 0))
            insides.append((y + area[0].start) * columns + x + area[1].start)
    return insides


def _span(start: float, stop: float, size: int) -> slice:
    """The places between two coordinates, at least one."""
    first = min(max(int(start), 0), size - 1)
    return slice(first, min(max(int(np.ceil(stop)), first + 1), size))


def fruit_losses(maps: FruitMaps, targets: FruitTargets) -> dict[str, Tensor]:
    """The loss terms of a batch, unweighted; see `LOSS_WEIGHTS`.

    Returns:
        Each term and a scalar.
    """
    height, width = maps.centre.shape[2:]
    x, y = place_centres(height, width, maps.centre.device)
    return {
        "centre": _focal(maps.centre, targets.heat, targets.heat_weight),
        "box": _box_term(_to_corners(maps.box, x, y), targets.box, targets.box_weight),
        "whole": _box_term(_to_corners(maps.whole, x, y), targets.whole, targets.whole_weight),
        "category": _category_term(maps.category, targets.category),
        "fruit": _fruit_term(maps.fruit, targets),
        "vote": _vote_term(maps.vote, targets, x, y),
    }


def _to_corners(distances: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Left, top, right, bottom in [px] from distances to them. Shape (B, 4, h, w)."""
    left, top, right, bottom = distances.unbind(1)
    return torch.stack([x - left, y - top, x + right, y + bottom], dim=1)


def _focal(logits: Tensor, heat: Tensor, weight: Tensor) -> Tensor:
    """Focal loss of CornerNet, the mean over the fruits."""
    centre = (heat == 1).float()
    probability = logits.sigmoid().clamp(1e-4, 1 - 1e-4)
    found = centre * (1 - probability) ** 2 * functional.logsigmoid(logits)
    missing = (1 - centre) * (1 - heat) ** 4 * probability**2 * functional.logsigmoid(-logits)
    return -((found + missing) * weight).sum() / (centre * weight).sum().clamp(min=1)


def _box_term(box: Tensor, target: Tensor, weight: Tensor) -> Tensor:
    """One minus the generalised IoU, weighted."""
    weight = weight[:, 0]
    chosen = weight > 0
    if not chosen.any():
        return box.sum() * 0
    a, b, w = box.movedim(1, -1)[chosen], target.movedim(1, -1)[chosen], weight[chosen]
    lower, upper = torch.maximum(a[:, :2], b[:, :2]), torch.minimum(a[:, 2:], b[:, 2:])
    overlap = (upper - lower).clamp(min=0).prod(1)
    size_a, size_b = ((c[:, 2:] - c[:, :2]).clamp(min=0).prod(1) for c in (a, b))
    union = (size_a + size_b - overlap).clamp(min=1e-3)
    hull = torch.maximum(a[:, 2:], b[:, 2:]) - torch.minimum(a[:, :2], b[:, :2])
    hull_area = hull.clamp(min=1e-3).prod(1)
    giou = overlap / union - (hull_area - union) / hull_area
    return ((1 - giou) * w).sum() / w.sum()


def _category_term(logits: Tensor, category: Tensor) -> Tensor:
    """Cross entropy where the kind is known."""
    chosen = category >= 0
    if not chosen.any():
        return logits.sum() * 0
    return functional.cross_entropy(logits.movedim(1, -1)[chosen], category[chosen])


def _fruit_term(logits: Tensor, targets: FruitTargets) -> Tensor:
    """Binary cross entropy over the pictures with masks, plus one minus the Dice coefficient, the mean of all fruits.

    Each fruit has one Dice coefficient, so a sliver counts as much as a whole fruit.
    """
    weight = targets.fruit_weight
    if weight.sum() == 0:
        return logits.sum() * 0
    entropy = (
        functional.binary_cross_entropy_with_logits(logits, targets.fruit, weight, reduction="sum")
        / weight.sum()
    )
    if not len(targets.inside_place):
        return entropy
    place, fruit = targets.inside_place, targets.inside_fruit
    probability, share = logits.sigmoid().flatten()[place], targets.fruit.flatten()[place]
    empty = torch.zeros(int(fruit[-1]) + 1, device=logits.device)
    shared = empty.index_add(0, fruit, probability * share)
    sizes = empty.index_add(0, fruit, probability + share)
    dice = (2 * shared + 1) / (sizes + 1)
    return entropy + 1 - dice.mean()


def _vote_term(vote: Tensor, targets: FruitTargets, x: Tensor, y: Tensor) -> Tensor:
    """Mean distance of the votes to the centres along x and y, in quarters of the box, smooth near 0."""
    weight = targets.vote_weight
    if weight.sum() == 0:
        return vote.sum() * 0
    error = (torch.stack([x, y]) + vote - targets.vote) / (targets.vote_size / 4)
    smooth = functional.smooth_l1_loss(error, torch.zeros_like(error), reduction="none")
    return (smooth * weight).sum() / weight.sum() / 2
