"""librealsense: its Python module, and framesets of a camera or of a recording through one pipeline."""

import ctypes
import importlib
import time
from functools import cache
from pathlib import Path
from typing import Any

from maniskill_tomato.deploy.deploy_errors import DeviceTimeoutError, NotConnectedError
from maniskill_tomato.deploy.realsense.realsense_config import RealSenseConfig


@cache
def load_sdk() -> Any:
    """The module `pyrealsense2`.

    Its wheel needs libusb, which neither it nor every machine brings; `libusb-package` will do.

    Raises:
        NotConnectedError: It cannot be loaded, with what to install.
    """
    try:
        return importlib.import_module("pyrealsense2")
    except ImportError as error:
        reason = str(error)
    if "libusb" in reason:
        try:
            library = importlib.import_module("libusb_package").get_library_path()
            ctypes.CDLL(str(library), mode=ctypes.RTLD_GLOBAL)
            return importlib.import_module("pyrealsense2")
        except (ImportError, OSError) as error:
            reason = str(error)
    raise NotConnectedError(
        f"the RealSense SDK cannot be loaded: {reason}; install the extra `hardware` of this package "
        "(pyrealsense2 and libusb-package), or libusb-1.0-0 and libudev1 of the system"
    )


def connected_serials(sdk: Any, context: Any) -> list[str]:
    """Serial numbers of the cameras that are plugged in.

    Args:
        sdk: The module `pyrealsense2`.
        context: A `context` of it.
    """
    info = sdk.camera_info.serial_number
    return [str(d.get_info(info)) for d in context.query_devices() if d.supports(info)]


class FrameSource:
    """A running pipeline of the SDK."""

    def __init__(self, sdk: Any, config: RealSenseConfig) -> None:
        """Starts the streams; fails at once where there is no camera, which the pipeline itself takes 15 s for.

        Args:
            sdk: The module `pyrealsense2`.
            config: Which camera or recording, which streams.

        Raises:
            NotConnectedError: There is no such camera or file, or it cannot send what is asked for.
        """
        self._sdk = sdk
        self._config = config
        self.serial: str | None = None
        settings = sdk.config()
        self._context = sdk.context()
        if config.recording is None:
            self.serial = self._find_camera()
            settings.enable_device(self.serial)
            width, height = config.color_size
            settings.enable_stream(sdk.stream.color, width, height, sdk.format.rgb8, config.fps)
            width, height = config.depth_size
            settings.enable_stream(sdk.stream.depth, width, height, sdk.format.z16, config.fps)
        else:
            path = Path(config.recording)
            if not path.is_file():
                raise NotConnectedError(
                    f"no recording at {path}; give camera.recording a .db3 file of the SDK"
                )
            settings.enable_device_from_file(str(path), repeat_playback=config.repeat)
        self._pipeline = sdk.pipeline(self._context)
        self._playback = None
        try:
            if config.recording is not None:
                # Before the start: played in real time, the first pictures are lost to whoever is late.
                device = settings.resolve(sdk.pipeline_wrapper(self._pipeline)).get_device()
                self._playback = device.as_playback()
                self._playback.set_real_time(False)
            self.profile = self._pipeline.start(settings)
        except RuntimeError as error:
            what = f"camera {self.serial}" if config.recording is None else f"recording {config.recording}"
            raise NotConnectedError(
                f"the {what} cannot be started: {error}; is another program using it, is it on a USB 3 port, and does "
                "it have these sizes and this rate?"
            ) from error

    @property
    def is_recording(self) -> bool:
        """Whether a file is played."""
        return self._playback is not None

    def depth_sensor(self) -> Any:
        """The SDK's depth sensor."""
        return self.profile.get_device().first_depth_sensor()

    def next(self, timeout_s: float) -> Any:
        """The next frameset.

        Args:
            timeout_s: The longest wait, in [s].

        Raises:
            NotConnectedError: The camera is gone, or the recording is over.
            DeviceTimeoutError: It sends nothing.
        """
        deadline = time.monotonic() + timeout_s
        while True:
            # A recording's end stops the pipeline without a word: look for it often.
            step = min(0.1, max(0.001, deadline - time.monotonic())) if self.is_recording else timeout_s
            try:
                there, frames = self._pipeline.try_wait_for_frames(int(1000 * step))
            except RuntimeError as error:
                raise NotConnectedError(f"the camera sends no more: {error}; look at its cable") from error
            if there:
                return frames
            if self._playback is not None:
                # One that repeats stops for a moment each time.
                is_over = self._playback.current_status() == self._sdk.playback_status.stopped
                if is_over and not self._config.repeat:
                    raise NotConnectedError(
                        "the recording is over; set camera.repeat = true to play it again"
                    )
            elif self.serial not in connected_serials(self._sdk, self._context):
                raise NotConnectedError(f"camera {self.serial} is gone; look at its cable and connect again")
            if time.monotonic() >= deadline:
                raise DeviceTimeoutError(
                    f"no picture within {timeout_s:g} s; the camera is there but sends nothing"
                )

    def close(self) -> None:
        """Stops the streams. Never raises."""
        try:
            self._pipeline.stop()
        except RuntimeError:
            pass  # The device went first.

    def _find_camera(self) -> str:
        serials = connected_serials(self._sdk, self._context)
        listed = ", ".join(serials) if serials else "none"
        wanted = self._config.serial
        if not serials:
            raise NotConnectedError(
                "no RealSense camera found; look at its cable (USB 3), its power and the udev rules, or play a "
                "file with camera.recording"
            )
        if wanted is None and len(serials) > 1:
            raise NotConnectedError(f"several cameras: {listed}; say which with camera.serial")
        if wanted is not None and wanted not in serials:
            raise NotConnectedError(f"no camera with the serial number {wanted}; found: {listed}")
        return wanted or serials[0]
