"""The Udwadia-Kalaba equation by elimination, as scalar programs of the value and of its first derivative (fast.py).

For every other pseudoinverse, and for all derivatives beyond the first, it is evaluated as it stands in the textbook.
"""

import dataclasses
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from udkjax.equations import fast
from udkjax.equations.analysis import Analysis, analyse
from udkjax.equations.code import Code, code, is_large, scalars, stacked
from udkjax.equations.motion import Closed, MechanismMotion, Tangential, Vector
from udkjax.equations.rank_policy import REVEAL, RankPolicy
from udkjax.equations.scales import Scales, rank_tolerance
from udkjax.equations.textbook import TextbookEquations
from udkjax.equations.udwadia_kalaba import Baumgarte
from udkjax.pinv import SVD, Auto, Elimination, Plus, Pseudoinverse, Varga
from udkjax.scene.mechanism import Mechanism
from udkjax.straightline import Loop, Program

FEW = 20  # coordinates: up to so many, `finish` has not too many results for a fusion of lanes (straightline/fusion.py)
# Steps with care begin on the constraint manifold, unless states are not projected, and only those beside singular configurations
# take it. Rows that count as redundant there and are not leave what they hold back in velocities, as large as the threshold, and
# rounding errors are as large as a unit over its square: both are least at some third root of a unit. With three times more,
# linkages that turn back in singular configurations take up to a quarter less steps, but Peaucellier's may cross with errors of
# 1e-5 in its energy, at any tolerance; with three times less they take up to two fifths more.
WITH_CARE = 0.2


