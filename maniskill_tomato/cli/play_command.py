"""`maniskill-tomato play`: an episode in a browser, or as one HTML file."""

import signal
import threading
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from maniskill_tomato.cli.arguments import Flat
from maniskill_tomato.cli.early_checks import check_choice, check_env_id, check_policy
from maniskill_tomato.cli.shared_options import EnvId, PlantOptions, camera_options, say
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.folder_lock import only_writer
from maniskill_tomato.plants.episode_list import EPISODE_LISTS
from maniskill_tomato.policies.opening import shipped_policy
from maniskill_tomato.task_registry import THESIS_IDS, task_ids
from maniskill_tomato.view.page_address import check_port
from maniskill_tomato.view.play_settings import LISTED_ID, PERCEPTIONS, SHIPPED, PlaySettings
from maniskill_tomato.view.record_kinds import EpisodeFolder, RunFile, find_record

if TYPE_CHECKING:
    from maniskill_tomato.view.player import Player


@dataclass(frozen=True, kw_only=True)
class Play:
    """Watch a policy look for tomatoes, in a browser: the plant, the arm, what its camera sees and what it believes.

    The page is for this machine alone unless --host says otherwise; it has no password. Over SSH, forward the port:
    ssh -L 8080:localhost:8080 MACHINE."""

    env_id: EnvId = LISTED_ID
    """The task."""
    record: Path | None = None
    """What was recorded, in place of a task: the folder of a `benchmark`, an `eval` or a `deploy` run, or its run.mcap.
    Of a benchmark the page shows what each policy made of the same episode, failures first."""
    policy: str | None = None
    """File of the policy (.pt, or .onnx from `export`), or `random`, or for the general tasks a planner's name; by
    default the one that ships with the package. With --record its name there, by default the first that failed."""
    seed: int | None = None
    """Seed of the episode, 0 by default; its number in the list where the task has one. With --record the first failure
    by default."""
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
    demonstrations: Path | None = None
    """Folder that keeps the episodes which you solve by hand on the page (tab Hand), as trajectory.h5 and
    trajectory.json, for `train --reward-from`; it may hold such episodes of the same task and options already.
    TomatoViewpoint-v1 then has the plants of trainings."""
    export: Path | None = None
    """Write the whole episode to this HTML file instead, which needs no server."""

    def run(self) -> None:
        """Serves the page until it is stopped, or writes the file."""
        self._check_export()
        self._check_demonstrations()
        with ExitStack() as held:
            self._run(held)

    def _run(self, held: ExitStack) -> None:
        """Does it; what must be given back at the end is entered in `held`."""
        settings = self._settings() if self.record is None else None
        kind = None if self.record is None else self._kind_of_record(self.record)
        if self.export is None:
            check_port(self.host, self.port)
        shown = None
        if settings is not None and self.demonstrations is not None:
            from maniskill_tomato.view.demonstrating import PersonsDemonstrations

            held.enter_context(only_writer(self.demonstrations, "records", "--demonstrations"))
            shown = PersonsDemonstrations(self.demonstrations, settings)

        from maniskill_tomato.view.player import Player

        record = None
        if settings is not None:
            from maniskill_tomato.view.play_session import PlaySession

            player = Player(lambda chosen: PlaySession(chosen, shown), settings)
        elif isinstance(kind, RunFile):
            from maniskill_tomato.view.run_recording import read_run

            player = Player.of(read_run(kind.path))
        else:
            from maniskill_tomato.view.record_session import RecordSession

            assert kind is not None
            record = RecordSession(kind.folder)
            record.choose(policy=self.policy, seed=self.seed)
            player = Player.over(record)
        if self.export is not None:
            _export(player, self.export)
            return

        from maniskill_tomato.view.page import PlayPage

        stop = threading.Event()
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: stop.set())
        page = PlayPage(player, self.host, self.port, record)
        try:
            say(f"page    {page.url} (Ctrl-C ends it)")
            stop.wait()
        finally:
            page.close()
            if shown is not None:
                say(f"{self.demonstrations}: {shown.episodes} demonstrations, {shown.moves} moves")

    def _check_export(self) -> None:
        if self.export is not None and self.export.suffix.lower() not in (".html", ".htm"):
            raise InvalidInputError(f"--export must name an .html file, got {self.export}")

    def _check_demonstrations(self) -> None:
        if self.demonstrations is None:
            return
        for name, is_given in (("--record", self.record is not None), ("--export", self.export is not None)):
            if is_given:
                raise InvalidInputError(
                    f"--demonstrations keeps what you do on the page of a task; leave out {name}"
                )
        check_env_id(self.env_id, (*THESIS_IDS, LISTED_ID))

    def _kind_of_record(self, record: Path) -> "RunFile | EpisodeFolder":
        """What a record is, by what it holds.

        Raises:
            InvalidInputError: It is none, or an option is for what is played.
        """
        found = find_record(record)
        given = {
            "ENV_ID": self.env_id != LISTED_ID,
            "the options of plants": bool(self.plants.env_options()),
            "--episode-list": self.episode_list is not None,
            "--perception": self.perception != "ground_truth",
            "--target": self.target is not None,
        }
        if isinstance(found, RunFile):
            given |= {"--policy": self.policy is not None, "--seed": self.seed is not None}
        if wrong := [name for name, is_given in given.items() if is_given]:
            raise InvalidInputError(f"--record shows what has happened; leave out {', '.join(wrong)}")
        return found

    def _settings(self) -> PlaySettings:
        """What to play.

        Raises:
            InvalidInputError: An option cannot be used.
        """
        if self.env_id not in task_ids() and Path(self.env_id).exists():
            raise InvalidInputError(
                f"{self.env_id} is no task; to see what it holds, give --record {self.env_id}"
            )
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
            seed=self.seed or 0,
            perception=self.perception,
            target=self.target,
            plant_options=self.plants.env_options(),
            episode_list=self.episode_list,
            is_demonstrated=self.demonstrations is not None,
        )


def _export(player: "Player", path: Path) -> None:
    """Makes and shows every move in a file."""
    from maniskill_tomato.view.page_export import export_page

    while not player.is_at_end:
        player.step()
    size = export_page(player.recording, path)
    print(f"{player.recording.title}: {player.recording.outcome}")
    print(f"page    {path} ({size / 1e6:.1f} MB)")
