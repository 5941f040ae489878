"""The characteristic length, rate and mass of a mechanism, the units of every threshold.

See analysis.py for what they mean. They are computed alike by NumPy, where all numbers are known, and by JAX in a trace.
"""

from functools import reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udkjax.equations.scene_arrays import SceneArrays
from udkjax.equations.scene_programs import scene_programs
from udkjax.equations.structure import AnyArray, ArrayLibrary, NumericArray, numbers_as_vector
from udkjax.expressions.deferred import deferred
from udkjax.printing import prints_table, units
from udkjax.scene.fields import ROUNDING, library_for, number
from udkjax.scene.identity_cache import cached_by_identity
from udkjax.scene.mechanism import Mechanism

# Relative to the largest singular value of D: far above rounding and drift, far below the singular values of a mechanism in
# ordinary positions. With the states returned to the constraint manifold, 1e-2 to 1e-5 cross the same singular configurations.
RANK_TOL = 1e-4
ORDINARY_MASS_RATIO = 100.0  # up to which that holds: see `Scales.rank_tol`


class GuessTerms(NamedTuple):
    """The terms of the equations at the initial guess that the scales are made of; Psi_q by its entries."""

    rows: np.ndarray
    columns: np.ndarray
    psi_q: NumericArray
    free: NumericArray  # a_F
    psi_t: NumericArray
    gamma: NumericArray


class RowReach(NamedTuple):
    """Pairs of a row of Psi and a body that it meets: the row's change as the body moves by a metre, and turns by a radian."""

    row: np.ndarray
    body: np.ndarray
    moved: NumericArray
    turned: NumericArray