class Equations(MechanismMotion):
    """The equations of motion of one mechanism by one method: what an integrator needs, ready to be evaluated.

    Coordinates and velocities are flat vectors (3 bodies,): x, y, angle of each body in turn.
    """

    constants: list[Array]  # the subexpressions of parameters alone that the programs use, computed once
    textbook: TextbookEquations  # the same as it stands, of the rows kept
    code: Code = eqx.field(static=True)
    policy: RankPolicy = REVEAL  # of `Auto`, which eliminates rows that are known to be independent
    loop: Loop | None = eqx.field(static=True, default=None)  # in which its programs run

    def accelerations(self, t: Any, q: Vector, v: Vector) -> Vector:
        """a = a_F + M^(-1/2) D^+ b."""
        return fast.accelerations("accelerations_watched" if self.branches else "accelerations", self, t, q, v)

    def multipliers(self, t: Any, q: Vector, v: Vector) -> Float[Array, "m"]:
        """lambda = -(D^+)^T D^+ b of all rows, by singular values."""
        return self.by(SVD).multipliers(t, q, v)

    def project(self, t: Any, q: Vector, v: Vector) -> tuple[Vector, Vector]:
        """Return q and v to Psi = 0 and Psi_dot = 0 by the smallest change in the mass metric."""
        return fast.project(self, t, q, v)

    def arrived(self, t: Any, q: Vector, v: Vector) -> tuple[Vector, Vector, Vector]:
        """q and v projected, and the accelerations there: by one elimination less."""
        return super().arrived(t, q, v) if self.branches else fast.arrived(self, t, q, v)

    def closed(self, t: Any, q: Vector, v: Vector, steps: int) -> Closed:
        return super().closed(t, q, v, steps) if self.branches else fast.closed(self, t, q, v, steps)

    @property
    def finishes(self) -> bool:
        few = self.loop is None or not self.loop.batch or self.code.n <= FEW
        return few and not self.branches

    def finished(self, t: Any, q: Vector, v: Vector, dq: Vector, dv: Vector) -> tuple[Vector, Vector, Vector, Tangential]:
        """q and v projected, the accelerations there, and what projection leaves of changes: by one elimination."""
        return fast.finished(self, t, q, v, dq, dv)

    def as_projected(self, t: Any, q: Vector, v: Vector) -> tuple[Vector, Vector]:
        """A state on the manifold, with the derivatives that `project` has where it returns it."""
        return fast.as_projected(self, t, q, v)

    def tangential(self, t: Any, q: Vector, v: Vector, dq: Vector, dv: Vector) -> Tangential:
        """(I - M^(-1/2) D^+ D M^(1/2)) of two vectors: what projection at q leaves of small changes."""
        return fast.tangential(self, t, q, v, dq, dv)

    def violation(self, t: Any, q: Vector, v: Vector) -> tuple[Array, Array]:
        """Psi and Psi_dot, of all rows: also of those that the method leaves out."""
        return stacked(self.run("psi", t, q, v)), stacked(self.run("psi_dot", t, q, v))

    def is_finite(self, t: Any, q: Vector, v: Vector) -> Bool[Array, ""]:
        """Whether everything that the equation is made of is a number."""
        return jnp.all(jnp.isfinite(stacked(self.run("rows", t, q, v))))

    def matrices(self, t: Any, q: Vector, v: Vector) -> tuple[Array, Vector, Array, Array]:
        """M, F, Psi_q and gamma - 2 alpha Psi_dot - beta^2 Psi, of all rows."""
        values, b, free, root = self.arrays("rows", t, q, v)
        M, A = 1 / root**2, self.code.pattern.dense(values) / root
        return jnp.diag(M), M * free, A, b + A @ free

    def jacobian(self, t: Any, q: Vector) -> Float[Array, "m n"]:
        """Psi_q of all rows."""
        values, _, root = self.arrays("closure", t, q, q)
        return self.code.pattern.dense(values) / root

    def weighted(self, t: Any, q: Vector) -> tuple[Float[Array, "m n"], Float[Array, "m"], Vector]:
        """D and Psi, their rows weighted, and M^(-1/2), of all rows."""
        values, psi, root = self.arrays("closure", t, q, q)
        w = self.scales.weights
        return w[:, None] * self.code.pattern.dense(values), w * psi, root

    def energy(self, t: Any, q: Vector, v: Vector) -> tuple[Array, Array]:
        """Kinetic and potential energy (J)."""
        kinetic, potential = self.run("energy", t, q, v)
        return kinetic, potential

    @property
    def method(self) -> Any:
        return self.textbook.method

    @property
    def scales(self) -> Scales:
        return self.textbook.scales

    @property
    def row_names(self) -> list[tuple[str, int]]:
        return self.code.equations.row_names

    @property
    def stabilized(self) -> bool:
        return bool(self.code.gains)

    @property
    def left_out(self) -> tuple[int, ...]:
        return self.code.left_out

    @property
    def constrained(self) -> bool:
        return bool(self.code.pattern.shape[0])

    @property
    def branches(self) -> bool:
        return self.policy.action == "reveal" and self.code.elimination == "check"

    def run(self, name: str, t: Any, q: Any, v: Any) -> list[Any]:
        """Evaluate one of the programs."""
        return self.call(self.code.program(name), t, q, v)

    def call(self, program: Program, *arrays: Any) -> list[Any]:
        """Evaluate a program of the constants and of all numbers of some arrays."""
        if self.loop is None:
            return program([*self.constants, *scalars(arrays)])
        return program.within(self.loop, [*self.constants, *(x for x in arrays if np.size(x))])

    def arrays(self, name: str, t: Any, q: Any, v: Any) -> list[Array]:
        """What a program returns, as arrays: the values of D, the right-hand side, and vectors over the coordinates."""
        outputs = self.run(name, t, q, v)
        n, pattern = len(q), self.code.pattern
        bounds = [0, pattern.slots, pattern.slots + pattern.shape[0]]
        bounds += list(range(bounds[-1] + n, len(outputs) + 1, n))
        return [stacked(outputs[i:j]) for i, j in pairwise(bounds)]

    def linearized(self, name: str, t: Any, q: Any, v: Any) -> tuple[Plus, Array, Vector]:
        """D^+ of all rows by a dense method, the right-hand side of the program `name`, and M^(-1/2); rows are weighted."""
        return self._on_all_rows(self.method).linearized(name, t, q, v)

    @property
    def refuses(self) -> bool:
        """Whether what a small pivot has to do with is not a number."""
        return self.policy.action == "refuse" and self.code.elimination == "check"

    def with_policy(self, policy: RankPolicy) -> "Equations":
        """The same with another decision about small pivots of `Auto`, which is the only method that has one to make."""
        constants, places = self.constants, [s.index for s in self.code.constants]
        if policy.threshold is not None and self.code.elimination == "check" and self.code.drop.index in places:
            drop = places.index(self.code.drop.index)
            constants = [policy.threshold if k == drop else c for k, c in enumerate(constants)]
        return dataclasses.replace(self, constants=constants, policy=policy)

    def by(self, method: type[Pseudoinverse], share: float = 1.0) -> TextbookEquations:
        """The same by another method on all rows, with a share of this one's rank threshold."""
        return self._on_all_rows(method(share * self.method.rank_tol, self.method.relative))

    @property
    def rank_revealing(self) -> TextbookEquations:
        """The same by Varga's method on all rows, which takes a fraction of the time that singular values take."""
        return self.by(Varga, WITH_CARE)

    def within(self, loop: Loop) -> "Equations":
        return dataclasses.replace(self, loop=loop)

    def _on_all_rows(self, method: Pseudoinverse) -> TextbookEquations:
        return dataclasses.replace(self.textbook, method=method, redundant=(), loop=self.loop)

    @property
    def plain(self) -> TextbookEquations:
        """The textbook's form of the same function, which derivatives are taken of where the programs have none."""
        return self.by(SVD) if self.branches else dataclasses.replace(self.textbook, loop=self.loop)

    def constants_of(self, mechanism: Mechanism, baumgarte: Baumgarte | None) -> list[Array]:
        """The constants as a function of the numbers of the scene and the gains."""
        gains = [] if baumgarte is None else [baumgarte.alpha, baumgarte.beta]
        numbers = [*scalars(jax.tree.leaves(mechanism)), *gains, jnp.zeros(()), jnp.zeros(())]
        return [jnp.asarray(c) for c in self.code.prologue(numbers)]


