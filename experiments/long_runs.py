"""Over a thousand periods the energy error grows like t and the phase error like t^2; Adams methods lose least for their cost.

Both systems are equivalent to a pendulum, phi'' = -w^2 sin(phi), with the energy J (phi'^2 / 2 - w^2 cos(phi)): the IFToMM
benchmark A01 (a point mass on a rod, 2000 s) and the paper's linkage (phi = theta + 90 degrees, J = 3.05 kg m^2, 1000 periods).
In action and angle variables the motion is E = const, psi' = Omega(E), with Omega = pi w / (2 K(k^2)), and psi follows from a
state by an elliptic integral. The error of a run therefore splits, without any fit, into an energy error and a phase error.

The local error of an integrator is the same in each period as long as the orbit is the same. A method that is not symmetric
(with an adaptive step, none of these is) gains or loses a fixed energy in each period, so dE ~ t, and

    dpsi = c t + Omega'(E) int dE dt,        one part ~ t, and one ~ t^2, which dominates (Hairer, Lubich, Wanner, 2006, X.3).

An Adams method changes its order and its steps irregularly, so that gains and losses nearly cancel from period to period: its
energy may fluctuate for a long time before it drifts.

Projection returns states to the constraint manifold, on which E is free: it does not conserve E. Without projection, however,
the loops open, and the reactions do work, dE/dt = -lambda^T Psi_dot, which exceeds the errors of the steps themselves. The
energy of a short run may show something else: results at output times come from the polynomial between the steps. With Dopri8,
whose steps are long and of order 8 but whose polynomial is of order 5, and with Verner65, whose polynomial is of order 4, these
results are less accurate than the ends of the steps.
"""

import json
from pathlib import Path
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import xarray
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from scipy.special import ellipk, ellipkinc

import udkjax as udk
from experiments.common import described, panels, tracked
from experiments.parts.stepping import by_tolerance
from udkjax.equations import prepare
from udkjax.integrate.diffrax_engine import derivative
from udkjax.show.style import COLOURS
from udkjax.study.accuracy import pendulum

SOLVERS: dict[str, Any] = {
    "Dopri8": diffrax.Dopri8,
    "Dopri5": diffrax.Dopri5,
    "Tsit5": diffrax.Tsit5,
    "Verner65": lambda: udk.Verner65(),
    "Adams": lambda: udk.Adams(),
    "BDF": lambda: udk.BDF(),
}
RUNGE_KUTTA = ("Dopri8", "Dopri5", "Tsit5", "Verner65")
TOLERANCES = (1e-6, 1e-8, 1e-10)
REFERENCE = Path(__file__).parents[1] / "tests" / "data" / "iftomm_A01_simple_pendulum.json"
MAX_STEPS, EVERY = 2**23, 64  # each 64th step is looked at
KEPT = 96  # number of steps kept in the file, spread evenly over the logarithm of time
SETTLED = 0.05  # fraction of the span after which a law is fitted
BUDGET_TOL, BUDGET_END = 1e-9, 20.0  # tolerance and end (s) of the short run whose energy is split into its parts


