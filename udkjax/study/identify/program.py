"""The one compiled program: what members would have measured, and its exact derivatives by everything that is to be found.

A member is a mechanism with parameters of its own on the way of one record. Parameters, starts, times and tolerances are numbers
of the program; it is compiled once for a mechanism, its targets, its channels and the length of a record. Derivatives are taken
forward, of all members at once.
"""

import os
from collections import OrderedDict
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from udkjax.integrate.assembly import State, close
from udkjax.integrate.simulate import simulate
from udkjax.integrate.solution import Solution
from udkjax.integrate.solvers import forward_mode
from udkjax.scene.mechanism import Mechanism
from udkjax.study.identify.channels import Channel, Quantity, measured
from udkjax.study.identify.unknowns import Target, applied
from udkjax.study.machine import CHUNKED, MEMBERS

# Members from which on they are computed in lanes; fewer are computed one by one, which takes no further program.
MANY = 1024
# Evaluations that are kept, since a fit goes back to its best, and the bytes up to which one is.
AGAIN, KEPT = 6, 2**24


class Members(NamedTuple):
    """Numbers of members, which all of them have first. S: unknowns of a start, of which there may be none."""

    x: Any  # (M, P) parameters
    shift: Any  # (M, S) unknowns of the start
    ts: Any  # (M, T) s; the first is when the motion begins
    q: Any  # (M, bodies, 3) the guess of the start; None: that of the scene
    v: Any
    bases: Any  # (M, 2, 3 bodies, S) how each unknown of the start changes q and v
    conditions: Any  # values by name, (M, ...)


class Predicted(NamedTuple):
    """What members would have measured (M, T, C), its derivatives by x and shift (M, T, C, P + S), and how the runs ended (M,).

    With the states at the first and at the last time, (M, 2, 2, 3 bodies), and their derivatives, where these are asked for.
    """

    y: np.ndarray
    slope: np.ndarray
    code: np.ndarray
    end: np.ndarray | None = None
    end_slope: np.ndarray | None = None


class Program:
    """Computes members of a mechanism with values in `targets`, of which `channels` are measured."""

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
        self.calls = 0
        self._latest: OrderedDict[bytes, Predicted] = OrderedDict()
        self._arrays, fixed = eqx.partition((mechanism, self.settings), eqx.is_array)
        self._static = Static(fixed, targets, channels, ends)

    def __call__(self, members: Members, tol: tuple[float, float]) -> Predicted:
        """Compute members, by relative and absolute tolerances of the integration."""
        size = len(members.x)
        key = b"".join(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves((members, tol)))
        if key in self._latest:
            return self._latest[key]
        self.calls += size
        together = size if jax.default_backend() not in CHUNKED else MEMBERS if size >= MANY else 1
        starts = range(0, size, together)
        pieces = [jax.tree.map(lambda x, k=k: _rows(x, k, together), members) for k in starts]
        if len(pieces) > 1:
            self._piece(pieces[0], tol)  # compiled once, before threads ask for it
            with ThreadPoolExecutor(os.cpu_count()) as pool:
                parts = list(pool.map(lambda piece: self._piece(piece, tol), pieces))
        else:
            parts = [self._piece(pieces[0], tol)]
        found = Predicted(*jax.tree.map(lambda *x: np.concatenate(x)[:size], *parts))
        if sum(part.nbytes for part in found if part is not None) <= KEPT:
            self._latest[key] = found
            if len(self._latest) > AGAIN:
                self._latest.popitem(last=False)
        return found

    def guess(self, members: Members, which: int) -> tuple[Any, Any]:
        """The state that the start of a member is closed from."""
        _, state = _member(self.mechanism, jax.tree.map(lambda leaf: leaf[which], members), self.targets)
        return state.q, state.v

    def _piece(self, members: Members, tol: tuple[float, float]) -> tuple:
        return jax.tree.map(np.asarray, _computed(self._static, self._arrays, members, tol))


