"""Stored episodes seen again: they are those that were run, and all policies stand beside each other."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from maniskill_tomato.cli import main
from maniskill_tomato.errors import InvalidInputError
from maniskill_tomato.experiments.episode_record import EpisodeRecord
from maniskill_tomato.experiments.result_store import ABOUT
from maniskill_tomato.view.page_plot import curves
from maniskill_tomato.view.page_record import failure_beside, ways_side_by_side
from maniskill_tomato.view.play_session import PlaySession
from maniskill_tomato.view.play_settings import PlaySettings
from maniskill_tomato.view.player import Player
from maniskill_tomato.view.record_kinds import EpisodeFolder, RunFile, find_record
from maniskill_tomato.view.record_session import RecordSession

Stored = dict[str, list[EpisodeRecord]]


@pytest.fixture(scope="module")
def session(record_folder: Path) -> RecordSession:
    return RecordSession(record_folder)


def test_the_first_failure_is_shown_with_the_ways_of_all_policies(
    session: RecordSession, stored: Stored
) -> None:
    assert all(e.success for e in stored["nbv"]) and not any(e.success for e in stored["random_step"])
    assert session.policy == "random_step" and session.seed == session.failures("random_step")[0]
    assert session.recording.outcome.startswith("failed after ")
    assert [way.label for way in session.recording.ways] == ["nbv", "random_step"]
    assert [way.is_solved for way in session.recording.ways] == [True, False]
    assert len({way.colour for way in session.recording.ways}) == 2
    for way in session.recording.ways:
        record = next(e for e in stored[way.label] if e.seed == session.seed)
        np.testing.assert_allclose(way.recording.visible_fractions, record.visible_fraction, atol=1e-5)
        assert record.camera is not None
        places = [s.T_w_camera[:3, 3] for s in way.recording.snapshots]
        np.testing.assert_allclose(places, record.camera, atol=1e-4)
        assert [s.was_refused for s in way.recording.snapshots[1:]] == record.refused.tolist()


def test_a_stored_view_has_the_picture_of_an_episode_that_is_played(session: RecordSession) -> None:
    session.choose(policy="nbv", seed=1)
    played = PlaySession(PlaySettings(policy="nbv", seed=1))
    while played.step():
        pass
    assert session.recording.moves == played.recording.moves > 0
    for k in (0, session.recording.moves):
        then, now = (r.picture(k).astype(int) for r in (session.recording, played.recording))
        # Joints are stored to 10 urad.
        assert np.mean(np.abs(then - now)) < 1.0
    assert session.recording.snapshots[-1].event == played.recording.snapshots[-1].event


def test_whoever_was_done_first_waits_at_the_end_of_its_way(session: RecordSession) -> None:
    session.choose(policy="nbv", seed=0)
    recording = session.recording
    other = next(way.recording for way in recording.ways if way.label == "random_step")
    assert recording.moves < other.moves == recording.length
    player = Player.over(session)
    player.show(99)
    assert player.shown == other.moves and player.is_at_end
    assert recording.at(player.shown) is recording.snapshots[-1]
    lines = {str(series.get("label")): values for series, values in curves(recording)}
    assert len(lines["nbv"]) == recording.moves + 1 and len(lines["random_step"]) == other.moves + 1


@pytest.mark.parametrize(
    ("shown", "which", "seed"),
    [
        (4, "next", 9),
        (9, "next", 2),
        (2, "next", 4),
        (4, "previous", 2),
        (9, "previous", 4),
        (2, "previous", 9),
        (7, "next", 4),
        (7, "previous", 2),
    ],
)
def test_failures_are_gone_through_in_a_circle_either_way(shown: int, which: str, seed: int) -> None:
    assert failure_beside([4, 9, 2], shown, which) == seed
    assert failure_beside([], shown, which) is None


def test_what_all_cameras_see_stands_side_by_side_with_how_it_ended(session: RecordSession) -> None:
    session.choose(policy="random_step", seed=0)
    page = ways_side_by_side(session.recording, 20)
    assert page.count("<img ") == 2
    assert "<b>nbv</b>, move " in page and "<b>random_step</b>, move " in page
    assert "solved after" in page and "failed after" in page
    assert "solved after" not in ways_side_by_side(session.recording, 0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": 7}, "holds no episode 7 of nbv; it has 0 to 1"),
        ({"policy": "nvb"}, "did you mean 'nbv'"),
        ({"condition": "plants"}, "must be one of"),
    ],
)
def test_what_a_record_does_not_hold_is_refused_and_the_shown_episode_stays(
    record_folder: Path, change: dict[str, object], message: str
) -> None:
    session = RecordSession(record_folder)
    session.choose(policy="nbv", seed=1)
    before = session.recording
    with pytest.raises(InvalidInputError, match=message):
        session.choose(**change)  # type: ignore[arg-type]
    assert session.recording is before and (session.policy, session.seed) == ("nbv", 1)


def test_an_episode_whose_plant_is_another_one_now_is_refused(record_folder: Path, tmp_path: Path) -> None:
    folder = tmp_path / "record"
    shutil.copytree(record_folder, folder)
    (path,) = folder.glob("results/*/random_step.jsonl")
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    for line in lines:
        line["result"]["visible_fraction"][0] += 0.1
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    with pytest.raises(InvalidInputError, match=r"another one in this version .*run the episodes again"):
        RecordSession(folder)


def test_no_plants_are_imported_because_a_record_names_them(record_folder: Path, tmp_path: Path) -> None:
    folder = tmp_path / "record"
    shutil.copytree(record_folder, folder)
    (path,) = folder.glob(f"results/*/{ABOUT}")
    about = json.loads(path.read_text())
    about["env_options"] = {"plant": "json:loads"}
    path.write_text(json.dumps(about))
    with pytest.raises(
        InvalidInputError, match=r"record names the plant generator json:loads, .* give it an entry"
    ):
        RecordSession(folder)


def test_a_record_is_told_by_what_it_holds(record_folder: Path, tmp_path: Path) -> None:
    assert find_record(record_folder) == EpisodeFolder(folder=record_folder)
    training = tmp_path / "training"
    shutil.copytree(record_folder, training / "eval")
    (training / "policy.pt").touch()
    assert find_record(training / "policy.pt") == EpisodeFolder(folder=training / "eval")
    run = tmp_path / "deploy"
    run.mkdir()
    (run / "run.mcap").touch()
    assert find_record(run) == find_record(run / "run.mcap") == RunFile(path=run / "run.mcap")
    with pytest.raises(InvalidInputError, match="there is no file or folder"):
        find_record(tmp_path / "nothing")
    with pytest.raises(InvalidInputError, match="holds no record"):
        find_record(tmp_path)
    old = tmp_path / "old"
    old.mkdir()
    (old / "trajectories.npz").touch()
    with pytest.raises(InvalidInputError, match="give its command again"):
        find_record(old)


def test_a_failure_of_a_record_is_exported(
    record_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "page.html"
    main(["play", "--record", str(record_folder), "--seed", "1", "--export", str(path)])
    told = capsys.readouterr().out
    assert "benchmark, TomatoViewpoint-v1, episode 1, random_step: failed after" in told
    assert 100_000 < path.stat().st_size < 4_000_000


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["TomatoViewpointRow-v1"], "leave out ENV_ID"),
        (["--perception", "occlusion_model"], "leave out --perception"),
        (["--policy", "nvb"], "did you mean 'nbv'"),
    ],
)
def test_options_that_a_record_leaves_no_choice_of_are_refused(
    record_folder: Path, arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["play", "--record", str(record_folder), *arguments, "--port", "0"])
    assert ended.value.code == 2 and message in capsys.readouterr().err


def test_a_record_in_place_of_a_task_is_answered_with_the_option(
    record_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main(["play", str(record_folder)])
    assert f"give --record {record_folder}" in capsys.readouterr().err
