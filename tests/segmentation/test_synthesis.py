"""Rendered data sets: the parts as functions with known answers, and a small data set where a renderer is there."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh

from maniskill_tomato.cli import main, parse
from maniskill_tomato.cli.image_commands import Dataset
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.generator import generate_plant
from maniskill_tomato.robot.d435 import (
    CameraIntrinsics,
    color_intrinsics,
    depth_intrinsics,
    depth_noise_std,
    min_depth,
)
from maniskill_tomato.robot.depth_noise import DepthNoise, measure_depth
from maniskill_tomato.segmentation.datasets.annotations import BEHIND
from maniskill_tomato.segmentation.synthesis.appearance import draw_appearance
from maniskill_tomato.segmentation.synthesis.dataset_rendering import DatasetConfig, _numbers, make_dataset
from maniskill_tomato.segmentation.synthesis.silhouette import draw_silhouette

CAMERA = color_intrinsics(320, 240)
QUIET = DepthNoise(subpixel_rms=0.0, flying_share=0.0, hole_share=0.0)


def sphere(centre: tuple[float, float, float], radius: float) -> tuple[Any, Any]:
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    return np.asarray(mesh.vertices) + np.array(centre), np.asarray(mesh.faces)


def test_a_silhouette_counts_the_pixels_of_a_sphere() -> None:
    vertices, faces = sphere((0.01, -0.02, 0.4), 0.03)
    found = draw_silhouette(vertices, faces, CAMERA)
    assert found is not None
    # A pixel belongs to the sphere if the ray through its centre comes nearer to the sphere's centre than its radius.
    rays = CAMERA.ray_directions(CAMERA.pixel_centres())
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    centre = np.array([0.01, -0.02, 0.4])
    away = np.linalg.norm(centre - (rays @ centre)[..., None] * rays, axis=-1)
    expected = away < 0.03
    drawn = found.in_image(CAMERA.width, CAMERA.height)
    assert found.total == pytest.approx(expected.sum(), rel=0.01)
    assert np.count_nonzero(drawn != expected) < 0.02 * expected.sum()


def test_a_silhouette_goes_on_outside_the_image() -> None:
    vertices, faces = sphere((0.0, 0.0, 0.4), 0.03)
    middle = draw_silhouette(vertices, faces, CAMERA)
    shifted = CameraIntrinsics(width=320, height=240, fx=CAMERA.fx, fy=CAMERA.fy, cx=0.0, cy=120.0)
    edge = draw_silhouette(vertices, faces, shifted)
    assert middle is not None and edge is not None
    assert edge.total == pytest.approx(middle.total, rel=0.01)
    inside = int(edge.in_image(320, 240).sum())
    assert inside == pytest.approx(edge.total / 2, rel=0.03)
    assert edge.box_xywh[0] < 0 < edge.box_xywh[0] + edge.box_xywh[2]
    assert draw_silhouette(vertices - [0, 0, 0.4], faces, CAMERA) is None


def test_depth_noise_has_the_size_of_the_formula() -> None:
    rng = np.random.default_rng(0)
    noise = DepthNoise(flying_share=0.0, hole_share=0.0)
    for depth in (0.4, 1.0):
        true = np.full((240, 320), depth)
        measured = measure_depth(true, CAMERA, noise, rng)
        errors = (measured - true)[measured > 0]
        # Disparities are rounded to 1/32 px as well, which adds 0.009 px to 0.08 px.
        assert errors.std() == pytest.approx(float(depth_noise_std(depth, depth_intrinsics())), rel=0.12)
        assert abs(errors.mean()) < 0.1 * errors.std() + 5e-4


def test_without_noise_depth_is_exact_to_its_steps() -> None:
    true = np.full((240, 320), 0.5)
    measured = measure_depth(true, CAMERA, QUIET, np.random.default_rng(0))
    assert np.abs(measured - true).max() < 0.5**2 / (depth_intrinsics().fx * 0.05) / 64 + 0.0006
    assert np.allclose(np.round(measured * 1000), measured * 1000)


def test_an_edge_throws_a_shadow_of_the_baseline_on_one_side() -> None:
    true = np.full((240, 320), 1.0)
    true[:, 100:160] = 0.4
    measured = measure_depth(true, CAMERA, QUIET, np.random.default_rng(0))
    row = measured[120]
    # The right imager sits 65 mm right of the colour camera: background left of the near thing is hidden from it.
    width = CAMERA.fx * 0.065 * (1 / 0.4 - 1 / 1.0)
    holes = np.flatnonzero(row[20:100] == 0)
    assert len(holes) == pytest.approx(width, abs=2)
    assert holes[-1] + 20 == 99
    assert (row[160:220] > 0).all()


def test_what_is_too_near_too_far_or_nothing_has_no_depth() -> None:
    true = np.full((240, 320), np.inf)
    true[:80] = 0.9 * min_depth(depth_intrinsics())
    true[80:160] = 9.0
    assert not measure_depth(true, CAMERA, QUIET, np.random.default_rng(0)).any()


@pytest.mark.parametrize(
    "change",
    [
        {"count": 0},
        {"seed": -1},
        {"split": "test"},
        {"width": 10},
        {"height": 5000},
        {"quality": 0},
        {"robot_share": 1.2},
    ],
)
def test_a_data_set_that_makes_no_sense_is_refused(change: dict[str, Any]) -> None:
    with pytest.raises(InvalidInputError):
        DatasetConfig(**change)


def test_scenes_share_the_images_out() -> None:
    config = DatasetConfig(count=30)
    numbers = [n for k in range(config.scenes) for n in _numbers(config, k)]
    assert numbers == list(range(30))


def test_another_data_set_is_not_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "dataset.json").write_text(json.dumps(DatasetConfig(seed=5).identity()))
    with pytest.raises(InvalidInputError, match="another seed"):
        make_dataset(DatasetConfig(count=1, seed=6), tmp_path)
    # Written before scenes could have a share of robots of their own.
    older = DatasetConfig(seed=5).identity()
    del older["robot_share"]
    (tmp_path / "dataset.json").write_text(json.dumps(older))
    with pytest.raises(InvalidInputError, match="another robot_share"):
        make_dataset(DatasetConfig(count=1, seed=5, robot_share=0.5), tmp_path)
    with pytest.raises(InvalidInputError, match="another seed; choose"):
        make_dataset(DatasetConfig(count=1, seed=6), tmp_path)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").write_text("mine")
    with pytest.raises(SystemExit) as caught:
        main(["dataset", "--count", "1", "--out", str(tmp_path / "full")])
    assert caught.value.code == 2
    assert "not empty" in capsys.readouterr().err


def write_mesh_plant(path: Path) -> Path:
    path.parent.mkdir(parents=True)
    meshes = {
        "fruit_0": trimesh.creation.icosphere(subdivisions=2, radius=0.03).apply_translation(
            (-0.1, 0.0, 0.8)
        ),
        "stem": trimesh.creation.box((0.02, 0.02, 1.2)).apply_translation((0.0, 0.0, 0.6)),
    }
    arrays: dict[str, Any] = {name: mesh.triangles for name, mesh in meshes.items()}
    np.savez(path, **arrays)
    return path


def test_a_data_set_on_mesh_files_is_another_one_and_needs_plants_of_its_split(tmp_path: Path) -> None:
    write_mesh_plant(tmp_path / "set" / "train" / "a.npz")
    plants = str(tmp_path / "set")
    with pytest.raises(InvalidInputError, match="no plants of the split 'held_out'"):
        DatasetConfig(plants=plants, split="held_out")
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "dataset.json").write_text(json.dumps(DatasetConfig(plants=plants).identity()))
    with pytest.raises(InvalidInputError, match="another plants"):
        make_dataset(DatasetConfig(count=1), tmp_path / "data")


@pytest.mark.render
def test_the_share_of_robots_changes_nothing_else_in_a_scene() -> None:
    usual, robots, none = (
        [draw_appearance(np.random.default_rng(k), robot_share=share) for k in range(40)]
        for share in (0.12, 1.0, 0.0)
    )
    assert all(scene.robot for scene in robots) and not any(scene.robot for scene in none)
    # Binomial, with a mean of 5 and a standard deviation of 2.
    assert 0 < sum(scene.robot for scene in usual) < 12
    assert [replace(scene, robot=False) for scene in robots] == none


def test_the_sun_lights_the_row_in_front_and_leaves_shade_it() -> None:
    from maniskill_tomato.segmentation.synthesis.greenhouse import GreenhouseScene

    intrinsics = color_intrinsics(160, 120)
    bright = replace(
        draw_appearance(np.random.default_rng(2), vary_crop=False),
        sun=(2.0, 2.0, 2.0),
        sun_direction=(0.6, 0.1, -0.79),
        sky=0.6,
        backdrop="gutters",
        robot=False,
    )
    plant = generate_plant("full", 3)
    scene = GreenhouseScene(plant, bright, intrinsics, np.random.default_rng(0))
    T = np.eye(4)
    # From the robot's side, level: x to the right is -y of the plant, y down, z away.
    T[:3, :3] = [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]
    T[:3, 3] = [-0.7, 0.0, 0.9]
    lit = scene.shoot(T)
    scene.relight(replace(bright, sun=(0.0, 0.0, 0.0)))
    dull = scene.shoot(T)

    front = (lit.thing >= 0) & (lit.depth_m < 0.9)
    gain = (lit.light - dull.light).mean(-1)[front]
    # Without shadows 0.4 of these pixels would gain as much, those of surfaces that face the sun; leaves shade most.
    assert 0.08 < np.mean(gain > 0.05) < 0.3


@pytest.mark.render
@pytest.mark.slow
def test_plants_of_mesh_files_stand_in_the_pictures(tmp_path: Path) -> None:
    path = write_mesh_plant(tmp_path / "a.npz" / "a.npz")
    config = DatasetConfig(count=3, plants=str(path), width=320, height=240)
    images = make_dataset(config, tmp_path / "data").images
    named = [
        one for image in images for one in image.instances if one.name and not one.name.startswith(BEHIND)
    ]
    assert {one.category for one in named} <= {"tomato_ripe", "stem", "robot"}
    assert any(one.category == "tomato_ripe" and one.visible_fraction for one in named)


def test_the_command_takes_its_options(tmp_path: Path) -> None:
    command = parse(
        ["dataset", "--count", "7", "--split", "held_out", "--no-vary-crop", "--out", str(tmp_path)]
    )
    assert isinstance(command, Dataset)
    assert (command.count, command.split, command.vary_crop, command.out) == (7, "held_out", False, tmp_path)


def test_missing_photos_are_an_error_of_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["dataset", "--count", "1", "--real", str(tmp_path / "gone"), "--out", str(tmp_path / "out")])
    assert capsys.readouterr().err.startswith("error: --real: there is no folder")
    assert not (tmp_path / "out").exists()


@pytest.mark.render
@pytest.mark.slow
def test_a_small_data_set_is_whole_continued_and_the_same_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from maniskill_tomato.rendering.vulkan_probe import rendering_available
    from maniskill_tomato.segmentation.datasets.reading import read_annotated
    from maniskill_tomato.segmentation.synthesis.dataset_page import write_statistics

    if not rendering_available():
        pytest.skip("needs a Vulkan device")
    config = DatasetConfig(count=2, seed=3, split="held_out", width=320, height=240)
    first = make_dataset(config, tmp_path / "a")
    assert len(first.images) == 2
    read = read_annotated(tmp_path / "a")
    assert not read.skipped and len(read.images) == 2
    for image in read.images:
        depth = image.load_depth()
        assert image.camera is not None and depth is not None and depth.max() > 0.2
        assert image.load().std() > 5
        for fruit in image.instances:
            if fruit.amodal_mask is None or fruit.visible_mask is None:
                continue
            seen, whole = fruit.visible_mask.decode(), fruit.amodal_mask.decode()
            assert not (seen & ~whole).any()
            assert fruit.visible_fraction is not None and 0 < fruit.visible_fraction <= 1
            # V_f is written with five decimals.
            assert fruit.visible_fraction <= seen.sum() / whole.sum() + 6e-6
    assert write_statistics(read, tmp_path / "a").is_file()
    judge = ("judge", "occlusion", "--data", str(tmp_path / "a"), "--out", str(tmp_path / "occ"), "--figure")
    main([*judge, "images/000000.jpg"])
    assert cv2.imread(str(tmp_path / "occ" / "steps.png")) is not None
    with pytest.raises(SystemExit):
        main([*judge, "images/9.jpg"])
    assert capsys.readouterr().err.startswith("error: --figure must be one of")
    # Continued to three images it keeps the first two, and made anew in one go it is the same.
    grown = make_dataset(replace(config, count=3), tmp_path / "a")
    again = make_dataset(replace(config, count=3), tmp_path / "b")
    for one, other in zip(grown.images, again.images, strict=True):
        assert one.path.read_bytes() == other.path.read_bytes()
        assert one.instances == other.instances
