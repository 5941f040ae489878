"""With a rank threshold of 1e-8, masses may spread over twelve decades, lengths over six; with 1e-4, a ratio of 1e8 is too much.

Four families have exact accelerations, and the linkage also has an exact motion:

    masses     the paper's linkage with links of 10^(-s/2), 1 and 10^(s/2) kg: one degree of freedom, J theta'' = -g w cos(theta);
    pendulum   two uniform rods in a chain, the lower one 10^s times as heavy, s = -12 ... 12: two equations in two angles, whose
               determinant is a sum of positive terms;
    lengths    the linkage with links of 10^(-3) to 10^3 m under a coupler with pins 1 m apart;
    rods       the two rods with lengths in a ratio of 10^(-6) to 10^6.

D = Psi_q M^(-1/2) has columns of the size of m^(-1/2), so its singular values spread like the roots of the masses. Truncation
at 1e-4 of the largest ignores the pins between heavy bodies once masses spread over 1e8, and the accelerations are completely
wrong. At 1e-8 and less, all independent rows are kept; redundant rows leave singular values of 1e-16, so there is room between.
`Auto` uses elimination, and is accurate on the linkage with any masses. If a light rod carries one 1e8 times as heavy, however,
its rows are nearly dependent in the mass metric, and `Auto` switches to singular values: truncated at 1e-4, the result is
completely wrong as well; with 1e-8 it is accurate. The default of the equations of motion is therefore 1e-4 up to a mass ratio
of 100, and smaller beyond, in proportion to the root of the ratio.

The remaining errors are due to rounding. Where the body m1 carries m2, elimination has an error of eps m2 / m1, the square of
the condition of D, and no such error in the opposite case. Orthogonal methods have an error of eps relative to M^(1/2) a, which
the heavy body dominates: a light body that hangs on it may have an error of up to eps m1 / m2. Gram-Schmidt with pivoting
combines columns only with columns, so that their sizes do not matter: it is exact to machine precision for all masses. With
every method, the linkage's errors grow as (length / pin distance)^2, the condition of the coupler's rotation; the lengths of
the rods have no effect.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import xarray
from matplotlib.figure import Figure

import udkjax as udk
from experiments.common import described, panels, tracked
from udkjax.show.style import COLOURS
from udkjax.study.accuracy import exact_coordinates

METHODS: dict[str, Any] = {
    "Auto": udk.Auto,
    "Elimination": udk.Elimination,
    "SVD": udk.SVD,
    "Varga": udk.Varga,
    "Householder": udk.Householder,
    "Gram-Schmidt": udk.GramSchmidt,
    "Greville": udk.Greville,
}
SMOKE = ("Elimination", "SVD")
RUN = ("Auto", "Elimination", "SVD")
THRESHOLDS = (1e-4, 1e-8, 1e-12)  # relative; the first is the default for masses that are not far apart
SPREADS = np.arange(0.0, 13.0, 2.0)  # decades
RATIOS = np.arange(-12.0, 13.0, 2.0)
ANGLE, RATE, GRAVITY = np.deg2rad(-45.0), 1.0, 9.81
EPS = float(np.finfo(float).eps)
TOL, SWINGS, OUTPUTS = 1e-9, 5.0, 101  # a run takes SWINGS times 2 pi sqrt(length / g)


def linkage(spread: float = 0.0, decade: float = 0.0, rate: float = RATE) -> udk.Mechanism:
    """The paper's linkage with uniform links, of 10^`decade` m, and masses that differ by `spread` decades."""
    length = 10.0**decade
    mech = udk.library.parallelogram(ANGLE, rate, length)
    masses = {f"link{i + 1}": 10.0 ** (spread * (i - 1) / 2) for i in range(3)}
    numbers = {
        f"body.{body}.{name}": m * size
        for body, m in masses.items()
        for name, size in (("mass", 1.0), ("inertia", length**2 / 12))
    }
    return mech.with_parameters(numbers)


