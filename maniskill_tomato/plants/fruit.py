"""A fruit: how ripe it is, its slightly flattened and ribbed shape, its mesh."""

from dataclasses import dataclass
from math import cos, pi, radians, sin

import numpy as np
from numpy.random import Generator

from maniskill_tomato.plants.meshing import Float64, Patch, cross, normalized
from maniskill_tomato.plants.organs import Ripeness
from maniskill_tomato.plants.plant_config import FruitConfig
from maniskill_tomato.plants.random_streams import normal, uniform

SKIN_VARIANTS = {"ripe": 3, "turning": 4, "green": 3}
"""Number of skin textures for each ripeness."""


@dataclass(frozen=True, eq=False)
class Berry:
    """Shape of one fruit, without its place."""

    radius: float
    """Equatorial radius, in [m]."""
    oblateness: float
    """Height over width."""
    ribs: int
    """Number of ribs."""
    rib_depth: float
    """Depth of the ribs at the shoulder over the radius."""
    rib_phase: float
    """Direction of the first rib, in [rad]."""
    dent: float
    """Depth of the dent around the calyx over the radius."""
    axis: Float64
    """Unit vector from the blossom end to the calyx. Shape (3,)."""
    ripeness: Ripeness
    variant: int
    """Which skin texture it has."""

    @property
    def top(self) -> float:
        """Distance from the centre to the bottom of the dent, where the calyx sits, in [m]."""
        return self.radius * (self.oblateness - self.dent)

    def frame(self) -> Float64:
        """Columns: two directions across the axis and the axis. Shape (3, 3)."""
        helper = np.array([1.0, 0.0, 0.0])
        first = normalized(helper - self.axis * self.axis[0])
        return np.stack([first, cross(self.axis, first), self.axis], 1)


def classify(config: FruitConfig, ripeness: float) -> Ripeness:
    """The class of a fruit by its ripeness (0 to 1)."""
    if ripeness >= config.ripe_above:
        return "ripe"
    return "turning" if ripeness >= config.turning_above else "green"


def draw_berry(config: FruitConfig, rng: Generator, truss: int, position: int) -> Berry:
    """Draws a fruit.

    Args:
        config: Ranges of its numbers.
        rng: Its random numbers.
        truss: Its truss, counted from the lowest.
        position: Its place on the truss, counted from the stem.
    """
    ripeness = 1.0 - config.truss_ripening_step * truss - config.fruit_ripening_step * position
    ripeness += normal(rng, 0.0, config.ripeness_spread)
    kind = classify(config, ripeness)
    # Fruits of the upper trusses, and those near a truss's tip, are still growing or stay smaller.
    grown = 1.0 - 0.018 * position - (0.0 if ripeness > 0.15 else 0.35 * min(1.0, (0.15 - ripeness) / 0.5))
    tilt = radians(normal(rng, 0.0, config.tilt_spread_deg))
    around = 2 * pi * rng.random()
    axis = np.array([sin(tilt) * cos(around), sin(tilt) * sin(around), cos(tilt)])
    low, high = config.ribs_range
    return Berry(
        radius=uniform(rng, config.radius_range) * grown,
        oblateness=uniform(rng, config.oblateness_range),
        ribs=low + int((high + 1 - low) * rng.random()),
        rib_depth=uniform(rng, config.rib_depth_range),
        rib_phase=2 * pi * rng.random(),
        dent=config.shoulder_dent * normal(rng, 1.0, 0.15),
        axis=axis,
        ripeness=kind,
        variant=int(rng.random() * SKIN_VARIANTS[kind]),
    )


def berry_patch(berry: Berry, centre: Float64, *, picture: bool) -> Patch:
    """The skin of a fruit.

    Args:
        berry: Its shape.
        centre: Its centre, in the plant frame, in [m]. Shape (3,).
        picture: Whether to use the finer mesh.
    """
    around, down = (48, 28) if picture else (12, 7)
    to_plant = berry.frame().T

    def point(phi: Float64, theta: Float64) -> Float64:
        ring = np.sin(theta)
        shoulder = np.clip(np.cos(theta) + 0.35, 0.0, 1.0)
        rib = berry.rib_depth * shoulder * ring * np.cos(berry.ribs * (phi - berry.rib_phase))
        across = berry.radius * ring * (1.0 + rib) * (1.0 + 0.03 * np.cos(theta))
        height = berry.radius * berry.oblateness * np.cos(theta)
        height = height - berry.radius * berry.dent * np.exp(-((theta / 0.42) ** 2))
        height = height + berry.radius * 0.035 * np.exp(-(((pi - theta) / 0.35) ** 2))
        local = np.stack([across * np.cos(phi), across * np.sin(phi), height], -1)
        return np.asarray(local @ to_plant)

    # Rows crowd a little at the top, where the dent is.
    rows = np.linspace(0.0, 1.0, down + 1)
    theta_rows = pi * (rows - 0.035 * np.sin(2 * pi * rows))
    phi = np.linspace(0.0, 2 * pi, around + 1)
    phi[-1] = 0.0
    theta = theta_rows[1:-1]
    grid_phi, grid_theta = np.meshgrid(phi, theta)
    step = 1e-3
    body = point(grid_phi, grid_theta)
    body_normals = cross(
        point(grid_phi, grid_theta + step) - point(grid_phi, grid_theta - step),
        point(grid_phi + step, grid_theta) - point(grid_phi - step, grid_theta),
    )
    zero = np.zeros(1)
    poles = np.concatenate([point(zero, zero), point(zero, zero + pi)])
    u = np.linspace(0.0, 1.0, around + 1)
    body_uv = np.stack(np.broadcast_arrays(u[None], (theta / pi)[:, None]), -1)
    # Each pole is repeated so that every triangle of its fan has its own texture column.
    middle_u = 0.5 * (u[1:] + u[:-1])
    vertices = np.concatenate([body.reshape(-1, 3), np.repeat(poles, around, 0)]) + centre
    normals = np.concatenate(
        [body_normals.reshape(-1, 3), np.repeat(np.stack([berry.axis, -berry.axis]), around, 0)]
    )
    uvs = np.concatenate(
        [
            body_uv.reshape(-1, 2),
            np.stack([middle_u, np.zeros(around)], 1),
            np.stack([middle_u, np.ones(around)], 1),
        ]
    )
    width = around + 1
    column = np.arange(around)
    top = len(theta) * width + column
    faces = [np.stack([top, column, column + 1], 1)]
    for row in range(len(theta) - 1):
        a = row * width + column
        faces.append(np.stack([a, a + width, a + width + 1], 1))
        faces.append(np.stack([a, a + width + 1, a + 1], 1))
    last = (len(theta) - 1) * width + column
    faces.append(np.stack([last, top + around, last + 1], 1))
    return Patch(vertices, normals, uvs, np.concatenate(faces))
