"""What members would show, and its exact derivatives by everything that is to be found: one compiled function.

A member is a mechanism with parameters of its own on the way of one record. Parameters, initial states, times and tolerances are
numbers; a mechanism, its targets, its channels and the length of a record are compiled for. Derivatives are taken forward, of all
members at once.
"""

import os
from collections import OrderedDict
from collections.abc import Hashable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache, partial
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from udkjax.integrate.assembly import State, close
from udkjax.integrate.simulate import simulate
from udkjax.integrate.solution import Solution
from udkjax.scene.mechanism import Mechanism
from udkjax.study.channel_values import measure
from udkjax.study.channels import Channel, Quantity
from udkjax.study.identify.unknowns import Target, apply_values
from udkjax.study.machine import CHUNKED, MEMBERS, cores

# Tolerances of the integration, relative and absolute: of final estimates (parameters are known to that much where there is no
# noise); where singular values or the continuity of pieces are all that is asked for; and on the way to a fit.
TIGHT, MEDIUM, LOOSE = 1e-11, 1e-9, 1e-7
LANES_FROM = 1024  # members that are computed together in vector lanes; fewer one by one, which needs no second compilation
CACHE_SIZE, CACHE_BYTES = 6, 2**24  # predictions stored, since a fit goes back to its best one, and the largest of them

Numbers: TypeAlias = np.ndarray | Array
Tolerances: TypeAlias = tuple[float, float]  # relative and absolute


class Runs(NamedTuple):
    """N runs that show what was measured, each a record or a piece of one. S >= 0: unknowns of an initial state."""

    ts: np.ndarray  # (N, T) s; the first is when the motion begins
    q: np.ndarray | None  # (N, bodies, 3) the guess of the initial state; None: that of the scene
    v: np.ndarray | None
    bases: np.ndarray  # (N, 2, 3 bodies, S) how each unknown of the initial state changes q and v
    conditions: Mapping[str, np.ndarray]  # values by name, (N, ...)


class Members(NamedTuple):
    """The numbers of M members, by which a compiled prediction varies: parameters, and the run of each."""

    x: Numbers  # (M, P) parameters
    shift: Numbers  # (M, S) unknowns of the initial state
    runs: Runs


class Prediction(NamedTuple):
    """What would be measured of members, its derivatives by (x, shift), and how the runs ended.

    The last two are the states at the first and at the last time, and their derivatives, where these are asked for.
    """

    y: Float[np.ndarray, "M T C"]
    dy: Float[np.ndarray, "M T C P+S"]
    code: Int[np.ndarray, "M"]
    ends: np.ndarray | None = None  # (M, 2 times, 2, 3 bodies)
    d_ends: np.ndarray | None = None  # (M, 2 times, 2, 3 bodies, P + S)


class Predictor:
    """Predicts what `channels` of members show: of a mechanism with values in `targets`."""

    def __init__(
        self,
        mechanism: Mechanism,
        targets: tuple[Target, ...],
        channels: tuple[Channel | Quantity, ...],
        settings: Mapping[str, Any],
        ends: bool = False,
    ):
        self.mechanism, self.targets, self.channels, self.ends = mechanism, targets, channels, ends
        self.settings = dict(settings)
        self.evaluations = 0
        self._cache: OrderedDict[bytes, Prediction] = OrderedDict()
        self._arrays, fixed = eqx.partition((mechanism, self.settings), eqx.is_array)
        self._static = _Static(fixed, targets, channels, ends)

    def __call__(self, members: Members, tol: Tolerances) -> Prediction:
        """Predict members, integrated with these tolerances."""
        size = len(members.x)
        key = b"".join(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves((members, tol)))
        if key in self._cache:
            return self._cache[key]
        self.evaluations += size
        together = size if jax.default_backend() not in CHUNKED else MEMBERS if size >= LANES_FROM else 1
        chunks = [jax.tree.map(lambda x, k=k: _rows(x, k, together), members) for k in range(0, size, together)]
        parts = [self._compute(chunks[0], tol)]  # compiled once, before threads ask for it
        if len(chunks) > 1:
            parts += _pool(os.getpid()).map(lambda chunk: self._compute(chunk, tol), chunks[1:])
        found = Prediction(*jax.tree.map(lambda *x: np.concatenate(x)[:size], *parts))
        if sum(part.nbytes for part in found if part is not None) <= CACHE_BYTES:
            self._cache[key] = found
            if len(self._cache) > CACHE_SIZE:
                self._cache.popitem(last=False)
        return found

    def guess(self, members: Members, which: int) -> State:
        """Return the state from which the initial state of a member is closed."""
        member = jax.tree.map(lambda leaf: leaf[which], members)
        return jax.tree.map(np.asarray, _guess(self._static, self._arrays, member))

    def _compute(self, members: Members, tol: Tolerances) -> tuple:
        return jax.tree.map(np.asarray, _predict(self._static, self._arrays, members, tol))


