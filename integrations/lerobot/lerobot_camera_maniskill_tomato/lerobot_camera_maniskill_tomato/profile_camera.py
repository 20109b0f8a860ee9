"""The camera: colours, and depth on the same pixels, seen from the colour camera."""

import time
from typing import Any

import numpy as np
from lerobot.cameras import Camera
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError
from numpy.typing import NDArray

from lerobot_camera_maniskill_tomato.config_profile_camera import ProfileCameraConfig
from maniskill_tomato.deploy.deploy_errors import DeviceTimeoutError, ProfileError, StaleError
from maniskill_tomato.deploy.depth_units import in_millimetres
from maniskill_tomato.deploy.interface import Frame
from maniskill_tomato.deploy.profile import load_profile
from maniskill_tomato.deploy.profile_files import profile_names
from maniskill_tomato.deploy.workcell import make_workcell


class ProfileCamera(Camera):
    """Any camera that `maniskill-tomato deploy` has a driver for.

    A frame is taken when it is asked for; no thread runs.
    """

    def __init__(self, config: ProfileCameraConfig) -> None:
        """Reads the profile; no device is touched.

        Raises:
            ProfileError: It cannot be used.
        """
        super().__init__(config)
        self.config = config
        self.use_depth = config.use_depth
        workcell = make_workcell(load_profile(config.profile), config.seed)
        self._camera, self._clock = workcell.camera, workcell.clock
        self._max_age = workcell.profile.capture.max_age
        self._last: Frame | None = None
        self._is_read = True

    @property
    def is_connected(self) -> bool:
        """Whether frames can be read."""
        return self._camera.is_connected

    @staticmethod
    def find_cameras() -> list[dict[str, Any]]:
        """The profiles that ship; what is plugged in says `maniskill-tomato deploy check`."""
        return [{"type": "maniskill_tomato", "id": name, "name": name} for name in profile_names()]

    def connect(self, warmup: bool = True) -> None:
        """Opens the camera.

        Raises:
            DeviceAlreadyConnectedError: It is open.
            ProfileError: Its pictures have another size than `width` and `height` say.
            DeployError: It is not there.
        """
        if self.is_connected:
            raise DeviceAlreadyConnectedError("the camera is connected already")
        self._camera.connect()
        try:
            found = self._camera.intrinsics
            for name in ("width", "height"):
                told = getattr(self, name)
                if told is not None and told != getattr(found, name):
                    raise ProfileError(
                        f"{name} must be {getattr(found, name)}, as the profile {self.config.profile!r} says; "
                        f"got {told}"
                    )
            self.width, self.height = found.width, found.height
            if warmup:
                self._take()
        except BaseException:
            self.disconnect()
            raise

    def read(self) -> NDArray[Any]:
        """A new colour picture. RGB, uint8, shape (H, W, 3).

        Raises:
            DeviceNotConnectedError: It is not open.
            DeployError: It gives none.
        """
        frame = self._take()
        self._is_read = True
        return frame.color.copy()

    def read_depth(self) -> NDArray[Any]:
        """New depth in [mm], 0 where there is none. uint16, shape (H, W, 1)."""
        frame = self._take()
        self._is_read = True
        return _depth(frame)

    def async_read(self, timeout_ms: float = 200) -> NDArray[Any]:
        """A colour picture that was not read yet.

        Raises:
            DeviceNotConnectedError: It is not open.
            TimeoutError: None came in time; one that came late is given by the next call.
        """
        return self._unread(timeout_ms).color.copy()

    def async_read_depth(self, timeout_ms: float = 200) -> NDArray[Any]:
        """Depth that was not read yet; see `async_read` and `read_depth`."""
        return _depth(self._unread(timeout_ms))

    def read_latest(self, max_age_ms: int = 500) -> NDArray[Any]:
        """The newest colour picture, taken anew if the last is older than `max_age_ms`."""
        return self._newest(max_age_ms).color.copy()

    def read_latest_depth(self, max_age_ms: int = 500) -> NDArray[Any]:
        """The newest depth; see `read_latest` and `read_depth`."""
        return _depth(self._newest(max_age_ms))

    def disconnect(self) -> None:
        """Lets the camera go."""
        self._camera.disconnect()
        self._last, self._is_read = None, True

    def _take(self) -> Frame:
        if not self.is_connected:
            raise DeviceNotConnectedError("the camera is not connected; call connect() first")
        after = None if self._last is None else self._last.stamp
        self._last, self._is_read = self._camera.read(self._max_age, after), False
        return self._last

    def _unread(self, timeout_ms: float) -> Frame:
        began = time.monotonic()
        if self._is_read or self._last is None or self._clock.now() - self._last.stamp > self._max_age:
            try:
                self._take()
            except (DeviceTimeoutError, StaleError) as error:
                raise TimeoutError(str(error)) from error
        assert self._last is not None
        if 1000.0 * (time.monotonic() - began) > timeout_ms:
            raise TimeoutError(f"the camera sent no picture within {timeout_ms:g} ms")
        self._is_read = True
        return self._last

    def _newest(self, max_age_ms: float) -> Frame:
        if self._last is None or 1000.0 * (self._clock.now() - self._last.stamp) > max_age_ms:
            return self._take()
        if not self.is_connected:
            raise DeviceNotConnectedError("the camera is not connected; call connect() first")
        return self._last


def _depth(frame: Frame) -> np.ndarray:
    return in_millimetres(frame.depth)[0][..., None]
