"""Posteriors of link parameters: what draws cost, and how far they and their normal approximations may be trusted.

A four-bar swings for 5 s; the angle of its crank is measured 500 times with 0.01 rad of noise. Five of its numbers are unknown,
with priors of 50 %. Each kind of scene runs in a process of its own with empty caches: `cold` is the CPU time of `udk.inference`
and the first `udk.sample`, `warm` that of a second `udk.sample` with another seed, including its warm-up, relative to
the bulk effective size of the worst parameter. Scenes in events take more chains, since the time of an event hardly depends on
how many runs share it. numpyro's No-U-Turn sampler draws from the plain scene's density in the same process.

Data sets whose parameters are drawn from the prior give the ranks of the true numbers among draws, which are uniform if the draws
are right (S. Talts et al., arXiv:1804.06788). The same sets tell how often a normal approximation is trusted, rightly or wrongly.
Four laws of friction are compared by their evidence. A second experiment is chosen by a posterior or at random, until the widest
interval is half as wide. A process is killed between chunks, and while it writes one, and its folder is continued.

Claim: 1,000 effective samples of the plain scene take less than 5 s, warm, and less than numpyro's; ranks are uniform; intervals
cover; the right law is found; a chosen experiment needs fewer records than a random one; killed runs continue to the same bits.
"""

import json
import os
import subprocess
import sys
import time
from importlib.util import find_spec
from typing import Any, TypedDict

import jax
import jax.numpy as jnp
import numpy as np
import xarray
from matplotlib.figure import Figure
from scipy.stats import kstest

import udkjax as udk
from experiments.common import described, panels, tracked
from experiments.parts.interrupted_draws import continues
from udkjax.show.plots import COLOURS
from udkjax.study.identify.density.laplace import approximate

TS, NOISE = np.linspace(0.0, 5.0, 500), 0.01
LINKS = ("body.crank.inertia", "body.coupler.mass", "body.coupler.inertia", "force.damper.damping")
SCENES = ("plain", "stiff", "friction", "impacts", "sticking")


class Sampling(TypedDict, total=False):
    """Numbers of draws: arguments of `udk.sample`."""

    chains: int
    draws: int
    warmup: int


MANY: Sampling = {"chains": 32, "draws": 50, "warmup": 100}  # for scenes in events
FEW: Sampling = {"chains": 8, "draws": 250}
SETS: Sampling = {"chains": 4, "draws": 100, "warmup": 100}  # of a calibration set
LEVELS = 0.5, 0.95
# Errors of trusted means, in deviations, and of deviations, as a factor, that are wrong: the largest that are trusted, 0.25 and
# 1.25, and 1.5 standard errors of the means and deviations of a set's draws, some 200 effective ones.
WRONG = 0.35, 1.35
SWING, SWING_NOISE = np.linspace(0.0, 5.0, 60), 0.02
LONG = np.linspace(0.0, 20.0, 200)  # linear and exponential decay hardly differ in shorter records
LAWS = {
    "none": {},
    "viscous": {"force.viscous.damping": (0.0, 0.3)},
    "dry": {"force.dry.torque": (0.0, 0.6)},
    "both": {"force.viscous.damping": (0.0, 0.3), "force.dry.torque": (0.0, 0.6)},
}
INERTIA = {"body.rod.inertia": (0.375, 0.1)}
MOST_RECORDS = 6
FOUND = 0.95  # share of right laws, but for sampling errors


def four_bar(kind: str) -> tuple[udk.Mechanism, tuple[str, ...], dict[str, Any]]:
    """Return a scene, the names of five unknown numbers, and settings of its runs."""
    base = udk.library.four_bar()
    damper = udk.TorsionSpring(("ground", "crank"), stiffness=0.0, damping=1e4 if kind == "stiff" else 0.5)
    laws = {
        "friction": udk.Friction("A", torque=1.0, velocity=0.05),
        "sticking": udk.Friction("A", torque=1.0, law="set-valued"),
    }
    forces = {"damper": damper, **({"dry": laws[kind]} if kind in laws else {})}
    settings = {"events": udk.JointLimit("A", lower=-0.6, restitution=0.6)} if kind == "impacts" else {}
    names = (*LINKS, "force.dry.torque" if kind in laws else "body.rocker.inertia")
    return udk.Mechanism(base.bodies, base.joints, forces=forces, gravity=base.gravity), names, settings


