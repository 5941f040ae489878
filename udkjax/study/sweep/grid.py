"""Sweeps as TOML files (grids): axes, settings and measures, read into the arguments of `udkjax.sweep`."""

import math
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypeAlias, cast

import numpy as np
from scipy import stats

from udkjax.annotations import TomlTable
from udkjax.extras import OptionalImport
from udkjax.scene.mechanism_tables import parse_toml
from udkjax.scene.tables.checks import Mistakes
from udkjax.study.choices import CHOICES, Choice, choice
from udkjax.study.quantities import InitialAngle, Length, Scaled, Setter
from udkjax.study.sweep.axes import Axis, Distribution, LatinHypercube, Random, Sobol, SweepDesign, Values, Zipped
from udkjax.wording import abbreviate, quote, suggestion, unknown_key

Toml: TypeAlias = "str | int | float | bool | list[Toml] | dict[str, Toml]"
TOP_KEYS = ("t0", "t1", "dt", "ts", "measures", "derivatives", "reference", "axes", "settings", "design")
SETTINGS = ("rtol", "atol", *CHOICES, "max_steps", "drift_tol", "dt0")
DESIGNS = {"sobol": Sobol, "latin-hypercube": LatinHypercube, "random": Random}
SCALES = {"linear": np.linspace, "log": np.geomspace}


class GridError(Mistakes):
    """A grid file is invalid. `problems` lists every mistake, each with the path of the offending entry."""

    subject = "grid"


