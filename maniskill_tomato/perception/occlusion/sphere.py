"""An amodal model without learning: each tomato is a sphere, found from its outline and its depth.

The edge of a visible mask is the tomato's own outline where the image gets deeper beyond it, and an occluder's where it
gets nearer. A circle (the sphere's silhouette) must pass through the former, hold all pixels of the mask, leave out
background that is seen beside the tomato, and bulge towards the camera as the depth does; a prior on the radius in
metres decides what remains open. T counts the mask and those pixels of the circle that something nearer hides or that
lie outside the image, so that a tomato that is not quite round but wholly visible gets V_f = 1.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.perception.masks import BinaryMask
from maniskill_tomato.perception.occlusion.estimate import (
    Estimate,
    Float64,
    TomatoView,
    filled_depth,
    fruit_depth,
)

SAMPLES: Final = 96
"""Points of each kind that a circle is judged by."""

ROUNDS: Final = 4
"""Rounds of the cross-entropy search for the best circle (Rubinstein 1999)."""

DRAWS: Final = 80
"""Circles drawn in each round."""


@dataclass(frozen=True, kw_only=True)
class SphereConfig:
    """What is known of tomatoes beforehand, and how much each kind of evidence weighs."""

    radius_m: float = 0.029
    """Median radius of the crop's tomatoes, in [m]."""
    radius_spread: float = 0.22
    """Standard deviation of the logarithm of the radius."""
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


@dataclass(frozen=True, kw_only=True)
class _Evidence:
    edge: Float64
    mask: Float64
    background: Float64
    mask_depth: Float64


