"""An amodal model without learning: each tomato is a sphere, found from its outline and its depth.

Where the picture's vertical is known, it is one that gravity has flattened, whose outline is round in a picture that is
stretched along the vertical.

The edge of a visible mask is the tomato's own outline where the image gets deeper beyond it, and an occluder's where it
gets nearer. A circle (the sphere's silhouette) must pass through the former, hold all pixels of the mask, leave out
background that is seen beside the tomato, and bulge towards the camera as the depth does; a prior on the radius in
metres decides what remains open. T counts the mask and those pixels of the circle that something nearer hides or that
lie outside the image, so that a tomato that is not quite round but wholly visible gets V_f = 1.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot.d435 import CameraIntrinsics
from maniskill_tomato.segmentation.masks import BinaryMask
from maniskill_tomato.sensing.visible_fraction.crop import FLATNESS, WholeFruit
from maniskill_tomato.sensing.visible_fraction.estimate import (
    Estimate,
    Float64,
    SegmentedImage,
    filled_depth,
    fruit_depth,
    surrounding_depth,
)

Floats = NDArray[np.floating[Any]]

NEAREST_MEASURED: Final = 0.15
"""A fruit at least as far away as this, in [m], has depth unless something nearer shadows it."""

SMALLEST_OUTLINE: Final = 10.0
"""Half the width and height, in [px], from which an outline tells a fruit's size and shape."""

LEAST_FLATNESS: Final = 0.6
LARGEST_FLATNESS: Final = 1.8
"""Heights over widths beyond which a mask is no whole fruit's."""

SAMPLES: Final = 64
"""Points of each kind that a circle is judged by."""

ROUNDS: Final = 4
"""Rounds of the cross-entropy search for the best circle (Rubinstein 1999)."""

CANDIDATES: Final = 64
"""Circles compared in each round."""


@dataclass(frozen=True, kw_only=True)
class SphereConfig:
    """What is known of tomatoes beforehand, and how much each kind of evidence weighs."""

    radius_m: float = 0.026
    """Median radius of tomatoes before an image is seen, in [m]."""
    radius_spread: float = 0.4
    """Standard deviation of the logarithm of the radius, over all crops."""
    crop_spread: float = 0.15
    """The same within one crop: tomatoes with a clear outline say how large the others in their image are."""
    clear_share: float = 0.6
    """Share of the outline that must be seen for that."""
    edge_step_m: float = 0.012
    """By how much the image must get deeper beyond the mask's edge for it to be the tomato's own outline, in [m]."""
    edge_error: float = 0.03
    """Standard deviation of the outline about a circle, in radii: tomatoes are not quite round."""
    inside_error: float = 0.03
    """The same for pixels of the mask outside the circle, and for background inside."""
    depth_error_m: float = 0.003
    """Standard deviation of the depth about the sphere, in [m]."""

    def __post_init__(self) -> None:
        for name in (
            "radius_m",
            "radius_spread",
            "edge_step_m",
            "edge_error",
            "inside_error",
            "depth_error_m",
        ):
            if not getattr(self, name) > 0:
                raise InvalidInputError(f"{name} must be positive, got {getattr(self, name)}")


OPEN_SHARE: Final = 0.8
"""Share of a mask's edge beyond which the image gets deeper, from which the whole outline counts as seen; the calyx
takes the rest."""

FILLED_SHARE: Final = 0.95
"""Least area of a whole fruit's mask over that of the ellipse with its moments; two fruits in one mask fill it less."""

STEEPEST: Final = 0.7
"""Height over width is not told from farther above or below than this: the cosine of the angle to the vertical."""


def round_outline(up: Float64 | None, ray: Float64, flatness: float = FLATNESS) -> Float64:
    """What makes the outline of a hanging, flat tomato round: a stretch of the picture along the vertical.

    Args:
        up: Unit vector upwards in the optical frame; None if it is not known. Shape (3,).
        ray: Towards the tomato, optical frame. Shape (3,).
        flatness: Its height over its width.

    Returns:
        Shape (2, 2).
    """
    if up is None:
        return np.eye(2)
    away = ray / np.linalg.norm(ray)
    along = float(up @ away)
    across = up[:2] - along * away[:2]
    # Seen along its axis it is round.
    direction = across / max(float(np.linalg.norm(across)), 1e-9)
    height = float(np.sqrt(flatness**2 * (1.0 - along**2) + along**2))
    return np.asarray(np.eye(2) + (1.0 / height - 1.0) * np.outer(direction, direction))


