# SPDX-License-Identifier: GPL-3.0-or-later
"""The fields of a foreign JSON object, each checked as it is taken."""

from collections.abc import Sequence
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

from ..errors import HoloreelError
from ..files import finite


class Fields:
    """A JSON object of a foreign file, and the ways to take something from it or say what is wrong with it."""

    def __init__(self, path: Path, at: str, value: Any) -> None:
        self.path, self.at = path, at
        if not isinstance(value, dict):
            raise HoloreelError(f"{path}: '{at}' is not an object; write the reel again.")
        self.value: dict[str, Any] = value

    def demand(self, right: bool, name: str, value: Any, wanted: str) -> None:
        """Raise `HoloreelError` unless `right`: the field is `value`, not `wanted`."""
        if not right:
            shown = repr(value)
            shown = shown if len(shown) < 80 else f"{shown[:76]} ..."
            name = f"{self.at}.{name}".lstrip(".")
            raise HoloreelError(f"{self.path}: '{name}' is {shown}, not {wanted}; correct it or write the reel again.")

    def part(self, name: str) -> "Fields":
        """Return the object of a name."""
        return Fields(self.path, f"{self.at}.{name}".lstrip("."), self.value.get(name))

    def parts(self, name: str, most: int) -> list["Fields"]:
        """Return the objects of a list of 1 to `most`."""
        value = self.value.get(name)
        right = isinstance(value, list) and 1 <= len(value) <= most
        self.demand(right, name, value, f"a list of 1 to {most} objects")
        at = f"{self.at}.{name}".lstrip(".")
        return [Fields(self.path, f"{at}[{index}]", part) for index, part in enumerate(value or ())]

    def whole(self, name: str, low: int, high: int) -> int:
        """Return a whole number from `low` to `high`."""
        value = self.value.get(name)
        right = isinstance(value, int) and not isinstance(value, bool) and low <= value <= high
        self.demand(right, name, value, str(low) if low == high else f"a whole number from {low} to {high}")
        return int(value or 0)

    def number(self, name: str, low: float, high: float) -> float:
        """Return a number from `low` to `high`."""
        value = finite(self.value.get(name))
        right = value is not None and low <= value <= high
        self.demand(right, name, self.value.get(name), f"a number from {low:g} to {high:g}")
        return value or 0.0

    def numbers(self, name: str, count: int) -> tuple[float, ...]:
        """Return a list of `count` finite numbers."""
        value = self.value.get(name)
        parts = [finite(part) for part in value] if isinstance(value, list | tuple) and len(value) == count else [None]
        self.demand(None not in parts, name, value, f"{count} finite numbers")
        return tuple(part or 0.0 for part in parts)

    def triple(self, name: str) -> tuple[float, float, float]:
        """Return three finite numbers."""
        x, y, z = self.numbers(name, 3)
        return x, y, z

    def choice(self, name: str, among: Sequence[Any]) -> Any:
        """Return one of several words."""
        value = self.value.get(name)
        self.demand(isinstance(value, str) and value in among, name, value, f"one of {', '.join(among)}")
        return value

    def digest(self, name: str) -> str:
        """Return a SHA-256 in hexadecimal digits."""
        value = self.value.get(name)
        right = isinstance(value, str) and len(value) == 64 and set(value) <= set("0123456789abcdef")
        self.demand(right, name, value, "a SHA-256 of 64 digits")
        return str(value)

    def file(self, name: str) -> str:
        """Return a path that cannot leave the file's folder, on any system."""
        value = self.value.get(name)
        plain = isinstance(value, str) and value and "\\" not in value and "\0" not in value
        safe = plain and not PureWindowsPath(str(value)).drive and not PurePosixPath(str(value)).is_absolute()
        self.demand(bool(safe) and ".." not in PurePosixPath(str(value)).parts, name, value, "a path below the reel")
        return str(value)
