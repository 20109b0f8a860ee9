"""Plants that worker processes grow ahead: the same episodes, and processes that end with their environment."""

import gc
import logging
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from process_watch import is_running, until

import maniskill_tomato  # noqa: F401
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants import growers as growers_module
from maniskill_tomato.plants.generator import generate_plant
from maniskill_tomato.plants.growers import PlantGrowers
from maniskill_tomato.plants.organs import Plant
from maniskill_tomato.plants.plant_store import ByteStore
from maniskill_tomato.plants.spec import PlantSpec
from maniskill_tomato.task_registry import TASK_IDS

GUIDED, _, GENERAL, _ = TASK_IDS

SPLIT = PlantSpec(seed="train")

NEEDS_PROC = pytest.mark.skipif(
    not Path("/proc/self/stat").exists(), reason="reads the states of processes from /proc"
)


@pytest.fixture(autouse=True)
def _a_store_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """No plant is there before a test."""
    monkeypatch.setattr(growers_module, "PLANT_STORE", ByteStore(lambda: 200_000_000))


@pytest.fixture
def growers() -> Iterator[PlantGrowers]:
    made = PlantGrowers(SPLIT, 2)
    yield made
    made.close()


def assert_same_plant(plant: Plant, other: Plant) -> None:
    """Bit for bit."""
    assert (plant.preset, plant.seed, plant.detail) == (other.preset, other.seed, other.detail)
    assert [organ.name for organ in plant.organs] == [organ.name for organ in other.organs]
    for organ, twin in zip(plant.organs, other.organs, strict=True):
        assert organ.semantic_class is twin.semantic_class
        for part, same in zip(organ.parts, twin.parts, strict=True):
            assert (part.material, part.two_sided) == (same.material, same.two_sided)
            for name in ("vertices", "normals", "uvs", "faces"):
                array, expected = getattr(part, name), getattr(same, name)
                assert array.dtype == expected.dtype
                np.testing.assert_array_equal(array, expected)
    for fruit, same_fruit in zip(plant.fruits, other.fruits, strict=True):
        assert (fruit.organ_index, fruit.radius, fruit.ripeness) == (
            same_fruit.organ_index,
            same_fruit.radius,
            same_fruit.ripeness,
        )
        np.testing.assert_array_equal(fruit.centre, same_fruit.centre)


def test_workers_grow_the_plants_of_the_seeds_before_they_are_asked_for(
    growers: PlantGrowers, monkeypatch: pytest.MonkeyPatch
) -> None:
    growers.expect({0: 7, 1: 8, 2: 7})
    growers.wait()
    monkeypatch.setattr(PlantSpec, "grow", lambda self, seed: pytest.fail("grown here"))
    shown = growers.plants({0: 7, 1: 8, 2: 7})
    assert shown[0] is shown[2], "one plant however many environments look at it"
    for env_index, seed in ((0, 7), (1, 8)):
        assert_same_plant(shown[env_index], generate_plant("one_tomato", seed))


def test_plants_that_nobody_expected_are_grown_too(growers: PlantGrowers) -> None:
    growers.expect({0: 7})
    shown = growers.plants({0: 9, 3: 10, 4: 11})
    assert {i: plant.seed for i, plant in shown.items()} == {0: 9, 3: 10, 4: 11}
    assert_same_plant(shown[3], generate_plant("one_tomato", 10))


@NEEDS_PROC
def test_plants_of_workers_that_were_killed_are_grown_here(
    growers: PlantGrowers, caplog: pytest.LogCaptureFixture
) -> None:
    growers.expect(dict(enumerate(range(20))))
    for pid in growers.process_ids:
        os.kill(pid, signal.SIGKILL)
    growers.wait()
    with caplog.at_level(logging.WARNING):
        assert until(lambda: len(caplog.records) == 2)
    assert "has ended early" in caplog.text
    assert_same_plant(growers.plants({5: 5})[5], generate_plant("one_tomato", 5))


@NEEDS_PROC
def test_a_closed_one_ends_its_workers_and_goes_on_alone(growers: PlantGrowers) -> None:
    growers.expect(dict(enumerate(range(50))))
    pids = growers.process_ids
    growers.close()
    assert len(pids) == 2 and not any(map(is_running, pids))
    assert growers.plants({0: 3})[0].seed == 3


