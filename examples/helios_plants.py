"""Plants of another maker: grows tomato, cherry tomato and capsicum plants with pyhelios3d as a folder for `mesh=`.

pyhelios3d's core is GPL, so it is no dependency of this package: this script imports nothing of maniskill-tomato and
runs in an environment of its own, and only the triangles pass through files. Every plant is cut out along the outline
that its leaves' textures have, split into leaves, stalks, calyces and fruits, and lifted so that its ripe fruits hang
where the arm reaches. What was drawn for each plant is written to `plants.json` beside the files.

Usage:
    uv run --no-project --with pyhelios3d --with pillow python examples/helios_plants.py --out foreign --count 12
    maniskill-tomato benchmark --plants foreign --policies lattice_oracle,view_quality,nbv
"""

import argparse
import importlib
import json
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Species:
    """What is drawn of one kind of plant."""

    label: str
    """Its name in the library of plants."""
    ages: tuple[float, float]
    """Range of ages at which it bears fruit, in days."""
    grown_radius: float
    """Half the width of a grown fruit, in [m]; smaller ones are less ripe."""


SPECIES = {
    "tomato": Species(label="tomato", ages=(108.0, 150.0), grown_radius=0.035),
    "cherry": Species(label="cherrytomato", ages=(162.0, 185.0), grown_radius=0.022),
    "capsicum": Species(label="capsicum", ages=(310.0, 400.0), grown_radius=0.055),
}

RIPE_FROM, TURNING_FROM = 0.8, 0.6
"""Size over that of a grown fruit from which a fruit counts as ripe, or as turning."""

FRUIT_HEIGHTS = (0.68, 0.88)
"""Range of the mean height of a plant's ripe fruits above the ground, in [m]; plants stand on a gutter."""

ATTEMPTS = 20
"""Plants drawn before it is given up that one bears a ripe fruit."""


def grow(helios: Any, architecture: Any, species: Species, age: float, seed: int) -> dict[str, Float64]:
    """The triangles of a plant by its organs' names, each of shape (F, 3, 3), in [m]."""
    with helios.Context() as context:
        context.seedRandomGenerator(seed)
        with architecture(context) as plants:
            plants.disableMessages()
            plants.loadPlantModelFromLibrary(species.label)
            origin = helios.types.vec3(0.0, 0.0, 0.0)
            plant = plants.buildPlantInstanceFromLibrary(base_position=origin, age=age)
            fruits = plants.getPlantFruitObjectIDs(plant)
            leaves = plants.getPlantLeafObjectIDs(plant)
            petioles = plants.getPlantPetioleObjectIDs(plant)
            others = set(plants.getAllPlantObjectIDs(plant)) - {*fruits, *leaves, *petioles}
            organs = _fruit_organs(context, fruits, species)
            stalks = [_triangles(context, number)[0] for number in petioles]
            blades = [_cut_out(context, number) for number in leaves]
            for k, parts in enumerate(_leaves(stalks, blades)):
                organs[f"leaf_{k:03d}"] = np.concatenate(parts)
            organs["stem"] = np.concatenate([_triangles(context, number)[0] for number in sorted(others)])
            return organs


def _fruit_organs(context: Any, fruits: list[int], species: Species) -> dict[str, Float64]:
    """Each fruit and its calyx, which is what of it is green."""
    organs = {}
    for k, number in enumerate(fruits):
        corners, colours, _ = _triangles(context, number)
        is_skin = colours[:, 0] > colours[:, 1]
        if not is_skin.any():
            continue
        skin = corners[is_skin]
        width = np.sort(np.ptp(skin.reshape(-1, 3), axis=0))[:2].mean()
        size = 0.5 * width / species.grown_radius
        ripeness = "ripe" if size >= RIPE_FROM else "turning" if size >= TURNING_FROM else "green"
        organs[f"fruit_{ripeness}_{k:02d}"] = skin
        if not is_skin.all():
            organs[f"stem_calyx_{k:02d}"] = corners[~is_skin]
    return organs


