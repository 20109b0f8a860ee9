"""The camera of a profile of maniskill-tomato as a camera of LeRobot: `type: maniskill_tomato`."""

from lerobot_camera_maniskill_tomato.config_profile_camera import ProfileCameraConfig
from lerobot_camera_maniskill_tomato.profile_camera import ProfileCamera

__all__ = ["ProfileCamera", "ProfileCameraConfig"]
