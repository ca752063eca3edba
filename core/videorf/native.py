# SPDX-License-Identifier: GPL-3.0-or-later
"""The compiled march as ctypes sees it: structures, signatures, threads."""

import ctypes
import functools
import os
import sys
from ctypes import POINTER, Structure, c_char_p, c_double, c_float, c_int, c_int32, c_int64, c_uint32, c_void_p
from pathlib import Path

from ..errors import HoloreelError
from ..render.native import available_cores

ABI = 4  # VIDEORF_ABI in kernels/api.hpp


class CLattice(Structure):
    """`VideorfLattice`."""

    _fields_ = (
        ("shape", c_int32 * 3),
        ("rows", c_int32),
        ("lowest", c_double * 3),
        ("spacing", c_double),
        ("lookup", c_void_p),
    )


class CRays(Structure):
    """`VideorfRays`."""

    _fields_ = (
        ("count", c_int64),
        *((name, c_void_p) for name in ("origins", "directions", "jitter")),
        ("step", c_double),
        ("transmittance_min", c_double),
    )


class CImages(Structure):
    """`VideorfImages`, and `VideorfImageGradients`, which is laid out alike."""

    _fields_ = (("accumulated", c_void_p), ("depth", c_void_p))


class CNetwork(Structure):
    """`VideorfNetwork`."""

    _fields_ = (("features", c_int32), ("frequencies", c_int32), ("hidden", c_int32), ("weights", c_void_p))


class CView(Structure):
    """`VideorfView`."""

    _fields_ = (
        ("width", c_int32),
        ("height", c_int32),
        ("origins", c_void_p),
        ("directions", c_void_p),
        ("step", c_double),
        ("transmittance_min", c_double),
        ("forward", c_float * 3),
        ("background", c_float * 3),
    )


class CPicture(Structure):
    """`VideorfPicture`."""

    _fields_ = (("image", c_void_p), ("alpha", c_void_p), ("depth", c_void_p))


class CStep(Structure):
    """`VideorfStep`."""

    _fields_ = (
        *((name, c_int64) for name in ("rows", "count")),
        *((name, c_int32) for name in ("channels", "neighbors")),
        *((name, c_void_p) for name in ("values", "mean", "square", "gradient", "previous", "near", "kinds")),
        *((name, c_void_p) for name in ("step", "rates", "low", "high")),
        ("weights", c_double * 4),
        *((name, c_double) for name in ("temporal", "beta1", "beta2", "epsilon")),
    )


_SIGNATURES = {
    "videorf_abi": (c_int, ()),
    "videorf_last_error": (c_char_p, ()),
    "videorf_set_threads": (None, (c_int,)),
    "videorf_get_threads": (c_int, ()),
    "videorf_set_lanes": (c_int, (c_int,)),
    "videorf_volume_new": (c_void_p, (POINTER(CLattice),)),
    "videorf_volume_free": (None, (c_void_p,)),
    "videorf_volume_cells": (c_int64, (c_void_p,)),
    "videorf_forward": (
        c_int,
        (c_void_p, c_void_p, c_int32, POINTER(CRays), POINTER(CImages), POINTER(c_int64), POINTER(c_void_p)),
    ),
    "videorf_backward": (c_int, (c_void_p, POINTER(CImages), c_void_p)),
    "videorf_tape_free": (None, (c_void_p,)),
    "videorf_draw": (
        c_int,
        (c_void_p, c_void_p, c_int32, POINTER(CNetwork), POINTER(CView), POINTER(CPicture)),
    ),
    "videorf_optimize": (c_int, (POINTER(CStep),)),
    "videorf_add_noise": (c_int, (c_void_p, c_int64, c_int32, c_void_p, c_uint32, c_void_p)),
}


@functools.cache
def load_kernels() -> ctypes.CDLL:
    """Load the compiled march and set its number of threads: HOLOREEL_THREADS, or one per available core.

    Raises HoloreelError if it is not there, cannot be loaded, or is of another version than this code.
    """
    remedy = "install a C++17 compiler and run `pip install -e .` in Holoreel's folder."
    folders = [Path(folder) for folder in sys.modules[__package__].__path__]
    names = ("holoreel_videorf.so", "holoreel_videorf.dylib", "holoreel_videorf.dll")
    found = [folder / name for folder in folders for name in names if (folder / name).is_file()]
    if not found:
        raise HoloreelError(f"The compiled ray march (holoreel_videorf) was not found: {remedy}")
    try:
        library = ctypes.CDLL(str(found[0]))
        for name, (result, arguments) in _SIGNATURES.items():
            function = getattr(library, name)
            function.restype, function.argtypes = result, arguments
            if name == "videorf_abi" and library.videorf_abi() != ABI:
                raise HoloreelError(f"{found[0]} is of another version than this code: {remedy}")
    except (OSError, AttributeError) as error:
        raise HoloreelError(f"{found[0]} cannot be loaded ({error}): {remedy}") from error
    wanted = os.environ.get("HOLOREEL_THREADS", "")
    library.videorf_set_threads(int(wanted) if wanted.isdigit() and int(wanted) else available_cores())
    return library


def set_threads(count: int) -> None:
    """Set how many threads the march uses, the calling one included."""
    if count < 1:
        raise ValueError("the number of threads must be 1 or more")
    load_kernels().videorf_set_threads(count)


def get_threads() -> int:
    """Return how many threads the march uses."""
    return load_kernels().videorf_get_threads()


def set_lanes(lanes: int) -> int:
    """Choose the march by vector width: 8 (AVX2 and FMA), 4 (SSE4.1 or NEON), or 0 for the best this machine has.

    Returns the width in use from now on. Raises HoloreelError where the machine or the build does not have it.
    """
    used = load_kernels().videorf_set_lanes(lanes)
    if used == 0:
        raise HoloreelError(f"This machine or build has no ray march of {lanes} lanes; take 4, or 0 for the best.")
    return used


def call(name: str, *arguments: object) -> None:
    """Call a kernel; raise `HoloreelError` with its reason where it declines."""
    library = load_kernels()
    if getattr(library, name)(*arguments) != 0:
        raise HoloreelError(f"The kernel {name} declines: {library.videorf_last_error().decode()}.")
