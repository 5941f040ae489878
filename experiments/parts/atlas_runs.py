"""The runs of the atlas: for each mechanism several sweeps, each along one of the choices that somebody has to make.

`methods`: the pseudoinverse and the stabilization. `integrators`: the solver. `formulations`: how the accelerations are found.
`gains`: Baumgarte's, equal ones. `two gains`: those on Psi_dot and on Psi, which differ. `thresholds`: of the rank. Every run is
compared with its reference at the same instants.
"""

from collections.abc import Callable, Mapping
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import diffrax
import jax.numpy as jnp
import numpy as np
import xarray

import udkjax as udk
from experiments.parts.atlas_own import BraunGoldfarb, HalfImplicit
from experiments.parts.atlas_problems import Model, Problem
from experiments.parts.atlas_reference import Reference

TOLERANCES = tuple(10.0**-k for k in range(3, 13))
COARSE = TOLERANCES[1:8:3]  # where the tolerance is not what is asked for
MAX_STEPS = 3_000  # several times what a run takes that gets on
METHODS: dict[str, Callable[[float | None], Any]] = {
    "Auto": lambda x: udk.Auto(x),
    "Elimination": lambda x: udk.Elimination(x),
    "SVD": lambda x: udk.SVD(x),
    "Varga": lambda x: udk.Varga(x),
    "Householder": lambda x: udk.Householder(x),
    "Gram-Schmidt": lambda x: udk.GramSchmidt(x),
    "Greville": lambda x: udk.Greville(x),
}
DENSE = {
    "SVD": udk.SVD,
    "Varga": udk.Varga,
    "Householder": udk.Householder,
    "Gram-Schmidt": udk.GramSchmidt,
    "Greville": udk.Greville,
}
STABILIZATIONS = {
    "projection": udk.Projection(),
    "gains of 5": udk.Baumgarte(5.0, 5.0),
    "none": udk.Baumgarte(0.0, 0.0),
}
OWN = {"Braun and Goldfarb": BraunGoldfarb()}
SOLVERS: dict[str, Any] = {
    "Dopri5": diffrax.Dopri5(),
    "Tsit5": diffrax.Tsit5(),
    "Verner65": udk.Verner65(),
    "Dopri8": diffrax.Dopri8(),
    "Kvaerno5": diffrax.Kvaerno5(),
}
CONSTANT: dict[str, Any] = {"half-implicit": HalfImplicit()}  # by steps of equal length
MULTISTEP: dict[str, Any] = {"Adams": udk.Adams(), "BDF": udk.BDF()}
FORMULATIONS: dict[str, Any] = {
    "augmented, LU": udk.Augmented(),
    "null space, QR": udk.NullSpaceQR(),
    "null space, SVD": udk.NullSpaceSVD(),
}
SLOW_FORMULATIONS: dict[str, Any] = {
    "augmented, SVD": udk.Augmented(udk.SVD()),
    "partitioning": udk.CoordinatePartitioning(),
}
GAINS = tuple(float(x) for x in np.geomspace(0.5, 1000.0, 16).round(2))
GAIN_PAIRS = tuple(
    (a, round(a * ratio, 2)) for a, ratio in product((2.0, 5.0, 10.0, 20.0, 50.0), (0.25, 0.5, 0.7, 1.4, 2.0, 4.0))
)
THRESHOLDS = (1e-1, 1e-2, 1e-3, 1e-4, 1e-6, 1e-8, 1e-10, 1e-12)


class Part(NamedTuple):
    """A sweep: the settings of its cells, its tolerances, and how many of the starts it runs."""

    cells: list[dict[str, Any]]  # names for the data, and under `settings` what `udk.sweep` gets
    tolerances: tuple[float, ...] = TOLERANCES
    starts: int | None = None  # None: all
    steps: bool = False  # whether the tolerances are steps, relative to the duration
    timed: bool = False  # whether each method runs by itself, since the time of a chunk is shared by steps, whatever they cost
    repeats: bool = (
        False  # whether runs with projection are timed twice, but for the dense methods, which take several times as long
    )


def cell(**chosen: Any) -> dict[str, Any]:
    """Return a cell, by default the package's own choices."""
    names = {"method": "Auto", "stabilization": "projection", "solver": "default", "formulation": "Udwadia-Kalaba"}
    return names | {"gain": np.nan, "beta": np.nan, "threshold": np.nan} | chosen


