"""Decimation keeps the budget, outlines of sheets and the shapes of bodies."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.decimation import decimated
from maniskill_tomato.plants.mesh_plant import plant_from_mesh
from maniskill_tomato.plants.mesh_rules import MeshRules
from maniskill_tomato.plants.spec import PlantSpec

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]


def sheet(cells: int, inside: Callable[[float, float], bool], bend: float = 0.0) -> tuple[Float64, Int64]:
    """A sheet of 10 cm side without the cells that are not inside, in [m]; bent about its diagonal."""
    at = np.arange(cells + 1) / cells
    x, y = (v.ravel() for v in np.meshgrid(at, at, indexing="ij"))
    vertices = 0.1 * np.stack([x, y, bend * (x + y) ** 2], 1)
    faces = []
    for i in range(cells):
        for j in range(cells):
            if inside((i + 0.5) / cells, (j + 0.5) / cells):
                a, b = i * (cells + 1) + j, (i + 1) * (cells + 1) + j
                faces += [[a, b, b + 1], [a, b + 1, a + 1]]
    return vertices, np.array(faces)


def angular(x: float, y: float) -> bool:
    return x < 0.5 or y < 0.5


def lobed(x: float, y: float) -> bool:
    angle = np.arctan2(y - 0.5, x - 0.5)
    return bool(np.hypot(x - 0.5, y - 0.5) < 0.36 + 0.12 * np.cos(5 * angle))


def area(vertices: Float64, faces: Int64) -> float:
    return float(trimesh.Trimesh(vertices, faces, process=False).area)


def outline(vertices: Float64, faces: Int64) -> list[tuple[Float64, Float64]]:
    """Edges that belong to one triangle, counted one by one."""
    count: dict[tuple[int, int], int] = {}
    for a, b, c in faces.tolist():
        for edge in ((a, b), (b, c), (c, a)):
            key = (min(edge), max(edge))
            count[key] = count.get(key, 0) + 1
    return [(vertices[a], vertices[b]) for (a, b), number in count.items() if number == 1]


def from_segment(point: Float64, a: Float64, b: Float64) -> float:
    along = float(np.clip((point - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0))
    return float(np.linalg.norm(point - a - along * (b - a)))


@pytest.mark.parametrize("budget", [200, 40, 12])
def test_a_flat_leaf_keeps_its_corners_and_its_area_with_a_few_triangles(budget: int) -> None:
    vertices, faces = sheet(20, angular)
    moved, left, kept = decimated(vertices, faces, budget)
    assert len(left) == len(kept) <= budget
    assert area(moved, left) == pytest.approx(0.0075, rel=1e-6)  # Three of four squares of 5 cm.
    corners = {tuple(np.round(v, 6) + 0.0) for v in moved[np.unique(left)]}
    for corner in ((0, 0), (0.1, 0), (0.1, 0.05), (0.05, 0.05), (0.05, 0.1), (0, 0.1)):
        assert (*corner, 0.0) in corners


def test_a_leaf_that_is_modelled_from_both_sides_keeps_its_outline_too() -> None:
    vertices, faces = sheet(20, angular)
    both = np.concatenate([faces, faces[:, ::-1]])
    moved, left, _ = decimated(vertices, both, 60)
    assert len(left) <= 60 and area(moved, left) == pytest.approx(0.015, rel=1e-6)


def test_the_outline_of_a_bent_lobed_leaf_moves_by_parts_of_a_millimetre() -> None:
    vertices, faces = sheet(40, lobed, bend=0.2)
    moved, left, _ = decimated(vertices, faces, len(faces) // 4)
    assert len(left) <= len(faces) // 4
    before, after = outline(vertices, faces), outline(moved, left)
    away = [min(from_segment(a, *edge) for edge in after) for a, _ in before]
    assert max(away) < 1e-3 and np.mean(away) < 1e-4
    # The library alone eats the outline up.
    plain = trimesh.Trimesh(vertices, faces).simplify_quadric_decimation(face_count=len(left))
    plain_edges = outline(np.asarray(plain.vertices), np.asarray(plain.faces))
    assert max(min(from_segment(a, *edge) for edge in plain_edges) for a, _ in before) > 2e-3


def test_a_ball_stays_closed_and_round() -> None:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.03)
    moved, left, kept = decimated(np.array(ball.vertices), np.array(ball.faces), 400)
    found = trimesh.Trimesh(moved, left, process=False)
    assert len(left) <= 400 and found.is_watertight
    assert found.volume == pytest.approx(4 / 3 * np.pi * 0.03**3, rel=0.02)
    np.testing.assert_allclose(np.linalg.norm(moved[np.unique(left)], axis=1), 0.03, atol=5e-4)
    # A triangle that is left is where it was, give or take what it grew.
    middles = np.array(ball.triangles_center)[kept]
    assert np.linalg.norm(moved[left].mean(1) - middles, axis=1).max() < 0.01


def test_a_surface_within_the_budget_stays_as_it_is() -> None:
    vertices, faces = sheet(4, angular)
    moved, left, kept = decimated(vertices, faces, len(faces))
    assert moved is vertices and left is faces and kept.tolist() == list(range(len(faces)))


def plant_file(path: Path) -> Path:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.03)
    stem = trimesh.creation.cylinder(radius=0.01, height=1.2, sections=24)
    vertices, faces = sheet(20, angular)
    leaf = vertices[faces]
    arrays: dict[str, Any] = {
        "stem": stem.apply_translation([0.0, 0.0, 0.6]).triangles,
        "fruit_00": ball.copy().apply_translation([-0.1, 0.0, 0.7]).triangles,
        "fruit_green_01": ball.copy().apply_translation([0.0, 0.1, 0.8]).triangles,
    } | {f"leaf_{k}": leaf + [0.0, 0.1 * k, 0.4] for k in range(3)}
    np.savez(path, **arrays)
    return path


def test_a_plant_keeps_its_organs_within_the_budget(tmp_path: Path) -> None:
    path = plant_file(tmp_path / "vine.npz")
    whole, small = (plant_from_mesh(path, MeshRules(triangles=n)) for n in (None, 900))
    assert 0.9 * 900 <= len(small.faces) <= 900 < len(whole.faces)
    assert [organ.name for organ in small.organs] == [organ.name for organ in whole.organs]
    for ours, theirs in zip(small.fruits, whole.fruits, strict=True):
        assert np.linalg.norm(ours.centre - theirs.centre) < 5e-4
        assert ours.radius == pytest.approx(theirs.radius, abs=1e-3)
    leaves = [organ for organ in small.organs if organ.name.startswith("leaf")]
    for leaf in leaves:
        assert area(leaf.vertices.astype(np.float64), leaf.faces.astype(np.int64)) == pytest.approx(0.0075)
        assert leaf.parts[0].two_sided
    again = plant_from_mesh(path, MeshRules(triangles=900))
    np.testing.assert_array_equal(again.vertices, small.vertices)


def test_a_bud_beside_large_leaves_stays(tmp_path: Path) -> None:
    path = plant_file(tmp_path / "vine.npz")
    vertices, faces = sheet(2, angular)
    with np.load(path) as found:
        arrays: dict[str, Any] = dict(found) | {"leaf_bud": 0.01 * vertices[faces] + [0.0, 0.0, 1.0]}
    np.savez(path, **arrays)
    plant = plant_from_mesh(path, MeshRules(triangles=600))
    bud = next(organ for organ in plant.organs if organ.name == "leaf_bud")
    assert len(plant.faces) <= 600
    assert len(bud.faces) >= 4 and np.ptp(bud.vertices[:, 0]) == pytest.approx(0.001, abs=2e-6)


def test_a_budget_below_what_shapes_need_is_refused(tmp_path: Path) -> None:
    pieces = {
        f"leaf_{k}": np.array([[[0, 0, 0.01 * k], [0.01, 0, 0.01 * k], [0, 0.01, 0.01 * k]]])
        for k in range(600)
    }
    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.03)
    arrays: dict[str, Any] = {**pieces, "fruit": ball.triangles}
    np.savez(tmp_path / "bits.npz", **arrays)
    with pytest.raises(
        InvalidInputError,
        match=r"bits.npz has 680 triangles and cannot be decimated to triangles=500: its shapes need 6",
    ):
        plant_from_mesh(tmp_path / "bits.npz", MeshRules(triangles=500))


@pytest.mark.parametrize("wrong", [0, 499, -5, 1000.0, True, "many"])
def test_a_budget_that_is_none_is_refused_before_a_file_is_read(tmp_path: Path, wrong: object) -> None:
    (tmp_path / "broken.npz").write_bytes(b"no mesh")
    with pytest.raises(InvalidInputError, match=r"triangles must be a whole number of 500 or more, .*; got "):
        PlantSpec.parse({"mesh": tmp_path / "broken.npz", "triangles": wrong}, PlantSpec())