class Static:
    """What a program is compiled for; of two that are equal the second compiles nothing."""

    def __init__(self, fixed: Any, *rest: Any):
        leaves, structure = jax.tree.flatten(fixed)
        self.rest, self._key = rest, (structure, tuple(leaves), rest)
        self._hash = hash(self._key)  # once: it takes as long as a short run

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, Static) and self._key == other._key)

    @property
    def fixed(self) -> Any:
        """What is not an array, in its place."""
        structure, leaves, _ = self._key
        return jax.tree.unflatten(structure, leaves)


def _rows(x: np.ndarray, first: int, count: int) -> np.ndarray:
    """Some members, filled up with copies of the last."""
    return x[np.minimum(np.arange(first, first + count), len(x) - 1)]


@partial(jax.jit, static_argnums=0)
def _computed(static, arrays, members, tol):
    mechanism, settings = eqx.combine(arrays, static.fixed)
    targets, channels, ends = static.rest
    several = len(members.x) > 1

    def along(e):
        def at(x, shift):
            outputs, code = every(members._replace(x=x, shift=shift)) if several else one(members, x, shift)
            return outputs, code

        points = members.x, members.shift
        by = jnp.split(e, [members.x.shape[1]])
        tangents = tuple(jnp.broadcast_to(t, p.shape) for t, p in zip(by, points, strict=True))
        return jax.jvp(at, points, tangents, has_aux=True)

    def one(members, x, shift):
        member = jax.tree.map(lambda leaf: leaf[0], members._replace(x=x, shift=shift))
        mech, state = _member(mechanism, member, targets)
        closure = close(mech, member.ts[0], state, analysis=settings["analysis"])
        return jax.tree.map(lambda leaf: leaf[None], _run(mech, member.ts, closure, tol, settings, channels, ends))

    def every(members):
        mechs, states = jax.vmap(lambda member: _member(mechanism, member, targets))(members)
        closures = jax.vmap(lambda m, t, state: close(m, t, state, settings["analysis"]))(mechs, members.ts[:, 0], states)
        return jax.vmap(lambda m, ts, c: _run(m, ts, c, tol, settings, channels, ends))(mechs, members.ts, closures)

    size = members.x.shape[1] + members.shift.shape[1]
    outputs, slopes, code = jax.vmap(along, out_axes=(None, -1, None))(jnp.eye(size))
    return outputs[0], slopes[0], code, *outputs[1:], *slopes[1:]


def _member(mechanism: Mechanism, member: Members, targets: tuple[Target, ...]) -> tuple[Mechanism, State]:
    """The mechanism of a member, and the state that its start is closed from."""
    base = mechanism.with_parameters(member.conditions) if member.conditions else mechanism
    found = guess = applied(base, targets, member.x)
    if member.q is not None:  # lengths move the guess: that of the record, while the scene's own decides about the constants
        guess = applied(_guessing(base, member.q, member.v), targets, member.x)
    q, v = (part.reshape(-1, 3) for part in jnp.einsum("iks,s->ik", member.bases, member.shift))
    return found, State(guess.q0 + q, guess.v0 + v)


def _guessing(mechanism: Mechanism, q: Any, v: Any) -> Mechanism:
    values: dict[str, Any] = {}
    for k, body in enumerate(mechanism.body_names):
        values |= {f"body.{body}.position": q[k, :2], f"body.{body}.angle": q[k, 2]}
        values |= {f"body.{body}.velocity": v[k, :2], f"body.{body}.angular_velocity": v[k, 2]}
    return mechanism.with_parameters(values)


def _run(mechanism, ts, closure, tol, settings, channels, ends):
    solution: Solution = simulate(mechanism, ts, closure, *tol, adjoint=forward_mode(), throw=False, **settings)
    y = measured(mechanism, solution, channels)
    if not ends:
        return (y,), solution.code
    ends = jnp.stack([solution.q[jnp.array([0, -1])], solution.v[jnp.array([0, -1])]], axis=1)
    return (y, ends.reshape(2, 2, -1)), solution.code
