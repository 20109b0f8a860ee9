"""A run on an arm, or on its twin, shown in a browser while it goes on."""

import logging
from types import TracebackType

from maniskill_tomato.deploy.drivers import arm_model
from maniskill_tomato.deploy.profile import Profile
from maniskill_tomato.deploy.run_records import Step
from maniskill_tomato.robot.iiwa14 import IIWA14
from maniskill_tomato.view.page import PlayPage
from maniskill_tomato.view.player import Player
from maniskill_tomato.view.run_recording import RunRecorder

logger = logging.getLogger(__name__)


class LiveView:
    """A recorder of `deploy` runs with a page; a context manager that ends the page.

    The page can only look: nothing on it reaches the arm. What fails here is logged and never ends a run.
    """

    def __init__(self, profile: Profile, port: int) -> None:
        """Serves the page, on this machine alone, before the first look.

        Args:
            profile: Of the run.
            port: 0 takes a free one.

        Raises:
            InvalidInputError: The port is taken.
        """
        # A twin's profile names its arm; the drivers of real arms are those of the iiwa 14.
        model = arm_model(str(profile.arm_options.get("model", IIWA14.name)))
        self._recorder = RunRecorder(f"live: {profile.name}", threshold=profile.loop.threshold, model=model)
        self.player = Player.of(self._recorder.recording)
        """What is shown."""
        self._page = PlayPage(self.player, port=port)

    @property
    def url(self) -> str:
        """Where a browser finds the page."""
        return self._page.url

    def step(self, step: Step) -> None:
        """Shows a look; see `deploy.run_records.Recorder`."""
        try:
            self._recorder.step(step)
            self._page.ask(self.player.follow)
        except Exception:  # Whatever fails on a page, it must not end a run that moves an arm.
            logger.exception("a look could not be shown; the run goes on")

    def event(self, stamp: float, text: str) -> None:
        """Lines of the log are not shown."""

    def __enter__(self) -> "LiveView":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._page.close()
