"""The backbone that begins from ImageNet weights."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch import nn
from torch.nn import functional

from maniskill_tomato.errors import CheckpointError, MissingPackageError
from maniskill_tomato.segmentation import efficientnet_lite
from maniskill_tomato.segmentation.efficientnet_lite import (
    FEATURE_WIDTHS,
    EfficientNetLite0,
    imagenet_weights,
)

PHOTO = Path(__file__).parents[2] / "docs" / "images" / "benchmark_views.jpg"


def test_features_come_at_strides_4_to_32() -> None:
    features = EfficientNetLite0().eval()(torch.zeros(2, 3, 64, 96))
    assert [f.shape for f in features] == [
        (2, width, 64 // stride, 96 // stride)
        for width, stride in zip(FEATURE_WIDTHS, (4, 8, 16, 32), strict=True)
    ]


def test_it_has_the_parameters_of_the_paper_without_the_last_stage_and_the_classifier() -> None:
    # 4,652,008 in all for Lite0 (the reference implementation), of which: the last inverted residual 192 -> 320
    # (192*1152 + 25*... counted layer by layer), the 1x1 convolution 320 -> 1280 and 1000 classes.
    last = 192 * 1152 + 2 * 1152 + 9 * 1152 + 2 * 1152 + 1152 * 320 + 2 * 320
    top = 320 * 1280 + 2 * 1280 + 1280 * 1000 + 1000
    assert sum(p.numel() for p in EfficientNetLite0().parameters()) == 4_652_008 - last - top


def test_strided_convolutions_pad_as_tensorflow_does() -> None:
    network = EfficientNetLite0().eval()
    image = torch.rand(1, 3, 32, 32)
    stem = network.stem[0]
    assert isinstance(stem, nn.Conv2d)
    # "SAME" with kernel 3, stride 2 and an even size: nothing before, one pixel behind.
    expected = functional.conv2d(functional.pad(image, (0, 1, 0, 1)), stem.weight, stride=2)
    torch.testing.assert_close(stem(image), expected)


def test_imagenet_weights_fit_the_data_flow() -> None:
    """Each batch normalisation knows the mean of what it was trained on; pictures must agree with that."""
    network = EfficientNetLite0()
    network.load_imagenet()
    network.eval()
    picture = cv2.imread(str(PHOTO))
    assert picture is not None
    crops = [
        picture[y : y + 160, x : x + 160, ::-1]
        for y in (0, 160)
        for x in range(0, picture.shape[1] - 160, 160)
    ]
    images = torch.from_numpy(np.stack(crops)).permute(0, 3, 1, 2).float()
    correlations = []

    def compare(module: nn.Module, inputs: tuple[torch.Tensor, ...], _: torch.Tensor) -> None:
        assert isinstance(module, nn.BatchNorm2d)
        assert module.running_mean is not None
        means = inputs[0].mean(dim=(0, 2, 3))
        correlations.append(float(torch.corrcoef(torch.stack([means, module.running_mean]))[0, 1]))

    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.register_forward_hook(compare)
    with torch.no_grad():
        network(images)
    assert len(correlations) == 45
    assert np.median(correlations) > 0.8


def test_fixed_layers_and_statistics_do_not_move_while_training() -> None:
    network = EfficientNetLite0()
    network.keep_fixed(3)
    network.train()
    before = {name: value.clone() for name, value in network.state_dict().items()}
    optimizer = torch.optim.SGD([p for p in network.parameters() if p.requires_grad], 1e-2)
    torch.stack([f.square().mean() for f in network(torch.rand(2, 3, 64, 64) * 255)]).sum().backward()  # type: ignore[no-untyped-call]
    optimizer.step()
    moved = {name for name, value in network.state_dict().items() if not torch.equal(value, before[name])}
    assert moved
    assert not any(name.startswith(("stem", "blocks.0.", "blocks.1.", "blocks.2.")) for name in moved)
    assert not any("running" in name or "tracked" in name for name in moved)


def test_a_file_of_something_else_is_refused(tmp_path: Path) -> None:
    torch.save({"weight": torch.zeros(3)}, tmp_path / "other.pth")
    with pytest.raises(CheckpointError, match="does not hold EfficientNet-Lite0"):
        EfficientNetLite0().load_imagenet(tmp_path / "other.pth")
    (tmp_path / "text.pth").write_text("no weights")
    with pytest.raises(CheckpointError, match="does not hold EfficientNet-Lite0"):
        EfficientNetLite0().load_imagenet(tmp_path / "text.pth")


def test_a_missing_package_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(efficientnet_lite, "WEIGHTS_PACKAGE", "no_such_package_of_weights")
    with pytest.raises(MissingPackageError, match="pretrained"):
        imagenet_weights()