class Orbit(NamedTuple):
    """A mechanism that is a pendulum, and how to see it as one."""

    mechanism: udk.Mechanism
    J: float  # kg m^2
    w: float  # 1/s
    end: float  # s

    def pendulum(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return phi (rad, from hanging) and phi' of states (T, 2n)."""
        q, v = np.split(y, 2, axis=1)
        if q.shape[1] == 3:
            return np.arctan2(q[:, 0], -q[:, 1]), (q[:, 0] * v[:, 1] - q[:, 1] * v[:, 0]) / (q[:, :2] ** 2).sum(1)
        return q[:, 2] + np.pi / 2, v[:, 2]

    def energy(self, y: np.ndarray) -> np.ndarray:
        """Return the energy above that of hanging at rest (J), 2 J w^2 k^2."""
        return 2 * self.J * self.w**2 * self.modulus(y) ** 2

    def modulus(self, y: np.ndarray) -> np.ndarray:
        """Return k."""
        phi, rate = self.pendulum(y)
        return np.hypot(np.sin(phi / 2), rate / (2 * self.w))

    def phase(self, y: np.ndarray) -> np.ndarray:
        """Return psi (rad)."""
        phi, rate = self.pendulum(y)
        k = self.modulus(y)
        return np.pi / 2 * ellipkinc(np.arctan2(np.sin(phi / 2), rate / (2 * self.w)), k**2) / ellipk(k**2)

    def frequency(self, y: np.ndarray) -> np.ndarray:
        """Return Omega (rad/s)."""
        return np.pi / 2 * self.w / ellipk(self.modulus(y) ** 2)


def orbits() -> dict[str, Orbit]:
    w = np.sqrt(3.5 * 9.81 / 3.05)
    linkage = Orbit(udk.library.parallelogram(np.deg2rad(-45.0)), 3.05, w, 1000 * 4 / w * float(ellipk(np.sin(np.pi / 8) ** 2)))
    return {"A01": Orbit(udk.library.simple_pendulum(), 1.0, np.sqrt(9.81), 2000.0), "linkage": linkage}


class History(NamedTuple):
    """Errors along a run, at KEPT times: of energy (J), of phase (rad), and of phase as those of energy alone would make it."""

    time: np.ndarray
    energy: np.ndarray
    phase: np.ndarray
    predicted: np.ndarray


def history(orbit: Orbit, ts: np.ndarray, ys: np.ndarray) -> History:
    """Split the errors of a run into energy and phase."""
    E, psi, frequency = orbit.energy(ys), orbit.phase(ys), orbit.frequency(ys)
    wrong = np.unwrap(psi - psi[0] - frequency[0] * ts)
    wrong = wrong - wrong[0]
    excess = frequency - frequency[0]
    predicted = np.append(0.0, np.cumsum(np.diff(ts) * (excess[1:] + excess[:-1]) / 2))
    kept = np.searchsorted(ts, np.geomspace(max(orbit.end / 1000, ts[1]), ts[-1], KEPT))
    return History(*(x[kept] for x in (ts, E - E[0], wrong, predicted)))


def study(smoke: bool) -> xarray.Dataset:
    systems = {name: orbit for name, orbit in orbits().items() if not smoke or name == "A01"}
    solvers, tolerances = (("Dopri8", "Verner65"), TOLERANCES[:2]) if smoke else (tuple(SOLVERS), TOLERANCES)
    shape = (len(systems), len(solvers), len(tolerances))
    found, cost = np.full((4, *shape, KEPT), np.nan), np.full(shape, -1)
    for (i, orbit), (j, solver) in tracked(
        [(s, m) for s in enumerate(systems.values()) for m in enumerate(solvers)], "long_runs"
    ):
        end = 1000.0 if smoke else orbit.end
        run = by_tolerance(orbit.mechanism, SOLVERS[solver](), end, 4 if smoke else EVERY, MAX_STEPS // (64 if smoke else 1))
        for k, tol in enumerate(tolerances):
            ts, ys, cost[i, j, k], good, _ = run(tol)
            seen = np.isfinite(ts)
            if good:
                found[:, i, j, k] = history(orbit, np.asarray(ts)[seen], np.asarray(ys)[seen])
    dims = ("system", "solver", "tol", "sample")
    texts = ("time", "error of the energy", "error of the phase", "error of the phase that the errors of energy make")
    units = ("s", "J", "rad", "rad")
    data = xarray.Dataset(
        {
            name: (dims, values.astype(np.float32), {"long_name": text, "units": unit})
            for name, values, text, unit in zip(History._fields, found, texts, units)
        },
        coords={
            "system": list(systems),
            "solver": list(solvers),
            "tol": list(tolerances),
            "budget": list(solvers[:1] if smoke else solvers),
        },
    )
    data["right_hand_sides"] = (dims[:3], cost)
    for name, values in budgets(("Dopri8",) if smoke else solvers).items():
        data[name] = ("budget", values, {"units": "J"})
    data["reference_error"] = reference_error()
    scenes = "\n".join(udk.dumps(orbit.mechanism) for orbit in systems.values())
    return described(
        data, scenes, {"tolerances": TOLERANCES, "spans": [orbit.end for orbit in systems.values()], "method": "Elimination"}
    )


def reference_error() -> float:
    """Return by how much the exact solution used here differs from the benchmark's reference positions (m), to 2000 s."""
    table = json.loads(REFERENCE.read_text())["reference_exact"]
    ts = np.array(sorted(map(float, table)))
    phi = -np.pi / 2 + pendulum(ts, -np.pi / 2, 0.0, np.sqrt(9.81))
    given = [[float(table[f"{t:g}"][axis]) for axis in "xy"] for t in ts]
    return float(np.abs(np.stack([np.sin(phi), -np.cos(phi)], 1) - given).max())


def budgets(solvers: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Take apart the energy of the linkage over 20 s at 1e-9: largest errors at step ends and at 401 outputs, sums of changes.

    `by_steps` and `by_projections` are the sums of the changes by steps and by their projections (Runge-Kutta only: a step
    can be taken again without its history).
    """
    orbit, ts = orbits()["linkage"], np.linspace(0.0, BUDGET_END, 401)
    names = ("at_step_ends", "unprojected_step_ends", "at_outputs", "by_steps", "by_projections")
    found = {name: np.full(len(solvers), np.nan) for name in names}
    for row, name in enumerate(tracked(solvers, "long_runs, energy of a short run")):
        for what, projected in (("at_step_ends", True), ("unprojected_step_ends", False)):
            run = by_tolerance(orbit.mechanism, SOLVERS[name](), BUDGET_END, 1, 2**15, projected, ts)
            times, ys, *_, outputs = run(BUDGET_TOL)
            seen = np.isfinite(times)
            times, ys = np.asarray(times)[seen], np.asarray(ys)[seen]
            E = total(orbit.mechanism, ys)
            found[what][row] = np.abs(E - E[0]).max()
            if not projected:
                continue
            found["at_outputs"][row] = np.abs(total(orbit.mechanism, settled(orbit.mechanism, outputs)) - E[0]).max()
            if name in RUNGE_KUTTA:
                raw = total(orbit.mechanism, again(orbit.mechanism, SOLVERS[name](), times, ys))
                found["by_steps"][row], found["by_projections"][row] = np.sum(raw - E[:-1]), np.sum(E[1:] - raw)
    return found


def settled(mechanism: udk.Mechanism, ys: Any) -> np.ndarray:
    """Return states between the steps to the manifold, as `simulate` does."""
    equations = prepare(mechanism, udk.Elimination())
    once = lambda y: jnp.concatenate(equations.project(0.0, *jnp.split(y, 2)))  # noqa: E731
    return np.asarray(jax.jit(lambda ys: jax.lax.map(lambda y: once(once(y)), ys))(ys))


def total(mechanism: udk.Mechanism, ys: np.ndarray) -> np.ndarray:
    """Return the energy (J) of states (T, 2n), on the manifold or off it."""
    equations = prepare(mechanism, udk.Elimination())
    return np.asarray(jax.jit(jax.vmap(lambda y: sum(equations.energy(0.0, *jnp.split(y, 2)))))(ys))


def again(mechanism: udk.Mechanism, solver: Any, times: np.ndarray, ys: np.ndarray) -> np.ndarray:
    """Return where each step of a Runge-Kutta method leads before it is projected."""
    equations, terms = prepare(mechanism, udk.Elimination()), diffrax.ODETerm(derivative)

    def step(t0, t1, y):
        state = solver.init(terms, t0, t1, y, equations)
        return solver.step(terms, t0, t1, y, equations, state, jnp.array(True))[0]

    return jax.jit(jax.vmap(step))(times[:-1], times[1:], ys[:-1])


def exponents(data: xarray.Dataset, what: str) -> xarray.DataArray:
    """Return p in |error| ~ t^p along each run, over the part of the run where the law has settled."""

    def fit(t, e):
        settled = (t > SETTLED * t[-1]) & (np.abs(e) > 0)
        return np.polyfit(np.log(t[settled]), np.log(np.abs(e[settled])), 1)[0] if settled.sum() > 3 else np.nan

    args = [data.time.astype(float), data[what].astype(float)]
    return xarray.apply_ufunc(fit, *args, input_core_dims=[["sample"]] * 2, vectorize=True)


def explained(data: xarray.Dataset) -> xarray.DataArray:
    """Return which part of the phase error at the end the errors of energy account for."""
    return (data.predicted / data.phase).isel(sample=-1)


def holds(data: xarray.Dataset) -> dict[str, bool]:
    steady = data.sel(solver=[name for name in data.solver.values if name != "Adams"])
    energy, phase, part = (x.values for x in (exponents(steady, "energy"), exponents(steady, "phase"), explained(steady)))
    dopri8 = data.sel(budget="Dopri8")
    explicit = data.sel(budget=[name for name in data.budget.values if name != "BDF"])
    parts = {
        "every run reaches the end": bool(np.isfinite(data.energy).all()),
        "energy drifts like t": bool((np.abs(energy - 1) < 0.05).all()),
        "phase is lost like t^2": bool(np.median(np.abs(phase - 2)) < 0.05),
        "as the errors of energy have it, within a tenth": bool((np.abs(part - 1) < 0.1).all()),
        "a short run by Dopri8 shows its interpolation: 10 times the error of its steps": bool(
            dopri8.at_outputs > 10 * dopri8.at_step_ends
        ),
        "not projected, the energy is worse": bool((explicit.at_step_ends < explicit.unprojected_step_ends).all()),
        "exact solution and benchmark agree": float(data.reference_error) < 1e-9,
    }
    if "Adams" in data.solver:
        adams, looser = data.sel(solver="Adams", tol=1e-10), data.sel(solver="Dopri8", tol=1e-8)
        less = (np.abs(adams.phase) < 0.1 * np.abs(looser.phase)).isel(sample=-1)
        cheaper = adams.right_hand_sides < looser.right_hand_sides
        parts["Adams at 1e-10 costs less than Dopri8 at 1e-8 and loses less than a tenth of the phase"] = bool(
            (less & cheaper).all()
        )
    return parts


def headline(data: xarray.Dataset) -> str:
    steady = data.sel(solver=[name for name in data.solver.values if name != "Adams"])
    energy, phase, part = (x.values for x in (exponents(steady, "energy"), exponents(steady, "phase"), explained(steady)))
    budget, tol = data.sel(budget="Dopri8"), data.tol.values[-1]
    ends = data.sel(system="A01", tol=tol).isel(sample=-1)
    told = ", ".join(
        f"{name} {np.abs(float(one.phase)):.0e} rad ({int(one.right_hand_sides)} right-hand sides)"
        for name, one in ((name, ends.sel(solver=name)) for name in data.solver.values if name in ("Dopri8", "Adams"))
    )
    return (
        f"median exponents: energy {np.median(energy):.2f}, phase {np.median(phase):.2f}; the energy error explains "
        f"{np.median(part):.0%} of the phase error; A01 at {tol:.0e} after {float(ends.time.max()):.0f} s: {told}; energy error "
        f"of the linkage, 20 s, 1e-9, Dopri8: {float(budget.at_step_ends):.1e} J at step ends, "
        f"{float(budget.at_outputs):.1e} J at outputs"
    )


def figure(data: xarray.Dataset) -> Figure:
    systems = data.system.values
    page, axes = panels(len(systems), 3, 12.5, 1.0 + 3.1 * len(systems), sharex="col")
    for row, system in zip(axes, systems):
        for axis, what, power in zip(row, ("energy", "phase"), (1, 2)):
            for number, solver in enumerate(data.solver.values):
                for tol, style in zip(data.tol.values, ("-", "--", ":")):
                    one = data.sel(system=system, solver=solver, tol=tol)
                    label = str(solver) if tol == data.tol.values[0] else None
                    axis.loglog(one.time, np.abs(one[what]), style, color=COLOURS[number], lw=1.1, label=label)
            t = np.array([20.0, float(data.time.max())])
            axis.loglog(t, 3 * np.nanmax(np.abs(data[what].sel(system=system))) * (t / t[-1]) ** power, "k", lw=0.7)
            axis.set(xlabel="t (s)", ylabel=f"{system}: error of {what} ({data[what].units}); line: ~ $t^{power}$")
        ends = data.sel(system=system).isel(sample=-1)
        for number, solver in enumerate(data.solver.values):
            one = ends.sel(solver=solver)
            row[2].loglog(one.right_hand_sides, np.abs(one.phase), "o-", ms=4, color=COLOURS[number], label=str(solver))
        row[2].xaxis.set_minor_formatter(NullFormatter())
        row[2].set(xlabel="right-hand sides", ylabel="phase error at the end (rad)")
    names = [f"{style}: rtol = atol = {tol:.0e}" for tol, style in zip(data.tol.values, ("solid", "dashed", "dotted"))]
    page.suptitle(", ".join(names), fontsize=9)
    axes[0, 2].legend(fontsize=8)
    return page
