"""Runs of `deploy` in the viewer: from their recordings, and live."""

from pathlib import Path

import numpy as np
import pytest

from maniskill_tomato.cli import main
from maniskill_tomato.deploy.deploy_errors import RecordingError
from maniskill_tomato.deploy.policy_run import RunConfig, run
from maniskill_tomato.deploy.profile import load_profile
from maniskill_tomato.deploy.run_records import KeptSteps, RunResult, Step
from maniskill_tomato.view.episode_recording import EpisodeRecording
from maniskill_tomato.view.live_run import LiveView
from maniskill_tomato.view.page_head import headline
from maniskill_tomato.view.page_plot import curves
from maniskill_tomato.view.run_recording import read_run


@pytest.fixture(scope="module")
def kept() -> KeptSteps:
    return KeptSteps()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("deploy")


@pytest.fixture(scope="module")
def live() -> EpisodeRecording:
    return EpisodeRecording(title="", threshold=0.0)


@pytest.fixture(scope="module")
def result(folder: Path, kept: KeptSteps, live: EpisodeRecording) -> RunResult:
    profile = load_profile("mock")
    with LiveView(profile, 0) as view:
        config = RunConfig(profile=profile, out=folder, policy="nbv")
        done = run(config, recorders=[kept, view])
        live.snapshots.extend(view.player.recording.snapshots)
        live.outcome = view.player.recording.outcome
    return done


def test_a_recording_is_read_as_the_looks_of_its_run(
    folder: Path, kept: KeptSteps, result: RunResult
) -> None:
    recording = read_run(folder / "run.mcap")
    assert recording.plant is None and recording.moves == len(kept.steps) - 1 > 0
    measured = [s.measured.value for s in recording.snapshots if s.measured is not None]
    # The result is rounded to four decimals.
    np.testing.assert_allclose(measured, result.visible_fractions, atol=5.1e-5)
    for snapshot, step in zip(recording.snapshots, kept.steps, strict=True):
        np.testing.assert_allclose(snapshot.joint_positions, step.joint_positions)
        np.testing.assert_allclose(snapshot.T_w_camera, step.T_world_camera)
    assert recording.outcome.startswith(f"{result.reason}: {result.detail}")
    assert [s.event.split(":")[0] for s in recording.snapshots[1:]] == [s.outcome for s in kept.steps[:-1]]


def test_a_recording_tells_how_far_off_a_fraction_may_be_and_goes_by_the_lower_edge(
    folder: Path, kept: KeptSteps, result: RunResult, live: EpisodeRecording
) -> None:
    for recording in (read_run(folder / "run.mcap"), live):
        lines = {str(series.get("label")): values for series, values in curves(recording)}
        sure = [step.view.sure_fraction for step in kept.steps]
        np.testing.assert_allclose(recording.visible_fractions, sure, atol=1e-6)
        np.testing.assert_allclose(lines["at least"], sure, atol=1e-6)
        np.testing.assert_allclose(
            lines["V_f"], [step.view.visible_fraction for step in kept.steps], atol=1e-6
        )
        # Of a fruit that was not found nothing is estimated.
        was_found = lines["V_f"] > 0.0
        assert was_found[0] and was_found.sum() >= 3
        assert (lines["at most"] > lines["V_f"])[was_found].all() and lines["at most"].max() <= 1.0
        low, high = lines["at least"][0], lines["at most"][0]
        assert f"from {low:.2f} to {high:.2f}" in headline(recording, 0)


def test_recordings_that_do_not_say_how_sure_a_fraction_was_are_shown_without_a_band() -> None:
    """`deploy run` wrote it before it stored that."""
    recording = read_run(Path(__file__).parents[1] / "deploy" / "data" / "json_recording.mcap")
    assert [s.measured for s in recording.snapshots] == [None] * 3
    np.testing.assert_allclose(recording.visible_fractions, [0.1668, 0.2963, 0.5049], atol=5.1e-5)
    labels = [series.get("label") for series, _ in curves(recording)]
    assert labels == ["V_f", "truly", "full"]


def test_points_lie_where_the_camera_measured_depth(folder: Path, kept: KeptSteps, result: RunResult) -> None:
    snapshot = read_run(folder / "run.mcap").snapshots[-1]
    assert snapshot.points is not None and len(snapshot.points.positions) > 500
    away = np.linalg.norm(snapshot.points.positions - snapshot.target_position, axis=1)
    red, green, _ = snapshot.points.colours[away < 0.04].mean(0)
    assert red > 1.5 * green
    step: Step = kept.steps[-1]
    in_camera = np.linalg.inv(step.T_world_camera)
    depth = snapshot.points.positions @ in_camera[2, :3] + in_camera[2, 3]
    assert 0.05 < depth.min() and depth.max() < 2.01


def test_a_live_run_is_recorded_as_its_file_says(
    folder: Path, result: RunResult, live: EpisodeRecording
) -> None:
    stored = read_run(folder / "run.mcap")
    assert live.outcome == stored.outcome and live.moves == stored.moves
    for now, then in zip(live.snapshots, stored.snapshots, strict=True):
        assert (now.event, now.was_refused) == (then.event, then.was_refused)
        np.testing.assert_array_equal(now.picture, then.picture)


def test_what_fails_in_the_viewer_does_not_end_a_run(caplog: pytest.LogCaptureFixture) -> None:
    with LiveView(load_profile("mock"), 0) as view:
        view.step(None)  # type: ignore[arg-type]
    assert "the run goes on" in caplog.text


def test_the_folder_of_a_run_is_exported(
    folder: Path, result: RunResult, capsys: pytest.CaptureFixture[str]
) -> None:
    page = folder / "page.html"
    main(["play", "--record", str(folder), "--export", str(page)])
    assert result.reason in capsys.readouterr().out
    assert page.stat().st_size < 2_500_000


def test_what_is_no_recording_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "run.mcap"
    with pytest.raises(SystemExit) as ended:
        main(["play", "--record", str(path)])
    assert ended.value.code == 2 and "there is no file or folder" in capsys.readouterr().err
    path.write_bytes(b"no recording")
    with pytest.raises(RecordingError, match="run.mcap"):
        read_run(path)


def test_an_inspection_is_shown_while_it_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shown: list[Step] = []
    show = LiveView.step

    def step(view: LiveView, look: Step) -> None:
        shown.append(look)
        show(view, look)

    monkeypatch.setattr(LiveView, "step", step)
    arguments = [
        "--profile",
        "mock",
        "--max-moves",
        "2",
        "--out",
        str(tmp_path),
        "--view",
        "--view-port",
        "0",
    ]
    main(["deploy", "inspect", *arguments])
    assert "page    http://127.0.0.1:" in "".join(capsys.readouterr())
    stored = read_run(tmp_path / "run.mcap")
    assert len(shown) == stored.moves + 1 > 1
    for look, snapshot in zip(shown, stored.snapshots, strict=True):
        np.testing.assert_allclose(look.joint_positions, snapshot.joint_positions)
