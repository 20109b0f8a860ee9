"""Which plant stands where: the `plant=` and `plant_pose=` options of the tasks, checked."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError, did_you_mean
from maniskill_tomato.plants.generator import generate_plant
from maniskill_tomato.plants.kinds import KINDS, PLANT_NAMES
from maniskill_tomato.plants.mesh_set import ALL, RULE_NAMES, MeshSource
from maniskill_tomato.plants.organs import Plant
from maniskill_tomato.plants.plant_generators import PLANT_GENERATORS, generated_plant
from maniskill_tomato.plants.row import generate_row, leaf_density_of, neighbour_seeds, stand_in_row
from maniskill_tomato.plants.seed_splits import SEED_SPLITS

ROW_NEIGHBOURS = 32
"""Neighbours in a row are among this number of plants of each split, so that a new row takes one new plant."""

MAX_SEED = 2**24 - 1
"""The largest plant seed: a saved state holds it as a float32."""


@dataclass(frozen=True, kw_only=True)
class PlantSpec:
    """The identity of a plant, or a rule that draws a new one at every reset."""

    preset: str = "one_tomato"
    """One of `maniskill_tomato.plants.kinds.PLANT_NAMES`."""
    seed: int | str = 0
    """The plant's seed, or the name of a split of `SEED_SPLITS`: then each reset draws a seed from it."""
    pool: int | None = None
    """With a split, draw only from this number of its seeds, the first ones; None draws from all. A plant that was
    seen before is ready at once, a new one takes 0.1 to 0.2 s to grow."""
    leaf_density: float | tuple[float, float] | None = None
    """Share of the preset's leaves, 0 or more; a range, from which each plant draws its own by its seed; None keeps
    the preset's own."""
    detail: Literal["training", "picture"] = "training"
    """Level of the triangles, both rendered and cast against."""
    row: bool = False
    """Whether the plant stands between two neighbours of its row (`plants.row`), drawn by its seed from the first
    `ROW_NEIGHBOURS` seeds of the same split."""
    mesh: MeshSource | None = None
    """Mesh files to take the plants from instead of growing them; preset, leaf density and detail then say nothing,
    seeds are those of `MeshSet`, and the split `all` has every plant."""
    generator: str | None = None
    """Another package's generator to take the plants from (`plants.plant_generators`); preset, leaf density and detail
    then say nothing."""

    def __post_init__(self) -> None:
        if self.mesh is not None:
            self._check_mesh(self.mesh)
            return
        if self.generator is not None:
            if not PLANT_GENERATORS.has(self.generator):
                raise InvalidInputError.choice(
                    "the plant generator",
                    self.generator,
                    (*PLANT_GENERATORS.names(), "package.module:callable"),
                )
        elif self.preset not in PLANT_NAMES:
            raise InvalidInputError.choice("plant preset", self.preset, PLANT_NAMES)
        if isinstance(self.seed, str):
            if self.seed not in SEED_SPLITS:
                raise InvalidInputError(
                    f"plant seed must be an integer from 0 to {MAX_SEED} or one of {', '.join(SEED_SPLITS)}; "
                    f"got {self.seed!r}"
                )
        elif isinstance(self.seed, bool) or not 0 <= self.seed <= MAX_SEED:
            raise InvalidInputError(f"plant seed must be an integer from 0 to {MAX_SEED}; got {self.seed!r}")
        if self.pool is not None and not self._pool_fits():
            raise InvalidInputError(
                "plant pool must be an integer from 1 to the size of a split, and needs a split's name as seed; "
                f"got pool={self.pool!r} with seed={self.seed!r}"
            )
        if isinstance(self.leaf_density, list):
            object.__setattr__(self, "leaf_density", tuple(self.leaf_density))
        if self.leaf_density is not None and not _is_density(self.leaf_density):
            raise InvalidInputError(
                "leaf_density must be a finite number of 0 or more, or a range (low, high) of such; "
                f"got {self.leaf_density!r}"
            )
        if self.detail not in ("training", "picture"):
            raise InvalidInputError.choice("plant detail", self.detail, ("training", "picture"))

    def _check_mesh(self, mesh: MeshSource) -> None:
        """Checks what does not depend on a split, which a list of episodes may replace."""
        if isinstance(self.seed, bool) or not isinstance(self.seed, str | int):
            raise InvalidInputError(
                f"plant seed must be a plant's number or a split's name; got {self.seed!r}"
            )
        if isinstance(self.seed, int):
            mesh.plants.check(self.seed)
        elif self.seed not in (*SEED_SPLITS, ALL):
            raise InvalidInputError.choice("plant seed", self.seed, (*SEED_SPLITS, ALL))
        pool = self.pool
        if pool is not None and (isinstance(pool, bool) or not isinstance(pool, int) or pool < 1):
            raise InvalidInputError(f"plant pool must be an integer of 1 or more; got {pool!r}")

    def _pool_fits(self) -> bool:
        if not isinstance(self.seed, str) or not isinstance(self.pool, int) or isinstance(self.pool, bool):
            return False
        low, high = SEED_SPLITS[self.seed]
        return 1 <= self.pool <= high - low

    @property
    def changes(self) -> bool:
        """Whether every reset draws a new plant."""
        return isinstance(self.seed, str)

    @property
    def first_seed(self) -> int:
        """The seed itself, or the first that may be drawn.

        Raises:
            InvalidInputError: The mesh files have no plants of the split.
        """
        return self.seed if isinstance(self.seed, int) else self._seeds()[0]

    def of_any_seed(self, split: str) -> "PlantSpec":
        """The same plants where a list of episodes says which: those of a split, or all of mesh files."""
        return replace(self, seed=split if self.mesh is None else ALL, pool=None)

    def grow(self, seed: int) -> Plant:
        """Grows the plant of a seed, or reads it from its file, with its neighbours if it has any."""
        if self.mesh is not None:
            plants = self.mesh.plants
            if not self.row:
                return plants.grow(seed)
            beside = plants.seeds(plants.split_of(seed))[:ROW_NEIGHBOURS]
            left, right = (plants.grow(beside[k]) for k in neighbour_seeds(seed, (0, len(beside))))
            return stand_in_row(plants.grow(seed), left, right)
        if self.generator is not None:
            return self._generated(self.generator, seed)
        if not self.row:
            return generate_plant(self.preset, seed, self.detail, leaf_density_of(self.leaf_density, seed))
        return generate_row(self.preset, seed, self.detail, self.leaf_density, seeds=_neighbours(seed))

    def _generated(self, generator: str, seed: int) -> Plant:
        plant = generated_plant(generator, seed)
        if not self.row:
            return plant
        left, right = (generated_plant(generator, k) for k in neighbour_seeds(seed, _neighbours(seed)))
        return stand_in_row(plant, left, right)

    def draw_seed(self, rng: np.random.RandomState) -> int:
        """The seed itself, or one drawn from the split with `rng`."""
        if isinstance(self.seed, int):
            return self.seed
        seeds = self._seeds()
        return int(seeds[rng.randint(len(seeds))])

    def _seeds(self) -> Sequence[int]:
        """The seeds that are drawn from."""
        assert isinstance(self.seed, str)
        if self.mesh is not None:
            return self.mesh.plants.seeds(self.seed)[: self.pool]
        low, high = SEED_SPLITS[self.seed]
        return range(low, high if self.pool is None else low + self.pool)

    @classmethod
    def parse(
        cls, value: "PlantSpec | Mapping[str, object] | str | None", default: "PlantSpec"
    ) -> "PlantSpec":
        """A choice from what a user may write.

        Args:
            value: None for the default; the name of a preset or of a generator; a mapping with any of this class's
                fields, which replace the default's. With `mesh`, the path of a mesh file or of a folder of them, it may
                also hold values of `MeshRules`, and the default's fields do not count: the plant is alone, and drawn
                from the training plants of a folder.
            default: The task's own plant.

        Raises:
            InvalidInputError: The value is of another form; the message lists what is allowed.
        """
        if value is None:
            return default
        if isinstance(value, PlantSpec):
            return value
        if isinstance(value, str) and value not in PLANT_NAMES and PLANT_GENERATORS.has(value):
            return cls._of_generator({"generator": value}, default)
        if isinstance(value, str):
            density = None if value in KINDS else default.leaf_density  # Each kind has its own.
            return replace(default, preset=value, leaf_density=density)
        if isinstance(value, Mapping):
            if value.get("mesh") is not None:
                return cls._parse_mesh(value)
            if value.get("generator") is not None:
                return cls._of_generator(value, default)
            names = [f.name for f in fields(cls)]
            unknown = sorted(set(value) - set(names))
            if unknown:
                of_mesh = "; it goes with mesh=" if unknown[0] in RULE_NAMES else ""
                raise InvalidInputError(
                    f"plant has no field {', '.join(map(repr, unknown))}{of_mesh}; the fields are {', '.join(names)}"
                    f"{did_you_mean(unknown[0], names)}"
                )
            replaced = dict(value)
            if replaced.get("preset") in KINDS:
                replaced.setdefault("leaf_density", None)  # Each kind has its own.
            if not isinstance(replaced.get("seed", ""), str):
                replaced.setdefault("pool", None)  # The default's pool is one of its split.
            return cls(**{**{name: getattr(default, name) for name in names}, **replaced})
        raise InvalidInputError(
            f"plant must be None, a preset's name ({', '.join(PLANT_NAMES)}) or a mapping of "
            f"{', '.join(f.name for f in fields(cls))}; got {value!r}"
        )

    @classmethod
    def _of_generator(cls, value: Mapping[str, Any], default: "PlantSpec") -> "PlantSpec":
        allowed = ("generator", "seed", "pool", "row")
        for name in value:
            if name not in allowed:
                raise InvalidInputError(
                    f"plant has no field {name!r} beside generator; the fields are {', '.join(allowed)}"
                    f"{did_you_mean(name, allowed)}"
                )
        if not isinstance(value["generator"], str):
            raise InvalidInputError(
                f"plant generator must be a name or package.module:callable; got {value['generator']!r}"
            )
        own = {"seed": default.seed if default.mesh is None else 0, "pool": default.pool, "row": default.row}
        if not isinstance(value.get("seed", ""), str):
            own["pool"] = None
        return cls(**{**own, **value})

    @classmethod
    def _parse_mesh(cls, value: Mapping[str, Any]) -> "PlantSpec":
        own = ("seed", "pool", "row")
        allowed = ("mesh", *own, *RULE_NAMES)
        for name in value:
            if name not in allowed:
                raise InvalidInputError(
                    f"plant has no field {name!r} beside mesh, whose plants are not grown; the fields are "
                    f"{', '.join(allowed)}{did_you_mean(name, allowed)}"
                )
        mesh = MeshSource.parse(value["mesh"], {n: v for n, v in value.items() if n in RULE_NAMES})
        is_file = list(mesh.plants.files) == [0] and mesh.plants.path.is_file()
        return cls(
            mesh=mesh, **{"seed": 0 if is_file else "train", **{n: value[n] for n in own if n in value}}
        )


