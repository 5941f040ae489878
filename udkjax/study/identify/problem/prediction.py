"""Predictions of measured values, with exact derivatives with respect to all unknowns.

A member is one run: a mechanism with its own parameters along one record. Parameters, initial states, times and tolerances are
inputs of a compiled program; the mechanism's structure, the targets, the channels and the length of a record are static.
Derivatives are in forward mode, for all members together.
"""

from collections import OrderedDict
from collections.abc import Hashable, Mapping
from functools import lru_cache, partial
from typing import Any, NamedTuple, TypeAlias, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from udkjax.annotations import NumericArray
from udkjax.devices import computing_on_host, on_host
from udkjax.integrate.simulate import simulate
from udkjax.positions.assembling.assembly import State, close
from udkjax.positions.assembling.channel_values import measure
from udkjax.positions.assembling.channels import Channel, Quantity
from udkjax.scene.elements.held import Held
from udkjax.study.identify.problem.unknowns import Target, apply_values
from udkjax.study.members import MOST_PROGRAMS, PIECE_MEMBERS, Program, structure_of
from udkjax.study.quantities import StudyModel

# Relative and absolute tolerances of the integration: for final estimates (the accuracy of parameters without noise); for
# singular values and the continuity of pieces; and for the search for a fit.
TIGHT_TOL, MEDIUM_TOL, LOOSE_TOL = 1e-11, 1e-9, 1e-7
FEWEST_IN_LANES = 1024  # fewer members are computed one by one, without compiling another program for vector lanes
CACHE_SIZE, CACHE_BYTES = 6, 2**24  # number of stored predictions (a fit returns to its best one), and their largest size

TolerancePair: TypeAlias = tuple[float, float]  # relative and absolute


class Runs(NamedTuple):
    """N runs, each along a record or a piece of one, with S >= 0 unknowns of the initial state."""

    ts: np.ndarray  # (N, T) s; the motion begins at the first time
    q: np.ndarray | None  # (N, bodies, 3) guess of the initial state; None: that of the scene
    v: np.ndarray | None
    bases: np.ndarray  # (N, 2, 3 bodies, S) derivatives of q and v with respect to the unknowns of the initial state
    conditions: Mapping[str, np.ndarray | Held]  # values by name, (N, ...), or (N, samples, ...)


class Members(NamedTuple):
    """The inputs of a compiled prediction for M members: parameters, initial-state unknowns and runs."""

    x: NumericArray  # (M, P) parameters
    shift: NumericArray  # (M, S) unknowns of the initial state
    runs: Runs


class Prediction(NamedTuple):
    """Predicted values of members, with derivatives with respect to (x, shift), and the results of the runs."""

    y: Float[np.ndarray, "M T C"]
    dy: Float[np.ndarray, "M T C P+S"]
    code: Int[np.ndarray, "M"]
    ends: np.ndarray | None = None  # (M, 2 times, 2, 3 bodies): states at the first and last time, if requested
    d_ends: np.ndarray | None = None  # (M, 2 times, 2, 3 bodies, P + S): derivatives of `ends`
    steps: np.ndarray | None = None  # (M,): numbers of steps of the integrations


class Predictor:
    """A function of members that predicts the values of channels, with stored results.

    Args:
        mechanism: the mechanism.
        targets: the numbers of the mechanism that the parameters of a member are assigned to.
        channels: the channels to predict.
        settings: further arguments of `simulate`.
        ends: True to return also the states at the first and last time of each run.

    Attributes:
        evaluations: number of members computed so far.
    """

    def __init__(
        self,
        mechanism: StudyModel,
        targets: tuple[Target, ...],
        channels: tuple[Channel | Quantity, ...],
        settings: Mapping[str, Any],
        ends: bool = False,
    ):
        self.evaluations = 0
        self._cache: OrderedDict[bytes, Prediction] = OrderedDict()
        arrays, static = eqx.partition((mechanism, dict(settings)), eqx.is_array)
        self._arrays = jax.tree.map(np.asarray, arrays)
        self._run = _MemberRun(static, targets, channels, ends)

    def __call__(self, members: Members, tol: TolerancePair) -> Prediction:
        """Return the prediction of members, integrated with the given tolerances; it may be a stored one."""
        size = len(members.x)
        key = b"".join(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves((members, tol)))
        if key in self._cache:
            return self._cache[key]
        self.evaluations += size
        piece = PIECE_MEMBERS if size >= FEWEST_IN_LANES else 1
        member = jax.tree.map(lambda x: x[0], members)
        program = _program(self._run, members.x.shape[1] + members.shift.shape[1], piece, structure_of((self._arrays, member)))
        with computing_on_host():
            values, slopes = program((self._arrays, np.array(tol)), members, on_threads=True)
        predicted = Prediction(values["y"], slopes["y"], values["code"], values.get("ends"), slopes.get("ends"), values["steps"])
        if sum(part.nbytes for part in predicted if part is not None) <= CACHE_BYTES:
            self._cache[key] = predicted
            if len(self._cache) > CACHE_SIZE:
                self._cache.popitem(last=False)
        return predicted

    def traced(self, members: Members, tol: TolerancePair) -> dict[str, Array]:
        """Return predictions for members within a program of JAX, by name: values "y" (M, T, C), results "code" (M,)."""

        def predict(member: Members) -> dict[str, Array]:
            no_shift = jnp.zeros(member.x.shape[0] + member.shift.shape[0])
            return self._run((self._arrays, jnp.array(tol)), member, no_shift)

        if len(members.x) == 1:  # `vmap` of a single member would execute all branches
            return jax.tree.map(lambda x: jnp.asarray(x)[None], predict(jax.tree.map(lambda x: x[0], members)))
        return jax.vmap(predict)(jax.tree.map(jnp.asarray, members))

    def second_derivatives(
        self, members: Members, tol: TolerancePair, first: Float[np.ndarray, "M P+S"], second: Float[np.ndarray, "M P+S"]
    ) -> Float[np.ndarray, "M T C"]:
        """Return the second derivatives of the predicted values by s where (x, shift) change by first s + second s^2 / 2."""
        inputs = [(jax.tree.map(lambda leaf, k=k: leaf[k], members), first[k], second[k]) for k in range(len(first))]
        return np.stack([np.asarray(_second_derivative(self._run, (self._arrays, np.array(tol)), *x)) for x in inputs])

    def guess(self, members: Members, which: int) -> State:
        """Return the guess from which the initial state of the member with index `which` is closed."""
        member = jax.tree.map(lambda leaf: leaf[which], members)
        return jax.tree.map(np.asarray, _guess(self._run, self._arrays, member))