def silhouette_pixels(centre: Float64, radius: float, intrinsics: CameraIntrinsics, up: Float64) -> float:
    """Pixels of the outline of a hanging tomato, in the picture or outside.

    Args:
        centre: In the optical frame, in [m]. Shape (3,).
        radius: Of its width, in [m].
        intrinsics: The camera's.
        up: Unit vector upwards in the optical frame. Shape (3,).

    Returns:
        Infinity for one that reaches behind the camera.
    """
    if centre[2] <= radius:
        return float("inf")
    tangent = radius**2 / (centre[2] ** 2 - radius**2)
    height = 1.0 / float(np.linalg.det(round_outline(up, centre)))
    return float(np.pi * intrinsics.fx * intrinsics.fy * tangent * height)


@dataclass(frozen=True, kw_only=True)
class _Evidence:
    edge: Floats
    mask: Floats
    background: Floats
    mask_depth: Floats

    def single(self) -> "_Evidence":
        """The same in 32 bits."""
        return _Evidence(**{k: v.astype(np.float32) for k, v in vars(self).items()})

    def stretched(self, stretch: Float64) -> "_Evidence":
        """The same in a stretched picture. Shape (2, 2)."""
        return _Evidence(
            **{k: np.concatenate([v[:, :2] @ stretch, v[:, 2:]], 1) for k, v in vars(self).items()}
        )


class SphereModel:
    """Fits a sphere to every mask."""

    def __init__(self, config: SphereConfig | None = None) -> None:
        """Keeps the prior."""
        self.config = config or SphereConfig()

    def __call__(self, view: SegmentedImage) -> list[Estimate]:
        """Estimates V and T of every mask; an empty one has failed. Without depth the outline alone decides."""
        depth = filled_depth(view.depth_m) if view.filled_m is None else view.filled_m
        config, crop = self.config, view.crop
        if crop is not None:
            config = replace(config, radius_m=crop.radius_m, radius_spread=crop.radius_spread)
        flatness = FLATNESS if crop is None else crop.flatness
        fits = [_Fit.prepare(view, depth, mask, config, flatness) for mask in view.masks]
        for fit in fits:
            if fit is not None:
                fit.search(config)
        clear = [f for f in fits if f is not None and f.measured and f.outline_share() >= config.clear_share]
        if clear:
            own = float(np.median([f.radius_m for f in clear]))
            alike = replace(config, radius_m=own, radius_spread=config.crop_spread)
            for fit in fits:
                if fit is not None and fit.measured and not any(fit is f for f in clear):
                    fit.search(alike)
        shown = depth
        if len(fits) > 1:
            # Of two tomatoes that touch, the nearer one as a whole hides the other.
            shown = depth.copy()
            for fit in fits:
                if fit is not None and fit.measured:
                    shown[fit.mask] = fit.own
        fruits = np.zeros(depth.shape, dtype=bool)
        for mask in view.masks:
            fruits |= mask
        return [
            Estimate.failed() if fit is None else fit.estimate(view, shown, config, fruits) for fit in fits
        ]


