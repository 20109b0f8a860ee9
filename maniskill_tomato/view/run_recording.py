"""Runs on an arm as a viewer draws them: from their recordings, or look by look while they go on."""

from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from maniskill_tomato.deploy.interface import Frame
from maniskill_tomato.deploy.run_records import Step
from maniskill_tomato.deploy.run_replay import load_recording
from maniskill_tomato.robot.arm_model import ArmModel
from maniskill_tomato.robot.d435 import CameraIntrinsics
from maniskill_tomato.view.episode_recording import (
    EpisodeRecording,
    Float64,
    MeasuredFraction,
    SeenPoints,
    Snapshot,
)

MOST_POINTS: Final = 20_000
"""Of a larger picture every second, third ... pixel in each direction becomes a point."""

FARTHEST: Final = 2.0
"""Points beyond are left out: what stands behind the row, in [m]."""

PICTURE_WIDTH: Final = 480
"""Of the pictures that are shown, at most, in [px]."""

GOES_ON: Final = ("moved", "refused")
"""Outcomes of a look after which a run goes on."""


def read_run(path: Path) -> EpisodeRecording:
    """The recording of a `deploy run` or `deploy inspect`.

    Raises:
        RecordingError: It is missing, damaged, or of another kind.
    """
    from maniskill_tomato.deploy.drivers import arm_model

    run = load_recording(path)
    info = run.info
    recorder = RunRecorder(
        f"{path}, {info.get('policy_name', 'a policy')}, {info.get('profile', 'recorded')}",
        threshold=run.profile.loop.threshold,
        model=arm_model(str(info.get("arm_model", "iiwa14"))),
    )
    for step in run.steps:
        facts = step.facts
        recorder.add(
            step.frame,
            joint_positions=np.array(facts["joint_positions"], dtype=np.float64),
            T_w_camera=np.array(facts["T_world_camera"], dtype=np.float64),
            target_position=np.array(facts["target_position"], dtype=np.float64),
            visible_fraction=float(facts["visible_fraction"]),
            # Recordings of earlier versions do not say how sure V_f was.
            fraction_margin=facts.get("fraction_margin"),
            outcome=str(facts["outcome"]),
            detail=str(facts["detail"]),
        )
    if run.fault is not None:
        recorder.recording.outcome = f"fault: {run.fault.reason}, {run.fault.detail}"
    elif run.is_cut_off:
        recorder.recording.outcome = "the recording is cut off here"
    return recorder.recording


class RunRecorder:
    """A recorder of `deploy` runs that makes a snapshot of every look."""

    def __init__(
        self,
        title: str,
        *,
        threshold: float,
        model: ArmModel,
    ) -> None:
        """Begins without a look.

        Args:
            title: What it is, in a line.
            threshold: V_f above which the target is fully visible.
            model: Of the arm.
        """
        self.recording = EpisodeRecording(title=title, threshold=threshold, model=model)
        """The run so far."""
        self._event, self._was_refused = "", False

    def step(self, step: Step) -> None:
        """Takes a look of a run that goes on; see `deploy.run_records.Recorder`."""
        self.add(
            step.frame,
            joint_positions=step.joint_positions,
            T_w_camera=step.T_world_camera,
            target_position=step.target_position,
            visible_fraction=float(step.view.visible_fraction),
            fraction_margin=step.view.fraction_margin,
            outcome=step.outcome,
            detail=step.detail,
        )

    def event(self, stamp: float, text: str) -> None:
        """Lines of the log are not shown."""

    def add(
        self,
        frame: Frame,
        *,
        joint_positions: Float64,
        T_w_camera: Float64,
        target_position: Float64,
        visible_fraction: float,
        fraction_margin: float | None,
        outcome: str,
        detail: str,
    ) -> None:
        """Adds a look, with what came of it, which is told of the next one.

        Args:
            frame: The pictures.
            joint_positions: In [rad]. Shape (7,).
            T_w_camera: Pose of the colour camera. Shape (4, 4).
            target_position: In [m]. Shape (3,).
            visible_fraction: V_f as it was measured.
            fraction_margin: How far off it may be; None where it is exact, or nobody knows.
            outcome: As in `deploy.run_records.Step`.
            detail: Likewise.
        """
        truth = frame.truth
        measured = None
        if fraction_margin is not None:
            measured = MeasuredFraction(value=visible_fraction, margin=float(fraction_margin))
        recording = self.recording
        recording.fov_y = float(frame.intrinsics.fov_y)
        recording.snapshots.append(
            Snapshot(
                joint_positions=joint_positions,
                T_w_camera=T_w_camera,
                target_position=target_position,
                visible_fraction=visible_fraction if measured is None else measured.band[0],
                measured=measured,
                true_visible_fraction=None if truth is None else truth.visible_fraction,
                picture=_thinned(frame.color),
                points=_points(frame, T_w_camera),
                event=self._event,
                was_refused=self._was_refused,
            )
        )
        self._was_refused = outcome == "refused"
        self._event = outcome if not detail else f"{outcome}: {detail}"
        if outcome not in GOES_ON:
            recording.outcome = self._event


def _thinned(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Every second, third ... pixel of a large picture. Shape (H, W, 3)."""
    stride = max(-(-picture.shape[1] // PICTURE_WIDTH), 1)
    return np.ascontiguousarray(picture[::stride, ::stride])


def _points(frame: Frame, T_w_camera: Float64) -> SeenPoints:
    """What has depth, in the world frame."""
    intrinsics: CameraIntrinsics = frame.intrinsics
    stride = max(int(np.ceil(np.sqrt(frame.depth.size / MOST_POINTS))), 1)
    thinned: Any = (slice(None, None, stride), slice(None, None, stride))
    depth = frame.depth[thinned]
    there = np.isfinite(depth) & (depth > 0.0) & (depth < FARTHEST)
    rays = intrinsics.ray_directions(intrinsics.pixel_centres()[thinned][there])
    points = (rays * depth[there][:, None]) @ T_w_camera[:3, :3].T + T_w_camera[:3, 3]
    return SeenPoints(
        positions=np.asarray(points, dtype=np.float32),
        colours=np.ascontiguousarray(frame.color[thinned][there]),
    )
