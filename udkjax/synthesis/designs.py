"""Results of a design: mechanisms that meet the goal, verified by their own motion."""

from collections.abc import Iterator

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from udkjax.arrays import FULL_TURN
from udkjax.positions.assembling.channels import locate
from udkjax.positions.following.drive import Drive
from udkjax.positions.following.free_numbers import FreeNumbers
from udkjax.positions.following.kinematics import kinematics
from udkjax.printing import PrintedTable, PrintsTable
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.tables.checks import SceneError
from udkjax.synthesis.curves.found_mechanism import FoundMechanism
from udkjax.synthesis.design_problem import DesignProblem

LOSS_TOL = 1e-6  # tolerance between the losses of search and motion, relative to the loss and to the squared scale


class FoundDesign(FoundMechanism):
    """One design that a search has found; it is drawn at the first position of the goal if all of its moving pins are free.

    Attributes:
        loss: the sum of the squared residuals of its motion (m^2; for a function rad^2 or m^2).
        mechanism: the mechanism, to be run, animated or saved.
        values: values of the driver at the positions of the goal (J,) (rad, m).
        residuals: residuals (J, G) of the motion that `kinematics` follows over these values.
        measures: measures of each motion goal at its samples.
        transmission: the smallest value over the positions, from 0 to 1; for a four-bar the sine of the transmission angle.
        turns: whether the driver makes a whole turn.
        parameters: the free numbers by name.
        driver: the driver.
    """

    loss: float
    mechanism: Mechanism
    values: Float[np.ndarray, "J"]
    residuals: Float[np.ndarray, "J G"]
    measures: tuple[np.ndarray, ...]
    transmission: float
    turns: bool
    parameters: dict[str, np.ndarray]
    driver: Drive = eqx.field(static=True)

    @property
    def last_value(self) -> float:
        """The value of the driver at the last position of the goal."""
        return self.values[-1]

    def _table(self) -> PrintedTable:
        rows = [("loss", f"{self.loss:.6g}"), ("largest residual", f"{np.max(np.abs(self.residuals)):.3g}")]
        rows += [("measures", ", ".join(f"{np.min(m):.4g} to {np.max(m):.4g}" for m in self.measures))] if self.measures else []
        rows += [("transmission", f"{self.transmission:.3g}"), ("turns", "yes" if self.turns else "no")]
        rows += self._pin_rows()
        lengths = {} if self.drawing is None else self.drawing.length_texts()
        rows += [(f"length of {name}", text) for name, text in lengths.items()]
        return PrintedTable(f"design {self.mechanism.name}".strip(), rows)


class Designs(PrintsTable):
    """Different mechanisms found for a goal, the best first: a sequence of `FoundDesign`.

    Attributes:
        found: the designs.
        losses: losses of all trials within the limits, sorted; the more often the best one occurs, the less likely a better one
            is.
        starts: number of mechanisms that the search started from.
        reason: why no design was found, and the cure; empty if there are designs.
    """

    found: tuple[FoundDesign, ...]
    losses: Float[np.ndarray, "k"]
    starts: int = eqx.field(static=True)
    reason: str = eqx.field(static=True, default="")

    def __len__(self) -> int:
        return len(self.found)

    def __getitem__(self, k: int) -> FoundDesign:
        return self.found[k]

    def __iter__(self) -> Iterator[FoundDesign]:
        return iter(self.found)

    def _table(self) -> PrintedTable:
        rows = [("starts", str(self.starts)), ("within the limits", str(len(self.losses)))]
        rows += [("nothing was found", self.reason)] if self.reason else []
        for k, design in enumerate(self.found):
            turns = ", turns" if design.turns else ""
            rows.append((str(k + 1), f"loss {design.loss:.6g}, transmission {design.transmission:.3g}{turns}"))
        return PrintedTable(f"{len(self.found)} designs", rows)


def verified(problem: DesignProblem, x: np.ndarray, s: np.ndarray, q: np.ndarray, loss: float) -> FoundDesign | None:
    """Return a trial as a design verified by its motion; None if the motion does not confirm the loss or a required turn.

    Args:
        problem: the problem.
        x: the unknowns of the trial (P,).
        s: the driver's values at the positions of the goal (J,).
        q: the positions (J, n).
        loss: the loss of the trial.
    """
    turns = problem.turns(x)
    if problem.rotation and not turns:
        return None
    try:
        mechanism = problem.free.moved(jnp.asarray(x[: problem.free.count]))
        mechanism = redrawn(problem, mechanism, q[0].reshape(-1, 3))
    except SceneError:  # without bounds, a pin may go so far away that no drawing has it
        return None
    values = s + float(problem.goal.origin(mechanism)) + (x[problem.free.count] if problem.shifted else 0.0)
    drawn = float(problem.drawn(mechanism))
    if problem.driven.is_angle:
        values = values + FULL_TURN * np.round((drawn - values[0]) / FULL_TURN)
    moved = follow(mechanism, problem.driver, values)
    numbers = FreeNumbers(mechanism, problem.free.names)
    unknowns = np.append(numbers.vector, x[problem.free.count :])
    tried = [term.measure_motion(mechanism, unknowns, values[0] - s[0]) for term in problem.terms]
    measures = [m for m in tried if m is not None]
    if moved is None or len(measures) < len(tried):
        return None
    residuals = problem.residuals(unknowns, moved.reshape(len(s), -1))
    of_terms = [term.residual(m) for term, m in zip(problem.terms, measures, strict=True)]
    loss_of_motion = float(sum(np.sum(r**2) for r in (residuals, *of_terms)))
    if not abs(loss_of_motion - loss) <= LOSS_TOL * (loss + LOSS_TOL * problem.scale**2):
        return None
    tau = problem.transmission_at(x, s, q)
    parameters = dict(zip(numbers.names, numbers.values, strict=True))
    return FoundDesign(
        loss=loss_of_motion,
        mechanism=mechanism,
        values=values,
        residuals=residuals,
        measures=tuple(measures),
        transmission=tau,
        turns=turns,
        parameters=parameters,
        driver=problem.driver,
    )


def follow(mechanism: Mechanism, driver: Drive, values: np.ndarray) -> np.ndarray | None:
    """Return positions (J, bodies, 3) at the driver's values, followed from the drawn position; None if one is not reached."""
    motion = kinematics(mechanism, driver, values)
    return np.asarray(motion.q) if np.all(motion.reached) else None


def redrawn(problem: DesignProblem, mechanism: Mechanism, q: np.ndarray) -> Mechanism:
    """Return the mechanism drawn in the position q (bodies, 3) if all of its moving pins are free.

    Otherwise, or if a link has an outline or a centre in world coordinates, return the mechanism itself.
    """
    drawing = mechanism.drawing
    if drawing is None:
        return mechanism
    pins = drawing.groups["pin"]
    fixed = set(drawing.ground)  # pyright: ignore[reportAttributeAccessIssue]
    moving = [name for name in pins if name not in fixed]
    if not {f"pin.{name}" for name in moving} <= {*problem.free.names} or problem.has_outlines:
        return mechanism
    places = {}
    for name in moving:
        body, local = locate(mechanism, f"pin.{name}")
        x, y, angle = q[mechanism.body_names.index(body)]
        c, s = np.cos(angle), np.sin(angle)
        places[f"pin.{name}"] = np.array([x + c * local[0] - s * local[1], y + s * local[0] + c * local[1]])
    return mechanism.with_parameters(places)
