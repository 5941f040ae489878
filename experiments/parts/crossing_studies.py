"""Rows of the table of functions by models: studies, files and pictures."""

import ctypes
import json
import re
import subprocess
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import udkjax as udk
from experiments.parts.crossing_case import EXACT, TS, Case, WrongError, agree, claim
from udkjax.show.player.player_data import motion_of

NAMES_MOST = 12  # names of a model that a study takes at once


def channel(case: Case) -> dict[str, Any]:
    if case.is_system:
        return {"q[0]": np.asarray(case.alone.q[:, 0])}
    return {f"body.{case.model.body_names[0]}.angle": np.asarray(case.alone.q[:, 0, 2])}


def names(case: Case) -> list[str]:
    """All numbers that may differ by a thousandth by themselves, without opening a loop or a mistake in the scene."""
    m, found = case.model, []
    for name, x in (m.parameters() if case.is_system else m.independent_parameters()).items():
        if name.endswith(".values") or not np.any(np.asarray(x)):
            continue
        try:
            udk.assemble(m.with_parameters({name: 1.0001 * np.asarray(x)}))
        except (udk.SceneError, udk.AssemblyError):
            continue
        found.append(name)
    return found


def identify(case: Case) -> str:
    name = case.number
    x0 = np.asarray(case.model.parameters()[name])
    found = udk.identify(case.model.with_parameters({name: 1.05 * x0}), {"time": TS, **channel(case)}, [name], progress=False)
    value, spread = np.asarray(found.values, float)[0], np.ptp(next(iter(channel(case).values())))
    again = udk.simulate(case.model.with_parameters({name: value}), TS, case.state, **EXACT)
    first = np.asarray(again.q).reshape(len(TS), -1)[:, 0 if case.is_system else 2]
    if np.abs(first - next(iter(channel(case).values()))).max() > 1e-5 * (spread + 1e-3):
        raise WrongError(f"{name} = {value:.6g}, not {x0:.6g}, and the motion is another")
    return "the motion that made the record"


def identify_names(case: Case) -> str:
    """All names at once: the fit begins where the record was made, and has to stay there."""
    chosen = names(case)
    found = udk.identify(case.model, {"time": TS, **channel(case)}, chosen, n_starts=0, noise=1e-4, progress=False)
    size = np.ptp(next(iter(channel(case).values()))) + 1e-3
    worst = max(float(np.abs(x).max()) for x in found.residuals[0].values())
    claim(worst < 1e-5 * size, f"leaves the motion that made the record by {worst:.2g}")
    return f"the motion that made the record, {len(chosen)} names"


def check_gradients(case: Case) -> str:
    found = udk.check_gradients(case.model, {"time": TS, **channel(case)}, [case.number])
    claim(found.ok, f"{found}"[:250])
    return "differences"


def check_gradients_names(case: Case) -> str:
    chosen = names(case)[:NAMES_MOST]
    found = udk.check_gradients(case.model, {"time": TS, **channel(case)}, chosen)
    claim(found.ok, f"{found}"[:250])
    return f"differences, {len(chosen)} names"


def design_experiment(case: Case) -> str:
    """The information of one channel on one parameter: the squares of its sensitivities, by differences."""
    name, noise = case.number, 1e-3
    x0 = np.asarray(case.model.parameters()[name])
    found = udk.design_experiment(case.model, [case.state], [name], list(channel(case)), noise=noise, ts=TS)
    runs = [udk.simulate(case.model.with_parameters({name: s * x0}), TS, case.state, **EXACT).q for s in (1 - 1e-4, 1 + 1e-4)]
    first = [np.asarray(q).reshape(len(TS), -1)[:, 0 if case.is_system else 2] for q in runs]
    slope = (first[1] - first[0]) / (2e-4 * float(x0))
    information = float(np.sum(slope**2)) / noise**2
    size = np.ptp(next(iter(channel(case).values()))) + 1e-3
    if information * float(x0) ** 2 < (1e-6 * size / noise) ** 2:  # the number does not change the motion
        claim(not found.standard_errors[0, 0] < 1e3 * noise / size * abs(float(x0)), "knows a number that the motion does not")
        return "the number does not change the motion"
    return agree(found.standard_errors[0, 0], information**-0.5, "sensitivities by differences", 1e-3)