def linkage_acceleration(mech: udk.Mechanism) -> np.ndarray:
    """Exact accelerations (bodies, 3) from J theta'' = -g w cos(theta)."""
    masses, inertia = (np.array([float(getattr(body, name)) for body in mech.bodies.values()]) for name in ("mass", "inertia"))
    theta, rate, length = float(mech.q0[0, 2]), float(mech.v0[0, 2]), 2 * float(np.linalg.norm(np.asarray(mech.q0)[0, :2]))
    arms = length * np.array([0.5, 0.5, 0.5, 1.0])
    turn = -GRAVITY * (masses @ arms) * np.cos(theta) / (inertia[:3].sum() + masses @ arms**2)
    e, n = np.array([np.cos(theta), np.sin(theta)]), np.array([-np.sin(theta), np.cos(theta)])
    return np.column_stack([np.outer(arms, turn * n - rate**2 * e), [turn, turn, turn, 0.0]])


def rods(mass: float = 0.0, length: float = 0.0) -> udk.Mechanism:
    """Two rods in a chain, the lower one heavier and longer by so many decades."""
    return udk.library.double_pendulum((1.0, 0.4), (1.0, -0.7), (1.0, 10.0**length), (1.0, 10.0**mass))


def rods_acceleration(mech: udk.Mechanism) -> np.ndarray:
    """Exact accelerations (bodies, 3) by two equations in the angles from hanging, in extended precision where there is one."""
    number = np.longdouble
    m1, m2 = (number(float(body.mass)) for body in mech.bodies.values())
    l1, l2 = (2 * number(float(np.asarray(joint.points)[-1, 0])) * -1 for joint in mech.joints.values())
    s1, s2 = (number(x) + number(np.pi) / 2 for x in np.asarray(mech.q0)[:, 2])
    w1, w2 = (number(x) for x in np.asarray(mech.v0)[:, 2])
    g, sin, cos = number(GRAVITY), np.sin(s1 - s2), np.cos(s1 - s2)
    own1, own2 = m1 * l1**2 / 3, m2 * l2**2 / 3
    both = m2 * l1 * l2 / 2
    h1 = -both * sin * w2**2 - (m1 / 2 + m2) * l1 * g * np.sin(s1)
    h2 = both * sin * w1**2 - m2 * l2 / 2 * g * np.sin(s2)
    det = own1 * own2 + m2**2 * l1**2 * l2**2 * (number(1) / 12 + sin**2 / 4)
    a1 = (own2 * h1 - both * cos * h2) / det
    a2 = ((own1 + m2 * l1**2) * h2 - both * cos * h1) / det

    def along(length, s, w, a):
        return length * np.array([a * np.cos(s) - w**2 * np.sin(s), a * np.sin(s) + w**2 * np.cos(s)])

    upper, tip = along(l1 / 2, s1, w1, a1), along(l1, s1, w1, a1)
    return np.array([[*upper, a1], [*(tip + along(l2 / 2, s2, w2, a2)), a2]], float)


def families(smoke: bool) -> dict[str, tuple[np.ndarray, list[udk.Mechanism], np.ndarray]]:
    """Return by name: decades, mechanisms that differ by numbers alone, exact accelerations."""
    few = slice(None, None, 3 if smoke else 1)
    found = {
        "masses": (SPREADS[few], lambda s: linkage(s), linkage_acceleration),
        "pendulum": (RATIOS[few], lambda s: rods(s), rods_acceleration),
        "lengths": (np.arange(-3.0, 4.0)[few], lambda s: linkage(0.0, s), linkage_acceleration),
        "rods": (RATIOS[few] / 2, lambda s: rods(0.0, s), rods_acceleration),
    }
    result = {}
    for name, (decades, make, exact) in found.items():
        mechanisms = [make(s) for s in decades]
        result[name] = decades, mechanisms, np.array([exact(mech) for mech in mechanisms])
    return result


def stacked(mechanisms: list[udk.Mechanism]) -> tuple[Any, Any]:
    """Return mechanisms as one, whose numbers have an axis in front, and so their analyses, with the first's redundant rows."""
    analyses = [udk.analyse(mech) for mech in mechanisms]
    analyses = [dataclasses.replace(found, redundant_rows=analyses[0].redundant_rows) for found in analyses]
    mechs, found = (jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees) for trees in (mechanisms, analyses))
    return mechs, found


def accelerations(mechanisms: list[udk.Mechanism], make: Any) -> np.ndarray:
    """Return accelerations (thresholds, mechanisms, bodies, 3)."""

    @eqx.filter_jit
    def run(tols, mechanisms):
        def one(tol):
            method = make(rank_tol=tol)
            return jax.lax.map(lambda x: udk.accelerations(x[0], 0.0, x[0].q0, x[0].v0, method, analysis=x[1]), mechanisms)

        return jax.lax.map(one, tols)

    return np.asarray(run(jnp.array(THRESHOLDS), stacked(mechanisms)))


