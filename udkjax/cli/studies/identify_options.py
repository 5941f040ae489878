"""Options of `udkjax identify` as parameters and records; all mistakes are reported together."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from udkjax.scene.mechanism import Mechanism
from udkjax.study.identify import IdentificationError, Parameter, Record, Start
from udkjax.study.identify.problem.parameters import unknowns_of
from udkjax.study.identify.records.record_reader import records_of
from udkjax.study.identify.records.records import Estimated
from udkjax.wording import quote, suggestion

Groups = Iterable[Iterable[str]]
Found = TypeVar("Found")


class IdentifyOptions:
    """The `parameters` to identify, made from the options of the command line; mistakes are collected in `problems`.

    Args:
        mechanism: the mechanism.
        parameters: names of the parameters, in groups, one for each time that the option was given.
        options: strings such as NAME=VALUE, in such groups, by the argument of `Parameter` that they set: guess, bounds or prior.
    """

    def __init__(self, mechanism: Mechanism, parameters: Groups, options: Mapping[str, Groups]):
        self.mechanism, self.problems = mechanism, []
        self.names: tuple[str, ...] = ()
        names = [name for group in parameters for name in group]
        given: dict[str, dict[str, Any]] = {name: {} for name in names}
        for option, groups in options.items():
            for text in (text for group in groups for text in group):
                self._add(given, option, text)
        self.parameters = [Parameter(name, **given[name]) for name in names]
        if not names:
            self.problems.append("--parameters: name at least one, such as body.link1.mass")

    def check(self, settings: Mapping[str, Any]) -> None:
        """Check that the parameters exist and that the settings are valid; add mistakes to `problems`."""
        if self.parameters:
            self.names = self._try(lambda: unknowns_of(self.mechanism, self.parameters).names, ())
        if settings["n_starts"] < 0:
            self.problems.append(f"--n-starts {settings['n_starts']}: must not be negative")
        if not 0 < settings["tol"] < 1:
            self.problems.append(f"--tol {settings['tol']:g}: must be between 0 and 1")
        if settings["seed"] < 0:
            self.problems.append(f"--seed {settings['seed']}: must not be negative")

    def records(self, data: Sequence[Path], noise: Groups, ignore: Groups, start: Estimated) -> list[Record]:
        """Return the records of the data files; mistakes are added to `problems`, and files with mistakes give no records.

        Args:
            data: files of measurements.
            noise: standard deviations as NUMBER, for all channels, or CHANNEL=NUMBER.
            ignore: columns to ignore.
            start: parts of each record's initial state to estimate.
        """
        if not data:
            self.problems.append("give a file of measurements (.csv or .nc) after the scene")
            return []
        everywhere, by_channel = self._noise(noise)
        left_out = [name for group in ignore for name in group]
        loaded = self._try(lambda: records_of(self.mechanism, list(data), by_channel, left_out), ())
        loaded = self._try(lambda: records_of(self.mechanism, loaded, everywhere), ()) if loaded else ()
        return [record.changed(initial_state=Start(estimate=start)) for record in loaded]

    def profiled(self, groups: Groups) -> list[str]:
        """Return the names in the estimate of parameters that are given by their full name, or by one of several tied names."""
        full_names = {_plain(alias): name for name in self.names for alias in (name, *name.split("="))}
        given = [text for group in groups for text in group]
        if self.names:
            self.problems += [
                f"--profile {quote(text)}: is not among --parameters{suggestion(text, self.names)}"
                for text in given
                if _plain(text) not in full_names
            ]
        return list(dict.fromkeys(full_names[_plain(text)] for text in given if _plain(text) in full_names))

    def _noise(self, groups: Groups) -> tuple[float | None, dict[str, float]]:
        """Return the standard deviation for all channels, None if it is not given, and those of individual channels by name."""
        everywhere, by_channel = None, {}
        for text in (text for group in groups for text in group):
            channel, _, number = text.rpartition("=")
            sigma = _numbers(number, 1)
            if sigma is None or not sigma[0] > 0:
                self.problems.append(f"--noise {quote(text)}: must be NUMBER or CHANNEL=NUMBER, in SI units, and positive")
            elif channel.strip() in by_channel or (not channel and everywhere is not None):
                self.problems.append(f"--noise {quote(text)}: is given twice")
            elif channel:
                by_channel[channel.strip()] = sigma[0]
            else:
                everywhere = sigma[0]
        return everywhere, by_channel

    def _add(self, given: dict[str, dict[str, Any]], option: str, text: str) -> None:
        """Add an option to the options `given` of a parameter, which its text names in full or by any of several tied names."""
        option_text = f"--{option} {quote(text)}"
        name, _, numbers = text.rpartition("=")
        parameter = {_plain(alias): full_name for full_name in given for alias in (full_name, *full_name.split("="))}.get(
            _plain(name)
        )
        values = _numbers(numbers, 1 if option == "guess" else 2)
        if not name or values is None:
            form = {"guess": "NAME=VALUE", "bounds": "NAME=LOW,HIGH", "prior": "NAME=MEAN,DEVIATION"}[option]
            self.problems.append(f"{option_text}: must be {form}, in SI units")
        elif parameter is None:
            advice = suggestion(
                name.strip(), [alias.strip() for full_name in given for alias in (full_name, *full_name.split("="))]
            )
            self.problems.append(f"{option_text}: {quote(name.strip())} is not among --parameters{advice}")
        elif option in given[parameter]:
            self.problems.append(f"{option_text}: is given twice for {quote(parameter)}")
        elif option == "bounds" and not values[0] < values[1]:
            self.problems.append(f"{option_text}: the lower bound must be below the upper one")
        else:
            given[parameter][option] = values[0] if option == "guess" else tuple(values)

    def _try(self, read: Callable[[], Found], otherwise: Found) -> Found:
        try:
            return read()
        except IdentificationError as error:
            self.problems += error.problems
            return otherwise


def _numbers(text: str, count: int) -> list[float] | None:
    """Return `count` comma-separated finite numbers; None if the text is anything else."""
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        return None
    return numbers if len(numbers) == count and all(map(math.isfinite, numbers)) else None


def _plain(text: str) -> str:
    return "".join(text.split())
