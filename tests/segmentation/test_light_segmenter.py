"""The light segmenter: decoding undoes the targets, pictures keep their annotation, training goes on bit for bit."""

import json
import sys
from dataclasses import asdict, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torchvision.ops import box_iou

from maniskill_tomato.errors import CheckpointError, InvalidInputError, MissingPackageError
from maniskill_tomato.segmentation.datasets.annotations import AnnotatedImage, Instance
from maniskill_tomato.segmentation.detector_configs import (
    AugmentationConfig,
    FruitNetworkConfig,
    LightTrainConfig,
)
from maniskill_tomato.segmentation.efficientnet_lite import EfficientNetLite0
from maniskill_tomato.segmentation.fruit_network import (
    STRIDE,
    FruitMaps,
    FruitNetwork,
    place_centres,
)
from maniskill_tomato.segmentation.light_segmenter import (
    FruitSession,
    LightSegmenter,
    find_fruits,
    mirror,
    open_light,
    split_by_votes,
    voted_boxes,
)
from maniskill_tomato.segmentation.masks import EncodedMask
from maniskill_tomato.segmentation.training.augmentation import augmented
from maniskill_tomato.segmentation.training.fruit_targets import fruit_losses, make_targets
from maniskill_tomato.segmentation.training.light_training import LightTraining
from maniskill_tomato.segmentation.training.training_pictures import (
    TrainingImages,
    TrainingPicture,
    training_picture,
)
from maniskill_tomato.segmentation.weights import save_weights

SMALL = FruitNetworkConfig(neck_width=8, fine_width=8)


def fruit_picture(seed: int = 0, count: int = 5, size: tuple[int, int] = (160, 192)) -> TrainingPicture:
    """Red discs on green; later ones stand in front of earlier ones. Ripe and unripe in turn."""
    rng = np.random.default_rng(seed)
    height, width = size
    image = np.full((height, width, 3), (40, 120, 40), np.uint8)
    labels = np.zeros(size, np.int16)
    whole = []
    y, x = np.mgrid[:height, :width] + 0.5
    for index in range(count):
        radius = rng.uniform(8, 20)
        cx, cy = rng.uniform(radius, width - radius), rng.uniform(radius, height - radius)
        disc = (x - cx) ** 2 + (y - cy) ** 2 <= radius**2
        image[disc] = (200, 30 + 20 * (index % 2), 30)
        labels[disc] = index + 1
        whole.append([cx - radius, cy - radius, cx + radius, cy + radius])
    if len(np.unique(labels)) <= count:  # One is covered altogether.
        return fruit_picture(seed + 1000, count, size)
    boxes = []
    for index in range(count):
        rows, columns = np.nonzero(labels == index + 1)
        boxes.append([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1])
    return TrainingPicture(
        image=image,
        boxes=np.array(boxes, np.float32),
        ignored=np.zeros(count, bool),
        labels=labels,
        whole_boxes=np.array(whole, np.float32),
        categories=np.arange(count) % 2 * 2,
    )


def perfect_maps(picture: TrainingPicture) -> FruitMaps:
    """What a network says that is right everywhere."""
    targets = make_targets([picture])
    x, y = place_centres(targets.heat.shape[2], targets.heat.shape[3])

    def distances(box: torch.Tensor) -> torch.Tensor:
        left, top, right, bottom = box.unbind(1)
        return torch.stack([x - left, y - top, right - x, bottom - y], dim=1)

    kinds = torch.nn.functional.one_hot(targets.category.clamp(min=0), 3).movedim(-1, 1).float()
    return FruitMaps(
        centre=torch.logit(targets.heat.clamp(1e-4, 1 - 1e-4)),
        box=distances(targets.box),
        whole=distances(targets.whole),
        category=kinds * 10,
        fruit=(targets.fruit - 0.5) * 20,
        vote=targets.vote - torch.stack([x, y]),
    )


