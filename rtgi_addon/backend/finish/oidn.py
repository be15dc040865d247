# SPDX-License-Identifier: GPL-3.0-or-later
"""Intel Open Image Denoise 2.x through its C API, by ctypes: find the shared library, open it once, filter images.

Blender's own copy serves; the caller says in which folders to look. That copy is built without weights for the
"RTLightmap" filter (bpy 4.5, 5.0 and 5.2), so the ray-tracing filter "RT" is the default: on light maps it is as good.
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from ..scene import Float32

_CPU = 1  # OIDN_DEVICE_TYPE_CPU: GPUs give other bits
_FLOAT3 = 3  # OIDN_FORMAT_FLOAT3
_QUALITY_FAST = 4  # OIDN_QUALITY_FAST
#: Above this much memory OIDN cuts the image into tiles (same bits, measured). Its own default follows the machine.
_MEMORY_MB = 2048
_NAMES = {
    "win32": ("OpenImageDenoise.dll",),
    "darwin": ("libOpenImageDenoise.2.dylib", "libOpenImageDenoise.2.*.dylib", "libOpenImageDenoise.dylib"),
}
_NAMES_ELSEWHERE = ("libOpenImageDenoise.so.2", "libOpenImageDenoise.so.2.*", "libOpenImageDenoise.so")

_SIZE, _HANDLE, _TEXT = ctypes.c_size_t, ctypes.c_void_p, ctypes.c_char_p
_SIGNATURES: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "oidnNewDevice": (_HANDLE, (ctypes.c_int,)),
    "oidnSetDeviceInt": (None, (_HANDLE, _TEXT, ctypes.c_int)),
    "oidnSetDeviceBool": (None, (_HANDLE, _TEXT, ctypes.c_bool)),
    "oidnGetDeviceInt": (ctypes.c_int, (_HANDLE, _TEXT)),
    "oidnCommitDevice": (None, (_HANDLE,)),
    "oidnReleaseDevice": (None, (_HANDLE,)),
    "oidnGetDeviceError": (ctypes.c_int, (_HANDLE, ctypes.POINTER(_TEXT))),
    "oidnNewFilter": (_HANDLE, (_HANDLE, _TEXT)),
    "oidnSetFilterBool": (None, (_HANDLE, _TEXT, ctypes.c_bool)),
    "oidnSetFilterInt": (None, (_HANDLE, _TEXT, ctypes.c_int)),
    "oidnSetFilterFloat": (None, (_HANDLE, _TEXT, ctypes.c_float)),
    "oidnSetSharedFilterImage": (
        None,
        (_HANDLE, _TEXT, _HANDLE, ctypes.c_int, _SIZE, _SIZE, _SIZE, _SIZE, _SIZE),
    ),
    "oidnCommitFilter": (None, (_HANDLE,)),
    "oidnExecuteFilter": (None, (_HANDLE,)),
    "oidnReleaseFilter": (None, (_HANDLE,)),
}


class OidnError(RuntimeError):
    """Open Image Denoise could not be loaded, or refused; its own message is in the text."""


class FilterKind(StrEnum):
    RT = "RT"  # hdr; in every build
    RT_LIGHTMAP = "RTLightmap"  # not in Blender's builds


def find_oidn(folders: Sequence[Path]) -> Path | None:
    """The first OIDN 2 library in ``folders``, in their order; None where there is none."""
    for folder in folders:
        for pattern in _NAMES.get(sys.platform, _NAMES_ELSEWHERE):
            found = sorted(path for path in Path(folder).glob(pattern) if path.is_file())
            if found:
                return found[0]
    return None


class Denoiser:
    """An open OIDN device on the CPU. Bits do not depend on ``threads`` (0: all cores); another version's may differ.

    Raises OidnError where the library cannot be loaded, is not version 2 or lacks the filter.
    """

    def __init__(
        self, library: Path, *, kind: FilterKind = FilterKind.RT, threads: int = 0, fast: bool = False
    ) -> None:
        """``fast``: a smaller network, a third off the time for a tenth more error (measured); OIDN before 2.3 has
        none and takes its only one."""
        self.library = library
        self.kind = kind
        self.fast = fast
        self._api = _load(library)
        self._filters: list[ImageFilter] = []
        self._device: int | None = self._api.oidnNewDevice(_CPU)
        self._check()
        if threads > 0:
            self._api.oidnSetDeviceInt(self._device, b"numThreads", threads)
        # Else OIDN pins its threads to cores, and with them whatever else runs there.
        self._api.oidnSetDeviceBool(self._device, b"setAffinity", False)
        self._api.oidnCommitDevice(self._device)
        self._check()
        parts = (self._api.oidnGetDeviceInt(self._device, b"version" + p) for p in (b"Major", b"Minor", b"Patch"))
        self.version = ".".join(map(str, parts))
        try:  # the weights are checked on commit only
            self.denoise(np.zeros((1, 1, 3), np.float32))
        except OidnError as error:
            self.close()
            raise OidnError(f"{library}: OIDN {self.version} has no {kind.value} filter ({error})") from error

    def denoise(self, image: Float32, *, input_scale: float | None = None) -> Float32:
        """``image`` (h, w, 3) linear, >= 0, without its noise; see :meth:`filter_of`.

        Raises ValueError for another shape and for values that are not finite, OidnError where OIDN refuses.
        """
        if image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
            raise ValueError(f"an image of shape {image.shape}: must be (h, w, 3) and not empty")
        require_finite(np.asarray(image, np.float32))
        with self.filter_of(image.shape[0], image.shape[1], input_scale=input_scale) as opened:
            opened.color[:] = image
            opened.run()
            return opened.output

    def filter_of(self, height: int, width: int, *, input_scale: float | None = None) -> ImageFilter:
        """A filter for images of one size, the caller's to close: making one takes as long as filtering 16 x 16.

        ``input_scale`` brings the values near 1, where the filter was trained; None: OIDN measures the image.
        """
        if self._device is None:
            raise ValueError("the denoiser is closed")
        handle = self._api.oidnNewFilter(self._device, self.kind.value.encode())
        self._check()
        made = ImageFilter(self, handle, height, width)
        self._filters.append(made)
        try:
            self._commit(made, input_scale)
        except OidnError:
            made.close()
            raise
        return made

    def _commit(self, made: ImageFilter, input_scale: float | None) -> None:
        handle = made.handle
        for name, array in ((b"color", made.color), (b"output", made.output)):
            height, width = array.shape[:2]
            self._api.oidnSetSharedFilterImage(handle, name, array.ctypes.data, _FLOAT3, width, height, 0, 0, 0)
        if self.kind is FilterKind.RT:  # the light-map filter is always hdr
            self._api.oidnSetFilterBool(handle, b"hdr", True)
        if input_scale is not None:
            self._api.oidnSetFilterFloat(handle, b"inputScale", input_scale)
        if self.fast:
            self._api.oidnSetFilterInt(handle, b"quality", _QUALITY_FAST)
        self._api.oidnSetFilterInt(handle, b"maxMemoryMB", _MEMORY_MB)
        self._api.oidnCommitFilter(handle)
        self._check()

    def execute(self, handle: int) -> None:
        """Run a filter of this device."""
        self._api.oidnExecuteFilter(handle)
        self._check()

    def release(self, made: ImageFilter) -> None:
        """Give back what OIDN holds for a filter of this device."""
        self._filters = [other for other in self._filters if other is not made]
        self._api.oidnReleaseFilter(made.handle)

    def _check(self) -> None:
        """Raise the error OIDN holds for this device, or for the thread where no device could be made."""
        message = _TEXT()
        if self._api.oidnGetDeviceError(self._device, ctypes.byref(message)):
            text = (message.value or b"unknown error").decode(errors="replace")
            # OIDN keeps one error at a time and raises the next on the following call: fetch until it is clean.
            while self._api.oidnGetDeviceError(self._device, ctypes.byref(message)):
                pass
            raise OidnError(f"Open Image Denoise: {text}")
        if self._device is None:
            raise OidnError("Open Image Denoise: no CPU device")

    def close(self) -> None:
        """Give device and threads back; filters that are still open are closed."""
        if self._device is not None:
            for opened in list(self._filters):
                opened.close()
            self._api.oidnReleaseDevice(self._device)
            self._device = None

    def __enter__(self) -> Denoiser:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


class ImageFilter:
    """A filter of one image size. Fill ``color`` (h, w, 3), finite and >= 0; ``run``; read ``output``."""

    def __init__(self, denoiser: Denoiser, handle: int, height: int, width: int) -> None:
        self._denoiser: Denoiser | None = denoiser
        self.handle = handle
        self.color: Float32 = np.zeros((height, width, 3), np.float32)
        self.output: Float32 = np.zeros((height, width, 3), np.float32)

    def run(self) -> None:
        """Filter ``color`` into ``output``."""
        if self._denoiser is None:
            raise ValueError("the filter is closed")
        self._denoiser.execute(self.handle)

    def close(self) -> None:
        """Give back what OIDN holds for it."""
        if self._denoiser is not None:
            self._denoiser.release(self)
            self._denoiser = None

    def __enter__(self) -> ImageFilter:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


def require_finite(values: Float32) -> None:
    """Raise ValueError where a texel of ``values`` (..., 3) is not finite, and say how many are."""
    bad = int(np.count_nonzero(~np.isfinite(values).all(axis=-1)))
    if bad:
        raise ValueError(f"{bad} of {values.size // values.shape[-1]} texels are not finite")


def _load(library: Path) -> Any:
    """The library with its functions typed."""
    try:
        api = ctypes.CDLL(str(library))
        for name, (result, arguments) in _SIGNATURES.items():
            function = getattr(api, name)
            function.restype, function.argtypes = result, arguments
    except OSError as error:
        raise OidnError(f"{library}: cannot be loaded ({error})") from error
    except AttributeError as error:
        raise OidnError(f"{library}: not Open Image Denoise 2 ({error})") from error
    return api
