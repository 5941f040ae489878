"""`tolerances`: how measures of a mechanism vary with the deviations of its numbers, and how often they are within limits."""

from collections.abc import Mapping
from functools import cached_property
from typing import Annotated, Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from udkjax.annotations import Numbers
from udkjax.argument_types import NOT_NEGATIVE_COUNT
from udkjax.positions.following.drive import Drive
from udkjax.printing import PrintedTable, prints_table
from udkjax.progress import ProgressOption, report_progress
from udkjax.requirements import concrete_only
from udkjax.scene.arguments import checked
from udkjax.scene.drawing.drawn_quantities import Units
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.tables.checks import SceneError
from udkjax.study.tolerancing.cheapest import Limits, common_factor, optimal_scales
from udkjax.study.tolerancing.dimensions import ToleratedNumbers
from udkjax.study.tolerancing.measures import Measuring, ToleratedMeasures
from udkjax.synthesis.ranges.deviations import ToleranceLike
from udkjax.synthesis.ranges.second_order import Quadratic, quadratic
from udkjax.wording import quote, suggestion

QUANTILES = (0.001, 0.01, 0.05, 0.5, 0.95, 0.99, 0.999)
TRUSTED_DIFFERENCE = 0.05  # largest difference between mean or standard deviation and those of samples, in standard deviations
CONSTANT_TOL = 1e-12  # standard deviation of a measure, relative to its largest value, up to which it is rounding
AT_ONCE = 2**16  # samples between reports of progress
FOR_SEARCH = 20_000  # samples with which the cheapest tolerances are found


class SecondOrder(NamedTuple):
    """Mean and standard deviation of each measure without samples, and whether these agree with the samples."""

    mean: dict[str, float]
    standard_deviation: dict[str, float]
    trusted: dict[str, bool]


class Share(NamedTuple):
    """The share of a deviation in the variance of a measure: by itself (`first`), and with all its pairs (`total`)."""

    first: float
    total: float


@prints_table
class CheapestTolerances(NamedTuple):
    """The tolerances of least cost with a given yield."""

    deviations: dict[str, tuple[float, float]]  # the lower and upper deviation of each number, in SI units
    factors: dict[str, float]  # relative to the given tolerances
    cost: float  # relative to that of the given tolerances
    yield_: float  # of samples that the search did not use
    standard_error: float
    texts: dict[str, tuple[str, str]]  # the deviations in the units of the drawing

    def _table(self) -> PrintedTable:
        title = f"cheapest tolerances with a yield of {100 * self.yield_:.4g} %: {self.cost:.3g} times the cost"
        return PrintedTable(title, [(name, *ends) for name, ends in self.texts.items()], ("number", "lower", "upper deviation"))