def _triangles(context: Any, number: int) -> tuple[Float64, Float64, list[int]]:
    """Corners (F, 3, 3), colours (F, 3) and numbers of the triangles of an object."""
    numbers = list(context.getObjectPrimitiveUUIDs(number))
    colours = np.asarray(context.getPrimitiveColor(numbers), dtype=np.float64)
    flat, offsets = context.getPrimitiveVertices(numbers)
    counts = np.diff(np.asarray(offsets, dtype=np.int64)) // 3
    points = np.asarray(flat, dtype=np.float64).reshape(-1, 3)
    first = np.cumsum(counts) - counts
    # A patch of four corners is two triangles.
    rows = np.concatenate([np.arange(len(numbers)), np.flatnonzero(counts == 4)])
    second = np.where(np.arange(len(rows)) < len(numbers), 1, 2)
    corners = np.stack(
        [points[first[rows]], points[first[rows] + second], points[first[rows] + second + 1]], 1
    )
    return corners, colours[rows], [numbers[row] for row in rows]


def _leaves(stalks: list[Float64], blades: list[Float64]) -> list[list[Float64]]:
    """Blades with the stalk that they stand on."""
    if not stalks:
        return [[blade] for blade in blades if len(blade)]
    # Every tenth corner: blades of one stalk are nearer to it than that is coarse.
    points = np.concatenate([stalk.reshape(-1, 3)[::10] for stalk in stalks])
    owner = np.concatenate([np.full(len(stalk.reshape(-1, 3)[::10]), k) for k, stalk in enumerate(stalks)])
    leaves = [[stalk] for stalk in stalks]
    for blade in blades:
        if len(blade):
            corners = blade.reshape(-1, 3)[::20]
            away = ((corners[:, None] - points) ** 2).sum(-1)
            leaves[owner[away.min(0).argmin()]].append(blade)
    return leaves


_alpha: dict[str, Float64] = {}
"""Alpha channels of textures by their files, 0 to 1."""


def _cut_out(context: Any, number: int) -> Float64:
    """The triangles of a leaf without what its texture leaves transparent. Shape (F, 3, 3)."""
    corners, _, numbers = _triangles(context, number)
    files = context.getPrimitiveTextureFile(numbers)
    solids = context.getPrimitiveSolidFraction(numbers)
    kept = []
    for triangle, uuid, file, solid in zip(corners, numbers, files, solids, strict=True):
        if not file or solid > 0.98:
            kept.append(triangle[None])
        elif solid > 0.02:
            uv = np.array([[p.x, p.y] for p in context.getPrimitiveTextureUV(uuid)])
            kept.append(_clipped(triangle, uv, _alpha_of(file)))
    return np.concatenate(kept) if kept else np.zeros((0, 3, 3))


def _alpha_of(file: str) -> Float64:
    if file not in _alpha:
        image = importlib.import_module("PIL.Image").open(file).convert("RGBA")
        _alpha[file] = np.asarray(image, dtype=np.float64)[..., 3] / 255.0
    return _alpha[file]


def _clipped(triangle: Float64, uv: Float64, alpha: Float64) -> Float64:
    """The part of a triangle where alpha is above a half, as triangles of shape (F, 3, 3).

    It is cut into four, and each of these along a straight line where alpha passes a half between its corners.
    """
    middles = np.array([[0.5, 0.5, 0.0], [0.0, 0.5, 0.5], [0.5, 0.0, 0.5]])
    weights = np.concatenate([np.eye(3), middles])
    points, places = weights @ triangle, weights @ uv
    rows, columns = alpha.shape
    row = np.clip(((1.0 - places[:, 1]) * (rows - 1)).round().astype(int), 0, rows - 1)
    column = np.clip((places[:, 0] * (columns - 1)).round().astype(int), 0, columns - 1)
    near = [alpha[max(r - 2, 0) : r + 3, max(c - 2, 0) : c + 3] for r, c in zip(row, column, strict=True)]
    inside = np.array([some.mean() for some in near]) - 0.5
    pieces = []
    for a, b, c in ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5)):
        polygon = []
        for i, j in ((a, b), (b, c), (c, a)):
            if inside[i] > 0.0:
                polygon.append(points[i])
            if (inside[i] > 0.0) != (inside[j] > 0.0):
                share = inside[i] / (inside[i] - inside[j])
                polygon.append(points[i] + share * (points[j] - points[i]))
        pieces += [[polygon[0], polygon[k], polygon[k + 1]] for k in range(1, len(polygon) - 1)]
    return np.array(pieces).reshape(-1, 3, 3)


