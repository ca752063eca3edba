# SPDX-License-Identifier: GPL-3.0-or-later
"""The compiled kernels as ctypes sees them: structures, signatures, threads. Needs neither numpy nor torch."""

import ctypes
import functools
import os
import sys
from ctypes import POINTER, Structure, c_char_p, c_double, c_int, c_int32, c_int64, c_void_p
from pathlib import Path

from ..errors import HoloreelError

ABI = 8  # HOLOREEL_ABI in kernels/api.hpp


class CCamera(Structure):
    """`HoloreelCamera`."""

    _fields_ = (
        *((name, c_double) for name in ("fx", "fy", "cx", "cy")),
        ("world_to_camera", c_double * 12),
        ("width", c_int32),
        ("height", c_int32),
    )


class CRules(Structure):
    """`HoloreelRules`."""

    _fields_ = (
        *(
            (name, c_double)
            for name in ("alpha_max", "alpha_min", "transmittance_min", "low_pass", "near", "jacobian_clamp")
        ),
        ("detach_motion_time", c_int32),
        ("cull_faded", c_int32),
    )


# The arrays of a Gaussian in the order of the C structures.
PARAMETERS = (
    "means",
    "motions",
    "quats",
    "omegas",
    "scales",
    "opacities",
    "features",
    "trbf_centers",
    "trbf_log_scales",
)


class CGaussians(Structure):
    """`HoloreelGaussians`."""

    _fields_ = (
        ("count", c_int64),
        ("channels", c_int32),
        ("spacetime", c_int32),
        ("time", c_double),
        *((name, c_void_p) for name in PARAMETERS),
        ("rows", c_void_p),
        ("listed", c_int64),
    )


class CImages(Structure):
    """`HoloreelImages`."""

    _fields_ = tuple((name, c_void_p) for name in ("features", "alpha", "depth", "transmittance", "background"))


class CImageGradients(Structure):
    """`HoloreelImageGradients`."""

    _fields_ = tuple((name, c_void_p) for name in ("features", "alpha", "depth"))


class CGradients(Structure):
    """`HoloreelGradients`."""

    _fields_ = tuple(
        (name, c_void_p) for name in (*PARAMETERS, "density_gradient", "density_views", "density_radius_px")
    )


class CDecoder(Structure):
    """`HoloreelDecoder`."""

    _fields_ = (("hidden", c_void_p), ("output", c_void_p), ("activation", c_int32), ("unused", c_int32))


class CWarp(Structure):
    """`HoloreelWarp`."""

    _fields_ = (
        *((name, c_void_p) for name in ("places", "valid", "spans")),
        *((name, c_int32) for name in ("width", "height", "source_width", "source_height", "channels", "samples")),
    )


class CAdamGroup(Structure):
    """`HoloreelAdamGroup`."""

    _fields_ = (
        *((n, c_void_p) for n in ("values", "gradient", "mean", "mean_square", "row_rates", "column_rates")),
        *((name, c_int64) for name in ("rows", "columns")),
        *((name, c_double) for name in ("rate", "low", "high")),
    )


TIMINGS = ("project", "sort", "bin", "blend", "backward_blend", "backward_gather")


class CTimings(Structure):
    """`HoloreelTimings`, in seconds."""

    _fields_ = tuple((name, c_double) for name in TIMINGS)


