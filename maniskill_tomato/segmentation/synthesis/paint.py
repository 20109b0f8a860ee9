"""Materials of a rendered scene: the plants' textures in varied colours, and materials of the surroundings."""

from functools import lru_cache
from typing import Any

import cv2
import numpy as np
import sapien.render
from numpy.random import Generator
from numpy.typing import NDArray

from maniskill_tomato.plants.materials import MATERIALS
from maniskill_tomato.plants.textures import cloud
from maniskill_tomato.rendering.plant_actors import repeating_texture, textured_material
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
    """Yellow between the veins and a few dry spots."""
    size = colour.shape[0]
    yellow = np.clip((cloud(rng, size, size, 3) - (1 - share)) / 0.5, 0, 1)[..., None] * 0.5
    colour = colour * (1 - yellow) + np.array([0.56, 0.58, 0.2]) * yellow
    dry = np.clip((cloud(rng, size, size, 9, octaves=2) - (1.05 - 0.5 * share)) / 0.08, 0, 1)[..., None]
    return np.asarray(colour * (1 - dry) + np.array([0.62, 0.5, 0.3]) * dry)


@lru_cache(maxsize=8)
def _dirt(variant: int) -> NDArray[np.float64]:
    rng = np.random.default_rng([4242, variant])
    broad, fine = cloud(rng, 256, 256, 3), cloud(rng, 256, 256, 30, octaves=2)
    streaks = cloud(rng, 1, 256, 40, octaves=2)
    return np.asarray(
        0.55 * np.clip(broad, 0, 1) + 0.25 * np.clip(fine, 0, 1) ** 2 + 0.2 * np.clip(streaks, 0, 1)
    )


def dirty(colour: tuple[float, float, float], rng: Generator, *, dirt: float) -> sapien.render.RenderMaterial:
    """A painted or plastic surface with stains.

    Args:
        colour: Base colour, sRGB, 0 to 1.
        rng: Chooses the stains.
        dirt: How strong they are, 0 to 1.
    """
    stain = (dirt * _dirt(int(rng.integers(8))))[..., None]
    mixed = np.array(colour) * (1 - stain) + np.array([0.32, 0.26, 0.18]) * stain
    pixels = np.dstack([np.clip(mixed * 255, 0, 255), np.full(mixed.shape[:2], 255.0)])
    return textured_material(pixels.astype(np.uint8), float(rng.uniform(0.35, 0.9)), 0.4)


def printed(colour: tuple[float, float, float], rng: Generator) -> sapien.render.RenderMaterial:
    """The wrapping of a slab: pale plastic with a few printed letters."""
    pixels = np.full((256, 512, 3), np.array(colour) * 255, dtype=np.float64)
    pixels *= 1 - 0.3 * np.repeat(np.clip(_dirt(int(rng.integers(8))), 0, 1), 2, axis=1)[..., None]
    canvas = np.ascontiguousarray(pixels.astype(np.uint8))
    ink = [int(v) for v in rng.choice([[40, 60, 120], [30, 30, 30], [60, 110, 60]])]
    for _ in range(int(rng.integers(1, 4))):
        word = "".join(chr(int(c)) for c in rng.integers(97, 123, int(rng.integers(4, 9)))).capitalize()
        place = (int(rng.integers(0, 380)), int(rng.integers(60, 240)))
        scale = float(rng.uniform(0.8, 2.4))
        cv2.putText(canvas, word, place, cv2.FONT_HERSHEY_DUPLEX, scale, ink, int(1 + scale), cv2.LINE_AA)
    return textured_material(np.dstack([canvas, np.full((256, 512), 255, np.uint8)]), 0.5, 0.3)


def plain(colour: tuple[float, float, float], *, roughness: float = 0.7) -> sapien.render.RenderMaterial:
    """One base colour, sRGB, 0 to 1."""
    linear = [float(c) ** 2.2 for c in colour]
    return sapien.render.RenderMaterial(base_color=[*linear, 1.0], roughness=roughness, specular=0.4)


def glowing(light: tuple[float, float, float]) -> sapien.render.RenderMaterial:
    """A surface that only shines, with linear strengths: a bright sheet of glass or sky."""
    material = sapien.render.RenderMaterial(base_color=[0, 0, 0, 1], roughness=1.0, specular=0.0)
    material.emission = [*light, 1.0]
    return material


def far_greenery(light: tuple[float, float, float], rng: Generator) -> sapien.render.RenderMaterial:
    """A wall that shines like rows too far away to be built: blurred foliage, gaps of light, stems, a few fruits.

    Meant to repeat every 4 m.

    Args:
        light: Linear strength of the light in the gaps; stronger light than 1 is left to walls of sky.
        rng: Places everything.
    """
    rows = columns = 512
    y, x = np.mgrid[:rows, :columns] / rows
    leaves = cloud(rng, rows, columns, 12, octaves=4)
    shade = cloud(rng, rows, columns, 30, octaves=2)
    tint = np.array([0.13, 0.3, 0.06]) * np.exp(rng.normal(0, 0.25, 3))
    picture = tint * (0.55 + 0.5 * shade[..., None]) * float(rng.uniform(0.5, 1.1))
    gaps = np.clip((leaves - rng.uniform(0.1, 0.45)) / 0.25, 0, 1)[..., None]
    picture = picture * (1 - gaps) + gaps
    for _ in range(int(rng.integers(0, 30))):
        # A fruit here is narrower than those that count.
        spot = np.exp(-((x - rng.random()) ** 2 + (y - rng.random()) ** 2) / float(rng.uniform(5e-6, 1.5e-5)))
        colour = np.array([0.4, 0.06, 0.03]) if rng.random() < 0.6 else np.array([0.3, 0.36, 0.14])
        picture = picture * (1 - spot[..., None]) + colour * spot[..., None]
    pixels = np.dstack([np.clip(picture, 0, 1) ** (1 / 2.2) * 255, np.full((rows, columns), 255.0)])
    brightest = max(*light, 1.0)
    material = glowing((light[0] / brightest, light[1] / brightest, light[2] / brightest))
    material.emission_texture = repeating_texture(pixels.astype(np.uint8))
    return material