def load_grid(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read the arguments of `udkjax.sweep`, except the mechanism, from a TOML file.

    Raises:
        GridError: the file is not a valid grid.
        OSError: the file cannot be read.
    """
    try:
        return loads_grid(Path(path).read_text(encoding="utf-8"), os.fspath(path))
    except UnicodeDecodeError as error:
        raise GridError([f"not a text file in UTF-8 ({error})"], os.fspath(path)) from None


def loads_grid(text: str, source: str = "") -> dict[str, Any]:
    """Read the arguments of `udkjax.sweep` from the text of a TOML file: see `load_grid`."""
    given = parse_toml(text, source, GridError)
    reader = _GridReader("design" in given, Path(source).parent)
    arguments = reader.sweep(given)
    if reader.problems:
        raise GridError(reader.problems, source)
    return arguments


class _GridReader:
    """A reader of a grid file. Mistakes are added to `problems`; invalid values are replaced by None or an empty value.

    If `drawn`, a design draws the members from ranges and distributions, instead of lists of values. Paths of other files are
    relative to `folder`.
    """

    def __init__(self, drawn: bool, folder: Path):
        self.drawn, self.folder = drawn, folder
        self.problems: list[str] = []

    def sweep(self, given: TomlTable) -> dict[str, Any]:
        self.check_keys("", given, TOP_KEYS)
        axes = self.table("axes", given.get("axes", {}))
        if given.get("axes", {}) == {}:
            self.wrong("axes", 'missing; write [axes], and below it such as "body.link1.mass" = [1.0, 2.0]')
        arguments: dict[str, Any] = {
            "axes": {name: self.axis(f"axes.{key_of(name)}", name, axis) for name, axis in axes.items()},
            "ts": self.times(given),
            **self.settings(self.table("settings", given.get("settings", {}))),
        }
        if "design" in given:
            arguments["design"] = self.design(self.table("design", given["design"]))
        if "measures" in given:
            arguments["measure"] = self.names("measures", given["measures"])
        if "derivatives" in given:
            arguments["derivatives"] = self.names("derivatives", given["derivatives"])
        if "reference" in given:
            arguments["reference"] = self.reference(given["reference"])
        return arguments

    def reference(self, given: Toml) -> np.ndarray | None:
        """Read coordinates (T, bodies, 3) from a file written by `udkjax simulate`."""
        with OptionalImport():
            import xarray
        if not isinstance(given, str):
            return self.wrong("reference", f"must be the name of a file written by udkjax simulate, not {abbreviate(given)}")
        try:
            with xarray.open_dataset(self.folder / given, engine="h5netcdf") as data:
                return data["q"].transpose("time", "body", "coordinate").values
        except (OSError, KeyError, ValueError) as error:
            return self.wrong("reference", f"{self.folder / given} has no coordinates q of a simulation ({error})")

    def times(self, given: TomlTable) -> np.ndarray | None:
        """Read output times: `ts`, or from `t0` (0) to `t1` in steps of `dt`, or only the start and the end."""
        if "ts" in given:
            for key in ("t0", "t1", "dt"):
                if key in given:
                    self.wrong(key, "ts is also given: leave one of them out")
            ts = self.numbers("ts", given["ts"])
            if ts is not None and (ts.ndim != 1 or len(ts) < 2 or not np.all(np.diff(ts) > 0)):
                self.wrong("ts", f"must be at least two increasing times (s), not {abbreviate(given['ts'])}")
            return ts
        if "t1" not in given:
            return self.wrong("t1", "missing; write t1 = 10.0 (s), or ts = [...]")
        t0, t1 = self.number("t0", given.get("t0", 0.0)), self.number("t1", given["t1"])
        if t0 is None or t1 is None:
            return None
        if not t0 < t1:
            return self.wrong("t1", f"must be later than t0 = {t0:g}, not {t1:g}")
        if "dt" not in given:
            return np.array([t0, t1])
        dt = self.number("dt", given["dt"])
        if dt is None:
            return None
        if not 0 < dt <= t1 - t0:
            return self.wrong("dt", f"must be positive and at most t1 - t0 = {t1 - t0:g}, not {dt:g}")
        return t0 + dt * np.arange(int((t1 - t0) / dt + 1e-6) + 1)  # includes t1 if it is t0 + k dt up to rounding

    def axis(self, path: str, name: str, given: Toml) -> Axis | Zipped:
        """Read one axis: a list of values, or a table."""
        if not isinstance(given, dict):
            return Axis(self.values(path, name, given))
        if "zipped" in given:
            self.check_keys(path, given, ("zipped",))
            axes = self.table(f"{path}.zipped", given["zipped"])
            return Zipped({k: self.axis(f"{path}.zipped.{key_of(k)}", k, v) for k, v in axes.items()})
        of, units = self.of(f"{path}.of", given.get("of")), given.get("units")
        if units is not None and not isinstance(units, str):
            units = self.wrong(f"{path}.units", f"must be a string, not {abbreviate(units)}")
        remaining = {key: value for key, value in given.items() if key not in ("of", "units")}
        if "distribution" in remaining:
            return Axis(self.distribution(path, remaining), of, units)
        if "values" in remaining:
            self.check_keys(path, remaining, ("values",))
            return Axis(self.values(f"{path}.values", name, remaining["values"]), of, units)
        return Axis(self.range(path, remaining), of, units)

    def values(self, path: str, name: str, given: Toml) -> np.ndarray | list[Choice]:
        if not isinstance(given, list) or not given:
            self.wrong(path, f"must be a list of values, or a table with from, to and num, not {abbreviate(given)}")
            return []
        if name not in CHOICES:
            numbers = self.numbers(path, given)
            return [] if numbers is None else numbers
        return [self.choice(f"{path}[{k}]", name, value) for k, value in enumerate(given)]

    def range(self, path: str, given: TomlTable) -> Values:
        """Read a range: the two ends for a design, otherwise `num` numbers from one end to the other."""
        needed = ("from", "to") if self.drawn else ("from", "to", "num")
        self.check_keys(path, given, (*needed, "scale"))
        for key in needed:
            if key not in given:
                self.wrong(f"{path}.{key}", "missing")
        low, high = (self.number(f"{path}.{key}", given[key]) if key in given else None for key in ("from", "to"))
        num = self.whole(f"{path}.num", given.get("num", 2), 1)
        scale = given.get("scale", "linear")
        if not isinstance(scale, str) or scale not in SCALES:
            self.wrong(f"{path}.scale", f"must be one of {', '.join(map(quote, SCALES))}, not {abbreviate(scale)}")
        elif scale == "log" and low is not None and high is not None and min(low, high) <= 0:
            self.wrong(path, 'from and to must be positive if scale is "log"')
        elif low is not None and high is not None and num is not None:
            if not self.drawn:
                return SCALES[scale](low, high, num)
            return (low, high) if scale == "linear" else cast(Distribution, stats.loguniform(low, high))
        return ()

    def distribution(self, path: str, given: TomlTable) -> Values:
        """Read a distribution of scipy.stats by its name and arguments."""
        name, numbers = given["distribution"], {key: value for key, value in given.items() if key != "distribution"}
        names = [key for key, value in vars(stats).items() if isinstance(value, stats.rv_continuous)]
        if not self.drawn:
            self.wrong(f"{path}.distribution", "needs a [design] that draws from it")
        elif not isinstance(name, str) or name not in names:
            self.wrong(f"{path}.distribution", f"scipy.stats has no {abbreviate(name)}{suggestion(name, names)}")
        else:
            try:
                return getattr(stats, name)(**numbers)
            except TypeError as error:
                self.wrong(path, str(error).replace("_parse_args()", name))
        return ()

    def of(self, path: str, given: "Toml | None") -> str | tuple[str, ...] | Setter | None:
        """Read the target of an axis: names, the length or initial angle of bodies, or names with factors; None if not given."""
        if given is None or isinstance(given, str):
            return given
        if isinstance(given, list):
            return self.names(path, given)
        if not isinstance(given, dict) or not given:
            return self.wrong(path, f"must be a name, a list of names or a table, not {abbreviate(given)}")
        if "length" in given:
            self.check_keys(path, given, ("length", "as_rod"))
            return Length(self.names(f"{path}.length", given["length"]), given.get("as_rod", False) is True)
        if "angle" in given:
            self.check_keys(path, given, ("angle",))
            return InitialAngle(self.names(f"{path}.angle", given["angle"]))
        return Scaled({name: self.number(f"{path}.{key_of(name)}", factor) or 0.0 for name, factor in given.items()})

    def settings(self, given: TomlTable) -> dict[str, Any]:
        self.check_keys("settings", given, SETTINGS)
        values: dict[str, Any] = {}
        for name, value in given.items():
            path = f"settings.{name}"
            if name in CHOICES:
                values[name] = self.choice(path, name, value)
            elif name == "max_steps":
                values[name] = self.whole(path, value, 1)
            elif name in SETTINGS:
                values[name] = self.number(path, value)
        return values

    def design(self, given: TomlTable) -> SweepDesign | None:
        self.check_keys("design", given, ("type", "members", "seed"))
        kind = given.get("type")
        members, seed = self.whole("design.members", given.get("members"), 1), self.whole("design.seed", given.get("seed", 0), 0)
        if kind not in DESIGNS:
            cure = f"must be one of {', '.join(map(quote, DESIGNS))}"
            return self.wrong("design.type", f"{cure}, not {abbreviate(kind)}{suggestion(kind, DESIGNS)}")
        return None if members is None or seed is None else DESIGNS[kind](members, seed)

    # --- single values

    def wrong(self, path: str, problem: str) -> None:
        """Report a mistake in the entry with this path."""
        self.problems.append(f"{path}: {problem}")

    def check_keys(self, path: str, given: TomlTable, expected: Iterable[str]) -> None:
        """Report unexpected keys of a table."""
        expected = tuple(expected)
        for key in given:
            if key not in expected:
                self.wrong(f"{path}.{key_of(key)}" if path else key_of(key), unknown_key(key, expected))

    def choice(self, path: str, setting: str, given: Toml) -> Choice:
        """Read a method, solver, stabilization or formulation."""
        try:
            return choice(setting, cast(str, given))
        except (TypeError, ValueError) as error:
            self.wrong(path, str(error))
            return None

    def table(self, path: str, given: Toml) -> TomlTable:
        """Read a table."""
        if isinstance(given, dict):
            return given
        self.wrong(path, f"must be a table, not {abbreviate(given)}")
        return {}

    def names(self, path: str, given: Toml) -> tuple[str, ...]:
        """Read a name or a list of names."""
        names = [given] if isinstance(given, str) else given
        if isinstance(names, list) and names and all(isinstance(name, str) for name in names):
            return tuple(map(str, names))
        self.wrong(path, f"must be a list of names, not {abbreviate(given)}")
        return ()

    def number(self, path: str, given: Toml) -> float | None:
        """Read a finite number."""
        if isinstance(given, int | float) and not isinstance(given, bool) and math.isfinite(given):
            return float(given)
        self.wrong(path, f"must be a finite number, not {abbreviate(given)}")
        return None

    def whole(self, path: str, given: "Toml | None", smallest: int) -> int | None:
        """Read a whole number."""
        if isinstance(given, int) and not isinstance(given, bool) and given >= smallest:
            return given
        self.wrong(path, "missing" if given is None else f"must be a whole number, at least {smallest}, not {abbreviate(given)}")
        return None

    def numbers(self, path: str, given: Toml) -> np.ndarray | None:
        """Read a list of finite numbers, which may be nested."""
        try:
            values = np.array(given)
        except ValueError:
            values = np.array(None)
        if values.dtype.kind in "iuf" and values.ndim and np.isfinite(values).all():
            return values.astype(float)
        self.wrong(path, f"must be a list of finite numbers, not {abbreviate(given)}")
        return None


def key_of(name: str) -> str:
    """Return a key as written in a TOML file, in quotes if necessary."""
    return name if name.replace("_", "").replace("-", "").isalnum() else quote(name)
