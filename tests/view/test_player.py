"""What the controls do, with a session that counts."""

import numpy as np
import pytest

from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.plants.generator import generate_plant
from maniskill_tomato.view.episode_recording import EpisodeRecording, Float64, HandView, Snapshot
from maniskill_tomato.view.play_settings import SHIPPED, PlaySettings
from maniskill_tomato.view.player import Player

LENGTH = 3


class CountingSession:
    """An episode of `LENGTH` moves."""

    def __init__(self, settings: PlaySettings) -> None:
        if settings.policy == "broken":
            raise InvalidInputError("this policy is broken")
        self.settings = settings
        self.begin(settings.seed)

    def begin(self, seed: int) -> None:
        self.recording = EpisodeRecording(
            title=f"seed {seed}",
            plant=generate_plant("one_tomato"),
            T_w_plant=np.eye(4),
            threshold=0.8,
            fov_y=0.7,
            snapshots=[snapshot(0.0)],
        )

    @property
    def is_over(self) -> bool:
        return self.recording.moves >= LENGTH

    def look_from(self, position: Float64) -> HandView | None:
        return None

    def step(self) -> bool:
        if self.is_over:
            return False
        self.recording.snapshots.append(snapshot(0.1 * len(self.recording.snapshots)))
        return True


def snapshot(fraction: float) -> Snapshot:
    return Snapshot(
        joint_positions=np.zeros(7),
        T_w_camera=np.eye(4),
        target_position=np.zeros(3),
        visible_fraction=fraction,
        picture=np.zeros((4, 4, 3), np.uint8),
    )


@pytest.fixture
def player() -> Player:
    return Player(CountingSession, PlaySettings())


def test_a_step_makes_a_move_and_shows_it_until_the_episode_ends(player: Player) -> None:
    for expected in (1, 2, 3, 3):
        player.step()
        assert player.shown == player.recording.moves == expected
    assert player.is_at_end


def test_going_back_makes_no_moves_and_a_step_from_there_shows_the_recorded_one(player: Player) -> None:
    player.step()
    player.step()
    player.show(0)
    assert (player.shown, player.recording.moves) == (0, 2)
    player.step()
    assert (player.shown, player.recording.moves) == (1, 2)
    player.show(99)
    assert player.shown == 2
    player.show(-1)
    assert player.shown == 0


def test_playing_ends_with_the_episode_and_begins_again_from_its_first_view(player: Player) -> None:
    player.play()
    for _ in range(LENGTH):
        assert player.is_playing
        player.step()
    assert not player.is_playing and player.shown == LENGTH
    player.play()
    assert player.is_playing and player.shown == 0 and player.recording.moves == LENGTH


def test_going_back_and_pausing_stop_the_playing(player: Player) -> None:
    player.play()
    player.pause()
    assert not player.is_playing
    player.play()
    player.step()
    player.show(0)
    assert not player.is_playing


def test_reset_and_another_seed_begin_anew(player: Player) -> None:
    player.step()
    player.change(seed=7)
    assert (player.shown, player.recording.moves, player.recording.title) == (0, 0, "seed 7")
    player.step()
    player.reset()
    assert (player.shown, player.recording.moves, player.settings.seed) == (0, 0, 7)


def test_another_task_takes_the_policy_that_ships_for_it() -> None:
    player = Player(CountingSession, PlaySettings(policy="nbv"))
    player.change(env_id="TomatoViewpointGuided-v1")
    assert player.settings.policy == SHIPPED
    player.change(policy="random")
    player.change(seed=1)
    assert player.settings.policy == "random"


def test_settings_that_cannot_be_opened_leave_the_episode_as_it_was(player: Player) -> None:
    player.step()
    before = player.recording
    with pytest.raises(InvalidInputError, match="broken"):
        player.change(policy="broken")
    assert player.recording is before and player.shown == 1 and player.settings.policy == SHIPPED


def test_an_episode_that_happened_elsewhere_is_only_looked_at() -> None:
    session = CountingSession(PlaySettings())
    while session.step():
        pass
    player = Player.of(session.recording)
    assert player.is_stored and player.shown == 0
    for expected in (1, 2, 3, 3):
        player.step()
        assert player.shown == expected
    assert player.is_at_end and player.recording.moves == LENGTH


def test_a_run_that_goes_on_is_followed_unless_somebody_went_back() -> None:
    session = CountingSession(PlaySettings())
    player = Player.of(session.recording)
    session.step()
    player.follow()
    assert player.shown == 1
    player.show(0)
    session.step()
    player.follow()
    assert player.shown == 0
    player.show(2)
    session.step()
    player.follow()
    assert player.shown == 3
