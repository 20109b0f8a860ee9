"""`maniskill-tomato play`: an episode in a browser, or as one HTML file."""

import signal
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import tyro

from maniskill_tomato.cli.arguments import Flat
from maniskill_tomato.cli.early_checks import check_choice, check_env_id, check_file, check_policy
from maniskill_tomato.cli.shared_options import PlantOptions, camera_options, say
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.episode_list import EPISODE_LISTS
from maniskill_tomato.policies.opening import shipped_policy
from maniskill_tomato.tasks import TASK_IDS
from maniskill_tomato.view.page_address import check_port
from maniskill_tomato.view.play_settings import LISTED_ID, PERCEPTIONS, SHIPPED, PlaySettings

if TYPE_CHECKING:
    from maniskill_tomato.view.player import Player

RECORDING: Final = "run.mcap"
"""What `deploy run` writes into its folder."""


@dataclass(frozen=True, kw_only=True)
class Play:
    """Watch a policy look for tomatoes, in a browser: the plant, the arm, what its camera sees and what it believes.

    The page is for this machine alone unless --host says otherwise; it has no password. Over SSH, forward the port:
    ssh -L 8080:localhost:8080 MACHINE."""

    env_id: Annotated[
        str,
        tyro.conf.Positional,
        tyro.conf.arg(
            metavar="ENV_ID",
            help=f"The task: {', '.join(TASK_IDS)}. Or a recording of `deploy run`: run.mcap or its folder.",
        ),
    ] = LISTED_ID
    policy: str | None = None
    """File of the policy (.pt, or .onnx from `export`), or `random`, or for the general tasks a planner's name; by
    default the one that ships with the package."""
    seed: int = 0
    """Seed of the episode; its number in the list where the task has one."""
    plants: Annotated[PlantOptions, Flat] = PlantOptions()
    """Another plant."""
    episode_list: str | None = None
    """Episodes of a fixed list, TomatoViewpoint-v1 only: validation, held_out, or a file; by default held_out, unless
    options of the plants are given."""
    perception: str = "ground_truth"
    """What V_f and the target's position come from: ground_truth, occlusion_model or simulated_segmenter."""
    target: str | None = None
    """How the target is named to a robot that sees through a camera: track (the default), map or any;
    TomatoViewpoint-v1 only."""
    host: str = "127.0.0.1"
    """Address to listen at. 0.0.0.0 lets every machine that reaches this one steer the page."""
    port: int = 8080
    """Port of the page; 0 takes a free one."""
    export: Path | None = None
    """Write the whole episode to this HTML file instead, which needs no server."""

    def run(self) -> None:
        """Serves the page until it is stopped, or writes the file."""
        self._check_export()
        run = _run_file(self.env_id)
        settings = None if run is not None else self._settings()
        if self.export is None:
            check_port(self.host, self.port)

        from maniskill_tomato.view.player import Player

        if run is not None:
            from maniskill_tomato.view.run_recording import read_run

            player = Player.of(read_run(run))
        else:
            from maniskill_tomato.view.play_session import PlaySession

            assert settings is not None
            player = Player(PlaySession, settings)
        if self.export is not None:
            _export(player, self.export)
            return

        from maniskill_tomato.view.page import PlayPage

        stop = threading.Event()
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: stop.set())
        page = PlayPage(player, self.host, self.port)
        try:
            say(f"page    {page.url} (Ctrl-C ends it)")
            stop.wait()
        finally:
            page.close()

    def _check_export(self) -> None:
        if self.export is not None and self.export.suffix.lower() not in (".html", ".htm"):
            raise InvalidInputError(f"--export must name an .html file, got {self.export}")

    def _settings(self) -> PlaySettings:
        """What to play.

        Raises:
            InvalidInputError: An option cannot be used.
        """
        check_env_id(self.env_id)
        check_policy("--policy", self.policy or shipped_policy(self.env_id), self.env_id)
        if self.episode_list is not None:
            if self.env_id != LISTED_ID:
                raise InvalidInputError(
                    f"--episode-list is for {LISTED_ID}; {self.env_id} draws from its seed"
                )
            if not Path(self.episode_list).is_file():
                check_choice("--episode-list", self.episode_list, (*EPISODE_LISTS, "FILE.json"))
        check_choice("--perception", self.perception, PERCEPTIONS)
        camera_options(self.env_id, self.perception, self.target, None)
        return PlaySettings(
            env_id=self.env_id,
            policy=self.policy or SHIPPED,
            seed=self.seed,
            perception=self.perception,
            target=self.target,
            plant_options=self.plants.env_options(),
            episode_list=self.episode_list,
        )


def _run_file(what: str) -> Path | None:
    """The recording of a run that the first argument names, if it names one.

    Raises:
        InvalidInputError: It looks like one and is not there.
    """
    path = Path(what)
    if path.suffix.lower() == ".mcap":
        check_file("RUN.mcap", path)
        return path
    inside = path / RECORDING
    return inside if inside.is_file() else None


def _export(player: "Player", path: Path) -> None:
    """Makes and shows every move in a file."""
    from maniskill_tomato.view.page_export import export_page

    while not player.is_at_end:
        player.step()
    size = export_page(player.recording, path)
    print(f"{player.recording.title}: {player.recording.outcome}")
    print(f"page    {path} ({size / 1e6:.1f} MB)")
