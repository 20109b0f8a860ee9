"""Judges the occlusion models by their error in V_f on rendered images of plants that nothing was tuned on.

Usage:
    maniskill-tomato dataset --count 1000 --split held_out --no-vary-crop --out runs/held_out
    python scripts/judge_occlusion.py --data runs/held_out --out runs/occlusion
    python scripts/judge_occlusion.py --data runs/held_out --figure images/000003.jpg --out runs/occlusion
"""

import json
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

import tyro
from tqdm import tqdm

from maniskill_tomato.errors import InvalidInputError, TomatoError
from maniskill_tomato.files import write_atomically
from maniskill_tomato.segmentation.datasets.reading import read_annotated
from maniskill_tomato.sensing.visible_fraction.amodal import AmodalModel
from maniskill_tomato.sensing.visible_fraction.estimate import OcclusionModel
from maniskill_tomato.sensing.visible_fraction.figure import draw_steps
from maniskill_tomato.sensing.visible_fraction.improved import ImprovedModel
from maniskill_tomato.sensing.visible_fraction.judge import annotated_fruits, judge, make_view, markdown
from maniskill_tomato.sensing.visible_fraction.sphere import SphereModel
from maniskill_tomato.sensing.visible_fraction.thesis import ThesisModel


@dataclass(frozen=True, kw_only=True)
class Args:
    """Judge occlusion models."""

    data: Path
    """A folder of `maniskill-tomato dataset`."""
    out: Path = Path("runs/occlusion")
    """Folder of the results."""
    models: tuple[str, ...] = ("thesis", "improved", "sphere", "amodal")
    """Which models."""
    count: int | None = None
    """Only the first images; all by default."""
    categories: tuple[str, ...] = ("tomato_ripe",)
    """Which tomatoes count; the thesis's model knows red ones only."""
    min_visible: int = 100
    """Tomatoes seen in fewer pixels are left out."""
    min_total: int = 400
    """Tomatoes whose whole silhouette has fewer pixels are left out: those of the rows behind."""
    figure: str | None = None
    """Draw every step on this image of the folder (steps.png, as Fig. 4-28) instead of judging."""


def draw_figure(args: Args, known: dict[str, OcclusionModel]) -> None:
    """Draws the steps of the thesis's model on one image, and what the others make of it."""
    images = read_annotated(args.data).images
    named = [image for image in images if image.file_name == args.figure]
    if not named:
        raise InvalidInputError.choice("--figure", str(args.figure), [i.file_name for i in images[:20]])
    area = [
        f for f in annotated_fruits(named[0]) if f.visible_mask and f.visible_mask.area >= args.min_visible
    ]
    view = make_view(named[0], area)
    if view is None:
        raise InvalidInputError(
            f"{args.figure} has no depth or camera; take a folder of `maniskill-tomato dataset`"
        )
    others = {name: list(known[name](view)) for name in args.models if name != "thesis"}
    draw_steps(view, ThesisModel().run(view), args.out / "steps.png", others)
    print(f"figure {args.out / 'steps.png'}")


def main(args: Args) -> None:
    """Runs the models, prints the tables and writes them with every single judgement."""
    known: dict[str, OcclusionModel] = {
        "thesis": ThesisModel(),
        "improved": ImprovedModel(),
        "sphere": SphereModel(),
        "amodal": AmodalModel(),
    }
    for name in args.models:
        if name not in known:
            raise InvalidInputError.choice("--models", name, known)
    if args.figure is not None:
        draw_figure(args, known)
        return
    images = read_annotated(args.data).images[: args.count]
    with tqdm(total=len(images), unit="image", disable=None) as bar:
        judged, milliseconds = judge(
            images,
            {n: known[n] for n in args.models},
            min_visible=args.min_visible,
            min_total=args.min_total,
            on_image=bar.update,
        )
    judged = [j for j in judged if j.category in args.categories]
    table = markdown(judged, milliseconds)
    text = f"{len(images)} images, {', '.join(args.categories)}, at least {args.min_visible} px visible, "
    text += f"{args.min_total} px in all.\n\n{table}"
    write_atomically(args.out / "occlusion.md", text.encode())
    write_atomically(args.out / "occlusion.json", json.dumps([asdict(j) for j in judged]).encode())
    print(text)


if __name__ == "__main__":
    try:
        main(tyro.cli(Args))
    except TomatoError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