@prints_table
class ToleranceAnalysis:
    """Samples of a mechanism whose numbers deviate, and their statistics.

    Attributes:
        names: the names of the measures.
        measured: the measures of the samples (N, G); NaN if a sample does not reach all values of the drive.
        nominal: the measures with the nominal numbers (G,).
        yield_: the share of samples within all limits; without limits, of those that reach all values.
        standard_error: standard error of the yield.
        outside: the share of samples outside the limits of each measure.
        not_assembled: the share of samples without a value.

    Args:
        numbers: the numbers with their tolerances.
        measuring: evaluates the measures.
        measured: the measures of the samples.
        limits: the limits of measures.
        seed: the seed of the samples.
    """

    def __init__(self, numbers: ToleratedNumbers, measuring: Measuring, measured: np.ndarray, limits: Limits, seed: int):
        self._numbers, self._measuring, self._limits, self._seed = numbers, measuring, limits, seed
        self.names, self.measured = measuring.names, measured
        self.nominal = measuring(numbers.nominal[None])[0]
        reached, holds = np.isfinite(measured).all(1), limits.holds(measured)
        self.yield_, self.standard_error = _share(reached & holds.all(1))
        self.not_assembled = float(1.0 - reached.mean())
        self.outside = {self.names[k]: float(1.0 - x) for k, x in zip(limits.which, holds.mean(0), strict=True)}
        self._reached = measured[reached]
        self._drawn = Units.of(numbers.mechanism.drawing)

    def shown(self, name: str) -> tuple[str, float]:
        """Return the unit in which the drawing shows a measure, and the size of this unit in SI units.

        For functions, whose units are unknown, return "" and 1.
        """
        unit = self._measuring.units[name]
        return (self._drawn.shown(unit), self._drawn.size(unit)) if unit else ("", 1.0)

    def limits_of(self, name: str) -> list[float]:
        """Return the finite limits of a measure."""
        places = [k for k, which in enumerate(self._limits.which) if self.names[which] == name]
        return [float(x) for k in places for x in (self._limits.low[k], self._limits.high[k]) if np.isfinite(x)]

    @cached_property
    def mean(self) -> dict[str, float]:
        """The mean of each measure over the samples that reach all values."""
        return self._by_name(self._reached.mean(0))

    @cached_property
    def standard_deviation(self) -> dict[str, float]:
        """The standard deviation of each measure over the samples that reach all values."""
        return self._by_name(self._reached.std(0))

    def quantiles(self, shares: Numbers = QUANTILES) -> dict[str, Float[np.ndarray, "Q"]]:
        """Return the values below which the given shares of the samples are, for each measure."""
        found = np.quantile(self._reached, np.asarray(shares, float), axis=0)
        return dict(zip(self.names, found.T, strict=True))

    @cached_property
    def second_order(self) -> SecondOrder:
        """Means and standard deviations from first and second differences, without samples.

        Each measure is trusted if both agree with those of the samples.
        """
        model, (own, pairs) = self._quadratic, self._parts
        mean, deviation = model.mean, np.sqrt(own.sum(1) + pairs.sum((1, 2)) / 2.0)
        of_samples, spread = self._reached.mean(0), self._reached.std(0)
        close = np.maximum(np.abs(mean - of_samples), np.abs(deviation - spread)) <= TRUSTED_DIFFERENCE * spread
        trusted = {name: bool(x) for name, x in zip(self.names, close | self._is_constant, strict=True)}
        return SecondOrder(self._by_name(mean), self._by_name(deviation), trusted)

    @property
    def _is_constant(self) -> Bool[np.ndarray, "measures"]:
        """Mask of the measures that vary by rounding errors alone."""
        return self._reached.std(0) <= CONSTANT_TOL * np.abs(self._reached).max(0, initial=0.0)

    @cached_property
    def shares(self) -> dict[str, dict[str, Share]]:
        """The share of each deviation in the variance of each measure, by the second-order terms."""
        own, pairs = self._parts
        variance = np.where(self._is_constant, np.inf, np.maximum(own.sum(1) + pairs.sum((1, 2)) / 2.0, 1e-300))[:, None]
        first, total = own / variance, (own + pairs.sum(2)) / variance
        sources = [source.name for source in self._numbers.sources]
        return {
            name: {source: Share(float(a), float(b)) for source, a, b in zip(sources, first[k], total[k], strict=True)}
            for k, name in enumerate(self.names)
        }

    def cheapest(self, wanted: float, costs: Mapping[str, float] | None = None) -> CheapestTolerances:
        """Return the tolerances of least cost with which a share `wanted` of the samples is within all limits.

        Each tolerance is multiplied by a factor t, and costs c / t, so that half the tolerance costs twice as much.

        Args:
            wanted: the yield, between 0 and 1.
            costs: c by the name of a deviation (those of `shares`); by default 1.

        Raises:
            ValueError: there are no limits, the nominal mechanism is outside of them, or a name is unknown.
        """
        names = [source.name for source in self._numbers.sources]
        unknown = [name for name in costs or {} if name not in names]
        if unknown:
            raise ValueError(f"costs: no deviation {quote(unknown[0])}{suggestion(unknown[0], names)}")
        if not len(self._limits.which):
            raise ValueError("cheapest needs limits: give tolerances(..., limits={measure: largest})")
        if not 0.0 < wanted < 1.0:
            raise ValueError(f"wanted must be a yield between 0 and 1, not {wanted}")
        if not self._limits.holds(self._measuring((self._numbers.nominal + self._numbers.middle)[None])).all():
            raise ValueError("no tolerances have this yield: the mechanism is outside the limits without any deviation")
        weights = np.array([float((costs or {}).get(name, 1.0)) for name in names])
        u = self._deviations(FOR_SEARCH, self._seed + 1)
        scales = optimal_scales(self._quadratic, self._limits, u, wanted, weights)
        factor = common_factor(lambda factor: self._yield(u, factor * scales)[0], wanted)
        scales = factor * scales
        found, error = self._yield(self._deviations(len(self.measured), self._seed + 2), scales)
        numbers = self._numbers
        half = numbers.sizes * scales[numbers.owners] / np.array([numbers.sources[k].tolerance.spread for k in numbers.owners])
        deviations = {n: (float(c - h), float(c + h)) for n, c, h in zip(numbers.names, numbers.middle, half, strict=True)}
        texts = {
            name: (self._drawn.text(low, unit), self._drawn.text(high, unit))
            for (name, (low, high)), unit in zip(deviations.items(), numbers.units, strict=True)
        }
        factors = dict(zip(names, map(float, scales), strict=True))
        cost = float((weights / scales).sum() / weights.sum())
        return CheapestTolerances(deviations, factors, cost, found, error, texts)

    def _yield(self, u: np.ndarray, scales: np.ndarray) -> tuple[float, float]:
        measured = self._measuring(self._numbers.values(u, scales))
        return _share(np.isfinite(measured).all(1) & self._limits.holds(measured).all(1))

    def _deviations(self, count: int, seed: int) -> np.ndarray:
        return self._numbers.deviations(np.random.default_rng(seed).standard_normal((count, len(self._numbers.sources))))

    @cached_property
    def _quadratic(self) -> Quadratic:
        return quadratic(lambda u: self._measuring(self._numbers.values(u)), len(self._numbers.sources))

    @cached_property
    def _parts(self) -> tuple[np.ndarray, np.ndarray]:
        return self._quadratic.parts(np.array([source.tolerance.kurtosis for source in self._numbers.sources]))

    def _by_name(self, values: np.ndarray) -> dict[str, float]:
        return dict(zip(self.names, map(float, values), strict=True))

    def _table(self) -> PrintedTable:
        rows, low = [], self.quantiles((0.001, 0.999))
        for name in self.names:
            worst = sorted(self.shares[name].items(), key=lambda item: -item[1].total)[:3]
            shares = ", ".join(f"{source} {100 * share.total:.0f} %" for source, share in worst if share.total)
            outside = f"{100 * self.outside[name]:.3g} %" if name in self.outside else "no limit"
            place = self.names.index(name)
            deviation = 0.0 if self._is_constant[place] else self.standard_deviation[name]
            unit, size = self.shown(name)
            nominal, mean, least, most = (f"{x / size:.6g}" for x in (self.nominal[place], self.mean[name], *low[name]))
            spread = f"{deviation / size:.3g}"
            rows.append((name, unit, nominal, mean, spread, least, most, outside, shares or "no tolerance varies it"))
        heads = "measure", "unit", "nominal", "mean", "standard deviation", "0.1 %", "99.9 %", "outside", "share of the variance"
        remarks = []
        if self.not_assembled:
            remarks.append(f"{100 * self.not_assembled:.3g} % of the samples do not reach all values of the drive.")
        if not self.yield_:
            remarks.append("No sample is within the limits: compare them with the nominal values.")
        loose = [name for name, trusted in self.second_order.trusted.items() if not trusted]
        if loose:
            remarks.append(f"Not quadratic over the tolerances, so that shares are approximate: {', '.join(loose)}.")
        yields = f"yield {100 * self.yield_:.6g} % +- {100 * self.standard_error:.2g} %"
        return PrintedTable(
            f"tolerances of {self._numbers.count} numbers: {yields} of {len(self.measured)} samples", rows, heads, remarks
        )

    _shapes = _table  # results are concrete


