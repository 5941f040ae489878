"""User-defined systems as the player shows them: bodies at the poses of a drawing function, moved along a solution."""

from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from udkjax.equations.states.quantities import energy, violation
from udkjax.equations.systems.general import ConstrainedSystem
from udkjax.programs.deferred import deferred
from udkjax.scene.elements.bodies import Body
from udkjax.scene.mechanism import Mechanism

PlacesBodies: TypeAlias = Callable[[Any, Any], Mapping[str, Any]]  # (t, q) -> x, y and angle of each drawn body, by name


def drawn_system(system: ConstrainedSystem, solution: Any, drawing: PlacesBodies) -> tuple[Mechanism, Any, dict[str, np.ndarray]]:
    """Return the drawn bodies as a mechanism without joints, their motion, and the system's energy and largest violation.

    Args:
        system: The system.
        solution: A solution of the system: ts (T,), q and v (T, n).
        drawing: A function of t and q that returns x, y (m) and, if the body turns, the angle (rad) of each drawn body, by name.
    """
    names = list(drawing(jnp.asarray(solution.ts[0]), jnp.asarray(solution.q[0])))

    def poses(t: Any, q: Any) -> Any:
        placed = (jnp.ravel(jnp.asarray(x, float)) for x in drawing(t, q).values())
        return jnp.stack([jnp.concatenate([x, jnp.zeros(3 - x.size)]) for x in placed])

    @deferred
    def along(ts: Any, q: Any, v: Any) -> Any:
        return jax.vmap(lambda t, q, v: jax.jvp(poses, (t, q), (jnp.ones_like(t), v)))(ts, q, v)

    q, v = along(*(jnp.asarray(x, float) for x in (solution.ts, solution.q, solution.v)))
    bodies = {name: Body(mass=1.0, inertia=1.0, position=q[0, k, :2], angle=q[0, k, 2]) for k, name in enumerate(names)}
    rows = np.abs(np.asarray(violation(system, solution))).max(axis=1, initial=0.0)
    curves = {"energy (J)": np.asarray(energy(system, solution).total), "largest violation": rows}
    return Mechanism(bodies, {}, gravity=[0.0, 0.0]), SimpleNamespace(ts=solution.ts, q=q, v=v), curves