def apart(seed: int) -> TrainingPicture:
    """The first picture from `seed` on whose fruits are not centred on neighbouring places."""
    while True:
        picture = fruit_picture(seed)
        centres = (picture.boxes[:, :2] + picture.boxes[:, 2:]) / 2
        away = np.abs(centres[:, None] - centres[None]).max(axis=2) + 100 * np.eye(len(centres))
        if away.min() > 3 * STRIDE:
            return picture
        seed += 100


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_decoding_perfect_maps_gives_the_annotation_back(seed: int) -> None:
    picture = apart(seed)
    maps = perfect_maps(picture)
    found = find_fruits(maps, 0.5, 0.9)
    assert len(found["boxes"]) == len(picture.boxes)
    order = np.array(
        [int(((picture.boxes - box.numpy()) ** 2).sum(axis=1).argmin()) for box in found["boxes"]]
    )
    assert sorted(order) == list(range(len(order)))
    np.testing.assert_allclose(found["boxes"].numpy(), picture.boxes[order], atol=1e-3)
    assert picture.whole_boxes is not None and picture.categories is not None and picture.labels is not None
    np.testing.assert_allclose(found["whole"].numpy(), picture.whole_boxes[order], atol=1e-3)
    np.testing.assert_array_equal(found["category"].numpy(), picture.categories[order])
    centres = np.concatenate([np.zeros((1, 2)), (picture.boxes[:, :2] + picture.boxes[:, 2:]) / 2])
    votes = centres[picture.labels].transpose(2, 0, 1).astype(np.float32)
    masks = split_by_votes(picture.labels > 0, votes, found["boxes"].numpy())
    for mask, index in zip(masks, order, strict=True):
        np.testing.assert_array_equal(mask, picture.labels == index + 1)


def test_places_around_a_centre_agree_on_a_box_that_scatters_less_than_that_of_the_centre() -> None:
    true = torch.tensor([[30.0, 20, 90, 70], [60, 84, 80, 110]])
    x, y = place_centres(64, 64)
    nearest = torch.where((y < 78), 0, 1)
    left, top, right, bottom = true[nearest].unbind(-1)
    distances = torch.stack([x - left, y - top, right - x, bottom - y])
    empty = torch.zeros(1, 1, 64, 64)
    maps = FruitMaps(empty, distances[None], empty, empty, empty, empty)
    torch.testing.assert_close(voted_boxes(maps, true), true)
    torch.testing.assert_close(voted_boxes(maps, true[:0]), true[:0])
    noise = torch.randn(1, 4, 64, 64, generator=torch.Generator().manual_seed(0)) * 3
    start = true + torch.tensor([2.0, -2, 3, 1])
    off = voted_boxes(maps._replace(box=maps.box + noise), start) - true
    assert off.abs().max() < 1.5


def test_losses_are_near_zero_for_perfect_maps_and_not_for_others() -> None:
    picture = apart(0)
    targets = make_targets([picture])
    right = fruit_losses(perfect_maps(picture), targets)
    wrong = fruit_losses(FruitMaps(*(-m for m in perfect_maps(picture))), targets)
    assert set(right) == {"centre", "box", "whole", "category", "fruit", "vote"}
    # The heat around a centre has a focal loss that cannot vanish: (1 - h)^4 h^2 (-ln (1 - h)) at each place.
    heat = targets.heat.numpy().astype(np.float64)
    around = heat[(heat > 0) & (heat < 1)]
    shoulders = (-((1 - around) ** 4) * around**2 * np.log(1 - around)).sum() / (heat == 1).sum()
    assert float(right["centre"]) == pytest.approx(shoulders, rel=0.02)
    for name in right:
        # So do cells that are part fruit.
        least = {"fruit": 0.35, "centre": 1.1 * shoulders}
        assert float(right[name]) < least.get(name, 0.02), name
        assert float(wrong[name]) > 2 * float(right[name]) + 0.2, name