def _neighbours(seed: int) -> tuple[int, int]:
    """Half-open range of the seeds of which the neighbours of a plant are drawn: the first ones of its split."""
    low = next((low for low, high in SEED_SPLITS.values() if low <= seed < high), 0)
    return low, low + ROW_NEIGHBOURS


def _is_density(value: object) -> bool:
    bounds = value if isinstance(value, tuple) else (value, value)
    numbers = [float(v) for v in bounds if isinstance(v, int | float) and math.isfinite(v) and v >= 0.0]
    return len(bounds) == len(numbers) == 2 and numbers[0] <= numbers[1]


@dataclass(frozen=True, kw_only=True)
class PlantPose:
    """Where a plant stands on the ground, in the world frame."""

    x: float
    """Stem base, in [m]."""
    y: float
    """Stem base, in [m]."""
    yaw: float = 0.0
    """Rotation about the vertical, in [rad]; at 0 the plant's -x side faces the robot."""

    def __post_init__(self) -> None:
        if not all(math.isfinite(v) for v in (self.x, self.y, self.yaw)):
            raise InvalidInputError(f"plant_pose must be finite; got x={self.x}, y={self.y}, yaw={self.yaw}")
        if not 0.3 <= math.hypot(self.x, self.y) <= 3.0:
            raise InvalidInputError(
                f"plant_pose must put the stem 0.3 to 3 m from the robot's base axis; got x={self.x}, y={self.y}"
            )

    @classmethod
    def parse(cls, value: "PlantPose | Sequence[float] | None", default: "PlantPose") -> "PlantPose":
        """A pose from None (the default) or `(x, y, yaw)` in [m, m, rad].

        Raises:
            InvalidInputError: The value is of another form or not finite.
        """
        if value is None:
            return default
        if isinstance(value, PlantPose):
            return value
        try:
            numbers = [float(v) for v in value]
        except (TypeError, ValueError):
            numbers = []
        if len(numbers) != 3:
            raise InvalidInputError(
                f"plant_pose must be three numbers (x [m], y [m], yaw [rad]); got {value!r}"
            )
        return cls(x=numbers[0], y=numbers[1], yaw=numbers[2])

    def as_array(self) -> NDArray[np.float64]:
        """(x, y, yaw). Shape (3,)."""
        return np.array([self.x, self.y, self.yaw])


ROW_PLANT = PlantSpec(preset="full", leaf_density=(0.8, 1.8), row=True)
"""The kind of plant of the general tasks and their lists of episodes; a seed or a split says which."""
