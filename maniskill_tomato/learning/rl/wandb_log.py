"""Weights & Biases, optional: a second place for the scalars that TensorBoard gets."""

import contextlib
import importlib
import json
import secrets
from pathlib import Path
from typing import Any

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.files import write_atomically

ID_FILE = "wandb.json"
"""Keeps the run's id in the run folder, so that a continued run goes on with the same curves."""


def import_wandb(project: str) -> Any:
    """The package `wandb`, which takes a second to import and need not be there.

    Raises:
        InvalidInputError: It is not installed, or `project` is empty.
    """
    if not project.strip():
        raise InvalidInputError("wandb_project must be the name of a project, got an empty one")
    wandb: Any = None
    with contextlib.suppress(ImportError):
        wandb = importlib.import_module("wandb")
    # A folder called wandb, such as the package makes itself, can be imported too, as an empty module.
    if not hasattr(wandb, "init"):
        raise InvalidInputError(
            f"wandb_project={project!r} needs the package wandb: pip install 'maniskill-tomato[wandb]', or train "
            "without it; TensorBoard's files are written in any case"
        )
    return wandb


class WandbWriter:
    """Takes scalars as TensorBoard's SummaryWriter does and sends those of one step together."""

    def __init__(self, project: str, run_dir: Path) -> None:
        """Begins the run, or goes on with the one that the folder names.

        Args:
            project: Name of the project.
            run_dir: Folder of the run, whose `config.json` is sent along; the package's own files go into its
                folder `wandb`.

        Raises:
            InvalidInputError: The package is not installed or cannot begin a run.
        """
        wandb = import_wandb(project)
        path = run_dir / ID_FILE
        run_id = json.loads(path.read_text())["id"] if path.is_file() else secrets.token_hex(4)
        try:
            self._run = wandb.init(
                project=project,
                dir=str(run_dir),
                id=run_id,
                name="/".join(run_dir.absolute().parts[-2:]),
                config=json.loads((run_dir / "config.json").read_text()),
                resume="allow",
                settings=wandb.Settings(console="off"),  # The progress bar is none of its business.
            )
        except Exception as error:  # Its exceptions have no common base.
            reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
            raise InvalidInputError(
                f"Weights & Biases could not begin a run of project {project!r} ({reason}): log in with `wandb login`, "
                "or set WANDB_MODE=offline and send the curves later with `wandb sync`; then go on with "
                f"--resume {run_dir}"
            ) from error
        write_atomically(path, (json.dumps({"project": project, "id": run_id}) + "\n").encode())
        self._step = 0
        self._row: dict[str, float] = {}

    def add_scalar(self, name: str, value: float, step: int) -> None:
        """Adds a value of an environment step; steps must not fall."""
        if step != self._step:
            self._send()
            self._step = step
        self._row[name] = value

    def _send(self) -> None:
        if self._row:
            self._run.log(self._row, step=self._step)
            self._row = {}

    def close(self, failed: bool = False) -> None:
        """Sends the rest and ends the run, as a failed one if asked."""
        self._send()
        self._run.finish(exit_code=int(failed))
