"""Units of parameters and of the settings of a run."""

from udkjax.scene.mechanism import Mechanism
from udkjax.scene.parameters import holder_of, parameters_of, split

# The settings of a run that are numbers: one program serves all their values.
NUMBERS = {
    "rtol": "1",
    "atol": "1",
    "rank_tol": "1",  # relative; where the method is absolute, in the units of D
    "branch_tol": "1",
    "alpha": "1/s",
    "beta": "1/s",
    "t1": "s",
    "drift_tol": "1",
    "dt0": "s",
}
_FIELDS = {
    "gravity": "m/s2",
    "mass": "kg",
    "inertia": "kg m2",
    "position": "m",
    "angle": "rad",
    "velocity": "m/s",
    "angular_velocity": "rad/s",
    "points": "m",
    "point": "m",
    "axis": "rad",
    "length": "m",
    "radius": "m",
    "radii": "m",
    "constant": "m",
    "vector": "N",
    "value": "N m",
    "torque": "N m",
    "frequency": "rad/s",
    "phase": "rad",
    "times": "s",
}
_OF_TYPE = {
    ("Spring", "stiffness"): "N/m",
    ("Spring", "damping"): "N s/m",
    ("TorsionSpring", "stiffness"): "N m/rad",
    ("TorsionSpring", "damping"): "N m s/rad",
    ("Friction", "velocity"): "rad/s",
    ("Profile", "angle"): "rad",
}
_FOLLOWS = ("amplitude", "offset", "values")  # a motion law has the unit of the coordinate that it drives


def units_of(mechanism: Mechanism, name: str) -> str:
    """Return the unit of a parameter or of a setting; an empty text where it is not known."""
    if name in NUMBERS:
        return NUMBERS[name]
    known = parameters_of(mechanism)
    found = known.get(split(name, known)[0])
    if found is None:
        return ""
    if not found.path:
        return _FIELDS[name.partition("[")[0]]
    element = holder_of(mechanism, found)
    field = found.path[-1]
    if field in _FOLLOWS:
        return "rad" if getattr(mechanism.drivers.get(found.owner), "coordinate", "") == "angle" else "m"
    return _OF_TYPE.get((type(element).__name__, field), _FIELDS.get(field, ""))
