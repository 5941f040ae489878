"""Annotated shapes of the textbook's functions and of the pseudoinverses, which beartype holds against the arrays."""

from tests.fresh_process import python

CODE = """
from jaxtyping import TypeCheckError, install_import_hook

methods = "svd varga greville householder gram_schmidt elimination auto orthogonal".split()
modules = [f"udkjax.equations.{name}" for name in ("constraints", "loads", "udwadia_kalaba", "determinacy")]
with install_import_hook([*modules, *(f"udkjax.pinv.{name}" for name in methods)], "beartype.beartype"):
    import udkjax as udk
    from udkjax.equations import constraints, determinacy, loads
    from udkjax.equations import udwadia_kalaba as uk

import jax
import numpy as np

A, b = np.array([[1.0, 2.0, 0.0], [2.0, 4.0, 0.0]]), np.ones(2)
for method in (udk.SVD(), udk.Varga(), udk.Greville(), udk.Householder(), udk.GramSchmidt(), udk.Elimination(), udk.Auto()):
    assert jax.eval_shape(method, A).shape == (3, 2) and jax.eval_shape(method.solve, A, b).x.shape == (3,)

mech, svd = udk.library.slider_crank(), udk.SVD()


def everything(q, v):
    found = [constraints.psi(mech, 0.0, q), constraints.psi_dot(mech, 0.0, q, v), constraints.gamma(mech, 0.0, q, v)]
    found += [loads.force(mech, 0.0, q, v), loads.kinetic_energy(mech, v), loads.potential_energy(mech, 0.0, q, v)]
    found += [uk.accelerations(mech, 0.0, q, v, svd, udk.Baumgarte()), uk.multipliers(mech, 0.0, q, v, svd)]
    found += [uk.project(mech, 0.0, q, v, svd), uk.tangent_part(mech, 0.0, q, v.ravel(), svd)]
    return found, determinacy.uniqueness(mech, 0.0, q)


for q, v in ((mech.q0, mech.v0), (mech.q0.ravel(), mech.v0.ravel())):
    jax.eval_shape(everything, q, v)  # shapes are known while it is traced

for wrong in (lambda: constraints.psi_q(mech, 0.0, q.reshape(-1, 3)[:, :2]), lambda: uk.tangent_part(mech, 0.0, q, v[:-1], svd)):
    try:
        jax.eval_shape(wrong)
    except TypeCheckError:
        print("refused")
"""


def test_arrays_have_the_annotated_shapes():
    assert python(CODE).split() == ["refused", "refused"]
