"""Plants in a ManiSkill scene: every organ has its own segmentation id, with and without a renderer."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sapien
import torch
import trimesh
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.envs.utils.system.backend import parse_sim_and_render_backend
from mani_skill.render import PREBUILT_SHADER_CONFIGS, set_shader_pack
from mani_skill.utils.structs.actor import Actor
from numpy.typing import NDArray
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from maniskill_tomato.plants.generator import generate_plant
from maniskill_tomato.plants.mesh_plant import plant_from_mesh
from maniskill_tomato.plants.mesh_rules import MeshRules
from maniskill_tomato.plants.organs import Plant
from maniskill_tomato.rendering.plant_actors import build_plant_actors


def make_scene(render_backend: str) -> ManiSkillScene:
    backend = parse_sim_and_render_backend("physx_cpu", render_backend)
    systems: list[sapien.System] = [sapien.physx.PhysxCpuSystem()]
    if render_backend != "none":
        set_shader_pack(PREBUILT_SHADER_CONFIGS["default"])
        systems.append(sapien.render.RenderSystem(backend.render_device))
    return ManiSkillScene([sapien.Scene(systems)], device=torch.device("cpu"), backend=backend)


def build(scene: ManiSkillScene, plant: Plant, x: float = 0.0) -> list[Actor]:
    return build_plant_actors(scene, plant, scene_idxs=[0], pose=sapien.Pose([x, 0, 0]), name_prefix="plant/")


def photograph(scene: ManiSkillScene, eye: list[float], forward: NDArray[np.float64]) -> NDArray[np.int64]:
    """A segmentation image by actor. Shape (320, 320)."""
    return np.asarray(take(scene, eye, forward).get_picture("Segmentation")[..., 1], np.int64)


def take(
    scene: ManiSkillScene, eye: list[float], forward: NDArray[np.float64]
) -> sapien.render.RenderCameraComponent:
    """A camera that has taken its picture."""
    left = np.cross([0.0, 0.0, 1.0], forward)
    left /= np.linalg.norm(left)
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = np.stack([forward, left, np.cross(forward, left)], 1)
    T_world_camera[:3, 3] = eye
    camera = scene.sub_scenes[0].add_camera("camera", 320, 320, 1.2, 0.01, 10.0)
    camera.entity.set_pose(sapien.Pose(T_world_camera))
    scene.sub_scenes[0].update_render()
    camera.take_picture()
    return camera


def test_a_scene_without_a_renderer_gets_an_actor_for_each_organ() -> None:
    plant = generate_plant("three_tomatoes", 1)
    scene = make_scene("none")
    actors = build(scene, plant, x=0.85)
    assert [actor.name for actor in actors] == [f"plant/{organ.name}" for organ in plant.organs]
    ids = [int(actor.per_scene_id[0]) for actor in actors]
    assert len(set(ids)) == len(ids) and min(ids) > 0
    for actor in actors:
        assert actor.px_body_type == "kinematic"
        assert not actor._bodies[0].get_collision_shapes()
        torch.testing.assert_close(actor.pose.p, torch.tensor([[0.85, 0.0, 0.0]]))


@pytest.mark.render
def test_segmentation_ids_do_not_depend_on_the_renderer() -> None:
    plant = generate_plant("full", 2)
    bare, drawn = (build(make_scene(backend), plant) for backend in ("none", "cpu"))
    assert [int(a.per_scene_id[0]) for a in bare] == [int(a.per_scene_id[0]) for a in drawn]


@pytest.mark.render
def test_every_organ_shows_in_the_segmentation_under_its_own_id() -> None:
    plant = generate_plant("full", 2)
    scene = make_scene("cpu")
    actors = build(scene, plant)
    images = []
    for azimuth in np.radians([0.0, 90.0, 180.0, 270.0]):
        forward = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        images.append(photograph(scene, [*(-1.2 * forward[:2]), 0.8], forward))
    seen = set(np.unique(np.stack(images)).tolist())
    for actor in actors:
        assert int(actor.per_scene_id[0]) in seen, actor.name


@pytest.mark.render
def test_a_leaflet_is_drawn_from_above_and_from_below() -> None:
    plant = generate_plant("full", 2)
    scene = make_scene("cpu")
    actors = build(scene, plant)
    leaf = next(i for i, organ in enumerate(plant.organs) if organ.name == "leaf_03")
    own = int(actors[leaf].per_scene_id[0])
    centre = plant.organs[leaf].parts[1].vertices.mean(0).astype(np.float64)
    outward = np.array([centre[0], centre[1], 0.0]) / np.linalg.norm(centre[:2])
    for lift in (0.35, -0.35):
        eye = centre + 0.12 * outward + np.array([0.0, 0.0, lift])
        image = photograph(scene, eye.tolist(), (centre - eye) / np.linalg.norm(centre - eye))
        assert (image == own).mean() > 0.02


@pytest.mark.render
def test_a_fruit_is_drawn_where_the_plant_says() -> None:
    plant = generate_plant("one_tomato", 0, leaf_density=0.0)
    scene = make_scene("cpu")
    actors = build(scene, plant, x=0.85)
    fruit = plant.fruits[0]
    own = int(actors[fruit.organ_index].per_scene_id[0])
    eye = fruit.centre.astype(np.float64) + [0.85 - 0.5, 0.0, 0.0]
    rows, columns = np.nonzero(photograph(scene, eye.tolist(), np.array([1.0, 0.0, 0.0])) == own)
    pixels_per_metre = 160 / np.tan(0.6) / 0.5
    assert abs(np.median(columns) - 159.5) < 3
    assert abs(np.ptp(columns) / 2 - fruit.radius * pixels_per_metre) < 3
    assert abs(np.mean([rows.min(), rows.max()]) - 159.5) < 6


@pytest.mark.render
def test_an_open_sheet_of_a_mesh_file_is_drawn_from_both_sides(tmp_path: Path) -> None:
    """Over the fruit a sheet of one side: it covers the fruit for both cameras, as rays say it does."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.03)
    ball.apply_translation([0.0, 0.0, 0.5])
    sheets = [[[x, -0.2, 0.3], [x, 0.2, 0.3], [x, 0.0, 0.9]] for x in (-0.1, 0.1)]
    np.savez(
        tmp_path / "a.npz", fruit_0=ball.triangles, leaf_0=np.array(sheets), stem=np.array(sheets[:1]) * 0.1
    )
    plant = plant_from_mesh(tmp_path / "a.npz", MeshRules())
    scene = make_scene("cpu")
    fruit, leaf, _ = (int(actor.per_scene_id[0]) for actor in build(scene, plant))
    for side in (-1.0, 1.0):
        image = photograph(scene, [-0.7 * side, 0.0, 0.5], np.array([side, 0.0, 0.0]))
        assert leaf in image and fruit not in image
    assert fruit in photograph(scene, [0.0, -0.7, 0.5], np.array([0.0, 1.0, 0.0]))


