"""Units of parameters and of settings of a run."""

from typing import Any

from udkjax.scene.elements.held import Held
from udkjax.scene.numbers.named_numbers import NamedNumber
from udkjax.scene.numbers.number_fields import owner_of, split_index

# Numeric settings of a run; one program serves all values.
NUMBERS = {
    "rtol": "1",
    "atol": "1",
    "rank_tol": "1",  # relative; in the units of D if the method is absolute
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
    "off": "m",
    "lead": "m",
    "to_points": "m",
    "to_axis": "rad",
    "constant": "m",
    "vector": "N",
    "value": "N m",
    "torque": "N m",
    "frequency": "rad/s",
    "phase": "rad",
    "times": "s",
    "density": "kg/m3",
    "width": "m",
    "thickness": "m",
    "centre": "m",
    "outline": "m",
    "holes": "m",
    "direction": "rad",
    "speed": "rad/s",
    "force": "N",
}
_OF_TYPE = {
    ("Spring", "stiffness"): "N/m",
    ("Spring", "damping"): "N s/m",
    ("TorsionSpring", "stiffness"): "N m/rad",
    ("TorsionSpring", "damping"): "N m s/rad",
    ("Friction", "velocity"): "rad/s",
    ("Friction", "speed"): "m/s",
    ("Friction", "viscous"): "s/m",
    ("Profile", "angle"): "rad",
    ("LiftProfile", "base"): "m",
    ("LiftProfile", "lift"): "m",
    ("LiftProfile", "start"): "rad",
    ("LiftProfile", "eccentricity"): "m",
    ("SwingProfile", "base"): "m",
    ("SwingProfile", "swing"): "rad",
    ("SwingProfile", "start"): "rad",
    ("SwingProfile", "pivot"): "m",
    ("SwingProfile", "arm"): "m",
    ("NamedNumber", "value"): "",
    ("GearPair", "pitch"): "m",
    ("Cam", "face"): "rad",
    ("CamPair", "face"): "rad",
    ("SlideMotor", "speed"): "m/s",
}
MOTION_LAW_FIELDS = ("amplitude", "offset", "values")  # a motion law has the unit of the coordinate that it drives


def units_of(mechanism: Any, name: str) -> str:
    """Return the unit of a parameter or of a setting; an empty string if unknown."""
    if name in NUMBERS:
        return NUMBERS[name]
    known = mechanism.number_fields()
    field = known.get(split_index(name, known)[0])
    if field is None:
        return ""
    if not field.path:
        return _FIELDS.get(name.partition("[")[0], "")
    driven = getattr(mechanism.groups["driver"].get(field.owner), "coordinate", "")
    owner = owner_of(mechanism, field)
    if isinstance(owner, NamedNumber):
        return owner.unit
    if isinstance(owner, Held):
        field = field._replace(path=field.path[:-1])
        owner = owner_of(mechanism, field)
    return field_unit(getattr(owner, "measured_as", type(owner).__name__), field.path[-1], driven)


def field_unit(type_name: str, field: str, driven: str = "") -> str:
    """Return the unit of a field of a scene class, "" if unknown; that of a motion law depends on the driven coordinate."""
    if field in MOTION_LAW_FIELDS:
        return "rad" if driven == "angle" else "m"
    return _OF_TYPE.get((type_name, field), _FIELDS.get(field, ""))
