"""Plants from files as `judge plants` tells them, against rays cast one view at a time."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from maniskill_tomato.experiments.mesh_judgement import (
    AZIMUTHS_DEG,
    ELEVATIONS_DEG,
    fixed_views,
    judge_meshes,
)
from maniskill_tomato.plants.mesh_plant import plant_from_mesh
from maniskill_tomato.plants.mesh_rules import MeshRules
from maniskill_tomato.plants.mesh_set import MeshSource
from maniskill_tomato.raycast.scene import RayScene
from maniskill_tomato.robot.d435 import color_intrinsics

CENTRE = (-0.1, 0.0, 0.7)


def make_set(folder: Path) -> Path:
    """A plant whose ripe fruit, a fine ball, hangs behind a lobed leaf of many triangles, and one without a leaf."""
    (folder / "validation").mkdir(parents=True)
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.03)
    disc = trimesh.creation.annulus(r_min=0.02, r_max=0.06, height=0.001, sections=180)
    disc.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0]))
    arrays: dict[str, Any] = {
        "stem": trimesh.creation.box((0.02, 0.02, 1.2)).apply_translation([0, 0, 0.6]).triangles,
        "fruit_0": ball.copy().apply_translation(CENTRE).triangles,
        "fruit_green_1": ball.copy().apply_translation([0, 0.1, 0.9]).triangles,
    }
    np.savez(folder / "validation" / "bare.npz", **arrays)
    leaf = disc.apply_translation([-0.2, 0.03, 0.7]).triangles
    np.savez(folder / "validation" / "leafy.npz", **arrays, leaf_0=leaf)
    return folder


def test_the_views_look_at_the_fruit_from_all_sides_of_the_robot() -> None:
    views = fixed_views(np.array(CENTRE)).numpy()
    assert views.shape == (len(AZIMUTHS_DEG) * len(ELEVATIONS_DEG), 4, 4)
    away = views[:, :3, 3] - np.array(CENTRE)
    np.testing.assert_allclose(np.linalg.norm(away, axis=1), 0.35, atol=1e-6)
    np.testing.assert_allclose(views[:, :3, 2], -away / 0.35, atol=1e-5)
    assert (away[:, 0] < 0).all()
    level_and_ahead = views[AZIMUTHS_DEG.index(0.0) * len(ELEVATIONS_DEG) + ELEVATIONS_DEG.index(0.0)]
    np.testing.assert_allclose(level_and_ahead[:3, 3], [-0.45, 0.0, 0.7], atol=1e-6)


def test_the_change_of_v_f_is_that_of_rays_cast_one_by_one(tmp_path: Path) -> None:
    folder = make_set(tmp_path / "set")
    text = judge_meshes(MeshSource.parse(folder), "all", 500, tmp_path / "out")
    bare, leafy = json.loads((tmp_path / "out" / "plants.json").read_text())
    assert (leafy["leaves"], leafy["fruits"], leafy["ripe"], leafy["split"]) == (1, 2, 1, "validation")
    assert bare["leaves"] == 0 and leafy["triangles"] > bare["triangles"] > leafy["kept"]
    assert max(bare["kept"], leafy["kept"]) <= 500

    path = folder / "validation" / "leafy.npz"
    values = []
    for rules in (MeshRules(), MeshRules(triangles=500)):
        plant = plant_from_mesh(path, rules)
        scene = RayScene([plant], color_intrinsics())
        views = fixed_views(plant_from_mesh(path, MeshRules()).fruits[0].centre)
        seen = [scene.visibility(view[None], torch.tensor([0]), torch.eye(4)[None]) for view in views]
        values.append(np.array([float(s.visible_fraction[0]) for s in seen]))
    changes = np.abs(values[0] - values[1])
    assert leafy["views"] == len(changes) == 28
    assert leafy["mean_change"] == pytest.approx(changes.mean(), abs=1e-6) and 0.0 < changes.mean() < 0.05
    assert leafy["largest_change"] == pytest.approx(changes.max(), abs=1e-6)
    assert leafy["crossed"] == int(((values[0] > 0.8) != (values[1] > 0.8)).sum())
    assert "At most 500 triangles a plant" in text and f"{leafy['kept']}" in text
    page = (tmp_path / "out" / "report.html").read_text()
    assert "At most 500 triangles a plant" in page and f"<td>{leafy['kept']}</td>" in page


def test_without_a_budget_plants_are_counted_alone(tmp_path: Path) -> None:
    folder = make_set(tmp_path / "set")
    text = judge_meshes(MeshSource.parse(folder), "validation", None, tmp_path / "out")
    assert "change" not in text and "| leafy | validation | 1 | 2 (1) |" in text
    assert all(row["views"] == 0 for row in json.loads((tmp_path / "out" / "plants.json").read_text()))
