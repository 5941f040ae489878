"""Every symbol of the derivation for one state, as numbers and as text: see section 3 of the paper that `explain` names."""

import html
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from udkjax.equations import determinacy
from udkjax.scene.elements.joints import Revolute, Weld
from udkjax.scene.mechanism import Mechanism
from udkjax.study.recommended import tolerance_lines
from udkjax.study.report import plain, row_label
from udkjax.wording import plural

MOST_MATRIX_COLUMNS = 18  # largest number of columns of a matrix on one line
MOST_ROWS, FIRST_ROWS = 24, 12  # longer tables and lists are printed up to a row, and the others counted
MOST_COLUMNS, FIRST_COLUMNS = 36, 18  # likewise for columns
SMALLEST_PRINTED = 1e-12  # smallest entry that is not printed as 0, relative to the largest of the array
SMALLEST_TERM = 1e-9  # smallest coefficient of a combination of rows that is not rounding, relative to the largest


class Gauss(NamedTuple):
    """Gauss's principle: of all feasible accelerations, a deviates least from a_F.

    G(x) = (x - a_F)^T M (x - a_F) / 2. Feasible accelerations are a + V y, with V an M-orthonormal basis of the null space of
    Psi_q; then G(a + V y) = G(a) + y . V^T M (a - a_F) + |y|^2 / 2, least at y = 0 if and only if V^T M (a - a_F) = 0.
    """

    at_a: float  # G(a), kg m^2/s^4
    free: int  # number of columns of V
    slope: float  # the largest of |V^T M (a - a_F)|, relative to |M^(1/2) (a - a_F)|: zero up to rounding
    least_rival: float  # the least G of random feasible accelerations
    rivals: int  # number of random accelerations


class RubbingTerms(NamedTuple):
    """Terms of friction that depends on the load of its joint: mu(s) times this load, which may not be unique."""

    joint: str
    speed: float  # of sliding, s (m/s)
    coefficient: float  # mu(s)
    load: float  # N
    is_unique: bool  # True if the load is unique; otherwise it is the load of least norm


class Explanation(NamedTuple):
    """Every symbol of section 3 of the paper (see `explain`) for one state, with a row for each equation of Psi.

    Columns are x, y and angle of each body.

    Attributes:
        mechanism: the mechanism.
        t: time (s).
        q: coordinates.
        v: velocities.
        row_names: joint and number of each row.
        psi: Psi.
        psi_dot: the rate of Psi.
        psi_q: the Jacobian of Psi.
        gamma: the right-hand side of Psi_q a = gamma.
        D: Psi_q M^(-1/2), with weighted rows.
        rank: the rank of D.
        D_plus: the pseudoinverse of D.
        a_F: M^(-1) F.
        b: gamma - Psi_q a_F, with weighted rows.
        a: accelerations.
        multipliers: lambda.
        friction: the terms of each friction that depends on the load of its joint; F contains it.
        gauss: the check of Gauss's principle.
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
    weights: Float[np.ndarray, "m"]  # weights of the rows of D and b
    D: Float[np.ndarray, "m n"]
    singular_values: Float[np.ndarray, "k"]  # singular values of D
    rank: int
    D_plus: Float[np.ndarray, "n m"]
    a_F: Float[np.ndarray, "n"]
    b: Float[np.ndarray, "m"]
    a: Float[np.ndarray, "n"]
    multipliers: Float[np.ndarray, "m"]
    unique: Bool[np.ndarray, "m"]  # mask of the unique multipliers
    null_rows: Float[np.ndarray, "m k"]  # N, whose columns are combinations of rows of Psi_q that vanish
    constraint_force: Float[np.ndarray, "n"]  # -Psi_q^T lambda
    friction: dict[str, RubbingTerms]
    gauss: Gauss
    checks: dict[str, float]  # residuals of the identities, relative to their terms

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain numbers, lists and strings, for JSON."""
        results = plain(self) | {"bodies": list(self.mechanism.body_names), "rows": self.row_labels()}
        return results | {"lambda": results.pop("multipliers")}

    def row_labels(self) -> list[str]:
        """Return the names of the rows as they are printed."""
        return [row_label(self.mechanism, *name) for name in self.row_names]

    def __str__(self) -> str:
        """Format the derivation for a terminal."""
        rows, columns = self.row_labels(), _columns(self.mechanism)
        parts = [_state(self, columns)]
        parts += [_constraints(self, rows, columns), _rank(self, rows)] if rows else []
        parts += [_masses(self, columns)]
        parts += [_right_hand_side(self, rows), _pseudoinverse(self, rows, columns)] if rows else []
        parts += [_accelerations(self, columns)]
        parts += [_multipliers(self, rows)] if rows else []
        return "\n\n".join("\n".join(lines) for lines in [*parts, _gauss(self), _checks(self), _tolerances(self)])

    def __repr__(self) -> str:
        return f"Explanation({self.mechanism.name!r}, t = {self.t:g}, rank {self.rank} of {len(self.psi)} rows)"

    def _repr_html_(self) -> str:
        return f"<pre>{html.escape(str(self))}</pre>"


