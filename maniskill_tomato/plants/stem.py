"""The main shoot: where its nodes are, where they point, and its mesh."""

from dataclasses import dataclass
from math import cos, pi, radians, sin

import numpy as np

from maniskill_tomato.plants.meshing import Float64, Patch, tube
from maniskill_tomato.plants.plant_config import PlantConfig
from maniskill_tomato.plants.random_streams import Stream, normal, stream


@dataclass(frozen=True, eq=False)
class Shoot:
    """Nodes of the main shoot, from the ground up."""

    heights: Float64
    """Height of each node, in [m]. Shape (N,)."""
    azimuths: Float64
    """Direction of each node's leaf in the horizontal plane, in [rad], not wrapped. Shape (N,)."""
    truss_nodes: tuple[int, ...]
    """Index of the node just above which each truss stands."""
    phases: Float64
    """Phases of the sideways wander, in [rad]. Shape (4,)."""
    config: PlantConfig

    def on_skin(self, height: float, azimuth: float) -> Float64:
        """A point just under the skin of the stem on one of its sides, in [m]. Shape (3,)."""
        z = np.array(height)
        side = np.array([cos(azimuth), sin(azimuth), 0.0])
        return np.asarray(self.axis(z) + 0.6 * float(self.radius(z)) * side)

    def axis(self, z: Float64) -> Float64:
        """Points of the stem's axis at given heights, in [m]. Shape (..., 3)."""
        stem = self.config.stem
        grow = np.clip(z / 0.25, 0.0, 1.0)
        x = np.sin(2 * pi * z / 0.62 + self.phases[0]) + 0.5 * np.sin(2 * pi * z / 0.27 + self.phases[1])
        y = np.sin(2 * pi * z / 0.55 + self.phases[2]) + 0.5 * np.sin(2 * pi * z / 0.31 + self.phases[3])
        node_x = np.interp(z, self.heights, -np.cos(self.azimuths) * stem.zigzag, 0.0, 0.0)
        node_y = np.interp(z, self.heights, -np.sin(self.azimuths) * stem.zigzag, 0.0, 0.0)
        return np.stack([grow * (stem.wander * x + node_x), grow * (stem.wander * y + node_y), z], -1)

    def radius(self, z: Float64) -> Float64:
        """Radius of the stem at given heights, without the swelling of its nodes, in [m]."""
        stem = self.config.stem
        part = np.clip(z / stem.height, 0.0, 1.0)
        # Greenhouse stems keep their girth and thin out near the apex.
        return stem.base_radius * (1.0 - (1.0 - stem.tip_radius_ratio) * part**2.2)


def grow_shoot(config: PlantConfig, seed: int) -> Shoot:
    """Draws the nodes of a plant's main shoot."""
    stem = config.stem
    rng = stream(seed, Stream.STEM)
    count = 60
    first = stem.nodes_below_first_truss
    lengths = np.array(
        [
            (stem.lower_internode_length if i <= first else stem.internode_length)
            * normal(rng, 1.0, stem.internode_spread)
            for i in range(count)
        ]
    )
    low, high = stem.divergence_range_deg
    steps = np.array(
        [
            np.clip(normal(rng, stem.divergence_mean_deg, stem.divergence_spread_deg), low, high)
            for _ in range(count)
        ]
    )
    handedness = 1.0 if rng.random() < 0.5 else -1.0
    azimuths = np.concatenate([[0.0], np.cumsum(np.radians(steps[:-1]) * handedness)])
    start, phases = 2 * pi * rng.random(), 2 * pi * rng.random(4)
    heights = np.cumsum(lengths)
    truss_nodes = tuple(first + stem.leaves_per_truss * k for k in range(len(config.fruits_per_truss)))

    if config.fruit_heights:
        # The internodes stretch so that each fruit hangs at its height; a fruit hangs a little under its
        # node.
        spread = np.array([2 * rng.random() - 1 for _ in truss_nodes]) * config.fruit_height_spread
        drop = config.truss.fruit_drop
        targets = np.array(config.fruit_heights) + spread + drop
        knots = np.concatenate([[0.0], heights[list(truss_nodes)]])
        values = np.concatenate([[0.0], targets])
        above = heights > knots[-1]
        heights = np.where(above, heights - knots[-1] + values[-1], np.interp(heights, knots, values))
    if config.hiding:
        # The leaf above the middle fruit points to the robot's side, as a grower turns a plant on its string.
        middle = truss_nodes[len(truss_nodes) // 2] + 1
        azimuths = (
            azimuths - azimuths[middle] + pi + radians(normal(rng, 0.0, config.hiding.plant_turn_spread_deg))
        )
    else:
        azimuths = azimuths + start
    inside = heights < stem.height - 0.02
    return Shoot(
        heights=heights[inside],
        azimuths=azimuths[inside],
        truss_nodes=truss_nodes,
        phases=phases,
        config=config,
    )


def stem_patch(shoot: Shoot, *, picture: bool) -> Patch:
    """The stem as a tube that swells at each node."""
    height = shoot.config.stem.height
    offsets = np.array([-0.009, -0.003, 0.003, 0.009]) if picture else np.array([-0.008, 0.0, 0.010])
    swell = shoot.config.stem.node_swelling * np.array([0.0, 0.85, 1.0, 0.0] if picture else [0.0, 1.0, 0.0])
    z = (shoot.heights[:, None] + offsets).ravel()
    bulge = np.tile(swell, len(shoot.heights))
    inner = (z > 0.012) & (z < height - 0.012)
    z = np.concatenate([[0.0], z[inner], [height]])
    bulge = np.concatenate([[0.15], bulge[inner], [-0.45]])
    order = np.argsort(z, kind="stable")
    z, bulge = z[order], bulge[order]
    return tube(
        shoot.axis(z), shoot.radius(z) * (1.0 + bulge), 14 if picture else 6, texture_length=0.25, cap=True
    )
