"""The folder of a run: what it holds, and its newest checkpoint that is whole."""

import logging
import shutil
from pathlib import Path
from typing import Any

import maniskill_tomato
from maniskill_tomato.errors import CheckpointError, InvalidInputError
from maniskill_tomato.files import write_json
from maniskill_tomato.folder_lock import only_writer
from maniskill_tomato.learning.rl.presets import MAY_CHANGE, TrainConfig
from maniskill_tomato.policies.trained_actor import load_checkpoint

logger = logging.getLogger(__name__)

RUN_STATE_FORMAT = 3
"""Version of the layout of a checkpoint's `run` entry."""

LOG_NAME = "train.log"
"""What a run in a process of its own says."""

_FILES = ("config.json", "episodes.csv", "history.npz", "policy.pt", "wandb.json")
_PATTERNS = (
    "checkpoints/step_*.pt",
    "checkpoints/damaged_step_*.pt",
    "tensorboard/events.out.tfevents.*",
    ".*.tmp",
    "checkpoints/.*.tmp",
)


def check_run_dir(run_dir: Path) -> None:
    """Accepts a folder for a new run.

    Raises:
        InvalidInputError: It already holds a run, or is a file.
    """
    if run_dir.exists() and not run_dir.is_dir():
        raise InvalidInputError(f"{run_dir} is a file; choose another --out")
    if (run_dir / "config.json").exists():
        raise InvalidInputError(
            f"{run_dir} already holds a run; continue it with --resume {run_dir}, choose another --out "
            "or pass --overwrite"
        )


def clear_run(run_dir: Path) -> None:
    """Removes what an earlier run wrote into `run_dir`, and nothing else.

    Raises:
        CheckpointError: That run is still going on.
    """
    if not (run_dir / "config.json").is_file():
        return
    with only_writer(run_dir, "trains"):
        remove_results(run_dir)
        (run_dir / LOG_NAME).unlink(missing_ok=True)


def remove_results(run_dir: Path) -> None:
    """Removes everything that a run wrote but its log; the caller is the folder's only writer."""
    for name in _FILES:
        (run_dir / name).unlink(missing_ok=True)
    for pattern in _PATTERNS:
        for path in run_dir.glob(pattern):
            path.unlink()
    shutil.rmtree(run_dir / "wandb", ignore_errors=True)


def write_config(
    run_dir: Path, env_id: str, seed: int, env_options: dict[str, Any], config: dict[str, Any]
) -> None:
    """Writes `config.json`, from which `--config` repeats the run and `--resume` continues it."""
    content = {
        "env_id": env_id,
        "seed": seed,
        "package_version": maniskill_tomato.__version__,
        "env_options": env_options,
        "config": config,
    }
    write_json(run_dir / "config.json", content)


def checkpoint_path(run_dir: Path, step: int) -> Path:
    """The file of the checkpoint after `step` environment steps."""
    return run_dir / "checkpoints" / f"step_{step:09d}.pt"


def checkpoints(run_dir: Path) -> list[Path]:
    """The checkpoints of a run, the oldest first."""
    return sorted((run_dir / "checkpoints").glob("step_*.pt"))


def newest_good_checkpoint(
    run_dir: Path, env_id: str, seed: int, config: dict[str, Any]
) -> dict[str, Any] | None:
    """The checkpoint from which a run goes on; None if it was stopped before it wrote one.

    Damaged files are passed over with a warning and renamed to `damaged_step_*.pt`, so that they are not in
    the way of the continued run's own.

    Raises:
        CheckpointError: All checkpoints are damaged, or the newest whole one was written for another task,
            seed or configuration, by another version, or without a run's state.
    """
    for leftover in (*run_dir.glob(".*.tmp"), *run_dir.glob("checkpoints/.*.tmp")):
        leftover.unlink(missing_ok=True)
    paths = checkpoints(run_dir)
    damaged: list[Path] = []
    data: dict[str, Any] | None = None
    path = run_dir
    for path in reversed(paths):
        try:
            data = load_checkpoint(path)
            break
        except CheckpointError as error:
            if error.newer_format:
                raise
            logger.warning("%s; going back to the one before", error)
            damaged.append(path)
    if data is None and damaged:
        raise CheckpointError(
            f"all {len(damaged)} checkpoints in {run_dir / 'checkpoints'} are damaged; "
            "train again with --overwrite"
        )
    if data is not None:
        _check_origin(path, data, env_id, seed, config)
    for bad in damaged:
        bad.replace(bad.with_name(f"damaged_{bad.name}"))
    return data


def _check_origin(path: Path, data: dict[str, Any], env_id: str, seed: int, config: dict[str, Any]) -> None:
    if data["env_id"] != env_id:
        raise CheckpointError(
            f"{path} was written by a run on {data['env_id']}, not on {env_id}; put back the checkpoints of "
            "this run"
        )
    run = data.get("run")
    if not isinstance(run, dict) or run.get("format") != RUN_STATE_FORMAT:
        raise CheckpointError(
            f"{path} was written by version {data['package_version']} without what continuing needs "
            f"(run state {RUN_STATE_FORMAT}); its policy can be used, but the training must begin again "
            "(--overwrite)"
        )
    if data["package_version"] != maniskill_tomato.__version__:
        raise CheckpointError(
            f"{path} was written by version {data['package_version']}, and this is "
            f"{maniskill_tomato.__version__}, which may not continue it exactly; install that version, or train "
            "again with --overwrite"
        )
    if data["counters"].get("seed") != seed:
        raise CheckpointError(
            f"{path} was written by a run with seed {data['counters'].get('seed')}, not {seed}"
        )
    begun = TrainConfig.from_dict(data["config"]).to_dict()
    stored = {k: v for k, v in begun.items() if k not in MAY_CHANGE}
    present = {k: v for k, v in config.items() if k not in MAY_CHANGE}
    changed = sorted(k for k in stored.keys() | present.keys() if stored.get(k) != present.get(k))
    if changed:
        listed = ", ".join(f"{k} ({stored.get(k)!r}, now {present.get(k)!r})" for k in changed)
        raise CheckpointError(
            f"{path} was written with other options: {listed}; a continued run may change "
            f"{', '.join(MAY_CHANGE)} only"
        )
