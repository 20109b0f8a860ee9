"""The materials that mesh parts name: a base colour texture and how it reflects."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial

from maniskill_tomato.plants.fruit import SKIN_VARIANTS
from maniskill_tomato.plants.leaf import LEAF_VARIANTS
from maniskill_tomato.plants.textures import (
    UInt8,
    calyx_texture,
    leaf_texture,
    skin_texture,
    stalk_texture,
    wilted_texture,
)


@dataclass(frozen=True)
class Material:
    """How a surface looks."""

    paint: Callable[[], UInt8]
    """Makes the base colour texture."""
    roughness: float
    """0 mirror-like, 1 matt."""
    specular: float
    """Strength of the reflection at normal incidence, 0 to 1, where 0.5 is 4 %."""

    @cached_property
    def base_color(self) -> UInt8:
        """The base colour, sRGB with alpha, made on first use. Shape (rows, columns, 4)."""
        return self.paint()


def _make_materials() -> dict[str, Material]:
    materials = {
        "stem": Material(partial(stalk_texture, 0, (104, 134, 66), streak=0.10), 0.75, 0.3),
        "petiole": Material(partial(stalk_texture, 1, (112, 146, 70), streak=0.08), 0.7, 0.3),
        "truss": Material(partial(stalk_texture, 2, (96, 132, 58), streak=0.07), 0.7, 0.3),
        "calyx": Material(calyx_texture, 0.7, 0.3),
        "petal": Material(partial(stalk_texture, 3, (236, 204, 46), streak=0.06), 0.6, 0.3),
    }
    for k in range(LEAF_VARIANTS):
        materials[f"leaf_upper_{k}"] = Material(partial(leaf_texture, k, upper=True), 0.55, 0.4)
        materials[f"leaf_under_{k}"] = Material(partial(leaf_texture, k, upper=False), 0.8, 0.25)
        materials[f"leaf_wilted_upper_{k}"] = Material(partial(wilted_texture, k, upper=True), 0.85, 0.2)
        materials[f"leaf_wilted_under_{k}"] = Material(partial(wilted_texture, k, upper=False), 0.9, 0.2)
    for k, colour in enumerate(((168, 150, 120), (205, 205, 200), (70, 92, 120))):
        materials[f"object_{k}"] = Material(partial(stalk_texture, 10 + k, colour, streak=0.05), 0.8, 0.3)
    for ripeness, variants in SKIN_VARIANTS.items():
        for k in range(variants):
            roughness = 0.22 if ripeness == "ripe" else 0.27
            materials[f"fruit_{ripeness}_{k}"] = Material(partial(skin_texture, ripeness, k), roughness, 0.5)
    return materials


MATERIALS: dict[str, Material] = _make_materials()
"""Every material by the name that `MeshPart.material` gives."""
