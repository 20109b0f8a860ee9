"""The example that grows plants with pyhelios3d: run with a stand-in, as the real one is no dependency."""

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from maniskill_tomato.plants.mesh_set import MeshSource

SCRIPT = Path(__file__).resolve().parent.parent / "examples" / "helios_plants.py"
RED, GREEN = (0.4, 0.2, 0.08), (0.26, 0.38, 0.1)
STEM, PETIOLE, LEAF, RIPE, PICKED = 1, 2, 3, 4, 5


@pytest.fixture
def example() -> Any:
    spec = importlib.util.spec_from_file_location("helios_plants", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["helios_plants"] = module
    spec.loader.exec_module(module)
    return module


def octahedron(z: float, radius: float = 0.04) -> list[Any]:
    tips = radius * np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]]) + [
        0.1,
        0,
        z,
    ]
    return [tips[[i, (i + 1) % 4, pole]] for i in range(4) for pole in (4, 5)]


class Context:
    """Five objects: a stem, a petiole, a blade with a texture, a fruit with a calyx, and one below the leaf."""

    def __enter__(self) -> "Context":
        return self

    def __exit__(self, *_: object) -> None: ...

    def seedRandomGenerator(self, seed: int) -> None:
        self.seed = seed

    def getObjectPrimitiveUUIDs(self, number: int) -> list[int]:
        return [100 * number + k for k in range(len(self.shapes(number)))]

    def shapes(self, number: int) -> list[tuple[Any, Any]]:
        upright = [
            np.array([[0, 0, 0], [0.02, 0, 0], [0, 0, 0.5]]),
            np.array([[0, 0, 0.2], [0.02, 0, 0.2], [0, 0, 1]]),
        ]
        blade = [np.array([[0.0, 0, 0.4], [0.2, 0, 0.4], [0.2, 0.2, 0.4]]), upright[1] * 0.1 + [0, 0, 0.4]]
        patch = np.array([[0.0, 0.01, 0.5], [0.0, 0.02, 0.5], [0.0, 0.02, 0.7], [0.0, 0.01, 0.7]])
        return {
            STEM: [(upright[0], GREEN), (patch, GREEN), (upright[1], GREEN)],
            PETIOLE: [(upright[0] * 0.1 + [0, 0, 0.4], GREEN)],
            LEAF: [(t, GREEN) for t in blade],
            RIPE: [*((t, RED) for t in octahedron(0.45)), (octahedron(0.5, 0.01)[0], GREEN)],
            PICKED: [(t, RED) for t in octahedron(0.2)],
        }[number]

    def shape(self, uuid: int) -> tuple[Any, Any]:
        return self.shapes(uuid // 100)[uuid % 100]

    def getPrimitiveVertices(self, uuids: list[int]) -> tuple[Any, Any]:
        corners = [np.ravel(self.shape(uuid)[0]) for uuid in uuids]
        return np.concatenate(corners), np.cumsum([0, *map(len, corners)], dtype=np.uint32)

    def getPrimitiveColor(self, uuids: list[int]) -> Any:
        return np.array([self.shape(uuid)[1] for uuid in uuids], dtype=np.float32)

    def getPrimitiveTextureFile(self, uuids: list[int]) -> list[str]:
        return ["leaf.png" if uuid == 100 * LEAF else "" for uuid in uuids]

    def getPrimitiveSolidFraction(self, uuids: list[int]) -> Any:
        return np.full(len(uuids), 0.5)

    def getPrimitiveTextureUV(self, uuid: int) -> list[Any]:
        return [SimpleNamespace(x=u, y=v) for u, v in ((0, 0), (1, 0), (1, 1))]


class Architecture:
    def __init__(self, context: Context) -> None: ...
    def __enter__(self) -> "Architecture":
        return self

    def __exit__(self, *_: object) -> None: ...
    def disableMessages(self) -> None: ...
    def loadPlantModelFromLibrary(self, label: str) -> None: ...

    def buildPlantInstanceFromLibrary(self, base_position: Any, age: float) -> int:
        return 0

    def getPlantFruitObjectIDs(self, plant: int) -> list[int]:
        return [RIPE, PICKED]

    def getPlantLeafObjectIDs(self, plant: int) -> list[int]:
        return [LEAF]

    def getPlantPetioleObjectIDs(self, plant: int) -> list[int]:
        return [PETIOLE]

    def getAllPlantObjectIDs(self, plant: int) -> list[int]:
        return [STEM, PETIOLE, LEAF, RIPE, PICKED]


def test_a_set_of_plants_is_written_that_the_tasks_read(
    tmp_path: Path, example: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    helios, types = ModuleType("pyhelios"), ModuleType("pyhelios.types")
    vars(types)["vec3"] = lambda *point: point
    vars(helios).update(Context=Context, PlantArchitecture=Architecture, types=types)
    monkeypatch.setitem(sys.modules, "pyhelios", helios)
    monkeypatch.setitem(sys.modules, "pyhelios.types", types)
    example._alpha["leaf.png"] = np.ones((8, 8)) * (np.arange(8) < 4)  # The left half is leaf.
    arguments = ["x", "--out", str(tmp_path), "--split", "validation", "--count", "2", "--species", "tomato"]
    monkeypatch.setattr(sys, "argv", arguments)
    example.main()
    plants = MeshSource.parse(tmp_path).plants
    assert list(plants.files) == [1_000_000, 1_000_001]
    plant = plants.grow(1_000_000)
    assert {organ.name for organ in plant.organs} == {"stem", "leaf_000", "fruit_ripe_00", "stem_calyx_00"}
    stem = next(organ for organ in plant.organs if organ.name == "stem")
    assert len(stem.faces) == 4  # Two triangles, and a patch of four corners.
    (fruit,) = plant.fruits
    assert fruit.ripeness == "ripe" and 0.68 <= float(fruit.centre[2]) <= 0.88
    told = json.loads((tmp_path / "plants_validation.json").read_text())
    assert [entry["file"] for entry in told] == [path.name for path in plants.files.values()]
    assert told[0]["seed"] != told[1]["seed"] and told[0]["ripe_fruits"] == 1
    before = plants.files[1_000_000].read_bytes()
    example.main()  # What is there is not grown again.
    assert plants.files[1_000_000].read_bytes() == before


def test_a_triangle_is_cut_along_its_textures_outline(example: Any) -> None:
    triangle = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0]])
    alpha = np.ones((200, 200)) * (np.arange(200) < 100)
    pieces = example._clipped(triangle, triangle[:, :2], alpha)
    across = np.cross(pieces[:, 1] - pieces[:, 0], pieces[:, 2] - pieces[:, 0])[:, 2]
    # Left of u = 0.5 lies a quarter of the triangle's area of 0.5; the cut is linear on each of four pieces.
    assert across.sum() / 2 == pytest.approx(0.125, abs=0.07) and (across > -1e-12).all()
    assert len(example._clipped(triangle, triangle[:, :2], np.zeros((8, 8)))) == 0
    np.testing.assert_allclose(
        example._clipped(triangle, triangle[:, :2], np.ones((8, 8))).reshape(-1, 3).max(0), [1, 1, 0]
    )


def test_without_pyhelios_the_error_says_how_to_run_it(
    example: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "pyhelios", None)
    monkeypatch.setattr(sys, "argv", ["x", "--out", str(tmp_path / "none")])
    with pytest.raises(SystemExit, match="environment of its own that has pyhelios3d.*uv run"):
        example.main()
    assert not (tmp_path / "none").exists()
