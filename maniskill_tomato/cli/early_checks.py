"""What can be checked of arguments without PyTorch, ManiSkill or a device, so that a typo costs no seconds."""

import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from maniskill_tomato.errors import InvalidInputError, PolicyError, did_you_mean
from maniskill_tomato.extension_points import is_import_path
from maniskill_tomato.policies.opening import find_policy
from maniskill_tomato.policies.registry import PRIVILEGED
from maniskill_tomato.task_registry import TASK_IDS, base_of, check_task_name, find_task, task_ids


def check_choice(flag: str, value: str, allowed: Sequence[str]) -> None:
    """Accepts one of several words."""
    if value not in allowed:
        raise InvalidInputError.choice(flag, value, allowed)


def check_env_id(env_id: str, bases: Sequence[str] = TASK_IDS) -> None:
    """Accepts the ID of a task, or `package.module:attribute` of one.

    Args:
        env_id: What was typed.
        bases: The tasks of this package that it may be, or be a form of.
    """
    check_task_name(env_id, "ENV_ID")
    if is_import_path(env_id):
        find_task(env_id)
    if env_id in TASK_IDS or len(bases) < len(TASK_IDS):
        base = env_id if env_id in TASK_IDS else base_of(env_id)
        if base not in bases:
            raise InvalidInputError.choice("ENV_ID", env_id, bases)


def task_word(argv: Sequence[str]) -> str | None:
    """The first argument that names a task, before the arguments are taken apart; None if none does."""
    known = task_ids()
    words = [word for before, word in zip(("", *argv), argv, strict=False) if before != "--plant"]
    word = next((word for word in words if word in known or is_import_path(word)), None)
    if word is not None and is_import_path(word):
        with suppress(InvalidInputError):  # `check_env_id` tells it.
            find_task(word)
    return word


def check_counts(least: int = 1, **values: int | None) -> None:
    """Accepts whole numbers of `least` or more, or none; their flags are called like the arguments."""
    for name, value in values.items():
        if value is not None and value < least:
            raise InvalidInputError(f"--{name.replace('_', '-')} must be {least} or more, got {value}")


def check_file(flag: str, path: Path | None) -> None:
    """Accepts a file, or none."""
    if path is not None and path.is_dir():
        raise InvalidInputError(f"{flag} must be a file, and {path} is a folder")
    if path is not None and not path.is_file():
        raise InvalidInputError(f"{flag}: there is no file {path}{_neighbour(path)}")


def check_folder(flag: str, path: Path | None) -> None:
    """Accepts a folder, or none."""
    if path is not None and path.is_file():
        raise InvalidInputError(f"{flag} must be a folder, and {path} is a file")
    if path is not None and not path.is_dir():
        raise InvalidInputError(f"{flag}: there is no folder {path}{_neighbour(path)}")


def check_out(out: Path, is_file: bool) -> None:
    """Accepts a place for results that is there or can be made, before the work of hours is lost there.

    Args:
        out: What `--out` names.
        is_file: Whether that is a file, not a folder.
    """
    if is_file and out.is_dir():
        raise InvalidInputError(f"--out must be a file, and {out} is a folder")
    nearest = out
    while not os.path.lexists(nearest) and nearest != nearest.parent:
        nearest = nearest.parent
    if not nearest.is_dir() and not (is_file and nearest == out):
        beyond = "" if nearest == out else f", so that {out} cannot be made"
        raise InvalidInputError(f"{nearest} is a file{beyond}; choose another --out")
    if not os.access(nearest, os.W_OK):
        raise InvalidInputError(f"cannot write to {nearest}: it may only be read; choose another --out")


def check_policy(
    flag: str, name_or_file: str | Path, env_id: str | None = None, on_robot: bool = False
) -> None:
    """Accepts the name of a policy that can act in a task, or an existing file.

    Args:
        flag: Where it was typed.
        name_or_file: What was typed.
        env_id: The task; None accepts any.
        on_robot: Whether there is no simulator that could tell it the truth.
    """
    try:
        found = find_policy(name_or_file, env_id)
    except PolicyError as error:
        raise InvalidInputError(f"{flag}: {error}") from error
    if on_robot and found in PRIVILEGED:
        raise InvalidInputError(
            f"{flag}: {found} knows what no camera could tell; it runs in simulation only"
        )


def check_policies(flag: str, text: str) -> None:
    """Accepts names and files of policies with commas between them; LABEL=FILE is a file."""
    parts = [part.strip() for part in text.split(",") if part.strip()]
    if not parts:
        raise InvalidInputError(f"{flag} must name one policy or more, with commas between them")
    for part in parts:
        check_policy(flag, part.rpartition("=")[2])


def check_place(flag: str, place: str) -> None:
    """Accepts FOLDER, FOLDER:SPLIT, and a kind of plant in the folder's place."""
    from maniskill_tomato.plants.kinds import KINDS

    folder = place.rpartition(":")[0] or place
    if folder not in KINDS and not Path(place).is_dir():
        check_folder(flag, Path(folder))


def check_segmenter(flag: str, text: str) -> None:
    """Accepts the name of a segmenter of image files, or an existing file of weights."""
    from maniskill_tomato.segmentation.segmenter import SEGMENTERS, segmenter_choices

    if text == "ground_truth":
        raise InvalidInputError(f"{flag}: ground_truth knows rendered views only, no image files")
    if Path(text).is_file() or SEGMENTERS.has(text):
        return
    if Path(text).suffix:
        raise InvalidInputError(f"{flag}: no weights at {text}{_neighbour(Path(text))}")
    check_choice(flag, text, segmenter_choices())


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
