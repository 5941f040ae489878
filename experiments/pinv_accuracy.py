"""The errors of orthogonal pseudoinverses are about eps cond(A), those of Greville and elimination about eps cond(A)^2.

The matrices are two families whose pseudoinverses are known exactly for every e, in rational arithmetic, and 27 single
matrices:

    gap       12 x 12, rank 11: ten singular values 1, one e, one 0. Two members of the collection give all others, since both
              A = A_0 + e B and A^+ = P_0 + C / e are straight lines.
    Lauchli   6 x 5, rank 5: a row of ones over e I. A^+ = (I - 11^T / (5 + e^2)) / e^2 A^T (Lauchli, Numer. Math. 3 (1961) 226).

An orthogonal factorization is exact for a matrix at a distance of eps |A| from A, and the relative error of A^+ is cond(A)
times this relative distance (Wedin, BIT 13 (1973) 217). Rounding the entries of A alone costs as much, so no method can do
better. With pivoting, modified Gram-Schmidt is as accurate even if it orthogonalizes once: the columns of Q lose their
orthogonality by eps cond, which is no more than the error that exists anyway. Elimination works on A A^T, whose condition is
cond(A)^2. Greville's recursion multiplies P = A_k^+, whose error is eps cond |P|, by the next row: c, the new part of the row,
then has an error of eps cond, too, which is large relative to c if c is as short as 1 / cond. Lauchli's matrices are
ill-conditioned only because of the sizes of their rows, which do not affect an orthogonal factorization.

A threshold decides the rank. `between` is the geometric mean of the smallest singular value that counts, 1 / cond, and the
value that rounding leaves of a zero: eps, with Greville eps cond, with elimination the root of eps. Both values are known for
test matrices only. `default` is the default threshold of the method.
"""

import json
from fractions import Fraction
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray
from matplotlib.figure import Figure

from experiments.common import described, panels, tracked
from udkjax.pinv import SVD, Elimination, GramSchmidt, Greville, Householder, Varga

MATRICES = Path(__file__).parents[1] / "tests" / "data" / "pinv_test_matrices.json"
METHODS = {
    "SVD": SVD,
    "Varga": Varga,
    "Householder": Householder,
    "Gram-Schmidt": GramSchmidt,
    "Gram-Schmidt once": lambda **tol: GramSchmidt(twice=False, **tol),
    "Greville": Greville,
    "Elimination": Elimination,
}
LINEAR = ("SVD", "Varga", "Householder", "Gram-Schmidt", "Gram-Schmidt once")  # errors of the order of eps cond
SIZE = 12  # rows and columns of zeros fill all matrices up: they add zeros to the pseudoinverse
EPS = float(np.finfo(float).eps)
VISIBLE, USEFUL = 3e-15, 1e-2  # relative errors between which a slope shows: above rounding, below no digit right


def study(smoke: bool) -> xarray.Dataset:
    names = ["SVD", "Greville"] if smoke else list(METHODS)
    matrices = collection() | {f"gap {k}": gap(k) for k in range(1, 14)} | {f"Lauchli {k}": lauchli(k) for k in range(1, 9)}
    exact = np.array([padded(plus) for _, plus, _, _ in matrices.values()])
    stack = jnp.array([padded(a) for a, _, _, _ in matrices.values()])
    cond = np.array([c for _, _, _, c in matrices.values()])
    found = {threshold: [] for threshold in ("default", "between")}
    ranks = {threshold: [] for threshold in found}
    for name in tracked(names, "pinv_accuracy"):
        for threshold, tols in (("default", None), ("between", jnp.sqrt(residue(name, cond) / cond))):
            plus, rank = by(METHODS[name], stack, tols)
            error = np.linalg.norm(plus - exact, axis=(1, 2)) / np.linalg.norm(exact, axis=(1, 2))
            found[threshold].append(error)
            ranks[threshold].append(rank)
    dims = ("threshold", "algorithm", "matrix")
    data = xarray.Dataset(
        {
            "error": (dims, np.array(list(found.values())), {"long_name": "relative error of the pseudoinverse"}),
            "rank": (dims, np.array(list(ranks.values()))),
            "true_rank": ("matrix", [r for _, _, r, _ in matrices.values()]),
            "cond": ("matrix", cond, {"long_name": "largest over smallest singular value that is not zero"}),
        },
        coords={"threshold": list(found), "algorithm": names, "matrix": list(matrices)},
    )
    return described(data, "none: matrices", {"thresholds": "sqrt(residue / cond), and the methods' own", "eps": EPS})


def residue(name: str, cond: np.ndarray) -> np.ndarray:
    """Return the remainder by rounding of a row that depends on others, relative to the longest one."""
    return {"Greville": EPS * cond, "Elimination": np.sqrt(EPS) + 0.0 * cond}.get(name, EPS + 0.0 * cond)