def prepare(
    mechanism: Mechanism,
    method: Pseudoinverse | None = None,
    baumgarte: Baumgarte | None = None,
    large: bool | None = None,
    moving: Sequence[bool] = (),
    analysis: Analysis | None = None,
    evaluated: bool = True,
) -> Any:
    """Prepare a mechanism for a method (default `Auto`). Its numbers may be traced; its structure decides what is compiled.

    Returns `Equations`, straight-line code, for elimination, `TextbookEquations` for every other method; or of a scene of more
    than `LARGE` elements `LargeEquations`, whose program does not grow with the scene. `large` says which, whatever the size.
    `moving` says of each leaf of the mechanism whether it is traced where all begins: of the others XLA may know the numbers,
    though they are traced here. Without it none is taken to be. `analysis` is that of `analyse`, by default made here. What is
    not `evaluated` lacks its constants: it is for whoever has code that computes them.

    A method without a `rank_tol` gets `rank_tolerance`. Without knowledge of which rows are redundant (a mechanism that was built
    from traced numbers) `Auto` takes singular values throughout, and `Elimination` drops what it finds dependent on the way.
    """
    analysis = analyse(mechanism) if analysis is None else analysis
    mechanism, redundant = mechanism.bare, analysis.redundant_rows
    chosen: Any = Auto() if method is None else method
    tol = rank_tolerance(mechanism) if chosen.rank_tol is None else chosen.rank_tol
    chosen = eqx.tree_at(lambda m: m.rank_tol, chosen, tol, is_leaf=lambda x: x is None)
    if isinstance(chosen, Elimination) and not chosen.relative:
        raise ValueError("Elimination compares each row with what remains of it: here its rank_tol must be relative")
    gains = [] if baumgarte is None else [baumgarte.alpha, baumgarte.beta]
    if is_large(mechanism) if large is None else large:
        from udkjax.equations.large import prepare_large  # and with it SciPy, which small scenes do without

        return prepare_large(mechanism, chosen, baumgarte, analysis, evaluated)
    elimination, drop = "drop", tol**2
    if isinstance(chosen, Auto) and redundant is not None:
        elimination, drop = "check", chosen.branch_tol
    elif not isinstance(chosen, Elimination):
        chosen = chosen.rank_revealing if isinstance(chosen, Auto) else chosen
        return TextbookEquations(mechanism=mechanism, method=chosen, baumgarte=baumgarte, scales=analysis.scales)
    programs = code(mechanism, redundant or (), baumgarte is not None, elimination)
    constants = []
    if evaluated:
        leaves = jax.tree.leaves(mechanism)
        numbers = [*scalars(leaves), *gains, drop, drop]
        moves = [move for leaf, move in zip(leaves, moving or [False] * len(leaves), strict=True) for _ in range(np.size(leaf))]
        found = programs.prologue.early(numbers, [*moves, *[False] * (len(numbers) - len(moves))])
        constants = [jnp.asarray(c) for c in found]
    textbook = TextbookEquations(
        mechanism=mechanism, method=chosen, baumgarte=baumgarte, scales=analysis.scales, redundant=redundant or ()
    )
    return Equations(constants=constants, textbook=textbook, code=programs)  # pyright: ignore[reportCallIssue]


def prepare_to_close(mechanism: Mechanism, large: bool | None = None, analysis: Analysis | None = None) -> Any:
    """As `prepare`, to close a mechanism: with all rows, by singular values, or in large scenes by elimination with damping."""
    if not (is_large(mechanism) if large is None else large):
        return prepare(mechanism, SVD(), large=False, analysis=analysis)
    from udkjax.equations.large import prepare_closing

    return prepare_closing(mechanism.bare, analyse(mechanism) if analysis is None else analysis)