@prints_table
class Scales(NamedTuple):
    """The units of lengths, rates, masses and rows of Psi, and the rank threshold of D; arrays without derivatives.

    `rank_tol` is `RANK_TOL`, less where masses are far apart. Where a light body carries a heavy one the singular values of
    D = Psi_q M^(-1/2) are as far apart as the roots of the masses, in any position: a ratio of 1e8 brings a constraint between
    them down to 1e-4 of the largest. So does a body that hardly resists turning, such as a point mass at the end of a rod: to a
    row with an arm r it is as light as 1 / (1 / m + r^2 / I).
    """

    length: Float[Array, ""]  # m
    arm: Float[Array, ""]  # m; the longest of a constraint, masses aside; `length` where there is none
    rate: Float[Array, ""]  # 1/s; 0 where nothing moves and nothing pulls
    mass: Float[Array, ""]  # kg
    rows: Float[Array, "m"]  # m, rad or whatever the row is in
    rank_tol: Float[Array, ""]  # of D, its rows weighted, relative to its largest singular value

    _units = units(length="m", arm="m", rate="1/s", mass="kg")

    @property
    def weights(self) -> Float[Array, "m"]:
        """The weights of the rows of D with which one rank threshold serves them all: 1 for rows in metres, L for radians."""
        if isinstance(self.rows, np.ndarray) or library_for(self) is jnp:
            return self.length / self.rows
        return number(np.asarray(self.length) / np.asarray(self.rows))

    def coordinates(self, n: int) -> Float[Array, "n"]:
        """Return the units of coordinates: L, L and one radian for each body."""
        if library_for(self.length) is np:
            return number(np.tile([float(self.length), float(self.length), 1.0], n // 3))
        return jnp.tile(jnp.stack([self.length, self.length, jnp.ones_like(self.length)]), n // 3)

    def size(self, q: AnyArray, xp: ArrayLibrary = jnp) -> AnyArray:
        """Return the largest of a change of coordinates (n,): lengths over L, angles in rad."""
        x = xp.abs(q.reshape(-1, 3))
        return xp.maximum(xp.max(x[:, :2], initial=0.0) / self.length, xp.max(x[:, 2], initial=0.0))

    def violation(self, psi: AnyArray, xp: ArrayLibrary = jnp) -> AnyArray:
        """Return the largest of a violation (m,) of the rows of Psi, each over its scale."""
        return xp.max(xp.abs(psi) / self.rows, initial=0.0)


def known_scales(mechanism: Mechanism) -> Scales:
    """Return the scales of a mechanism whose numbers are known, by NumPy."""
    mechanism, q, v = _known_guess(mechanism)
    with np.errstate(all="ignore"):  # numbers that are not finite are no scales
        found = _scales(mechanism, _guess_terms(mechanism, q, v, np), np)
    return jax.tree.map(number, found)


def scales_by_masses(scales: Scales, known: Mechanism, mechanism: Mechanism) -> Scales:
    """Return the scales of a known mechanism, with the rank threshold of the masses of one that was made from it.

    A threshold decides what is a rank, and masses may be far apart in some member of a batch alone. Units decide how accurate a
    run is, and those of the known mechanism serve: to trace a whole scene for them takes half a second of XLA's.
    """
    mass, inertia = jax.lax.stop_gradient(_masses(mechanism))
    return scales._replace(rank_tol=_deferred_rank_tol(_known_reach(known), scales.weights, mass, inertia))


@cached_by_identity
def _known_reach(mechanism: Mechanism) -> RowReach:
    """Return how rows meet bodies in a mechanism of known numbers, by NumPy."""
    mechanism, q, v = _known_guess(mechanism)
    with np.errstate(all="ignore"):
        return _reach(mechanism, _guess_terms(mechanism, q, v, np), np)


def _known_guess(mechanism: Mechanism) -> tuple[Mechanism, np.ndarray, np.ndarray]:
    """Return a mechanism of known numbers as arrays of NumPy, at the time 0, and its guess."""
    mechanism = jax.tree.map(np.asarray, mechanism.at(0.0))
    q, v = (np.asarray(x, float).ravel() for x in (mechanism.q0, mechanism.v0))
    return mechanism, q, v


def traced_scales(mechanism: Mechanism) -> Scales:
    """Return the same in a trace; without derivatives."""
    return _traced_scales(jax.lax.stop_gradient(mechanism.without_origin))


@deferred
def _traced_scales(mechanism: Mechanism) -> Scales:
    mechanism = mechanism.at(0.0)
    q, v = mechanism.q0.ravel(), mechanism.v0.ravel()
    return _scales(mechanism, _guess_terms(mechanism, q, v, jnp), jnp)


def _guess_terms(mechanism: Mechanism, q: NumericArray, v: NumericArray, xp: ArrayLibrary) -> GuessTerms:
    """Return the terms of a scene at the initial guess, by its programs."""
    programs = scene_programs(mechanism)
    row, column, *_ = programs.psi_q_entries
    arrays = SceneArrays(programs, xp.asarray(numbers_as_vector(mechanism.numbers)), xp)
    _, rate, psi_q = arrays.geometry(0.0, q, 0 * v)
    free, b = arrays.loads(0.0, q, v)
    moved = xp.sum(_grouped(psi_q * free[column], np.asarray(row), programs.row_count, xp), 1)
    return GuessTerms(row, column, psi_q, free, rate, b + moved)


def _grouped(values: Any, group: np.ndarray, count: int, xp: ArrayLibrary) -> Any:
    """Return values by the groups that they are in, (groups, most of one), with zeros in the places that are left over.

    A sum over them is a few operations that XLA fuses, where adding to the places of an array is a loop.
    """
    size = np.bincount(group, minlength=count)
    order = np.argsort(group, kind="stable")
    place = np.full((count, int(size.max(initial=0))), len(group))
    place[group[order], np.arange(len(group)) - np.repeat(np.cumsum(size) - size, size)] = order
    return xp.append(values, 0.0)[place]


def mass_of(mechanism: Mechanism, xp: ArrayLibrary) -> NumericArray:
    """Return the diagonal of the mass matrix, by NumPy or JAX."""
    mass, inertia = _masses(mechanism)
    return xp.ravel(xp.stack([mass, mass, inertia], 1))


def _masses(mechanism: Mechanism) -> tuple[Any, Any]:
    """Return the masses and the moments of inertia of all bodies."""
    bodies = mechanism.bodies.values()
    return numbers_as_vector([body.mass for body in bodies]), numbers_as_vector([body.inertia for body in bodies])


def _scales(mechanism: Mechanism, guess: GuessTerms, xp: ArrayLibrary) -> Scales:
    mass, inertia = (xp.asarray(x) for x in _masses(mechanism))
    free, psi_t, gamma = guess[3:]
    length = arm = xp.max(xp.sqrt(inertia / mass))
    reach = _reach(mechanism, guess, xp)
    of_row, moved, turned = reach.row, reach.moved, reach.turned
    if len(of_row):
        by_place = moved > ROUNDING * xp.max(moved)
        arm = xp.where(by_place, turned / xp.where(by_place, moved, 1.0), 0.0)
        arm = xp.max(xp.where(xp.isfinite(arm), arm, 0.0))
        arm = xp.where(arm > ROUNDING * length, arm, length)
        length = xp.maximum(length, arm)
    change = xp.maximum(moved * length, turned)
    scale = xp.max(_grouped(change, of_row, len(psi_t), xp), 1, initial=0.0)
    scale = xp.where(xp.isfinite(scale), scale, 0.0)
    moves = scale > ROUNDING * xp.max(scale, initial=0.0)
    scale = xp.where(moves, scale, length)  # a row that nothing moves here: as if in metres

    unit = xp.tile(xp.stack([length, length, xp.ones_like(length)]), len(mass))
    v = xp.asarray(mechanism.v0).ravel()
    # An acceleration a lets a pendulum of length L swing to and fro in pi sqrt(L / a) each.
    swings = (xp.sqrt(_largest(x, xp)) / np.pi for x in (free / unit, gamma / scale))
    rates = [_largest(v / unit, xp), _largest(psi_t / scale, xp), *swings]
    rank_tol = _rank_tol(reach, length / scale, mass, inertia, xp)
    return Scales(length, arm, reduce(xp.maximum, rates), xp.max(mass), scale, rank_tol)


def _reach(mechanism: Mechanism, guess: GuessTerms, xp: ArrayLibrary) -> RowReach:
    """Return how the rows of Psi meet bodies at the initial guess."""
    count, turns = len(mechanism.bodies), guess.columns % 3 == 2
    pair, of_entry = np.unique(guess.rows * count + guess.columns // 3, return_inverse=True)
    psi_q, turns = _grouped(guess.psi_q, of_entry, len(pair), xp), _grouped(turns, of_entry, len(pair), np) > 0
    moved = xp.sqrt(xp.sum(xp.where(turns, 0.0, psi_q**2), 1))
    return RowReach(pair // count, pair % count, moved, xp.sum(xp.where(turns, xp.abs(psi_q), 0.0), 1))


def _rank_tol(reach: RowReach, weights: Any, mass: Any, inertia: Any, xp: ArrayLibrary = jnp) -> Any:
    """Return the rank threshold of D, its rows weighted."""
    yields = reach.moved**2 / mass[reach.body] + reach.turned**2 / inertia[reach.body]  # 1/kg, of a row at a body
    most = _largest(yields * weights[reach.row] ** 2, xp) * xp.max(mass)
    return RANK_TOL / xp.sqrt(xp.maximum(1.0, most / ORDINARY_MASS_RATIO))


_deferred_rank_tol = deferred(_rank_tol)


def _largest(x: NumericArray, xp: ArrayLibrary) -> NumericArray:
    """Return the largest size of those that are finite."""
    return xp.max(xp.where(xp.isfinite(x), xp.abs(x), 0.0), initial=0.0)