_SIGNATURES = {
    "holoreel_kernels_abi": (c_int, ()),
    "holoreel_last_error": (c_char_p, ()),
    "holoreel_set_threads": (None, (c_int,)),
    "holoreel_get_threads": (c_int, ()),
    "holoreel_set_lanes": (c_int, (c_int,)),
    "holoreel_forward": (c_void_p, (POINTER(CGaussians), POINTER(CCamera), POINTER(CRules), POINTER(CImages))),
    "holoreel_backward": (
        c_int,
        (
            c_void_p,
            POINTER(CGaussians),
            POINTER(CCamera),
            POINTER(CRules),
            POINTER(CImages),
            POINTER(CImageGradients),
            POINTER(CGradients),
        ),
    ),
    "holoreel_l1_dssim": (
        c_int,
        (*[c_void_p] * 3, *[c_int] * 3, c_double, POINTER(c_double), POINTER(c_double), c_void_p),
    ),
    "holoreel_decode": (c_int, (POINTER(CCamera), POINTER(CDecoder), c_void_p, c_void_p)),
    "holoreel_decode_backward": (c_int, (POINTER(CCamera), POINTER(CDecoder), *[c_void_p] * 5)),
    "holoreel_warp_spans": (c_int, (POINTER(CWarp), c_void_p)),
    "holoreel_warp": (c_int, (POINTER(CWarp), c_void_p, c_void_p)),
    "holoreel_warp_backward": (c_int, (POINTER(CWarp), c_void_p, c_void_p)),
    "holoreel_adam_step": (c_int, (POINTER(CAdamGroup), c_int64, *[c_double] * 3, c_int64)),
    "holoreel_frame_free": (None, (c_void_p,)),
    "holoreel_frame_intersections": (c_int64, (c_void_p,)),
    "holoreel_frame_visible": (c_int64, (c_void_p,)),
    "holoreel_frame_timings": (None, (c_void_p, POINTER(CTimings))),
}


def library_folders() -> list[Path]:
    """Where the library may lie: an editable install keeps it in site-packages and the sources in the repository."""
    return [Path(folder) for folder in sys.modules[__package__].__path__]


def available_cores() -> int:
    """Return how many cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@functools.cache
def load_kernels() -> ctypes.CDLL:
    """Load the compiled kernels and set their number of threads: HOLOREEL_THREADS, or one per available core.

    Raises HoloreelError if they are not there, cannot be loaded, or are of another version than this code.
    """
    remedy = "install a C++17 compiler and run `pip install -e .` in Holoreel's folder."
    names = ("holoreel_kernels.so", "holoreel_kernels.dylib", "holoreel_kernels.dll")
    found = [folder / name for folder in library_folders() for name in names if (folder / name).is_file()]
    if not found:
        raise HoloreelError(f"The compiled kernels (holoreel_kernels) were not found: {remedy}")
    try:
        library = ctypes.CDLL(str(found[0]))
        for name, (result, arguments) in _SIGNATURES.items():
            function = getattr(library, name)
            function.restype, function.argtypes = result, arguments
            if name == "holoreel_kernels_abi" and library.holoreel_kernels_abi() != ABI:
                raise HoloreelError(f"{found[0]} is of another version than this code: {remedy}")
    except (OSError, AttributeError) as error:
        raise HoloreelError(f"{found[0]} cannot be loaded ({error}): {remedy}") from error
    library.holoreel_set_threads(_threads_wanted())
    return library


def _threads_wanted() -> int:
    text = os.environ.get("HOLOREEL_THREADS", "")
    if not text:
        return available_cores()
    if not text.isdigit() or int(text) < 1:
        raise HoloreelError(f"HOLOREEL_THREADS is '{text}'; set it to a number of threads, 1 or more, or unset it.")
    return int(text)


def set_threads(count: int) -> None:
    """Set how many threads the kernels use, the calling one included."""
    if count < 1:
        raise ValueError("the number of threads must be 1 or more")
    load_kernels().holoreel_set_threads(count)


def get_threads() -> int:
    """Return how many threads the kernels use."""
    return load_kernels().holoreel_get_threads()


def set_lanes(lanes: int) -> int:
    """Choose the kernels by vector width: 8 (AVX2 and FMA), 4 (SSE4.1 or NEON), or 0 for the best this machine has.

    Returns the width in use from now on. Raises HoloreelError where the machine or the build does not have it.
    """
    used = load_kernels().holoreel_set_lanes(lanes)
    if used == 0:
        raise HoloreelError(
            f"This machine or build has no kernels of {lanes} lanes; take 4, or 0 for the best there are."
        )
    return used
