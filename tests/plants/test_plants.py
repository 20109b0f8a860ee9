"""Generated tomato plants: counts, shape, determinism, botany, and how leaves hide fruits."""

import ast
import dataclasses
import hashlib
import inspect
import itertools
import textwrap
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.fruit import classify
from maniskill_tomato.plants.generator import generate_plant
from maniskill_tomato.plants.kinds import config_of
from maniskill_tomato.plants.materials import MATERIALS
from maniskill_tomato.plants.organs import Organ, Plant, SemanticClass, with_fruit_at
from maniskill_tomato.plants.plant_config import (
    PRESETS,
    FlowerConfig,
    FruitConfig,
    HidingConfig,
    LeafConfig,
    PlantConfig,
    StemConfig,
    TrussConfig,
    make_full_config,
)
from maniskill_tomato.plants.stem import grow_shoot

Float64 = NDArray[np.float64]
PINNED = [
    (
        "one_tomato",
        "00f5e1aa03f3627a",
        [[-0.000581, 0.011778, 1.080807], [0.10333, 0.117541, 0.247201], [-8.9e-05, -7.4e-05, -9.6e-05]],
    ),
    (
        "three_tomatoes",
        "d5523314b9375d3c",
        [[-0.011689, -7.1e-05, 0.983049], [0.089913, 0.113061, 0.255133], [-0.000248, 2.1e-05, 0.000433]],
    ),
    (
        "full",
        "f577eae6fa89b3f2",
        [[-0.037764, -0.009512, 0.890282], [0.119106, 0.113106, 0.330285], [1e-06, 4.1e-05, 0.000177]],
    ),
]
"""Seed 3 at training detail: checksum of the triangles, then `moments` of the vertices in [m]. They change only when
the plants do."""
DENSEST = (47, 50, 121, 58)
FRUIT_CLASSES = {
    "ripe": SemanticClass.FRUIT_RIPE,
    "turning": SemanticClass.FRUIT_TURNING,
    "green": SemanticClass.FRUIT_GREEN,
}


@cache
def grown(preset: str, seed: int, *arguments: Any, **options: Any) -> Plant:
    """A plant that several tests look at."""
    return generate_plant(preset, seed, *arguments, **options)


def organs_of(plant: Plant, prefix: str) -> list[Organ]:
    return [organ for organ in plant.organs if organ.name.startswith(prefix)]


def triangle_checksum(plant: Plant) -> str:
    """Of whole numbers alone: those that a processor does not round."""
    numbers = plant.faces.astype("<i4").tobytes() + plant.organ_of_face.astype("<i4").tobytes()
    return hashlib.sha256(numbers).hexdigest()[:16]


def moments(plant: Plant) -> Float64:
    """Mean, standard deviation and a mean with alternating weights of the vertices, in [m]. Shape (3, 3)."""
    vertices = plant.vertices.astype(np.float64)
    weights = np.cos(np.arange(len(vertices)))[:, None]
    return np.stack((vertices.mean(axis=0), vertices.std(axis=0), (weights * vertices).mean(axis=0)))


def triangle_areas(vertices: NDArray[np.float32], faces: NDArray[np.int32]) -> Float64:
    corners = vertices.astype(np.float64)[faces]
    return np.asarray(
        0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    )


def leaf_area(plant: Plant) -> float:
    return float(sum(triangle_areas(o.vertices, o.faces).sum() for o in organs_of(plant, "leaf_")))


def first_hits(origin: Float64, directions: Float64, triangles: Float64) -> Float64:
    """Distance to the first of some triangles along each ray, infinite for a miss: every ray against every triangle."""
    v0, e1, e2 = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    offset = origin - v0
    q = np.cross(offset, e1)
    nearest = np.full(len(directions), np.inf)
    for i, direction in enumerate(directions):
        h = np.cross(direction, e2)
        determinant = (e1 * h).sum(1)
        safe = np.where(np.abs(determinant) < 1e-15, np.inf, determinant)
        u, v, t = (offset * h).sum(1) / safe, (q @ direction) / safe, (e2 * q).sum(1) / safe
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-6)
        if hit.any():
            nearest[i] = t[hit].min()
    return nearest