@checked
@concrete_only()
def tolerances(
    mechanism: Mechanism,
    tolerances: Mapping[str, ToleranceLike],
    measures: ToleratedMeasures,
    *,
    drive: Drive = None,
    values: Numbers | None = None,
    limits: Mapping[str, Any] | None = None,
    samples: Annotated[int, NOT_NEGATIVE_COUNT] = 100_000,
    seed: Annotated[int, NOT_NEGATIVE_COUNT] = 0,
    progress: ProgressOption = None,
) -> ToleranceAnalysis:
    """Analyse the effect of the deviations of a mechanism's numbers on measures, and the share of samples within limits.

    Args:
        mechanism: the mechanism, with its nominal numbers.
        tolerances: the largest deviation by the name of a number (`pin.B`, `length(crank)`, `spring.s.stiffness`): in SI units,
            as a text ("0.05 mm", or "0.05" in the unit of the drawing), as a grade of ISO 286 of a length ("h9", "H7", "js8";
            "IT9" is js9), or as a `Tolerance`. A `PinClearance` by the name of a joint is the play of its pin. Deviations are
            independent, and a plain tolerance is three standard deviations of a normal distribution.
        measures: texts, or measures by name. A text such as "range(body.rocker.angle)" is max, min, range, mean, rms, first or
            last of a coordinate (`body.NAME.angle`, `pin.NAME.x`, as for `kinematics`) over the drive, in rad and m;
            "deviation(pin.P)" is the largest distance from the positions of the nominal mechanism. A goal, such as `PathGoal`
            with a target for each value, is the largest distance from its targets. A function of JAX takes the mechanism and
            returns a number, for example from `simulate`.
        drive: the driver or coordinate, as for `kinematics`; by default the only driver. Functions do not need it.
        values: values of the driver; by default every 5 degrees of a turn from the drawn position.
        limits: the largest value of a measure by name, or (least, largest), in SI units or as texts ("0.5 mm", "2 deg",
            or "0.5" in the unit of the drawing).
        samples: the number N of samples.
        seed: the seed of the random deviations.
        progress: None shows a line after two seconds, False none; or a function of a `Progress`.

    Returns:
        A `ToleranceAnalysis`: yield, standard errors, quantiles, shares, and the cheapest tolerances for a yield.

    Raises:
        SceneError: lists every mistake: unknown names, numbers that drivers prescribe, tolerances that are not positive, a
            nominal mechanism that does not move over all values.
        ValueError: there are fewer than two samples, or values are not finite.
    """
    numbers = ToleratedNumbers(mechanism, tolerances)
    measuring = Measuring(numbers, measures, drive, values)
    within = _limits(mechanism, measuring, limits or {})
    if samples < 2:
        raise ValueError(f"samples must be at least 2, not {samples}")
    generator, found = np.random.default_rng(seed), np.empty((samples, len(measuring.names)))
    with report_progress(progress, samples, "tolerances") as report:
        for first in range(0, samples, AT_ONCE):
            count = min(AT_ONCE, samples - first)
            u = numbers.deviations(generator.standard_normal((count, len(numbers.sources))))
            found[first : first + count] = measuring(numbers.values(u))
            report(first + count)
    return ToleranceAnalysis(numbers, measuring, found, within, seed)


