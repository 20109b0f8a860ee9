"""Options of the camera."""

from dataclasses import dataclass

from lerobot.cameras import CameraConfig


@CameraConfig.register_subclass("maniskill_tomato")
@dataclass(kw_only=True)
class ProfileCameraConfig(CameraConfig):
    """A profile of maniskill-tomato, of which only the camera is opened."""

    profile: str = "mock"
    """Name of a profile that ships, or the path of a TOML file."""
    seed: int = 0
    """Of a simulated profile: the twin's episode."""
    use_depth: bool = False
    """Whether robots read its depth too."""