def tended(organs: dict[str, Float64]) -> dict[str, Float64]:
    """The plant without the fruits that hang below its lowest leaf, which a grower has picked."""
    lowest = min(corners[..., 2].min() for name, corners in organs.items() if name.startswith("leaf"))
    picked = {
        name.rsplit("_", 1)[1]
        for name, corners in organs.items()
        if name.startswith("fruit") and corners[..., 2].mean() < lowest
    }
    return {
        name: corners
        for name, corners in organs.items()
        if not (name.startswith(("fruit", "stem_calyx")) and name.rsplit("_", 1)[1] in picked)
    }


def lifted(organs: dict[str, Float64], height: float) -> tuple[dict[str, Float64], float]:
    """The plant with its ripe fruits at a mean height, and how far it was lifted. All in [m].

    Where that is down, as growers lower the stems of a high-wire crop, what would be in the ground is left out.
    """
    ripe = [corners[..., 2].mean() for name, corners in organs.items() if name.startswith("fruit_ripe")]
    lift = height - float(np.mean(ripe))
    moved = {name: corners + np.array([0.0, 0.0, lift]) for name, corners in organs.items()}
    above = {name: corners[corners[..., 2].min(1) >= 0.0] for name, corners in moved.items()}
    return {name: corners for name, corners in above.items() if len(corners)}, lift


def main() -> None:
    """Grows what is missing of a set."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="folder of the set")
    parser.add_argument("--split", default="held_out", choices=("train", "validation", "held_out"))
    parser.add_argument("--count", type=int, default=12, help="how many plants, in turn of each species")
    parser.add_argument("--species", nargs="+", default=list(SPECIES), choices=list(SPECIES))
    parser.add_argument("--seed", type=int, default=0, help="draws ages, heights and plants")
    args = parser.parse_args()
    if args.count < 1:
        sys.exit(f"error: --count must be 1 or more, got {args.count}")
    try:
        helios = importlib.import_module("pyhelios")
        architecture = importlib.import_module("pyhelios").PlantArchitecture
        importlib.import_module("pyhelios.types")
        importlib.import_module("PIL.Image")
    except ImportError as error:
        sys.exit(
            f"error: {error}; run this script in an environment of its own that has pyhelios3d and pillow: "
            "`uv run --no-project --with pyhelios3d --with pillow python examples/helios_plants.py ...`"
        )
    folder = args.out / args.split
    folder.mkdir(parents=True, exist_ok=True)
    log = args.out / f"plants_{args.split}.json"
    told: list[dict[str, Any]] = json.loads(log.read_text()) if log.is_file() else []
    for number in range(args.count):
        kind = args.species[number % len(args.species)]
        path = folder / f"{kind}_{args.seed}_{number:03d}.npz"
        if path.is_file():
            continue
        species = SPECIES[kind]
        rng = np.random.default_rng([args.seed, number])
        for _ in range(ATTEMPTS):
            age, seed = round(float(rng.uniform(*species.ages)), 1), int(rng.integers(1, 2**31))
            organs = tended(grow(helios, architecture, species, age, seed))
            if any(name.startswith("fruit_ripe") for name in organs):
                break
        else:
            sys.exit(f"error: none of {ATTEMPTS} plants of {kind} bears a ripe fruit")
        organs, lift = lifted(organs, float(rng.uniform(*FRUIT_HEIGHTS)))
        arrays: dict[str, Any] = {name: corners.astype(np.float32) for name, corners in organs.items()}
        np.savez_compressed(path, **arrays)
        fruits = sum(name.startswith("fruit_ripe") for name in organs)
        triangles = sum(len(corners) for corners in organs.values())
        told.append(
            {"file": path.name, **asdict(species), "age": age, "seed": seed, "lift": round(lift, 4)}
            | {"ripe_fruits": fruits, "triangles": triangles}
        )
        log.write_text(json.dumps(told, indent=1) + "\n")
        print(f"{path}: {age} days, {fruits} ripe fruits, {triangles} triangles", flush=True)


if __name__ == "__main__":
    main()
