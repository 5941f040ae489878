"""If a start violates the constraints by delta, projection removes this at once, gains in time; otherwise it stays or grows.

The paper's linkage starts at -45 degrees, at rest, with its loops open by delta or their rates wrong by delta. The state is
moved by M^(-1/2) D^+ w with a random w, which is orthogonal, in the mass metric, to the motions that the mechanism can make.
The nearest closed state is therefore still the original one, and errors are measured against the exact motion from there. If
only Psi'' = 0 is enforced, the violation evolves as follows:

    chosen rows:            Psi = Psi_0 + t Psi_dot_0: an opening stays, a wrong rate opens the loops like t. (The row left out
                            follows from the others with factors that depend on the position; its error is a few times as large.)
    truncated pseudoinverse: redundant constraints drift like a bead on a rotating wire, at 1.77 /s, until the twelfth singular
                            value, which is due to the drift, exceeds the rank threshold: then the run is lost.
    Baumgarte, alpha = beta: Psi = (Psi_0 + (Psi_dot_0 + alpha Psi_0) t) e^(-alpha t): closed after a few 1/alpha. Meanwhile,
                            however, the feedback also moves the mechanism along its manifold by O(delta), and this error stays.
    projection:             closed after the first step, by the smallest change in the mass metric. The result is the nearest
                            closed state, except for the motion during this one step, O(h delta).
"""

from types import SimpleNamespace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import xarray
from matplotlib.figure import Figure

import udkjax as udk
from experiments.common import described, panels, tracked
from udkjax.equations import prepare
from udkjax.show.style import COLOURS
from udkjax.study.accuracy import exact_coordinates

TREATMENTS: dict[str, tuple[Any, Any]] = {
    "projection": (udk.Auto(), udk.Projection()),
    "Baumgarte 5, 5": (udk.Auto(), udk.Baumgarte(5.0, 5.0)),
    "Baumgarte 1000, 100": (udk.Auto(), udk.Baumgarte(1000.0, 100.0)),
    "none, chosen rows": (udk.Elimination(), None),
    "none, truncated": (udk.SVD(), None),
}
SMOKE = ("projection", "none, chosen rows")
DELTAS = 10.0 ** np.arange(-12, -1)
KINDS = ("position", "velocity")
ANGLE, END, OUTPUTS, SEED = np.deg2rad(-45.0), 20.0, 201, 4
TOL = 1e-10
LOST = 0.1  # m, rad: an error above it


