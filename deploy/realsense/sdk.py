"""Loads librealsense's Python module on first use."""

import ctypes
import importlib
from functools import cache
from typing import Any

from maniskill_tomato.deploy.deploy_errors import NotConnectedError


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
