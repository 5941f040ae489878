"""Runs by each pseudoinverse and formulation, and of traced mechanisms: the paper's linkage, 5 s, 101 outputs, at 1e-8.

Each method takes one run and 64 of them under `vmap`, by machine code and in plain JAX; Adams and BDF of diffrax take the same
equations. A jitted function of a mechanism, a library function and stacked mechanisms are compared with a concrete one.
"""

import statistics
from typing import Any

import jax
import numpy as np

import udkjax as udk
from benchmarks.common import Compiled, in_turn, ratio

METHODS = (udk.Auto(), udk.Elimination(), udk.Greville(), udk.GramSchmidt(), udk.Householder(), udk.Varga(), udk.SVD())
FORMULATIONS = (udk.NullSpaceQR(), udk.NullSpaceSVD(), udk.Augmented(udk.SVD()))
MEMBERS, ROUNDS = 64, 9


def main(smoke: bool = False) -> list[dict[str, Any]]:
    """Print CPU times in ms and relative to the run by `Auto`, and the time to compile."""
    ts, members, rounds = (np.linspace(0.0, 0.1, 3), 2, 1) if smoke else (np.linspace(0.0, 5.0, 101), MEMBERS, ROUNDS)
    linkage, masses, angles = udk.library.parallelogram(), np.linspace(1.0, 1.2, members), np.linspace(-0.9, -0.5, members)

    def by(engine: Any = "auto", **choices: Any):
        changed = lambda mass: linkage.with_parameters({"body.link1.mass": mass})  # noqa: E731
        return lambda mass: udk.simulate(changed(mass), ts, engine=engine, **choices).q

    def of_geometry(angle):
        return udk.simulate(udk.library.parallelogram(angle=angle), ts).q

    def of_mechanism(mechanism):
        return udk.simulate(mechanism, ts).q

    figures = []
    stacked = jax.vmap(lambda angle: udk.library.parallelogram(angle=angle))(angles)
    chosen: dict[str, dict[str, Any]] = {type(m).__name__: {"method": m} for m in METHODS}
    chosen |= {type(x).__name__: {"formulation": x} for x in FORMULATIONS}
    if smoke:
        chosen = {name: chosen[name] for name in ("Auto", "Greville", "NullSpaceQR")}
    single = {name: (by(**choices), 1.0) for name, choices in chosen.items()}
    batch = {f"{name}, {members}": (jax.vmap(by(**choices)), masses) for name, choices in chosen.items()}
    plain = {f"{name}, plain JAX": (by("jax", **choices), 1.0) for name, choices in list(chosen.items())[2:] if not smoke}
    solvers = {}
    if not smoke:
        for solver in (udk.Adams(), udk.BDF()):
            solvers[type(solver).__name__] = by(solver=solver), 1.0
            solvers[f"{type(solver).__name__}, plain JAX"] = by("jax", solver=solver), 1.0
    traced = {
        "jit of a mechanism": (of_mechanism, linkage),
        "function of the library": (of_geometry, -0.7),
        f"function of the library, {members}": (jax.vmap(of_geometry), angles),
        f"stacked mechanisms, {members}": (jax.vmap(of_mechanism), stacked),
    }
    print(f"{'the linkage, 5 s':32} {'ms':>9} {'times Auto':>11} {'compile s':>10}")
    for group, baseline in ((single | plain | solvers, "Auto"), (batch, f"Auto, {members}")):
        further = {k: v for k, v in traced.items() if (k.endswith(str(members))) == (group is batch)}
        given = group | further
        compiled = {name: (Compiled(f, x), x) for name, (f, x) in given.items()}

        def beside(name: str, compiled: Any = compiled, baseline: str = baseline) -> dict[str, list[float]]:
            call = lambda key: compiled[key][0].cpu_seconds(compiled[key][1])  # noqa: E731
            return in_turn({key: lambda key=key: call(key) for key in (baseline, name)}, rounds)

        times = {name: beside(name) for name in given}
        for name, found in times.items():
            row = {"name": name, "ms": statistics.median(found[name]) * 1e3, "times": ratio(found[name], found[baseline])}
            figures.append(row | {"compile_s": compiled[name][0].compile_seconds})
            print(f"{name:32} {row['ms']:9.3f} {row['times']:11.2f} {compiled[name][0].compile_seconds:10.2f}")
    return figures
