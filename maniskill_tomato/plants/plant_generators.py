"""Generators of plants that other packages add.

A generator is a callable `(seed) -> plant` that gives the same plant for the same seed on every machine. The plant is a
mapping from names to triangles of shape (F, 3, 3) in [m], or a `Plant`. In the plant's frame the origin is the foot of
the stem, z points up and the robot stands at -x. Names begin with `leaf_`, `stem` or `fruit_` (`fruit_green_`,
`fruit_turning_`).
"""

from collections.abc import Mapping
from typing import Final

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.extension_points import ExtensionPoint
from maniskill_tomato.plants.mesh_plant import plant_from_triangles
from maniskill_tomato.plants.organs import Plant

PLANT_GENERATORS: Final = ExtensionPoint("plant generator", "maniskill_tomato.plants", {})
"""By name; `generator.generate_plant` grows this package's own presets."""


def check_recorded_plant(plant: object, source: object, instead: str) -> None:
    """Accepts the task option `plant` of a file, unless its generator is a module that only the file names.

    Args:
        plant: The option, in any form that `PlantSpec.parse` takes; other forms are left to that.
        source: The file or folder, for the message.
        instead: What the user may do, for the message; `{name}` in it stands for the generator.

    Raises:
        InvalidInputError: See `ExtensionPoint.check_recorded`.
    """
    name = plant.get("generator") if isinstance(plant, Mapping) else plant
    if isinstance(name, str):
        PLANT_GENERATORS.check_recorded(name, source, instead.replace("{name}", name))


def generated_plant(name: str, seed: int) -> Plant:
    """The plant of a seed from another package's generator.

    Args:
        name: Of `PLANT_GENERATORS`, or `package.module:callable`.
        seed: Which plant.

    Raises:
        InvalidInputError: There is no such generator, it cannot be imported, or what it makes is no plant.
    """
    made = PLANT_GENERATORS.load(name)(seed)
    if isinstance(made, Plant):
        return made
    if not isinstance(made, Mapping):
        raise InvalidInputError(
            f"the plant generator {name!r} must give a mapping from names to triangles, or a Plant; it gave a "
            f"{type(made).__name__}"
        )
    return plant_from_triangles(name, made, seed)
