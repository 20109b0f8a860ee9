"""How far occlusion models are from the truth: errors in V_f on annotated images, by how hidden the tomato is."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.report_design import markdown_table
from maniskill_tomato.robot.d435 import CameraIntrinsics
from maniskill_tomato.segmentation.datasets.annotations import AnnotatedImage, Instance
from maniskill_tomato.segmentation.instances import Instances
from maniskill_tomato.segmentation.metrics.detection_metrics import mask_overlaps
from maniskill_tomato.segmentation.segmenter import Segmenter
from maniskill_tomato.sensing.fruit_detector import FruitDetector
from maniskill_tomato.sensing.posed_frame import PosedFrame
from maniskill_tomato.sensing.visible_fraction.estimate import Estimate, OcclusionModel, SegmentedImage

BANDS = ((0.0, 0.2), (0.2, 0.4), (0.4, 0.6), (0.6, 0.8), (0.8, 0.95), (0.95, 1.001))
"""Levels of the true visible fraction."""

LEAST_HIDDEN = 0.05
"""Share of a tomato that must be hidden for its hidden part to be compared."""

SAME_FRUIT = 0.5
"""Intersection over union of a fruit's visible pixels and a mask from which on the mask is that fruit's."""


@dataclass(frozen=True, kw_only=True)
class Judged:
    """One tomato in one image, by one model."""

    model: str
    file_name: str
    category: str
    visible_px: int
    truth: float
    """V_f of the annotation."""
    estimate: float
    """V_f of the model; NaN where it failed."""
    whole_iou: float = float("nan")
    """Intersection over union of the model's whole silhouette with the true one, inside the image; 0 where it failed,
    NaN where silhouettes are not compared."""
    hidden_iou: float = float("nan")
    """The same of what is hidden of the silhouettes; NaN where less than `LEAST_HIDDEN` is."""


@dataclass(frozen=True, kw_only=True)
class Score:
    """What a model's errors come to."""

    count: int
    mae: float
    """Mean absolute error of V_f; a failure counts with the error of a guess of 0."""
    bias: float
    """Mean error, without failures."""
    rmse: float
    """Root of the mean squared error, without failures."""
    failures: int
    """Tomatoes about which the model said nothing."""


def annotated_fruits(image: AnnotatedImage) -> list[Instance]:
    """The visible tomatoes of an image whose masks and V_f are known."""
    return [i for i in image.fruits if i.visible_mask is not None and i.visible_fraction is not None]


def make_view(image: AnnotatedImage, fruits: list[Instance]) -> SegmentedImage | None:
    """What a robot with a perfect segmenter has of an image; None without depth or camera."""
    depth = image.load_depth()
    if depth is None or image.camera is None:
        return None
    k = image.camera.matrix
    intrinsics = CameraIntrinsics(
        width=image.width, height=image.height, fx=k[0, 0], fy=k[1, 1], cx=k[0, 2], cy=k[1, 2]
    )
    masks = tuple(i.visible_mask.decode() for i in fruits if i.visible_mask is not None)
    return SegmentedImage(rgb=image.load(), depth_m=depth, masks=masks, intrinsics=intrinsics)


def judge(
    images: tuple[AnnotatedImage, ...],
    models: Mapping[str, OcclusionModel],
    *,
    segmenter: Segmenter | None = None,
    min_visible: int = 100,
    min_total: int = 400,
    on_image: Callable[[int], object] | None = None,
) -> tuple[list[Judged], dict[str, float]]:
    """Runs models on annotated images.

    Args:
        images: With depth, cameras and V_f.
        models: By name.
        segmenter: What finds the fruits, measured as a robot does (`FruitDetector`); one that no mask shares half with
            counts as a failure. None gives the models the true masks.
        min_visible: Fruits seen in fewer pixels are left out of the judgement.
        min_total: Fruits whose whole silhouette has fewer pixels, too: those of the rows behind. At 640 x 480 a tomato
            30 mm in radius has 400 px at 1.6 m.
        on_image: Called with 1 after every image.

    Returns:
        Every single judgement, and each model's mean processor time for an image, in [ms], without the segmenter's.
    """
    results: list[Judged] = []
    seconds = dict.fromkeys(models, 0.0)
    count = 0
    for image in images:
        fruits = annotated_fruits(image)
        view = make_view(image, fruits)
        if view is not None and fruits:
            count += 1
            found = None if segmenter is None else segmenter(view.rgb, view.depth_m.astype(np.float32))
            for name, model in models.items():
                start = time.process_time()
                outlines = [(float("nan"), float("nan"))] * len(fruits)
                if found is None:
                    told = model(view)
                    seconds[name] += time.process_time() - start
                    estimates = [estimate.visible_fraction for estimate in told]
                    outlines = [compared_outline(f, e) for f, e in zip(fruits, told, strict=True)]
                else:
                    estimates = _measured(image, view, fruits, model, found)
                    seconds[name] += time.process_time() - start
                for fruit, estimate, outline in zip(fruits, estimates, outlines, strict=True):
                    assert fruit.visible_mask is not None and fruit.visible_fraction is not None
                    area = fruit.visible_mask.area
                    if area < min_visible or area < min_total * fruit.visible_fraction:
                        continue
                    results.append(
                        Judged(
                            model=name,
                            file_name=image.file_name,
                            category=fruit.category,
                            visible_px=area,
                            truth=fruit.visible_fraction,
                            estimate=estimate,
                            whole_iou=outline[0],
                            hidden_iou=outline[1],
                        )
                    )
        if on_image is not None:
            on_image(1)
    return results, {name: 1000 * s / max(count, 1) for name, s in seconds.items()}


