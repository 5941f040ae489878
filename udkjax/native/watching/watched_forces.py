"""The program of the forces that a run watches (`Conditions.forces`), for modules with multipliers in their memory."""

from udkjax.native.language.ir import Function
from udkjax.native.language.program import write
from udkjax.native.run.trajectory import Trajectory
from udkjax.native.watching.conditions import Conditions


def write_forces(conditions: Conditions, module: Trajectory, numbers: str = "condition numbers") -> Function:
    """Return the function `own_forces(work)`, which computes the array `forces` from the arrays `multipliers` and `numbers`.

    Args:
        conditions: the conditions, with forces.
        module: the module, whose memory has these arrays.
        numbers: the name of the array that holds the numbers of the conditions.
    """
    assert conditions.forces is not None  # checked by the caller
    p = module.places
    inputs = [("work", p[numbers] + i) for i in range(conditions.number_count)]
    inputs += [("work", p["multipliers"] + i) for i in range(module.m)]
    outputs = [("work", p["forces"] + k) for k in range(conditions.force_count)]
    return write(conditions.forces, "own_forces", module.plan.width, ("work",), inputs, outputs)
