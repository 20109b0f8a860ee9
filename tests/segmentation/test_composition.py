"""The thesis's sets of rendered images and photos, drawn from files that are no pictures: nothing is decoded."""

from pathlib import Path

import numpy as np
import pytest

from maniskill_tomato.cli import main
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.segmentation.datasets.annotations import AnnotatedImage, AnnotatedImages, Instance
from maniskill_tomato.segmentation.datasets.coco import write_coco
from maniskill_tomato.segmentation.datasets.composition import (
    PARTS,
    Counts,
    Part,
    compose,
)
from maniskill_tomato.segmentation.datasets.reading import read_place
from maniskill_tomato.segmentation.masks import EncodedMask
from maniskill_tomato.segmentation.training.training_pictures import TrainingImages

SMALL: dict[Part, Counts] = {
    "train": Counts(rendered=4, photos=3),
    "validation": Counts(rendered=2, photos=2),
    "test": Counts(rendered=1, photos=1),
}


def annotated(folder: Path, count: int, masks: bool) -> str:
    """A folder of so many images with one fruit each; every file has other bytes."""
    (folder / "images").mkdir(parents=True)
    mask = np.zeros((8, 8), bool)
    mask[2:6, 2:6] = True
    fruit = Instance(
        category="tomato_ripe" if masks else "tomato",
        box_xywh=(2.0, 2.0, 4.0, 4.0),
        visible_mask=EncodedMask.encode(mask) if masks else None,
    )
    images = []
    for k in range(count):
        path = folder / "images" / f"{k:04d}.jpg"
        path.write_text(f"{folder.name} {k}")
        images.append(
            AnnotatedImage(path=path, file_name=f"images/{path.name}", width=8, height=8, instances=(fruit,))
        )
    write_coco(AnnotatedImages(images=tuple(images)), folder)
    return str(folder)


def contents(found: dict[Part, AnnotatedImages]) -> dict[Part, set[str]]:
    """What the files of each part hold, which tells where they come from."""
    return {part: {image.path.read_text() for image in found[part].images} for part in PARTS}


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str]:
    folder = tmp_path_factory.mktemp("places")
    return annotated(folder / "rendered", 420, masks=True), annotated(folder / "photos", 210, masks=False)


def test_the_sets_have_the_thesis_s_numbers_and_grow_from_strategy_to_strategy(
    tmp_path: Path, places: tuple[str, str]
) -> None:
    rendered, photos = places
    one = contents(compose("strategy-1", [rendered], [photos], tmp_path / "1"))
    two = contents(compose("strategy-2", [rendered], [photos], tmp_path / "2"))
    three = contents(compose("strategy-3", [rendered], [photos], tmp_path / "3"))
    for texts, simulated, real in (
        (one["train"], 103, 50),
        (one["validation"], 68, 30),
        (two["train"], 144, 76),
    ):
        kinds = [text.split()[0] for text in texts]
        assert (kinds.count("rendered"), kinds.count("photos")) == (simulated, real)
    # Tables 4-3 and 4-4, and the 40 test images.
    for found, sizes in ((one, (153, 98, 40)), (two, (220, 125, 40))):
        assert tuple(len(found[part]) for part in ("train", "validation", "test")) == sizes
    for found in (one, two, three):
        assert sum(map(len, found.values())) == len(set().union(*found.values())), "an image is in two parts"
    for part in PARTS:
        assert one[part] <= two[part] <= three[part]
    assert one["test"] == three["test"]


def test_yolo_has_photos_alone(tmp_path: Path, places: tuple[str, str]) -> None:
    found = compose("yolo", [], [places[1]], tmp_path / "yolo")
    assert [len(found[part].images) for part in ("train", "validation", "test")] == [120, 30, 50]