def by(make: Any, stack: Any, tols: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return pseudoinverses and ranks of all matrices."""

    @jax.jit
    def run(stack, tols):
        def one(a, tol):
            plus = make(rank_tol=tol).plus(a)
            return plus @ jnp.eye(SIZE), plus.rank

        return jax.vmap(one, in_axes=(0, None if tols is None else 0))(stack, tols)

    plus, rank = run(stack, tols)
    return np.asarray(plus), np.asarray(rank)


def collection() -> dict[str, tuple]:
    """Return (A, A^+, rank, cond) by name: A and A^+ exact, as fractions."""
    entries = json.loads(MATRICES.read_text()).items()
    return {name: (fractions(e["A"]), fractions(e["pinv"]), e["rank"], e["cond_eff"]) for name, e in entries}


def gap(k: int) -> tuple:
    """Singular values 1 (ten times), 10^-k and 0."""
    known = collection()
    (a3, p3), (a8, p8) = known["gap12_1e-3"][:2], known["gap12_1e-8"][:2]
    e, e3, e8 = Fraction(1, 10**k), Fraction(1, 10**3), Fraction(1, 10**8)
    slope, inverse = (a3 - a8) / (e3 - e8), (p3 - p8) / (1 / e3 - 1 / e8)
    return a3 + (e - e3) * slope, p3 + (1 / e - 1 / e3) * inverse, 11, 10.0**k


def lauchli(k: int) -> tuple:
    """A row of ones over 10^-k I."""
    e, one = Fraction(1, 10**k), np.array([[Fraction(int(i == j)) for j in range(5)] for i in range(5)])
    a = np.vstack([np.full((1, 5), Fraction(1)), e * one])
    plus = ((one - np.full((5, 5), 1 / (5 + e * e))) / (e * e)) @ a.T
    return a, plus, 5, float(np.sqrt(float(5 + e * e)) / float(e))


def fractions(rows: list[list[str]]) -> np.ndarray:
    """Return an array of fractions."""
    return np.array([[Fraction(x) for x in row] for row in rows])


def padded(a: np.ndarray) -> np.ndarray:
    """Round to float64 and fill up with zeros."""
    rows, columns = a.shape
    return np.pad(a.astype(float), [(0, SIZE - rows), (0, SIZE - columns)])


def slopes(data: xarray.Dataset) -> dict[str, float]:
    """Return the exponent of cond in the error along the gap family, with the rank told."""
    family = data.sel(threshold="between", matrix=[m for m in data.matrix.values if m.startswith("gap ")])
    result = {}
    for method in data.algorithm.values:
        error = family.error.sel(algorithm=method).values
        seen = (error > VISIBLE) & (error < USEFUL)
        result[str(method)] = float(np.polyfit(np.log(family.cond.values[seen]), np.log(error[seen]), 1)[0])
    return result


def constants(data: xarray.Dataset) -> dict[str, float]:
    """Return the largest error / (eps cond) over the matrices with eps cond < 1e-4 on which the method finds the rank."""
    best = data.sel(threshold="between", matrix=data.cond * EPS < 1e-4)
    worst = (best.error / (EPS * best.cond)).where(best["rank"] == best.true_rank).max("matrix")
    return {str(method): float(worst.sel(algorithm=method)) for method in data.algorithm.values}


def holds(data: xarray.Dataset) -> dict[str, bool]:
    slope, worst = slopes(data), constants(data)
    orthogonal = [method for method in slope if method in LINEAR]
    own = data.sel(threshold="default")
    at = lambda method, limit: data.error.sel(threshold="default", algorithm=method).where(data.cond < limit, drop=True)  # noqa: E731
    return {
        "orthogonal methods: the error grows as cond": all(0.8 < slope[m] < 1.2 for m in orthogonal),
        "and is at most 10 eps cond on all matrices": all(worst[m] < 10 for m in orthogonal),
        "Greville and elimination: as cond^2": all(1.7 < slope[m] < 2.3 for m in slope if m in ("Greville", "Elimination")),
        "SVD finds every rank by itself up to cond = 1e13": bool(
            ((own["rank"] == own.true_rank).sel(algorithm="SVD") | (own.cond > 1e13)).all()
        ),
        "Greville by itself errs by less than 1e-3 up to cond = 1e5": bool((at("Greville", 1e5) < 1e-3).all()),
    }


def headline(data: xarray.Dataset) -> str:
    slope, worst = slopes(data), constants(data)
    powers = ", ".join(f"{method} {power:.2f}" for method, power in slope.items())
    return (
        f"error ~ cond^p, p = {powers}; largest error / (eps cond): "
        f"SVD {worst['SVD']:.1f}, all orthogonal methods {max(worst[m] for m in worst if m in LINEAR):.1f}"
    )


def figure(data: xarray.Dataset) -> Figure:
    page, axes = panels(1, 2, 10.0, 3.9, sharex=True, sharey=True)
    marks = dict(zip(METHODS, "osD^v*X"))
    family = np.array([m.startswith("gap ") for m in data.matrix.values])
    texts = {"between": "gap family, threshold in the middle", "default": "all matrices, the method's own threshold"}
    for axis, (threshold, text) in zip(axes.ravel(), texts.items()):
        for color, method in enumerate(data.algorithm.values):
            error = np.clip(data.error.sel(threshold=threshold, algorithm=method).values, 1e-17, 1e3)
            look = {"marker": marks[method], "color": f"C{color}", "ms": 3.5, "lw": 1}
            axis.loglog(data.cond.values[family], error[family], label=method, **look)
            if threshold == "default":
                axis.loglog(data.cond.values[~family], error[~family], ls="", mfc="none", mew=0.6, **look | {"ms": 3})
        cond = np.array([1.0, 1e16])
        axis.loglog(cond, EPS * cond, "k--", lw=1, label="eps cond")
        axis.loglog(cond, EPS * cond**2, "k:", lw=1, label="eps cond$^2$")
        axis.set(ylim=(3e-17, 2e3), xlim=(0.6, 1e15), xlabel="cond(A)", title=text)
    axes[0, 0].set_ylabel("relative error of $A^+$ (above $10^3$: at the edge)")
    page.legend(*axes[0, 0].get_legend_handles_labels(), fontsize=8, loc="outside right upper")
    return page