def wrong(found: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """Return the largest relative error (thresholds, mechanisms) of a body's acceleration, translation and rotation each."""
    scale = np.maximum(np.linalg.norm(exact[..., :2], axis=-1), 1e-300)
    moved = np.linalg.norm((found - exact)[..., :2], axis=-1) / scale
    turned = np.abs((found - exact)[..., 2]) / np.abs(exact[..., 2]).max(axis=-1, keepdims=True)
    return np.fmax(moved, turned).max(axis=-1)


def runs(mechanisms: list[udk.Mechanism], make: Any) -> np.ndarray:
    """Return the largest error of an angle (rad) along a run (thresholds, mechanisms); infinite where it ends early."""
    lengths = np.array([2 * np.linalg.norm(np.asarray(m.q0)[0, :2]) for m in mechanisms])
    ts = SWINGS * 2 * np.pi * np.sqrt(lengths / GRAVITY)[:, None] * np.linspace(0, 1, OUTPUTS)

    @eqx.filter_jit
    def run(tols, mechanisms, ts):
        def one(given: Any, ts: Any, tol: Any):
            mech, analysis = given
            choices: dict[str, Any] = {"max_steps": 20_000, "throw": False, "drift_tol": jnp.inf, "analysis": analysis}
            return udk.simulate(mech, ts, udk.State(mech.q0, mech.v0), TOL, TOL, make(rank_tol=tol), **choices).q[:, :3, 2]

        return jax.lax.map(lambda tol: jax.lax.map(lambda x: one(x[0], x[1], tol), (mechanisms, ts)), tols)

    angles = np.asarray(run(jnp.array(THRESHOLDS), stacked(mechanisms), ts))
    exact = [exact_coordinates(m, t, m.q0, m.v0) for m, t in zip(mechanisms, ts)]
    error = np.abs(angles - np.array(exact)[:, :, :3, 2]).max(axis=(2, 3))
    return np.where(np.isfinite(error), error, np.inf)


def study(smoke: bool) -> xarray.Dataset:
    names = SMOKE if smoke else tuple(METHODS)
    variables, coords, scenes = {}, {"method_name": list(names), "threshold": list(THRESHOLDS), "run_by": list(RUN)}, []
    for family, (decades, mechanisms, exact) in families(smoke).items():
        coords[f"decades_{family}"] = decades
        scenes.append(udk.dumps(mechanisms[-1]))
        errors = [wrong(accelerations(mechanisms, METHODS[n]), exact) for n in tracked(names, f"spread, {family}")]
        variables[family] = (
            ("method_name", "threshold", f"decades_{family}"),
            errors,
            {"long_name": "relative error of a body's acceleration"},
        )
    for family, sizes in () if smoke else (("masses", {"spread": SPREADS}), ("lengths", {"decade": np.arange(-3.0, 4.0)})):
        ((key, values),) = sizes.items()
        mechanisms = [linkage(**{key: s, "rate": 0.0}) for s in values]
        errors = [runs(mechanisms, METHODS[n]) for n in tracked(RUN, f"spread, runs, {family}")]
        variables[f"{family}_run"] = (
            ("run_by", "threshold", f"decades_{family}"),
            errors,
            {"long_name": "error of an angle", "units": "rad"},
        )
    data = xarray.Dataset(variables, coords)
    return described(data, "\n".join(scenes), {"tol": TOL, "thresholds": THRESHOLDS, "swings": SWINGS, "solver": "Dopri8"})


def at(data: xarray.Dataset, family: str, method: str, threshold: float) -> xarray.DataArray:
    """Return errors over the decades of a family."""
    by = "run_by" if family.endswith("_run") else "method_name"
    return data[family].sel({by: method, "threshold": threshold})


def holds(data: xarray.Dataset) -> dict[str, bool]:
    methods = [str(name) for name in data.method_name.values]
    dense = [name for name in methods if name not in ("Auto", "Elimination")]
    beyond = {family: np.abs(data[f"decades_{family}"]) >= 8 for family in ("masses", "pendulum")}
    tight = [data[family].sel(threshold=1e-8) for family in ("masses", "pendulum", "lengths", "rods")]
    let_go = data.masses.sel(threshold=1e-4, method_name=dense)[:, beyond["masses"]]
    size = 10.0**data.decades_lengths
    own = data.sel(threshold=1e-4)
    parts = {
        "truncated at 1e-4 dense methods let go from a ratio of 1e8 on": bool((let_go > 0.5).all()),
        "at 1e-8 every method has three digits or more, whatever the masses and lengths": all(
            bool((x < 1e-3).all()) for x in tight
        ),
        "elimination is right on the linkage with its default": bool((own.masses.sel(method_name="Elimination") < 1e-9).all()),
        "elimination loses eps m2 / m1 where m1 carries m2": bool(
            (at(data, "pendulum", "Elimination", 1e-8) < 5 * EPS * np.maximum(10.0**data.decades_pendulum, 3)).all()
        ),
        "orthogonal methods err by up to eps times the ratio": bool(
            (at(data, "pendulum", "SVD", 1e-8) < 50 * EPS * 10.0 ** np.abs(data.decades_pendulum)).all()
        ),
        "the length of rods costs nothing": bool((data.rods < 1e-14).all()),
        "long links over narrow pins err by eps (length / distance)^2": bool(
            (data.lengths < 10 * EPS * np.maximum(size, 1.0) ** 2 + 1e-14).all()
        ),
    }
    if "Auto" in methods:
        heavy = data.decades_pendulum >= 8
        auto = [at(data, "pendulum", "Auto", threshold)[heavy] for threshold in (1e-4, 1e-8)]
        parts |= {
            "at 1e-4 Auto fails where a light rod carries 1e8 times its mass": bool((auto[0] > 0.5).all()),
            "with 1e-8 it does not": bool((auto[1] < 1e-9).all()),
            "Gram-Schmidt with 1e-8 is exact to rounding for all masses": bool(
                max(at(data, family, "Gram-Schmidt", 1e-8).max() for family in ("masses", "pendulum")) < 1e-14
            ),
            "runs by Auto are right over 12 decades of masses and 6 of lengths": bool(
                max(data[run].sel(run_by="Auto").max() for run in ("masses_run", "lengths_run")) < 1e-7
            ),
        }
    return parts


def headline(data: xarray.Dataset) -> str:
    def largest(family: str, method: str, threshold: float) -> str:
        return f"{method} {float(at(data, family, method, threshold).max()):.0e}"

    methods = [str(name) for name in data.method_name.values]
    told = {f: ", ".join(largest(f, m, 1e-8) for m in methods) for f in ("masses", "pendulum")}
    return (
        f"largest relative error of an acceleration, threshold 1e-8: linkage, masses over 12 decades: {told['masses']}; two "
        f"rods, ratio 1e-12 to 1e12: {told['pendulum']}; threshold 1e-4: {largest('masses', 'SVD', 1e-4)} on the linkage"
    )


def figure(data: xarray.Dataset) -> Figure:
    titles = {
        "masses": "linkage: masses over s decades",
        "pendulum": "two rods: the lower one $10^s$ times as heavy",
        "lengths": "linkage: links of $10^s$ m",
        "rods": "two rods: the lower one $10^s$ times as long",
        "masses_run": "run: masses over s decades",
        "lengths_run": "run: links of $10^s$ m",
    }
    shown = [name for name in titles if name in data]
    page, axes = panels(2, (len(shown) + 1) // 2, 12.5, 7.0)
    for axis, family in zip(axes.ravel(order="F"), shown):
        by = "run_by" if family.endswith("_run") else "method_name"
        decades = data[f"decades_{family.removesuffix('_run')}"]
        for number, method in enumerate(METHODS):
            for threshold, style in zip(THRESHOLDS, ("-", "--", ":")):
                if method not in data[by]:
                    continue
                error = np.clip(at(data, family, method, threshold), 1e-17, 10.0)
                label = method if threshold == THRESHOLDS[0] else None
                axis.semilogy(decades, error, style, marker=".", ms=3, lw=1, color=COLOURS[number], label=label)
        axis.set(title=titles[family], xlabel="s", ylim=(1e-17, 30.0))
        axis.set_ylabel("largest error of an angle (rad)" if family.endswith("_run") else "relative error of an acceleration")
    page.legend(*axes[0, 0].get_legend_handles_labels(), fontsize=8, ncols=len(METHODS), loc="outside upper center")
    page.supxlabel("rank threshold: solid 1e-4, dashed 1e-8, dotted 1e-12", fontsize=9)
    return page
