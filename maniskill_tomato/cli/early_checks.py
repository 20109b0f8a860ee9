"""What can be checked of arguments without PyTorch, ManiSkill or a device, so that a typo costs no seconds."""

from collections.abc import Iterable, Sequence
from pathlib import Path

from maniskill_tomato.errors import InvalidInputError, did_you_mean
from maniskill_tomato.policies.planner_names import PLANNERS
from maniskill_tomato.tasks import TASK_IDS


def check_choice(flag: str, value: str, allowed: Sequence[str]) -> None:
    """Accepts one of several words."""
    if value not in allowed:
        raise InvalidInputError.choice(flag, value, allowed)


def check_env_id(env_id: str, allowed: Sequence[str] = TASK_IDS) -> None:
    """Accepts the ID of a task."""
    check_choice("ENV_ID", env_id, allowed)


def check_count(flag: str, value: int | None, least: int = 1) -> None:
    """Accepts a whole number of `least` or more, or none."""
    if value is not None and value < least:
        raise InvalidInputError(f"{flag} must be {least} or more, got {value}")


def check_file(flag: str, path: Path | None) -> None:
    """Accepts a file, or none."""
    if path is not None and not path.is_file():
        raise InvalidInputError(f"{flag}: there is no file {path}{_neighbour(path)}")


def check_folder(flag: str, path: Path | None) -> None:
    """Accepts a folder, or none."""
    if path is not None and not path.is_dir():
        raise InvalidInputError(f"{flag}: there is no folder {path}{_neighbour(path)}")


def check_policy(flag: str, text: str, names: Iterable[str] = PLANNERS) -> None:
    """Accepts one of the names, or an existing file of a policy."""
    known = tuple(names)
    if text in known or Path(text).is_file():
        return
    or_names = f", or one of {', '.join(known)}" if known else ""
    raise InvalidInputError(
        f"{flag}: no policy at {text!r}; give a .pt or .onnx file{or_names}"
        f"{did_you_mean(text, known) or _neighbour(Path(text))}"
    )


def check_policies(flag: str, text: str) -> None:
    """Accepts planners and files of policies with commas between them; LABEL=FILE is a file."""
    parts = [part.strip() for part in text.split(",") if part.strip()]
    if not parts:
        raise InvalidInputError(f"{flag} must name one policy or more, with commas between them")
    for part in parts:
        label, _, file = part.rpartition("=")
        check_policy(flag, file, () if label else PLANNERS)


def check_place(flag: str, place: str) -> None:
    """Accepts FOLDER or FOLDER:SPLIT."""
    if not Path(place).is_dir():
        check_folder(flag, Path(place.rpartition(":")[0] or place))


def check_segmenter(flag: str, text: str, without: Sequence[str] = ()) -> None:
    """Accepts a segmenter's name or an existing file of weights."""
    from maniskill_tomato.segmentation.segmenter import SEGMENTERS

    names = tuple(name for name in SEGMENTERS if name not in without)
    if text not in names and not Path(text).is_file():
        raise InvalidInputError(
            f"{flag} must be a file of weights or one of {', '.join(names)}; got {text!r}{did_you_mean(text, names)}"
        )


def check_profile(flag: str, text: str) -> None:
    """Accepts the name of a profile that ships, or an existing file."""
    from maniskill_tomato.deploy.profile_files import profile_names, profile_path

    if not profile_path(text).is_file():
        raise InvalidInputError(
            f"{flag}: no profile {text!r}: give the path of a TOML file or one of {', '.join(profile_names())}"
            f"{did_you_mean(text, profile_names())}"
        )


def _neighbour(path: Path) -> str:
    """Names a file beside it that is called nearly the same."""
    if not path.parent.is_dir():
        return ""
    return did_you_mean(path.name, [p.name for p in path.parent.iterdir()])