class _Fit:
    """The circle of one mask."""

    def __init__(
        self,
        mask: BinaryMask,
        evidence: _Evidence,
        corner: tuple[int, int],
        own: float,
        measured: bool,
        focal: float,
        stretch: Float64,
        whole: WholeFruit | None,
    ) -> None:
        self.mask, self.evidence, self.corner, self.whole = mask, evidence, corner, whole
        self.own, self.measured, self.focal, self.stretch = own, measured, focal, stretch
        self.circle = np.zeros(3)

    @classmethod
    def prepare(
        cls, view: SegmentedImage, depth: Float64, mask: BinaryMask, config: SphereConfig, flatness: float
    ) -> "_Fit | None":
        """Collects the evidence in a window; None for an empty mask."""
        first_x, first_y, width, height = cv2.boundingRect(mask.view(np.uint8))
        if not width:
            return None
        focal = view.intrinsics.fx
        box = (slice(first_y, first_y + height), slice(first_x, first_x + width))
        own = fruit_depth(view.depth_m[box], mask[box])
        own_depth = measured = bool(np.isfinite(own))
        if not measured:
            # Nearer than the camera measures, where the mask's own extent stands for the size; or in a stereo shadow.
            own = config.radius_m * focal / (0.5 * (max(width, height) + 1))
            around = surrounding_depth(view.depth_m, mask)
            if own > NEAREST_MEASURED and np.isfinite(around):
                own, measured = around, True
        size = config.radius_m * focal / own
        reach = int(np.ceil(1.4 * size)) + 4
        top, left = max(first_y - reach, 0), max(first_x - reach, 0)
        window = (slice(top, first_y + height + reach), slice(left, first_x + width + reach))
        z = depth[window] if measured else np.zeros_like(depth[window])
        evidence, open_share = _collect(mask[window], z, view.depth_m[window], own, size, config.edge_step_m)
        i = view.intrinsics
        middle = (first_x + 0.5 * width, first_y + 0.5 * height)
        ray = np.array([(middle[0] - i.cx) / i.fx, (middle[1] - i.cy) / i.fy, 1.0])
        stretch = round_outline(view.up_optical, ray, flatness)
        inside = first_x > 0 and first_y > 0 and first_x + width < i.width and first_y + height < i.height
        whole = None
        if own_depth and inside and open_share >= OPEN_SHARE and view.up_optical is not None:
            whole = _whole_fruit(mask[box], view.up_optical, ray, own, focal)
        return cls(mask, evidence.stretched(stretch), (left, top), own, measured, focal, stretch, whole)

    @property
    def radius_m(self) -> float:
        """Of the circle at the depth of the visible surface, as the prior counts it, in [m]."""
        return float(self.circle[2]) * self.own / self.focal

    def outline_share(self) -> float:
        """The share of the circle, by angle, near which the tomato's own outline is seen."""
        edge = self.evidence.edge
        if not len(edge):
            return 0.0
        away = edge - self.circle[:2]
        near = np.abs(np.hypot(away[:, 0], away[:, 1]) / self.circle[2] - 1) < 0.08
        angles = np.arctan2(away[near, 1], away[near, 0])
        return len(np.unique(np.floor(angles / (2 * np.pi) * 24))) / 24

    def search(self, config: SphereConfig) -> None:
        """Finds the best circle."""
        self.circle = _fit(self.evidence, self.own, self.focal, config)

    def estimate(
        self, view: SegmentedImage, shown: Float64, config: SphereConfig, fruits: BinaryMask
    ) -> Estimate:
        """V and T under the circle.

        Args:
            view: The image.
            shown: Its depth, that of whole tomatoes in their masks. Shape (height, width).
            config: What is known beforehand.
            fruits: The pixels of all tomatoes. Shape (height, width).
        """
        mask, i = self.mask, view.intrinsics
        place = np.linalg.solve(self.stretch, self.circle[:2]) + self.corner
        x, y, radius = float(place[0]), float(place[1]), float(self.circle[2])
        own = self.own + config.edge_step_m if self.measured else np.inf
        whole, outside = whole_silhouette(mask, (x, y, radius), shown, own, self.own, fruits, self.stretch)
        centre, radius_m = None, float("nan")
        if self.measured:
            z = _centre_depth(self.evidence.mask_depth, self.circle, self.own, self.focal)
            centre = ((x - i.cx) / i.fx * z, (y - i.cy) / i.fy * z, z)
            tangent = float(radius) / self.focal
            radius_m = z * tangent / float(np.hypot(1.0, tangent))
        return Estimate(
            visible=int(np.count_nonzero(mask)),
            total=int(np.count_nonzero(whole)) + outside,
            whole=whole,
            centre_optical=centre,
            radius_m=radius_m,
            seen_whole=self.whole,
        )


