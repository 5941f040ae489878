"""Check of a mechanism: rows, rank, degrees of freedom, closure of the initial guess, and likely mistakes."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from udkjax.equations import constraints
from udkjax.equations.rows.analysis import analyse
from udkjax.equations.rows.redundancy import dependent_constraints
from udkjax.positions.assembling.assembly import close, moves_of_assembly
from udkjax.printing import PrintedTable, format_number, prints_table
from udkjax.requirements import concrete_only
from udkjax.scene.arguments import checked
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.suspicions import suspicions
from udkjax.wording import numbered


@prints_table
class Check(NamedTuple):
    """The findings of `check` about a mechanism: its constraints, the closure of its initial guess, and likely mistakes."""

    bodies: int
    coordinates: int
    rows: int
    rank: int  # away from singular configurations
    degrees_of_freedom: int
    redundant: tuple[tuple[str, int], ...]  # rows that can be left out: the constraint and the row within it
    dependent: tuple[str, ...]  # constraints that depend on each other
    residual_before: float  # the largest |Psi| (m, rad) as given, and assembled
    residual_after: float
    closed: bool
    length: float  # characteristic length (m), as in `analyse`
    time: float  # characteristic time (s)
    mass: float  # characteristic mass (kg)
    moved: tuple[str, ...] = ()  # bodies moved far by assembly, relative to their sizes
    suspicious: tuple[str, ...] = ()  # likely mistakes

    def lines(self) -> dict[str, str]:
        """Return the findings as texts by title."""
        lines = {
            "bodies": f"{self.bodies}",
            "coordinates": f"{self.coordinates}",
            "constraint equations": f"{self.rows}",
            "rank": f"{self.rank}",
            "degrees of freedom": f"{self.degrees_of_freedom}",
            "redundant constraints": ", ".join(f"{name} (equation {row + 1})" for name, row in self.redundant) or "none",
        }
        if self.dependent:
            lines["depend on each other"] = ", ".join(self.dependent)
        lines["length, time, mass"] = f"{self.length:.3g} m, {self.time:.3g} s, {self.mass:.3g} kg"
        before, after = (format_number(x, "m or rad", self.length) for x in (self.residual_before, self.residual_after))
        lines |= {"closure, as given": before, "closure, assembled": after + ("" if self.closed else ": it does not close")}
        more = [text.removeprefix("assembly ") for text in self.moved]
        return lines | numbered("assembly", more) | numbered("likely a mistake", list(self.suspicious))

    def _table(self) -> PrintedTable:
        return PrintedTable("mechanism, checked", list(self.lines().items()))


@checked
@concrete_only()
def check(mechanism: Mechanism) -> Check:
    """Return rows, rank and degrees of freedom of a mechanism, its redundant rows, and the residuals of its initial guess.

    The result also names bodies that assembly moves by more than a hundredth of their size, and likely mistakes: points far
    outside all bodies, angles that look like degrees, bodies without a joint.

    Args:
        mechanism: a mechanism of concrete numbers.

    Returns:
        A `Check`: the counts, |Psi| before and after assembly (m, rad), and the findings as text.
    """
    closure = close(mechanism)
    before = constraints.psi(mechanism, 0.0, mechanism.q0)
    rows = len(before)
    closed = bool(closure.is_closed)
    found = analyse(mechanism)
    rank = int(closure.rank) if found.rank is None or not closed else found.rank
    return Check(
        bodies=len(mechanism.body_names),
        coordinates=3 * len(mechanism.body_names),
        rows=rows,
        rank=rank,
        degrees_of_freedom=3 * len(mechanism.body_names) - rank,
        redundant=found.redundant if closed else (),
        dependent=dependent_constraints(mechanism, np.asarray(closure.state.q)) if closed else (),
        residual_before=float(jnp.abs(before).max(initial=0.0)),
        residual_after=float(jnp.abs(closure.psi).max(initial=0.0)),
        closed=closed,
        length=float(found.length),
        time=float(found.time),
        mass=float(found.mass),
        moved=moves_of_assembly(mechanism, closure.state.q) if closed else (),
        suspicious=tuple(suspicions(mechanism)),
    )
