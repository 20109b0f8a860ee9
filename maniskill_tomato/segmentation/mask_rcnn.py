"""Mask R-CNN (He et al., 2017) as torchvision builds it, with the thesis's settings.

Deviations from the thesis, whose implementation was in Keras: torchvision initialises its heads and samples its regions
in its own way, and pads with the mean colour's zero; without pretrained weights the backbone's batch normalisation is
trained, since frozen statistics of random weights mean nothing.
"""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torchvision.models.detection import MaskRCNN
from torchvision.models.detection.anchor_utils import AnchorGenerator
from torchvision.models.detection.backbone_utils import resnet_fpn_backbone
from torchvision.models.detection.faster_rcnn import FastRCNNPredictor
from torchvision.models.detection.mask_rcnn import MaskRCNNHeads, MaskRCNNPredictor
from torchvision.ops import MultiScaleRoIAlign
from torchvision.ops.feature_pyramid_network import FeaturePyramidNetwork, LastLevelMaxPool
from torchvision.ops.misc import FrozenBatchNorm2d

from maniskill_tomato.errors import CheckpointError, InvalidInputError, MissingWeightsError
from maniskill_tomato.network_weights import fill_network
from maniskill_tomato.segmentation.detector_configs import FIXED_BLOCKS, ClassicAugmentation, MaskRcnnConfig
from maniskill_tomato.segmentation.efficientnet_lite import FEATURE_WIDTHS, EfficientNetLite0
from maniskill_tomato.segmentation.instances import Image, Instances, check_image
from maniskill_tomato.segmentation.weights import load_weights

ASPECT_RATIOS = (0.5, 1.0, 2.0)
"""Height over width of the anchors; the implementation that the thesis built on has these."""

LIGHT_WIDTH = 96
"""Channels of the light pyramid."""

DETECTIONS_PER_CLASS = 50
"""How many detections a picture may have for each class; all of them may be of one."""


class Lite0Pyramid(nn.Module):
    """EfficientNet-Lite0 under a light pyramid; takes colours from 0 to 255."""

    def __init__(self) -> None:
        super().__init__()
        self.body = EfficientNetLite0()
        self.out_channels = LIGHT_WIDTH
        self.fpn = FeaturePyramidNetwork(
            list(FEATURE_WIDTHS), LIGHT_WIDTH, extra_blocks=LastLevelMaxPool(), norm_layer=nn.BatchNorm2d
        )

    def forward(self, image: Tensor) -> dict[str, Tensor]:
        """Features by level. Shape (B, 3, H, W) to five of (B, `LIGHT_WIDTH`, h, w)."""
        features: dict[str, Tensor] = self.fpn({str(i): f for i, f in enumerate(self.body(image))})
        return features


class BoxHead(nn.Module):
    """Two fully connected layers, each with dropout after it (4-2-3)."""

    def __init__(self, inputs: int, width: int, dropout: float) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Flatten(),
            nn.Linear(inputs, width),
            nn.ReLU(inplace=True),
            nn.Dropout(dropout),
            nn.Linear(width, width),
            nn.ReLU(inplace=True),
            nn.Dropout(dropout),
        )

    def forward(self, regions: Tensor) -> Tensor:
        """Features of regions. Shape (N, C, 7, 7) to (N, width)."""
        features: Tensor = self.layers(regions)
        return features


def build_mask_rcnn(config: MaskRcnnConfig, pretrained: bool = False) -> MaskRCNN:
    """A network with random weights, or on a backbone with ImageNet weights.

    Args:
        config: Its settings.
        pretrained: Download the backbone's weights; those of EfficientNet-Lite0 come from an installed package.

    Raises:
        MissingWeightsError: They cannot be downloaded.
        MissingPackageError: The package is not installed.
    """
    try:
        backbone = _backbone(config, pretrained)
    except OSError as error:
        raise MissingWeightsError(
            f"the ImageNet weights of {config.backbone} cannot be downloaded ({error}); "
            "train from random weights, or put them into torchvision's cache"
        ) from error
    light = config.backbone == "efficientnet_lite0"
    width = LIGHT_WIDTH if light else 256
    representation = 256 if light else 1024
    classes = len(config.categories) + 1
    levels = ["0", "1", "2", "3"]
    return MaskRCNN(
        backbone,
        min_size=config.shortest_side,
        max_size=config.longest_side,
        image_mean=[0.0] * 3 if light else None,
        image_std=[1 / 255] * 3 if light else None,
        # A square of the longest side, so that several pictures fit one batch.
        size_divisible=config.longest_side if config.longest_side % 32 == 0 else 32,
        rpn_anchor_generator=AnchorGenerator(
            tuple((side,) for side in config.anchor_sides), (ASPECT_RATIOS,) * len(config.anchor_sides)
        ),
        rpn_nms_thresh=config.proposal_nms,
        rpn_pre_nms_top_n_train=500 if light else 2000,
        rpn_post_nms_top_n_train=500 if light else 2000,
        rpn_pre_nms_top_n_test=500 if light else 1000,
        rpn_post_nms_top_n_test=300 if light else 1000,
        box_head=BoxHead(width * 7 * 7, representation, config.dropout),
        box_predictor=FastRCNNPredictor(representation, classes),
        box_score_thresh=config.least_confidence,
        box_batch_size_per_image=config.rois_per_image,
        box_detections_per_img=DETECTIONS_PER_CLASS * len(config.categories),
        mask_roi_pool=MultiScaleRoIAlign(levels, 14, 2),
        mask_head=MaskRCNNHeads(width, (width,) * (2 if light else 4), 1),
        mask_predictor=MaskRCNNPredictor(width, width, classes),
    )