# --- lines of each section, as text


def _columns(mechanism: Mechanism) -> list[str]:
    return [f"{letter}{k + 1}" for k in range(len(mechanism.body_names)) for letter in ("x", "y", "th")]


def _state(e: Explanation, columns: list[str]) -> list[str]:
    bodies = ", ".join(_first([f"{k + 1} {name}" for k, name in enumerate(e.mechanism.body_names)]))
    head = f"{e.mechanism.name or 'mechanism'} at t = {e.t:g} s. Bodies: {bodies}. Coordinates of each: x, y (m), th (rad)."
    return [head, "", *_table(["q", "v"], columns, np.stack([e.q, e.v]))]


def _constraints(e: Explanation, rows: list[str], columns: list[str]) -> list[str]:
    shown = np.abs(e.psi_q) > SMALLEST_PRINTED * np.abs(e.psi_q).max()
    width, places = _width(rows), range(_shown(len(columns), MOST_COLUMNS, FIRST_COLUMNS))
    pattern = [
        f"  {name:<{width}}  " + " ".join("x" if row[k] else "." for k in places) for name, row in zip(rows, shown, strict=True)
    ]
    return [
        "1. Constraints Psi(t, q) = 0; along a motion Psi_dot = Psi_q v + Psi_t = 0, and Psi_q a = gamma",
        *_table(rows, ["Psi", "Psi_dot", "gamma"], np.stack([e.psi, e.psi_dot, e.gamma], axis=1)),
        "",
        f"  The Jacobian Psi_q ({len(rows)} x {len(columns)}): its nonzero entries (x), then their values:",
        *_first(pattern, _left_out(len(rows), len(columns))),
        "",
        *_table(rows, columns, e.psi_q),
    ]


def _rank(e: Explanation, rows: list[str]) -> list[str]:
    n = len(e.a)
    free = f"{n} coordinates - {e.rank} = {plural(n - e.rank, 'degree')} of freedom"
    lines = [f"2. Rank of Psi_q: {e.rank} of {len(rows)} rows; {free}"]
    if not e.null_rows.shape[1]:
        return [*lines, "  All rows are independent."]
    lines.append("  These combinations of rows vanish: adding any multiple of one to lambda leaves the motion unchanged.")
    combinations = []
    for column in e.null_rows.T:
        column = column / column[np.argmax(np.abs(column))]
        terms = [f"{x:+.3g} {name}" for x, name in zip(column, rows, strict=True) if abs(x) > SMALLEST_TERM]
        combinations.append("    " + " ".join(_first(terms)))
    return [*lines, *_first(combinations)]