def starts(mechanism: udk.Mechanism, deltas: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return q and v (kinds, deltas, bodies, 3) whose largest Psi (m), or Psi_dot (m/s), is delta."""
    equations = prepare(mechanism, udk.SVD())
    q = mechanism.q0.ravel()
    plus, _, root = equations.linearized_position(0.0, q)
    away = root * (plus @ jnp.asarray(np.random.default_rng(SEED).standard_normal(12)))
    away = np.asarray(away / jnp.abs(equations.jacobian(0.0, q) @ away).max()).reshape(-1, 3)
    none, moved = 0.0 * deltas[:, None, None] * away, deltas[:, None, None] * away
    return np.stack([mechanism.q0 + moved, mechanism.q0 + none]), np.stack([mechanism.v0 + none, mechanism.v0 + moved])


def study(smoke: bool) -> xarray.Dataset:
    mechanism = udk.library.parallelogram(ANGLE)
    names, deltas = (SMOKE, DELTAS[2::4]) if smoke else (tuple(TREATMENTS), DELTAS)
    ts = np.linspace(0.0, END, OUTPUTS)
    exact = exact_coordinates(mechanism, ts, mechanism.q0, mechanism.v0)
    q0, v0 = (x.reshape(-1, 4, 3) for x in starts(mechanism, deltas))
    (psi, error), chosen = np.full((2, len(names), len(q0), OUTPUTS), np.nan), np.empty(0)
    steps = np.full((len(names), len(q0)), -1)
    for row, name in enumerate(tracked(names, "inconsistent_starts")):
        method, stabilization = TREATMENTS[name]

        @eqx.filter_jit
        def runs(q0, v0, method=method, stabilization=stabilization):
            def run(start):
                choices: dict = {"method": method, "stabilization": stabilization, "drift_tol": jnp.inf, "throw": False}
                sol = udk.simulate(mechanism, ts, udk.State(*start), TOL, TOL, **choices)
                return sol.q, sol.v, sol.stats["steps"]

            return jax.lax.map(run, (q0, v0))

        q, v, steps[row] = runs(q0, v0)
        flat = SimpleNamespace(ts=np.tile(ts, len(q)), q=q.reshape(-1, 4, 3), v=v.reshape(-1, 4, 3))
        residual = np.abs(udk.violation(mechanism, flat))
        psi[row] = residual.max(axis=1).reshape(len(q), -1)
        if name == "none, chosen rows":
            chosen = np.delete(residual, udk.analyse(mechanism).redundant_rows or (), axis=1).max(axis=1)
        error[row] = np.abs(np.asarray(q) - exact).max(axis=(2, 3))
    dims, shape = ("treatment", "kind", "delta", "time"), (len(names), 2, len(deltas), OUTPUTS)
    data = xarray.Dataset(
        {
            "violation": (dims, psi.reshape(shape).astype(np.float32), {"long_name": "largest |Psi|", "units": "m"}),
            "of_chosen_rows": (
                dims[1:],
                chosen.reshape(shape[1:]).astype(np.float32),
                {"long_name": "the same of the 11 chosen rows, without stabilization", "units": "m"},
            ),
            "error": (
                dims,
                error.reshape(shape).astype(np.float32),
                {"long_name": "largest error of q against the motion from the closed start", "units": "m, rad"},
            ),
            "steps": (dims[:3], steps.reshape(shape[:3])),
        },
        coords={"treatment": list(names), "kind": list(KINDS), "delta": deltas, "time": ts},
    )
    return described(data, mechanism, {"rtol": TOL, "atol": TOL, "solver": "Dopri8", "span": END}, SEED)


def left(data: xarray.Dataset, treatment: str) -> dict[str, xarray.DataArray]:
    """Return violation and error over the second half of the runs of one treatment, the largest; infinite where a run is lost."""
    late = data.sel(treatment=treatment, time=slice(END / 2, None))
    largest = {name: late[name].max("time", skipna=False) for name in ("violation", "error")}
    gone = ~(largest["error"] < LOST)
    return {name: value.where(~gone, np.inf) for name, value in largest.items()}


def holds(data: xarray.Dataset) -> dict[str, bool]:
    delta = data.delta
    visible = delta >= 1e-7  # below it the errors of integration are larger
    projected = data.sel(treatment="projection")
    rows = data.of_chosen_rows.isel(time=slice(1, None))
    law = {"position": 1.0 + 0.0 * rows.time, "velocity": rows.time}
    small = delta[visible & (delta <= 1e-4)]  # of first order
    off = {kind: float(np.abs(rows.sel(kind=kind, delta=small) / small / form - 1).max()) for kind, form in law.items()}
    parts = {
        "projection closes what is open at once": bool((projected.violation.isel(time=slice(1, None)) < 1e-12).all()),
        "and errs by less than delta / 10": bool((left(data, "projection")["error"] < 0.1 * delta + 1e-8).all()),
        "chosen rows: an opening stays": off["position"] < 0.02,
        "and a wrong rate opens the loops like t": off["velocity"] < 0.02,
    }
    if "none, truncated" in data.treatment:
        soft, stiff, lost = (left(data, name) for name in ("Baumgarte 5, 5", "Baumgarte 1000, 100", "none, truncated"))
        between = [float((soft["error"] / delta)[:, visible].min()), float((soft["error"] / delta)[:, visible].max())]
        parts |= {
            "gains of 5 close all but rounding": bool((soft["violation"] < 1e-9).all()),
            "and leave errors of the order of delta": between[0] > 0.05 and between[1] < 50,
            "so do gains of 1000 and 100": bool((stiff["violation"] < 1e-9).all()),
            "truncated, not stabilized, every start off by 1e-9 and more is lost": bool(
                np.isinf(lost["error"].sel(delta=slice(0.9e-9, None))).all()
            ),
        }
    return parts


def headline(data: xarray.Dataset) -> str:
    listed = []
    for name in data.treatment.values:
        found = left(data, str(name))
        worst = {
            what: [float(value.sel(delta=1e-6, method="nearest").sel(kind=k)) for k in KINDS] for what, value in found.items()
        }
        told = ["lost" if np.isinf(e) else f"{p:.0e} / {e:.0e}" for p, e in zip(worst["violation"], worst["error"])]
        listed.append(f"{name}: {told[0]} and {told[1]}")
    return "violation / error of q after 10 s, with starts that are open by 1e-6 m and by 1e-6 m/s: " + "; ".join(listed)


def figure(data: xarray.Dataset) -> Figure:
    page, axes = panels(2, 3, 12.5, 7.0)
    middle = data.sel(delta=1e-6, method="nearest")
    for row, kind in zip(axes, KINDS):
        for number, name in enumerate(data.treatment.values):
            look: dict = {"color": COLOURS[number], "lw": 1.2, "label": str(name)}
            one = middle.sel(treatment=name, kind=kind)
            row[0].semilogy(one.time, np.maximum(one.violation, 1e-17), **look)
            row[1].semilogy(one.time, np.maximum(one.error, 1e-14), **look)
            error = left(data, str(name))["error"].sel(kind=kind)
            row[2].loglog(data.delta, np.minimum(error, 10.0), "o-", ms=3, **look)
        row[2].loglog(data.delta, data.delta, "k:", lw=1, label="delta")
        row[0].set(ylabel=f"{kind} off by 1e-6: |Psi| (m)", ylim=(1e-17, 10.0))
        row[1].set(ylabel="error of q (m, rad)", ylim=(1e-13, 10.0))
        row[2].set(ylabel="largest error of q after 10 s (top: lost)", ylim=(1e-13, 20.0))
    for axis, label in zip(axes[1], ("t (s)", "t (s)", f"delta ({'m, m/s'})")):
        axis.set_xlabel(label)
    axes[0, 2].legend(fontsize=8)
    return page
