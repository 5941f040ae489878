"""What an identification returns: the values, how well they are known, what the records cannot tell, and how it was found."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from udkjax.integrate.assembly import State, assemble
from udkjax.integrate.solution import versions
from udkjax.scene.mechanism import Mechanism
from udkjax.study.identify.agreement import GradientCheck
from udkjax.study.identify.fitting import Fit
from udkjax.study.identify.held import profile_of
from udkjax.study.identify.knowledge import Knowledge, Values, knowledge
from udkjax.study.identify.losses import Loss
from udkjax.study.identify.problem import Problem
from udkjax.study.identify.profile import LEVEL, Profile
from udkjax.study.identify.results import dataset, labels, text
from udkjax.study.identify.search import Found
from udkjax.study.identify.shooting import Shooting
from udkjax.study.identify.unknowns import applied
from udkjax.study.identify.whiteness import Whiteness, whiteness

ROUNDING = 1e-8  # of what a channel shows: residuals below it are errors of the integration, which are not noise and need not be


@dataclass(frozen=True, eq=False, repr=False)
class Estimate:
    """Values of parameters that were identified, and what there is to know of them.

    `success` says that the fit has settled and that the records tell every parameter; `message` says what there is to say.
    `print` shows a table.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    values: Float[np.ndarray, "P"]
    knowledge: Knowledge
    at_bounds: tuple[str, ...]
    start_values: Mapping[str, tuple[float, float]]  # of what was estimated of them: the change, and its standard error
    predicted: tuple[Mapping[str, np.ndarray], ...]  # of each record, by channel, at its times
    residuals: tuple[Mapping[str, np.ndarray], ...]  # measured - predicted, in the channel's units
    noise: tuple[Mapping[str, np.ndarray], ...]  # standard deviation, given or estimated
    whiteness: Mapping[tuple[int, str], Whiteness]  # of each record's channels, where anything is left but rounding
    converged: bool
    agreeing: int  # first guesses that led here, out of
    guesses: int
    ways: tuple[str, ...]
    history: tuple[tuple[float, float], ...]  # cost and Gauss-Newton step, evaluation by evaluation of the best fit
    evaluations: int  # of a record, each with its derivatives
    seconds: float
    tol: tuple[float, float]
    z: Float[np.ndarray, "K"]
    problem: Problem | Shooting
    loss: Loss

    @classmethod
    def of(
        cls,
        fit: Fit,
        found: Found,
        history: list,
        tol: tuple[float, float],
        loss: Loss,
        seconds: float,
    ) -> "Estimate":
        """What a fit has found."""
        problem = found.problem
        unknowns, P, z = problem.unknowns, len(problem.unknowns.names), fit.z[0]
        x = unknowns.values(z[:P])
        plain = problem.evaluate(fit.z, tol)
        counted = plain if loss is None else loss(plain)
        groups = groups_of(problem)
        values = Values(
            problem.all_names,
            problem.all_units,
            np.concatenate([x, z[P:]]),
            np.concatenate([unknowns.slopes(z[:P]), np.ones(problem.K - P)]),
            (*unknowns.kinds, *["free"] * (problem.K - P)),
        )
        known = knowledge(counted.J[0], counted.r[0], values, groups, P, priors=len(problem.priors))
        every = (
            knowledge(counted.J[0], counted.r[0], values, groups, priors=len(problem.priors)).standard_errors
            if problem.K > P
            else known.standard_errors
        )
        scale = np.append(known.noise, 1.0)[groups]
        rows = len(problem.where)
        sigma = problem.sigma * scale[:rows]
        left = -plain.r[0, :rows] * problem.sigma
        tables = [_by_record(problem, part) for part in (problem.y[problem.there] - left, left, sigma)]
        white = {}
        for places in problem.series():
            record, _, channel = problem.where[places[0]]
            ts = problem.ts[record, problem.where[places, 1]]
            if np.abs(left[places]).max() > ROUNDING * problem.spread[channel]:
                seen = (counted.r[0, :rows] / scale[:rows])[places]
                white[int(record), problem.names[channel]] = whiteness(ts, seen, known.projection[places])
        return cls(
            names=unknowns.names,
            units=unknowns.units,
            values=x,
            knowledge=known,
            at_bounds=unknowns.at_bounds(x),
            start_values={
                name: (float(z[P + k]), float(every[P + k]))
                for k, name in enumerate(name for start in problem.starts for name in start.names)
            },
            predicted=tables[0],
            residuals=tables[1],
            noise=tables[2],
            whiteness=white,
            converged=bool(fit.settled[0]),
            agreeing=found.agreeing,
            guesses=found.guesses,
            ways=found.ways,
            history=tuple(history),
            evaluations=problem.program.calls,
            seconds=seconds,
            tol=tol,
            z=z,
            problem=problem,
            loss=loss,
        )

    @cached_property
    def mechanism(self) -> Mechanism:
        """The mechanism with the values in."""
        return applied(self.problem.mechanism, self.problem.unknowns.targets, jnp.asarray(self.values))

    @property
    def parameters(self) -> dict[str, float]:
        """The values by name."""
        return dict(zip(self.names, self.values.tolist(), strict=True))

    @property
    def standard_errors(self) -> dict[str, float]:
        """One standard error of each value, by name; inf where the records do not tell it."""
        return dict(zip(self.names, self.knowledge.standard_errors.tolist(), strict=True))

    @cached_property
    def starts(self) -> tuple[State, ...]:
        """The states that the records began with, closed."""
        problem, found = self.problem, []
        members = problem.members(self.z[None])
        for k, record in enumerate(problem.records):
            q, v = problem.program.guess(members, k)
            mine = self.mechanism.with_parameters(record.conditions) if record.conditions else self.mechanism
            found.append(assemble(mine, record.t0, State(q, v), throw=False))
        return tuple(found)

    @property
    def success(self) -> bool:
        """Whether the fit has settled, and the records tell every parameter."""
        return self.converged and not self.knowledge.dead and not self.knowledge.flat

    @property
    def message(self) -> str:
        """What there is to say of the estimate, one sentence a line."""
        lines = [] if self.converged else ["the fit has not settled: these are the best values that were found"]
        lines += self.knowledge.texts
        lines += [f"{name} is at one of its bounds" for name in self.at_bounds]
        lines += [found.text(self._where(*key)) for key, found in self.whiteness.items() if not found.white]
        if self.guesses > 1 and self.agreeing == 1:
            lines.append(f"only one of {self.guesses} first guesses led here: there may be a better minimum")
        return "\n".join(lines) or "every parameter is known from the records"

    def _where(self, record: int, channel: str) -> str:
        records = self.problem.records
        return channel if len(records) == 1 else f"{labels(records)[record]}, {channel}"

    def __str__(self) -> str:
        return text(self)

    def __repr__(self) -> str:
        return f"Estimate({', '.join(f'{name}: {value:.6g}' for name, value in self.parameters.items())})"

    def profile(self, name: str, level: float = LEVEL) -> Profile:
        """Return the profile likelihood of a parameter: its confidence interval at this level, without a linear model.

        It is held at values beside the estimate, and all others are fitted anew. Raises `IdentificationError`.
        """
        return profile_of(self, name, level=level)

    def check_gradients(self) -> GradientCheck:
        """Compare the derivatives at the estimate with differences: see `udkjax.check_gradients`."""
        from udkjax.study.identify.trust import compare

        return compare(self.problem, self.z, self.tol)

    def to_xarray(self) -> Any:
        """Return an xarray Dataset: what was measured, what the mechanism shows, and what is known of the parameters."""
        return dataset(self)

    def to_dict(self) -> dict[str, Any]:
        """The figures as plain numbers and texts, as a JSON file has them."""
        known = self.knowledge
        return {
            "success": self.success,
            "converged": self.converged,
            "message": self.message,
            "parameters": {
                name: {"value": value, "standard_error": _plain(error), "units": units}
                for name, value, error, units in zip(
                    self.names, self.values.tolist(), known.standard_errors, self.units, strict=True
                )
            },
            "correlation": [[_plain(x) for x in row] for row in known.correlation],
            "unknown": {"dead": list(known.dead), "flat": [direction.text for direction in known.flat]},
            "at_bounds": list(self.at_bounds),
            "starts": {
                name: {"change": _plain(x), "standard_error": _plain(error)} for name, (x, error) in self.start_values.items()
            },
            "chi2": known.chi2,
            "degrees_of_freedom": known.degrees_of_freedom,
            "noise": [
                {channel: _plain(np.median(sigma[np.isfinite(sigma)])) for channel, sigma in table.items()}
                for table in self.noise
            ],
            "whiteness": [
                {"record": record, "channel": channel, "p": _plain(found.p)}
                for (record, channel), found in self.whiteness.items()
            ],
            "guesses": self.guesses,
            "agreeing": self.agreeing,
            "ways": list(self.ways),
            "evaluations": self.evaluations,
            "seconds": self.seconds,
            "tolerance": self.tol[0],
            "versions": versions(),
        }

    def to_json(self) -> str:
        """The same as text."""
        return json.dumps(self.to_dict(), indent=1)


def _plain(x: Any) -> float | None:
    """A number as JSON knows it: what is not finite is null."""
    return float(x) if np.isfinite(x) else None


def groups_of(problem: Problem | Shooting) -> np.ndarray:
    """Of each residual, which noise it shares that is to be estimated: that of its channel; -1 where it is known."""
    unknown = np.where(problem.known, -1, problem.where[:, 2])
    _, group = np.unique(unknown, return_inverse=True)
    group = group - 1 if problem.known.any() else group
    return np.concatenate([group, np.full(problem.more, -1)])


def _by_record(problem: Problem | Shooting, rows: np.ndarray) -> tuple[dict[str, np.ndarray], ...]:
    """Numbers of all residuals as tables: of each record, its channels at its times."""
    full = np.full(problem.y.shape, np.nan)
    full[problem.there] = rows
    found = []
    for k, record in enumerate(problem.records):
        first = 0 if record.t0 == record.times[0] else 1
        part = full[k, first : first + len(record.times)]
        found.append({name: part[:, c] for c, name in enumerate(problem.names) if np.isfinite(part[:, c]).any()})
    return tuple(found)
