"""The terms of a mechanism's equations in textbook form, in one program, with which several folders are compared."""

from typing import NamedTuple

import jax
import numpy as np

from udkjax.equations import constraints, loads


class Terms(NamedTuple):
    psi: np.ndarray
    psi_q: np.ndarray
    psi_dot: np.ndarray
    gamma: np.ndarray
    mass: np.ndarray  # the diagonal of M
    force: np.ndarray


@jax.jit  # operation by operation they are hundreds of programs
def _terms(mechanism, t, q, v):
    of_state = [f(mechanism, t, q, v) for f in (constraints.psi_dot, constraints.gamma, loads.force)]
    return constraints.psi(mechanism, t, q), constraints.psi_q(mechanism, t, q), *of_state[:2], loads.mass(mechanism), of_state[2]


def terms(mechanism, t, q, v=None) -> Terms:
    """Evaluate all terms at a state, by default at rest."""
    q = np.ravel(q)
    v = np.zeros_like(q) if v is None else np.ravel(v)
    return Terms(*map(np.asarray, _terms(mechanism.without_origin, float(t), q, v)))
