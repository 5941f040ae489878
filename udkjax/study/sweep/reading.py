"""Reads values of a TOML file, and gathers what is wrong with them, each mistake under the path of its entry."""

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from udkjax.scene.checks import Mistakes, abbreviate, quote, suggestion
from udkjax.study.choices import choice


class GridError(Mistakes):
    """A file cannot be the grid of a sweep. `problems` lists every mistake, each with the path of the offending entry."""

    subject = "grid"


class Reader:
    """Reads the values of one file. What is not as it should be becomes one of `problems`, and None or something empty."""

    def __init__(self):
        self.problems: list[str] = []

    def wrong(self, place: str, problem: str) -> None:
        """Note a mistake."""
        self.problems.append(f"{place}: {problem}")

    def known(self, place: str, given: Mapping[str, Any], expected: Iterable[str]) -> None:
        """Note the keys of a table that are not expected."""
        expected = tuple(expected)
        for key in given:
            if key not in expected:
                self.wrong(f"{place}.{key_of(key)}" if place else key_of(key), f"unknown key{suggestion(key, expected)}")

    def choice(self, place: str, setting: str, given: Any) -> Any:
        """Read one of the choices of a run."""
        try:
            return choice(setting, given)
        except (TypeError, ValueError) as error:
            self.wrong(place, str(error))
            return None

    def table(self, place: str, given: Any) -> Mapping[str, Any]:
        """Read a table."""
        if isinstance(given, dict):
            return given
        self.wrong(place, f"must be a table, is {abbreviate(given)}")
        return {}

    def names(self, place: str, given: Any) -> tuple[str, ...]:
        """Read a name or a list of names."""
        names = [given] if isinstance(given, str) else given
        if isinstance(names, list) and names and all(isinstance(name, str) for name in names):
            return tuple(names)
        self.wrong(place, f"must be a list of names, is {abbreviate(given)}")
        return ()

    def number(self, place: str, given: Any) -> float | None:
        """Read a finite number."""
        if isinstance(given, int | float) and not isinstance(given, bool) and math.isfinite(given):
            return float(given)
        self.wrong(place, f"must be a finite number, is {abbreviate(given)}")
        return None

    def whole(self, place: str, given: Any, least: int) -> int | None:
        """Read a whole number."""
        if isinstance(given, int) and not isinstance(given, bool) and given >= least:
            return given
        self.wrong(place, "missing" if given is None else f"must be a whole number from {least} on, is {abbreviate(given)}")
        return None

    def numbers(self, place: str, given: Any) -> np.ndarray | None:
        """Read a list of finite numbers, or of such lists."""
        try:
            values = np.array(given)
        except ValueError:
            values = np.array(None)
        if values.dtype.kind in "iuf" and values.ndim and np.isfinite(values).all():
            return values.astype(float)
        self.wrong(place, f"must be a list of finite numbers, is {abbreviate(given)}")
        return None


def key_of(name: str) -> str:
    """A key as a TOML file shows it."""
    return name if name.replace("_", "").replace("-", "").isalnum() else quote(name)
