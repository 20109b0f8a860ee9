"""The colours that a mesh file gives its surfaces: textures, colours of materials, of vertices and of faces."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from maniskill_tomato.plants.meshing import Float64, Int64
from maniskill_tomato.plants.textures import UInt8

LARGEST_TEXTURE: Final = 1024
"""Longer side of a texture, in [px]; larger ones are made smaller."""

_EXACT_COLOURS: Final = 4096
"""Up to so many colours of faces are kept as they are; of more, each channel has 64 levels."""


@dataclass(frozen=True, eq=False)
class Paint:
    """Base colours of triangles."""

    image: UInt8
    """sRGB with alpha; columns follow u, rows v. Shape (rows, columns, 4)."""
    uvs: Float64
    """Where each corner of each triangle is in the image. Shape (F, 3, 2)."""


def paint_of(visual: Any, faces: Int64, images: dict[object, UInt8], *, linear: bool) -> Paint | None:
    """The colours of a mesh as trimesh reads them; None if its file has none.

    Args:
        visual: Its `visual`.
        faces: Its triangles. Shape (F, 3).
        images: Images of the file so far, which meshes of the same look share; new ones are added.
        linear: Whether colours that are not in an image are linear light, as in glTF, and no sRGB.
    """
    material = getattr(visual, "material", None)
    tint = _material_colour(material)
    shades = _corner_colours(visual, faces)
    uv: Any = getattr(visual, "uv", None)
    picture = _picture(material) if uv is not None and len(uv) else None
    if uv is not None and picture is not None:
        # glTF multiplies the two; an OBJ's texture stands in place of the colour.
        factor = tint if linear and tint is not None else np.ones(3)
        if (key := (id(picture), *factor.tolist())) not in images:
            images[key] = _texture(picture, factor)
        # trimesh counts v from the lower edge.
        return Paint(images[key], np.stack([uv[..., 0], 1.0 - uv[..., 1]], -1)[faces])
    if shades is None and tint is None:
        return None
    colours = np.ones((len(faces), 3)) if shades is None else shades.mean(1)
    colours = colours * (1.0 if tint is None or (shades is not None and not linear) else tint)
    image, places = _palette(_srgb(colours) if linear else np.round(255.0 * colours).astype(np.uint8))
    return Paint(
        images.setdefault((image.shape, image.tobytes()), image), np.repeat(places[:, None], 3, axis=1)
    )


def _material_colour(material: Any) -> Float64 | None:
    """What the file says of a material's colour, 0 to 1. Shape (3,)."""
    colour = getattr(material, "baseColorFactor", None)
    if "kd" in (getattr(material, "kwargs", None) or {}):
        colour = material.diffuse
    return None if colour is None else np.asarray(colour, dtype=np.float64)[:3] / 255.0


def _corner_colours(visual: Any, faces: Int64) -> Float64 | None:
    """Colours of vertices or faces at each corner, 0 to 1. Shape (F, 3, 3)."""
    kind = getattr(visual, "kind", None)
    if kind == "face":
        colours = np.repeat(np.asarray(visual.face_colors)[:, None, :3], 3, axis=1)
    elif kind == "vertex":
        colours = np.asarray(visual.vertex_colors)[faces][..., :3]
    elif kind == "texture" and "color" in visual.vertex_attributes:
        colours = np.asarray(visual.vertex_attributes["color"])[faces][..., :3]
    else:
        return None
    top = np.iinfo(colours.dtype).max if colours.dtype.kind in "iu" else 1.0
    return np.asarray(colours / top, dtype=np.float64)


def _picture(material: Any) -> Any:
    """The texture of a material, as its file holds it; None without one."""
    picture = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    # What trimesh makes up for a material without a texture never was a file of some format.
    return picture if getattr(picture, "format", None) is not None else None


def _texture(picture: Any, factor: Float64) -> UInt8:
    """Pixels of a picture times a factor of its light. Shape (rows, columns, 4)."""
    small = picture.convert("RGB")
    small.thumbnail((LARGEST_TEXTURE, LARGEST_TEXTURE))
    pixels = _srgb(_linear(np.asarray(small) / 255.0) * factor)
    return np.dstack([pixels, np.full(pixels.shape[:2], 255, np.uint8)])


def _palette(colours: UInt8) -> tuple[UInt8, Float64]:
    """A picture of the colours that occur, and where in it each triangle's is.

    Args:
        colours: Of the triangles. Shape (F, 3).

    Returns:
        Shapes (side, side, 4) and (F, 2).
    """
    digits = np.array([65536, 256, 1])
    codes = colours.astype(np.int64) @ digits
    if len(np.unique(codes)) > _EXACT_COLOURS:
        codes = (colours // 4 * 4 + 2).astype(np.int64) @ digits
    found, numbers = np.unique(codes, return_inverse=True)
    side = int(np.ceil(np.sqrt(len(found))))
    image = np.full((side * side, 4), 255, dtype=np.uint8)
    image[: len(found), :3] = found[:, None] // digits % 256
    places = (np.stack([numbers % side, numbers // side], 1) + 0.5) / side
    return image.reshape(side, side, 4), places


def _linear(colours: Float64) -> Float64:
    return np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)


def _srgb(light: Float64) -> UInt8:
    """Linear light, 0 to 1, in 8 bits of sRGB."""
    coded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)
    return np.round(255.0 * np.clip(coded, 0.0, 1.0)).astype(np.uint8)
