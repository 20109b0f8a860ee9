"""Options of the robot."""

from dataclasses import dataclass, field
from typing import Literal

from lerobot.cameras import CameraConfig
from lerobot.robots import RobotConfig


@RobotConfig.register_subclass("kuka_iiwa")
@dataclass(kw_only=True)
class KukaIiwaConfig(RobotConfig):
    """A profile of maniskill-tomato: arm, wrist camera, calibration and limits."""

    profile: str = "mock"
    """Name of a profile that ships, or the path of a TOML file."""
    seed: int = 0
    """Of a simulated profile: the twin's episode."""
    allow_motion: bool = False
    """Whether a real arm may move. A simulated one always may."""
    on_refusal: Literal["raise", "hold"] = "raise"
    """What happens when the guard refuses a move: an error, or the arm stays and the joint angles where it stands are
    told as the action that was sent."""
    use_depth: bool = True
    """Whether observations hold the wrist camera's depth."""
    width: int | None = None
    """Of the wrist camera's pictures, in [px]; only for drivers that do not tell it before they connect."""
    height: int | None = None
    """Likewise."""
    cameras: dict[str, CameraConfig] = field(default_factory=dict)
    """Further cameras, which the guard does not use."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.on_refusal not in ("raise", "hold"):
            raise ValueError(f"on_refusal must be 'raise' or 'hold', got {self.on_refusal!r}")
        for name in ("wrist", "wrist_depth"):
            if name in self.cameras:
                raise ValueError(f"cameras: {name} is the profile's own camera; choose another name")
