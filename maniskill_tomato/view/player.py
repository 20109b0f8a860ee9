"""What the controls of a page do: play, step, go back, another episode; it knows nothing of any page."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final, Protocol, cast

from maniskill_tomato.view.episode_recording import EpisodeRecording, Float64, HandView
from maniskill_tomato.view.play_settings import SHIPPED, PlaySettings

NO_DRAG: Final = (
    "the target can be dragged where exact labels name it; a camera chooses its target among what it sees: take the "
    "senses ground_truth"
)
"""Why a target stays where it is."""


class Session(Protocol):
    """Where a player gets its episode from."""

    settings: PlaySettings
    """Which."""

    @property
    def recording(self) -> EpisodeRecording:
        """The episode so far."""
        ...

    @property
    def is_over(self) -> bool:
        """Whether it has ended."""
        ...

    def begin(self, seed: int) -> None:
        """Begins another episode."""
        ...

    def step(self) -> bool:
        """Makes a move; whether there was one to make."""
        ...

    def look_from(self, position: Float64) -> HandView | None:
        """What a camera at a place would see of the target; None if that is not known. Shape (3,), in [m]."""
        ...


class PlayedSession(Session, Protocol):
    """One that makes the moves itself, on a plant that can be altered."""

    def target_place(self) -> Float64 | None:
        """Where the target is, in the world frame, in [m]; None where it cannot be moved. Shape (3,)."""
        ...

    def move_target(self, position: Float64) -> None:
        """Hangs the target elsewhere and sees the last view again. Shape (3,), in [m]."""
        ...

    def decide_again(self) -> None:
        """Lets the policy decide on the last view as it is now."""
        ...

    def move_camera(self, position: Float64) -> None:
        """Makes a move of a person: to a place, or a part of the way there. Shape (3,), in [m]."""
        ...

    @property
    def demonstrated(self) -> str | None:
        """What becomes of the episode as a demonstration, in words; None where nothing is kept."""
        ...


class StoredSession:
    """An episode that happened elsewhere: all that can be done is to look at it."""

    is_over = True

    def __init__(self, recording: EpisodeRecording) -> None:
        """Keeps the recording; snapshots that come later are shown too."""
        self.settings = PlaySettings()
        self.recording = recording

    def begin(self, seed: int) -> None:
        """Nothing: it has happened."""

    def step(self) -> bool:
        """There is never a move to make."""
        return False

    def look_from(self, position: Float64) -> HandView | None:
        """There is no plant to look at."""
        return None


class Player:
    """Shows one snapshot of the episode of a session, and goes on from the last one."""

    def __init__(self, open_session: Callable[[PlaySettings], Session], settings: PlaySettings) -> None:
        """Opens the first episode.

        Args:
            open_session: Makes a session; it may raise a `TomatoError`.
            settings: Of the first.
        """
        self.is_stored = False
        """Whether the episode happened elsewhere, so that no other can be chosen."""
        self._open = open_session
        self._session = open_session(settings)
        self.settings = settings
        """Of the episode that is shown."""
        self.shown = 0
        """Which snapshot is shown."""
        self.is_playing = False
        """Whether moves follow each other by themselves."""

    @classmethod
    def of(cls, recording: EpisodeRecording) -> "Player":
        """Shows an episode that happened elsewhere."""
        return cls.over(StoredSession(recording))

    @classmethod
    def over(cls, session: Session) -> "Player":
        """Shows the episodes of a session that makes no moves."""
        player = cls(lambda _: session, PlaySettings())
        player.is_stored = True
        return player

    @property
    def recording(self) -> EpisodeRecording:
        """The episode so far."""
        return self._session.recording

    def look_from(self, position: Float64) -> HandView | None:
        """What a camera elsewhere would see of the present target; see `HandView`. Shape (3,), in [m]."""
        return self._session.look_from(position)

    def target_place(self) -> Float64 | None:
        """Where the target is; None where it cannot be moved. Shape (3,), in [m]."""
        session = self._session
        return None if self.is_stored else cast(PlayedSession, session).target_place()

    def move_target(self, position: Float64) -> None:
        """Hangs the target elsewhere and shows the last view as it is now. Shape (3,), in [m]."""
        if not self.is_stored:
            self.show(self.recording.moves)
            cast(PlayedSession, self._session).move_target(position)

    def drop_target(self) -> None:
        """Lets the policy decide on where the target was left."""
        if not self.is_stored:
            cast(PlayedSession, self._session).decide_again()

    def move_camera(self, position: Float64) -> None:
        """Makes a move of a person from the last view, and shows where it led. Shape (3,), in [m].

        Raises:
            InvalidInputError: The episode is over, or no move leads there.
            NotWrittenError: A demonstration that the move completes cannot be saved.
        """
        if not self.is_stored:
            self.show(self.recording.moves)
            try:
                cast(PlayedSession, self._session).move_camera(position)
            finally:
                self.shown = self.recording.moves

    @property
    def demonstrated(self) -> str | None:
        """What becomes of the episode as a demonstration, in words; None where nothing is kept."""
        return None if self.is_stored else cast(PlayedSession, self._session).demonstrated

    @property
    def is_at_end(self) -> bool:
        """Whether no move is left to show or to make."""
        return self.shown >= self.recording.length and self._session.is_over

    def step(self) -> None:
        """Shows the next snapshot, and makes a move where there is none yet."""
        if self.shown < self.recording.length or self._session.step():
            self.shown += 1
        if self.is_at_end:
            self.is_playing = False

    def play(self) -> None:
        """Lets moves follow each other; from the first view where the end is shown."""
        if self.is_at_end:
            self.shown = 0
        self.is_playing = True

    def pause(self) -> None:
        """Stops after the present move."""
        self.is_playing = False

    def show(self, index: int) -> None:
        """Shows a snapshot that was recorded; the nearest where there is none of this number."""
        self.is_playing = False
        self.shown = min(max(index, 0), self.recording.length)

    def follow(self) -> None:
        """Shows the last snapshot if the one before it, or a later one, was shown: whoever went back stays there."""
        last = self.recording.moves
        if self.shown >= last - 1:
            self.shown = max(last, 0)

    def reset(self) -> None:
        """Begins the same episode again."""
        self.change(seed=self.settings.seed)

    def change(self, **changes: Any) -> None:
        """Begins the episode of other settings.

        Args:
            changes: Fields of `PlaySettings`. With another task the policy is the one that ships for it, unless it is
                given too.

        Raises:
            TomatoError: It cannot be opened; the episode that was shown stays.
        """
        if changes.get("env_id", self.settings.env_id) != self.settings.env_id:
            changes.setdefault("policy", SHIPPED)
        settings = replace(self.settings, **changes)
        if set(changes) == {"seed"}:
            self._session.begin(settings.seed)
            self._session.settings = settings
        else:
            self._session = self._open(settings)
        self.settings = settings
        self.shown, self.is_playing = 0, False