@pytest.mark.render
def test_a_picture_shows_the_colours_of_a_file(tmp_path: Path) -> None:
    """A leaf that its texture makes red at its right and blue at its left side, as seen from -x; a green fruit."""
    pixels = np.zeros((8, 8, 3), np.uint8)
    pixels[:, :4, 2], pixels[:, 4:, 0] = 230, 230
    corners = [[-0.2, 0.1, 0.4], [-0.2, -0.1, 0.4], [-0.2, -0.1, 0.6], [-0.2, 0.1, 0.6]]
    leaf = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)
    material = PBRMaterial(name="blade", baseColorTexture=Image.fromarray(pixels))
    leaf.visual = TextureVisuals(uv=np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]]), material=material)
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.03).apply_translation([0.0, 0.0, 0.8])
    ball.visual = TextureVisuals(material=PBRMaterial(name="skin", baseColorFactor=[0.0, 0.6, 0.0, 1.0]))
    turned = trimesh.Scene()
    turn: Any = trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0])
    for name, mesh in {"leaf": leaf, "fruit": ball}.items():
        turned.add_geometry(mesh, node_name=name, transform=turn)
    turned.export(tmp_path / "a.glb")
    plant = plant_from_mesh(tmp_path / "a.glb", MeshRules())
    scene = make_scene("cpu")
    build(scene, plant)
    scene.sub_scenes[0].set_ambient_light([0.8, 0.8, 0.8])
    picture = np.asarray(take(scene, [-0.9, 0.0, 0.6], np.array([1.0, 0.0, 0.0])).get_picture("Color"))[
        ..., :3
    ]
    pixels_per_metre = 160 / np.tan(0.6)

    def at(x: float, y: float, z: float) -> NDArray[np.float64]:
        scale = pixels_per_metre / (x + 0.9)
        return np.asarray(picture[int(160 - (z - 0.6) * scale), int(160 - y * scale)], np.float64)

    red, blue, green = at(-0.2, -0.05, 0.5), at(-0.2, 0.05, 0.5), at(-0.03, 0.0, 0.8)
    for colour, channel in ((red, 0), (blue, 2), (green, 1)):
        others = np.delete(colour, channel)
        assert colour[channel] > 3 * others.max() and colour[channel] > 0.1