def inference(case: Case) -> str:
    """The likelihood of a record at a number that did not make it, from a run with that number."""
    name, values = case.number, next(iter(channel(case).values()))
    model = case.model.with_parameters({name: 1.01 * np.asarray(case.model.parameters()[name])})
    noise = 1e-2 * float(np.ptp(values)) + 1e-4
    problem = udk.inference(model, {"time": TS, **channel(case)}, [name], noise=noise, tol=EXACT["rtol"])
    run = udk.simulate(model, TS, udk.assemble(model), **EXACT)
    predicted = np.asarray(run.q).reshape(len(TS), -1)[:, 0 if case.is_system else 2]
    likelihood = -0.5 * np.sum(((predicted - values) / noise) ** 2) - len(TS) * np.log(noise * np.sqrt(2.0 * np.pi))
    found = float(problem.log_densities(problem.start[None])[0] - problem.log_prior(problem.start))
    claim(abs(found - likelihood) < 1e-4 * (1.0 + abs(likelihood)), f"{found:.8g} instead of {likelihood:.8g}")
    return "likelihood of a run"


def sample(case: Case) -> str:
    """Draws around a number with a normal prior that is much narrower than the likelihood of a record with large noise."""
    name, values = case.number, next(iter(channel(case).values()))
    x0, noise = float(np.asarray(case.model.parameters()[name])), 1e2 * float(np.ptp(values)) + 1.0
    if x0 == 0.0:
        return "the number is zero"
    priors = {name: (x0, 1e-2 * abs(x0))}
    problem = udk.inference(case.model, {"time": TS, **channel(case)}, [name], noise=noise, priors=priors, tol=EXACT["rtol"])
    found = udk.sample(problem, chains=4, draws=50, warmup=50, progress=False)
    claim(np.isfinite(found.log_density).all(), "draws without density")
    error = abs(found.draws[name].mean() / x0 - 1.0)
    claim(error < 1e-2, f"the mean is off by {error:.2g}")
    return "mean of the prior"


def compare(case: Case) -> str:
    """Evidences for records with large noise are those of the noise alone, whatever the prior of a number."""
    name, values = case.number, next(iter(channel(case).values()))
    x0, noise = float(np.asarray(case.model.parameters()[name])), 1e3 * float(np.ptp(values)) + 1.0
    if x0 == 0.0:
        return "the number is zero"
    given = {"data": {"time": TS, **channel(case)}, "parameters": [name], "noise": noise, "tol": EXACT["rtol"]}
    models = {str(width): udk.inference(case.model, priors={name: (x0, width * abs(x0))}, **given) for width in (1e-2, 2e-2)}
    found = udk.compare(models)
    claim(abs(found.differences[1]) < 1e-2 + 4.0 * found.difference_errors[1], f"differ by {found.differences[1]:.2g}")
    return "evidence of noise"


def tolerances(case: Case) -> str:
    """A sample's coordinate at the end of the drive, by `kinematics` of the model with the sample's numbers."""
    channel, values = f"body.{case.model.body_names[-1]}.angle" if not case.is_system else "q[0]", case.values()
    names = [case.length] if case.length and "." in case.length else [case.number]
    given = {name + "[0]" * np.ndim(case.model.parameters()[name]): 1e-5 for name in names}
    found = udk.tolerances(case.model, given, [f"last({channel})"], drive=case.driver, values=values, samples=3)
    own = np.random.default_rng(0).standard_normal((3, 1)) * 1e-5 / 3.0
    wanted = []
    for shift in own[:, 0]:
        x = np.asarray(case.model.parameters()[names[0]])
        moved = x + shift if not x.ndim else np.concatenate([x.ravel()[:1] + shift, x.ravel()[1:]]).reshape(x.shape)
        m = case.model.with_parameters({names[0]: moved})
        wanted.append(float(np.asarray(udk.kinematics(m, case.driver, values).q)[-1, -1, 2]))
    return agree(found.measured[:, 0], np.array(wanted), "kinematics", 1e-9)


def sweep(case: Case) -> str:
    name = case.number
    x0 = np.asarray(case.model.parameters()[name])
    data = udk.sweep(case.model, {name: [x0, 1.02 * x0]}, TS, ["final"], rtol=1e-10, atol=1e-10, progress=False)
    ends = [udk.simulate(case.model.with_parameters({name: x}), TS, **EXACT).q[-1] for x in (x0, 1.02 * x0)]
    return agree(data["q_end"].values, np.stack(ends), "simulate", 1e-6)


def sweep_names(case: Case) -> str:
    """Each name is an axis; its members are runs of `simulate`."""
    m, chosen = case.model, names(case)
    for name in chosen:
        x0 = np.asarray(m.parameters()[name])
        values = [x0, 1.0001 * x0] if x0.ndim == 0 else np.stack([x0, 1.0001 * x0])
        data = udk.sweep(m, {name: values}, TS[:2], ["final"], rtol=1e-10, atol=1e-10, progress=False)
        end = udk.simulate(m.with_parameters({name: 1.0001 * x0}), TS[:2], **EXACT).q[-1]
        agree(data["q_end"].values[-1], end, f"simulate, of {name}", 1e-6)
    return f"simulate, {len(chosen)} names"


