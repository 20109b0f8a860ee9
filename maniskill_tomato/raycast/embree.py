"""Intel's Embree, which traces the rays of a CPU: triangle meshes and the addresses of its functions.

The package `embreex` brings the library. Its own Python interface traces one mesh a call; here Warp's kernels call
Embree's C interface ray by ray, so that a query stays one launch for all environments. Where there is no wheel of
`embreex`, such as on ARM, and on CUDA Warp traces the rays itself.

Source: the headers of Embree 4 (`embree4/rtcore*.h`).
"""

import ctypes
import weakref
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any, Final, Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray

from maniskill_tomato.errors import InvalidInputError, UnsoundEnvironmentError

Backend = Literal["embree", "warp"]
"""What traces rays."""

PACKAGE: Final = "embreex"

BYTES_OF_A_FACE: Final = 90
"""Corners, vertex indices and bounding volumes of a triangle of an Embree mesh, as measured."""

# With more threads Embree would sort a mesh in a pool of its own, beside the processes that share the machine.
_DEVICE_OPTIONS: Final = b"threads=1,set_affinity=0"
_TRIANGLES: Final = 0  # RTC_GEOMETRY_TYPE_TRIANGLE
_INDEX_BUFFER: Final = 0  # RTC_BUFFER_TYPE_INDEX
_VERTEX_BUFFER: Final = 1  # RTC_BUFFER_TYPE_VERTEX
_UINT3: Final = 0x5003  # RTC_FORMAT_UINT3
_FLOAT3: Final = 0x9003  # RTC_FORMAT_FLOAT3
_ROBUST: Final = 4  # RTC_SCENE_FLAG_ROBUST: no ray slips between two triangles.

_POINTER, _UNSIGNED, _SIZE = ctypes.c_void_p, ctypes.c_uint, ctypes.c_size_t
_FUNCTIONS: Final[dict[str, tuple[Any, tuple[Any, ...]]]] = {
    "rtcNewDevice": (_POINTER, (ctypes.c_char_p,)),
    "rtcGetDeviceError": (ctypes.c_int, (_POINTER,)),
    "rtcNewScene": (_POINTER, (_POINTER,)),
    "rtcSetSceneFlags": (None, (_POINTER, ctypes.c_int)),
    "rtcNewGeometry": (_POINTER, (_POINTER, ctypes.c_int)),
    "rtcSetNewGeometryBuffer": (_POINTER, (_POINTER, ctypes.c_int, _UNSIGNED, ctypes.c_int, _SIZE, _SIZE)),
    "rtcCommitGeometry": (None, (_POINTER,)),
    "rtcAttachGeometry": (_UNSIGNED, (_POINTER, _POINTER)),
    "rtcReleaseGeometry": (None, (_POINTER,)),
    "rtcCommitScene": (None, (_POINTER,)),
    "rtcReleaseScene": (None, (_POINTER,)),
}


class Embree:
    """The library with one device, for as long as the process lives."""

    def __init__(self, path: Path) -> None:
        """Loads the library.

        Raises:
            UnsoundEnvironmentError: It cannot be loaded, or finds no processor that it knows.
        """
        try:
            self._library = ctypes.CDLL(str(path))
        except OSError as error:
            raise UnsoundEnvironmentError(
                f"{PACKAGE} is installed, but its library cannot be loaded ({error}); install it again, or uninstall "
                "it, and Warp traces the rays"
            ) from error
        for name, (result, arguments) in _FUNCTIONS.items():
            function = getattr(self._library, name)
            function.restype, function.argtypes = result, arguments
        self._device = self._library.rtcNewDevice(_DEVICE_OPTIONS)
        self._check()
        self.closest_hit = self._address("rtcIntersect1")
        """Address of the function that finds the first triangle on a ray."""
        self.any_hit = self._address("rtcOccluded1")
        """Address of the function that says whether a ray meets any triangle."""

    def build(self, vertices: NDArray[np.float32], faces: NDArray[np.uint32]) -> int:
        """Address of a new scene of triangles; see `EmbreeMesh`."""
        library = self._library
        scene: int = library.rtcNewScene(self._device)
        library.rtcSetSceneFlags(scene, _ROBUST)
        geometry = library.rtcNewGeometry(self._device, _TRIANGLES)
        for kind, form, rows in ((_VERTEX_BUFFER, _FLOAT3, vertices), (_INDEX_BUFFER, _UINT3, faces)):
            buffer = library.rtcSetNewGeometryBuffer(geometry, kind, 0, form, 12, len(rows))
            self._check()
            ctypes.memmove(buffer, rows.ctypes.data, rows.nbytes)
        library.rtcCommitGeometry(geometry)
        library.rtcAttachGeometry(scene, geometry)
        library.rtcReleaseGeometry(geometry)
        library.rtcCommitScene(scene)
        self._check()
        return scene

    def release(self, scene: int) -> None:
        """Frees what `build` made."""
        self._library.rtcReleaseScene(scene)

    def _address(self, name: str) -> int:
        return int(ctypes.cast(getattr(self._library, name), _POINTER).value or 0)

    def _check(self) -> None:
        error = self._library.rtcGetDeviceError(self._device)
        if error or not self._device:
            raise UnsoundEnvironmentError(
                f"Embree reports its error {error} (RTCError in embree4/rtcore_device.h); uninstall {PACKAGE}, and "
                "Warp traces the rays"
            )


class EmbreeMesh:
    """Triangles in an Embree scene."""

    def __init__(self, vertices: NDArray[Any], faces: NDArray[Any]) -> None:
        """Sorts the triangles.

        Args:
            vertices: Positions, in [m]. Shape (V, 3).
            faces: Vertex indices. Shape (F, 3).

        Raises:
            InvalidInputError: There is no Embree here.
        """
        embree = load_embree()
        if embree is None:
            raise InvalidInputError(f"Embree meshes need the package {PACKAGE}, which is not installed")
        corners = np.ascontiguousarray(vertices, dtype=np.float32)
        self.id = embree.build(corners, np.ascontiguousarray(faces, dtype=np.uint32))
        """What kernels know the mesh by."""
        weakref.finalize(self, embree.release, self.id).atexit = False


@cache
def load_embree() -> Embree | None:
    """Embree, loaded once; None where `embreex` is not installed.

    Raises:
        UnsoundEnvironmentError: It is installed and cannot be used.
    """
    try:
        files = metadata.files(PACKAGE) or []
    except metadata.PackageNotFoundError:
        return None
    paths = [Path(str(file.locate())) for file in files if file.name.startswith("libembree4")]
    return Embree(paths[0]) if paths else None


def choose_backend(device: torch.device, wanted: Backend | None) -> Backend:
    """What traces the rays of a device.

    Args:
        device: Where they are cast.
        wanted: None for Embree on a CPU that has it, and else Warp.

    Raises:
        InvalidInputError: `wanted` is unknown, or is not to be had there.
    """
    if wanted is not None and wanted not in get_args(Backend):
        raise InvalidInputError.choice("backend", wanted, get_args(Backend))
    has_embree = device.type == "cpu" and wanted != "warp" and load_embree() is not None
    if wanted == "embree" and not has_embree:
        needs = "a CPU" if device.type != "cpu" else f"the package {PACKAGE}, which is not installed"
        raise InvalidInputError(f"backend='embree' needs {needs}; choose 'warp', which runs everywhere")
    return "embree" if has_embree else "warp"