def whole_silhouette(
    mask: BinaryMask,
    circle: tuple[float, float, float],
    depth: Float64,
    farthest: float,
    farthest_fruit: float,
    fruits: BinaryMask,
    stretch: Float64 | None = None,
) -> tuple[BinaryMask, int]:
    """The mask of a tomato and the pixels of its outline that something hides.

    Args:
        mask: Its visible pixels. Shape (height, width).
        circle: Its outline: x, y, radius, in [px].
        depth: Of the image, in [m], 0 where it is not known, which counts as nearer: whole rows without depth show what
            is too near to be measured. Shape (height, width).
        farthest: What is nearer than this hides it, in [m]; infinity if the depth tells nothing.
        farthest_fruit: The same for other tomatoes, in [m].
        fruits: The pixels of all tomatoes. Shape (height, width).
        stretch: Of the picture, under which the outline is that circle about its middle (`round_outline`); none if
            None. Shape (2, 2).

    Returns:
        Its silhouette inside the image, of shape (height, width), and how many pixels of it lie outside.
    """
    x, y, radius = circle
    low_x, low_y = int(np.floor(x - radius)) - 1, int(np.floor(y - radius)) - 1
    side = int(np.ceil(2 * radius)) + 3
    s = np.eye(2) if stretch is None else stretch
    u = low_x + np.arange(side) + 0.5 - x
    v = (low_y + np.arange(side) + 0.5 - y)[:, None]
    disc = (u * s[0, 0] + v * s[1, 0]) ** 2 + (u * s[0, 1] + v * s[1, 1]) ** 2 < radius**2
    height, width = mask.shape
    rows = slice(max(low_y, 0), max(min(low_y + side, height), 0))
    columns = slice(max(low_x, 0), max(min(low_x + side, width), 0))
    inside = disc[
        rows.start - low_y : max(rows.stop - low_y, 0), columns.start - low_x : max(columns.stop - low_x, 0)
    ]
    outside = int(np.count_nonzero(disc)) - int(np.count_nonzero(inside))
    if np.isfinite(farthest):
        limit = np.where(fruits[rows, columns], farthest_fruit, farthest)
        inside = inside & (depth[rows, columns] <= limit)
    whole = mask.copy()
    whole[rows, columns] |= inside
    return whole, outside


def _collect(
    here: BinaryMask, z: Float64, measured: Float64, own: float, size: float, step: float
) -> tuple[_Evidence, float]:
    """Samples of the four kinds of evidence, as x, y in the window, in [px], and the share of the edge that is open.

    Args:
        here: The mask in the window.
        z: Depth without holes there, in [m].
        measured: Depth with holes, in [m].
        own: The tomato's depth, in [m].
        size: Its radius, in [px], about.
        step: By how much the image gets deeper at an outline, in [m].
    """
    image = here.view(np.uint8)
    inner_edge = here & (cv2.erode(image, np.ones((3, 3), np.uint8), borderValue=1) == 0)
    # Masks and depth disagree by a pixel or two at edges, so that the depth is asked a little further out.
    beyond = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 2.0)
    height, width = here.shape
    rim = _pixels(inner_edge)
    ex, ey = rim.T
    down, up, right, left = (
        np.minimum(ey + 1, height - 1),
        np.maximum(ey - 1, 0),
        np.minimum(ex + 1, width - 1),
        np.maximum(ex - 1, 0),
    )
    gx = (beyond[ey, right] - beyond[ey, left]) / np.maximum(right - left, 1)
    gy = (beyond[down, ex] - beyond[up, ex]) / np.maximum(down - up, 1)
    length = np.hypot(gx, gy) + 1e-9
    gx, gy = gx / length, gy / length
    deeper = np.ones(len(ex), dtype=bool)
    probe = float(np.clip(0.12 * size, 1.5, 3.0))
    for distance in (probe, 1.7 * probe):
        ox = np.round(ex - distance * gx).astype(int)
        oy = np.round(ey - distance * gy).astype(int)
        in_window = (ox >= 0) & (oy >= 0) & (ox < width) & (oy < height)
        out = z[np.clip(oy, 0, height - 1), np.clip(ox, 0, width - 1)]
        deeper &= in_window & ((out > own + step) | (out == 0))
    patch = np.ones((5, 5), np.uint8)
    behind = (z > own + 2 * step) & (cv2.dilate(image, patch) == 0)
    core = (cv2.erode(image, patch) > 0) & (measured > 0)
    inner = _thinned(_pixels(core))
    evidence = _Evidence(
        edge=_thinned(rim[deeper]) + 0.5,
        mask=_thinned(rim if len(rim) else _pixels(here)) + 0.5,
        background=_thinned(_pixels(behind), 2 * SAMPLES) + 0.5,
        mask_depth=np.concatenate([inner + 0.5, measured[inner[:, 1], inner[:, 0]][:, None]], 1),
    )
    return evidence, float(deeper.mean()) if len(deeper) else 0.0