class _MemberRun:
    """The computation of one member's prediction, hashable by its static part; equal computations share compiled programs."""

    def __init__(self, static: PyTree, *choices: Hashable):
        leaves, structure = jax.tree.flatten(static)
        self._key = (structure, tuple(leaves), choices)
        self._hash = hash(self._key)  # stored, since computing it takes as long as a short run
        self._static = static
        self.targets, self.channels, self.ends = cast(tuple[tuple[Target, ...], tuple[Channel | Quantity, ...], bool], choices)

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, _MemberRun) and self._key == other._key)

    def place(self, arrays: PyTree, member: Members) -> tuple[StudyModel, State, dict[str, Any]]:
        """Return the mechanism of a member, the guess from which its initial state is closed, and the settings."""
        run = member.runs
        mechanism, settings = eqx.combine(arrays, self._static)
        base = mechanism.with_parameters(run.conditions) if run.conditions else mechanism
        assigned = guess = apply_values(base, self.targets, member.x)
        if run.q is not None and run.v is not None:
            # Length parameters also move the record's guess; constants are computed from the scene's guess.
            guess = apply_values(base.with_guess(run.q, run.v), self.targets, member.x)
        q, v = jnp.einsum("iks,s->ik", run.bases, member.shift)
        q0, v0 = jnp.asarray(guess.q0), jnp.asarray(guess.v0)
        return assigned, State(q0 + q.reshape(q0.shape), v0 + v.reshape(q0.shape)), settings

    def __call__(self, shared: tuple[PyTree, Array], member: Members, shift: Array) -> dict[str, Array]:
        P = member.x.shape[0]
        member = member._replace(x=member.x + shift[:P], shift=member.shift + shift[P:])
        arrays, (rtol, atol) = shared
        mechanism, guess, settings = self.place(arrays, member)
        if settings["analysis"] is not None:  # a member has scales of its own
            settings["analysis"] = settings["analysis"].with_numbers_of(mechanism)
        closure = close(mechanism, member.runs.ts[0], guess, analysis=settings["analysis"])
        solution = simulate(mechanism, member.runs.ts, closure, rtol, atol, throw=False, **settings)
        predicted = {"y": measure(mechanism, solution, self.channels), "code": solution.code, "steps": solution.stats["steps"]}
        if self.ends:
            ends = jnp.stack([solution.q[jnp.array([0, -1])], solution.v[jnp.array([0, -1])]], axis=1)
            predicted["ends"] = ends.reshape(2, 2, -1)
        return predicted


@lru_cache(maxsize=MOST_PROGRAMS)
def _program(run: _MemberRun, slopes: int, piece: int, inputs: Hashable) -> Program:
    del inputs  # the static part alone does not tell an array from an absent number
    return Program(run, slopes, piece)


@on_host
@partial(jax.jit, static_argnums=0)
def _second_derivative(run: _MemberRun, shared: PyTree, member: Members, first: Array, second: Array) -> Array:
    values = lambda s: run(shared, member, s * first + 0.5 * s * s * second)["y"]  # noqa: E731
    slope = lambda s: jax.jvp(values, (s,), (jnp.ones(()),))[1]  # noqa: E731
    return jax.jvp(slope, (jnp.zeros(()),), (jnp.ones(()),))[1]


@on_host
@partial(jax.jit, static_argnums=0)
def _guess(run: _MemberRun, arrays: PyTree, member: Members) -> State:
    return run.place(arrays, member)[1]
