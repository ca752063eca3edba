# SPDX-License-Identifier: GPL-3.0-or-later
"""Spacetime Gaussians in PLY files, in the layout that the paper's authors write. Needs numpy only.

One element `vertex`, all properties `float`, in this order (lite: 32 floats, full: 38). Values are raw, as in
`SpacetimeGaussians`; colors of a lite model are plain RGB, not harmonics:

    x y z, trbf_center, trbf_scale, nx ny nz (zeros), motion_0..8 (linear, quadratic, cubic xyz),
    f_dc_0..2 (lite) or f_dc_0..5 (full: base, direction), opacity, scale_0..2, rot_0..3 (w x y z), omega_0..3,
    f_t_0..2 (full only; the network that goes with it lies in a file of its own, see `decoder`)

Ordinary 3D Gaussian Splatting files (`f_dc`, `opacity`, `scale`, `rot` without motion) are read as well: as Gaussians
that stand still and are always visible, colored by the constant band of their harmonics.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import HoloreelError
from ..plyfile import read_vertices, write_vertices
from .model import ALWAYS_LOG_SCALE, SpacetimeGaussians, rows

SH_C0 = 0.28209479177387814  # the constant spherical harmonic, 1 / (2 √π)

# (parameter, or None for zeros; the properties that hold its columns)
_Column = tuple[str | None, tuple[str, ...]]


def _numbered(prefix: str, count: int) -> tuple[str, ...]:
    return tuple(f"{prefix}_{number}" for number in range(count))


_HEAD: list[_Column] = [
    ("means", ("x", "y", "z")),
    ("trbf_centers", ("trbf_center",)),
    ("trbf_log_scales", ("trbf_scale",)),
    (None, ("nx", "ny", "nz")),
    ("motions", _numbered("motion", 9)),
]
_TAIL: list[_Column] = [
    ("opacity_logits", ("opacity",)),
    ("log_scales", _numbered("scale", 3)),
    ("quats", _numbered("rot", 4)),
    ("omegas", _numbered("omega", 4)),
]
LAYOUTS: dict[str, list[_Column]] = {
    "lite": [*_HEAD, ("features", _numbered("f_dc", 3)), *_TAIL],
    "full": [*_HEAD, ("features", _numbered("f_dc", 6)), *_TAIL, ("features", _numbered("f_t", 3))],
}
_STATIC = ("opacity_logits", "log_scales", "quats")


def read_ply(path: str | Path) -> tuple[SpacetimeGaussians, list[str]]:
    """Read a lite, full or ordinary Gaussian PLY; return the model and sentences about what is unusual.

    Rows with NaN, infinite or unusable values are left out and reported. Raises `HoloreelError` for a file that is not
    a whole PLY, lacks a property, or has no usable row.
    """
    path = Path(path)
    table = read_vertices(path)
    names = set(table.dtype.names or ())
    report: list[str] = []
    if {"trbf_center", "trbf_scale"} & names:
        gaussians = _spacetime(path, table, "full" if {"f_t_0", "f_dc_3"} & names else "lite")
    elif "f_dc_0" in names:
        gaussians = _static(path, table)
        report.append(
            f"{path.name} is an ordinary 3D Gaussian PLY: it stands still, and colors do not depend on the view."
        )
    else:
        raise HoloreelError(
            f"{path} is a PLY of plain points: it lacks trbf_center, f_dc_0 and the other properties of Gaussians; "
            "train it first, or give the point_cloud.ply of a trained model."
        )
    return usable_rows(path, gaussians, report), report


def write_ply(path: str | Path, gaussians: SpacetimeGaussians) -> None:
    """Write the authors' lite or full layout, atomically; no comments, since viewers count header lines."""
    layout = LAYOUTS[gaussians.variant]
    names = [name for _, columns in layout for name in columns]
    table = np.zeros(len(gaussians), dtype=[(name, "f4") for name in names])
    feature = 0
    for parameter, columns in layout:
        if parameter is None:
            continue
        values = gaussians.columns(parameter)
        if parameter == "features":  # split over f_dc and f_t
            values, feature = values[:, feature : feature + len(columns)], feature + len(columns)
        for name, column in zip(columns, values.T, strict=True):
            table[name] = column
    write_vertices(path, table)


def usable_rows(path: Path, gaussians: SpacetimeGaussians, report: list[str]) -> SpacetimeGaussians:
    """Leave out unusable rows and report their number; raises `HoloreelError` where nothing is left."""
    good = gaussians.without_bad_rows()
    if len(gaussians) == 0:
        raise HoloreelError(f"{path} holds no Gaussians: give a file with at least one.")
    if len(good) == 0:
        raise HoloreelError(f"{path} has NaN or unusable values in all of its {rows(len(gaussians))}: export it again.")
    if left_out := len(gaussians) - len(good):
        report.append(f"{rows(left_out)} of {len(gaussians):,} left out: NaN, infinite or unusable values.")
    return good


def _spacetime(path: Path, table: NDArray[np.void], variant: str) -> SpacetimeGaussians:
    parts: dict[str, list[NDArray[np.float32]]] = {}
    for parameter, columns in LAYOUTS[variant]:
        if parameter is not None:
            parts.setdefault(parameter, []).append(
                _columns(path, table, columns, f"a {variant} Spacetime Gaussian PLY")
            )
    return _model({name: np.concatenate(values, axis=1) for name, values in parts.items()})


def _static(path: Path, table: NDArray[np.void]) -> SpacetimeGaussians:
    what = "a 3D Gaussian PLY"
    values = {
        parameter: _columns(path, table, columns, what)
        for parameter, columns in LAYOUTS["lite"]
        if parameter in ("means", *_STATIC)
    }
    count = len(table)
    harmonics = _columns(path, table, _numbered("f_dc", 3), what)
    # Viewers of such files clip below, not above.
    values["features"] = np.maximum(0.5 + SH_C0 * harmonics, 0.0)
    values["motions"] = np.zeros((count, 9), np.float32)
    values["omegas"] = np.zeros((count, 4), np.float32)
    values["trbf_centers"] = np.full((count, 1), 0.5, np.float32)
    values["trbf_log_scales"] = np.full((count, 1), ALWAYS_LOG_SCALE, np.float32)
    return _model(values)


def _columns(path: Path, table: NDArray[np.void], names: tuple[str, ...], what: str) -> NDArray[np.float32]:
    """Return the properties `names` as (N, len(names)) float32."""
    for name in names:
        if name not in (table.dtype.names or ()):
            raise HoloreelError(f"{path} lacks the property '{name}' of {what}: export it again with all properties.")
    with np.errstate(over="ignore"):  # a double beyond float32 becomes infinite, and its row unusable
        return np.stack([table[name].astype(np.float32) for name in names], axis=1)


def _model(values: dict[str, NDArray[np.float32]]) -> SpacetimeGaussians:
    count = len(values["means"])
    shapes = {
        "motions": (count, 3, 3),
        "opacity_logits": (count,),
        "trbf_centers": (count,),
        "trbf_log_scales": (count,),
    }
    return SpacetimeGaussians(**{name: array.reshape(shapes.get(name, array.shape)) for name, array in values.items()})