def visible_fraction(plant: Plant, fruit_index: int, eye: Float64, rays: int = 48) -> float:
    """Share of a fruit's silhouette that is seen from a point, by brute force."""
    fruit = plant.fruits[fruit_index]
    triangles = plant.vertices.astype(np.float64)[plant.faces]
    own = plant.organ_of_face == fruit.organ_index
    centre = fruit.centre.astype(np.float64)
    axis = (centre - eye) / np.linalg.norm(centre - eye)
    across = np.cross(axis, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    up = np.cross(across, axis)
    k = np.arange(rays) + 0.5
    r, turn = fruit.radius * np.sqrt(k / rays), k * 2.399963
    aims = centre + (r * np.cos(turn))[:, None] * across + (r * np.sin(turn))[:, None] * up
    directions = (aims - eye) / np.linalg.norm(aims - eye, axis=1, keepdims=True)
    on_fruit = first_hits(eye, directions, triangles[own])
    silhouette = np.isfinite(on_fruit)
    others = first_hits(eye, directions[silhouette], triangles[~own])
    return float((on_fruit[silhouette] <= others).mean())


def eye_at(
    plant: Plant, fruit_index: int, azimuth_deg: float, elevation_deg: float, distance: float
) -> Float64:
    """A camera position seen from a fruit; azimuth 0 is the robot's side (-x), positive towards +y."""
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    direction = np.array(
        [-np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    return np.asarray(plant.fruits[fruit_index].centre.astype(np.float64) + distance * direction)


@pytest.mark.parametrize(("preset", "count"), [("one_tomato", 1), ("three_tomatoes", 3)])
def test_plants_of_the_thesis_carry_their_ripe_fruits_on_the_robots_side(preset: str, count: int) -> None:
    for seed in range(10):
        plant = grown(preset, seed)
        assert len(plant.fruits) == count
        assert {fruit.ripeness for fruit in plant.fruits} == {"ripe"}
        for fruit in plant.fruits:
            assert -0.14 < fruit.centre[0] < -0.03
            assert abs(fruit.centre[1]) < 0.11


def test_one_tomato_hangs_where_the_arm_works() -> None:
    heights = [float(grown("one_tomato", seed).fruits[0].centre[2]) for seed in range(20)]
    assert min(heights) > 0.68 and max(heights) < 0.87
    assert np.ptp(heights) > 0.05


def test_three_tomatoes_hang_at_clearly_different_heights() -> None:
    for seed in range(10):
        heights = [float(fruit.centre[2]) for fruit in grown("three_tomatoes", seed).fruits]
        np.testing.assert_allclose(heights, [0.62, 0.80, 0.98], atol=0.06)
        assert np.diff(heights).min() > 0.12


def test_full_plants_carry_every_ripeness_and_ripen_from_below() -> None:
    order = {"green": 0, "turning": 1, "ripe": 2}
    for seed in range(6):
        plant = grown("full", seed)
        assert len(plant.fruits) == sum(make_full_config().fruits_per_truss)
        assert {fruit.ripeness for fruit in plant.fruits} == set(order)
        lower, upper = plant.fruits[:6], plant.fruits[-6:]
        assert min(order[f.ripeness] for f in lower) > max(order[f.ripeness] for f in upper)
        assert max(f.centre[2] for f in lower) < min(f.centre[2] for f in upper)
        assert len(organs_of(plant, "leaf_")) >= 11


@pytest.mark.parametrize("preset", PRESETS)
def test_training_plants_stay_under_the_triangle_budget(preset: str) -> None:
    counts = [len(grown(preset, seed).faces) for seed in range(20)]
    assert max(counts) < 15_000
    assert min(counts) > 3_000


def test_the_densest_full_plants_stay_under_the_triangle_budget() -> None:
    # The seeds with the most triangles among the first 300.
    assert max(len(grown("full", seed).faces) for seed in DENSEST) < 15_000


@pytest.mark.parametrize("preset", PRESETS)
def test_the_same_seed_gives_the_same_plant_and_another_seed_another(preset: str) -> None:
    first, again, other = (generate_plant(preset, seed) for seed in (5, 5, 6))
    for a, b in zip(first.organs, again.organs, strict=True):
        assert a.name == b.name
        for part, same in zip(a.parts, b.parts, strict=True):
            assert part.material == same.material
            for field in ("vertices", "normals", "uvs", "faces"):
                np.testing.assert_array_equal(getattr(part, field), getattr(same, field))
    np.testing.assert_array_equal(first.vertices, again.vertices)
    assert triangle_checksum(first) == triangle_checksum(again)
    assert np.abs(moments(first) - moments(other)).max() > 1e-3


@pytest.mark.parametrize(("preset", "triangles", "expected"), PINNED)
def test_a_seed_gives_this_plant_on_every_machine(
    preset: str, triangles: str, expected: list[list[float]]
) -> None:
    plant = grown(preset, 3)
    assert triangle_checksum(plant) == triangles
    # Expected to 1e-6 m; processors round the vertices of a plant to 1e-7 m, each in its own way.
    np.testing.assert_allclose(moments(plant), expected, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("preset", PRESETS)
def test_the_picture_level_is_the_same_plant_with_more_triangles(preset: str) -> None:
    coarse, fine = grown(preset, 2, "training"), grown(preset, 2, "picture")
    assert len(fine.faces) > 5 * len(coarse.faces)
    assert [o.name for o in coarse.organs] == [o.name for o in fine.organs]
    assert [o.semantic_class for o in coarse.organs] == [o.semantic_class for o in fine.organs]
    for a, b in zip(coarse.fruits, fine.fruits, strict=True):
        np.testing.assert_array_equal(a.centre, b.centre)
        assert a.ripeness == b.ripeness
        assert abs(a.radius - b.radius) < 0.002
    for x, y in zip(coarse.organs, fine.organs, strict=True):
        np.testing.assert_allclose(x.vertices.min(0), y.vertices.min(0), atol=0.03)
        np.testing.assert_allclose(x.vertices.max(0), y.vertices.max(0), atol=0.03)


@pytest.mark.parametrize("preset", PRESETS)
def test_organs_have_unique_names_and_the_class_of_their_kind(preset: str) -> None:
    plant = grown(preset, 1)
    names = [organ.name for organ in plant.organs]
    assert len(set(names)) == len(names)
    assert names[0] == "stem"
    kinds = {"stem": SemanticClass.STEM, "leaf": SemanticClass.LEAF, "truss": SemanticClass.STEM}
    fruits = {fruit.organ_index: fruit for fruit in plant.fruits}
    for index, organ in enumerate(plant.organs):
        kind = organ.name.split("_")[0]
        if kind == "fruit":
            assert organ.semantic_class == FRUIT_CLASSES[fruits[index].ripeness]
        else:
            assert organ.semantic_class == kinds[kind]
    assert [plant.organs[f.organ_index].name for f in plant.fruits] == [
        f"fruit_{i:02d}" for i in range(len(plant.fruits))
    ]


@pytest.mark.parametrize("detail", ["training", "picture"])
@pytest.mark.parametrize("preset", PRESETS)
def test_meshes_are_valid(preset: str, detail: str) -> None:
    plant = grown(preset, 4, "training" if detail == "training" else "picture")
    for organ in plant.organs:
        for part in organ.parts:
            assert part.material in MATERIALS
            assert part.vertices.dtype == part.normals.dtype == part.uvs.dtype == np.float32
            assert part.faces.dtype == np.int32
            assert part.vertices.shape == part.normals.shape == (len(part.uvs), 3)
            assert part.faces.min() >= 0 and part.faces.max() < len(part.vertices)
            assert np.isfinite(part.vertices).all()
            np.testing.assert_allclose(np.linalg.norm(part.normals, axis=1), 1.0, atol=2e-3)
            assert triangle_areas(part.vertices, part.faces).min() > 0
    assert plant.vertices[:, 2].min() > -0.02 and plant.vertices[:, 2].max() < 1.75
    assert np.abs(plant.vertices[:, :2]).max() < 0.65


@pytest.mark.parametrize("detail", ["training", "picture"])
def test_fruits_are_closed_outward_and_inside_their_radius(detail: str) -> None:
    plant = grown("full", 7, "training" if detail == "training" else "picture")
    for fruit in plant.fruits:
        organ = plant.organs[fruit.organ_index]
        mesh = trimesh.Trimesh(organ.vertices, organ.faces, process=True)
        assert mesh.is_watertight and mesh.is_winding_consistent
        ball = 4 / 3 * np.pi * fruit.radius**3
        assert 0.6 * ball < mesh.volume < ball
        away = np.linalg.norm(organ.vertices.astype(np.float64) - fruit.centre, axis=1)
        assert fruit.radius - 5e-6 < away.max() <= fruit.radius
        assert 0.015 < fruit.radius < 0.04


def test_normals_point_to_the_side_from_which_a_triangle_is_seen() -> None:
    plant = grown("full", 0)
    for organ in plant.organs:
        for part in organ.parts:
            corners = part.vertices.astype(np.float64)[part.faces]
            facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            shading = part.normals.astype(np.float64)[part.faces].mean(1)
            agree = (facing * shading).sum(1) > 0
            assert agree.mean() > 0.93, (organ.name, part.material, agree.mean())


def test_leaflets_have_both_sides() -> None:
    for organ in organs_of(grown("full", 0), "leaf_"):
        upper, under = organ.parts[1:]
        assert upper.material.startswith("leaf_upper") and under.material.startswith("leaf_under")
        np.testing.assert_array_equal(upper.vertices, under.vertices)
        np.testing.assert_array_equal(upper.faces[:, ::-1], under.faces)


def test_divergence_angles_follow_the_measured_phyllotaxis() -> None:
    steps = []
    for seed in range(60):
        shoot = grow_shoot(make_full_config(), seed)
        step = np.degrees(np.diff(shoot.azimuths))
        # Either handedness occurs, but never both on one plant.
        assert (step > 0).all() or (step < 0).all()
        steps.append(step)
    angles = np.abs(np.concatenate(steps))
    assert len(angles) > 1000
    assert abs(angles.mean() - 135.3) < 1.0
    assert 119.3 - 1e-6 <= angles.min() and angles.max() <= 154.7 + 1e-6
    assert 0.3 < np.mean([step[0] > 0 for step in steps]) < 0.7


def test_internodes_and_trusses_follow_the_sympodial_order() -> None:
    config = make_full_config()
    lengths = []
    for seed in range(30):
        shoot = grow_shoot(config, seed)
        assert np.diff(shoot.truss_nodes).tolist() == [3] * (len(config.fruits_per_truss) - 1)
        lengths.append(np.diff(shoot.heights)[shoot.truss_nodes[0] :])
    mean = float(np.concatenate(lengths).mean())
    assert 0.069 < mean < 0.073


def test_petioles_leave_the_stem_at_the_measured_angle() -> None:
    angles = []
    for seed in range(8):
        plant = grown("full", seed)
        for organ in organs_of(plant, "leaf_")[:6]:
            petiole = organ.parts[0].vertices.astype(np.float64).reshape(-1, 3)
            # Five vertices a ring; the first and last of a ring coincide.
            start, later = petiole[:4].mean(0), petiole[5:9].mean(0)
            direction = (later - start) / np.linalg.norm(later - start)
            angles.append(np.degrees(np.arccos(direction[2])))
    assert abs(np.mean(angles) - 59.0) < 6.0


def test_fruits_hang_below_their_truss_and_clear_of_each_other() -> None:
    for seed in range(6):
        plant = grown("full", seed)
        tops = {o.name: float(o.vertices[:, 2].max()) for o in organs_of(plant, "truss_")}
        counts = make_full_config().fruits_per_truss
        owner = [f"truss_{k:02d}" for k, n in enumerate(counts) for _ in range(n)]
        for fruit, truss in zip(plant.fruits, owner, strict=True):
            assert fruit.centre[2] < tops[truss]
        centres = np.stack([fruit.centre for fruit in plant.fruits]).astype(np.float64)
        radii = np.array([fruit.radius for fruit in plant.fruits])
        apart = np.linalg.norm(centres[:, None] - centres[None], axis=-1) - 0.80 * (radii[:, None] + radii)
        assert apart[~np.eye(len(radii), dtype=bool)].min() > 0


def test_a_calyx_sits_on_top_of_its_fruit() -> None:
    plant = grown("one_tomato", 3)
    fruit = plant.fruits[0]
    (truss,) = organs_of(plant, "truss_")
    calyx = next(part for part in truss.parts if part.material == "calyx").vertices - fruit.centre
    assert np.linalg.norm(calyx[:, :2].mean(0)) < 0.012
    assert calyx[:, 2].min() > -0.2 * fruit.radius
    assert np.linalg.norm(calyx, axis=1).min() > 0.6 * fruit.radius


@pytest.mark.parametrize("preset", PRESETS)
def test_more_density_means_more_leaf_area_and_zero_means_none(preset: str) -> None:
    for seed in range(3):
        areas = [leaf_area(grown(preset, seed, leaf_density=d)) for d in (0.0, 0.3, 0.6, 1.0, 1.5, 2.0)]
        assert areas[0] == 0.0
        assert all(np.diff(areas) > 0), areas


def test_density_changes_neither_fruits_nor_stem_and_keeps_the_remaining_leaves() -> None:
    whole, thin = grown("full", 8), grown("full", 8, leaf_density=0.5)
    np.testing.assert_array_equal(whole.organs[0].vertices, thin.organs[0].vertices)
    for a, b in zip(whole.fruits, thin.fruits, strict=True):
        np.testing.assert_array_equal(a.centre, b.centre)
    rows = {
        tuple(v) for v in np.concatenate([o.parts[1].vertices for o in organs_of(whole, "leaf_")]).tolist()
    }
    kept = [tuple(v) for o in organs_of(thin, "leaf_") for v in o.parts[1].vertices.tolist()]
    assert set(kept) <= rows


def test_one_tomato_is_hidden_from_the_front_and_seen_whole_from_somewhere() -> None:
    front, best = [], []
    for seed in range(10):
        plant = grown("one_tomato", seed)
        front.append(visible_fraction(plant, 0, eye_at(plant, 0, 0.0, 0.0, 0.6)))
        views = [(a, e) for a in (-60.0, -45.0, 45.0, 60.0) for e in (-28.0, -12.0)]
        best.append(max(visible_fraction(plant, 0, eye_at(plant, 0, a, e, 0.35)) for a, e in views))
    assert np.mean(front) < 0.3, front
    assert np.mean(np.array(front) < 0.4) >= 0.8, front
    assert np.mean(np.array(best) > 0.85) >= 0.9, best


def test_without_leaves_the_one_tomato_is_seen_from_the_front() -> None:
    plant = grown("one_tomato", 0, leaf_density=0.0)
    assert visible_fraction(plant, 0, eye_at(plant, 0, 0.0, 0.0, 0.6)) > 0.9


def test_ripeness_classes_change_at_their_thresholds() -> None:
    config = FruitConfig()
    assert classify(config, config.ripe_above) == "ripe"
    assert classify(config, config.ripe_above - 1e-9) == "turning"
    assert classify(config, config.turning_above) == "turning"
    assert classify(config, config.turning_above - 1e-9) == "green"


def test_an_unknown_preset_names_the_allowed_ones() -> None:
    with pytest.raises(InvalidInputError, match="'full', 'varied', 'other_kind'; got 'cherry'"):
        generate_plant("cherry")


@pytest.mark.parametrize("density", [-0.01, 4.01, float("nan"), float("inf")])
def test_a_density_out_of_range_is_refused(density: float) -> None:
    with pytest.raises(InvalidInputError, match="leaf_density must be a number from 0"):
        grown("full", 0, leaf_density=density)


def test_bad_seeds_and_details_are_refused() -> None:
    with pytest.raises(InvalidInputError, match="seed must be an integer of 0 or more"):
        generate_plant("full", -1)
    with pytest.raises(InvalidInputError, match="detail must be one of 'training', 'picture'"):
        generate_plant("full", 0, "finest")  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]


def test_configurations_refuse_contradictions() -> None:
    with pytest.raises(InvalidInputError, match="at least one fruit"):
        PlantConfig(fruits_per_truss=(0, 0))
    with pytest.raises(InvalidInputError, match="hiding needs fruit_heights"):
        PlantConfig(hiding=HidingConfig())
    with pytest.raises(InvalidInputError, match="fruit_heights needs one height per truss"):
        PlantConfig(fruits_per_truss=(2,), fruit_heights=(0.8,))
    with pytest.raises(InvalidInputError, match="must ascend"):
        PlantConfig(fruits_per_truss=(1, 1), fruit_heights=(0.9, 0.7))
    with pytest.raises(InvalidInputError, match="radius_range must be \\(low, high\\)"):
        FruitConfig(radius_range=(0.04, 0.03))
    with pytest.raises(InvalidInputError, match="StemConfig.height must be positive"):
        StemConfig(height=0.0)


def test_a_configuration_of_ones_own_grows() -> None:
    config = dataclasses.replace(config_of("full", 0), name="cluster", fruits_per_truss=(8,))
    plant = grown(config, 0)
    assert plant.preset == "cluster"
    assert len(plant.fruits) == 8


@pytest.mark.parametrize(
    "config",
    [StemConfig(), LeafConfig(), TrussConfig(), FlowerConfig(), FruitConfig(), HidingConfig(), PlantConfig()],
)
def test_the_plants_page_lists_every_parameter_with_its_default_and_meaning(
    config: StemConfig | LeafConfig | TrussConfig | FlowerConfig | FruitConfig | HidingConfig | PlantConfig,
) -> None:
    page = (Path(__file__).parents[2] / "docs" / "plants.md").read_text(encoding="utf-8")
    section = page.split(f"### {type(config).__name__}\n")[1].split("\n### ")[0]
    told = told_of(type(config))
    for item in dataclasses.fields(config):
        (row,) = [line for line in section.splitlines() if line.startswith(f"| `{item.name}` |")]
        value = getattr(config, item.name)
        if not dataclasses.is_dataclass(value):
            assert ast.literal_eval(row.split("`")[3]) == value
        assert row.split(" | ")[2].removesuffix(" |") == told[item.name]


def told_of(config: type) -> dict[str, str]:
    """What stands under each field of a config, in a line."""
    (kind,) = ast.parse(textwrap.dedent(inspect.getsource(config))).body
    assert isinstance(kind, ast.ClassDef)
    return {
        ast.unparse(item.target): " ".join(ast.literal_eval(note.value).split())
        for item, note in itertools.pairwise(kind.body)
        if isinstance(item, ast.AnnAssign) and isinstance(note, ast.Expr)
    }


@pytest.mark.parametrize("name", MATERIALS)
def test_base_colour_textures_are_opaque_and_made_the_same_each_time(name: str) -> None:
    material = MATERIALS[name]
    image = material.base_color
    assert image.dtype == np.uint8 and image.ndim == 3 and image.shape[2] == 4
    assert (image[..., 3] == 255).all()
    np.testing.assert_array_equal(image, material.paint())
    red, green = image[..., 0].astype(float).mean(), image[..., 1].astype(float).mean()
    assert red > 2 * green if name.startswith("fruit_ripe") else green > 0.4 * red
    if name.startswith(("object", "petal")):
        return  # Boards and strings have any colour, flowers are yellow.
    is_green = name.startswith(
        ("leaf_upper", "leaf_under", "petiole", "stem", "truss", "calyx", "fruit_green")
    )
    assert (green > red) == is_green


def test_a_fruit_that_is_hung_elsewhere_leaves_all_other_organs_where_they_were() -> None:
    plant = generate_plant("three_tomatoes")
    way = np.array([0.01, -0.02, 0.05], np.float32)
    moved = with_fruit_at(plant, 1, plant.fruits[1].centre + way)
    for index, (before, after) in enumerate(zip(plant.organs, moved.organs, strict=True)):
        shift = way if index == plant.fruits[1].organ_index else 0.0
        np.testing.assert_allclose(after.vertices, before.vertices + shift, atol=1e-6)
    for index, (old, new) in enumerate(zip(plant.fruits, moved.fruits, strict=True)):
        np.testing.assert_allclose(new.centre, old.centre + (way if index == 1 else 0.0), atol=1e-6)
    assert len(moved.faces) == len(plant.faces)
