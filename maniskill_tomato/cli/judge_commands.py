"""`maniskill-tomato judge`: how good the parts are that a policy rests on."""

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from maniskill_tomato.cli.early_checks import (
    check_counts,
    check_folder,
    check_place,
    check_policies,
    check_policy,
    check_profile,
    check_segmenter,
)
from maniskill_tomato.cli.shared_options import say
from maniskill_tomato.experiments.configs import PerceptionComparisonConfig, TwinConfig

OcclusionModelName = Literal[
    "thesis", "thesis_watershed", "thesis_classifier", "improved", "sphere", "amodal"
]


@dataclass(frozen=True, kw_only=True)
class JudgeOcclusion:
    """Judge occlusion models by their error in V_f on rendered images.

    For plants that nothing was tuned on: `maniskill-tomato dataset --count 1000 --split held_out --no-vary-crop`.
    """

    data: Path
    """A folder of `maniskill-tomato dataset`."""
    out: Path = Path("runs/occlusion")
    """Folder of report.html, and of occlusion.json or steps.png."""
    models: tuple[OcclusionModelName, ...] = ("thesis", "improved", "sphere", "amodal")
    """Which models."""
    segmenter: str | None = None
    """Name of a segmenter, or a file of weights, that finds the tomatoes; the models then measure as on the robot. By
    default they are given the true masks."""
    count: int | None = None
    """Only the first images; all by default."""
    categories: tuple[str, ...] = ("tomato_ripe",)
    """Which tomatoes count; the thesis's model knows red ones only."""
    min_visible: int = 100
    """Tomatoes seen in fewer pixels are left out, in [px]."""
    min_total: int = 400
    """Tomatoes whose whole silhouette has fewer pixels are left out, in [px]: those of the rows behind."""
    figure: str | None = None
    """Draw every step on this image of the folder (steps.png, as Fig. 4-28) instead of judging."""

    def run(self) -> None:
        """Runs the models and prints the tables."""
        check_folder("--data", self.data)
        if self.segmenter is not None:
            check_segmenter("--segmenter", self.segmenter)
        check_counts(count=self.count)

        from tqdm import tqdm

        from maniskill_tomato.experiments.occlusion_report import (
            draw_occlusion,
            report_occlusion,
        )
        from maniskill_tomato.segmentation.datasets.reading import read_annotated

        if self.figure is not None:
            path = draw_occlusion(
                self.data, self.figure, self.out, models=self.models, min_visible=self.min_visible
            )
            print(f"figure {path}")
            print(f"report {self.out / 'report.html'}")
            return
        images = read_annotated(self.data).images[: self.count]
        with tqdm(total=len(images), unit="image", disable=None) as bar:
            text = report_occlusion(
                images,
                self.out,
                models=self.models,
                categories=self.categories,
                min_visible=self.min_visible,
                min_total=self.min_total,
                segmenter=self.segmenter,
                on_image=bar.update,
            )
        print(text)
        print(f"report {self.out / 'report.html'}")


