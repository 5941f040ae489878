"""Constraints that events switch on and off, and friction that is switched together with its joint.

A switched element has one more number, `active`: one, or zero, which makes its rows of Psi, or its loads, vanish. All sets of
constraints that events can leave behind are thus one mechanism with different numbers, and share its equations and its code.
"""

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from functools import cache
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from udkjax.arrays import is_traced, make_module, number
from udkjax.scene.elements.forces import Wrench
from udkjax.scene.elements.friction import Friction
from udkjax.scene.elements.joints import Constraint, Joint
from udkjax.scene.elements.rolling import RollingJoint
from udkjax.scene.mechanism import Mechanism

AnyConstraint = TypeVar("AnyConstraint", bound=Constraint)


def switched(constraint: AnyConstraint) -> AnyConstraint:
    """Return a constraint with the further number `active`, which is one: the constraint is switched on."""
    return make_module(_switched(type(constraint)), **vars(constraint), active=number(1.0))


def unswitched(constraint: Constraint) -> Constraint:
    """Return a constraint without the number `active`."""
    plain: Any = type(constraint).__bases__[0]
    return make_module(plain, **{name: x for name, x in vars(constraint).items() if name != "active"})


@cache
def _switched(cls: type) -> Any:
    """Return the subclass of a class of constraints whose elements have the number `active`."""

    class Switched(cls):
        active: Float[Array, ""] = eqx.field(default=1.0)

        def residual(self, t, *frames):
            # Not a product: what is off may be undefined.
            return [jnp.where(self.active > 0.5, row, 0.0) for row in super().residual(t, *frames)]

    if not issubclass(cls, RollingJoint):
        return Switched

    class SwitchedRolling(cls):
        active: Float[Array, ""] = eqx.field(default=1.0)

        def rates(self, t, *frames):
            return [jnp.where(self.active > 0.5, row, 0.0) for row in super().rates(t, *frames)]

    return SwitchedRolling


@cache
def switched_friction(cls: type) -> Any:
    """Return the subclass of a class of friction with the number `active`, for a joint that can be switched."""

    class SwitchedFriction(cls):
        active: Float[Array, ""] = eqx.field(default=1.0)

        def loads(self, t, *frames):
            loads = super().loads(t, *frames)
            return None if loads is None else [self._switched(load) for load in loads]

        def rubbing_loads(self, joint, multipliers, t, *frames):
            return [self._switched(load) for load in super().rubbing_loads(joint, multipliers, t, *frames)]

        def largest_force(self, joint, multipliers):
            return self.active * super().largest_force(joint, multipliers)

        def _switched(self, load: Wrench) -> Wrench:
            x, y, torque = load
            return self.active * x, self.active * y, self.active * torque

    return SwitchedFriction


def with_switched_friction(forces: dict[str, Any], names: Sequence[str]) -> dict[str, Any]:
    """Return force elements by name, in which the friction of the joints `names` has the number `active`, set to one."""
    result = {}
    for name, force in forces.items():
        is_switched = isinstance(force, Friction) and force.joint in names
        result[name] = force
        if is_switched:
            result[name] = make_module(switched_friction(type(force)), **vars(force), active=number(1.0))
    return result


def with_switches(
    mechanism: Mechanism, names: Sequence[str], others: Mapping[str, Joint], friction: Mapping[str, Friction]
) -> Mechanism:
    """Return the mechanism with further joints, in which these joints and the named constraints have a switch, set to on.

    Args:
        mechanism: The scene.
        names: The constraints of the scene that can be switched.
        others: The further joints by name; numbers that they leave open are taken from the initial guess.
        friction: The friction of further joints, by joint.
    """
    of_scene: dict[str, Any] = {name: switched(x) for name, x in mechanism.constraints.items() if name in names}
    is_concrete = mechanism.is_concrete and not is_traced((list(others.values()), list(friction.values())))
    with jax.ensure_compile_time_eval() if is_concrete else nullcontext():  # numbers taken from the guess stay concrete
        joints, drivers = (
            {k: of_scene.get(k, x) for k, x in elements.items()} for elements in (mechanism.joints, mechanism.drivers)
        )
        forces = with_switched_friction(dict(mechanism.forces), list(of_scene))
        for joint, force in friction.items():
            name = next(x for k in range(len(forces) + 1) if (x := f"{joint} friction{' ' * k}") not in forces)
            forces[name] = force
        whole = Mechanism(mechanism.bodies, joints | dict(others), drivers, forces, mechanism.gravity, mechanism.name)
        whole = whole.without_origin
        completed = [switched(whole.joints[name]) for name in others]
        return eqx.tree_at(lambda m: [m._joints[m.joint_names.index(name)] for name in others], whole, completed)


def switch(mechanism: Mechanism, names: Sequence[str], active: Sequence[Any]) -> Mechanism:
    """Return the mechanism with new numbers `active`, one for each of the switched constraints `names`, and for its friction."""

    def numbers(m: Mechanism) -> list[Any]:
        return [element.active for _, element in _switched_elements(m, names)]

    new = dict(zip(names, active, strict=True))
    return eqx.tree_at(numbers, mechanism, [new[name] for name, _ in _switched_elements(mechanism, names)])


def _switched_elements(mechanism: Mechanism, names: Sequence[str]) -> list[tuple[str, Any]]:
    constraints, forces = mechanism.constraints, mechanism._forces
    return [(name, constraints[name]) for name in names] + [
        (f.joint, f) for f in forces if isinstance(f, Friction) and hasattr(f, "active")
    ]


def places_of_switches(mechanism: Mechanism, names: Sequence[str]) -> tuple[tuple[int, int], ...]:
    """Return the places of all `active` among the numbers of a mechanism, each with the index of its constraint in `names`."""
    zeros = jax.tree.map(lambda x: np.zeros(np.shape(x)), mechanism)
    marked = switch(zeros, names, [np.asarray(k + 1.0) for k in range(len(names))])
    numbers = np.concatenate([np.ravel(x) for x in jax.tree.leaves(marked)])
    return tuple((int(place), int(numbers[place]) - 1) for place in np.flatnonzero(numbers))
