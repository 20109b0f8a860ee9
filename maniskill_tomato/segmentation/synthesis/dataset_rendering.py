"""A data set of rendered images: scenes made by several processes, resumed where it was stopped.

A scene is the unit of work. Its images and depth maps are written first, its annotations last, so that what is
annotated is whole; the final files put the scenes together. All random numbers come from (seed, split, scene).
"""

import json
import logging
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from maniskill_tomato.errors import InvalidInputError, RenderingUnavailableError
from maniskill_tomato.files import write_atomically
from maniskill_tomato.folder_lock import only_writer
from maniskill_tomato.plants.mesh_set import MeshSet, MeshSource
from maniskill_tomato.plants.organs import Plant
from maniskill_tomato.plants.seed_splits import SEED_SPLITS
from maniskill_tomato.rendering.vulkan_probe import rendering_problem
from maniskill_tomato.robot.d435 import color_intrinsics
from maniskill_tomato.segmentation.datasets.annotations import (
    AnnotatedImage,
    AnnotatedImages,
    CameraView,
    joined,
)
from maniskill_tomato.segmentation.datasets.coco import read_coco, write_coco
from maniskill_tomato.segmentation.datasets.composition import copied
from maniskill_tomato.segmentation.datasets.picture_files import write_picture
from maniskill_tomato.segmentation.datasets.voc import write_voc
from maniskill_tomato.segmentation.synthesis.appearance import ROBOT_SHARE
from maniskill_tomato.text_files import read_json
from maniskill_tomato.worker_pool import run_jobs

logger = logging.getLogger(__name__)

Split = Literal["train", "validation", "held_out"]

VIEWS_PER_SCENE: Final = 12
"""Images of one scene; growing and building it takes as long as several of them."""

FORMAT: Final = 4
"""Raised when the same seed gives other images."""

CONFIG_FILE: Final = "dataset.json"