@dataclass(frozen=True, kw_only=True)
class JudgeSegmenter:
    """Judge a segmenter on annotated images: precision, recall, AP (Eq. 4-1 to 4-3), COCO's AP and AR, pictures."""

    data: str
    """Folder of annotated images, or FOLDER:SPLIT for one list of it (`photos:val` for its val.txt)."""
    segmenter: str = "light"
    """Name of a segmenter (light, colour, mask_rcnn, yolo), or a file of weights."""
    thorough: bool = False
    """Let the light segmenter look at each image as often as `maniskill-tomato detect` does."""
    limit: int | None = None
    """Look at this many images only, spread over the list."""
    smallest_share: float | None = None
    """Rendered fruits narrower than this share of the image's longer side are set aside; by default 12 px of 640; 0:
    the tiniest alone."""
    out: Path = Path("runs/segmenter-evaluation")
    """Folder of metrics.json, report.html, precision_recall.png, overlaps.png and pictures.jpg."""

    def run(self) -> None:
        """Evaluates and prints the figures."""
        check_place("--data", self.data)
        check_segmenter("--segmenter", self.segmenter)
        check_counts(limit=self.limit)

        from tqdm import tqdm

        from maniskill_tomato.files import write_atomically
        from maniskill_tomato.segmentation.datasets.annotations import SMALLEST_SHARE
        from maniskill_tomato.segmentation.datasets.reading import read_place
        from maniskill_tomato.segmentation.metrics.detector_evaluation import (
            chosen_images,
            coco_table,
            evaluate_segmenter,
        )
        from maniskill_tomato.segmentation.metrics.evaluation_page import write_evaluation_page
        from maniskill_tomato.segmentation.segmenter import open_for_files

        segmenter = open_for_files(self.segmenter, 0.02, self.thorough)
        found = read_place(self.data)
        if found.skipped:
            print(f"{self.data}: {found.skipped_text()}", file=sys.stderr)
        share = SMALLEST_SHARE if self.smallest_share is None else self.smallest_share
        images = chosen_images(found.images, self.limit)
        with tqdm(total=len(images), unit="image", disable=None) as bar:
            judged = evaluate_segmenter(segmenter, images, self.out, share, bar.update)
        metrics = judged.metrics
        described = {"segmenter": self.segmenter, "thorough": self.thorough, "data": self.data, **metrics}
        write_atomically(self.out / "metrics.json", json.dumps(described, indent=1).encode())
        for name, value in metrics.items():
            if not name.startswith("coco_"):
                print(f"{name:24} {value:.4g}")
        print(coco_table(metrics))
        about = {"segmenter": self.segmenter, "data": self.data, "thorough": str(self.thorough)}
        print(f"report {write_evaluation_page(judged, self.out, about)}")


@dataclass(frozen=True, kw_only=True)
class JudgePlants:
    """Read plants from mesh files, say what is in them, and what a budget of triangles changes in V_f.

    Every file is read, so that one that is refused shows at once.
    """

    mesh: Path
    """A mesh file, or a folder of them; the rules stand in its mesh.toml."""
    split: Literal["train", "validation", "held_out", "all"] = "all"
    """Whose plants."""
    triangles: int | None = None
    """The most that a plant may keep; by default what mesh.toml says."""
    out: Path = Path("runs/plants")
    """Folder of report.html and plants.json."""

    def run(self) -> None:
        """Reads the plants and prints the table."""
        from maniskill_tomato.plants.mesh_rules import MeshRules
        from maniskill_tomato.plants.mesh_set import MeshSource

        MeshRules(triangles=self.triangles)
        source = MeshSource.parse(self.mesh)
        count = len(source.plants.seeds(self.split))

        from tqdm import tqdm

        from maniskill_tomato.experiments.mesh_judgement import judge_meshes

        with tqdm(total=count, unit="plant", disable=None) as bar:
            text = judge_meshes(source, self.split, self.triangles, self.out, bar.update)
        print(text)
        print(f"report {self.out / 'report.html'}")


@dataclass(frozen=True, kw_only=True)
class JudgePerception(PerceptionComparisonConfig):
    """Measure what a policy loses when it sees through the camera instead of the simulator, on the same episodes.

    An episode ends when the robot believes that the target is fully visible, or after the last move. It is a success
    if that is then true.
    """

    def run(self) -> None:
        """Runs what is missing and prints the table."""
        check_policies("--policies", self.policies)

        from maniskill_tomato.experiments.perception_comparison import compare_perceptions

        done = compare_perceptions(self)
        print(done.table)
        print(f"report  {done.report}")


@dataclass(frozen=True, kw_only=True)
class JudgeTwin(TwinConfig):
    """Run the twin of `deploy` on many episodes, and judge it by ray casting.

    The simulated task runs the same episodes with the same policy. The difference of the two rates is what perception,
    depth noise, dynamics and the safety checks cost. An episode whose run cannot begin, or ends with a fault, counts as
    failed.
    """

    def run(self) -> None:
        """Runs what is missing and prints the figures."""
        check_profile("--profile", self.profile)
        if self.policy is not None:
            check_policy("--policy", self.policy, on_robot=True)

        from maniskill_tomato.experiments.twin_comparison import compare_twin
        from maniskill_tomato.experiments.twin_inspection import inspect_twin

        measure = inspect_twin if self.inspect else compare_twin
        print(json.dumps(measure(self, say), indent=1))
        say(f"report  {self.out / 'report.html'}")