def _whole_fruit(mask: BinaryMask, up: Float64, ray: Float64, own: float, focal: float) -> WholeFruit | None:
    """Size and shape by the moments of a mask whose whole outline is the fruit's; None where they do not tell.

    Args:
        mask: Its pixels, in the smallest box that holds them.
        up: Unit vector upwards in the optical frame. Shape (3,).
        ray: Towards the fruit, optical frame. Shape (3,).
        own: Depth of its visible surface, in [m].
        focal: In [px].
    """
    away = ray / np.linalg.norm(ray)
    along = float(up @ away)
    if abs(along) > STEEPEST:
        return None
    direction = up[:2] - along * away[:2]
    direction = direction / np.linalg.norm(direction)
    rows, columns = np.nonzero(mask)
    upright = float(np.std(columns * direction[0] + rows * direction[1]))
    across = float(np.std(columns * direction[1] - rows * direction[0]))
    if (
        2.0 * min(upright, across) < SMALLEST_OUTLINE
        or len(rows) < FILLED_SHARE * 4.0 * np.pi * upright * across
    ):
        return None
    squared = ((upright / across) ** 2 - along**2) / (1.0 - along**2)
    if not LEAST_FLATNESS**2 < squared < LARGEST_FLATNESS**2:
        return None
    # The middle lies behind the visible surface's median depth by 0.7 of a radius.
    tangent = 2.0 * across / focal
    radius = tangent * (own + 0.7 * tangent * own) / float(np.hypot(1.0, tangent))
    return WholeFruit(radius_m=radius, flatness=float(np.sqrt(squared)))


def _pixels(mask: BinaryMask) -> NDArray[np.int64]:
    """Column and row of each true pixel, row by row. Shape (N, 2)."""
    rows, columns = np.divmod(np.flatnonzero(mask), mask.shape[1])
    return np.stack([columns, rows], 1)


def _fit(evidence: _Evidence, own: float, focal: float, c: SphereConfig) -> Float64:
    """The best circle: x, y, radius in the window, in [px]. Shape (3,)."""
    size = c.radius_m * focal / own
    # Half the precision, half the time: 0.01 px of a window are far below what an outline tells.
    evidence = evidence.single()
    points = evidence.mask
    start = np.array([*points.mean(0), size])
    spread = np.array([0.6 * size, 0.6 * size, 1.5 * c.radius_spread * size])
    extra = _circles(evidence.edge)
    best, best_cost = start, np.inf
    for number, noise in enumerate(_noise()):
        drawn = start + spread * noise
        if number == 0 and len(extra):
            drawn = np.concatenate([drawn, extra])
        drawn[:, 2] = np.clip(drawn[:, 2], 0.3 * size, 2.5 * size)
        cost = _cost(drawn.astype(np.float32), evidence, own, focal, c)
        order = np.argsort(cost)[:12]
        if cost[order[0]] < best_cost:
            best, best_cost = drawn[order[0]], float(cost[order[0]])
        start = drawn[order].mean(0)
        spread = np.maximum(drawn[order].std(0), 0.004 * size)
    return np.asarray(best, np.float64)