def density(kind: str, measured: np.ndarray) -> Any:
    """Return the density of five numbers of a scene."""
    mech, names, settings = four_bar(kind)
    priors = {name: (value := float(mech.parameters()[name]), 0.5 * value) for name in names}
    return udk.inference(mech, udk.Record(TS, {"body.crank.angle": measured}, NOISE), names, priors=priors, **settings)


def costs(kind: str, measured: np.ndarray, numbers: Sampling, peer: bool) -> dict[str, float]:
    """Return CPU times of a scene in a new process (s), effective samples, and those of numpyro."""
    begun = time.process_time()
    problem = density(kind, measured)
    udk.sample(problem, **numbers, progress=False)
    cold = time.process_time() - begun
    begun = time.process_time()
    posterior = udk.sample(problem, **numbers, seed=1, progress=False)
    warm, effective = time.process_time() - begun, min(row.bulk for row in posterior.rows)
    mech, names, settings = four_bar(kind)
    estimate = udk.identify(mech, problem.fit_problem.records, names, n_starts=0, progress=False, **settings)
    estimate.laplace()
    begun = time.process_time()
    estimate.laplace(seed=1)
    found = {"cold": cold, "warm": 1000 * warm / effective, "effective": effective, "laplace": time.process_time() - begun}
    return found | (by_numpyro(problem, posterior) if peer else {})


def by_numpyro(problem: Any, posterior: Any) -> dict[str, float]:
    """Return the CPU time of 1,000 effective samples by numpyro's NUTS, warm, and its largest difference in standard errors."""
    import arviz
    from numpyro.infer import MCMC, NUTS

    # A full mass matrix, and short trees while it warms up, suit the ridge of the masses; by default it takes far longer.
    kernel = NUTS(potential_fn=lambda x: -problem.log_density(x), dense_mass=True, max_tree_depth=(6, 10))
    runs = MCMC(kernel, num_warmup=150, num_samples=200, progress_bar=False)
    start = jnp.asarray(posterior.x.mean((0, 1)))
    runs.run(jax.random.key(0), init_params=start)
    begun = time.process_time()
    runs.run(jax.random.key(1), init_params=start)
    drawn = {name: np.asarray(values) for name, values in problem.parameters(runs.get_samples()).items()}
    spent, errors, sizes = time.process_time() - begun, [], []
    for row in posterior.rows:
        sizes.append(float(arviz.ess(drawn[row.parameter][None], method="bulk")))
        errors.append(abs(drawn[row.parameter].mean() - row.mean) / row.deviation / np.sqrt(1 / sizes[-1] + 1 / row.bulk))
    return {"numpyro": 1000 * spent / min(sizes), "numpyro_error": max(errors)}


def in_new_process(kind: str, numbers: Sampling, peer: bool) -> dict[str, float]:
    """Return `costs`, computed with empty caches."""
    mech, _, settings = four_bar(kind)
    angle = np.asarray(udk.simulate(mech, TS, **settings).q)[:, 0, 2] + NOISE * np.random.default_rng(0).standard_normal(len(TS))
    code = "import json, sys; from experiments.posteriors import *; print(json.dumps(costs(*json.load(sys.stdin))))"
    given = json.dumps([kind, angle.tolist(), numbers, peer])
    environment = os.environ | {"UDKJAX_CACHE": "0", "JAX_ENABLE_COMPILATION_CACHE": "false"}
    ran = subprocess.run([sys.executable, "-c", code], input=given, capture_output=True, text=True, check=True, env=environment)
    return json.loads(ran.stdout.splitlines()[-1])


# --- calibration


def rod(law: str, viscous: Any = 0.1, dry: Any = 0.2) -> udk.Mechanism:
    """Return a rod on a pin with one of four laws of friction."""
    base = udk.library.compound_pendulum(angle=1.2)
    forces = {
        "viscous": udk.TorsionSpring(("ground", "rod"), stiffness=0.0, damping=viscous),
        "dry": udk.Friction("pin", torque=dry, velocity=0.1),
    }
    return udk.Mechanism(base.bodies, base.joints, forces={k: f for k, f in forces.items() if law in (k, "both")})


