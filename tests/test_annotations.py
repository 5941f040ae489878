"""Beartype checks the annotated shapes of the textbook functions and the pseudoinverses; each type alias is defined once."""

import ast
from collections import Counter
from pathlib import Path

import udkjax
from tests.fresh_process import python

TYPES = "Any Array ArrayLike Bool Callable Float Int Iterable Literal Mapping PyTree Sequence dict list ndarray set tuple".split()

CODE = """
from jaxtyping import TypeCheckError, install_import_hook

methods = "svd varga greville householder gram_schmidt elimination auto orthogonal".split()
modules = [f"udkjax.equations.{name}" for name in ("terms.constraints", "terms.loads", "laws.udwadia_kalaba", "rows.determinacy")]
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


def is_type(node: ast.expr) -> bool:
    """Return True if an expression consists of types, like the value of an alias."""
    match node:
        case ast.Subscript():
            return is_type(node.value)
        case ast.BinOp(op=ast.BitOr()):
            return is_type(node.left) or is_type(node.right)
        case ast.Name(id=name) | ast.Attribute(attr=name):
            return name in TYPES
        case ast.Call(func=ast.Name(id="TypeAliasType")):
            return True
    return False


def aliases(text: str) -> list[str]:
    """Return the type aliases and the classes that a module defines, without type variables."""
    found = []
    for node in ast.parse(text).body:
        match node:
            case ast.ClassDef(name=name):
                found.append(name)
            case ast.AnnAssign(target=ast.Name(id=name), annotation=ast.Name(id="TypeAlias")):
                found.append(name)
            case ast.Assign(targets=[ast.Name(id=name)], value=value) if is_type(value):
                found.append(name)
    return found


def test_aliases_are_found():
    text = 'A = Float[Array, "n"] | None\nB: TypeAlias = "C | D"\nC = TypeAliasType("C", int)\nD = f(int)\n'
    text += 'T = TypeVar("T")\nE = 1 | 2\n'
    assert aliases(text) == ["A", "B", "C"]


def test_each_alias_has_one_meaning():
    root = Path(udkjax.__file__).parent
    files = [file for file in root.rglob("*.py") if root / "cli" not in file.parents]  # types of options share their names
    defined = Counter(name for file in files for name in aliases(file.read_text(encoding="utf-8")))
    assert len(defined) > 500
    assert [name for name, count in defined.items() if count > 1] == []