def _cost(circles: Floats, evidence: _Evidence, own: float, focal: float, c: SphereConfig) -> Float64:
    """Negative log likelihood of circles. Shape (N,)."""
    radius = circles[:, 2:3]
    inverse = 1.0 / radius

    def away(points: Floats) -> Floats:
        # Several times as quick as np.hypot.
        across, down = points[:, 0] - circles[:, 0:1], points[:, 1] - circles[:, 1:2]
        across *= across
        down *= down
        across += down
        return np.asarray(np.sqrt(across, out=across))

    def mean_square(error: Floats, largest: float) -> Floats:
        """Of each row, halved, no square larger than that."""
        error *= error
        np.minimum(error, 2.0 * largest, out=error)
        return np.asarray(error.sum(1) * np.float32(0.5 / error.shape[1]))

    radius_m = circles[:, 2] * np.float32(own / focal)
    cost = 0.5 * (np.log(radius_m / c.radius_m) / c.radius_spread) ** 2
    if len(evidence.edge):
        error = away(evidence.edge)
        error -= radius
        error *= inverse * np.float32(1.0 / c.edge_error)
        # Points of the outline are not independent: together they weigh as a few dozen.
        cost = cost + 24 * (len(evidence.edge) / SAMPLES) * mean_square(error, 4.5)
    error = away(evidence.mask)
    error -= radius
    np.maximum(error, 0, out=error)
    error *= inverse * np.float32(1.0 / c.inside_error)
    cost = cost + 24 * mean_square(error, 8.0)
    if len(evidence.background):
        error = away(evidence.background)
        np.subtract(radius, error, out=error)
        np.maximum(error, 0, out=error)
        error *= inverse * np.float32(1.0 / c.inside_error)
        cost = cost + 24 * mean_square(error, 8.0)
    if len(evidence.mask_depth) >= 12:
        centre = away(evidence.mask_depth)
        centre *= np.float32(own / focal)
        centre *= centre
        np.subtract(radius_m[:, None] ** 2, centre, out=centre)
        np.maximum(centre, 0, out=centre)
        np.sqrt(centre, out=centre)
        centre += evidence.mask_depth[:, 2]
        centre -= _medians(centre)
        centre *= np.float32(1.0 / c.depth_error_m)
        cost = cost + 12 * mean_square(centre, 4.5)
    return np.asarray(cost)


def _medians(values: Floats) -> Floats:
    """The median of each row; `np.median` takes several times as long. Shape (N, 1)."""
    half = values.shape[1] // 2
    ordered = np.partition(values, half, axis=1)
    upper = ordered[:, half : half + 1]
    return upper if values.shape[1] % 2 else (upper + ordered[:, :half].max(1, keepdims=True)) / 2


def _centre_depth(points: Floats, circle: Float64, own: float, focal: float) -> float:
    """Depth of a sphere's centre from points of its surface: x, y in [px] and depth in [m]. Shape (N, 3)."""
    radius_m = circle[2] * own / focal
    if not len(points):
        return own + 0.7 * float(radius_m)
    across = np.hypot(points[:, 0] - circle[0], points[:, 1] - circle[1]) * own / focal
    return float(np.median(points[:, 2] + np.sqrt(np.maximum(radius_m**2 - across**2, 0))))


def _thinned(points: NDArray[np.int64], count: int = SAMPLES) -> NDArray[np.int64]:
    if len(points) <= count:
        return points
    return np.asarray(points[np.linspace(0, len(points) - 1, count).astype(int)])


@lru_cache(maxsize=1)
def _noise() -> NDArray[np.float64]:
    # Always the same numbers, so that the same image gives the same answer.
    return np.asarray(np.random.default_rng(5).standard_normal((ROUNDS, CANDIDATES, 3)))


def _circles(edge: Floats) -> Floats:
    """Circles through triples of outline points, well apart. Shape (N, 3)."""
    n = len(edge)
    if n < 12:
        return np.zeros((0, 3))
    i = np.random.default_rng(7).integers(0, n, (64, 3))
    a, b, c = edge[i[:, 0]], edge[i[:, 1]], edge[i[:, 2]]
    d = 2 * (a[:, 0] * (b[:, 1] - c[:, 1]) + b[:, 0] * (c[:, 1] - a[:, 1]) + c[:, 0] * (a[:, 1] - b[:, 1]))
    ok = np.abs(d) > 1.0
    a, b, c, d = a[ok], b[ok], c[ok], d[ok]
    a2, b2, c2 = (a**2).sum(1), (b**2).sum(1), (c**2).sum(1)
    x = (a2 * (b[:, 1] - c[:, 1]) + b2 * (c[:, 1] - a[:, 1]) + c2 * (a[:, 1] - b[:, 1])) / d
    y = (a2 * (c[:, 0] - b[:, 0]) + b2 * (a[:, 0] - c[:, 0]) + c2 * (b[:, 0] - a[:, 0])) / d
    return np.stack([x, y, np.hypot(a[:, 0] - x, a[:, 1] - y)], 1)