def calibrated() -> dict[str, tuple[udk.Mechanism, dict[str, tuple[float, float]], str]]:
    """Return three mechanisms with priors, and the measured channels."""
    pendulums = udk.library.double_pendulum(angles=(-0.5, -0.2))
    linkage = {"body.coupler.mass": (2.5, 0.5), "body.rocker.inertia": (0.7, 0.15), "force.damper.damping": (0.5, 0.15)}
    return {
        "rod with dry friction": (rod("both"), INERTIA | {"force.dry.torque": (0.2, 0.06)}, "body.rod.angle"),
        "double pendulum": (pendulums, {"body.upper.mass": (1.0, 0.2), "body.lower.inertia": (0.08, 0.02)}, "body.lower.angle"),
        "four-bar": (four_bar("plain")[0], linkage, "body.crank.angle"),
    }


def calibrate(mech: udk.Mechanism, priors: dict[str, tuple[float, float]], channel: str, sets: int) -> dict[str, np.ndarray]:
    """Return ranks (sets, K) of true numbers among draws, in [0, 1], and the verdicts of approximations (sets,)."""
    random, noise = np.random.default_rng(1), 5 * SWING_NOISE
    problem = udk.inference(mech, udk.Record(SWING, {channel: np.zeros(len(SWING))}, noise), [*priors], priors=priors)
    mean, deviation = np.array(list(priors.values())).T
    ranks, trusted, wrong = np.zeros((sets, len(priors))), np.zeros(sets, bool), np.zeros(sets, bool)
    predict = jax.jit(problem.predicted)
    for k in range(sets):
        truth = np.full(len(priors), -1.0)
        while (truth <= 0.0).any():  # priors end at zero
            truth = mean + deviation * random.standard_normal(len(priors))
        exact = np.asarray(predict(problem.fit_problem.unknowns.z_of(truth)))
        problem_of_set = problem.with_measured(exact + noise * random.standard_normal(len(SWING)))
        posterior = udk.sample(problem_of_set, **SETS, seed=k, progress=False)
        ranks[k] = [np.mean(posterior.draws[name] < x) for name, x in zip(priors, truth, strict=True)]
        approximation = approximate(problem_of_set, problem.start, k)
        trusted[k] = approximation.trusted
        x = posterior.x.reshape(-1, len(truth))
        size = np.sqrt(np.diag(approximation.covariance))
        shift, ratio = np.abs(x.mean(0) - approximation.mode) / size, np.abs(np.log(x.std(0) / size))
        wrong[k] = (shift > WRONG[0]).any() or (ratio > np.log(WRONG[1])).any()
    return {"rank": ranks, "trusted": trusted, "wrong": trusted & wrong}


def uniformity(ranks: np.ndarray) -> float:
    """Return the probability of a less even distribution of ranks, by Kolmogorov's test."""
    return float(kstest(ranks, "uniform").pvalue)


# --- models and experiments


def right_laws(sets: int) -> np.ndarray:
    """Return whether the law of each set of a swinging rod has the largest evidence (sets,)."""
    empty = udk.Record(LONG, {"body.rod.angle": np.zeros(len(LONG))}, NOISE)
    problems = {law: udk.inference(rod(law), empty, [*INERTIA, *priors], priors=INERTIA | priors) for law, priors in LAWS.items()}
    random, right = np.random.default_rng(2), []
    for k in range(sets):
        law = list(LAWS)[k % len(LAWS)]
        q = np.asarray(udk.simulate(rod(law), LONG, rtol=1e-9, atol=1e-9).q)[:, 0, 2]
        measured = q + NOISE * random.standard_normal(len(LONG))
        right.append(udk.compare({name: problem.with_measured(measured) for name, problem in problems.items()}).best == law)
    return np.array(right)


