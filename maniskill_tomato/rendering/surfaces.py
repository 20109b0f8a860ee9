"""Surfaces of what stands round the plants in pictures: painted, dirty, printed and shining ones; boxes; the sky."""

import tempfile
from functools import lru_cache

import cv2
import numpy as np
import sapien
import sapien.render
from numpy.random import Generator
from numpy.typing import NDArray

from maniskill_tomato.plants.textures import cloud
from maniskill_tomato.rendering.plant_actors import repeating_texture, textured_material

SKY_RESOLUTION = 16
"""Side of the environment map's faces, in [px]: a gradient needs no more, and filtering a large one takes minutes on
a CPU."""


def tiled_box(
    half: list[float], material: sapien.render.RenderMaterial, tile: float = 0.6
) -> sapien.render.RenderShape:
    """A box whose texture repeats every `tile` metres, where SAPIEN's own would stretch over its faces.

    Args:
        half: Half its sides, in [m].
        material: Of all faces.
        tile: In [m].
    """
    corners: list[NDArray[np.float64]] = []
    normals: list[NDArray[np.float64]] = []
    uvs: list[list[float]] = []
    faces: list[list[int]] = []
    size = np.array(half)
    for axis in range(3):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        for sign in (-1.0, 1.0):
            first = len(corners)
            for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
                corner = np.zeros(3)
                corner[axis], corner[i], corner[j] = sign * size[axis], a * size[i], b * size[j]
                corners.append(corner)
                normals.append(sign * np.eye(3)[axis])
                along, across = (i, j) if size[i] >= size[j] else (j, i)
                # Print on the side that faces the aisle (-x) is the right way round.
                uvs.append([-corner[along] / tile, 0.5 - corner[across] / tile])
            order = [[0, 1, 2], [0, 2, 3]] if sign > 0 else [[0, 2, 1], [0, 3, 2]]
            faces += [[first + k for k in face] for face in order]
    return sapien.render.RenderShapeTriangleMesh(
        vertices=np.array(corners, np.float32),
        triangles=np.array(faces, np.uint32),
        normals=np.array(normals, np.float32),
        uvs=np.array(uvs, np.float32),
        material=material,
    )


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


@lru_cache(maxsize=16)
def dome(
    sky: tuple[float, float, float], ground: tuple[float, float, float], blend: float
) -> sapien.render.RenderCubemap:
    """Light from all sides as an environment map.

    Args:
        sky: Linear colour from above, 0 to 1; SAPIEN's 8-bit colours wrap round above that.
        ground: From below.
        blend: How softly one becomes the other at the horizon, 0 to 1.
    """
    from sapien.asset import create_dome_envmap

    with tempfile.TemporaryDirectory() as folder:  # Its default file is one for all processes.
        return create_dome_envmap(
            filename=f"{folder}/sky.ktx",
            sky_color=list(sky),
            ground_color=list(ground),
            blend=blend,
            resolution=SKY_RESOLUTION,
        )