# --- designs


def design(case: Case) -> str:
    """A goal that the mechanism itself meets; the loss is that of the motion that `kinematics` follows."""
    m, values = case.model, np.linspace(case.values(1)[0], case.values(1)[0] + 0.3, 4)
    pins = [k[4:] for k in m.parameters() if re.fullmatch(r"pin\.\w+", k)]
    motion = udk.kinematics(m, case.driver, values, held=case.held)
    if pins:
        moving = udk.pin_motion(m, motion).pins
        pin = list(moving)[-1]
        goal: Any = udk.PathGoal(pin, np.asarray(moving[pin])[:, 0])
        free = [f"pin.{pin}"]
    else:  # of plain bodies: a point of the first one
        goal = udk.FunctionGoal(f"body.{m.body_names[-1]}.angle", values, np.asarray(motion.q)[:, -1, 2])
        free = [k for k in m.parameters() if k.startswith("joint.") and k.endswith(".points")][:1]
    found = udk.design(m, goal, free=free, driver=case.driver, starts=4, rotation=False)
    if not len(found):
        claim(len(found.reason) > 20, "no design, and no reason")
        return "a reason"
    best = found[0]
    again = udk.kinematics(best.mechanism, case.driver, best.values)
    claim(np.asarray(again.reached).all(), "the design does not reach its positions")
    return agree(float(best.loss), float(np.sum(np.square(best.residuals))), "kinematics of the design", 1e-9)


def design_all(case: Case) -> str:
    """Five poses of the coupler of the four-bar itself: it is among the four-bars that are found."""
    m, s = case.model, case.values(1)[0] + np.linspace(0.0, 1.5, 5)
    if case.is_system:
        udk.design_all(m, udk.PoseGoal("none", np.zeros((5, 3))), case.driver)
    coupler = "coupler" if "coupler" in m.body_names else m.body_names[-1]
    pins = [k[4:] for k in m.parameters() if re.fullmatch(r"pin\.\w+", k)]
    own = m.drawing.links[coupler].pins if m.drawing is not None and coupler in m.drawing.links else pins
    third = own[2] if len(own) > 2 else (own or ["none"])[-1]
    motion = udk.kinematics(m, case.driver, s, held=case.held)
    place = np.asarray(udk.pin_motion(m, motion).pins.get(third, np.zeros((5, 3, 2))))[:, 0]
    turn = np.asarray(motion.q)[:, m.body_names.index(coupler), 2]
    found = udk.design_all(m, udk.PoseGoal(coupler, np.column_stack([place, turn - turn[0]]), pin=third), case.driver)
    start = np.array([np.asarray(m.parameters()[f"pin.{p}"]) for p in pins])
    apart = [np.abs(np.array([x.mechanism.parameters()[f"pin.{p}"] for p in pins]) - start).max() for x in found]
    claim(min(apart, default=1.0) < 1e-6 * np.abs(start).max(), f"{len(found)} four-bars without its own")
    return "its own four-bar"


# --- files and pictures


def dumps(case: Case) -> str:
    again = udk.loads(udk.dumps(case.model))
    agree(udk.simulate(again, TS, case.state, **EXACT).q, case.alone.q, "the motion")
    return agree(list(again.parameters().values()), list(case.model.parameters().values()), "numbers and motion", 1e-12)


def save(case: Case) -> str:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "scene.toml"
        udk.save(case.model, file)
        return agree(udk.simulate(udk.load(file), TS, case.state, **EXACT).q, case.alone.q, "the motion")