def episodes(env_id: str, **options: Any) -> list[np.ndarray[Any, Any]]:
    """What environments show and where their arms are, over resets of all, of some, and with new seeds."""
    envs: Any = gym.make_vec(
        env_id, 3, "vector_entry_point", autoreset_mode="SameStep", max_episode_steps=2, **options
    )
    world, actions = envs.unwrapped.world, np.full(envs.action_space.shape, 0.02, np.float32)
    told: list[np.ndarray[Any, Any]] = []

    def tell(observation: Any) -> None:
        told.extend((observation, world.state.plant_seed.numpy().copy(), world.qpos.numpy()))
        told.extend(plant.vertices for plant in world.plant_batch.plants)

    tell(envs.reset(seed=5)[0])
    for _ in range(3):
        tell(envs.step(actions)[0])
    tell(envs.reset(options={"reset_mask": np.array([True, False, True])})[0])
    tell(envs.reset(seed=[11, 5, 12])[0])
    tell(envs.reset()[0])
    envs.close()
    return told


@pytest.mark.parametrize(
    ("env_id", "plant"),
    [
        (GUIDED, {"seed": "train"}),
        pytest.param(GENERAL, {"seed": "train", "pool": 5}, marks=pytest.mark.slow),
    ],
)
def test_episodes_are_the_same_with_and_without_growers(
    env_id: str, plant: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    alone = episodes(env_id, plant=plant)
    monkeypatch.setattr(growers_module, "PLANT_STORE", ByteStore(lambda: 0))
    with_growers = episodes(env_id, plant=plant, growers=2)
    assert len({seeds.tobytes() for seeds in alone[1::6]}) > 3, "plants changed"
    for array, expected in zip(with_growers, alone, strict=True):
        np.testing.assert_array_equal(array, expected)


def test_the_plants_of_the_next_episodes_are_those_that_are_expected(monkeypatch: pytest.MonkeyPatch) -> None:
    """A reset then grows nothing itself."""
    envs: Any = gym.make_vec(GUIDED, 4, "vector_entry_point", plant={"seed": "train"}, growers=1).unwrapped
    envs.reset(seed=0)
    monkeypatch.setattr(PlantSpec, "grow", lambda self, seed: pytest.fail("grown here"))
    for _ in range(3):
        envs.world.plant_batch.growers.wait()
        before = envs.world.plant_batch.seeds
        envs.reset()
        assert envs.world.plant_batch.seeds != before
    envs.close()


@NEEDS_PROC
def test_workers_end_with_their_environment() -> None:
    envs: Any = gym.make_vec(GUIDED, 2, "vector_entry_point", plant={"seed": "train"}, growers=2)
    pids = envs.unwrapped.world.plant_batch.growers.process_ids
    assert len(pids) == 2 and all(map(is_running, pids))
    envs.close()
    assert not any(map(is_running, pids))
    forgotten: Any = gym.make_vec(GUIDED, 2, "vector_entry_point", plant={"seed": "train"}, growers=1)
    (pid,) = forgotten.unwrapped.world.plant_batch.growers.process_ids
    del forgotten
    gc.collect()
    assert until(lambda: not is_running(pid))


SCRIPT = """
import signal, sys, time
from maniskill_tomato.plants.growers import PlantGrowers
from maniskill_tomato.plants.spec import PlantSpec

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # A shell in the background leaves it ignored.
    growers = PlantGrowers(PlantSpec(seed="train"), 2)
    growers.expect(dict(enumerate(range(1000))))
    print(*growers.process_ids, flush=True)
    if sys.argv[1] == "return":
        sys.exit()
    while True:
        time.sleep(0.1)  # One long sleep would go on after a signal that arrives just before it.
"""


@NEEDS_PROC
@pytest.mark.parametrize("end", ["return", "SIGINT", "SIGTERM", "SIGKILL"])
def test_workers_end_with_the_process_that_started_them(tmp_path: Path, end: str) -> None:
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    command = [sys.executable, str(script), end]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as parent:
        assert parent.stdout is not None
        pids = [int(pid) for pid in parent.stdout.readline().split()]
        assert len(pids) == 2
        if end != "return":
            parent.send_signal(getattr(signal, end))
    assert until(lambda: not any(map(is_running, pids)))


def test_growers_without_anything_to_grow_are_refused() -> None:
    with pytest.raises(InvalidInputError, match=r"growers=2 have nothing to grow.*plant=\{'seed': 'train'\}"):
        gym.make_vec(GUIDED, 2, "vector_entry_point", growers=2)
    with pytest.raises(InvalidInputError, match="growers must be an integer of 0 or more; got -1"):
        gym.make_vec(GUIDED, 2, "vector_entry_point", plant={"seed": "train"}, growers=-1)