def records_needed(repetitions: int) -> np.ndarray:
    """Return numbers of further records until the widest interval is half as wide: chosen and random ones (2, repetitions)."""
    mech, names, channel = rod("viscous"), ["body.rod.inertia", "force.viscous.damping"], "body.rod.angle"
    starts = [udk.State(m.q0, m.v0) for m in (udk.library.compound_pendulum(angle=a) for a in np.linspace(0.1, 1.5, 8))]
    exact = [np.asarray(udk.simulate(mech, SWING, start).q)[:, 0, 2] for start in starts]
    random, needed, first = np.random.default_rng(3), np.zeros((2, repetitions)), 3
    measure = lambda k: udk.Record(  # noqa: E731
        SWING, {channel: exact[k] + SWING_NOISE * random.standard_normal(len(SWING))}, SWING_NOISE, udk.Start(starts[k])
    )
    problem = udk.inference(mech, measure(first), names)
    for r in range(repetitions):
        begun = measure(first)
        posterior = udk.sample(problem.with_measured(begun.values[channel]), **SETS, seed=r, progress=False)
        best = udk.design_experiment(mech, starts, names, [channel], SWING, SWING_NOISE, given=posterior).best
        for way, choose in enumerate((lambda best=best: best, lambda: int(random.integers(len(starts))))):
            records, width = [begun], relative_width(mech, [begun], names)
            while len(records) <= MOST_RECORDS and relative_width(mech, records, names) > width / 2:
                records.append(measure(choose()))
            needed[way, r] = len(records) - 1
    return needed


def relative_width(mech: udk.Mechanism, records: list[Any], names: list[str]) -> float:
    """Return the widest interval, relative to its number, by the standard errors of a fit."""
    estimate = udk.identify(mech, records, names, n_starts=0, progress=False)
    return float(np.max(estimate.uncertainty.standard_errors / np.abs(estimate.values)))


# --- the study


def study(smoke: bool, sets: int = 200, laws: int = 200, repetitions: int = 50, scenes: int = 5) -> xarray.Dataset:
    """Costs of scenes, ranks of calibration sets, right laws, numbers of records, and continued folders."""
    sets, laws, repetitions, scenes = (4, 4, 1, 1) if smoke else (sets, laws, repetitions, scenes)
    costs_of = {}
    for kind in tracked(SCENES[:scenes], "scenes"):
        costs_of[kind] = in_new_process(
            kind, MANY if kind in SCENES[3:] else FEW, kind == SCENES[0] and find_spec("numpyro") is not None
        )
    keys = "cold", "warm", "effective", "laplace", "numpyro", "numpyro_error"
    table = np.array([[costs_of[kind].get(key, np.nan) for key in keys] for kind in costs_of])
    ranks, names, trusted, wrong = [], [], [], []
    for name, (mech, priors, channel) in tracked(list(calibrated().items())[: 1 if smoke else 3], "calibration"):
        found = calibrate(mech, priors, channel, sets)
        ranks.append(found["rank"])
        names += [f"{name}: {parameter}" for parameter in priors]
        trusted.append(found["trusted"])
        wrong.append(found["wrong"])
    needed = records_needed(repetitions)
    right = right_laws(laws)
    same = [continues(when) for when in tracked(("between chunks", "in a write"), "killed processes")]
    data = xarray.Dataset(
        {
            "cost": (("scene", "quantity"), table, {"units": "s of CPU time, but effective samples and standard errors"}),
            "rank": (("set", "parameter"), np.concatenate(ranks, axis=1), {"long_name": "share of draws below the truth"}),
            "trusted": (("mechanism", "set"), np.array(trusted).astype(int)),
            "wrong": (("mechanism", "set"), np.array(wrong).astype(int), {"long_name": "trusted wrongly"}),
            "right": ("data_set", right.astype(int), {"long_name": "whether the right law has the largest evidence"}),
            "records": (("way", "repetition"), needed, {"long_name": "records until the widest interval is half as wide"}),
            "same": ("killed", np.array(same).astype(int), {"long_name": "whether a killed run continues to the same bits"}),
        },
        coords={"scene": list(costs_of), "quantity": list(keys), "parameter": names, "way": ["chosen", "random"]},
    )
    return described(data, four_bar("plain")[0], {"sets": sets, "laws": laws, "repetitions": repetitions, "noise": NOISE}, 0)


def coverage(data: xarray.Dataset) -> list[float]:
    """Return the shares of true numbers in central intervals of each level."""
    return [float((np.abs(data["rank"] - 0.5) <= level / 2).mean()) for level in LEVELS]


