"""Says whether this machine can render: a Vulkan device with the feature that SAPIEN needs, and a picture.

Usage:
    python3 scripts/check_vulkan.py            # ask the Vulkan loader; standard library only
    .venv/bin/python scripts/check_vulkan.py --render   # also render one picture with SAPIEN

The last line is the verdict. The exit status is 0 when rendering can work and 1 otherwise.
"""

import argparse
import ctypes
import sys
from dataclasses import dataclass

# Values of the C enumerations VkStructureType and VkResult (Vulkan 1.2 core).
APPLICATION_INFO = 0
INSTANCE_CREATE_INFO = 1
PHYSICAL_DEVICE_FEATURES_2 = 1000059000
DESCRIPTOR_INDEXING_FEATURES = 1000161001
VK_SUCCESS = 0
VK_API_1_2 = (1 << 22) | (2 << 12)
VK_API_1_1 = (1 << 22) | (1 << 12)

N_CORE_FEATURES = 55
N_DESCRIPTOR_INDEXING_FEATURES = 20
PARTIALLY_BOUND = 17
"""Position of `descriptorBindingPartiallyBound` in VkPhysicalDeviceDescriptorIndexingFeatures."""

PROPERTIES_BYTES = 4096
"""More than the 824 bytes of VkPhysicalDeviceProperties."""


class _ApplicationInfo(ctypes.Structure):
    _fields_ = [
        ("sType", ctypes.c_int),
        ("pNext", ctypes.c_void_p),
        ("pApplicationName", ctypes.c_char_p),
        ("applicationVersion", ctypes.c_uint32),
        ("pEngineName", ctypes.c_char_p),
        ("engineVersion", ctypes.c_uint32),
        ("apiVersion", ctypes.c_uint32),
    ]


class _InstanceCreateInfo(ctypes.Structure):
    _fields_ = [
        ("sType", ctypes.c_int),
        ("pNext", ctypes.c_void_p),
        ("flags", ctypes.c_uint32),
        ("pApplicationInfo", ctypes.POINTER(_ApplicationInfo)),
        ("enabledLayerCount", ctypes.c_uint32),
        ("ppEnabledLayerNames", ctypes.c_void_p),
        ("enabledExtensionCount", ctypes.c_uint32),
        ("ppEnabledExtensionNames", ctypes.c_void_p),
    ]


class _DescriptorIndexingFeatures(ctypes.Structure):
    _fields_ = [
        ("sType", ctypes.c_int),
        ("pNext", ctypes.c_void_p),
        ("features", ctypes.c_uint32 * N_DESCRIPTOR_INDEXING_FEATURES),
    ]


class _Features2(ctypes.Structure):
    _fields_ = [
        ("sType", ctypes.c_int),
        ("pNext", ctypes.c_void_p),
        ("features", ctypes.c_uint32 * N_CORE_FEATURES),
    ]


@dataclass(frozen=True)
class Device:
    """A Vulkan device as its driver describes it."""

    name: str
    api_version: str
    partially_bound: bool


def list_devices() -> "list[Device]":
    """The machine's Vulkan devices.

    Raises:
        OSError: There is no Vulkan loader or it refuses to start; the message says which.
    """
    try:
        vulkan = ctypes.CDLL("libvulkan.so.1")
    except OSError as error:
        raise OSError(f"no Vulkan loader ({error})") from error

    application = _ApplicationInfo(sType=APPLICATION_INFO, apiVersion=VK_API_1_2)
    create_info = _InstanceCreateInfo(
        sType=INSTANCE_CREATE_INFO, pApplicationInfo=ctypes.pointer(application)
    )
    instance = ctypes.c_void_p()
    result = vulkan.vkCreateInstance(ctypes.byref(create_info), None, ctypes.byref(instance))
    if result != VK_SUCCESS:
        raise OSError(f"the Vulkan loader found no driver (vkCreateInstance returned {result})")
    try:
        count = ctypes.c_uint32()
        result = vulkan.vkEnumeratePhysicalDevices(instance, ctypes.byref(count), None)
        handles = (ctypes.c_void_p * count.value)()
        if result == VK_SUCCESS and count.value:
            result = vulkan.vkEnumeratePhysicalDevices(instance, ctypes.byref(count), handles)
        if result != VK_SUCCESS:
            raise OSError(f"the Vulkan drivers list no device (vkEnumeratePhysicalDevices returned {result})")
        return [_describe(vulkan, ctypes.c_void_p(handle)) for handle in handles]
    finally:
        vulkan.vkDestroyInstance(instance, None)