def _backbone(config: MaskRcnnConfig, pretrained: bool) -> nn.Module:
    """Features at strides 4 to 32, and one more level by pooling."""
    if config.backbone == "efficientnet_lite0":
        pyramid = Lite0Pyramid()
        if pretrained:
            pyramid.body.load_imagenet()
            pyramid.body.keep_fixed(FIXED_BLOCKS)
        return pyramid
    residual: nn.Module = resnet_fpn_backbone(
        backbone_name=config.backbone,
        weights="IMAGENET1K_V1" if pretrained else None,
        norm_layer=FrozenBatchNorm2d if pretrained else nn.BatchNorm2d,
        trainable_layers=5,
    )
    return residual


class MaskRcnnSegmenter:
    """A `Segmenter` over torchvision's Mask R-CNN; colours only, depth is not used."""

    def __init__(
        self, network: MaskRCNN, categories: tuple[str, ...], score_threshold: float | None = None
    ) -> None:
        """Takes a trained network.

        Args:
            network: It is set to evaluation mode.
            categories: Names of its classes without the background.
            score_threshold: Detections below are left out; by default the network's own.

        Raises:
            InvalidInputError: The threshold is not between 0 and 1.
        """
        if score_threshold is not None:
            if not 0 <= score_threshold <= 1:
                raise InvalidInputError(f"score_threshold must be between 0 and 1, got {score_threshold}")
            heads: Any = network.roi_heads
            heads.score_thresh = score_threshold
        self.network = network.eval().requires_grad_(False)
        self.categories = categories

    def __call__(self, image: Image, depth_m: NDArray[np.float32] | None = None) -> Instances:
        """The fruits in an image; see `Segmenter`. Its other classes, such as the robot, are left out."""
        return self.things(image, depth_m).fruits()

    def things(self, image: Image, depth_m: NDArray[np.float32] | None = None) -> Instances:
        """What the network tells apart in an image, of all classes; see `ThingSegmenter`."""
        check_image(image, depth_m)
        height, width = image.shape[:2]
        x = torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1).float() / 255
        with torch.inference_mode():
            (found,) = self.network([x])
        names = [self.categories[k - 1] for k in found["labels"].tolist()]
        boxes, masks = found["boxes"], found["masks"][:, 0] >= 0.5
        whole = ((boxes[:, 2:] - boxes[:, :2]) >= 1).all(1)
        return Instances(
            boxes=boxes[whole].numpy(),
            scores=found["scores"][whole].numpy(),
            categories=tuple(name for name, w in zip(names, whole.tolist(), strict=True) if w),
            masks=masks[whole].numpy().reshape(-1, height, width),
        )


def open_mask_rcnn(
    weights: Path | str | None = None, score_threshold: float | None = None
) -> MaskRcnnSegmenter:
    """Opens the weights in a file; none ship.

    Raises:
        CheckpointError: No file is given, or it is missing, damaged or of something else.
    """
    if weights is None:
        raise CheckpointError(
            "no Mask R-CNN weights ship; train some with `maniskill-tomato train-segmenter mask-rcnn` and give "
            "their file as the segmenter"
        )
    data = load_weights(Path(weights), "mask_rcnn")
    try:
        augmentation = ClassicAugmentation(**data["config"]["augmentation"])
        config = MaskRcnnConfig(**{**data["config"], "augmentation": augmentation})
        network = build_mask_rcnn(config)
        fill_network(network, data["state"])
    except (TypeError, KeyError, ValueError, RuntimeError) as error:
        raise CheckpointError(
            f"{weights} does not fit this version's network ({str(error).splitlines()[0]})"
        ) from error
    return MaskRcnnSegmenter(network, config.categories, score_threshold)
