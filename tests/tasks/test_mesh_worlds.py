"""The four tasks on plants from mesh files: who is the target, what hides it, lists of episodes, saved states."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from maniskill_tomato.plants.episode_list import Episode
from maniskill_tomato.tasks import TASK_IDS
from maniskill_tomato.tasks.making import make_world

RIPE = (-0.12, 0.05, 0.75)


def make_set(folder: Path, count: int) -> Path:
    """Plants of a stem, a fruit of 3 cm at `RIPE`, a green one above, and a sheet before them; they differ in yaw."""
    folder.mkdir(parents=True)
    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.03)
    stem = trimesh.creation.box((0.02, 0.02, 1.2))
    sheet = trimesh.Trimesh(
        [[-0.2, -0.1, 0.65], [-0.2, 0.1, 0.65], [-0.2, 0, 0.9]], [[0, 1, 2]], process=False
    )
    for k in range(count):
        meshes = {
            "stem": stem.copy().apply_translation([0, 0, 0.6]),
            "leaf_0": sheet.copy(),
            "fruit_0": ball.copy().apply_translation(RIPE),
            "fruit_green_1": ball.copy().apply_translation([0.02, -0.08, 0.9]),
        }
        turn = trimesh.transformations.rotation_matrix(0.1 * k, [0, 0, 1])
        arrays: dict[str, Any] = {n: m.apply_transform(turn).triangles for n, m in meshes.items()}
        np.savez(folder / f"plant_{k}.npz", **arrays)
    return folder


@pytest.mark.parametrize("env_id", TASK_IDS)
def test_a_mesh_is_the_plant_of_every_task(tmp_path: Path, env_id: str) -> None:
    folder = make_set(tmp_path / "set", 1)
    world = make_world(env_id, 2, plant={"mesh": str(folder / "plant_0.npz")}, plant_pose=(0.85, 0.1, 0.0))
    world.reset(3)
    assert world.plant_batch.plants[0] is world.plant_batch.plants[1]
    assert world.state.target.tolist() == [0, 0]  # The only ripe one.
    at = world.target_position_w - world.plant_batch.position_w
    c, s = world.plant_batch.yaw.cos(), world.plant_batch.yaw.sin()
    expected = torch.stack(
        [c * RIPE[0] - s * RIPE[1], s * RIPE[0] + c * RIPE[1], torch.full_like(c, RIPE[2])], dim=-1
    )
    torch.testing.assert_close(at, expected, atol=1e-5, rtol=0.0)
    world.step(torch.zeros(2, 6 if env_id in TASK_IDS[:2] else 3))
    fraction = world.state.visible_fraction
    assert bool(((fraction >= 0.0) & (fraction <= 1.0)).all())


def test_resets_draw_the_plants_of_a_split_and_states_keep_which(tmp_path: Path) -> None:
    make_set(tmp_path / "set" / "train", 3)
    make_set(tmp_path / "set" / "held_out", 1)
    world = make_world("TomatoViewpoint-v1", plant={"mesh": str(tmp_path / "set")})
    seen = set()
    for seed in range(12):
        world.reset(seed)
        seen.add(world.plant_batch.plants[0].preset)
        assert world.plant_batch.plants[0].seed == world.plant_batch.seeds[0]
    assert seen == {"plant_0", "plant_1", "plant_2"} and max(world.plant_batch.seeds) <= 2
    again = make_world("TomatoViewpoint-v1", plant={"mesh": str(tmp_path / "set")})
    again.reset(11)
    torch.testing.assert_close(again.belief.observation, world.belief.observation)


def test_a_list_of_episodes_names_plants_of_every_split(tmp_path: Path) -> None:
    make_set(tmp_path / "set" / "validation", 1)
    make_set(tmp_path / "set" / "held_out", 2)
    episodes = [
        Episode(
            plant_seed=seed,
            leaf_density=1.0,
            plant_pose=(0.9, 0.0, 0.0),
            target=0,
            camera_position=(0.4, -0.1, 0.75),
            start_visibility=0.0,
        )
        for seed in (2_000_001, 1_000_000)
    ]
    world = make_world("TomatoViewpoint-v1", episodes=episodes, plant={"mesh": str(tmp_path / "set")})
    for number, episode in enumerate(episodes):
        world.reset(options={"episode": number})
        assert world.plant_batch.plants[0].seed == episode.plant_seed
        assert world.belief.camera_position[0].tolist() == pytest.approx(episode.camera_position, abs=1e-4)
