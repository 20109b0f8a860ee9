"""The colours of mesh files: what each format says is what a plant's parts are painted with."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from maniskill_tomato.plants.mesh_plant import plant_from_mesh
from maniskill_tomato.plants.mesh_rules import MeshRules
from maniskill_tomato.plants.organs import MeshPart, Plant
from maniskill_tomato.plants.plant_store import plant_bytes

RED, BLUE, GREEN = (200, 30, 20), (20, 40, 210), (60, 140, 50)


def parts() -> dict[str, trimesh.Trimesh]:
    """A stem, a fruit, and an upright leaf of two triangles that share their slanted edge."""
    stem = trimesh.creation.cylinder(radius=0.01, height=1.2, sections=8).apply_translation([0.0, 0.0, 0.6])
    fruit = trimesh.creation.icosphere(subdivisions=2, radius=0.03).apply_translation([-0.1, 0.0, 0.7])
    corners = [[-0.25, -0.1, 0.6], [-0.25, 0.1, 0.6], [-0.25, 0.1, 0.8], [-0.25, -0.1, 0.8]]
    leaf = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)
    return {"stem": stem, "fruit": fruit, "leaf": leaf}


UVS = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


def two_halves() -> Image.Image:
    """Red where u is below a half, blue beyond; the upper row is green."""
    pixels = np.zeros((8, 8, 3), np.uint8)
    pixels[:, :4], pixels[:, 4:], pixels[0] = RED, BLUE, GREEN
    return Image.fromarray(pixels)


def write_glb(path: Path, meshes: dict[str, trimesh.Trimesh]) -> Path:
    scene = trimesh.Scene()
    turn: Any = trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0])
    for name, mesh in meshes.items():
        scene.add_geometry(mesh, node_name=name, geom_name=f"mesh of {name}", transform=turn)
    scene.export(path)
    return path


def of(plant: Plant, name: str) -> MeshPart:
    (part,) = next(organ for organ in plant.organs if organ.name == name).parts
    return part


def colour_at(part: MeshPart, face: int, weights: tuple[float, float, float]) -> tuple[int, ...]:
    """The texel under a point of a triangle, found as a renderer does; weights belong to its corners."""
    assert part.texture is not None
    u, v = np.array(weights) @ part.uvs[part.faces[face]]
    rows, columns = part.texture.shape[:2]
    return tuple(part.texture[int(v % 1.0 * rows), int(u % 1.0 * columns), :3].tolist())


def at_place(part: MeshPart, y: float, z: float) -> tuple[int, ...]:
    """The colour of a leaf at a place, by a search for the triangle that holds it."""
    for face, corners in enumerate(part.vertices[part.faces][..., 1:].astype(np.float64)):
        weights = np.linalg.solve(np.vstack([corners.T, np.ones(3)]), [y, z, 1.0])
        if (weights > 0.0).all():
            return colour_at(part, face, tuple(weights))
    raise AssertionError("no triangle there")


def near(colour: tuple[int, ...], expected: tuple[int, ...], atol: int = 2) -> bool:
    return bool(np.abs(np.subtract(colour, expected)).max() <= atol)


def test_a_texture_of_a_glb_lies_on_the_leaf_as_its_file_says(tmp_path: Path) -> None:
    meshes = parts()
    meshes["leaf"].visual = TextureVisuals(
        uv=UVS, material=PBRMaterial(name="blade", baseColorTexture=two_halves())
    )
    plant = plant_from_mesh(write_glb(tmp_path / "vine.glb", meshes), MeshRules())
    leaf = of(plant, "leaf")
    assert near(at_place(leaf, -0.05, 0.65), RED) and near(at_place(leaf, 0.05, 0.65), BLUE)
    assert near(at_place(leaf, -0.05, 0.79), GREEN)  # Up is the picture's upper row.
    assert of(plant, "fruit").texture is None and of(plant, "stem").texture is None


def test_meshes_of_one_material_share_its_texture(tmp_path: Path) -> None:
    meshes = parts()
    material = PBRMaterial(name="blade", baseColorTexture=two_halves())
    second = meshes["leaf"].copy().apply_translation([0.0, 0.0, -0.3])
    for mesh in (meshes["leaf"], second):
        mesh.visual = TextureVisuals(uv=UVS, material=material)
    plant = plant_from_mesh(write_glb(tmp_path / "vine.glb", meshes | {"leaf_b": second}), MeshRules())
    texture = of(plant, "leaf").texture
    assert texture is of(plant, "leaf_b").texture and texture is not None
    # It takes its place in memory once.
    unpainted = [replace(o, parts=tuple(replace(p, texture=None) for p in o.parts)) for o in plant.organs]
    assert plant_bytes(plant) - plant_bytes(replace(plant, organs=tuple(unpainted))) == texture.nbytes


def test_the_colour_of_a_glbs_material_is_linear_light(tmp_path: Path) -> None:
    meshes = parts()
    meshes["fruit"].visual = TextureVisuals(
        material=PBRMaterial(name="skin", baseColorFactor=[0.5, 0.0, 1.0, 1.0])
    )
    plant = plant_from_mesh(write_glb(tmp_path / "vine.glb", meshes), MeshRules())
    # sRGB of half the light is 188 (IEC 61966-2-1).
    assert near(colour_at(of(plant, "fruit"), 0, (0.2, 0.3, 0.5)), (188, 0, 255))


def test_an_obj_has_the_colours_and_pictures_of_its_materials(tmp_path: Path) -> None:
    two_halves().save(tmp_path / "blade.png")
    (tmp_path / "vine.mtl").write_text(
        "newmtl skin\nKd 0.784 0.118 0.078\n\nnewmtl blade\nKd 0.8 0.8 0.8\nmap_Kd blade.png\n\nnewmtl bark\nNs 10\n"
    )
    lines, first = ["mtllib vine.mtl"], 1
    lines += [f"vt {u} {v}" for u, v in UVS]
    for name, material in (("stem", "bark"), ("fruit", "skin"), ("leaf", "blade")):
        mesh = parts()[name]
        lines += [f"o {name}", f"usemtl {material}"]
        lines += [f"v {x:.7f} {y:.7f} {z:.7f}" for x, y, z in mesh.vertices]
        places = "{0}/{1}" if name == "leaf" else "{0}"
        lines += [
            "f " + " ".join(places.format(k + first, k + 1) for k in face) for face in mesh.faces.tolist()
        ]
        first += len(mesh.vertices)
    (tmp_path / "vine.obj").write_text("\n".join(lines) + "\n")
    plant = plant_from_mesh(tmp_path / "vine.obj", MeshRules())
    assert near(colour_at(of(plant, "fruit"), 3, (0.2, 0.3, 0.5)), RED)
    assert near(at_place(of(plant, "leaf"), 0.05, 0.65), BLUE)
    assert of(plant, "stem").texture is None


def test_a_leaf_with_another_material_below_shows_each_on_its_own_side(tmp_path: Path) -> None:
    (tmp_path / "vine.mtl").write_text("newmtl upper\nKd 0 0.4 0\nnewmtl under\nKd 0.5 0.6 0.4\n")
    lines, first = ["mtllib vine.mtl"], 1
    for name, mesh in parts().items():
        lines += [f"o {name}", *(f"v {x:.7f} {y:.7f} {z:.7f}" for x, y, z in mesh.vertices)]
        for material, order in (("upper", (0, 1, 2)), ("under", (2, 1, 0)))[: 2 if name == "leaf" else 1]:
            lines += [f"usemtl {material}"]
            lines += ["f " + " ".join(str(face[k] + first) for k in order) for face in mesh.faces.tolist()]
        first += len(mesh.vertices)
    (tmp_path / "vine.obj").write_text("\n".join(lines) + "\n")
    plant = plant_from_mesh(tmp_path / "vine.obj", MeshRules())
    leaf = next(organ for organ in plant.organs if organ.name == "leaf")
    under, upper = leaf.parts
    assert near(colour_at(upper, 0, (0.2, 0.3, 0.5)), (0, 102, 0))
    assert near(colour_at(under, 0, (0.2, 0.3, 0.5)), (128, 153, 102))
    for part in leaf.parts:
        assert len(part.faces) == 2 and not part.two_sided
        a, b, c = part.vertices[part.faces[0]]
        across = np.cross(b - a, c - a)
        np.testing.assert_allclose(part.normals, np.tile(across / np.linalg.norm(across), (4, 1)), atol=1e-6)


@pytest.mark.parametrize("suffix", ["glb", "ply"])
def test_colours_of_vertices_paint_each_triangle_with_their_mean(tmp_path: Path, suffix: str) -> None:
    meshes: dict[str, Any] = parts()
    meshes["leaf"].visual.vertex_colors = [RED, RED, BLUE, BLUE]
    meshes["fruit"].visual.vertex_colors = [RED] * len(meshes["fruit"].vertices)
    rules: dict[str, Any] = {}
    if suffix == "glb":
        path = write_glb(tmp_path / "vine.glb", meshes)
    else:
        path, rules = tmp_path / "vine.ply", {"leaf": "label_2", "fruit": "label_1", "stem": "label_0"}
        meshes["stem"].visual.vertex_colors = [GREEN] * len(meshes["stem"].vertices)
        write_ply(path, meshes)
    plant = plant_from_mesh(path, MeshRules(**rules))
    fruit, leaf = (of(plant, rules.get(name, name)) for name in ("fruit", "leaf"))

    def coded(light: float) -> float:
        return 255 * (1.055 * (light / 255) ** (1 / 2.4) - 0.055) if suffix == "glb" else light

    expected = {
        tuple(round(coded((2 * a + b) / 3)) for a, b in zip(x, y, strict=True))
        for x, y in ((RED, BLUE), (BLUE, RED))
    }
    for face in range(2):
        found = colour_at(leaf, face, (0.2, 0.3, 0.5))
        assert any(near(found, colour) for colour in expected)
    assert near(colour_at(fruit, 5, (0.2, 0.3, 0.5)), tuple(round(coded(c)) for c in RED))
    if suffix == "glb":
        assert of(plant, "stem").texture is None


def write_ply(path: Path, meshes: dict[str, Any]) -> None:
    vertices = [
        (*v, *c[:3]) for m in meshes.values() for v, c in zip(m.vertices, m.visual.vertex_colors, strict=True)
    ]
    faces, first = [], 0
    for label, mesh in enumerate(meshes.values()):
        faces += [(*(int(k) + first for k in face), label) for face in mesh.faces]
        first += len(mesh.vertices)
    properties = [f"property float {a}" for a in "xyz"] + [
        f"property uchar {c}" for c in ("red", "green", "blue")
    ]
    head = [
        "ply",
        "format ascii 1.0",
        f"element vertex {len(vertices)}",
        *properties,
        f"element face {len(faces)}",
    ]
    head += ["property list uchar int vertex_indices", "property int label", "end_header"]
    rows = [f"{x:.7f} {y:.7f} {z:.7f} {r} {g} {b}" for x, y, z, r, g, b in vertices]
    rows += [f"3 {a} {b} {c} {label}" for a, b, c, label in faces]
    path.write_text("\n".join(head + rows) + "\n")


def test_triangles_that_decimation_leaves_keep_their_colours(tmp_path: Path) -> None:
    meshes = parts()
    fruit: Any = meshes["fruit"].subdivide_loop(2)
    upper = fruit.triangles_center[:, 2] > 0.7
    fruit.visual.face_colors = np.where(upper[:, None], RED, BLUE)
    meshes["fruit"] = fruit
    plant = plant_from_mesh(write_glb(tmp_path / "vine.glb", meshes), MeshRules(triangles=600))
    assert len(plant.faces) <= 600
    part = of(plant, "fruit")
    assert part.texture is not None and len(np.unique(part.texture[..., :3].reshape(-1, 3), axis=0)) >= 2
    heights = part.vertices[part.faces].mean(1)[:, 2]
    for face in np.flatnonzero(np.abs(heights - 0.7) > 0.01):
        red, _, blue = colour_at(part, int(face), (0.2, 0.3, 0.5))
        assert (red > blue) == (heights[face] > 0.7)
