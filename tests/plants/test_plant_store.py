"""The store of plants: bounded in bytes, the oldest go first, its limit is an option."""

import subprocess
import sys

import pytest

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.generator import generate_plant
from maniskill_tomato.plants.plant_store import LIMIT_VARIABLE, ByteStore, plant_bytes, store_limit


def test_what_was_asked_for_longest_ago_goes_first() -> None:
    store, made = ByteStore(lambda: 30), []

    def get(name: str, size: int = 10) -> str:
        def make() -> str:
            made.append(name)
            return name.upper()

        return store.get(name, make, lambda thing: size)

    assert [get(name) for name in "abca"] == ["A", "B", "C", "A"]
    assert made == ["a", "b", "c"]
    get("d")
    assert [get(name) for name in "acd"] == ["A", "C", "D"] and made == ["a", "b", "c", "d"]
    get("b")
    assert made == ["a", "b", "c", "d", "b"]
    assert (store.size, len(store)) == (30, 3)
    assert get("large", 31) == "LARGE" and get("large", 31) == "LARGE"
    assert made[-2:] == ["large", "large"], "it fits nowhere"
    assert (store.size, len(store)) == (30, 3), "nothing had to go for it"
    get("two", 20)
    assert (store.size, len(store)) == (30, 2)


def test_no_store_keeps_nothing() -> None:
    store = ByteStore(lambda: 0)
    assert store.get("a", lambda: 1, lambda thing: 1) == 1
    assert (store.size, len(store)) == (0, 0)


def test_a_plant_takes_at_least_the_bytes_of_its_arrays() -> None:
    plant = generate_plant("one_tomato", 3)
    parts = [part for organ in plant.organs for part in organ.parts]
    own = sum(a.nbytes for p in parts for a in (p.vertices, p.normals, p.uvs, p.faces))
    derived = plant.vertices.nbytes + plant.faces.nbytes
    derived += sum(organ.vertices.nbytes + organ.faces.nbytes for organ in plant.organs)
    assert own + derived <= plant_bytes(plant) <= 1.3 * (own + derived)


@pytest.mark.parametrize("text", ["-1", "1.5", "", "much", "9" * 12, "\u0664"])
def test_a_limit_that_is_no_number_is_refused(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.setenv(LIMIT_VARIABLE, text)
    with pytest.raises(InvalidInputError, match="must be a whole number of megabytes"):
        store_limit.__wrapped__()


def test_the_variable_sets_the_limit_of_a_process() -> None:
    script = (
        "from maniskill_tomato.plants.generator import generate_plant\n"
        "from maniskill_tomato.plants.plant_store import PLANT_STORE, plant_bytes\n"
        "grow = lambda k: PLANT_STORE.get(k, lambda: generate_plant('one_tomato', k), plant_bytes)\n"
        "for seed in range(12): grow(seed)\n"
        "print(0 < PLANT_STORE.size <= 1_000_000, len(PLANT_STORE) < 12, grow(11) is grow(11))\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", script], env={LIMIT_VARIABLE: "1", "PATH": ""}, capture_output=True, text=True
    )
    assert result.stdout.split() == ["True"] * 3, result.stderr
