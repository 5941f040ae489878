"""The derivation of the accelerations for one state, with the paper's symbols and numbers: `explain`.

Everything comes from the textbook's functions (equations/constraints.py, loads.py, udwadia_kalaba.py), one symbol each, and each
claim is checked beside it: the equations of motion, the constraints, Penrose's four conditions, and Gauss's principle.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from udkjax.equations import constraints, loads
from udkjax.equations import udwadia_kalaba as uk
from udkjax.equations.analysis import Analysis, analyse
from udkjax.equations.determinacy import left_null_space, uniqueness
from udkjax.equations.scales import rank_tolerance
from udkjax.equations.udwadia_kalaba import Baumgarte
from udkjax.integrate.assembly import State, assemble
from udkjax.pinv import SVD
from udkjax.scene.mechanism import Mechanism
from udkjax.study.explanation_texts import as_dict, as_html, as_text

RIVALS = 200  # feasible accelerations that a is compared with


class Gauss(NamedTuple):
    """Gauss's principle: of all accelerations that the constraints allow, a deviates least from a_F.

    G(x) = (x - a_F)^T M (x - a_F) / 2. Feasible is a + V y, V spanning what the constraints leave free, M-orthonormal; then
    G(a + V y) = G(a) + y . V^T M (a - a_F) + |y|^2 / 2, least at y = 0 if and only if V^T M (a - a_F) = 0.
    """

    at_a: float  # G(a), kg m^2/s^4
    free: int  # columns of V
    slope: float  # the largest of |V^T M (a - a_F)|, relative to |M^(1/2) (a - a_F)|: zero
    least_rival: float  # the least G of feasible accelerations at random
    rivals: int


class Explanation(NamedTuple):
    """Every symbol of section 3 of the paper for one state. Rows are those of Psi, columns x, y, angle of each body."""

    mechanism: Mechanism
    t: float
    q: Float[np.ndarray, "n"]
    v: Float[np.ndarray, "n"]
    row_names: tuple[tuple[str, int], ...]
    psi: Float[np.ndarray, "m"]
    psi_dot: Float[np.ndarray, "m"]
    psi_q: Float[np.ndarray, "m n"]
    gamma: Float[np.ndarray, "m"]
    mass: Float[np.ndarray, "n"]  # the diagonal of M
    force: Float[np.ndarray, "n"]  # F
    weights: Float[np.ndarray, "m"]  # of the rows of D and b
    D: Float[np.ndarray, "m n"]
    singular_values: Float[np.ndarray, "k"]  # of D
    rank: int
    D_plus: Float[np.ndarray, "n m"]
    a_F: Float[np.ndarray, "n"]
    b: Float[np.ndarray, "m"]
    a: Float[np.ndarray, "n"]
    multipliers: Float[np.ndarray, "m"]
    unique: Bool[np.ndarray, "m"]  # of the multipliers
    null_rows: Float[np.ndarray, "m k"]  # N: combinations of rows of Psi_q that vanish
    constraint_force: Float[np.ndarray, "n"]  # -Psi_q^T lambda
    gauss: Gauss
    checks: dict[str, float]  # what must vanish, relative to what it is the difference of

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain numbers, lists and texts, for JSON."""
        return as_dict(self)

    def __str__(self) -> str:
        return as_text(self)

    def __repr__(self) -> str:
        return f"Explanation({self.mechanism.name!r}, t = {self.t:g}, rank {self.rank} of {len(self.psi)} rows)"

    def _repr_html_(self) -> str:
        return as_html(self)


def explain(
    mechanism: Mechanism, t: float = 0.0, state: State | None = None, stabilization: Baumgarte | None = None
) -> Explanation:
    """Derive the accelerations and multipliers of one state, step by step, with numbers; print the result.

    Args:
        mechanism: its numbers are known.
        t: time (s), for drivers and loads.
        state: the state; it is closed first. By default the initial guess.
        stabilization: Baumgarte's terms in b, if any.

    Returns:
        The `Explanation`: Psi, Psi_q, M, gamma, F, D, D^+, a_F, b, a, lambda, and the checks.

    Raises:
        AssemblyError: the state cannot be closed.
        ValueError: numbers of the mechanism are traced.

    Source:
        D. de Falco, E. Pennestri, L. Vita, The Udwadia-Kalaba formulation, ECCOMAS Multibody Dynamics 2005, section 3.
    """
    if not mechanism.is_concrete:
        raise ValueError("explain takes known numbers; under jit and vmap take accelerations and uniqueness, which are pure")
    state = assemble(mechanism, t, state)
    analysis = analyse(mechanism)
    q, v = jnp.ravel(state.q), jnp.ravel(state.v)
    symbols = _symbols(mechanism.without_origin, analysis, float(t), q, v, stabilization, rank_tolerance(mechanism))
    s = {name: np.asarray(value) for name, value in symbols.items()}
    n = len(s["a"])
    rank = int(s["rank"])
    null_rows = s["null"][:, np.linalg.norm(s["null"], axis=0) > 0]
    return Explanation(
        mechanism=mechanism,
        t=float(t),
        q=np.asarray(q),
        v=np.asarray(v),
        row_names=analysis.row_names,
        **{
            key: s[key]
            for key in ("psi", "psi_dot", "psi_q", "gamma", "mass", "force", "weights", "D", "D_plus", "a_F", "b", "a")
        },
        singular_values=s["sigma"],
        rank=rank,
        multipliers=s["multipliers"],
        unique=s["unique"],
        null_rows=null_rows,
        constraint_force=-s["psi_q"].T @ s["multipliers"] if len(s["psi"]) else np.zeros(n),
        gauss=_gauss(s, rank),
        checks=_checks(s),
    )