def compared_outline(fruit: Instance, estimate: Estimate) -> tuple[float, float]:
    """`Judged.whole_iou` and `Judged.hidden_iou` of an estimate; NaN where the true silhouette is not known."""
    if fruit.amodal_mask is None or fruit.visible_mask is None:
        return float("nan"), float("nan")
    whole, visible = fruit.amodal_mask.decode(), fruit.visible_mask.decode()
    hidden = whole & ~visible
    is_compared = hidden.sum() >= LEAST_HIDDEN * whole.sum()
    if estimate.whole is None:
        return 0.0, 0.0 if is_compared else float("nan")
    return _iou(whole, estimate.whole), _iou(hidden, estimate.whole & ~visible) if is_compared else float(
        "nan"
    )


def _iou(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    return float((a & b).sum() / max((a | b).sum(), 1))


def _measured(
    image: AnnotatedImage,
    view: SegmentedImage,
    fruits: list[Instance],
    model: OcclusionModel,
    found: Instances,
) -> list[float]:
    """V_f of each annotated fruit as a robot measures it that was told what a segmenter found; NaN where it did not."""
    assert image.camera is not None
    frame = PosedFrame(
        depth_m=view.depth_m.astype(np.float32),
        intrinsics=view.intrinsics,
        T_world_camera=image.camera.T_world_optical,
        rgb=view.rgb,
    )

    def told(image: NDArray[np.uint8], depth_m: NDArray[np.float32] | None = None) -> Instances:
        return found

    measurement = FruitDetector(told, model).measure(frame)
    shape = (-1, *view.depth_m.shape)
    masks = np.array([measurement.mask(k) for k in range(len(measurement.fruits))], bool).reshape(shape)
    estimates = []
    for overlaps in mask_overlaps(np.array(view.masks, bool).reshape(shape), masks):
        best = int(overlaps.argmax()) if len(overlaps) else -1
        shared = best >= 0 and overlaps[best] >= SAME_FRUIT
        estimates.append(measurement.fruits[best].visible_fraction if shared else float("nan"))
    return estimates


def score(judged: list[Judged]) -> Score:
    """Sums judgements up; NaN for the errors of an empty list."""
    truth = np.array([j.truth for j in judged])
    estimate = np.array([j.estimate for j in judged])
    found = np.isfinite(estimate)
    errors = (estimate - truth)[found]
    penalised = np.abs(np.where(found, estimate, 0.0) - truth)
    return Score(
        count=len(judged),
        mae=float(penalised.mean()) if len(judged) else float("nan"),
        bias=float(errors.mean()) if len(errors) else float("nan"),
        rmse=float(np.sqrt((errors**2).mean())) if len(errors) else float("nan"),
        failures=int((~found).sum()),
    )


def by_band(judged: list[Judged]) -> list[tuple[tuple[float, float], Score]]:
    """Scores for each level of the true V_f."""
    return [(band, score([j for j in judged if band[0] <= j.truth < band[1]])) for band in BANDS]


SCORE_HEAD = ("model", "tomatoes", "MAE", "bias", "RMSE", "failures", "CPU ms an image")


def score_cells(judged: list[Judged], milliseconds: Mapping[str, float]) -> list[tuple[str, ...]]:
    """The lines of a table with `SCORE_HEAD`."""
    rows: list[tuple[str, ...]] = []
    for name, own in _by_model(judged, milliseconds).items():
        s = score(own)
        errors = f"{s.mae:.3f}", f"{s.bias:+.3f}", f"{s.rmse:.3f}"
        rows.append((name, str(s.count), *errors, str(s.failures), f"{milliseconds[name]:.0f}"))
    return rows


def band_table(
    judged: list[Judged], milliseconds: Mapping[str, float]
) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Head and lines of a table of errors by the true V_f."""
    bands = [by_band(own) for own in _by_model(judged, milliseconds).values()]
    rows = [
        (
            f"{low:g} to {min(high, 1):g}",
            *(f"{band[k][1].mae:.3f} ({band[k][1].bias:+.3f})" for band in bands),
            str(bands[0][k][1].count),
        )
        for k, (low, high) in enumerate(BANDS)
    ]
    return ("true V_f", *(f"{name}: MAE (bias)" for name in milliseconds), "tomatoes"), rows


OUTLINE_HEAD = ("model", "tomatoes", "IoU of the whole", "partly hidden", "IoU of the hidden part")


def outline_cells(judged: list[Judged]) -> list[tuple[str, ...]]:
    """The lines of a table with `OUTLINE_HEAD`, means over tomatoes; none where no silhouettes were compared."""
    rows: list[tuple[str, ...]] = []
    for name in dict.fromkeys(j.model for j in judged):
        own = [j for j in judged if j.model == name and np.isfinite(j.whole_iou)]
        hidden = [j.hidden_iou for j in own if np.isfinite(j.hidden_iou)]
        if own:
            whole = float(np.mean([j.whole_iou for j in own]))
            part = f"{np.mean(hidden):.3f}" if hidden else ""
            rows.append((name, str(len(own)), f"{whole:.3f}", str(len(hidden)), part))
    return rows


def markdown(judged: list[Judged], milliseconds: Mapping[str, float]) -> str:
    """The judgements as tables."""
    by_model = markdown_table(SCORE_HEAD, score_cells(judged, milliseconds))
    tables = [by_model, markdown_table(*band_table(judged, milliseconds))]
    if outlines := outline_cells(judged):
        tables.append(markdown_table(OUTLINE_HEAD, outlines))
    return "\n\n".join(tables) + "\n"


def _by_model(judged: list[Judged], milliseconds: Mapping[str, float]) -> dict[str, list[Judged]]:
    return {name: [j for j in judged if j.model == name] for name in milliseconds}
