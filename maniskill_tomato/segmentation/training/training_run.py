"""A training of a segmenter from folders of images to a file of weights; one that was stopped goes on."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.segmentation.datasets.annotations import AnnotatedImage
from maniskill_tomato.segmentation.datasets.reading import read_place
from maniskill_tomato.segmentation.metrics.detection_plots import plot_losses
from maniskill_tomato.segmentation.training.resumable_training import CHECKPOINT, ResumableTraining
from maniskill_tomato.segmentation.yolo import read_history, train_yolo, write_yolo_data


@dataclass(frozen=True, kw_only=True)
class TrainingImages:
    """What a segmenter is trained on."""

    sets: tuple[tuple[AnnotatedImage, ...], ...]
    """The images of each folder."""
    shares: tuple[float, ...]
    """How often each folder is drawn from."""
    validation: tuple[AnnotatedImage, ...]
    """Images whose losses are logged too."""

    @classmethod
    def read(
        cls,
        places: Sequence[str],
        shares: Sequence[float],
        validation: str | None,
        limit: int | None,
        report: Callable[[str], None],
    ) -> "TrainingImages":
        """Reads annotated images.

        Args:
            places: Folders, or FOLDER:SPLIT for one list of a folder.
            shares: How often each is drawn from; all alike if empty.
            validation: Such a place.
            limit: Use only this many images of each folder, the first of its list.
            report: Told what is left out of a folder.

        Raises:
            InvalidInputError: There is nothing usable in one of them.
        """
        if limit is not None and limit < 1:
            raise InvalidInputError(f"limit must be 1 or more, got {limit}")

        def images(place: str, count: int | None) -> tuple[AnnotatedImage, ...]:
            found = read_place(place)
            if found.skipped:
                report(f"{place}: {found.skipped_text()}")
            return found.images[:count]

        return cls(
            sets=tuple(images(place, limit) for place in places),
            shares=tuple(shares) or (1.0,) * len(places),
            validation=images(validation, None) if validation else (),
        )


def run_training(
    training: ResumableTraining, out: Path, report: Callable[[str], None], stopped: Callable[[], bool]
) -> Path | None:
    """Goes on or begins, and draws the losses at the end.

    Returns:
        File of the weights, or None if it was stopped.
    """
    if (out / CHECKPOINT).is_file():
        training.resume(out)
    path = training.run(out, report, stopped)
    if training.history:
        plot_losses({out.name: training.history}, out / "losses.png")
    return path


def run_yolo_training(
    images: TrainingImages, out: Path, settings: dict[str, object], model: str, seed: int
) -> Path:
    """Trains YOLO through Ultralytics, and draws the losses at the end."""
    data = write_yolo_data([image for one in images.sets for image in one], images.validation, out / "data")
    path = train_yolo(data, out, settings, model, seed)
    plot_losses({out.name: read_history(out / "yolo" / "results.csv")}, out / "losses.png")
    return path
