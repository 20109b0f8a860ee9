"""Recordings of `deploy run` and `deploy inspect` as episodes: one frame for each look."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from maniskill_tomato.conversion.episodes import (
    FLAG,
    Episode,
    EpisodeSource,
    Feature,
    Frame,
    color,
    depth,
    flag,
    vector,
)
from maniskill_tomato.deploy.deploy_errors import RecordingError
from maniskill_tomato.deploy.depth_units import in_millimetres
from maniskill_tomato.deploy.drivers import arm_model
from maniskill_tomato.deploy.run_replay import RecordedRun, RecordedStep, load_recording
from maniskill_tomato.errors import InvalidInputError

CAMERA: Final = "wrist"
"""Name of the camera on the flange, also that of the plug-in for LeRobot."""

MOVE_NAMES: Final = ("right", "up", "forward")
"""Of a policy's move, each in [-1, 1]."""

ONE_FRUIT: Final = "Look at the tomato until it is fully visible."
WHOLE_ROW: Final = "Look at every ripe tomato of the row until it is fully visible."


def read_run(path: Path, task: str | None = None) -> EpisodeSource:
    """A recording as one episode; of one that was cut off, the looks that are whole.

    Args:
        path: The `.mcap` file.
        task: What was to be done, in words; None for what the recording says.

    Raises:
        RecordingError: It is missing, damaged, or holds no look.
    """
    run = load_recording(path)
    if not run.steps:
        raise RecordingError(f"{path} holds no look, only a fault")
    model = arm_model(str(run.info.get("arm_model", "iiwa14")))
    words = task or (WHOLE_ROW if "row_moves" in run.info else ONE_FRUIT)
    episode = Episode(task=words, frames=_frames(run), source=str(path))
    return EpisodeSource(
        features=run_features(
            model.joint_names, run.steps[0].frame.color.shape[:2], _intrinsics(run.steps[0])
        ),
        robot=model.name,
        episodes=iter([episode]),
    )


def run_features(
    joint_names: tuple[str, ...], size: tuple[int, ...], intrinsics: dict[str, float]
) -> dict[str, Feature]:
    """What a frame of a run holds.

    Args:
        joint_names: Of the arm.
        size: Rows and columns of the images, in [px].
        intrinsics: `fx`, `fy`, `cx` and `cy` of both, in [px].
    """
    joints = tuple(f"{name}.pos" for name in joint_names)
    images = f"observation.images.{CAMERA}"
    height, width = size
    return {
        "observation.state": vector(joints, unit="rad"),
        "action": vector(joints, unit="rad"),
        images: color(height, width, intrinsics=intrinsics),
        f"{images}_depth": depth(height, width, intrinsics=intrinsics),
        "camera_pose": vector(("x", "y", "z", "qw", "qx", "qy", "qz"), frame="arm's base", unit="m"),
        "target_position": vector(("x", "y", "z"), frame="arm's base", unit="m"),
        "visible_fraction": Feature(dtype="float32", shape=FLAG),
        "policy_move": vector(MOVE_NAMES),
        "move_sent": flag(),
        "seconds": Feature(dtype="float32", shape=FLAG, info={"unit": "s"}),
        "next.done": flag(),
        "next.success": flag(),
    }


def _frames(run: RecordedRun) -> Iterator[Frame]:
    first = run.steps[0].frame
    last = len(run.steps) - 1
    for number, step in enumerate(run.steps):
        if _intrinsics(step) != _intrinsics(run.steps[0]):
            raise InvalidInputError("the camera's intrinsics change within a recording")
        try:
            frame = _frame(step, step.frame.stamp - first.stamp, number == last)
        except (KeyError, TypeError, ValueError) as error:
            raise RecordingError(f"look {number} of a recording is incomplete ({error})") from error
        yield frame


def _frame(step: RecordedStep, seconds: float, is_last: bool) -> Frame:
    facts = step.facts
    joints = _numbers(facts["joint_positions"])
    sent = facts["commanded"] is not None
    T_world_camera = np.asarray(facts["T_world_camera"], dtype=np.float64)
    quat_wxyz = Rotation.from_matrix(T_world_camera[:3, :3]).as_quat(scalar_first=True, canonical=True)
    millimetres, _ = in_millimetres(step.frame.depth)
    move = facts["action"]
    return {
        "observation.state": joints,
        "action": _numbers(facts["commanded"]) if sent else joints,
        f"observation.images.{CAMERA}": step.frame.color,
        f"observation.images.{CAMERA}_depth": millimetres[..., None],
        "camera_pose": _numbers([*T_world_camera[:3, 3], *quat_wxyz]),
        "target_position": _numbers(facts["target_position"]),
        "visible_fraction": _numbers([facts["visible_fraction"]]),
        "policy_move": np.zeros(3, np.float32) if move is None else _numbers(move),
        "move_sent": np.array([sent]),
        "seconds": _numbers([seconds]),
        "next.done": np.array([is_last]),
        "next.success": np.array([facts["outcome"] == "success"]),
    }


def _intrinsics(step: RecordedStep) -> dict[str, float]:
    found = step.frame.intrinsics
    return {"fx": found.fx, "fy": found.fy, "cx": found.cx, "cy": found.cy}


def _numbers(values: Any) -> NDArray[np.float32]:
    return np.asarray(values, dtype=np.float32)