def parts(problem: Problem) -> dict[str, Part]:
    """Return the sweeps of a mechanism by name."""
    found = {
        "methods": Part([cell(method=m, stabilization=s) for m in METHODS for s in STABILIZATIONS], timed=True, repeats=True),
        "integrators": Part([cell(solver=s) for s in SOLVERS], repeats=True),
        "formulations": Part([cell(formulation=f) for f in FORMULATIONS]),
        "gains": Part([cell(stabilization="gains", gain=g, beta=g) for g in GAINS]),
        "two gains": Part([cell(stabilization="two gains", gain=a, beta=b) for a, b in GAIN_PAIRS], TOLERANCES[1:8:2]),
    }
    if problem.thorough:  # programs that XLA compiles for seconds, and rank thresholds where ranks are at stake
        found["multistep"] = Part([cell(solver=s) for s in MULTISTEP], TOLERANCES[1:8:2], 2)
        found["Braun and Goldfarb"] = Part([cell(stabilization="Braun and Goldfarb")], TOLERANCES[:3], 2)
        found["constant steps"] = Part([cell(solver=s) for s in CONSTANT], (1e-2, 1e-3, 1e-4), 2, steps=True)
        found["partitioning"] = Part([cell(formulation=f) for f in SLOW_FORMULATIONS], TOLERANCES[1:8:2], 2)
    if problem.crosses or problem.redundant:  # elsewhere Greville finds the accelerations that Auto finds
        gains = [cell(method="Greville", stabilization="gains", gain=g, beta=g) for g in GAINS]
        found["gains, Greville"] = Part(gains, COARSE)
        several = [(s, m, x) for s in ("projection", "none") for m in METHODS for x in THRESHOLDS]
        starts = 1 if problem.is_spatial else 4  # violations that count as rank take thirty times as many steps there
        found["thresholds"] = Part([cell(method=m, stabilization=s, threshold=x) for s, m, x in several], COARSE, starts)
    return found


def settings(chosen: Mapping[str, Any], alone: bool = False) -> dict[str, Any]:
    """Return the arguments of `simulate` for a cell; those that it shares with all cells are left out."""
    threshold, name = chosen["threshold"], chosen["method"]
    own = (STABILIZATIONS | OWN).get(chosen["stabilization"])
    solver = (SOLVERS | MULTISTEP | CONSTANT).get(chosen["solver"])
    formulation = (FORMULATIONS | SLOW_FORMULATIONS).get(chosen["formulation"])
    found: dict[str, Any] = {"stabilization": own or udk.Baumgarte(chosen["gain"], chosen["beta"])}
    if formulation is not None:
        found["formulation"] = formulation
    elif alone and name in DENSE:  # all dense methods share a program
        number = np.asarray(list(DENSE).index(name))
        found["method"] = udk.OneOf(methods=tuple(one() for one in DENSE.values()), number=number)
    else:
        found["method"] = METHODS[name](None if np.isnan(threshold) else threshold)
    if solver is not None:
        found["solver"] = solver
    return found


def compare(problem: Problem, expected: Reference) -> Callable[[Model, udk.Solution], Any]:
    """Return a measure of a run: its largest error, relative to the problem's lengths, against the reference of its start."""
    states = problem.states(len(expected.q))
    starts = jnp.asarray(np.stack([np.concatenate([s.q, s.v]) for s in states]))
    q, lengths = jnp.asarray(expected.q), jnp.asarray(problem.lengths)

    def error(mechanism: Model, run: udk.Solution):
        begun = jnp.concatenate([run.q[0], run.v[0]])
        start = jnp.argmin(jnp.square(starts - begun).reshape(len(starts), -1).sum(1))
        return jnp.max(jnp.abs(run.q - q[start]) / lengths)

    return error


def run(problem: Problem, expected: Reference, part: Part, out: Path | None) -> list[tuple[list[dict[str, Any]], xarray.Dataset]]:
    """Run a part of the atlas, in one sweep or several; return the cells of each and its data.

    An interrupted sweep goes on from the chunks in the folder `out`.
    """
    groups: dict[str, list[dict[str, Any]]] = {}
    for one in part.cells:
        name = one["method"] if part.timed else ""
        twice = part.repeats and one["stabilization"] == "projection" and one["method"] not in DENSE
        groups.setdefault(f"{name}, projection" if twice else name, []).append(one)
    found = []
    for name, cells in groups.items():
        data = _sweep(problem, expected, part, cells, out and out / name)
        if name.endswith("projection"):
            again = _sweep(problem, expected, part, cells, out and out / f"{name}, again")
            least, most = np.minimum(data.seconds, again.seconds), np.maximum(data.seconds, again.seconds)
            data = data.assign(seconds=least, slower=most)
        found.append((cells, data))
    return found


def _sweep(problem: Problem, expected: Reference, part: Part, cells: list[dict[str, Any]], out: Path | None) -> xarray.Dataset:
    chosen = [settings(one, part.timed) for one in cells]
    tolerances = np.array(part.tolerances)
    if len(cells) > 1:
        varied: dict[str, Any] = {"cell": udk.Zipped({name: [one[name] for one in chosen] for name in chosen[0]})}
        shared: dict[str, Any] = {}
    else:
        varied, shared = {}, chosen[0]
    chosen_numbers = {"rtol": tolerances, "atol": tolerances}
    if part.steps:
        shared = shared | {"stepsize_controller": diffrax.ConstantStepSize()}
        chosen_numbers["dt0"] = tolerances * problem.end
    axes = varied | {
        "tol": udk.Zipped(chosen_numbers),
        "start": udk.Axis(problem.states(len(expected.q))[: part.starts], of="state"),
    }
    measures = {"wrong": compare(problem, expected), "closure": "violation", "energy": "energy_drift"}
    data = udk.sweep(
        problem.mechanism,
        axes,
        expected.ts,
        measures | {"n": "counts", "seconds": "seconds"},
        out=out,
        progress=False,
        max_steps=3 * MAX_STEPS if part.steps else MAX_STEPS,
        **shared,
        units={"wrong": "1"},
    )
    return data if varied else data.expand_dims("cell")
