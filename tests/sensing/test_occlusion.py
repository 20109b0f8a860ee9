"""Occlusion models on drawn scenes whose answer is known."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.robot.d435 import color_intrinsics
from maniskill_tomato.segmentation.instances import Image, Instances
from maniskill_tomato.segmentation.masks import BinaryMask
from maniskill_tomato.sensing.visible_fraction import image_operations as operations
from maniskill_tomato.sensing.visible_fraction.amodal import AmodalModel
from maniskill_tomato.sensing.visible_fraction.estimate import SegmentedImage, filled_depth, fruit_depth
from maniskill_tomato.sensing.visible_fraction.improved import ImprovedConfig, ImprovedModel
from maniskill_tomato.sensing.visible_fraction.occlusion_models import make_occlusion_model
from maniskill_tomato.sensing.visible_fraction.sphere import SphereConfig, SphereModel
from maniskill_tomato.sensing.visible_fraction.thesis import ThesisConfig, ThesisModel

INTRINSICS = color_intrinsics(320, 240)
RADIUS = 0.03
HEIGHT, WIDTH = 240, 320


def draw(
    *,
    leaf_from: float = -1.0,
    centre: tuple[float, float] = (0.0, 0.0),
    depth: float = 0.4,
    noise: float = 0.0,
) -> tuple[SegmentedImage, float]:
    """A red sphere, and a green leaf before the part of it right of `leaf_from` (in radii, -1 hides all, 1 nothing).

    Returns:
        The view, and its true V_f by counting the pixels of the sphere.
    """
    u, v = np.meshgrid((np.arange(WIDTH) + 0.5 - INTRINSICS.cx) / INTRINSICS.fx, np.arange(HEIGHT) + 0.5)
    v = (v - INTRINSICS.cy) / INTRINSICS.fy
    z = depth + RADIUS
    c = np.array([centre[0], centre[1], z])
    # Rays (u, v, 1) meet the sphere where |t d - c| = r.
    dd, dc = u**2 + v**2 + 1, u * c[0] + v * c[1] + z
    inside = dc**2 - dd * (c @ c - RADIUS**2)
    sphere = inside > 0
    surface = np.where(sphere, (dc - np.sqrt(np.maximum(inside, 0))) / dd, 0)
    rgb = np.full((HEIGHT, WIDTH, 3), 200, np.uint8)
    depth_m = np.full((HEIGHT, WIDTH), 1.5)
    rgb[sphere], depth_m[sphere] = (190, 30, 25), surface[sphere]
    leaf = (
        (u * z - c[0] > leaf_from * RADIUS)
        & (np.abs(v * z - c[1]) < 2 * RADIUS)
        & (u * z - c[0] < 3 * RADIUS)
    )
    if leaf_from < 1:
        rgb[leaf], depth_m[leaf] = (60, 130, 50), depth - 0.06
    else:
        leaf = np.zeros_like(leaf)
    mask = sphere & ~leaf
    rng = np.random.default_rng(1)
    depth_m = depth_m + noise * depth_m**2 * rng.standard_normal(depth_m.shape)
    view = SegmentedImage(rgb=rgb, depth_m=depth_m, masks=(mask,), intrinsics=INTRINSICS)
    # T counts the part outside the image too: the same test on a canvas three images wide.
    wide = (np.arange(-WIDTH, 2 * WIDTH) + 0.5 - INTRINSICS.cx) / INTRINSICS.fx
    wide = np.broadcast_to(wide, (HEIGHT, 3 * WIDTH))
    rows = np.broadcast_to(v[:, :1], wide.shape)
    dd, dc = wide**2 + rows**2 + 1, wide * c[0] + rows * c[1] + z
    total = np.count_nonzero(dc**2 > dd * (c @ c - RADIUS**2))
    return view, float(mask.sum() / total)


@pytest.mark.parametrize("leaf_from", [-0.6, -0.2, 0.2, 0.6, 2.0])
def test_the_sphere_completes_a_half_hidden_tomato(leaf_from: float) -> None:
    view, truth = draw(leaf_from=leaf_from, noise=0.004)
    (estimate,) = SphereModel()(view)
    assert estimate.visible_fraction == pytest.approx(truth, abs=0.05)
    assert estimate.centre_optical is not None
    assert np.allclose(estimate.centre_optical, (0, 0, 0.43), atol=0.006)
    if leaf_from > 1:
        assert estimate.visible_fraction > 0.99


def test_the_sphere_counts_what_lies_outside_the_image() -> None:
    edge = -INTRINSICS.cx / INTRINSICS.fx * 0.43
    view, truth = draw(leaf_from=2.0, centre=(edge, 0.0))
    assert truth == pytest.approx(0.5, abs=0.05)
    (estimate,) = SphereModel(SphereConfig(radius_m=0.029, radius_spread=0.14))(view)
    # At the image's edge perspective stretches a sphere's silhouette by an eighth, which a circle does not know.
    assert estimate.visible_fraction == pytest.approx(truth, abs=0.1)


def test_a_nearer_leaf_hides_and_a_deeper_one_does_not() -> None:
    view, truth = draw(leaf_from=0.0)
    # The same leaf behind the tomato is background: the tomato is then wholly visible as the half that it shows.
    behind = view.depth_m.copy()
    behind[(behind < 0.36) & (behind > 0)] = 0.6
    deep = SegmentedImage(rgb=view.rgb, depth_m=behind, masks=view.masks, intrinsics=INTRINSICS)
    for model in (ImprovedModel(), SphereModel()):
        assert model(view)[0].visible_fraction < truth + 0.2
        assert model(deep)[0].visible_fraction > 0.9


def test_the_thesis_model_bridges_a_leaf_across_a_tomato() -> None:
    view, _ = draw(leaf_from=2.0)
    rgb, depth, mask = view.rgb.copy(), view.depth_m.copy(), view.masks[0].copy()
    strip = np.zeros_like(mask)
    strip[:, 156:166] = True
    rgb[strip], depth[strip] = (60, 130, 50), 0.3
    truth = (mask & ~strip).sum() / mask.sum()
    crossed = SegmentedImage(rgb=rgb, depth_m=depth, masks=(mask & ~strip,), intrinsics=INTRINSICS)
    (estimate,) = ThesisModel()(crossed)
    # At the image's edge perspective stretches a sphere's silhouette by an eighth, which a circle does not know.
    assert estimate.visible_fraction == pytest.approx(truth, abs=0.1)


def test_what_the_camera_could_not_measure_beside_a_tomato_is_background_to_the_thesis_model() -> None:
    view, _ = draw(leaf_from=2.0)
    # A reddish wall in the shadow that stereo leaves beside the tomato.
    columns = np.flatnonzero(view.masks[0].any(axis=0))
    rgb, depth = view.rgb.copy(), view.depth_m.copy()
    beside = np.zeros_like(view.masks[0])
    beside[100:140, columns[-1] - 2 : columns[-1] + 15] = True
    beside &= ~view.masks[0]
    rgb[beside], depth[beside] = (150, 100, 90), 0.0
    shaded = SegmentedImage(rgb=rgb, depth_m=depth, masks=view.masks, intrinsics=INTRINSICS)
    (estimate,) = ThesisModel()(shaded)
    assert estimate.visible_fraction > 0.95
    assert estimate.whole is not None and not (estimate.whole & beside).sum() > 20


def test_the_learned_whole_box_completes_a_tomato_that_the_segmenter_found() -> None:
    seen: BinaryMask = np.zeros((100, 100), bool)
    seen[40:60, 40:50] = True
    other: BinaryMask = np.zeros((100, 100), bool)
    other[5:15, 5:15] = True

    def segment(image: Image, depth_m: NDArray[np.float32] | None = None) -> Instances:
        # A little more than the mask: 200 of 220 px are the same.
        mask = seen.copy()
        mask[40:60, 50] = True
        return replace(
            Instances.from_masks(mask[None]), amodal_boxes=np.array([[40, 40, 60, 60]], np.float32)
        )

    intrinsics = replace(color_intrinsics(), width=100, height=100)
    view = SegmentedImage(
        rgb=np.zeros((100, 100, 3), np.uint8),
        depth_m=np.ones((100, 100)),
        masks=(seen, other),
        intrinsics=intrinsics,
    )
    found, missed = AmodalModel(segment)(view)
    # V = 200 px; T is a circle 20 px in diameter, of 314.2 px, and the mask's corners outside it.
    columns, rows = np.meshgrid(np.arange(100) + 0.5, np.arange(100) + 0.5)
    corners = (seen & (np.hypot(columns - 50, rows - 50) > 10)).sum()
    assert found.visible_fraction == pytest.approx(200 / (np.pi * 100 + corners))
    assert found.whole is not None and found.whole[50, 55] and not found.whole[50, 61]
    assert np.isnan(missed.visible_fraction)

    def boxes_only(image: Image, depth_m: NDArray[np.float32] | None = None) -> Instances:
        return Instances.from_masks(seen[None])

    with pytest.raises(InvalidInputError, match="no whole boxes"):
        AmodalModel(boxes_only)(view)


def test_the_thesis_steps_are_what_they_say() -> None:
    rgb = np.zeros((4, 4, 3), np.uint8)
    rgb[0, 0] = (10, 200, 0)
    rgb[1, 1] = (200, 10, 0)
    rgb[2, 2] = (95, 100, 0)
    leaves = operations.leaf_image(rgb, 10)
    assert leaves[0, 0] == 255 and np.count_nonzero(leaves) == 1
    # The thesis takes every positive difference.
    assert np.argwhere(operations.leaf_image(rgb, ThesisConfig().leaf_threshold)).tolist() == [[0, 0], [2, 2]]
    assert np.flatnonzero(operations.red_image(rgb)).tolist() == [5]
    binary = np.full((1, 3), 255, np.uint8)
    kept = operations.remove_deeper(binary, np.array([[0.3, 0.0, 0.9]]), 0.5)
    assert kept.tolist() == [[255, 255, 0]]


def test_an_ellipse_is_found_again() -> None:
    image = operations.fill_ellipse(((80.0, 60.0), (60.0, 40.0), 30.0), (120, 160))
    (outline,) = operations.outlines(image, 10)
    found = operations.fit_ellipse(outline)
    assert found is not None
    (x, y), (a, b), _ = found
    assert (x, y) == pytest.approx((80, 60), abs=1) and sorted((a, b)) == pytest.approx([40, 60], abs=2)
    assert operations.fit_ellipse(outline[:4]) is None


def test_touching_tomatoes_are_kept_apart_by_the_watershed() -> None:
    view, _ = draw(leaf_from=2.0)
    radius = RADIUS * INTRINSICS.fx / 0.43
    other = np.roll(view.masks[0], int(2 * radius) - 1, axis=1) & ~view.masks[0]
    rgb, depth = view.rgb.copy(), view.depth_m.copy()
    rgb[other] = (190, 30, 25)
    depth[other] = np.roll(view.depth_m, int(2 * radius) - 1, axis=1)[other]
    both = SegmentedImage(rgb=rgb, depth_m=depth, masks=(view.masks[0], other), intrinsics=INTRINSICS)
    for estimate in (*ImprovedModel()(both), *SphereModel()(both)):
        assert estimate.visible_fraction > 0.9
    # The thesis's red image holds both as one.
    assert len(ThesisModel().run(both).contours) == 1


@pytest.mark.parametrize("model", [ThesisModel(), ImprovedModel(), SphereModel()])
def test_images_without_tomatoes_or_depth_are_no_error(
    model: ThesisModel | ImprovedModel | SphereModel,
) -> None:
    view, _ = draw(leaf_from=0.0)
    nothing = SegmentedImage(rgb=view.rgb, depth_m=view.depth_m, masks=(), intrinsics=INTRINSICS)
    assert list(model(nothing)) == []
    blind = SegmentedImage(
        rgb=view.rgb, depth_m=np.full((HEIGHT, WIDTH), np.nan), masks=view.masks, intrinsics=INTRINSICS
    )
    (estimate,) = model(blind)
    assert not estimate.visible_fraction < 0
    empty = np.zeros((HEIGHT, WIDTH), bool)
    unseen = SegmentedImage(rgb=view.rgb, depth_m=view.depth_m, masks=(empty,), intrinsics=INTRINSICS)
    assert np.isnan(model(unseen)[0].visible_fraction)
    everything = SegmentedImage(rgb=view.rgb, depth_m=view.depth_m, masks=(~empty,), intrinsics=INTRINSICS)
    assert len(model(everything)) == 1


def test_wrong_images_are_refused() -> None:
    view, _ = draw()
    good = {"rgb": view.rgb, "depth_m": view.depth_m, "masks": view.masks, "intrinsics": INTRINSICS}
    for change in (
        {"rgb": view.rgb.astype(np.float32)},
        {"rgb": view.rgb[..., 0]},
        {"rgb": np.zeros((0, 0, 3), np.uint8)},
        {"depth_m": view.depth_m[:100]},
        {"depth_m": (1000 * view.depth_m).astype(np.uint16)},
        {"masks": (view.masks[0].astype(np.uint8),)},
        {"intrinsics": color_intrinsics(640, 480)},
    ):
        with pytest.raises(InvalidInputError):
            SegmentedImage(**(good | change))  # type: ignore[arg-type]
    with pytest.raises(InvalidInputError, match="leaf_threshold must be from 0"):
        ThesisConfig(leaf_threshold=-1)
    with pytest.raises(InvalidInputError, match="behind_m must be positive"):
        ThesisConfig(behind_m=-1.0)
    with pytest.raises(InvalidInputError, match="margin must be positive"):
        ImprovedConfig(margin=0.0)
    with pytest.raises(InvalidInputError, match="radius_m must be positive"):
        SphereConfig(radius_m=float("nan"))


def test_holes_of_the_depth_take_the_farther_side() -> None:
    depth = np.array([[0.0, 0.4, 0.0, 0.0, 0.9, 0.0], [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]])
    assert filled_depth(depth).tolist() == [[0.4, 0.4, 0.9, 0.9, 0.9, 0.9], [0.0] * 6]
    assert np.isnan(fruit_depth(depth, depth == 0.0))


def test_a_hole_is_filled_as_a_shadow_only_if_it_is_no_wider_than_that_of_its_nearer_side() -> None:
    # With a focal length of 100 px the imager 65 mm aside sees 100 x 0.065 x (1 / 0.4 - 1 / 0.9) = 9 px less.
    for width, filled in ((9, 0.9), (20, 0.0)):
        row = np.array([[0.4, *[0.0] * width, 0.9]])
        assert filled_depth(row, focal=100.0).tolist() == [[0.4, *[filled] * width, 0.9]]
    assert filled_depth(np.array([[0.0, 0.9]]), focal=100.0).tolist() == [[0.0, 0.9]], (
        "nothing nearer beside it"
    )


def test_models_are_made_by_name_and_other_names_are_refused() -> None:
    view, _ = draw(leaf_from=2.0)
    for name in ("thesis", "improved", "sphere"):
        assert len(make_occlusion_model(name)(view)) == 1
    with pytest.raises(InvalidInputError, match="sphere"):
        make_occlusion_model("cube")