def _describe(vulkan: ctypes.CDLL, handle: ctypes.c_void_p) -> Device:
    properties = ctypes.create_string_buffer(PROPERTIES_BYTES)
    vulkan.vkGetPhysicalDeviceProperties(handle, properties)
    version = int.from_bytes(properties.raw[:4], sys.byteorder)
    name = properties.raw[20 : 20 + 256].split(b"\0", 1)[0].decode(errors="replace")
    partially_bound = False
    if version >= VK_API_1_1:
        indexing = _DescriptorIndexingFeatures(sType=DESCRIPTOR_INDEXING_FEATURES)
        features = _Features2(
            sType=PHYSICAL_DEVICE_FEATURES_2, pNext=ctypes.cast(ctypes.pointer(indexing), ctypes.c_void_p)
        )
        vulkan.vkGetPhysicalDeviceFeatures2(handle, ctypes.byref(features))
        partially_bound = bool(indexing.features[PARTIALLY_BOUND])
    api = f"{version >> 22 & 0x7F}.{version >> 12 & 0x3FF}.{version & 0xFFF}"
    return Device(name=name, api_version=api, partially_bound=partially_bound)


def render_one_picture() -> None:
    """Render a lit box with SAPIEN.

    Raises:
        RuntimeError: The picture is empty. SAPIEN's own errors pass through.
    """
    import numpy as np
    import sapien

    # The usual shaders need the same device, and compile for about ten seconds.
    sapien.render.set_camera_shader_dir("trivial")
    scene = sapien.Scene()
    scene.set_ambient_light([0.5, 0.5, 0.5])
    builder = scene.create_actor_builder()
    builder.add_box_visual(half_size=(0.2, 0.2, 0.2))
    box = builder.build_static(name="box")
    box.set_pose(sapien.Pose([1.0, 0.0, 0.0]))
    camera = scene.add_camera("camera", 32, 32, fovy=0.8, near=0.01, far=10.0)
    scene.update_render()
    camera.take_picture()
    picture = np.asarray(camera.get_picture("Color"))
    if (
        picture.shape != (32, 32, 4)
        or not np.isfinite(picture).all()
        or float(picture[16, 16, :3].max()) <= 0.0
    ):
        raise RuntimeError(f"SAPIEN rendered an empty picture (shape {picture.shape})")


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--render", action="store_true", help="also render one picture with SAPIEN")
    arguments = parser.parse_args()

    try:
        ctypes.CDLL("libX11.so.6")
    except OSError:
        print("no: SAPIEN needs the system library libX11, even without a screen; `make vulkan` installs it")
        return 1
    try:
        devices = list_devices()
    except OSError as error:
        print(f"no: {error}; `make vulkan` installs a CPU driver")
        return 1
    for device in devices:
        has = "has" if device.partially_bound else "lacks"
        print(f"{device.name}: Vulkan {device.api_version}, {has} descriptorBindingPartiallyBound")
    if not any(device.partially_bound for device in devices):
        print(
            "no: no Vulkan device has descriptorBindingPartiallyBound, which SAPIEN needs; "
            "`make vulkan` installs a CPU driver that has it"
        )
        return 1
    if arguments.render:
        try:
            render_one_picture()
        except (ImportError, RuntimeError) as error:
            print(f"no: SAPIEN cannot render: {error}")
            return 1
        print("yes: SAPIEN rendered a picture")
    else:
        print("yes: there is a Vulkan device that SAPIEN can use")
    return 0


if __name__ == "__main__":
    sys.exit(main())