class SphereModel:
    """Fits a sphere to every mask."""

    def __init__(self, config: SphereConfig | None = None) -> None:
        """Keeps the prior."""
        self.config = config or SphereConfig()

    def __call__(self, view: TomatoView) -> list[Estimate]:
        """Estimates V and T of every mask; an empty one has failed. Without depth the outline alone decides."""
        depth = filled_depth(view.depth_m)
        return [self._one(view, depth, mask) for mask in view.masks]

    def _one(self, view: TomatoView, depth: Float64, mask: BinaryMask) -> Estimate:
        rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
        if not len(rows):
            return Estimate.failed()
        focal = view.intrinsics.fx
        own = fruit_depth(view.depth_m, mask)
        measured_here = bool(np.isfinite(own))
        if not measured_here:
            # Nearer than the camera measures; the mask's own extent then stands for the size.
            own = (
                self.config.radius_m * focal / (0.5 * max(rows[-1] - rows[0], columns[-1] - columns[0]) + 1.0)
            )
        size = self.config.radius_m * focal / own
        reach = int(np.ceil(1.2 * size)) + 4
        top, left = max(rows[0] - reach, 0), max(columns[0] - reach, 0)
        window = (slice(top, rows[-1] + reach + 1), slice(left, columns[-1] + reach + 1))
        here, z, measured = mask[window], depth[window], view.depth_m[window]
        evidence = self._collect(here, z if measured_here else np.zeros_like(z), measured, own)
        circle = self._fit(evidence, own, focal)
        x, y, radius = circle[0] + left, circle[1] + top, circle[2]
        low_x, low_y = int(np.floor(x - radius)) - 1, int(np.floor(y - radius)) - 1
        side = int(np.ceil(2 * radius)) + 3
        u, v = np.meshgrid(low_x + np.arange(side) + 0.5, low_y + np.arange(side) + 0.5)
        disc = (u - x) ** 2 + (v - y) ** 2 < radius**2
        height, width = mask.shape
        inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
        outside = int(np.count_nonzero(disc & ~inside))
        whole = np.zeros(mask.shape, dtype=bool)
        chosen = disc & inside
        whole[v[chosen].astype(int), u[chosen].astype(int)] = True
        if measured_here:
            whole &= ~((depth > own + self.config.edge_step_m) | (depth == 0))
        whole |= mask
        centre = None
        if measured_here:
            i = view.intrinsics
            depth_c = _centre_depth(evidence.mask_depth, circle, own, focal)
            centre = ((x - i.cx) / i.fx * depth_c, (y - i.cy) / i.fy * depth_c, depth_c)
        return Estimate(
            visible=int(np.count_nonzero(mask)),
            total=int(np.count_nonzero(whole)) + outside,
            whole=whole,
            centre_optical=centre,
        )

    def _collect(self, here: BinaryMask, z: Float64, measured: Float64, own: float) -> _Evidence:
        """Samples of the four kinds of evidence, as x, y in the window, in [px]."""
        step = self.config.edge_step_m
        image = here.astype(np.uint8)
        ring = np.ones((3, 3), np.uint8)
        inner_edge = (image > 0) & (cv2.erode(image, ring, borderValue=1) == 0)
        # Masks and depth disagree by a pixel or two at edges, so that the depth is asked a little further out.
        beyond = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 2.0)
        gy, gx = np.gradient(beyond)
        ey, ex = np.nonzero(inner_edge)
        length = np.hypot(gx[ey, ex], gy[ey, ex]) + 1e-9
        deeper = np.ones(len(ey), dtype=bool)
        for distance in (3.0, 5.0):
            ox = np.round(ex - distance * gx[ey, ex] / length).astype(int)
            oy = np.round(ey - distance * gy[ey, ex] / length).astype(int)
            in_window = (ox >= 0) & (oy >= 0) & (ox < here.shape[1]) & (oy < here.shape[0])
            out = z[np.clip(oy, 0, here.shape[0] - 1), np.clip(ox, 0, here.shape[1] - 1)]
            deeper &= in_window & ((out > own + step) | (out == 0))
        edge = np.stack([ex + 0.5, ey + 0.5], 1)[deeper]
        grown = cv2.dilate(image, np.ones((5, 5), np.uint8)) > 0
        behind = (z > own + 2 * step) & ~grown
        core = cv2.erode(image, np.ones((5, 5), np.uint8)) > 0
        my, mx = np.nonzero(here)
        cy, cx = np.nonzero(core & (measured > 0))
        by, bx = np.nonzero(behind)
        centres = np.stack([mx + 0.5, my + 0.5], 1).astype(np.float64)
        rim = np.stack([ex + 0.5, ey + 0.5], 1).astype(np.float64)
        return _Evidence(
            edge=_thinned(edge),
            mask=_thinned(rim if len(rim) else centres),
            background=_thinned(np.stack([bx + 0.5, by + 0.5], 1).astype(np.float64), 2 * SAMPLES),
            mask_depth=_thinned(np.stack([cx + 0.5, cy + 0.5, measured[cy, cx]], 1).astype(np.float64)),
        )

    def _fit(self, evidence: _Evidence, own: float, focal: float) -> Float64:
        """The best circle: x, y, radius in the window, in [px]. Shape (3,)."""
        c = self.config
        size = c.radius_m * focal / own
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
            cost = self._cost(drawn, evidence, own, focal)
            order = np.argsort(cost)[:12]
            if cost[order[0]] < best_cost:
                best, best_cost = drawn[order[0]], float(cost[order[0]])
            start = drawn[order].mean(0)
            spread = np.maximum(drawn[order].std(0), 0.004 * size)
        return np.asarray(best)

    def _cost(self, circles: Float64, evidence: _Evidence, own: float, focal: float) -> Float64:
        """Negative log likelihood of circles. Shape (N,)."""
        c = self.config
        radius = circles[:, 2:3]

        def away(points: Float64) -> Float64:
            return np.asarray(np.hypot(points[:, 0] - circles[:, 0:1], points[:, 1] - circles[:, 1:2]))

        radius_m = circles[:, 2] * own / focal
        cost = 0.5 * (np.log(radius_m / c.radius_m) / c.radius_spread) ** 2
        if len(evidence.edge):
            error = (away(evidence.edge) / radius - 1) / c.edge_error
            # Points of the outline are not independent: together they weigh as a few dozen.
            cost = cost + 24 * (len(evidence.edge) / SAMPLES) * np.mean(np.minimum(0.5 * error**2, 4.5), 1)
        error = np.maximum(away(evidence.mask) / radius - 1, 0) / c.inside_error
        cost = cost + 24 * np.mean(np.minimum(0.5 * error**2, 8.0), 1)
        if len(evidence.background):
            error = np.maximum(1 - away(evidence.background) / radius, 0) / c.inside_error
            cost = cost + 24 * np.mean(np.minimum(0.5 * error**2, 8.0), 1)
        if len(evidence.mask_depth) >= 12:
            z = evidence.mask_depth[:, 2]
            across = away(evidence.mask_depth) * own / focal
            bulge = np.sqrt(np.maximum(radius_m[:, None] ** 2 - across**2, 0))
            centre = z + bulge
            error = (centre - np.median(centre, 1, keepdims=True)) / c.depth_error_m
            cost = cost + 12 * np.mean(np.minimum(0.5 * error**2, 4.5), 1)
        return np.asarray(cost)


def _centre_depth(points: Float64, circle: Float64, own: float, focal: float) -> float:
    """Depth of a sphere's centre from points of its surface: x, y in [px] and depth in [m]. Shape (N, 3)."""
    radius_m = circle[2] * own / focal
    if not len(points):
        return own + 0.7 * float(radius_m)
    across = np.hypot(points[:, 0] - circle[0], points[:, 1] - circle[1]) * own / focal
    return float(np.median(points[:, 2] + np.sqrt(np.maximum(radius_m**2 - across**2, 0))))


def _thinned(points: Float64, count: int = SAMPLES) -> Float64:
    if len(points) <= count:
        return points
    return np.asarray(points[np.linspace(0, len(points) - 1, count).astype(int)])


@lru_cache(maxsize=1)
def _noise() -> NDArray[np.float64]:
    # Always the same draws, so that the same image gives the same answer.
    return np.asarray(np.random.default_rng(5).standard_normal((ROUNDS, DRAWS, 3)))


def _circles(edge: Float64) -> Float64:
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
