"""An explanation: every symbol of the derivation for one state, and the same as text that reads like the paper's section."""

import html
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from udkjax.equations.determinacy import unique_direction
from udkjax.scene.joints import Revolute
from udkjax.scene.mechanism import Mechanism
from udkjax.study.row_labels import row_label
from udkjax.study.wording import plural

MOST_MATRIX_COLUMNS = 18  # columns of a matrix that fit beside each other
SMALLEST_PRINTED = 1e-12  # relative to the largest of an array: printed as 0
SYMBOLS = ("psi", "psi_dot", "psi_q", "gamma", "mass", "force", "weights", "D", "singular_values", "D_plus", "a_F", "b", "a")


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
    """Every symbol of section 3 of the paper for one state. Rows are those of Psi, columns x, y, angle of each body.

    Attributes:
        mechanism: of which it is.
        t: time (s).
        q: coordinates.
        v: velocities.
        row_names: joint and number of each row.
        psi: Psi.
        psi_dot: its rate.
        psi_q: its Jacobian.
        gamma: the right-hand side of Psi_q a = gamma.
        D: Psi_q M^(-1/2), with weighted rows.
        rank: of D.
        D_plus: its pseudoinverse.
        a_F: M^(-1) F.
        b: gamma - Psi_q a_F, with weighted rows.
        a: accelerations.
        multipliers: lambda.
        gauss: Gauss's principle, checked.
    """

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


# --- as text


def as_text(e: Explanation) -> str:
    """Lay out the derivation for a terminal."""
    rows, columns = [row_label(e.mechanism, *name) for name in e.row_names], _columns(e.mechanism)
    parts = [_state(e, columns)]
    if rows:
        parts += [_constraints(e, rows, columns), _rank(e, rows)]
    parts += [_masses(e, columns)]
    if rows:
        parts += [_right_hand_side(e, rows), _pseudoinverse(e, rows, columns)]
    parts += [_accelerations(e, columns)]
    if rows:
        parts += [_multipliers(e, rows)]
    parts += [_gauss(e), _checks(e)]
    return "\n\n".join(parts)


def as_html(e: Explanation) -> str:
    """Return the same text for a notebook, as it stands."""
    return f"<pre>{html.escape(as_text(e))}</pre>"


def as_dict(e: Explanation) -> dict[str, Any]:
    """Return an explanation as plain numbers, lists and texts."""
    return {
        "mechanism": e.mechanism.name,
        "t": e.t,
        "bodies": list(e.mechanism.body_names),
        "rows": [row_label(e.mechanism, *name) for name in e.row_names],
        "q": e.q.tolist(),
        "v": e.v.tolist(),
        **{name: getattr(e, name).tolist() for name in SYMBOLS},
        "rank": e.rank,
        "lambda": e.multipliers.tolist(),
        "unique": e.unique.tolist(),
        "constraint_force": e.constraint_force.tolist(),
        "gauss": {**e.gauss._asdict(), "least_rival": e.gauss.least_rival if e.gauss.rivals else None},
        "checks": e.checks,
    }


def _columns(mechanism: Mechanism) -> list[str]:
    return [f"{letter}{k + 1}" for k in range(len(mechanism.body_names)) for letter in ("x", "y", "th")]


def _title(number: int, text: str) -> str:
    return f"{number}. {text}"


def _state(e: Explanation, columns: list[str]) -> str:
    bodies = ", ".join(f"{k + 1} {name}" for k, name in enumerate(e.mechanism.body_names))
    head = f"{e.mechanism.name or 'mechanism'} at t = {e.t:g} s. Bodies: {bodies}; x, y (m) and th (rad) of each."
    return "\n".join([head, "", _table(["q", "v"], columns, np.stack([e.q, e.v]))])


def _constraints(e: Explanation, rows: list[str], columns: list[str]) -> str:
    pattern = [
        f"  {name:<{_width(rows)}}  "
        + " ".join("x" if abs(entry) > SMALLEST_PRINTED * np.abs(e.psi_q).max() else "." for entry in row)
        for name, row in zip(rows, e.psi_q, strict=True)
    ]
    values = np.stack([e.psi, e.psi_dot, e.gamma], axis=1)
    return "\n".join(
        [
            _title(1, "Constraints Psi(t, q) = 0; along a motion Psi_dot = Psi_q v + Psi_t = 0, and Psi_q a = gamma"),
            _table(rows, ["Psi", "Psi_dot", "gamma"], values),
            "",
            f"  The Jacobian Psi_q ({len(rows)} x {len(columns)}), which entries are there, and their values:",
            *pattern,
            "",
            _table(rows, columns, e.psi_q),
        ]
    )


def _rank(e: Explanation, rows: list[str]) -> str:
    n = len(e.a)
    free = f"{n} coordinates - {e.rank} = {plural(n - e.rank, 'degree')} of freedom"
    lines = [_title(2, f"Rank of Psi_q: {e.rank} of {len(rows)} rows; {free}")]
    if e.null_rows.shape[1]:
        lines.append("  These combinations of rows vanish, so that lambda may be changed by any of them without an effect:")
        for column in e.null_rows.T:
            column = column / column[np.argmax(np.abs(column))]
            terms = [f"{x:+.3g} {name}" for x, name in zip(column, rows, strict=True) if abs(x) > 1e-9]
            lines.append("    " + " ".join(terms))
    else:
        lines.append("  All rows are independent.")
    return "\n".join(lines)


