"""Curves for linkages: capital letters, each in one stroke of a pen, classic curves, and curves of random linkages."""

import numpy as np
import svgelements

from udkjax.synthesis.curves.curve_file import FRACTIONS
from udkjax.synthesis.curves.dyad_forms import PINS
from udkjax.synthesis.curves.dyads import BASE_LINKS, DYAD_NUMBERS, HEAD_NUMBERS, SECOND_PIVOT, Topology, number_count, positions
from udkjax.synthesis.curves.targets import as_points

LETTERS = {
    "A": "M0 6 L2 0 L4 6 L3.2 3.6 H0.8",
    "B": "M0 6 V0 H2.5 A1.5 1.5 0 0 1 2.5 3 H0 H2.5 A1.5 1.5 0 0 1 2.5 6 Z",
    "C": "M4 1 A2.4 3 0 1 0 4 5",
    "D": "M0 6 V0 H1 A3 3 0 0 1 1 6 Z",
    "E": "M4 0 H0 V3 H3 H0 V6 H4",
    "F": "M4 0 H0 V3 H3 H0 V6",
    "G": "M4 1 A2.4 3 0 1 0 4 5 V3.2 H2.5",
    "H": "M0 0 V6 V3 H4 V0 V6",
    "I": "M0 0 V3 V6",
    "J": "M4 0 V4 A2 2 0 0 1 0 4",
    "K": "M0 0 V6 V3.6 L4 0 L1.5 2.25 L4 6",
    "L": "M0 0 V6 H4",
    "M": "M0 6 V0 L2 4 L4 0 V6",
    "N": "M0 6 V0 L4 6 V0",
    "O": "M2 0 A2 3 0 1 0 2 6 A2 3 0 1 0 2 0 Z",
    "P": "M0 6 V0 H2.4 A1.6 1.6 0 0 1 2.4 3.2 H0",
    "Q": "M4.1 6.2 L2.5 4.2 L3.3 5.28 A2 3 0 1 1 2 0 A2 3 0 0 1 3.3 5.28",
    "R": "M0 6 V0 H2.4 A1.6 1.6 0 0 1 2.4 3.2 H0 H1.8 L4 6",
    "S": "M3.8 1 A1.9 1.5 0 1 0 2 3 A1.9 1.5 0 1 1 0.2 5",
    "T": "M0 0 H4 H2 V6",
    "U": "M0 0 V4 A2 2 0 0 0 4 4 V0",
    "V": "M0 0 L2 6 L4 0",
    "W": "M0 0 L1 6 L2 2 L3 6 L4 0",
    "X": "M0 0 L4 6 L2 3 L4 0 L0 6",
    "Y": "M0 0 L2 3 L4 0 L2 3 V6",
    "Z": "M0 0 H4 L0 6 H4",
}


def points_of_path(path: str) -> np.ndarray:
    """Return the points (n, 2) of a path of SVG in one stroke, with y upwards."""
    segments = [one for one in svgelements.Path(path).segments() if not isinstance(one, svgelements.Move)]
    return np.concatenate([one.npoint(FRACTIONS) for one in segments]) * [1.0, -1.0]


def letter(name: str) -> np.ndarray:
    """Return the points (n, 2) of a letter, 6 high."""
    return points_of_path(LETTERS[name])


def classic_curves() -> dict[str, np.ndarray]:
    """Return curves of textbooks, of different sizes, by name."""
    t = np.linspace(0.0, 2.0 * np.pi, 240, endpoint=False)
    arc, sweep = np.linspace(-0.6, 0.6, 120), np.linspace(-np.pi / 4, 5 * np.pi / 4, 160)
    star = np.exp(1j * (np.pi / 2 + np.arange(10) * np.pi / 5)) * np.where(np.arange(10) % 2, 0.45, 1.0)
    return {
        "straight line": as_points(np.linspace(0.0, 1.0, 50) + 0j),
        "line and return": as_points(np.concatenate([np.linspace(-1.0, 1.0, 80) + 0j, np.cos(t[:120]) + 0.5j * np.sin(t[:120])])),
        "arc": as_points(1j * np.exp(1j * arc)),
        "horseshoe": as_points(np.exp(1j * sweep)),
        "figure eight": as_points(np.sin(t) + 0.5j * np.sin(2 * t)),
        "heart": as_points(16 * np.sin(t) ** 3 + 1j * (13 * np.cos(t) - 5 * np.cos(2 * t) - 2 * np.cos(3 * t) - np.cos(4 * t))),
        "star": as_points(np.append(star, star[0])),
        "step of a leg": as_points(
            np.concatenate([np.linspace(1.0, -1.0, 100) + 0j, -np.cos(t[:120]) + 0.7j * np.sin(t[:120]) ** 2])
        ),
        "trefoil": as_points(np.sin(t) + 2 * np.sin(2 * t) + 1j * (np.cos(t) - 2 * np.cos(2 * t))),
        "square": points_of_path("M0 0 H1 V1 H0 Z"),
    }


def curves_of_mechanisms(count: int, rng: np.random.Generator) -> list[np.ndarray]:
    """Return curves of random linkages of 4, 7 or 10 joints, drawn at random until their crank turns."""
    curves: list[np.ndarray] = []
    theta = np.linspace(0.0, 2.0 * np.pi, 361)[None]
    while len(curves) < count:
        dyads = 1 + len(curves) % 3
        second_crank, links = np.arange(SECOND_PIVOT, HEAD_NUMBERS), BASE_LINKS + 2 * np.arange(dyads)
        x = np.insert(rng.uniform(-2.0, 2.0, number_count(dyads) - len(second_crank)), [SECOND_PIVOT] * len(second_crank), 0.0)[
            None
        ]
        x[0, HEAD_NUMBERS : HEAD_NUMBERS + 2] = rng.uniform(0.3, 1.0), 0.0
        for k in HEAD_NUMBERS + DYAD_NUMBERS * np.arange(dyads):
            x[0, k + 4 : k + 6] = rng.uniform(0.7, 3.0, 2)
        first = np.array([[1, *(links[1:] - rng.integers(1, 3, dyads - 1))]])
        second = np.where(rng.random((1, dyads)) < 0.5, 0, np.maximum(first - 2, 0) * (first > BASE_LINKS + 1))
        at = positions(
            x,
            Topology(first, second, rng.choice([-1.0, 1.0], (1, dyads)), np.full((1, dyads), PINS), np.zeros(1, int)),
            theta,
            0.0,
        )
        if np.abs(at.cosines).max() < np.cos(np.deg2rad(10.0)) and np.ptp(np.real(at.pin)) > 0.1:
            curves.append(as_points(at.pin[0, :-1]))
    return curves
