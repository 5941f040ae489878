"""The goal of a drawn curve: a pin draws it, in any order and direction, by a part of the turn or all of it."""

from types import ModuleType

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udkjax.annotations import Numbers, NumericArray
from udkjax.arrays import FULL_TURN
from udkjax.requirements import require_choice, require_count, require_text
from udkjax.scene.mechanism import Mechanism
from udkjax.synthesis.curves.comparison import CurveComparison, compare
from udkjax.synthesis.curves.curve_search import OF_FINISH
from udkjax.synthesis.curves.descent import LEAST_SPAN
from udkjax.synthesis.curves.targets import CurveTarget, WantedCurve, as_points, resampled
from udkjax.synthesis.goals import CombinedResiduals, Goal, check_place, place_of

# Distance, in RMS radii of the curve, below which squares of distances count: the error of a curve that looks right. Steps
# converge fast where losses are quadratic; the search of `mechanisms_for` begins to finish with the same blur.
BLUR = OF_FINISH[0][0]
# Points of the curve for each position. With one, the loss of a good fit misses what lies between, up to two thirds of it; with
# two it is within 15 % of that with eight.
POINTS_PER_POSITION = 2
# Smallest second derivative of a position in steps, relative to their mean. Positions that coincide have no share in the curve's
# length, and none in the loss; gradients are exact with any value, and steps at most 1 / sqrt(SOFTENING) times longer than usual.
SOFTENING = 1e-2


class CurveGoal(Goal):
    """A pin draws a curve, as for `mechanisms_for`: only the drawn shape counts, not the order and time of its points.

    The loss is R^2 times the smooth Chamfer distance, with the RMS radius R of the curve: distances d in RMS radii of each curve
    from the other, averaged along it, count as sqrt(d^2 + b^2) - b with b = 0.01, and both averages are added. `residuals` of a
    design are the roots of these parts (J, 2), so that the sum of their squares is the loss. The driver must be able to turn.

    Args:
        pin: the name of the pin.
        points: points (n, 2) of the curve (m), in order; it is closed if its ends nearly meet.
        part: "free": an open curve is drawn by any part of the turn, found by the search; "whole": by the whole turn.
        samples: number of positions of the part that draws the curve.
    """

    pin: str = eqx.field(static=True)
    points: np.ndarray
    part: str = eqx.field(static=True)
    samples: int = eqx.field(static=True)
    targets: np.ndarray
    values: np.ndarray
    start: str = eqx.field(static=True)
    line: tuple[str, ...] = eqx.field(static=True)
    scale: float = eqx.field(static=True)
    is_whole: bool = eqx.field(static=True)
    _middle: complex = eqx.field(static=True)
    _target: CurveTarget

    def __init__(self, pin: str, points: Numbers, part: str = "free", samples: int = 72):
        require_text("pin", pin)
        require_choice("part", part, ("free", "whole"))
        require_count("samples", samples, 3)
        wanted = WantedCurve(points, part == "whole", "points")
        self.pin, self.part, self.samples, self.start, self.line = pin, part, samples, "free", ()
        self.points = np.asarray(points, float)
        self.is_whole, self.scale, self._middle = wanted.is_whole, wanted.scale, wanted.middle
        self._target = wanted.target(POINTS_PER_POSITION * samples)
        order = wanted.points
        if wanted.is_whole and not wanted.is_closed:  # forth and back
            order = np.concatenate([order, order[-2::-1]])
        path = resampled(order, samples, wanted.is_whole)
        self.targets = as_points(wanted.middle + wanted.scale * path)
        self.values = np.linspace(0.0, FULL_TURN, samples, endpoint=not wanted.is_whole)

    @property
    def extras(self) -> int:
        """One for an open curve: the fraction of the turn that draws it."""
        return int(not self.is_whole)

    @property
    def bounds_of_extras(self) -> tuple[float, float]:
        return LEAST_SPAN / FULL_TURN, 1.0

    @property
    def has_place(self) -> bool:
        return True

    @property
    def is_combined(self) -> bool:
        return True

    def check(self, mechanism: Mechanism) -> None:
        check_place(mechanism, f"pin.{self.pin}", None)

    def measure(self, mechanism: Mechanism, q: Float[Array, "bodies 3"]) -> Float[Array, "G"]:
        return jnp.stack(place_of(mechanism, f"pin.{self.pin}", None, q))

    def residual(self, measured: NumericArray, target: NumericArray, extras: NumericArray, xp: ModuleType) -> list[NumericArray]:
        return [measured[..., 0], measured[..., 1]]

    def values_at(self, extras: np.ndarray, values: np.ndarray) -> np.ndarray:
        return self.values * (np.ones((len(extras), 1)) if self.is_whole else extras)

    def combine(self, r: np.ndarray, by_value: np.ndarray, by_unknowns: np.ndarray) -> CombinedResiduals:
        """Return residuals r (M, J, 2) for steps, and the rest of the loss.

        With the derivatives g of the loss with respect to the places p and matrices A = L L^T of second derivatives, r is
        L^-1 g / sqrt(2), and its derivative L^T / sqrt(2): the gradient 2 J^T r is exact, and 2 J^T J close to the second
        derivative.
        """
        found = self._compare(r)
        xx, xy, yy = found.moments
        soft = SOFTENING * 0.5 * (xx + yy).mean(1, keepdims=True)
        a = np.sqrt(xx + soft)
        b = xy / a
        c = np.sqrt(yy + soft - b * b)
        gx, gy = self.scale * np.real(found.pull), self.scale * np.imag(found.pull)
        first = gx / a
        r = np.sqrt(0.5) * np.stack([first, (gy - b * first) / c], -1)
        slopes = by_unknowns.copy()
        if not self.is_whole:
            slopes[..., -1] += by_value * self.values[:, None]
        x, y = slopes[:, :, 0], slopes[:, :, 1]
        slopes = np.sqrt(0.5) * np.stack([a[..., None] * x + b[..., None] * y, c[..., None] * y], 2)
        rest = self.scale**2 * found.distance - np.einsum("mjg,mjg->m", r, r)
        return CombinedResiduals(r, np.zeros_like(by_value), slopes, rest)

    def report(self, r: np.ndarray) -> np.ndarray:
        """Return the roots (J, 2) of the parts of the loss: those of the J positions, and those of J pieces of the curve."""
        found = self._compare(r[None])
        of_curve = found.of_target[0].reshape(self.samples, POINTS_PER_POSITION).sum(1)
        return self.scale * np.sqrt(np.stack([found.of_curve[0], of_curve], 1))

    def distances(self, residuals: np.ndarray) -> np.ndarray:
        """Return the distances (J,) (m) of pieces of the wanted curve from the drawn one, by the residuals (J, 2) of a design."""
        rho = self.samples * (residuals[:, 1] / self.scale) ** 2
        return self.scale * np.sqrt((rho + BLUR) ** 2 - BLUR**2)

    def _compare(self, places: np.ndarray) -> CurveComparison:
        z = (places[..., 0] + 1j * places[..., 1] - self._middle) / self.scale
        with np.errstate(all="ignore"):  # places of trials without positions are not finite
            return compare(z, self._target, self.is_whole, BLUR)