def _limits(mechanism: Mechanism, measuring: Measuring, given: Mapping[str, Any]) -> Limits:
    problems, which, low, high, units = [], [], [], [], Units.of(mechanism.drawing)
    for name, limit in given.items():
        if name not in measuring.names:
            problems.append(f"limits: no measure {quote(name)}{suggestion(name, measuring.names)}")
            continue
        try:
            parts = [_number(x, measuring.units[name], units) for x in (limit if isinstance(limit, list | tuple) else [limit])]
            if len(parts) > 2 or not parts or np.isnan(parts).any() or (len(parts) == 2 and parts[0] >= parts[1]):
                raise ValueError(f"give the largest value, or the least and a larger one, not {limit}")
        except (TypeError, ValueError) as problem:
            problems.append(f"limits: {quote(name)}: {problem}")
            continue
        which.append(measuring.names.index(name))
        low.append(parts[0] if len(parts) == 2 else -np.inf)
        high.append(parts[-1])
    if problems:
        raise SceneError(problems, mechanism.name)
    return Limits(np.array(which, int), np.array(low), np.array(high))


def _number(given: Any, unit: str, units: Units) -> float:
    return units.read_text(given, unit) if isinstance(given, str) else float(given)


def _share(holds: np.ndarray) -> tuple[float, float]:
    """Return the share of True, and its standard error, which is positive even if all or none of the samples are True."""
    count = len(holds)
    smoothed = (holds.sum() + 1.0) / (count + 2.0)
    return float(holds.mean()), float(np.sqrt(smoothed * (1.0 - smoothed) / count))