@dataclass(frozen=True, kw_only=True)
class DatasetConfig:
    """What identifies a data set; the same values give the same images."""

    count: int = 1000
    """Images."""
    seed: int = 0
    """Draws scenes, looks and views."""
    split: Split = "train"
    """Whose plants: training, validation and held-out plants have disjoint seeds."""
    width: int = 640
    """Of an image, in [px]."""
    height: int = 480
    """Of an image, in [px]."""
    vary_crop: bool = True
    """Cherry and beef tomatoes and other leaf densities too, instead of the tasks' own plants alone."""
    quality: int = 92
    """Of the JPEG files, 1 to 100."""
    plants: str | None = None
    """Mesh file or folder whose plants of the split stand in front, each alone; None grows rows of our own."""
    robot_share: float = ROBOT_SHARE
    """Share of the scenes in which another arm works; only some of their images show it."""

    def __post_init__(self) -> None:
        if self.count < 1:
            raise InvalidInputError(f"count must be 1 or more images, got {self.count}")
        if self.seed < 0:
            raise InvalidInputError(f"seed must be 0 or more, got {self.seed}")
        if self.split not in SEED_SPLITS:
            raise InvalidInputError.choice("split", self.split, SEED_SPLITS)
        if not (64 <= self.width <= 1920 and 64 <= self.height <= 1080):
            raise InvalidInputError(
                f"width and height must be 64 to 1920 and 64 to 1080 px, got {self.width} x {self.height}"
            )
        if not 1 <= self.quality <= 100:
            raise InvalidInputError(f"quality must be 1 to 100, got {self.quality}")
        if not 0 <= self.robot_share <= 1:
            raise InvalidInputError(f"robot_share must be from 0 to 1, got {self.robot_share}")
        if self.plants is not None:
            self.mesh_plants(self.plants).seeds(self.split)

    @property
    def scenes(self) -> int:
        """How many scenes it takes."""
        return -(-self.count // VIEWS_PER_SCENE)

    def identity(self) -> dict[str, Any]:
        """What may not change when a data set is continued; its count may."""
        plants = None if self.plants is None else self.mesh_plants(self.plants).fingerprint
        same = {k: v for k, v in asdict(self).items() if k != "count"}
        return same | {"format": FORMAT, "plants": plants}

    @staticmethod
    def mesh_plants(plants: str) -> MeshSet:
        """The set of mesh files."""
        return MeshSource.parse(plants).plants


def make_dataset(
    config: DatasetConfig,
    out: Path,
    *,
    jobs: int = 1,
    real: AnnotatedImages | None = None,
    on_scene: Callable[[int], object] | None = None,
) -> AnnotatedImages:
    """Renders what is missing and writes the annotations.

    Args:
        config: Which data set.
        out: Its folder; one that was begun with the same configuration is continued.
        jobs: Processes.
        real: Photos to copy in.
        on_scene: Called with the number of images whenever a scene is finished.

    Returns:
        All images of the data set.

    Raises:
        InvalidInputError: The folder holds another data set.
        RenderingUnavailableError: There is no Vulkan device.
        CheckpointError: A file cannot be written, or another process renders in the folder.
    """
    with only_writer(out, "renders"):
        return _make(config, out, jobs, real, on_scene)


def _make(
    config: DatasetConfig,
    out: Path,
    jobs: int,
    real: AnnotatedImages | None,
    on_scene: Callable[[int], object] | None,
) -> AnnotatedImages:
    _claim(config, out)
    missing = [k for k in range(config.scenes) if not _finished(config, out, k)]
    if on_scene is not None and len(missing) < config.scenes:
        on_scene(sum(len(_numbers(config, k)) for k in range(config.scenes) if k not in set(missing)))
    if missing and (problem := rendering_problem()) is not None:
        raise RenderingUnavailableError(problem)
    processes = max(1, min(jobs, len(missing)))
    for _, scene in run_jobs(_render_one, [(config, out, scene) for scene in missing], processes):
        if on_scene is not None:
            on_scene(len(_numbers(config, scene)))
    parts = [read_coco(_scene_file(out, k), root=out) for k in range(config.scenes)]
    rendered = joined(parts).filtered(lambda image: int(Path(image.file_name).stem) < config.count)
    result = joined([rendered, copied(real, out, "real")]) if real is not None else rendered
    write_coco(result, out)
    write_voc(result, out)
    return result


def _claim(config: DatasetConfig, out: Path) -> None:
    path = out / CONFIG_FILE
    if path.is_file():
        found = read_json(path)
        if not isinstance(found, dict):
            raise InvalidInputError(f"{path} describes no data set; choose another folder")
        # A data set that was begun before an option existed has that option's default.
        found = {"robot_share": DatasetConfig.robot_share} | found
        differing = [k for k, v in config.identity().items() if found.get(k) != v]
        if differing:
            raise InvalidInputError(
                f"{out} holds a data set with another {', '.join(differing)}; choose another folder or the same values"
            )
    elif out.is_dir() and any(out.iterdir()):
        raise InvalidInputError(
            f"{out} is not empty and holds no data set of this command; choose another folder"
        )
    write_atomically(path, json.dumps(config.identity() | {"count": config.count}, indent=2).encode())


def _numbers(config: DatasetConfig, scene: int) -> range:
    return range(scene * VIEWS_PER_SCENE, min((scene + 1) * VIEWS_PER_SCENE, config.count))


def _scene_file(out: Path, scene: int) -> Path:
    return out / "scenes" / f"{scene:06d}.json"


def _finished(config: DatasetConfig, out: Path, scene: int) -> bool:
    path = _scene_file(out, scene)
    if not path.is_file():
        return False
    done = {int(Path(image.file_name).stem) for image in read_coco(path, root=out).images}
    return done.issuperset(_numbers(config, scene))


def _render_one(work: tuple[DatasetConfig, Path, int]) -> int:
    return render_scene(*work)


def render_scene(config: DatasetConfig, out: Path, scene: int) -> int:
    """Renders, annotates and writes one scene's images.

    Args:
        config: The data set.
        out: Its folder.
        scene: Which of its scenes.

    Returns:
        The scene's number.
    """
    from maniskill_tomato.robot.depth_noise import DepthNoise, measure_depth
    from maniskill_tomato.segmentation.synthesis.annotate import annotate
    from maniskill_tomato.segmentation.synthesis.appearance import draw_appearance
    from maniskill_tomato.segmentation.synthesis.greenhouse import GreenhouseScene, grow
    from maniskill_tomato.segmentation.synthesis.photo import develop, draw_photo_settings
    from maniskill_tomato.segmentation.synthesis.viewpoints import draw_views

    low, high = SEED_SPLITS[config.split]
    rng = np.random.default_rng([config.seed, low, scene])
    appearance = draw_appearance(rng, vary_crop=config.vary_crop, robot_share=config.robot_share)
    coarse: Plant
    fine: Plant
    if config.plants is None:
        coarse, fine = grow(appearance, low + int(rng.integers(high - low)), (low, high))
    else:
        meshes = config.mesh_plants(config.plants)
        seeds = meshes.seeds(config.split)
        coarse = fine = meshes.grow(seeds[int(rng.integers(len(seeds)))])
    intrinsics = color_intrinsics(config.width, config.height)
    views = draw_views(coarse, VIEWS_PER_SCENE, intrinsics, rng)
    built = GreenhouseScene(fine, appearance, intrinsics, rng, first_seed=low)
    images = []
    for number, view in zip(_numbers(config, scene), views, strict=False):
        # Numbers of its own for each image: a larger count must not change the others.
        rng = np.random.default_rng([config.seed, low, scene, number])
        sun = draw_appearance(rng)
        built.relight(replace(appearance, sun=sun.sun, sun_direction=sun.sun_direction))
        shot = built.shoot(view.T_plant_optical)
        photo = develop(shot.light, shot.depth_m, draw_photo_settings(rng), rng)
        noise = DepthNoise(
            subpixel_rms=float(rng.uniform(0.03, 0.12)), hole_share=float(rng.uniform(0.0, 0.04))
        )
        depth_mm = np.round(measure_depth(shot.depth_m, intrinsics, noise, rng) * 1000).astype(np.uint16)
        name = f"images/{number:06d}.jpg"
        depth_path = out / "depth" / f"{number:06d}.png"
        quality = int(rng.integers(max(config.quality - 14, 1), config.quality + 1))
        write_picture(out / name, photo, quality)
        write_picture(depth_path, depth_mm)
        images.append(
            AnnotatedImage(
                path=out / name,
                file_name=name,
                width=config.width,
                height=config.height,
                instances=annotate(shot.thing, built.things, view.T_plant_optical, intrinsics),
                depth_path=depth_path,
                camera=CameraView(T_world_optical=view.T_plant_optical, matrix=intrinsics.matrix),
            )
        )
    write_coco(AnnotatedImages(images=tuple(images)), out / "scenes", name=f"{scene:06d}")
    return scene