def test_a_seed_draws_the_same_images_again_and_another_seed_others(
    tmp_path: Path, places: tuple[str, str]
) -> None:
    drawn = [
        contents(compose("strategy-1", [places[0]], [places[1]], tmp_path / name, seed=seed, counts=SMALL))
        for name, seed in (("a", 3), ("b", 3), ("a", 3), ("c", 4))
    ]
    assert drawn[0] == drawn[1] == drawn[2]
    assert drawn[0] != drawn[3]


def test_photos_give_boxes_and_no_masks_and_train_no_masks(tmp_path: Path, places: tuple[str, str]) -> None:
    masked = annotated(tmp_path / "masked_photos", 6, masks=True)
    compose("strategy-1", [places[0]], [masked], tmp_path / "out", counts=SMALL)
    images = read_place(f"{tmp_path / 'out'}:train").images
    with_masks = {
        image.path.read_text().split()[0]: [i.visible_mask is not None for i in image.instances]
        for image in images
    }
    assert with_masks == {"rendered": [True], "masked_photos": [False]}
    assert all(image.fruits[0].box_xywh == (2, 2, 4, 4) for image in images)
    photos = [image for image in images if not image.fruits[0].visible_mask]
    assert not TrainingImages(sets=[photos]).with_masks


def test_each_part_can_have_a_place_of_its_own(tmp_path: Path, places: tuple[str, str]) -> None:
    others = [annotated(tmp_path / name, 5, masks=True) for name in ("t", "v", "e")]
    found = contents(compose("strategy-1", others, [places[1]], tmp_path / "out", counts=SMALL))
    kinds = {part: {text.split()[0] for text in texts} for part, texts in found.items()}
    assert kinds == {"train": {"t", "photos"}, "validation": {"v", "photos"}, "test": {"e", "photos"}}


def test_what_cannot_be_composed_is_said(tmp_path: Path, places: tuple[str, str]) -> None:
    rendered, photos = places
    few = annotated(tmp_path / "few", 3, masks=True)
    out = tmp_path / "out"
    with pytest.raises(InvalidInputError, match="has 3 rendered images, 7 are needed"):
        compose("strategy-1", [few], [photos], out, counts=SMALL)
    with pytest.raises(InvalidInputError, match="holds no masks"):
        compose("strategy-1", [photos], [photos], out, counts=SMALL)
    with pytest.raises(InvalidInputError, match="rendered are asked for; name a folder"):
        compose("strategy-1", [], [photos], out, counts=SMALL)
    with pytest.raises(InvalidInputError, match="one place, or three"):
        compose("strategy-1", [rendered, few], [photos], out, counts=SMALL)
    with pytest.raises(InvalidInputError, match="images to train on"):
        compose("yolo", [], [photos], out, counts={"train": Counts(rendered=0, photos=0)})
    with pytest.raises(InvalidInputError, match="seed"):
        compose("strategy-1", [rendered], [photos], out, seed=-1)
    assert not out.exists(), "nothing is left of what failed"
    compose("strategy-1", [rendered], [photos], out, counts=SMALL)
    with pytest.raises(InvalidInputError, match="another composition"):
        compose("strategy-1", [rendered], [photos], out, seed=1, counts=SMALL)
    with pytest.raises(InvalidInputError, match="holds no composition"):
        compose("strategy-1", [rendered], [photos], Path(photos), counts=SMALL)


def test_the_command_says_what_each_set_holds(
    tmp_path: Path, places: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    counts = ["--train", "4", "3", "--validation", "2", "2", "--test", "1", "1"]
    main(
        ["compose-dataset", "--rendered", places[0], "--photos", places[1], *counts, "--out", str(out)],
    )
    text = capsys.readouterr().out
    assert f"{out}:train: 7 images, 4 of them with masks, 0 with the robot; 7 visible fruits" in text
    assert len(read_place(f"{out}:test").images) == 2
    with pytest.raises(SystemExit) as exit_info:
        main(["compose-dataset", "--rendered", str(tmp_path / "nowhere"), "--out", str(out)])
    assert exit_info.value.code == 2 and "--rendered: there is no folder" in capsys.readouterr().err