def accelerations_by_c(folder: Path, prefix: str, memory: int, case: Case) -> np.ndarray:
    """Compile the accelerations of a folder of C, and evaluate them at the start of a case."""
    flags = ["-O0", "-std=c99", "-Wall", "-Wextra", "-pedantic", "-Werror", "-shared", "-fPIC"]
    sources = [str(folder / f"{prefix}_{x}.c") for x in ("accelerations", "numbers")]
    subprocess.run(["cc", *flags, *sources, "-o", str(folder / "code.so"), "-lm"], check=True)
    library = ctypes.CDLL(str(folder / "code.so"))
    q, v = (np.ravel(np.asarray(x, float)) for x in (case.state.q, case.state.v))
    a, work = np.zeros_like(q), np.zeros(memory // 8)
    numbers, arrays = (
        ctypes.c_double.in_dll(library, f"{prefix}_numbers"),
        [x.ctypes.data_as(ctypes.c_void_p) for x in (q, v, a, work)],
    )
    getattr(library, f"{prefix}_accelerations")(ctypes.byref(numbers), ctypes.c_double(0.0), *arrays)
    return a


def export_c(case: Case) -> str:
    with tempfile.TemporaryDirectory() as folder:
        found = udk.export_c(case.model, folder, ["accelerations"])
        a = accelerations_by_c(Path(folder), found.prefix, found.memory["accelerations"], case)
    return agree(a, np.ravel(udk.accelerations(case.model, 0.0, case.state.q, case.state.v)), "udk.accelerations", 1e-9)


def export_fmu(case: Case) -> str:
    with tempfile.TemporaryDirectory() as folder:
        found = udk.export_fmu(case.model, Path(folder) / "a.fmu", ["co-simulation"], (), (), platforms=[])
        with zipfile.ZipFile(found.file) as archive:
            start = re.findall(r'name="state.*start="(.*)"', archive.read("modelDescription.xml").decode())
    return agree(np.array(start, float), np.ravel([case.state.q, case.state.v]), "the state", 1e-9)


def export_compiled(case: Case) -> str:
    def run(q: Any) -> Any:
        return udk.simulate(case.model, TS, udk.State(q, case.state.v), **EXACT).q

    q = np.asarray(case.state.q, float)
    return agree(udk.load_exported(udk.export_compiled(run, q))(q), case.alone.q, "the motion")


def mjcf(case: Case) -> str:
    again = udk.read_mjcf(udk.mjcf_text(case.model))
    energies = [udk.energy(m, udk.simulate(m, TS, **EXACT)).kinetic for m in (again, case.model)]
    return agree(energies[0], energies[1], "the kinetic energy", 1e-5)


def page_data(text: str) -> Any:
    """Return the data in a written page."""
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)
    claim(found, "a page without data")
    assert found is not None
    return json.loads(found[1])


def shown(data: Any, run: Any) -> str:
    """Compare the motion of a page with a run, up to the precision of a page."""
    motion = motion_of(data["runs"][0])
    q = np.asarray(run.q)
    reached = np.isfinite(q).all((1, 2))
    claim(reached[0], "there is no motion")
    agree(np.stack([motion(t) for t in np.asarray(run.ts)[reached]]), q[reached], "the run", 1e-4)
    return "the motion in the page"


def animate(live: bool) -> Callable[[Case], str]:
    def row(case: Case) -> str:
        chosen = list(case.model.parameters() if case.is_system else case.model.independent_parameters()) if live else []
        chosen = [x for x in chosen if not x.endswith((".values", ".times"))]
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "page.html"
            if live:
                udk.animate(case.model, case.alone, live=chosen).save(file)
            else:
                udk.animate(case.model, case.run).save(file)
            data = page_data(file.read_text(encoding="utf-8"))
        by = shown(data, case.alone if live else case.run)
        if not live:
            return by
        sliders = json.dumps(data["live"])
        missing = [x for x in chosen if x.split(".")[-2 if "." in x else 0] not in sliders]
        claim(not missing, f"no slider of {missing}")
        return f"{by}, {len(chosen)} names"

    return row


def animate_modes(case: Case) -> str:
    shapes = np.ones((1, *np.shape(case.state.q)))
    data = page_data(udk.animate_modes(case.model, case.state.q, shapes).html())
    motion = motion_of(data["runs"][0])
    ratio = (motion(0.25) - np.asarray(case.state.q)) / (motion(0.125) - np.asarray(case.state.q))
    return agree(ratio, np.full(ratio.shape, 2**0.5), "q + shape sin(phase)", 1e-3)


# --- printed findings


def diagnose(case: Case) -> str:
    """The rank of Psi_q and the unique rows, as `singular_values` and `uniqueness` have them."""
    found = udk.diagnose(case.model, case.state)
    claim(len(str(found)) > 100, f"says {found}")
    if case.is_system:
        agree(found.ordinary_rank, 1, "the rank by hand")
        return "the rank by hand"
    sigma = np.asarray(udk.singular_values(case.model, 0.0, case.state.q))
    agree(found.rank, int((sigma > 1e-7 * sigma.max(initial=0.0)).sum()), "singular values")
    unique = np.asarray(udk.uniqueness(case.model, 0.0, case.state.q).unique).tolist()
    flat = [bool(x) for forces in found.forces.values() for x in forces.unique]
    claim(flat == [bool(x) for x in unique], f"unique rows {flat}, by uniqueness {unique}")
    return "singular_values, uniqueness"


def explain(case: Case) -> str:
    """M a + Psi_q^T lambda = F, Psi_q a = gamma, and a is that of `accelerations`."""
    found = udk.explain(case.model, 0.0, case.state)
    claim(len(str(found)) > 300, f"says {found}")
    a = np.asarray(found.a)
    agree(a, np.ravel(udk.accelerations(case.model, 0.0, case.state.q, case.state.v)), "accelerations", 1e-7)
    agree(np.asarray(found.psi_q) @ a, found.gamma, "gamma", 1e-7)
    return "accelerations, gamma"
