"""Positions of a driven mechanism as a curve Psi(s, q) = 0 in scaled coordinates and value, X = (q, s)."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from udkjax.arrays import library_for, number
from udkjax.equations import constraints
from udkjax.equations.elimination.dense_pseudoinverse import dense_pseudoinverse
from udkjax.equations.rows.analysis import Analysis
from udkjax.equations.rows.dense_rows import DenseTerms
from udkjax.equations.rows.position_closure import CLOSURE
from udkjax.equations.terms.scale_program import RANK_TOL
from udkjax.pinv import SVD, Plus
from udkjax.pinv.svd import SVDFactors
from udkjax.positions.following.drive import Driven
from udkjax.programs.control_flow import BY_JAX, BY_NUMPY, ControlFlow
from udkjax.programs.identity_cache import cached_by_identity
from udkjax.scene.mechanism import Mechanism

_ROUNDING = CLOSURE.rounding * float(np.finfo(float).eps)
NEWTON_STEPS = 8  # largest number; three are usual
_Correction = tuple[Any, Any, Any]  # X, corrections so far, whether it is closed


class AbstractCurve(ABC):
    """The positions of a driven mechanism as a curve of points X = (q, s), each coordinate and the value s in its unit."""

    weights: Any  # weights of the rows
    units: Any  # units of the coordinates and the value
    rows: Any  # the scales of the rows
    independent: tuple[int, ...]  # indices of the independent rows

    by: ClassVar[ControlFlow]

    @abstractmethod
    def residual(self, X: Float[Array, "n+1"]) -> Float[Array, "m"]:
        """Return Psi, with each row times its weight."""

    @abstractmethod
    def slopes(self, X: Float[Array, "n+1"]) -> Float[Array, "m n+1"]:
        """Return E, the derivatives of the residual by X."""

    @abstractmethod
    def plus(self, E: Float[Array, "m n"], tol: float = RANK_TOL) -> Any:
        """Return E^+, truncated where singular values are below `tol` times the largest."""

    @abstractmethod
    def inverse_singular_values(self, plus: Any) -> Float[Array, "k"]:
        """Return 1/sigma of the matrix with the pseudoinverse `plus`, in descending order of sigma; zero where truncated."""

    @abstractmethod
    def gamma(self, s: Float[Array, ""], q: Float[Array, "n"], v: Float[Array, "n"]) -> Float[Array, "m"]:
        """Return gamma, for which Psi_q a = gamma is the second derivative of Psi = 0, at the value s and the rates v = dq/ds."""

    def is_closed(self, X: Float[Array, "n+1"]) -> Bool[Array, ""]:
        """Return True if the violation at X is within rounding errors."""
        return self.violation(X) <= self.rounding(X)

    def rounding(self, X: Float[Array, "n+1"]) -> Float[Array, ""]:
        """Return the largest violation that rounding errors of the coordinates cause."""
        return CLOSURE.rounding * float(np.finfo(X.dtype).eps) * self.by.xp.maximum(1.0, abs(X).max())

    def violation(self, X: Float[Array, "n+1"]) -> Float[Array, ""]:
        """Return the largest |Psi| of all rows, each relative to its scale."""
        return abs(self.residual(X) / (self.weights * self.rows)).max(initial=0.0)

    @abstractmethod
    def correct(self, X: Float[Array, "n+1"], fixed: Bool[Array, ""] | bool = False) -> tuple[Array, Bool[Array, ""]]:
        """Return the nearest point of the curve, with the same value s if `fixed`, and whether Newton's method converged.

        The last step corrects a closed point once more.
        """

    def clearance(self, X: Float[Array, "n+1"]) -> Any:
        """Return the distance of E from rank loss, which occurs where branches meet: its n-th singular value over the largest."""
        xp, E = self.by.xp, self.slopes(X)
        if min(E.shape) < len(X) - 1:
            return xp.zeros(())
        if xp is np and not np.all(np.isfinite(E)):  # NumPy refuses to decompose it
            return np.asarray(np.nan)
        sigma = xp.linalg.svd(E, compute_uv=False)
        return sigma[len(X) - 2] / xp.where(sigma[0] > 0, sigma[0], 1.0)

    def tangent(self, X: Float[Array, "n+1"], before: Float[Array, "n+1"]) -> tuple[Array, Array, Array]:
        """Return the unit tangent tau in the direction of the one before, the side of the point, and its clearance.

        The side is the sign of det [E; tau] of independent rows, +-1: along a branch it changes only where the branch meets
        another, not at toggles. It is 1 if the independent rows are unknown. The clearance is `clearance(X)` from the same
        decomposition, or zero if E^+ is truncated.
        """
        xp, E = self.by.xp, self.slopes(X)
        plus = self.plus(E)
        tau = before - plus @ (E @ before)
        inverse = self.inverse_singular_values(plus)
        last = inverse[len(X) - 2] if min(E.shape) >= len(X) - 1 else xp.zeros(())
        clearance = xp.where(last == 0, 0.0, inverse[0] / xp.where(last == 0, 1.0, last)) if len(inverse) else last
        size = xp.linalg.norm(tau)
        tau = tau / xp.where(size > 0, size, 1.0)
        A = xp.concatenate([E[np.array(self.independent, int)], tau[None]])
        return tau, xp.linalg.slogdet(A)[0] if A.shape[0] == A.shape[1] else xp.ones(()), clearance

    def derivatives(self, s: Float[Array, ""], q: Float[Array, "n"]) -> tuple[Array, Array, Array]:
        """Return q' = dq/ds and q'' (n,) at a closed position, and the rank of Psi_q: Psi_q q' = -Psi_s, Psi_q q'' = gamma."""
        W, w = self.units[:-1], self.weights
        E = self.slopes(self.by.xp.append(q, s) / self.units)
        inverse = self.plus(E[:, :-1])
        dq = -W * (inverse @ (E[:, -1] / self.units[-1]))
        return dq, W * (inverse @ (w * self.gamma(s, q, dq))), inverse.rank


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Curve(AbstractCurve):
    """The positions of a driven mechanism whose numbers may be traced, as a curve, by JAX."""

    mechanism: Mechanism
    weights: Float[Array, "m"]
    units: Float[Array, "n+1"]
    rows: Float[Array, "m"]
    independent: tuple[int, ...] = field(metadata={"static": True})

    by: ClassVar[ControlFlow] = BY_JAX

    @classmethod
    def of(cls, driven: Driven) -> "Curve":
        scales = driven.analysis.scales
        scale = scales.coordinates(driven.analysis.coordinates)
        units = library_for((scale, driven.unit)).append(scale, driven.unit)
        independent = driven.analysis.independent_rows
        return cls(driven.mechanism, scales.weights, number(units), scales.rows, independent)

    def residual(self, X: Float[Array, "n+1"]) -> Float[Array, "m"]:
        x = X * self.units
        return self.weights * constraints.psi(self.mechanism, x[-1], x[:-1])

    def slopes(self, X: Float[Array, "n+1"]) -> Float[Array, "m n+1"]:
        return jax.jacfwd(self.residual)(X)

    def plus(self, E: Float[Array, "m n"], tol: float = RANK_TOL) -> Plus:
        return SVD(tol).plus(E)

    def inverse_singular_values(self, plus: Plus) -> Float[Array, "k"]:
        factors = plus.factors
        assert isinstance(factors, SVDFactors)
        return factors.inverse

    def gamma(self, s: Float[Array, ""], q: Float[Array, "n"], v: Float[Array, "n"]) -> Float[Array, "m"]:
        return constraints.gamma(self.mechanism, s, q, v)

    def correct(self, X: Float[Array, "n+1"], fixed: Bool[Array, ""] | bool = False) -> tuple[Array, Bool[Array, ""]]:
        if not len(self.rows):  # no constraints
            return X, jnp.asarray(True)

        def body(state: _Correction) -> _Correction:
            X, k, _ = state
            E = self.slopes(X)
            E = jnp.where(fixed & (np.arange(len(X)) == len(X) - 1), 0.0, E)
            return X - self.plus(E) @ self.residual(X), k + 1, self.is_closed(X)

        def is_unfinished(state: _Correction) -> Bool[Array, ""]:
            _, k, closed = state
            return (k < NEWTON_STEPS) & ~closed

        X, _, closed = jax.lax.while_loop(is_unfinished, body, (X, jnp.asarray(0), jnp.asarray(False)))
        return X, closed


@dataclass(frozen=True)
class NumpyCurve(AbstractCurve):
    """The positions of a driven mechanism of concrete numbers, as a curve, by NumPy on the scene's programs without compiling."""

    terms: DenseTerms
    weights: Float[np.ndarray, "m"]
    units: Float[np.ndarray, "n+1"]
    rows: Float[np.ndarray, "m"]
    independent: tuple[int, ...]
    newton_step: Callable[[float, np.ndarray], tuple[np.ndarray, np.ndarray] | None] | None  # of `DenseTerms.eliminated`

    by: ClassVar[ControlFlow] = BY_NUMPY

    @staticmethod
    def of(driven: Driven) -> "NumpyCurve":
        """Return the curve of a driven mechanism, which is cached for its mechanism, analysis and unit."""
        return _curve_of_concrete(driven.mechanism, driven.analysis, np.asarray(driven.unit).item())

    @classmethod
    def make(cls, mechanism: Mechanism, analysis: Analysis, unit: float) -> "NumpyCurve":
        scales = jax.tree.map(np.asarray, analysis.scales)
        units = np.append(np.tile([scales.length, scales.length, 1.0], analysis.coordinates // 3), unit)
        terms = DenseTerms.of(mechanism)
        eliminated = terms.eliminated(analysis.redundant_rows or (), float(scales.length))
        step = None if eliminated is None else eliminated.newton_step
        return cls(terms, scales.weights, units, scales.rows, analysis.independent_rows, step)

    @cached_property
    def _factors(self) -> Float[np.ndarray, "m n+1"]:
        return self.weights[:, None] * self.units

    @cached_property
    def _at_rest(self) -> Float[np.ndarray, "n"]:
        return np.zeros(len(self.units) - 1)

    @cached_property
    def _still(self) -> Float[np.ndarray, "m"]:
        return np.zeros(len(self.rows))

    def _geometry(self, X: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return Psi, Psi_s and the nonzero entries of Psi_q, unscaled."""
        x = X * self.units
        return self.terms.geometry(x[-1], x[:-1], self._at_rest)

    def residual(self, X: Any) -> Any:
        return self.weights * self._geometry(X)[0]

    def rounding(self, X: Any) -> Any:
        return _ROUNDING * max(1.0, np.abs(X).max())

    def violation(self, X: Any) -> Any:
        return np.abs(self._geometry(X)[0] / self.rows).max(initial=0.0)

    def slopes(self, X: Any) -> Any:
        return self._slopes(*self._geometry(X)[1:])

    def _slopes(self, rate: np.ndarray, entries: np.ndarray) -> np.ndarray:
        E = np.zeros(self._factors.shape)
        E[self.terms.entries] = entries
        E[:, -1] = rate
        return E * self._factors

    def plus(self, E: Any, tol: float = RANK_TOL) -> Any:
        return dense_pseudoinverse(E, tol, with_values=True)

    def inverse_singular_values(self, plus: Any) -> np.ndarray:
        return plus.inverse

    def gamma(self, s: Any, q: Any, v: Any) -> Any:
        return self.terms.gamma(s, q, v)

    def correct(self, X: Any, fixed: Any = False) -> tuple[Any, Any]:
        """Return the results of `AbstractCurve.correct`; a closed point is corrected by the pseudoinverse of the step before."""
        if not len(self.rows):
            return X, np.True_
        if fixed and (corrected := self._eliminate(X)) is not None:
            return corrected, np.True_
        plus, closed = None, np.False_
        for _ in range(NEWTON_STEPS):
            psi, rate, entries = self._geometry(X)
            closed = np.abs(psi / self.rows).max() <= self.rounding(X)
            if plus is None or not closed:
                plus = dense_pseudoinverse(self._slopes(self._still if fixed else rate, entries), RANK_TOL)
            X = X - plus @ (self.weights * psi)
            if closed:
                break
        return X, closed

    def _eliminate(self, X: Any) -> np.ndarray | None:
        """Return the nearest point of the curve with the same value, by elimination; None if that is not possible."""
        x = X * self.units
        q, s = x[:-1], float(x[-1])
        for _ in range(NEWTON_STEPS):
            found = self.newton_step and self.newton_step(s, q)
            if not found:
                return None
            q, psi = found
            if np.abs(psi / self.rows).max() <= CLOSURE.last:
                return np.concatenate([q, x[-1:]]) / self.units
        return None


@cached_by_identity
def _curve_of_concrete(mechanism: Mechanism, analysis: Analysis, unit: float) -> NumpyCurve:
    return NumpyCurve.make(mechanism, analysis, unit)