def _masses(e: Explanation, columns: list[str]) -> str:
    return "\n".join(
        [
            _title(3, "Masses M (diagonal), loads F, and a_F = M^(-1) F: what the loads would do without the constraints"),
            _table(["M", "F", "a_F"], columns, np.stack([e.mass, e.force, e.a_F])),
        ]
    )


def _right_hand_side(e: Explanation, rows: list[str]) -> str:
    done = e.psi_q @ e.a_F
    lines = [
        _title(4, "What the constraints still ask: b = gamma - Psi_q a_F"),
        _table(rows, ["gamma", "Psi_q a_F", "b"], np.stack([e.gamma, done, e.b / e.weights], axis=1)),
    ]
    return "\n".join(lines)


def _pseudoinverse(e: Explanation, rows: list[str], columns: list[str]) -> str:
    sigma = " ".join(_number(x, np.abs(e.singular_values).max(initial=0.0)) for x in e.singular_values)
    weighted = not np.allclose(e.weights, 1.0)
    note = "; rows in radians are multiplied by the characteristic length, b too" if weighted else ""
    return "\n".join(
        [
            _title(5, f"D = Psi_q M^(-1/2){note}"),
            _table(rows, columns, e.D),
            f"  Singular values: {sigma}",
            "",
            f"  D^+, transposed (a row of it for each row of D), of rank {e.rank}:",
            _table(rows, columns, e.D_plus.T),
        ]
    )


def _accelerations(e: Explanation, columns: list[str]) -> str:
    return "\n".join(
        [
            _title(6, "a = a_F + M^(-1/2) D^+ b: what the loads would do, and what the constraints add"),
            _table(["a_F", "added", "a"], columns, np.stack([e.a_F, e.a - e.a_F, e.a])),
        ]
    )


def _multipliers(e: Explanation, rows: list[str]) -> str:
    shown = _table(rows, ["lambda"], e.multipliers[:, None]).split("\n")
    marks = ["", *("unique" if unique else "not unique: the share of least norm" for unique in e.unique)]
    return "\n".join(
        [
            _title(7, "lambda = -(D^+)^T D^+ b (N, N m), with which M a + Psi_q^T lambda = F"),
            *(f"{line}   {mark}".rstrip() for line, mark in zip(shown, marks, strict=True)),
            *(f"  {name}: its force is unique only along {np.rad2deg(angle):.4g} degrees" for name, angle in _directions(e)),
            "",
            "  The constraints' forces on the bodies, -Psi_q^T lambda = M (a - a_F), are unique:",
            _table(["force"], _columns(e.mechanism), e.constraint_force[None]),
        ]
    )


def _directions(e: Explanation) -> list[tuple[str, float]]:
    """Return the pins whose force is unique in one direction alone, and that direction (rad)."""
    found, null_rows = [], e.null_rows / np.abs(e.null_rows).max(initial=np.finfo(float).tiny)
    for name, joint in e.mechanism.joints.items():
        own = [k for k, (owner, _) in enumerate(e.row_names) if owner == name]
        angle = unique_direction(null_rows[own]) if isinstance(joint, Revolute) else None
        found += [] if angle is None else [(name, angle)]
    return found


def _gauss(e: Explanation) -> str:
    g = e.gauss
    lines = [
        _title(8, "Gauss's principle: of all accelerations that the constraints allow, a has the least"),
        "     G(x) = (x - a_F)^T M (x - a_F) / 2",
        f"  G(a) = {g.at_a:.10g}",
    ]
    if g.free:
        free = f"  {plural(g.free, 'direction')} {'is' if g.free == 1 else 'are'} left free"
        lines += [
            f"{free}. The slope of G there is {g.slope:.1e} of its size: zero, to rounding.",
            f"  The least G of {g.rivals} other feasible accelerations is {g.least_rival:.10g}: "
            + ("more." if g.least_rival >= g.at_a else "LESS, which must not be."),
        ]
    else:
        lines.append("  The constraints leave nothing free: a is the only one.")
    return "\n".join(lines)


def _checks(e: Explanation) -> str:
    width = max(map(len, e.checks))
    return "\n".join(
        [_title(9, "Checks, relative: all vanish"), *(f"  {name:<{width}}  {x:.1e}" for name, x in e.checks.items())]
    )


def _width(names: list[str]) -> int:
    return max(map(len, names))


def _table(rows: list[str], columns: list[str], values: np.ndarray) -> str:
    """Lay out a matrix with its names; wide ones in pieces below each other."""
    width, pieces = _width(rows), []
    for start in range(0, len(columns), MOST_MATRIX_COLUMNS):
        part = slice(start, start + MOST_MATRIX_COLUMNS)
        sizes = np.abs(values).max(axis=0 if values.shape[1] <= 3 else None, initial=0.0)
        cells = [
            [_number(x, size) for x, size in zip(row[part], np.broadcast_to(sizes, row.shape)[part], strict=True)]
            for row in values
        ]
        widths = [max(len(name), *(len(line[k]) for line in cells)) for k, name in enumerate(columns[part])]
        lines = ["  " + " " * width + "  " + " ".join(f"{name:>{w}}" for name, w in zip(columns[part], widths, strict=True))]
        lines += [
            f"  {name:<{width}}  " + " ".join(f"{cell:>{w}}" for cell, w in zip(line, widths, strict=True))
            for name, line in zip(rows, cells, strict=True)
        ]
        pieces.append("\n".join(lines))
    return "\n\n".join(pieces)


def _number(x: float, size: float) -> str:
    """Write a number with four digits; as zero where it is rounding beside the largest."""
    return "0" if abs(x) <= SMALLEST_PRINTED * size else f"{x:.4g}"
