"""Records: tables of times and of what was measured then, and the state that each of them began with."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import ArrayLike, Float

from udkjax.integrate.assembly import State
from udkjax.scene.checks import quoted
from udkjax.study.identify.channels import Quantity
from udkjax.study.identify.errors import IdentificationError

Estimated = Literal["nothing", "position", "velocity", "both"]


@dataclass(frozen=True, eq=False)
class Start:
    """The state that a record begins with: what is known of it, and what of it is to be estimated.

    `state` is the guess that is closed (default: the scene's own). Of what is estimated, "position" or "velocity" or "both", the
    unknowns are as many coordinates or rates as the mechanism has degrees of freedom there. Starts of one `name` are tied: they
    are the same state, estimated from all of their records.
    """

    state: State | None = None
    estimate: Estimated = "nothing"
    name: str = ""

    def __post_init__(self):
        if self.estimate not in get_args(Estimated):
            raise IdentificationError([f"Start: estimate must be one of {', '.join(get_args(Estimated))}, is {self.estimate!r}"])

    @property
    def position(self) -> bool:
        """Whether the position is estimated."""
        return self.estimate in ("position", "both")

    @property
    def velocity(self) -> bool:
        """Whether the velocity is estimated."""
        return self.estimate in ("velocity", "both")


class Record:
    """What was measured at some times (T,), s: `values` maps channels to arrays (T,), not a number where nothing was measured.

    Channels are named as in `udkjax.study.identify.channels` ("body.crank.angle"), or `Quantity`s of the user's own. `noise` is
    the standard deviation of all channels, or maps channels to their own, a number or (T,); where it is not given, it is
    estimated from what the fit leaves. The motion begins at `t0` (s; by default at the first time) with `start`. `conditions`
    maps names of parameters to values that they are known to have had in this record: a payload, the amplitude of a driver.

    Raises `IdentificationError`, which lists every mistake.
    """

    def __init__(
        self,
        times: ArrayLike | Sequence[float],
        values: Mapping[Any, Any],
        noise: Mapping[Any, Any] | float | None = None,
        start: Start | State | None = None,
        t0: float | None = None,
        conditions: Mapping[str, Any] | None = None,
        name: str = "",
    ):
        problems: list[str] = []
        self.name = name
        self.times: Float[np.ndarray, "T"] = _numbers("time", times, None, problems)
        self._check_times(t0, problems)
        self.values = {_key(c): _numbers(str(c), v, self.times.shape, problems) for c, v in values.items()}
        self.t0 = float(self.times[0]) if t0 is None and self.times.size else float(t0 or 0.0)
        self.noise = self._noise(noise, problems)
        self.start = start if isinstance(start, Start) else Start(start)
        self.conditions = dict(conditions or {})
        if not self.values:
            problems.append("nothing was measured: there is no channel")
        for channel, value in self.values.items():
            if not np.isfinite(value).any() and value.size:
                problems.append(f"{quoted(str(channel))}: holds no number; leave the channel out")
            elif np.isinf(value).any():
                problems.append(
                    f"{quoted(str(channel))}: entry {int(np.flatnonzero(np.isinf(value))[0])} is infinite; a gap is nan"
                )
        if problems:
            raise IdentificationError([self.where + problem for problem in problems])

    @property
    def where(self) -> str:
        """What messages about it begin with."""
        return f"record {quoted(self.name)}: " if self.name else ""

    def starting(self, start: Start) -> "Record":
        """The same with another start."""
        return Record(self.times, self.values, self.noise, start, self.t0, self.conditions, self.name)

    def __repr__(self) -> str:
        return f"Record({len(self.times)} times, {', '.join(map(str, self.values))})"

    def _check_times(self, t0: float | None, problems: list[str]) -> None:
        if self.times.ndim != 1 or not self.times.size:
            problems.append(f"time: must be a vector of at least one time, is of shape {self.times.shape}")
            self.times = np.zeros(0)
        elif not np.isfinite(self.times).all():
            problems.append(f"time: entry {int(np.flatnonzero(~np.isfinite(self.times))[0])} is not a finite number")
        elif not (steps := np.diff(self.times) > 0).all():
            problems.append(f"time: must increase, but entry {int(np.argmin(steps)) + 1} does not exceed the one before")
        elif t0 is not None and not t0 <= self.times[0]:
            problems.append(f"t0: the motion begins at {t0} s, after the first time measured, {self.times[0]} s")

    def _noise(self, given: Any, problems: list[str]) -> dict[Any, Float[np.ndarray, "T"] | None]:
        mapped = {_key(c): s for c, s in given.items()} if isinstance(given, Mapping) else dict.fromkeys(self.values, given)
        found: dict[str, Any] = dict.fromkeys(self.values)
        for channel, sigma in mapped.items():
            if channel not in self.values:
                problems.append(f"noise: {quoted(str(channel))} is not among the channels")
            elif sigma is not None:
                sigma = np.asarray(sigma, float)
                sigma = sigma if sigma.ndim else np.full(self.times.shape, sigma)
                shapes = self.times.shape, sigma.shape
                of = sigma[np.isfinite(self.values[channel])] if sigma.shape == self.times.shape else sigma
                if sigma.shape != self.times.shape:
                    problems.append(f"noise of {quoted(str(channel))}: must be a number or of shape {shapes[0]}, is {shapes[1]}")
                elif not (np.isfinite(of).all() and (of > 0).all()):
                    problems.append(f"noise of {quoted(str(channel))}: a standard deviation must be a finite number > 0")
                found[channel] = sigma
        return found


def _key(channel: Any) -> Any:
    """Channels that are named go by their names, a user's own by itself."""
    return channel if isinstance(channel, Quantity) else str(channel)


def _numbers(name: str, given: Any, shape: tuple[int, ...] | None, problems: list[str]) -> np.ndarray:
    try:
        found = np.asarray(given, float)
    except (TypeError, ValueError):
        problems.append(f"{quoted(name)}: must be numbers, is {given!r:.40}")
        return np.zeros(shape or 0)
    if shape is not None and found.shape != shape:
        problems.append(f"{quoted(name)}: must have a value for each of the {shape[0]} times, is of shape {found.shape}")
        return np.zeros(shape)
    return found
