"""Materials of a rendered scene: the plants' textures in varied colours, and materials of the surroundings."""

from typing import Any

import numpy as np
import sapien.render
from numpy.random import Generator
from numpy.typing import NDArray

from maniskill_tomato.plants.materials import MATERIALS
from maniskill_tomato.plants.textures import cloud
from maniskill_tomato.rendering.plant_actors import textured_material
from maniskill_tomato.segmentation.synthesis.appearance import SceneAppearance

BLOOM = (0.66, 0.6, 0.4)
"""Colour of what lies on a fruit's skin, sRGB, 0 to 1: in photos from greenhouses green is 0.43 of the red of ripe
fruits in the median, blue 0.24."""


class PlantMaterials(dict[str, sapien.render.RenderMaterial]):
    """The plants' materials with one appearance, made when first asked for; like the dictionary that shapes take."""

    def __init__(self, appearance: SceneAppearance, rng: Generator) -> None:
        """Keeps the appearance.

        Args:
            appearance: Decides colours, blemishes and gloss.
            rng: Places the blemishes.
        """
        super().__init__()
        self._appearance = appearance
        self._seed = int(rng.integers(2**31))

    def __contains__(self, name: object) -> bool:
        return name in MATERIALS or super().__contains__(name)  # The others are a mesh file's own.

    def __missing__(self, name: str) -> sapien.render.RenderMaterial:
        material = MATERIALS[name]
        pixels = material.base_color.astype(np.float32) / 255.0
        rng = np.random.default_rng([self._seed, sum(name.encode())])
        colour: NDArray[np.floating[Any]] = pixels[..., :3]
        roughness, specular = material.roughness, material.specular
        if name.startswith("leaf"):
            colour = colour * np.array(self._appearance.leaf_gain, dtype=np.float32)
            colour = _blemished(colour, self._appearance.leaf_blemish, rng)
            roughness = float(np.clip(roughness * self._appearance.gloss, 0.3, 0.95))
        elif name.startswith("fruit"):
            colour = (
                colour
                * np.array(self._appearance.fruit_gain, dtype=np.float32)
                * np.exp(rng.normal(0, 0.05, 3))
            )
            colour = (
                colour * (1 - self._appearance.fruit_bloom) + np.array(BLOOM) * self._appearance.fruit_bloom
            )
            roughness = float(np.clip(roughness * self._appearance.gloss, 0.12, 0.5))
            specular = 0.25
        else:
            colour = colour * np.array(self._appearance.leaf_gain, dtype=np.float32)
        pixels = np.dstack([np.clip(colour, 0, 1), pixels[..., 3:]])
        self[name] = textured_material((pixels * 255).astype(np.uint8), roughness, specular)
        return self[name]


def _blemished(colour: NDArray[np.floating[Any]], share: float, rng: Generator) -> NDArray[np.floating[Any]]:
    """Yellow between the veins, a few dry spots, and a dry tip."""
    size = colour.shape[0]
    yellow = np.clip((cloud(rng, size, size, 3) - (1 - share)) / 0.5, 0, 1)[..., None] * 0.5
    colour = colour * (1 - yellow) + np.array([0.56, 0.58, 0.2]) * yellow
    dry = np.clip((cloud(rng, size, size, 9, octaves=2) - (1.05 - 0.5 * share)) / 0.08, 0, 1)[..., None]
    ends = 1.0 - 0.25 * share + 0.06 * cloud(rng, size, size, 6)
    dry = np.maximum(dry, np.clip((np.linspace(0, 1, size)[None] - ends) / 0.03, 0, 1)[..., None])
    return np.asarray(colour * (1 - dry) + np.array([0.62, 0.5, 0.3]) * dry)