def _masses(e: Explanation, columns: list[str]) -> list[str]:
    title = "3. Masses M (diagonal), loads F, and the unconstrained accelerations a_F = M^(-1) F"
    return [title, *_table(["M", "F", "a_F"], columns, np.stack([e.mass, e.force, e.a_F])), *_friction(e)]


def _friction(e: Explanation) -> list[str]:
    if not e.friction:
        return []
    values = np.array([[x.speed, x.coefficient, x.load] for x in e.friction.values()])
    lines = _table([f"{name} in {x.joint}" for name, x in e.friction.items()], ["s", "mu(s)", "load"], values)
    marks = ["", *("unique" if x.is_unique else "not unique: that of the minimum-norm solution" for x in e.friction.values())]
    return [
        "",
        "  F contains friction: mu(s) times the load of a joint (N), which follows from lambda; s is the speed of sliding (m/s).",
        *(f"{line}   {mark}".rstrip() for line, mark in zip(lines, [*marks, *[""] * len(lines)], strict=False)),
    ]


def _right_hand_side(e: Explanation, rows: list[str]) -> list[str]:
    values = np.stack([e.gamma, e.psi_q @ e.a_F, e.b / e.weights], axis=1)
    title = "4. b = gamma - Psi_q a_F: the residual of a_F in the constraints Psi_q a = gamma"
    return [title, *_table(rows, ["gamma", "Psi_q a_F", "b"], values)]


def _pseudoinverse(e: Explanation, rows: list[str], columns: list[str]) -> list[str]:
    weighted = not np.allclose(e.weights, 1.0)
    return [
        f"5. D = Psi_q M^(-1/2){'; angular rows of D and b are multiplied by the characteristic length' if weighted else ''}",
        *_table(rows, columns, e.D),
        f"  Singular values: {' '.join(_first([_number(x, e.singular_values.max(initial=0.0)) for x in e.singular_values]))}",
        "",
        f"  D^+, transposed (one row for each row of D), of rank {e.rank}:",
        *_table(rows, columns, e.D_plus.T),
    ]


def _accelerations(e: Explanation, columns: list[str]) -> list[str]:
    title = "6. a = a_F + M^(-1/2) D^+ b: the unconstrained accelerations, and the accelerations added by the constraints"
    return [title, *_table(["a_F", "added", "a"], columns, np.stack([e.a_F, e.a - e.a_F, e.a]))]


def _multipliers(e: Explanation, rows: list[str]) -> list[str]:
    marks = ["", *("unique" if unique else "not unique: the minimum-norm solution" for unique in e.unique)]
    shown = zip(_table(rows, ["lambda"], e.multipliers[:, None]), marks, strict=False)
    directions = [
        f"  {name}: only the component of its force along {np.rad2deg(angle):.4g} degrees is unique"
        for name, angle in _directions(e)
    ]
    return [
        "7. lambda = -(D^+)^T D^+ b (N, N m), so that M a + Psi_q^T lambda = F",
        *(f"{line}   {mark}".rstrip() for line, mark in shown),
        *_first(directions),
        "",
        "  The constraints' forces on the bodies, -Psi_q^T lambda = M (a - a_F), are unique:",
        *_table(["force"], _columns(e.mechanism), e.constraint_force[None]),
    ]


def _directions(e: Explanation) -> list[tuple[str, float]]:
    """Return the pins and welds whose force is unique in one direction only, with this direction (rad)."""
    directions, null_rows = [], e.null_rows / np.abs(e.null_rows).max(initial=np.finfo(float).tiny)
    for name, joint in e.mechanism.joints.items():
        indices = [k for k, (owner, _) in enumerate(e.row_names) if owner == name]
        holds_point = isinstance(joint, Revolute | Weld)
        angle = determinacy.unique_direction(null_rows[indices[:2]]) if holds_point else None  # a weld's third row is its torque
        directions += [] if angle is None else [(name, angle)]
    return directions