def test_places_of_small_fruits_weigh_more_in_the_mask_terms() -> None:
    # Squares of 64, 16, 8 and 4 px: 32 px over the side, from 1 to 4.
    labels = np.zeros((128, 128), np.int16)
    boxes = np.array([[0, 0, 64, 64], [80, 0, 96, 16], [80, 40, 88, 48], [80, 80, 84, 84]], np.float32)
    for index, (left, top, right, bottom) in enumerate(boxes.astype(int)):
        labels[top:bottom, left:right] = index + 1
    picture = TrainingPicture(
        image=np.zeros((128, 128, 3), np.uint8), boxes=boxes, ignored=np.zeros(4, bool), labels=labels
    )
    targets = make_targets([picture])
    rows, columns = ((boxes[:, [1, 0]] + 2) // STRIDE).astype(int).T
    assert targets.vote_weight[0, 0, rows, columns].tolist() == [1, 2, 4, 4]
    assert targets.fruit_weight[0, 0, rows, columns].tolist() == [1, 2, 4, 4]
    assert targets.fruit_weight[0, 0, -1, -1] == 1 and targets.vote_weight[0, 0, -1, -1] == 0
    assert targets.vote_size[0, :, rows[1], columns[1]].tolist() == [16, 16]
    # Votes that are wrong by an eighth of the box, half of its quarter: 0.5 * 0.5^2 along x and 0 along y.
    x, y = place_centres(64, 64)
    maps = perfect_maps(picture)
    off = targets.vote_size * torch.tensor([1 / 8, 0.0])[:, None, None]
    vote = targets.vote - torch.stack([x, y]) + off
    # Fruit pixels as likely as not: ln 2, and one minus each fruit's Dice. Two for one in length, the boxes and a place
    # around them, cut at the picture's edges, have 33 x 33, 10 x 9, 6 x 6 and 4 x 4 places, of which 32 x 32, 8 x 8,
    # 4 x 4 and 2 x 2 are fruit: Dice is (fruit + 1) / (places / 2 + fruit + 1).
    found = fruit_losses(maps._replace(vote=vote, fruit=torch.zeros(1, 1, 64, 64)), targets)
    assert float(found["vote"]) == pytest.approx(0.125 / 2, rel=1e-4)
    dice = np.mean([1025 / 1569.5, 65 / 110, 17 / 35, 5 / 13])
    assert float(found["fruit"]) == pytest.approx(np.log(2) + 1 - dice, rel=1e-4)
    assert 0 < float(fruit_losses(maps, targets)["fruit"]) < 0.1


def test_the_mask_of_a_fruit_is_judged_without_its_neighbours_and_without_fruits_that_do_not_count() -> None:
    # Two squares of 8 px side by side, and one that is ignored.
    labels = np.zeros((64, 64), np.int16)
    boxes = np.array([[16, 16, 24, 24], [24, 16, 32, 24], [40, 40, 48, 48]], np.float32)
    for index, (left, top, right, bottom) in enumerate(boxes.astype(int)):
        labels[top:bottom, left:right] = index + 1
    picture = TrainingPicture(
        image=np.zeros((64, 64, 3), np.uint8),
        boxes=boxes,
        ignored=np.array([False, False, True]),
        labels=labels,
    )
    targets = make_targets([picture, picture])
    # 6 x 6 places around a box of 4 x 4, less the column of 4 that is the neighbour's; both pictures one after another.
    assert np.bincount(targets.inside_fruit).tolist() == [32, 32, 32, 32]
    owner = (
        torch.from_numpy(labels[1::2, 1::2].astype(np.int64)).repeat(2, 1, 1).flatten()[targets.inside_place]
    )
    for fruit, others in enumerate(({2, 3}, {1, 3}, {2, 3}, {1, 3})):
        assert set(owner[targets.inside_fruit == fruit].tolist()) == {0, 1, 2, 3} - others
    assert targets.inside_place[targets.inside_fruit == 2].min() >= 32 * 32
    # One fruit missed altogether costs a quarter of the Dice term, whatever its size.
    maps = perfect_maps(picture)
    both = FruitMaps(*(torch.cat([m, m]) for m in maps))
    missed = both.fruit.clone()
    missed[0, 0, 8:12, 8:12] = -10
    entropy = torch.nn.functional.binary_cross_entropy_with_logits
    losses = [
        float(fruit_losses(both._replace(fruit=f), targets)["fruit"])
        - float(entropy(f, targets.fruit, targets.fruit_weight, reduction="sum") / targets.fruit_weight.sum())
        for f in (both.fruit, missed)
    ]
    assert losses[0] == pytest.approx(0, abs=1e-3)
    # Nothing of 16 places: Dice 1 / 17.
    assert losses[1] == pytest.approx((1 - 1 / 17) / 4, abs=1e-3)


def test_terms_without_annotation_are_zero() -> None:
    picture = fruit_picture()
    boxes_only = TrainingPicture(image=picture.image, boxes=picture.boxes, ignored=picture.ignored)
    losses = fruit_losses(FruitNetwork(SMALL)(torch.zeros(1, 3, 160, 192)), make_targets([boxes_only]))
    assert all(float(losses[name].detach()) == 0 for name in ("whole", "category", "fruit", "vote"))
    assert float(losses["box"].detach()) > 0


def test_an_ignored_fruit_is_no_centre_and_its_box_does_not_count() -> None:
    picture = fruit_picture(count=1)
    ignored = TrainingPicture(
        image=picture.image, boxes=picture.boxes, ignored=np.ones(1, bool), labels=picture.labels
    )
    targets = make_targets([ignored])
    assert targets.heat.max() == 0 and targets.box_weight.max() == 0
    left, top, right, bottom = (picture.boxes[0] / STRIDE).astype(int)
    assert targets.heat_weight[0, 0, top : bottom + 1, left : right + 1].max() == 0
    assert targets.heat_weight.mean() > 0.8


@pytest.mark.parametrize("mosaic", [0.0, 1.0])
def test_boxes_and_labels_move_with_the_picture(mosaic: float) -> None:
    config = AugmentationConfig(size=160, mosaic_probability=mosaic, blur_probability=0, noise_probability=0)
    rng = np.random.default_rng(0)
    seen = 0
    for _ in range(30):
        picture = augmented(lambda: fruit_picture(int(rng.integers(100)), 3), config, rng)
        assert picture.labels is not None and picture.image.shape == (160, 160, 3)
        assert picture.labels.max(initial=0) <= len(picture.boxes)
        for index in np.flatnonzero(~picture.ignored):
            rows, columns = np.nonzero(picture.labels == index + 1)
            if not len(rows):  # A sliver that fell between the sampled pixels.
                continue
            around = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
            # Labels are sampled at the nearest pixel.
            if mosaic == 0.0 and (picture.boxes[index] % 160 > 0).all():
                np.testing.assert_allclose(picture.boxes[index], around, atol=2.5)
                seen += 1
            colours = picture.image[rows, columns].astype(float).mean(axis=0)
            assert colours[0] > colours[1]
    assert mosaic or seen > 10


def annotated(folder: Path, count: int = 3, masks: bool = True) -> list[AnnotatedImage]:
    """Pictures of discs as files."""
    images = []
    for number in range(count):
        picture = fruit_picture(number, 3, (96, 96))
        assert picture.labels is not None and picture.whole_boxes is not None
        path = folder / f"{number}.png"
        cv2.imwrite(str(path), picture.image[..., ::-1])
        fruits = []
        for index, (left, top, right, bottom) in enumerate(picture.boxes.tolist()):
            mask = EncodedMask.encode(picture.labels == index + 1) if masks else None
            a, b, c, d = picture.whole_boxes[index].tolist()
            fruits.append(
                Instance(
                    category="tomato_ripe",
                    box_xywh=(left, top, right - left, bottom - top),
                    visible_mask=mask,
                    amodal_box_xywh=(a, b, c - a, d - b) if masks else None,
                )
            )
        images.append(
            AnnotatedImage(path=path, file_name=path.name, width=96, height=96, instances=tuple(fruits))
        )
    return images


def test_an_annotated_image_becomes_a_training_picture(tmp_path: Path) -> None:
    (image,) = annotated(tmp_path, 1)
    picture, expected = training_picture(image), fruit_picture(0, 3, (96, 96))
    np.testing.assert_array_equal(picture.image, expected.image)
    np.testing.assert_allclose(picture.boxes, expected.boxes)
    assert picture.labels is not None and expected.labels is not None
    np.testing.assert_array_equal(picture.labels, expected.labels)
    (boxes_only,) = annotated(tmp_path, 1, masks=False)
    assert training_picture(boxes_only).labels is None


def small_config(steps: int) -> LightTrainConfig:
    return LightTrainConfig(
        steps=steps,
        batch_size=2,
        warmup_steps=2,
        log_every=2,
        save_every=2,
        bfloat16=False,
        network=SMALL,
        augmentation=AugmentationConfig(size=64),
    )


def test_a_stopped_training_goes_on_bit_for_bit(tmp_path: Path) -> None:
    images = annotated(tmp_path)
    whole = LightTraining(small_config(4), TrainingImages(sets=[images], validation=images))
    assert whole.run(tmp_path / "whole", lambda line: None) == tmp_path / "whole" / "weights.pt"
    first = LightTraining(small_config(4), TrainingImages(sets=[images], validation=images))
    assert first.run(tmp_path / "parts", lambda line: None, lambda: first.step == 3) is None
    second = LightTraining(small_config(4), TrainingImages(sets=[images], validation=images))
    second.resume(tmp_path / "parts")
    assert second.step == 3
    second.run(tmp_path / "parts", lambda line: None)
    for name, tensor in whole.kept.state_dict().items():
        torch.testing.assert_close(second.kept.state_dict()[name], tensor, rtol=0, atol=0)
    histories = [json.loads((tmp_path / d / "history.json").read_text()) for d in ("whole", "parts")]
    assert histories[0] == histories[1]
    assert "val_loss" in histories[0][-1] and histories[0][-1]["step"] == 4


def test_training_from_imagenet_moves_all_but_the_first_layers_and_the_backbone_more_slowly(
    tmp_path: Path,
) -> None:
    images = annotated(tmp_path, 2)
    config = replace(small_config(1), warmup_steps=1, fixed_blocks=2, backbone_rate=0.25)
    training = LightTraining(config, TrainingImages(sets=[images]))
    start = EfficientNetLite0()
    start.load_imagenet()
    training.run(tmp_path / "run", lambda line: None)
    # AdamW's first step moves every weight by its learning rate (Kingma and Ba, 2015), besides the decay.
    rates = {group["share"]: group["lr"] for group in training.optimizer.param_groups}
    assert rates == {1.0: config.learning_rate, 0.25: 0.25 * config.learning_rate}
    for name, tensor in training.network.backbone.state_dict().items():
        fixed = name.startswith(("stem", "blocks.0.", "blocks.1.")) or "running" in name or "tracked" in name
        assert torch.equal(tensor, start.state_dict()[name]) == fixed, name


def test_training_from_weights_takes_over_the_layers_that_fit(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    images = annotated(tmp_path, 1)
    start = FruitNetwork(SMALL)
    save_weights(tmp_path / "w.pt", "light", asdict(SMALL), start.state_dict())
    wider = replace(small_config(1), network=replace(SMALL, fine_width=12))
    network = LightTraining(wider, TrainingImages(sets=[images]), tmp_path / "w.pt").network.state_dict()
    for name, tensor in start.state_dict().items():
        if network[name].shape == tensor.shape:
            torch.testing.assert_close(network[name].float(), tensor.float(), rtol=1e-3, atol=1e-4, msg=name)
    assert network["output.weight"].shape[1] == 12 and "begin anew" in caplog.text
    other = {n: tensor for n, tensor in start.state_dict().items() if not n.startswith("backbone.stem")}
    save_weights(tmp_path / "w.pt", "light", asdict(SMALL), other)
    with pytest.raises(CheckpointError, match="another backbone"):
        LightTraining(wider, TrainingImages(sets=[images]), tmp_path / "w.pt")


def test_a_training_of_other_settings_is_not_continued(tmp_path: Path) -> None:
    images = annotated(tmp_path)
    LightTraining(small_config(2), TrainingImages(sets=[images])).run(tmp_path / "run", lambda line: None)
    with pytest.raises(CheckpointError, match="other settings"):
        LightTraining(small_config(3), TrainingImages(sets=[images])).resume(tmp_path / "run")


def test_training_lowers_the_loss_on_two_pictures(tmp_path: Path) -> None:
    torch.manual_seed(0)
    images = annotated(tmp_path, 2)
    config = LightTrainConfig(
        steps=40,
        batch_size=2,
        learning_rate=5e-3,
        warmup_steps=5,
        log_every=10,
        save_every=40,
        network=SMALL,
        bfloat16=False,
        augmentation=AugmentationConfig(size=96, mosaic_probability=0, scale=(1.0, 1.0)),
    )
    training = LightTraining(config, TrainingImages(sets=[images]))
    training.run(tmp_path / "run", lambda line: None)
    assert training.history[-1]["loss"] < 0.8 * training.history[0]["loss"]
    assert training.history[-1]["fruit"] < training.history[0]["fruit"]


def test_the_learning_rate_rises_and_falls() -> None:
    config = LightTrainConfig(steps=100, warmup_steps=10, learning_rate=1.0 - 1e-9)
    rates = [config.rate_at(step) for step in range(101)]
    assert rates[0] == pytest.approx(0.1) and rates[10] == pytest.approx(1.0)
    assert rates[55] == pytest.approx(0.505) and rates[100] == pytest.approx(0.01)


def test_shares_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    images = annotated(tmp_path, 1)
    for sets, shares in (([], []), ([images, []], [1, 1]), ([images], [1, 1]), ([images], [0])):
        with pytest.raises(InvalidInputError):
            TrainingImages(sets=sets, shares=shares)


@pytest.mark.parametrize("size", [(1, 1), (33, 70), (100, 700)])
def test_images_of_any_size_give_masks_of_that_size(size: tuple[int, int], tmp_path: Path) -> None:
    segmenter = LightSegmenter(FruitNetwork(SMALL), score_threshold=0.0)
    found = segmenter(np.full((*size, 3), 90, np.uint8))
    assert found.masks.shape[1:] == size
    if len(found):
        assert (
            (found.boxes >= 0).all()
            and (found.boxes[:, 2] <= size[1]).all()
            and (found.boxes[:, 3] <= size[0]).all()
        )
        assert found.amodal_boxes is not None
        assert (found.amodal_boxes[:, :2] <= found.boxes[:, :2]).all()
        assert (np.diff(found.scores) <= 0).all()


def test_two_looks_at_one_image_are_joined_in_order_and_sizes_are_shared_out() -> None:
    torch.manual_seed(0)
    image = fruit_picture(size=(224, 288)).image
    network = FruitNetwork(SMALL)
    # All places say the same distances: away from the border a vote of several changes nothing.
    assert network.output.bias is not None
    with torch.no_grad():
        network.output.weight[1:5] = 0
        network.output.bias[1:5] = 1.3
    both = LightSegmenter(network, score_threshold=0.0, overlap_threshold=0.5)(image)
    fine = LightSegmenter(network, score_threshold=0.0, overlap_threshold=0.5, scales=(1.0,))(image)
    assert len(both) > 0 and (np.diff(both.scores) <= 0).all()
    inner = (both.boxes[:, :2] > 0).all(axis=1) & (both.boxes[:, 2:] < [288, 224]).all(axis=1)
    boxes = torch.from_numpy(both.boxes[inner]).double()
    overlaps = box_iou(boxes, boxes).numpy()
    assert len(boxes) > 5 and (overlaps - np.eye(len(boxes))).max() <= 0.5 + 1e-6
    # Small boxes can only come from the fine look.
    small = (both.boxes[:, 2:] - both.boxes[:, :2]).min(axis=1) < 60
    for box in both.boxes[small]:
        assert np.abs(fine.boxes - box).max(axis=1).min() < 1e-3
    with pytest.raises(InvalidInputError, match="scales"):
        LightSegmenter(network, scales=(0.5, 1.0))


def square(size: int, left: float, side: float) -> TrainingPicture:
    """A picture with one square fruit in the middle of its height."""
    top = (size - side) / 2
    box = np.array([[left, top, left + side, top + side]], np.float32)
    labels = np.zeros((size, size), np.int16)
    labels[round(top) : round(top + side), round(left) : round(left + side)] = 1
    return TrainingPicture(
        image=np.zeros((size, size, 3), np.uint8),
        boxes=box,
        ignored=np.zeros(1, bool),
        labels=labels,
        whole_boxes=box,
        categories=np.zeros(1, np.int64),
    )


# The fine look keeps fruits of up to 192 px, the coarse one those of 32 px or more in its image of half the size.
@pytest.mark.parametrize(
    ("side", "found_at"),
    [(40, [20]), (60, [20]), (68, [20, 400]), (120, [20, 400]), (188, [20, 400]), (196, [400]), (240, [400])],
)
def test_fruits_too_large_for_the_fine_look_are_left_to_the_coarse_one_and_the_other_way_round(
    monkeypatch: pytest.MonkeyPatch, side: float, found_at: list[float]
) -> None:
    """A network that finds a fruit of one size, at the left in the fine image and at the right in the coarse one."""

    def look(image: torch.Tensor) -> FruitMaps:
        size = image.shape[3]
        return perfect_maps(square(size, 20.0 if size == 704 else 200.0, side * size / 704))

    monkeypatch.setattr("maniskill_tomato.segmentation.light_segmenter.FruitSession", lambda network: look)
    segmenter = LightSegmenter(FruitNetwork(SMALL), longest_side=704)
    found = segmenter(np.zeros((704, 704, 3), np.uint8))
    assert sorted(found.boxes[:, 0].round().tolist()) == found_at


def turned(boxes: NDArray[np.float32], width: int) -> NDArray[np.float32]:
    """Boxes of a mirror image."""
    return np.asarray(
        np.stack([width - boxes[:, 2], boxes[:, 1], width - boxes[:, 0], boxes[:, 3]], axis=1), np.float32
    )


def test_what_a_mirror_image_shows_is_turned_back() -> None:
    picture = apart(3)
    assert picture.labels is not None and picture.whole_boxes is not None
    width = picture.image.shape[1]
    mirrored = replace(
        picture,
        image=picture.image[:, ::-1],
        labels=picture.labels[:, ::-1],
        boxes=turned(picture.boxes, width),
        whole_boxes=turned(picture.whole_boxes, width),
    )
    seen, known = mirror(perfect_maps(mirrored)), perfect_maps(picture)
    found, expected = find_fruits(seen, 0.5, 0.9), find_fruits(known, 0.5, 0.9)
    for name in ("boxes", "whole"):
        # Of two places as near to a centre either may be the peak; the box is the same.
        gap = (found[name][:, None] - expected[name][None]).abs().amax(dim=2).amin(dim=1)
        assert len(gap) == len(expected[name]) and float(gap.max()) < 1e-3
    on_fruit = make_targets([picture]).vote_weight.expand(-1, 2, -1, -1) > 0
    assert float((seen.vote - known.vote)[on_fruit].abs().median()) < 1e-3


def test_a_mirrored_look_finds_the_mirror_image_s_fruits() -> None:
    torch.manual_seed(0)
    segmenter = LightSegmenter(FruitNetwork(SMALL), score_threshold=0.0, scales=(1.0,), mirrored=True)
    image = fruit_picture(size=(160, 192)).image
    found, other = segmenter(image), segmenter(np.ascontiguousarray(image[:, ::-1]))
    assert len(found) == len(other) > 0
    gap = np.abs(found.boxes[:, None] - turned(other.boxes, 192)[None]).max(axis=2).min(axis=1)
    assert gap.max() < 0.01


def test_weights_come_back_in_half_precision(tmp_path: Path) -> None:
    network = FruitNetwork(SMALL)
    save_weights(tmp_path / "w.pt", "light", asdict(SMALL), network.state_dict())
    opened = open_light(tmp_path / "w.pt").network
    for name, tensor in network.state_dict().items():
        torch.testing.assert_close(opened.state_dict()[name].float(), tensor.float(), rtol=1e-3, atol=1e-3)


def test_values_beyond_16_bits_survive_in_a_file(tmp_path: Path) -> None:
    state = FruitNetwork(SMALL).state_dict()
    state["smooths.2.1.running_var"][0] = 350_484.0
    state["output.weight"][0, 0] = 70_000.0
    save_weights(tmp_path / "w.pt", "light", asdict(SMALL), state)
    opened = open_light(tmp_path / "w.pt").network.state_dict()
    assert float(opened["smooths.2.1.running_var"][0]) == 350_484.0
    assert float(opened["output.weight"][0, 0]) == 70_000.0


def test_weights_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    state = FruitNetwork(SMALL).state_dict()
    save_weights(tmp_path / "w.pt", "light", {**asdict(SMALL), "fine_width": 9}, state)
    with pytest.raises(CheckpointError, match="does not fit"):
        open_light(tmp_path / "w.pt")
    save_weights(tmp_path / "m.pt", "mask_rcnn", asdict(SMALL), state)
    with pytest.raises(CheckpointError, match="mask_rcnn"):
        open_light(tmp_path / "m.pt")
    (tmp_path / "broken.pt").write_bytes((tmp_path / "w.pt").read_bytes()[:1000])
    with pytest.raises(CheckpointError, match="truncated"):
        open_light(tmp_path / "broken.pt")


def test_without_torchvision_opening_the_segmenter_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torchvision", None)
    with pytest.raises(MissingPackageError, match="perception"):
        open_light()


def test_a_network_of_boxes_only_gives_ellipses() -> None:
    network = FruitNetwork(SMALL)
    found = LightSegmenter(network, boxes_only=True, score_threshold=0.0)(np.full((64, 64, 3), 90, np.uint8))
    assert found.amodal_boxes is None and set(found.categories) <= {"tomato"}


def test_the_translated_network_says_the_same_at_any_size() -> None:
    torch.manual_seed(1)
    network = FruitNetwork(SMALL).eval()
    session = FruitSession(network)
    for size in ((64, 96), (160, 128)):
        image = torch.rand(1, 3, *size) * 255
        with torch.no_grad():
            expected = network(image)
        for name, ours, theirs in zip(FruitMaps._fields, session(image), expected, strict=True):
            torch.testing.assert_close(ours, theirs, rtol=1e-3, atol=1e-3, msg=name)