def holds(data: xarray.Dataset) -> dict[str, bool]:
    """Compare each part of the claim with the data; a small run has too few sets for shares."""
    plain = data.cost.sel(scene="plain")
    parts = {
        "1,000 effective samples take less than 5 s": bool(plain.sel(quantity="warm") < 5.0),
        "killed runs continue to the same bits": bool(data.same.all()),
    }
    if np.isfinite(plain.sel(quantity="numpyro")):
        parts["less than numpyro's"] = bool(plain.sel(quantity="warm") < plain.sel(quantity="numpyro"))
        parts["the same means as numpyro's"] = bool(plain.sel(quantity="numpyro_error") < 4.0)
    if not data.attrs["smoke"]:
        ps = [uniformity(data["rank"][:, k].values) for k in range(data.sizes["parameter"])]
        sigma = [np.sqrt(level * (1 - level) / data["rank"].size) for level in LEVELS]
        parts |= {
            "ranks are uniform": min(ps) * len(ps) > 0.05,  # the smallest of several, by Bonferroni's bound
            "intervals cover": all(abs(c - p) < 4 * s for c, p, s in zip(coverage(data), LEVELS, sigma, strict=True)),
            "the right law is found": bool(data.right.mean() > FOUND - 3 * np.sqrt(FOUND * (1 - FOUND) / data.right.size)),
            "chosen experiments need fewer records": bool(data.records[0].mean() < data.records[1].mean()),
            "hardly any normal approximation is trusted wrongly": bool(data.wrong.mean() < 0.05),
        }
    return parts


def headline(data: xarray.Dataset) -> str:
    """Return the claim in figures."""
    of = lambda quantity: ", ".join(  # noqa: E731
        f"{name} {value:.3g}" for name, value in zip(data.scene.values, data.cost.sel(quantity=quantity).values, strict=True)
    )
    peer, error = (float(data.cost.sel(scene="plain", quantity=name)) for name in ("numpyro", "numpyro_error"))
    ps = [uniformity(data["rank"][:, k].values) for k in range(data.sizes["parameter"])]
    numpyro = f"{peer:.3g} (means differ by {error:.1f} standard errors)" if np.isfinite(peer) else "not run"
    half, most = coverage(data)
    chosen, random = data.records.mean("repetition").values
    return (
        f"CPU s for 1,000 effective samples, warm: {of('warm')}; numpyro {numpyro}; cold: {of('cold')}; Laplace warm: "
        f"{of('laplace')}; calibration by {data.sizes['set']} sets of {data.sizes['mechanism']} mechanisms: smallest p "
        f"{min(ps):.2g} of {len(ps)}, 50 and 95 % intervals cover {half:.0%} and {most:.0%}; normal approximations: "
        f"{int(data.trusted.sum())} of {data.trusted.size} trusted, {int(data.wrong.sum())} wrongly; right law "
        f"{int(data.right.sum())} of {data.sizes['data_set']}; records needed: chosen {chosen:.2f}, random "
        f"{random:.2f}, {data.sizes['repetition']} repetitions; killed runs: "
        f"{'the same bits' if data.same.all() else 'OTHER BITS'}"
    )


def figure(data: xarray.Dataset) -> Figure:
    """Draw costs, ranks, and numbers of records."""
    fig, axes = panels(1, 3, 11.0, 3.4)
    warm = data.cost.sel(quantity="warm")
    axes[0, 0].barh(data.scene.values, warm, color=COLOURS[0])
    axes[0, 0].barh(["numpyro, plain"], data.cost.sel(scene="plain", quantity="numpyro"), color=COLOURS[1])
    axes[0, 0].set(xscale="log", xlabel="CPU time of 1,000 effective samples (s)")
    for k, name in enumerate(data.parameter.values):
        axes[0, 1].plot(np.sort(data["rank"][:, k]), (np.arange(data.sizes["set"]) + 0.5) / data.sizes["set"], lw=1, label=name)
    axes[0, 1].plot([0, 1], [0, 1], "--", color="0.5", lw=0.8)
    axes[0, 1].legend(fontsize=5)
    axes[0, 1].set(xlabel="rank of the true number among draws", ylabel="share of data sets")
    edges = np.arange(0.5, MOST_RECORDS + 1)
    axes[0, 2].hist(data.records.values.T, edges, label=list(data.way.values), color=COLOURS[:2])
    axes[0, 2].legend()
    axes[0, 2].set(xlabel="further records until the widest interval is half as wide", ylabel="repetitions")
    return fig
