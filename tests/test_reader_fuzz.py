"""Files of strangers: whatever is done to a good one, each reader gives its content or one error in words.

`tests/corpus` holds a small good file of each kind, and some that once broke a reader. Hypothesis draws what is done
to their bytes.
"""

import shutil
import tempfile
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from maniskill_tomato.array_files import read_arrays
from maniskill_tomato.deploy.calibration.view_folder import read_views
from maniskill_tomato.deploy.profile import load_profile
from maniskill_tomato.deploy.run_replay import load_recording
from maniskill_tomato.errors import TomatoError
from maniskill_tomato.experiments.result_store import ResultStore
from maniskill_tomato.experiments.training_runs import read_columns
from maniskill_tomato.files import read_tensors
from maniskill_tomato.plants.episode_list import read_episodes
from maniskill_tomato.plants.mesh_files import read_objects
from maniskill_tomato.plants.mesh_rules import MeshRules
from maniskill_tomato.policies.description import PolicyDescription
from maniskill_tomato.segmentation.datasets.coco import read_coco
from maniskill_tomato.segmentation.datasets.picture_files import read_depth, read_picture
from maniskill_tomato.segmentation.datasets.voc import read_voc
from maniskill_tomato.segmentation.training.yolo_training import read_history
from maniskill_tomato.tables import read_table
from maniskill_tomato.text_files import read_toml

CORPUS = Path(__file__).parent / "corpus"

SECONDS_OF_A_FILE = 10.0
"""Of processor time; a reader that takes longer over a file of a few kB hangs."""


@dataclass(frozen=True)
class Reader:
    """What reads a file, and the files of the corpus that are mutated for it."""

    read: Callable[[Path], object]
    seeds: tuple[str, ...]
    beside: tuple[str, ...] = ()
    """Other files of the corpus that must lie in its folder."""


def _calibrated(path: Path) -> object:
    profile = path.with_name("calibrated.toml")
    profile.write_text(f'{(CORPUS / "profile.toml").read_text()}\n[calibration]\nfile = "{path.name}"\n')
    return load_profile(str(profile))


def _results(path: Path) -> object:
    store = ResultStore(path.parent, {"env_id": "x"})
    place = path.parent / "results" / "part" / "name.jsonl"
    place.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(path, place)
    return store.read("part", "name")


READERS = {
    "profile": Reader(lambda p: load_profile(str(p)), ("profile.toml", "profile_int_400_digits.toml")),
    "calibration": Reader(_calibrated, ("calibration.json",)),
    "board views": Reader(lambda p: read_views(p.parent), ("views.json",), ("picture.png",)),
    "board picture": Reader(lambda p: read_views(p.parent), ("picture.png",), ("views.json",)),
    "picture": Reader(read_picture, ("picture.jpg", "picture.png", "truncated.jpg")),
    "depth": Reader(read_depth, ("depth.png",)),
    "coco": Reader(read_coco, ("coco.json", "coco_mask_of_1e10_pixels.json"), ("picture.jpg",)),
    "voc": Reader(
        lambda p: read_voc(p.parent),
        ("voc.xml", "voc_infinite_width.xml", "voc_unknown_encoding.xml", "voc_utf7.xml"),
        ("picture.jpg",),
    ),
    "arrays": Reader(read_arrays, ("mesh.npz",)),
    "mesh": Reader(read_objects, ("mesh.npz", "mesh.glb", "mesh.ply", "mesh.obj")),
    "mesh rules": Reader(lambda p: read_table(MeshRules, read_toml(p), p), ("mesh_rules.toml",)),
    "tensors": Reader(read_tensors, ("tensors.pt",)),
    "policy description": Reader(
        lambda p: PolicyDescription.from_json(p.read_text(errors="replace")), ("description.json",)
    ),
    "episode list": Reader(read_episodes, ("episodes.json",)),
    "episodes of a run": Reader(read_columns, ("episodes.csv",)),
    "epochs of YOLO": Reader(read_history, ("results.csv",)),
    "recording": Reader(load_recording, ("recording.mcap", "recording_json.mcap")),
    "results": Reader(_results, ("results.jsonl",)),
    "settings": Reader(lambda p: ResultStore(p.parent, {"env_id": "x"}), ("settings.json",)),
}

HARD_WORDS = (
    *(
        b"\x00",
        b"\xff" * 4,
        b"\x7f\xff\xff\xff",
        b"\xff\xff\xff\x7f",
        b"-1",
        b"NaN",
        b"1e999",
        b"-0",
        b'"',
        b"[" * 90,
    ),
    *(
        b"9" * 400,
        b"{",
        b"<!DOCTYPE a [<!ENTITY b SYSTEM 'file:///etc/passwd'>]>",
        b"\xed\xa0\x80",
        b"../../",
        b"\n",
    ),
)

EDITS = st.lists(
    st.tuples(
        st.floats(0.0, 1.0),
        st.integers(0, 12),
        st.sampled_from(HARD_WORDS) | st.binary(max_size=6),
    ),
    min_size=1,
    max_size=6,
)
"""Where, how many bytes go, and what takes their place."""


def mutated(content: bytes, edits: list[tuple[float, int, bytes]], cut: float) -> bytes:
    """The content with edits, and without its end."""
    for where, gone, new in edits:
        at = int(where * len(content))
        content = content[:at] + new + content[at + gone :]
    return content[: int(cut * len(content)) + 1]


def read_mutated(reader: Reader, seed: str, content: bytes) -> None:
    """Reads a file; anything but a value or one of our errors fails the test."""
    with tempfile.TemporaryDirectory() as place, warnings.catch_warnings(action="ignore"):
        for name in reader.beside:
            shutil.copyfile(CORPUS / name, Path(place) / name)
        path = Path(place) / seed
        path.write_bytes(content)
        began = time.process_time()
        try:
            reader.read(path)
        except TomatoError as error:
            assert str(error) and len(str(error)) < 4000
        assert time.process_time() - began < SECONDS_OF_A_FILE


def fuzz(name: str, examples: int) -> None:
    reader = READERS[name]

    @settings(
        max_examples=examples,
        deadline=None,
        database=None,
        phases=(Phase.explicit, Phase.generate, Phase.shrink),
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
    )
    @given(seed=st.sampled_from(reader.seeds), edits=EDITS, cut=st.just(1.0) | st.floats(0.0, 1.0))
    def run(seed: str, edits: list[tuple[float, int, bytes]], cut: float) -> None:
        read_mutated(reader, seed, mutated((CORPUS / seed).read_bytes(), edits, cut))

    run()


@pytest.mark.parametrize("name", READERS)
def test_every_file_of_the_corpus_is_read_or_refused_in_words(name: str) -> None:
    for seed in READERS[name].seeds:
        content = (CORPUS / seed).read_bytes()
        for changed in (content, b"", content[: len(content) // 2], content * 2):
            read_mutated(READERS[name], seed, changed)


def test_the_first_file_of_each_reader_is_a_good_one(tmp_path: Path) -> None:
    for name, reader in READERS.items():
        folder = tmp_path / name
        folder.mkdir()
        for file in (*reader.beside, reader.seeds[0]):
            shutil.copyfile(CORPUS / file, folder / file)
        reader.read(folder / reader.seeds[0])


@pytest.mark.parametrize("name", READERS)
def test_a_mutated_file_is_read_or_refused_in_words(name: str) -> None:
    fuzz(name, 15)


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
def test_many_mutated_files_are_read_or_refused_in_words(name: str) -> None:
    fuzz(name, 1500)
