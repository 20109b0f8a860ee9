"""`benchmark --plants`: hidden starts on other plants, certified by the oracle, and policies on them."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments.certified_episodes import certified_list, parse_place
from maniskill_tomato.experiments.configs import BenchmarkConfig
from maniskill_tomato.experiments.result_store import ResultStore
from maniskill_tomato.experiments.viewpoint_benchmark import run_benchmark
from maniskill_tomato.plants.episode_list import load_episodes, read_episodes, write_episodes
from maniskill_tomato.tasks.making import make_world


def write_plant(path: Path, fruit: tuple[float, float, float]) -> None:
    """A stem, a ripe fruit and a sheet that hides it from the front, but not from the sides."""
    path.parent.mkdir(parents=True, exist_ok=True)
    x, y, z = fruit
    meshes = {
        "stem": trimesh.creation.box((0.02, 0.02, 1.2)).apply_translation([0, 0, 0.6]),
        "leaf_0": trimesh.creation.box((0.002, 0.2, 0.16)).apply_translation([x - 0.06, y, z]),
        "fruit_0": trimesh.creation.icosphere(subdivisions=1, radius=0.03).apply_translation(fruit),
    }
    arrays: dict[str, Any] = {name: mesh.triangles for name, mesh in meshes.items()}
    np.savez(path, **arrays)


def test_policies_run_on_hidden_starts_that_the_oracle_solves(tmp_path: Path) -> None:
    write_plant(tmp_path / "set" / "validation" / "a.npz", (-0.1, 0.0, 0.8))
    write_plant(tmp_path / "set" / "validation" / "b.npz", (-0.12, 0.05, 0.7))
    write_plant(tmp_path / "set" / "train" / "c.npz", (-0.12, 0.05, 0.7))
    options: dict[str, Any] = {
        "plants": f"{tmp_path / 'set'}:validation",
        "jobs": 1,
        "pictures": False,
        "out": tmp_path / "out",
    }
    result = run_benchmark(BenchmarkConfig(policies="lattice_oracle", episodes=2, **options))
    listed = read_episodes(tmp_path / "out" / "episodes_2.json")
    # In turn of the plants, all of them hidden at first, and solved by the oracle, which so solves them again.
    assert [e.plant_seed for e in listed] == [1_000_000, 1_000_001]
    assert all(e.certified and e.oracle_moves is not None and e.start_visibility < 0.3 for e in listed)
    (row,) = json.loads((tmp_path / "out" / "benchmark.json").read_text())
    assert row["success_rate"] == 1.0 and row["mean_moves"] == sum(e.oracle_moves or 0 for e in listed) / 2
    page = result.page.read_text(encoding="utf-8")
    assert "<dt>plants</dt><dd>2 of 2 (validation)</dd><dt>oracle</dt><dd>lattice_oracle</dd>" in page
    assert "lattice_oracle, the best that knows the truth" in page
    # Another plant under the same name is another benchmark.
    write_plant(tmp_path / "moved" / "validation" / "a.npz", (-0.1, 0.1, 0.8))
    with pytest.raises(InvalidInputError, match="another experiment.*plants differ"):
        run_benchmark(
            BenchmarkConfig(
                policies="lattice_oracle",
                episodes=1,
                **{**options, "plants": f"{tmp_path / 'moved'}:validation"},
            )
        )


def test_a_longer_list_begins_with_the_shorter_one_and_draws_are_kept(tmp_path: Path) -> None:
    write_plant(tmp_path / "set" / "held_out" / "a.npz", (-0.1, 0.0, 0.8))
    store = ResultStore(tmp_path / "out", {})
    lists = [
        certified_list(parse_place(str(tmp_path / "set")), count, store, tmp_path / "out", 1)
        for count in (1, 2, 1)
    ]
    one, two, again = (read_episodes(listed.path) for listed in lists)
    assert one == again == two[:1] and len(two) == 2
    assert two[0].camera_position != two[1].camera_position
    lines = (tmp_path / "out" / "results" / "certified" / "plants.jsonl").read_text().splitlines()
    assert len(lines) == 2  # Drawn for one episode, again for two; then nothing was missing.


def test_plants_of_other_kinds_of_ours_grow_until_there_are_enough_episodes(tmp_path: Path) -> None:
    place = parse_place("other_kind:validation")
    store = ResultStore(tmp_path / "out", {})
    lists = [certified_list(place, count, store, tmp_path / "out", 1) for count in (2, 3)]
    two, three = (read_episodes(listed.path) for listed in lists)
    assert two == three[:2] and len(three) == 3 and lists[0].plant["preset"] == "other_kind"
    seeds = [e.plant_seed for e in three]
    # One plant after the other, with two episodes at most on each, of the validation split.
    assert seeds == sorted(seeds) and 1_000_000 <= seeds[0] and max(map(seeds.count, seeds)) <= 2
    # The list says on which plants it was drawn.
    world = make_world("TomatoViewpoint-v1", episodes=str(lists[1].path))
    for number, episode in enumerate(three):
        world.reset(options={"episode": number})
        assert float(world.state.visible_fraction[0]) == pytest.approx(episode.start_visibility, abs=1e-4)
        assert world.state.visible_fraction[0] < 0.3


def test_a_list_that_names_its_plants_wrongly_is_refused(tmp_path: Path) -> None:
    write_episodes(tmp_path / "list.json", load_episodes("validation")[:1], {"preset": "other_kind"})
    text = (tmp_path / "list.json").read_text()
    (tmp_path / "list.json").write_text(text.replace('{"preset": "other_kind"}', '"other_kind"'))
    with pytest.raises(InvalidInputError, match="`plant` of .* must be a table"):
        make_world("TomatoViewpoint-v1", episodes=str(tmp_path / "list.json"))


def test_plants_out_of_reach_are_told(tmp_path: Path) -> None:
    write_plant(tmp_path / "set" / "held_out" / "high.npz", (-0.1, 0.0, 2.6))
    config = BenchmarkConfig(
        policies="nbv", episodes=2, plants=str(tmp_path / "set"), jobs=1, pictures=False, out=tmp_path / "out"
    )
    with pytest.raises(InvalidInputError, match="solves only 0 episodes on the 1 plants.*reach"):
        run_benchmark(config)


def test_which_plants_are_meant_is_checked_before_anything_runs(tmp_path: Path) -> None:
    write_plant(tmp_path / "set" / "train" / "a.npz", (-0.1, 0.0, 0.8))
    assert parse_place(f"{tmp_path / 'set'}:all").split == "all"
    for change, message in (
        ({"plants": str(tmp_path / "set")}, "no plants of the split 'held_out'"),
        ({"plants": f"{tmp_path / 'set'}:test"}, "split of --plants FOLDER:SPLIT must be one of"),
        ({"plants": str(tmp_path / "none")}, "no folder .*none; .*a kind of ours: varied, other_kind"),
        (
            {"plants": "other_kind:all"},
            "split of --plants FOLDER:SPLIT must be one of 'train', 'validation', 'held_out'",
        ),
        ({"plants": f"{tmp_path / 'set'}:train", "sweeps": "all"}, "leave out --sweeps"),
        ({"plants": f"{tmp_path / 'set'}:train", "episodes": 0}, "--episodes must be 1 or more"),
    ):
        options: dict[str, Any] = {"policies": "nbv", "episodes": 1, **change}
        with pytest.raises(InvalidInputError, match=message):
            run_benchmark(BenchmarkConfig(out=tmp_path / "out", **options))
    assert not (tmp_path / "out").exists()
