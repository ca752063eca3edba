# SPDX-License-Identifier: GPL-3.0-or-later
"""An HTML page that shows pictures, figures and numbers side by side; its files lie beside it."""

from dataclasses import dataclass
from pathlib import Path

from ..files import atomic_path


@dataclass(frozen=True)
class Card:
    """One number worth a glance."""

    label: str
    value: str
    note: str = ""


@dataclass(frozen=True)
class Picture:
    """A picture by its path relative to the page."""

    title: str
    file: str
    note: str = ""


@dataclass(frozen=True)
class Row:
    """Pictures to compare, side by side."""

    caption: str
    pictures: tuple[Picture, ...]


@dataclass(frozen=True)
class Table:
    """Numbers in columns."""

    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Section:
    """A headed part of the page; what it has is shown in this order."""

    title: str
    text: str = ""
    rows: tuple[Row, ...] = ()
    figures: tuple[Picture, ...] = ()
    table: Table | None = None


@dataclass(frozen=True)
class Report:
    """A whole page."""

    title: str
    intro: str
    cards: tuple[Card, ...] = ()
    sections: tuple[Section, ...] = ()
    footer: str = ""
    pixelated: bool = False


def write_report(path: Path, report: Report) -> None:
    """Write the page; everything in it is escaped."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent), autoescape=True, trim_blocks=True, lstrip_blocks=True
    )
    with atomic_path(path) as temporary:
        temporary.write_text(environment.get_template("page.html").render(report=report), encoding="utf-8")