@jax.jit
def _symbols(
    mechanism: Mechanism, analysis: Analysis, t: Any, q: Any, v: Any, baumgarte: Baumgarte | None, tol: Any
) -> dict[str, Any]:
    w, method = analysis.scales.weights, SVD(rank_tol=tol)
    psi_q = constraints.psi_q(mechanism, t, q)
    rows, columns = psi_q.shape
    D, unique = uk.D(mechanism, t, q, w), uniqueness(mechanism, t, q, analysis)
    null = left_null_space(mechanism, t, q, analysis).basis / analysis.scales.rows[:, None]
    sigma = jnp.linalg.svd(D, compute_uv=False) if rows else jnp.zeros(0)
    return {
        "psi": constraints.psi(mechanism, t, q),
        "psi_dot": constraints.psi_dot(mechanism, t, q, v),
        "psi_q": psi_q,
        "gamma": constraints.gamma(mechanism, t, q, v),
        "mass": loads.mass(mechanism),
        "force": loads.force(mechanism, t, q, v),
        "weights": w,
        "D": D,
        "sigma": sigma,
        "rank": method.rank(D) if rows else jnp.zeros((), int),
        "D_plus": method(D) if rows else jnp.zeros((columns, 0)),
        "a_F": uk.a_F(mechanism, t, q, v),
        "b": uk.b(mechanism, t, q, v, baumgarte, w),
        "a": uk.accelerations(mechanism, t, q, v, method, baumgarte, w),
        "multipliers": uk.multipliers(mechanism, t, q, v, method, baumgarte, w),
        "unique": unique.unique,
        "null": null,
    }


def _gauss(s: dict[str, np.ndarray], rank: int) -> Gauss:
    root = np.sqrt(s["mass"])
    deviation = root * (s["a"] - s["a_F"])  # M^(1/2) (a - a_F)
    free = np.linalg.svd(s["D"])[2][rank:].T if len(s["D"]) else np.eye(len(root))  # M^(1/2) V
    size = float(np.linalg.norm(deviation))
    slope = float(np.abs(free.T @ deviation).max(initial=0.0)) / (size if size > 0 else 1.0)
    spread = max(size, float(np.linalg.norm(root * s["a_F"])), np.finfo(float).tiny) / 10
    steps = np.random.default_rng(0).standard_normal((RIVALS if free.shape[1] else 0, free.shape[1])) * spread
    rivals = 0.5 * np.sum((deviation + steps @ free.T) ** 2, axis=1)
    return Gauss(0.5 * size**2, free.shape[1], slope, float(rivals.min(initial=np.inf)), len(rivals))


def _checks(s: dict[str, np.ndarray]) -> dict[str, float]:
    """What must vanish, each relative to the largest number that it is the difference of."""
    inertia, reaction = s["mass"] * s["a"], s["psi_q"].T @ s["multipliers"]
    asked = s["b"] + s["D"] @ (np.sqrt(s["mass"]) * s["a_F"])  # of the rows of D, with Baumgarte's terms
    D, plus = s["D"], s["D_plus"]
    return {
        "M a + Psi_q^T lambda - F": _relative(inertia + reaction - s["force"], inertia, reaction, s["force"]),
        "Psi_q a - gamma": _relative(D @ (np.sqrt(s["mass"]) * s["a"]) - asked, asked, s["b"]),
        "D D^+ D - D": _relative(D @ plus @ D - D, D),
        "D^+ D D^+ - D^+": _relative(plus @ D @ plus - plus, plus),
        "(D D^+)^T - D D^+": _relative((D @ plus).T - D @ plus, np.ones(1)),
        "(D^+ D)^T - D^+ D": _relative((plus @ D).T - plus @ D, np.ones(1)),
    }


def _relative(difference: np.ndarray, *parts: np.ndarray) -> float:
    size = max(float(np.abs(part).max(initial=0.0)) for part in parts)
    return float(np.abs(difference).max(initial=0.0)) / (size if size > 0 else 1.0)
