"""Plants from mesh files: what each format gives, which object is what, sizes, places, sets and their splits."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.mesh_plant import plant_from_mesh
from maniskill_tomato.plants.mesh_rules import MeshRules
from maniskill_tomato.plants.mesh_set import MeshSource
from maniskill_tomato.plants.organs import Plant, SemanticClass
from maniskill_tomato.plants.row import Row
from maniskill_tomato.plants.seed_splits import SEED_SPLITS
from maniskill_tomato.plants.spec import PlantSpec
from maniskill_tomato.raycast.scene import RayScene
from maniskill_tomato.robot.d435 import color_intrinsics

FRUITS = {"fruit_00": (-0.1, 0.0, 0.7), "fruit_green_01": (0.0, 0.1, 0.8)}
RADIUS = 0.03


def ball(centre: tuple[float, float, float], radius: float = RADIUS) -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=radius)
    mesh.apply_translation(centre)
    return mesh


def board(x: float, low: float, high: float, width: float = 0.2) -> trimesh.Trimesh:
    """An upright open sheet at x, from `low` to `high`."""
    y = 0.5 * width
    corners = [[x, -y, low], [x, y, low], [x, y, high], [x, -y, high]]
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)


def parts() -> dict[str, trimesh.Trimesh]:
    stem = trimesh.creation.cylinder(radius=0.01, height=1.2, sections=8)
    stem.apply_translation([0.0, 0.0, 0.6])
    return {"stem": stem, "leaf_00": board(-0.25, 0.6, 0.8)} | {n: ball(c) for n, c in FRUITS.items()}


def scene(meshes: dict[str, trimesh.Trimesh], T: Any = None) -> trimesh.Scene:
    made = trimesh.Scene()
    for name, mesh in meshes.items():
        made.add_geometry(mesh, node_name=name, geom_name=f"mesh of {name}", transform=T)
    return made


def write_npz(path: Path, meshes: dict[str, trimesh.Trimesh]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays: dict[str, Any] = {name: mesh.triangles for name, mesh in meshes.items()}
    np.savez(path, **arrays)
    return path


def write_obj(path: Path, meshes: dict[str, trimesh.Trimesh]) -> Path:
    lines, first = [], 1
    for name, mesh in meshes.items():
        lines.append(f"o {name}")
        lines += [f"v {x:.7f} {y:.7f} {z:.7f}" for x, y, z in mesh.vertices]
        lines += [f"f {a + first} {b + first} {c + first}" for a, b, c in mesh.faces]
        first += len(mesh.vertices)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def write_glb(path: Path, meshes: dict[str, trimesh.Trimesh]) -> Path:
    to_y_up = trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0])
    scene(meshes, to_y_up).export(path)
    return path


def write_ply(path: Path, meshes: dict[str, trimesh.Trimesh]) -> Path:
    joined: Any = trimesh.util.concatenate(list(meshes.values()))
    labels = np.repeat(np.arange(len(meshes)), [len(m.faces) for m in meshes.values()])
    head = (
        f"ply\nformat ascii 1.0\nelement vertex {len(joined.vertices)}\nproperty float x\nproperty float y\n"
    )
    head += f"property float z\nelement face {len(joined.faces)}\nproperty list uchar int vertex_indices\n"
    rows = [f"{x:.7f} {y:.7f} {z:.7f}" for x, y, z in joined.vertices]
    rows += [f"3 {a} {b} {c} {label}" for (a, b, c), label in zip(joined.faces, labels, strict=True)]
    path.write_text(head + "property int label\nend_header\n" + "\n".join(rows) + "\n", encoding="utf-8")
    return path


PLY_RULES = {"stem": "label_0", "leaf": "label_1", "fruit": ["label_2", "label_3"], "green": "label_3"}


def check_whole(plant: Plant) -> None:
    kinds = [organ.semantic_class for organ in plant.organs]
    for kind in (SemanticClass.STEM, SemanticClass.LEAF, SemanticClass.FRUIT_RIPE, SemanticClass.FRUIT_GREEN):
        assert kinds.count(kind) == 1
    ripe, green = plant.fruits
    assert (ripe.ripeness, green.ripeness) == ("ripe", "green")
    for fruit, centre in zip(plant.fruits, FRUITS.values(), strict=True):
        np.testing.assert_allclose(fruit.centre, centre, atol=2e-6)
        # Icospheres have their vertices on the sphere; positions are rounded to a micrometre.
        assert fruit.radius == pytest.approx(RADIUS, abs=4e-6)


@pytest.mark.parametrize(
    ("write", "name", "rules"),
    [
        (write_npz, "vine.npz", {}),
        (write_obj, "vine.obj", {}),
        (write_glb, "vine.glb", {}),
        (write_ply, "vine.ply", PLY_RULES),
    ],
    ids=["npz", "obj", "glb", "ply"],
)
def test_every_format_gives_the_same_plant(tmp_path: Path, write: Any, name: str, rules: Any) -> None:
    meshes = parts()
    plant = plant_from_mesh(write(tmp_path / name, meshes), MeshRules(**rules), seed=7)
    assert (plant.preset, plant.seed) == ("vine", 7)
    check_whole(plant)
    assert len(plant.faces) == sum(len(mesh.faces) for mesh in meshes.values())


def test_units_axes_turn_and_shift_of_a_file_are_undone(tmp_path: Path) -> None:
    rules = MeshRules(units="cm", up="-x", yaw=0.5, offset=(0.1, -0.05, 0.2), scale=0.5)
    # By hand: down the file's x is up, its z is the plant's x; then the turn, then the shift.
    c, s = np.cos(0.5), np.sin(0.5)
    meshes = parts()
    for mesh in meshes.values():
        x, y, z = mesh.vertices.T - np.array([[0.1], [-0.05], [0.2]])
        x, y = c * x + s * y, -s * x + c * y
        mesh.vertices = np.stack([-z, y, x], 1) * 200.0
    check_whole(plant_from_mesh(write_npz(tmp_path / "moved.npz", meshes), rules))


def test_materials_say_what_an_object_is_that_is_called_anything() -> None:
    rules = MeshRules(leaf=("blade*",))
    assert rules.kind_of("Plane.003", "Blade_B") == "leaf"
    assert rules.kind_of("fruit_7", "blade") == "fruit"
    assert rules.kind_of("Cube", "Material") is None
    assert MeshRules().kind_of("tomato_leaf_3", "") == "leaf"
    assert MeshRules(ignore=("pot*",)).kind_of("Pot_leaf", "") == "ignore"
    assert MeshRules().ripeness_of("Tomato.004", "skin_turning") == "turning"


def test_the_pieces_of_one_object_are_fruits(tmp_path: Path) -> None:
    meshes = parts()
    seed = ball((-0.1, 0.0, 0.71), 0.004)
    balls = [ball((-0.1, 0.0, 0.7)), ball((0.0, 0.1, 0.8)), seed]
    del meshes["fruit_00"], meshes["fruit_green_01"]
    joined: Any = trimesh.util.concatenate(balls)
    meshes["Fruits"] = joined
    path = write_npz(tmp_path / "one.npz", meshes)
    fruits = plant_from_mesh(path, MeshRules(fruits="pieces")).fruits
    assert len(fruits) == 2  # The seed lies in one of them.
    np.testing.assert_allclose(fruits[1].centre, (0.0, 0.1, 0.8), atol=2e-6)
    joined.vertices *= [4.0, 4.0, 1.0]
    with pytest.raises(InvalidInputError, match=r"'Fruits'.*3 pieces.*fruits='pieces'"):
        plant_from_mesh(write_npz(path, meshes), MeshRules())


def test_a_fruit_behind_a_leaf_is_hidden_from_either_side_of_the_leaf(tmp_path: Path) -> None:
    plant = plant_from_mesh(write_npz(tmp_path / "vine.npz", parts()), MeshRules())
    casting = RayScene([plant], color_intrinsics(160, 120))
    T = torch.eye(4)[None]
    facing = torch.tensor([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # The optical axis along +x.
    T[0, :3, :3] = facing
    T[0, :3, 3] = torch.tensor([-0.7, 0.0, 0.7])
    seen = casting.visibility(T, torch.tensor([0]), torch.eye(4)[None])
    assert float(seen.visible_fraction) == 0.0
    # From the side it is free.
    T[0, :3, :3] = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    T[0, :3, 3] = torch.tensor([-0.1, -0.6, 0.7])
    seen = casting.visibility(T, torch.tensor([0]), torch.eye(4)[None])
    assert float(seen.visible_fraction) == 1.0


def test_open_sheets_are_drawn_from_both_sides_and_closed_bodies_are_not(tmp_path: Path) -> None:
    plant = plant_from_mesh(write_npz(tmp_path / "vine.npz", parts()), MeshRules())
    sides = {organ.name: organ.parts[0].two_sided for organ in plant.organs}
    assert sides == {"stem": False, "leaf_00": True, "fruit_00": False, "fruit_green_01": False}


def test_only_the_open_pieces_of_an_object_are_drawn_from_both_sides(tmp_path: Path) -> None:
    """A leaf of a closed stalk and an open blade."""
    meshes = parts()
    stalk = trimesh.creation.cylinder(radius=0.002, height=0.1, sections=6).apply_translation(
        [-0.2, 0.0, 0.7]
    )
    joined: Any = trimesh.util.concatenate([meshes["leaf_00"], stalk])
    meshes["leaf_00"] = joined
    plant = plant_from_mesh(write_npz(tmp_path / "vine.npz", meshes), MeshRules())
    leaf = next(organ for organ in plant.organs if organ.name == "leaf_00")
    assert {part.two_sided: len(part.faces) for part in leaf.parts} == {False: len(stalk.faces), True: 2}


def test_a_leaf_of_two_sides_is_lit_on_both(tmp_path: Path) -> None:
    meshes = parts()
    one = meshes["leaf_00"]
    meshes["leaf_00"] = trimesh.Trimesh(
        one.vertices, np.concatenate([one.faces, one.faces[:, ::-1]]), process=False
    )
    plant = plant_from_mesh(write_npz(tmp_path / "vine.npz", meshes), MeshRules())
    (leaf,) = next(organ for organ in plant.organs if organ.name == "leaf_00").parts
    assert not leaf.two_sided and len(leaf.faces) == 4
    for face in leaf.faces:
        a, b, c = leaf.vertices[face].astype(np.float64)
        across = np.cross(b - a, c - a)
        np.testing.assert_allclose(
            leaf.normals[face], np.tile(across / np.linalg.norm(across), (3, 1)), atol=1e-6
        )


def test_leaf_cards_are_refused_with_the_reason(tmp_path: Path) -> None:
    def card(alpha: int) -> Path:
        picture = Image.new("RGBA", (4, 4), (0, 128, 0, 255))
        picture.putpixel((0, 0), (0, 128, 0, alpha))
        material = PBRMaterial(name="foliage", baseColorTexture=picture, alphaMode="MASK")
        meshes = parts()
        uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
        meshes["leaf_00"].visual = TextureVisuals(uv=uv, material=material)
        return write_glb(tmp_path / f"card{alpha}.glb", meshes)

    with pytest.raises(InvalidInputError, match=r"'leaf_00' is a card.*alpha.*'foliage'.*cut it out"):
        plant_from_mesh(card(0), MeshRules())
    plant_from_mesh(card(255), MeshRules())


def test_an_obj_whose_material_names_a_picture_of_its_opacity_is_a_card(tmp_path: Path) -> None:
    path = write_obj(tmp_path / "vine.obj", parts())
    lines = path.read_text(encoding="utf-8")
    for name, material in (("leaf_00", "foliage"), ("fruit_00", "skin")):
        lines = lines.replace(f"o {name}\n", f"o {name}\nusemtl {material}\n")
    path.write_text(f"mtllib vine.mtl\n{lines}", encoding="utf-8")
    for opacity in ("d 1.0", "map_d holes.png"):
        (tmp_path / "vine.mtl").write_text(
            f"newmtl foliage\nKd 0.1 0.5 0.1\n{opacity}\nnewmtl skin\nKd 0.8 0.1 0.1\n", encoding="utf-8"
        )
        if opacity.startswith("map"):
            with pytest.raises(InvalidInputError, match=r"'leaf_00' is a card.*'foliage'"):
                plant_from_mesh(path, MeshRules())
        else:
            check_whole(plant_from_mesh(path, MeshRules()))


def changed(name: str, mesh: trimesh.Trimesh | None) -> dict[str, trimesh.Trimesh]:
    meshes = parts()
    if mesh is None:
        del meshes[name]
    else:
        meshes[name] = mesh
    return meshes


@pytest.mark.parametrize(
    ("meshes", "rules", "message"),
    [
        (changed("Cube", ball((0, 0, 0.3))), {}, r"object 'Cube' is no leaf, stem or fruit.*ignore="),
        (changed("fruit_big", ball((0, 0, 0.5), 0.4)), {}, r"'fruit_big' has a radius of 0.4.*units='m'"),
        (parts(), {"units": "mm"}, r"'fruit_00' has a radius of 3.2e-05 m.*units may be m, cm, mm, in"),
        (parts(), {"green": "*"}, r"none of its 2 fruits, such as 'fruit_00', is ripe"),
        (parts(), {"fruit": "berry"}, r"'fruit_00'.* \(and 1 more\) is no leaf"),
        (parts(), {"fruit": "berry", "ignore": "fruit*"}, r"has no fruit, only 'leaf_00', 'stem'"),
        (parts(), {"offset": (3.0, 0.0, 0.0)}, r"middle is at x = 2\.\d\d.*offset=\(-2"),
        (parts(), {"scale": 4.0}, r"the plant is 4.8 m|is allowed"),
    ],
    ids=["unknown", "large", "unit", "unripe", "more", "none", "place", "high"],
)
def test_errors_name_the_object_and_say_what_to_do(
    tmp_path: Path, meshes: dict[str, trimesh.Trimesh], rules: Any, message: str
) -> None:
    path = write_npz(tmp_path / "bad.npz", meshes)
    if "scale" in rules:
        meshes = changed("fruit_green_01", None)
        meshes["stem"].apply_scale(2.0)
        path = write_npz(path, meshes)
    with pytest.raises(InvalidInputError, match=message):
        plant_from_mesh(path, MeshRules(**rules))


def test_broken_files_are_told_apart(tmp_path: Path) -> None:
    broken = tmp_path / "broken.glb"
    broken.write_bytes(b"no mesh")
    with pytest.raises(InvalidInputError, match=r"broken.glb cannot be read as GLB"):
        plant_from_mesh(broken, MeshRules())
    np.savez(tmp_path / "flat.npz", leaf_1=np.zeros((4, 3)))
    with pytest.raises(
        InvalidInputError, match=r"'leaf_1' must be an array of triangles of shape \(F, 3, 3\)"
    ):
        plant_from_mesh(tmp_path / "flat.npz", MeshRules())
    corners = parts()["leaf_00"].triangles.copy()
    corners[0, 0, 0] = np.nan
    np.savez(tmp_path / "nan.npz", leaf_1=corners)
    with pytest.raises(InvalidInputError, match="'leaf_1' has corners that are not finite"):
        plant_from_mesh(tmp_path / "nan.npz", MeshRules())
    with pytest.raises(InvalidInputError, match=r"ending of the mesh file vine.stl must be one of '.glb'"):
        (tmp_path / "vine.stl").touch()
        plant_from_mesh(tmp_path / "vine.stl", MeshRules())


def test_subfolders_are_splits_whose_seeds_follow_the_names(tmp_path: Path) -> None:
    for place in ("train/b", "train/a", "held_out/c"):
        write_npz(tmp_path / f"{place}.npz", parts())
    plants = MeshSource.parse(tmp_path).plants
    assert {seed: path.stem for seed, path in plants.files.items()} == {0: "a", 1: "b", 2_000_000: "c"}
    assert plants.seeds("train") == [0, 1] and plants.seeds("all") == [0, 1, 2_000_000]
    assert plants.grow(1).preset == "b"
    with pytest.raises(InvalidInputError, match=r"no plants of the split 'validation' \(train: 2, valid"):
        plants.seeds("validation")
    with pytest.raises(
        InvalidInputError, match=r"no plant of seed 2; it has 0 to 1 \(train\), 2000000 \(held_out\)"
    ):
        plants.grow(2)


def test_a_plain_folder_is_split_by_name_and_plants_stay_when_others_come(tmp_path: Path) -> None:
    def splits() -> dict[str, str]:
        plants = MeshSource.parse(tmp_path, {"yaw": 0.001 * len(list(tmp_path.iterdir()))}).plants
        return {path.stem: plants.split_of(seed) for seed, path in plants.files.items()}

    for k in range(0, 60, 2):
        (tmp_path / f"plant_{k}.npz").touch()
    before = splits()
    for k in range(1, 60, 2):
        (tmp_path / f"plant_{k}.npz").touch()
    after = splits()
    assert before.items() <= after.items() and len(after) == 60
    counts = {split: list(after.values()).count(split) for split in SEED_SPLITS}
    assert 25 <= counts["train"] <= 47 and min(counts.values()) >= 5


def test_rules_of_a_folder_stand_in_its_toml_and_those_given_go_before(tmp_path: Path) -> None:
    meshes = {name.replace("leaf", "blade"): mesh for name, mesh in parts().items()}
    write_npz(tmp_path / "train" / "a.npz", meshes)
    (tmp_path / "mesh.toml").write_text('leaf = ["blade*"]\nyaw = 0.5\n', encoding="utf-8")
    plants = MeshSource.parse(tmp_path, {"yaw": 0.0}).plants
    assert plants.rules == MeshRules(leaf=("blade*",))
    check_whole(plants.grow(0))
    (tmp_path / "mesh.toml").write_text('leav = ["blade*"]\n', encoding="utf-8")
    with pytest.raises(InvalidInputError, match=r"mesh.toml: leav is unknown.*did you mean 'leaf'"):
        _ = MeshSource.parse(tmp_path, {"yaw": 0.2}).plants


def test_the_option_plant_takes_mesh_files_and_what_is_said_about_them(tmp_path: Path) -> None:
    file = write_npz(tmp_path / "set" / "validation" / "a.npz", parts())
    spec = PlantSpec.parse({"mesh": file, "yaw": 0.1}, PlantSpec())
    assert spec.seed == 0 and not spec.changes and spec.grow(0).preset == "a"
    folder = PlantSpec.parse({"mesh": str(tmp_path / "set"), "seed": "validation"}, PlantSpec(row=True))
    assert folder.changes and not folder.row and folder.first_seed == 1_000_000
    assert folder.draw_seed(np.random.RandomState(0)) == 1_000_000
    with pytest.raises(InvalidInputError, match=r"no plants of the split 'train' \(train: 0, validation: 1"):
        _ = PlantSpec.parse({"mesh": str(tmp_path / "set")}, PlantSpec()).first_seed
    row = PlantSpec.parse({"mesh": str(file), "row": True}, PlantSpec()).grow(0)
    assert isinstance(row, Row) and len(row.fruits) == 6 and row.middle_fruits == 2
    for wrong, message in (
        ({"mesh": file, "preset": "full"}, "no field 'preset' beside mesh"),
        ({"mesh": file, "unit": "cm"}, "did you mean 'units'"),
        ({"mesh": file, "units": "yd"}, "units must be one of 'm', 'cm', 'mm', 'in'; got 'yd'"),
        ({"mesh": tmp_path / "non"}, "there is no mesh file and no folder"),
        ({"mesh": str(tmp_path / "set"), "seed": "test"}, "plant seed must be one of 'train', .*got 'test'"),
        ({"mesh": file, "seed": 4}, "no plant of seed 4"),
        ({"mesh": tmp_path / "set", "pool": 0}, "pool must be an integer of 1 or more"),
        ({"units": "cm"}, "'units'; it goes with mesh="),
    ):
        with pytest.raises(InvalidInputError, match=message):
            PlantSpec.parse(wrong, PlantSpec())
