"""The derivation of the accelerations for one state, with the paper's symbols and numbers: `explain`.

Each symbol is computed by a textbook function (equations/terms/constraints.py, textbook.py, udwadia_kalaba.py). The
equations of motion, the constraints, Penrose's four conditions and Gauss's principle are checked.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from udkjax.arrays import number
from udkjax.equations import constraints, determinacy
from udkjax.equations import udwadia_kalaba as uk
from udkjax.equations.laws.udwadia_kalaba import Baumgarte
from udkjax.equations.rows.analysis import Analysis, analyse
from udkjax.equations.states.quantities import equations_of
from udkjax.pinv import SVD
from udkjax.positions.assembling.assembly import State, assemble
from udkjax.programs.deferred import deferred
from udkjax.requirements import concrete_only
from udkjax.scene.arguments import checked
from udkjax.scene.elements.friction import Friction
from udkjax.scene.mechanism import Mechanism
from udkjax.study.diagnosis.joint_friction import joint_friction
from udkjax.study.explanation import Explanation, Gauss, RubbingTerms

N_RIVALS = 200  # number of random feasible accelerations to compare a with


@checked
@concrete_only(instead="accelerations and uniqueness, which are pure")
def explain(
    mechanism: Mechanism, t: float = 0.0, state: State | None = None, stabilization: Baumgarte | None = None
) -> Explanation:
    """Derive the accelerations and multipliers of one state, step by step, with numbers; print the result.

    F includes friction that depends on joint loads, computed with the loads of the result.

    Args:
        mechanism: mechanism with concrete numbers.
        t: time (s), for drivers and loads.
        state: the state; it is closed first. By default the initial guess.
        stabilization: adds Baumgarte's terms to b; by default there are none.

    Returns:
        The `Explanation`: Psi, Psi_q, M, gamma, F, D, D^+, a_F, b, a, lambda, and the checks.

    Raises:
        AssemblyError: the state cannot be closed.
        ValueError: numbers of the mechanism are traced.

    Source:
        D. de Falco, E. Pennestri, L. Vita, The Udwadia-Kalaba formulation, ECCOMAS Multibody Dynamics 2005, section 3.
    """
    mechanism.require_masses("accelerations")
    state = assemble(mechanism, t, state)
    analysis = analyse(mechanism)
    q, v = jnp.ravel(state.q), jnp.ravel(state.v)
    symbols = _symbols(mechanism.without_origin, analysis, number(t), q, v, stabilization, analysis.scales.rank_tol)
    terms: dict[str, Array] = symbols.pop("friction")
    s = {name: np.asarray(value) for name, value in symbols.items()}
    rank, null_rows = int(s.pop("rank")), s.pop("null_rows")
    marks = joint_friction(
        equations_of(mechanism, SVD(), analysis=analysis), t, q, null_rows * np.asarray(analysis.scales.rows)[:, None]
    )
    names = {f.joint: name for name, f in mechanism.forces.items() if isinstance(f, Friction) and f.rubs}
    return Explanation(
        mechanism=mechanism,
        t=float(t),
        q=np.asarray(q),
        v=np.asarray(v),
        row_names=analysis.row_names,
        rank=rank,
        null_rows=null_rows[:, np.linalg.norm(null_rows, axis=0) > 0],
        constraint_force=-s["psi_q"].T @ s["multipliers"],
        friction={
            names[joint]: RubbingTerms(joint, float(x[0]), float(x[1]), float(x[2]), marks[joint].load)
            for joint, x in terms.items()
        },
        gauss=_gauss(s, rank),
        checks=_checks(s),
        **s,
    )


@deferred
def _symbols(
    mechanism: Mechanism, analysis: Analysis, t: Array, q: Array, v: Array, baumgarte: Baumgarte | None, tol: ArrayLike
) -> dict[str, Any]:
    w, method = analysis.scales.weights, SVD(rank_tol=tol)
    equations = equations_of(mechanism, method, baumgarte, analysis=analysis)
    M, F, psi_q, required = equations.matrices(t, q, v)
    a, multipliers = equations.motion(t, q, v)
    rows, columns = psi_q.shape
    D, mass = uk.D(mechanism, t, q, w), jnp.diagonal(M)
    return {
        "psi": constraints.psi(mechanism, t, q),
        "psi_dot": constraints.psi_dot(mechanism, t, q, v),
        "psi_q": psi_q,
        "gamma": constraints.gamma(mechanism, t, q, v),
        "mass": mass,
        "force": F,
        "friction": equations.rubbing_terms(q, v, multipliers),
        "weights": w,
        "D": D,
        "singular_values": jnp.linalg.svd(D, compute_uv=False) if rows else jnp.zeros(0),
        "rank": method.rank(D) if rows else jnp.zeros((), int),
        "D_plus": method(D) if rows else jnp.zeros((columns, 0)),
        "a_F": F / mass,
        "b": w * (required - psi_q @ (F / mass)),
        "a": a,
        "multipliers": multipliers,
        "unique": determinacy.uniqueness(mechanism, t, q, analysis).unique,
        "null_rows": determinacy.left_null_space(mechanism, t, q, analysis).basis / analysis.row_units[:, None],
    }


def _gauss(symbols: dict[str, np.ndarray], rank: int) -> Gauss:
    root = np.sqrt(symbols["mass"])
    deviation = root * (symbols["a"] - symbols["a_F"])  # M^(1/2) (a - a_F)
    free = np.linalg.svd(symbols["D"])[2][rank:].T if len(symbols["D"]) else np.eye(len(root))  # M^(1/2) V
    size = float(np.linalg.norm(deviation))
    slope = float(np.abs(free.T @ deviation).max(initial=0.0)) / (size if size > 0 else 1.0)
    spread = max(size, float(np.linalg.norm(root * symbols["a_F"])), np.finfo(float).tiny) / 10
    steps = np.random.default_rng(0).standard_normal((N_RIVALS if free.shape[1] else 0, free.shape[1])) * spread
    rivals = 0.5 * np.sum((deviation + steps @ free.T) ** 2, axis=1)
    return Gauss(0.5 * size**2, free.shape[1], slope, float(rivals.min(initial=np.inf)), len(rivals))


def _checks(symbols: dict[str, np.ndarray]) -> dict[str, float]:
    """Return the residuals of the equations and of Penrose's conditions by name, each relative to its largest term."""
    inertia, reaction = symbols["mass"] * symbols["a"], symbols["psi_q"].T @ symbols["multipliers"]
    required = symbols["b"] + symbols["D"] @ (
        np.sqrt(symbols["mass"]) * symbols["a_F"]
    )  # of the rows of D, with Baumgarte's terms
    D, plus = symbols["D"], symbols["D_plus"]
    return {
        "M a + Psi_q^T lambda - F": _relative(inertia + reaction - symbols["force"], inertia, reaction, symbols["force"]),
        "Psi_q a - gamma": _relative(D @ (np.sqrt(symbols["mass"]) * symbols["a"]) - required, required, symbols["b"]),
        "D D^+ D - D": _relative(D @ plus @ D - D, D),
        "D^+ D D^+ - D^+": _relative(plus @ D @ plus - plus, plus),
        "(D D^+)^T - D D^+": _relative((D @ plus).T - D @ plus, np.ones(1)),
        "(D^+ D)^T - D^+ D": _relative((plus @ D).T - plus @ D, np.ones(1)),
    }


def _relative(difference: np.ndarray, *parts: np.ndarray) -> float:
    size = max(float(np.abs(part).max(initial=0.0)) for part in parts)
    return float(np.abs(difference).max(initial=0.0)) / (size if size > 0 else 1.0)
