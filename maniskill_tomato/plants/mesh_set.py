"""Plants from mesh files as a set: a file is one plant, a folder holds many, each in one split."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, Final

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.mesh_files import MESH_SUFFIXES
from maniskill_tomato.plants.mesh_plant import plant_from_mesh
from maniskill_tomato.plants.mesh_rules import MeshRules
from maniskill_tomato.plants.organs import Plant
from maniskill_tomato.plants.seed_splits import SEED_SPLITS
from maniskill_tomato.tables import read_table
from maniskill_tomato.text_files import read_toml

RULES_FILE: Final = "mesh.toml"
"""The rules of all files of its folder."""

KEPT_PLANTS: Final = 64
"""Plants of mesh files that are kept, so that all who show one share its triangles; large ones take 30 MB."""

ALL: Final = "all"
"""Every plant of a set, whatever its split."""

RULE_NAMES: Final = tuple(field.name for field in fields(MeshRules))

_TRAIN_SHARE, _VALIDATION_SHARE = 0.6, 0.2


@dataclass(frozen=True, kw_only=True)
class MeshSource:
    """Where plants come from, and what is said about them beside what stands in their folder."""

    path: str
    """A mesh file or a folder of them."""
    rules: tuple[tuple[str, Any], ...] = ()
    """Values of `MeshRules` by name that go before those of `mesh.toml`."""

    @classmethod
    def parse(cls, path: object, rules: Mapping[str, Any] | None = None) -> "MeshSource":
        """The source of a path and of values of `MeshRules` by name.

        Raises:
            InvalidInputError: It is no path, or a value is refused.
        """
        if isinstance(path, MeshSource):
            return path
        if not isinstance(path, str | Path) or not str(path):
            raise InvalidInputError(
                f"mesh must be the path of a mesh file or of a folder of them; got {path!r}"
            )
        frozen: dict[str, Any] = {n: tuple(v) if isinstance(v, list) else v for n, v in (rules or {}).items()}
        MeshRules(**frozen)
        return cls(path=str(path), rules=tuple(sorted(frozen.items())))

    @property
    def plants(self) -> "MeshSet":
        """The set.

        Raises:
            InvalidInputError: There is no such file or folder, or it holds no plant.
        """
        return _open_set(self)


@dataclass(frozen=True, eq=False)
class MeshSet:
    """The plants of a file or folder by their seeds.

    A plant's seed is the first of its split in `SEED_SPLITS` plus its place among the split's plants, in the order of
    their names. Sub-folders called like splits say which plants are in which; without any, a plant's name does: of
    many, 60 % are training plants, 20 % validation and 20 % held-out ones, and a plant stays where it is when others
    come. A single file is a training plant.
    """

    path: Path
    rules: MeshRules
    files: Mapping[int, Path]
    """The file of each plant, by its seed, in order."""

    def seeds(self, split: str) -> list[int]:
        """Seeds of the plants of a split, or of `all`.

        Raises:
            InvalidInputError: There is no such split, or it has no plants.
        """
        if split not in (*SEED_SPLITS, ALL):
            raise InvalidInputError.choice("the split of plants", split, (*SEED_SPLITS, ALL))
        low, high = (0, 2**24) if split == ALL else SEED_SPLITS[split]
        found = [seed for seed in self.files if low <= seed < high]
        if not found:
            raise InvalidInputError(
                f"{self.path} has no plants of the split {split!r} ({self._counts()}); put some into a sub-folder of "
                f"that name, or choose another split or 'all'"
            )
        return found

    def split_of(self, seed: int) -> str:
        """The split that a seed belongs to."""
        return next(name for name, (low, high) in SEED_SPLITS.items() if low <= seed < high)

    def grow(self, seed: int) -> Plant:
        """Reads the plant of a seed.

        Raises:
            InvalidInputError: There is no such plant, or its file is refused.
        """
        self.check(seed)
        return _read_plant(self.files[seed], self.rules, seed)

    def check(self, seed: int) -> None:
        """Accepts the seed of a plant.

        Raises:
            InvalidInputError: There is no such plant.
        """
        if seed not in self.files:
            raise InvalidInputError(f"{self.path} has no plant of seed {seed}; it has {self._ranges()}")

    @cached_property
    def fingerprint(self) -> str:
        """Tells sets of other plants or rules apart: a hash of names, contents and rules."""
        digest = hashlib.sha256(repr(self.rules).encode())
        for seed, path in self.files.items():
            digest.update(f"{seed} {path.name}\n".encode())
            digest.update(hashlib.sha256(path.read_bytes()).digest())
        return digest.hexdigest()[:16]

    def _by_split(self) -> dict[str, list[int]]:
        return {
            split: [seed for seed in self.files if low <= seed < high]
            for split, (low, high) in SEED_SPLITS.items()
        }

    def _counts(self) -> str:
        return ", ".join(f"{split}: {len(seeds)}" for split, seeds in self._by_split().items())

    def _ranges(self) -> str:
        told = []
        for split, seeds in self._by_split().items():
            if seeds:
                told.append(f"{seeds[0]}{f' to {seeds[-1]}' if len(seeds) > 1 else ''} ({split})")
        return ", ".join(told)


@lru_cache(maxsize=KEPT_PLANTS)
def _read_plant(path: Path, rules: MeshRules, seed: int) -> Plant:
    return plant_from_mesh(path, rules, seed)


@lru_cache(maxsize=16)
def _open_set(source: MeshSource) -> MeshSet:
    path = Path(source.path).expanduser()
    given = dict(source.rules)
    if path.is_file():
        return MeshSet(path, _rules(path.parent / RULES_FILE, given), {0: path})
    if not path.is_dir():
        raise InvalidInputError(
            f"there is no mesh file and no folder {path}; give plant={{'mesh': ...}} one of them"
        )
    split_files = {split: _mesh_files(path / split) for split in SEED_SPLITS if (path / split).is_dir()}
    if not split_files:
        split_files = {split: [] for split in SEED_SPLITS}
        for file in _mesh_files(path):
            split_files[_split_by_name(file.stem)].append(file)
    files = {
        SEED_SPLITS[split][0] + k: file for split, some in split_files.items() for k, file in enumerate(some)
    }
    if not files:
        raise InvalidInputError(
            f"{path} holds no plants: no files that end in {', '.join(MESH_SUFFIXES)}, neither there nor in the "
            f"sub-folders {', '.join(SEED_SPLITS)}"
        )
    return MeshSet(path, _rules(path / RULES_FILE, given), files)


def _mesh_files(folder: Path) -> list[Path]:
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in MESH_SUFFIXES and p.is_file())


def _split_by_name(name: str) -> str:
    share = int.from_bytes(hashlib.sha256(name.encode()).digest()[:4], "big") / 2**32
    if share < _TRAIN_SHARE:
        return "train"
    return "validation" if share < _TRAIN_SHARE + _VALIDATION_SHARE else "held_out"


def _rules(path: Path, given: Mapping[str, Any]) -> MeshRules:
    if not path.is_file():
        return MeshRules(**given)
    return read_table(MeshRules, {**read_toml(path), **given}, path)
