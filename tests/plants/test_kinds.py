"""Plants of many kinds: what is drawn, and that it grows."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.generator import generate_plant
from maniskill_tomato.plants.kinds import KINDS, LEAST_BEYOND, TRAITS, draw_kind, draw_traits
from maniskill_tomato.plants.organs import Plant, SemanticClass
from maniskill_tomato.plants.plant_config import PlantConfig, StemConfig
from maniskill_tomato.plants.spec import ROW_PLANT, PlantSpec

SEEDS = range(1_000_000, 1_000_300)


def leaves(plant: Plant) -> int:
    return sum(organ.semantic_class is SemanticClass.LEAF for organ in plant.organs)


def test_what_is_learnt_and_what_lies_beyond_do_not_overlap() -> None:
    for trait in TRAITS:
        low, high = trait.learnt
        assert low < high
        assert all(b <= low or a >= high for a, b in trait.beyond), trait.name


def test_plants_to_learn_on_have_every_trait_in_its_range_and_fill_it() -> None:
    drawn = [draw_traits(seed) for seed in SEEDS]
    for trait in TRAITS:
        values = np.array([traits[trait.name] for traits in drawn])
        low, high = trait.learnt
        assert low <= values.min() and values.max() <= high
        assert values.min() < low + 0.05 * (high - low) and values.max() > high - 0.05 * (high - low)


def test_other_kinds_have_traits_that_nothing_learnt() -> None:
    counts = []
    for seed in SEEDS:
        traits = draw_traits(seed, is_other=True)
        outside = [t for t in TRAITS if not t.learnt[0] <= traits[t.name] <= t.learnt[1]]
        assert all(any(a <= traits[t.name] <= b for a, b in t.beyond) for t in outside)
        counts.append(len(outside))
    assert min(counts) >= LEAST_BEYOND
    assert len(set(counts)) > 3


@pytest.mark.parametrize("preset", KINDS)
def test_a_plant_of_any_kind_is_sound_and_the_same_each_time(preset: str) -> None:
    for seed in (0, 5):
        plant = generate_plant(preset, seed)
        np.testing.assert_array_equal(plant.vertices, generate_plant(preset, seed).vertices)
        assert plant.preset == preset and len({organ.name for organ in plant.organs}) == len(plant.organs)
        assert np.isfinite(plant.vertices).all() and plant.faces.max() < len(plant.vertices)
        for fruit in plant.fruits:
            skin = plant.organs[fruit.organ_index]
            away = np.linalg.norm(skin.vertices - fruit.centre, axis=1)
            assert away.max() <= fruit.radius + 1e-6


def test_a_bush_has_several_shoots_that_lean_apart() -> None:
    plant = generate_plant(PlantConfig(shoots=3, fruits_per_truss=(2, 1)), 4)
    stems = [organ for organ in plant.organs if organ.name.endswith("/stem")]
    assert len(stems) == 3
    tips = np.array([stem.vertices[stem.vertices[:, 2].argmax()] for stem in stems])
    apart = np.linalg.norm(tips[:, None, :2] - tips[None, :, :2], axis=-1)
    assert apart[~np.eye(3, dtype=bool)].min() > 0.1
    assert all(plant.organs[f.organ_index].name.split("/")[1].startswith("fruit") for f in plant.fruits)


def test_density_wilting_and_clutter_do_what_they_say() -> None:
    plain = generate_plant(PlantConfig(), 2)
    dense = generate_plant(PlantConfig(leaf_density=4.0), 2)
    assert leaves(dense) == 4 * leaves(plain)
    dying = generate_plant(PlantConfig(wilted_share=1.0), 2)
    materials = {part.material for organ in dying.organs for part in organ.parts if "leaf" in part.material}
    assert materials and all("wilted" in material for material in materials)
    cluttered = generate_plant(PlantConfig(clutter=7), 2)
    things = [organ for organ in cluttered.organs if organ.semantic_class is SemanticClass.OBJECT]
    assert len(things) == 7 and len(cluttered.organs) == len(plain.organs) + 7
    assert min(organ.vertices[:, 2].min() for organ in things) > -0.2


def test_flowers_stand_above_the_fruits_and_change_nothing_else() -> None:
    config = PlantConfig(stem=StemConfig(height=2.0), fruits_per_truss=(4, 3))
    plain = generate_plant(config, 5, "picture")
    flowering = generate_plant(dataclasses.replace(config, flowering_trusses=2), 5, "picture")
    flowers = [organ for organ in flowering.organs if organ.name.startswith("flowers")]

    assert len(flowers) == 2
    assert all(organ.semantic_class is SemanticClass.STEM for organ in flowers)
    fruits = [plain.organs[fruit.organ_index] for fruit in plain.fruits]
    assert min(f.vertices[:, 2].min() for f in flowers) > max(f.vertices[:, 2].max() for f in fruits)
    for before, after in zip(plain.organs, flowering.organs, strict=False):
        assert before.name == after.name
        np.testing.assert_array_equal(before.vertices, after.vertices)
    for organ in flowers:
        (petals,) = [part for part in organ.parts if part.material == "petal"]
        normals, faces = petals.normals, petals.faces
        assert np.allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-3)
        a, b, c = (petals.vertices[faces[:, k]].astype(float) for k in range(3))
        across = np.cross(b - a, c - a)
        inside = np.linalg.norm(across, axis=1) > 1e-12
        turned = (across * normals[faces].mean(1)).sum(1)[inside] > 0
        assert turned.mean() > 0.98


def test_a_stem_that_is_too_short_bears_no_flowers() -> None:
    names = [organ.name for organ in generate_plant(PlantConfig(flowering_trusses=4), 0).organs]
    assert not any(name.startswith("flowers") for name in names)


def test_a_task_takes_the_density_of_the_kind_unless_another_is_asked_for() -> None:
    assert PlantSpec.parse("varied", ROW_PLANT).leaf_density is None
    assert PlantSpec.parse({"preset": "other_kind"}, ROW_PLANT).leaf_density is None
    assert PlantSpec.parse({"preset": "varied", "leaf_density": 1.0}, ROW_PLANT).leaf_density == 1.0
    assert PlantSpec.parse({"preset": "full"}, ROW_PLANT).leaf_density == ROW_PLANT.leaf_density
    assert draw_kind(7).leaf_density != draw_kind(8).leaf_density


@pytest.mark.parametrize(
    ("field", "value"),
    [("shoots", 0), ("shoots", 9), ("wilted_share", 1.5), ("clutter", -1), ("flowering_trusses", 5)],
)
def test_a_number_out_of_range_is_named(field: str, value: Any) -> None:
    with pytest.raises(InvalidInputError, match=field):
        dataclasses.replace(PlantConfig(), **{field: value})


def test_the_plants_page_lists_every_trait_with_its_ranges() -> None:
    page = (Path(__file__).parents[2] / "docs" / "plants.md").read_text(encoding="utf-8")
    page = page.split("## Plants of many kinds\n")[1].split("\n## ")[0]
    for trait in TRAITS:
        (row,) = [line for line in page.splitlines() if line.startswith(f"| `{trait.name}` |")]
        learnt, beyond = (
            ", ".join(f"{low:g} to {high:g}" for low, high in ranges)
            for ranges in ([trait.learnt], trait.beyond)
        )
        assert row.split("|")[2:4] == [f" {learnt} ", f" {beyond} "]
