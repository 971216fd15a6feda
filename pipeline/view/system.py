"""Check for system libraries, Vulkan driver and display, which open3d needs in addition to its wheel.

The check comes first, because open3d's renderer ends the whole process if one of them is missing.
"""

from __future__ import annotations

import ctypes
import os
import re
from typing import Any

from pipeline.core.errors import MissingLibraryError

__all__ = ["import_open3d", "require_display", "require_renderer"]

# Debian's and Ubuntu's packages of the libraries that open3d 0.20 links.
_PACKAGES = {
    "libEGL.so.1": "libegl1",
    "libGL.so.1": "libgl1",
    "libX11.so.6": "libx11-6",
    "libidn2.so.0": "libidn2-0",
    "libudev.so.1": "libudev1",
    "libusb-1.0.so.0": "libusb-1.0-0",
}
_DRIVER = "libvulkan1 mesa-vulkan-drivers"  # the second also draws on the CPU
_INSTANCE_CREATE_INFO = 1  # VkStructureType


def import_open3d() -> Any:
    """The module open3d; MissingLibraryError if a system library that it links is not installed."""
    try:
        import open3d  # noqa: PLC0415 - its failure is what is asked for
    except (ImportError, OSError) as err:
        missing = re.match(r"(lib\S+\.so[.\d]*): cannot open shared object file", str(err))
        if missing is None:
            raise
        library = missing[1]
        raise MissingLibraryError("open3d", library, _PACKAGES.get(library, "")) from err
    return open3d


def require_renderer() -> None:
    """Check for a Vulkan driver, which open3d draws with; MissingLibraryError if there is none."""
    try:
        vulkan = ctypes.CDLL("libvulkan.so.1")
    except OSError as err:
        raise MissingLibraryError("open3d", "libvulkan.so.1", _DRIVER) from err
    instance, count = ctypes.c_void_p(), ctypes.c_uint32()
    info = (ctypes.c_uint64 * 8)(_INSTANCE_CREATE_INFO)  # VkInstanceCreateInfo without layers and extensions
    if vulkan.vkCreateInstance(ctypes.byref(info), None, ctypes.byref(instance)) == 0:
        vulkan.vkEnumeratePhysicalDevices(instance, ctypes.byref(count), None)
        vulkan.vkDestroyInstance(instance, None)
    if not count.value:
        raise MissingLibraryError("open3d", "a Vulkan driver", _DRIVER)


def require_display() -> None:
    """Check for a display that a window can open on; MissingLibraryError, naming --out, if none."""
    if os.environ.get("WAYLAND_DISPLAY"):
        return
    try:
        x11 = ctypes.CDLL("libX11.so.6")
    except OSError as err:
        raise MissingLibraryError("open3d", "libX11.so.6", _PACKAGES["libX11.so.6"]) from err
    x11.XOpenDisplay.restype = ctypes.c_void_p
    display = x11.XOpenDisplay(None)
    if not display:
        raise MissingLibraryError("the window", "a display (DISPLAY)", "", "draw without one: --out FILE.png")
    x11.XCloseDisplay(ctypes.c_void_p(display))
