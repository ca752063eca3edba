# SPDX-License-Identifier: GPL-3.0-or-later
"""PLY vertex tables: layout to the byte, round trips, and files that are not whole."""

import struct
from pathlib import Path

import numpy as np
import pytest
from holoreel.core.errors import HoloreelError
from holoreel.core.plyfile import read_header, read_vertices, write_vertices

COLUMNS = [("x", "<f4"), ("y", "<f4"), ("red", "u1"), ("id", "<i4"), ("w", "<f8")]
HEADER = (
    b"ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
    b"property uchar red\nproperty int id\nproperty double w\nend_header\n"
)


def rows() -> list[tuple[float, float, int, int, float]]:
    """Values that say where they belong: column.row."""
    return [(1 + r / 10, 2 + r / 10, 30 + r, 400 + r, 5 + r / 10) for r in range(3)]


def whole_file() -> bytes:
    return HEADER + b"".join(struct.pack("<ffBid", *row) for row in rows())


def test_layout_is_exact(tmp_path: Path) -> None:
    write_vertices(tmp_path / "a.ply", np.array(rows(), COLUMNS))
    assert (tmp_path / "a.ply").read_bytes() == whole_file()
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]


def test_round_trip_from_unpacked_and_foreign_order(tmp_path: Path) -> None:
    table = np.array(rows(), np.dtype(COLUMNS, align=True).newbyteorder(">"))
    write_vertices(tmp_path / "a.ply", table, comments=("made here",))
    back = read_vertices(tmp_path / "a.ply")
    assert back.dtype.names == table.dtype.names
    assert all(np.array_equal(back[name], table[name]) for name in back.dtype.names)
    assert read_header(tmp_path / "a.ply").comments == ("made here",)


@pytest.mark.parametrize("kind", ["ascii", "binary_big_endian"])
def test_other_formats_and_faces_after(tmp_path: Path, kind: str) -> None:
    header = HEADER.replace(b"binary_little_endian", kind.encode()).replace(
        b"end_header", b"element face 1\nproperty list uchar int vertex_indices\nend_header"
    )
    if kind == "ascii":
        body = "".join(" ".join(map(str, row)) + "\n" for row in rows()).encode() + b"3 0 1 2\n"
    else:
        body = b"".join(struct.pack(">ffBid", *row) for row in rows()) + struct.pack(">Biii", 3, 0, 1, 2)
    (tmp_path / "a.ply").write_bytes(header + body)
    back = read_vertices(tmp_path / "a.ply")
    assert back["id"].tolist() == [400, 401, 402]
    assert np.allclose(back["w"], [5, 5.1, 5.2])
    assert back["x"].dtype.isnative


def test_empty_table(tmp_path: Path) -> None:
    write_vertices(tmp_path / "a.ply", np.empty(0, COLUMNS))
    assert read_vertices(tmp_path / "a.ply").shape == (0,)


def test_every_truncation_is_refused(tmp_path: Path) -> None:
    data = whole_file()
    for size in range(len(data)):
        (tmp_path / "a.ply").write_bytes(data[:size])
        with pytest.raises(HoloreelError, match=r"a\.ply"):
            read_vertices(tmp_path / "a.ply")


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"element vertex 3", b"element vertex 99999999999999999999999999"),
        (b"element vertex 3", b"element vertex -3"),
        (b"element vertex 3", b"element vertex 2"),
        (b"element vertex 3", b"element vertex many"),
        (b"property float y", b"property float x"),
        (b"property float y", b"property half y"),
        (b"property float y", b"property list uchar int y"),
        (b"format binary_little_endian 1.0", b"format binary_little_endian 2.0"),
        (b"element vertex 3", b"element edge 3\nproperty int a\nelement vertex 3"),
        (b"ply\n", b"plx\n"),
        (b"end_header\n", b""),
        (b"format binary_little_endian 1.0\n", b""),
    ],
)
def test_wrong_headers_are_refused(tmp_path: Path, old: bytes, new: bytes) -> None:
    (tmp_path / "a.ply").write_bytes(whole_file().replace(old, new))
    with pytest.raises(HoloreelError, match=r"a\.ply"):
        read_vertices(tmp_path / "a.ply")


def test_ascii_with_words_or_missing_rows(tmp_path: Path) -> None:
    header = HEADER.replace(b"binary_little_endian", b"ascii")
    for body in (b"1 2 3 4 5\n" * 2 + b"\n" * 20, b"1 2 3 4 a\n" * 3, b"1 2 3 4\n" * 4):
        (tmp_path / "a.ply").write_bytes(header + body)
        with pytest.raises(HoloreelError, match=r"a\.ply"):
            read_vertices(tmp_path / "a.ply")


def test_unwritable_place(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(HoloreelError, match="cannot be written"):
        write_vertices(tmp_path / "file" / "a.ply", np.empty(0, COLUMNS))
    with pytest.raises(HoloreelError, match="cannot be read"):
        read_vertices(tmp_path / "nothing.ply")