class _Static:
    """The static argument of `_predict`: for equal ones it is compiled once."""

    def __init__(self, fixed: PyTree, *rest: Hashable):
        leaves, structure = jax.tree.flatten(fixed)
        self.rest, self._key = rest, (structure, tuple(leaves), rest)
        self._hash = hash(self._key)  # stored: it takes as long as a short run

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, _Static) and self._key == other._key)

    @property
    def static_part(self) -> PyTree:
        """What is not an array, in its place."""
        structure, leaves, _ = self._key
        return jax.tree.unflatten(structure, leaves)


@lru_cache(maxsize=1)
def _pool(process: int) -> ThreadPoolExecutor:
    """Return the threads of this process: to start them anew would take as long as a short run."""
    return ThreadPoolExecutor(cores(), thread_name_prefix="identify")


def _rows(x: np.ndarray, first: int, count: int) -> np.ndarray:
    """Return some members, filled up with copies of the last."""
    return x[np.minimum(np.arange(first, first + count), len(x) - 1)]


@partial(jax.jit, static_argnums=0)
def _guess(static, arrays, member):
    mechanism, _ = eqx.combine(arrays, static.static_part)
    return _place(mechanism, member, static.rest[0])[1]


@partial(jax.jit, static_argnums=0)
def _predict(static, arrays, members, tol):
    mechanism, settings = eqx.combine(arrays, static.static_part)
    targets, channels, ends = static.rest
    several = len(members.x) > 1

    def along(e):
        def at(x, shift):
            return (every if several else one)(members._replace(x=x, shift=shift))

        points = members.x, members.shift
        by = jnp.split(e, [members.x.shape[1]])
        tangents = tuple(jnp.broadcast_to(t, p.shape) for t, p in zip(by, points, strict=True))
        return jax.jvp(at, points, tangents, has_aux=True)

    def one(members):
        member = jax.tree.map(lambda leaf: leaf[0], members)
        mech, state = _place(mechanism, member, targets)
        closure = close(mech, member.runs.ts[0], state, analysis=settings["analysis"])
        return jax.tree.map(lambda leaf: leaf[None], _run(mech, member.runs.ts, closure, tol, settings, channels, ends))

    def every(members):
        mechs, states = jax.vmap(lambda member: _place(mechanism, member, targets))(members)
        ts = members.runs.ts
        closures = jax.vmap(lambda m, t, state: close(m, t, state, settings["analysis"]))(mechs, ts[:, 0], states)
        return jax.vmap(lambda m, ts, c: _run(m, ts, c, tol, settings, channels, ends))(mechs, ts, closures)

    size = members.x.shape[1] + members.shift.shape[1]
    outputs, derivatives, code = jax.vmap(along, out_axes=(None, -1, None))(jnp.eye(size))
    return outputs[0], derivatives[0], code, *outputs[1:], *derivatives[1:]


def _place(mechanism: Mechanism, member: Members, targets: tuple[Target, ...]) -> tuple[Mechanism, State]:
    """Return the mechanism of a member, and the state from which its initial state is closed."""
    run = member.runs
    base = mechanism.with_parameters(run.conditions) if run.conditions else mechanism
    found = guess = apply_values(base, targets, member.x)
    if run.q is not None and run.v is not None:
        # Lengths move the guess: that of the record, while the scene's own decides about the constants.
        guess = apply_values(_with_state(base, run.q, run.v), targets, member.x)
    q, v = (part.reshape(-1, 3) for part in jnp.einsum("iks,s->ik", run.bases, member.shift))
    return found, State(guess.q0 + q, guess.v0 + v)


def _with_state(mechanism: Mechanism, q: Numbers, v: Numbers) -> Mechanism:
    values: dict[str, Numbers] = {}
    for k, body in enumerate(mechanism.body_names):
        values |= {f"body.{body}.position": q[k, :2], f"body.{body}.angle": q[k, 2]}
        values |= {f"body.{body}.velocity": v[k, :2], f"body.{body}.angular_velocity": v[k, 2]}
    return mechanism.with_parameters(values)


def _run(mechanism, ts, closure, tol, settings, channels, ends):
    solution: Solution = simulate(mechanism, ts, closure, *tol, throw=False, **settings)
    y = measure(mechanism, solution, channels)
    if not ends:
        return (y,), solution.code
    ends = jnp.stack([solution.q[jnp.array([0, -1])], solution.v[jnp.array([0, -1])]], axis=1)
    return (y, ends.reshape(2, 2, -1)), solution.code
