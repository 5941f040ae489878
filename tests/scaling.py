"""Mechanisms in other units of length, time and mass: the same motion, written down with other numbers."""

import re

import numpy as np

import udkjax as udk
from udkjax.scene.numbers.units import units_of


def scaled(mechanism: udk.Mechanism, length: float = 1.0, time: float = 1.0, mass: float = 1.0) -> udk.Mechanism:
    """Return a mechanism whose lengths, times and masses are so many times as large."""
    base = {"m": length, "s": time, "kg": mass, "rad": 1.0, "N": mass * length / time**2}

    def factor(unit: str) -> float:
        sides = unit.split("/")
        parts = [
            (name, (-1) ** k * int(power or 1))
            for k, side in enumerate(sides)
            for name, power in re.findall(r"([A-Za-z]+)(\d*)", side)
        ]
        return float(np.prod([base[name] ** power for name, power in parts]))

    values = {}
    for name, value in mechanism.parameters().items():
        if name.endswith(".coefficients"):  # of a polynomial in time, each with a unit of its own
            driven = 1.0 if mechanism.drivers[name.split(".")[1]].coordinate == "angle" else length
            values[name] = value * driven / time ** np.arange(len(value))
        else:
            values[name] = value * factor(units_of(mechanism, name))
    return mechanism.with_parameters(values)