def _gauss(e: Explanation) -> list[str]:
    g = e.gauss
    lines = [
        "8. Gauss's principle: of all accelerations that the constraints allow, a has the smallest",
        "     G(x) = (x - a_F)^T M (x - a_F) / 2",
        f"  G(a) = {g.at_a:.10g}",
    ]
    if not g.free:
        return [*lines, "  The constraints leave no direction free: a is the only feasible acceleration."]
    free = f"  {plural(g.free, 'direction')} {'is' if g.free == 1 else 'are'} free"
    verdict = "larger." if g.least_rival >= g.at_a else "SMALLER, which is an error."
    return [
        *lines,
        f"{free}. The relative slope of G at a is {g.slope:.1e}: zero up to rounding.",
        f"  The smallest G of {g.rivals} other feasible accelerations is {g.least_rival:.10g}: {verdict}",
    ]


def _checks(e: Explanation) -> list[str]:
    width = _width(list(e.checks))
    return [
        "9. Checks: relative residuals, zero up to rounding",
        *(f"  {name:<{width}}  {x:.1e}" for name, x in e.checks.items()),
    ]


def _tolerances(e: Explanation) -> list[str]:
    title = "10. Motions: `rtol`, and `atol` relative to the mechanism's length, at which `simulate` had an error in the atlas"
    return [title, *tolerance_lines(e.mechanism.name)]


def _width(names: list[str]) -> int:
    return max(map(len, names))


def _shown(count: int, most: int = MOST_ROWS, first: int = FIRST_ROWS) -> int:
    """Return the number of rows or columns, out of `count`, that are printed."""
    return count if count <= most else first


def _first(lines: list[str], left_out: str = "") -> list[str]:
    """Return the first lines, and a line that counts the others or, if given, `left_out`; all lines if they are few."""
    shown = _shown(len(lines))
    rest = left_out or (f"and {len(lines) - shown} more" if shown < len(lines) else "")
    return [*lines[:shown], *([rest] if rest else [])]


def _left_out(rows: int, columns: int) -> str:
    """Return a line that counts the rows and columns of a matrix that are not printed; "" if there are none."""
    more_rows, more_columns = rows - _shown(rows), columns - _shown(columns, MOST_COLUMNS, FIRST_COLUMNS)
    counts = [plural(n, noun) for n, noun in ((more_rows, "row"), (more_columns, "column")) if n]
    return f"  and {' and '.join(counts)} more, in the fields of the explanation" if counts else ""


def _table(rows: list[str], columns: list[str], values: np.ndarray) -> list[str]:
    """Return a matrix as lines, with names of rows and columns; wide matrices are split into blocks, large ones shown in part."""
    sizes = np.abs(values).max(axis=0 if values.shape[1] <= 3 else None, initial=0.0)
    left_out = _left_out(len(rows), len(columns))
    rows, columns = rows[: _shown(len(rows))], columns[: _shown(len(columns), MOST_COLUMNS, FIRST_COLUMNS)]
    values, width, lines = values[: len(rows), : len(columns)], _width(rows), []
    cells = [[_number(x, size) for x, size in zip(row, np.broadcast_to(sizes, row.shape), strict=True)] for row in values]
    for start in range(0, len(columns), MOST_MATRIX_COLUMNS):
        part = slice(start, start + MOST_MATRIX_COLUMNS)
        widths = [max(map(len, column)) for column in zip(columns[part], *(line[part] for line in cells), strict=True)]
        lines += [""] if start else []
        for name, line in zip(["", *rows], [columns[part], *(line[part] for line in cells)], strict=True):
            lines.append(f"  {name:<{width}}  " + " ".join(f"{cell:>{w}}" for cell, w in zip(line, widths, strict=True)))
    return [*lines, left_out] if left_out else lines


def _number(x: float, size: float) -> str:
    """Format a number with four digits; as 0 if it is a rounding error relative to `size`."""
    return "0" if abs(x) <= SMALLEST_PRINTED * size else f"{x:.4g}"
