"""Rows of the table of functions by models: each command, on the saved scene. What it writes is compared with the functions."""

import contextlib
import io
import json
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import udkjax as udk
from experiments.parts.crossing_case import TS, Case, WrongError, agree, arrays, claim
from experiments.parts.crossing_studies import accelerations_by_c, page_data, shown
from udkjax.cli import main as udkjax_cli
from udkjax.study.report import plain

SHORT = ("--t1", "0.2", "--dt", "0.05")
COMMANDS: dict[str, tuple[str, ...]] = {
    "simulate": ("SCENE", *SHORT, "--out", "OUT.nc", "--json"),
    "animate": ("SCENE", *SHORT, "--out", "OUT.html", "--json"),
    "kinematics": ("SCENE", "--driver", "DRIVER", "--from", "FIRST", "--to", "LAST", "--count", "5", "--json"),
    "gaps": ("SCENE", "--driver", "DRIVER", "--from", "FIRST", "--to", "LAST", "--width", "WIDTH", "--layers", "--json"),
    "inverse": ("SCENE", *SHORT, "--json"),
    "reactions": ("SCENE", *SHORT, "--json"),
    "tolerances": (
        *("SCENE", "--tol", "TOLERANCE", "--measure", "MEASURE", "--driver", "DRIVER", "--from", "FIRST", "--to", "LAST"),
        *("--count", "4", "--samples", "100", "--json", "--quiet"),
    ),
    "statics": ("SCENE", "--json"),
    "modes": ("SCENE", "--json"),
    "export": ("SCENE", "--c", "OUT.c", "--what", "accelerations", "--json"),
    "check": ("SCENE", "--json"),
    "convert": ("SCENE", "OUT.toml", "--json"),
    "diagnose": ("SCENE", "--json"),
    "explain": ("SCENE", "--json"),
    "sweep": ("SCENE", "GRID", "--out", "OUT.sweep", "--json", "--quiet"),
    "identify": ("SCENE", "DATA", "--parameters", "NUMBER", "--out", "OUT.found", "--json", "--quiet"),
}
# Commands that read no scene, or that answer a question about drawings alone.
WITHOUT_SCENE = ("report", "studio", "doctor", "design", "solve", "exercise")


class RefusedError(Exception):
    """A command ends with a message and an exit code."""


def command(name: str, case: Case) -> str:
    """Run a command on the saved scene; return what its results were compared with."""
    printed, said = io.StringIO(), io.StringIO()
    with tempfile.TemporaryDirectory() as folder:
        scene = Path(folder) / "scene.toml"
        udk.save(case.model, scene)  # an element of one's own is refused here
        words = _words(name, case, Path(folder)) | {"SCENE": str(scene)}
        arguments = [words.get(x, x.replace("OUT", f"{folder}/out")) for x in COMMANDS[name]]
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(said):
            try:
                udkjax_cli([name, *arguments])
                code = 0
            except SystemExit as end:
                code = end.code
        text = " ".join((said.getvalue() + printed.getvalue()).split())
        claim("Traceback" not in text and text, f"exit {code}: {text[-200:]}")
        if code not in (0, None):
            raise RefusedError(" ".join(said.getvalue().split())[-300:])
        claim(len(said.getvalue()) > 20 or name in ("animate", "convert", "sweep", "identify"), "prints nothing")
        results = json.loads(printed.getvalue())
        return READ[name](case, udk.load(scene), results, Path(folder))


def _words(name: str, case: Case, folder: Path) -> dict[str, str]:
    """Return the words of a command line that depend on the case; write the files that it reads."""
    first, last = (f"{float(x)!r} rad" for x in case.values()[[0, -1]])
    if case.driver in case.model.driver_names and case.model.drivers[case.driver].coordinate != "angle":
        first, last = (f"{float(x)!r} m" for x in case.values()[[0, -1]])
    words = {"DRIVER": str(case.driver), "NUMBER": case.number, "FIRST": first, "LAST": last, "WIDTH": "10 mm"}
    if name == "tolerances":
        words["TOLERANCE"] = f"{case.number}=1e-3 {case.model.unit_of(case.number)}"
        words["MEASURE"] = f"range(body.{case.model.body_names[-1]}.angle)"
    if name == "sweep":
        grid, value = folder / "grid.toml", float(np.ravel(case.model.parameters()[case.number])[0])
        axes = f'[axes]\n"{case.number}" = [{value!r}, {1.01 * value!r}]\n'
        grid.write_text(f't1 = 0.2\ndt = 0.05\nmeasures = ["final"]\n{axes}[settings]\nrtol = 1e-10\natol = 1e-10\n')
        words["GRID"] = str(grid)
    if name == "identify":
        data, body = folder / "data.csv", case.model.body_names[0]
        lines = [f"{t!r},{x!r}" for t, x in zip(TS.tolist(), np.asarray(case.alone.q)[:, 0, 2].tolist(), strict=True)]
        data.write_text("\n".join([f"time,body.{body}.angle", *lines]))
        words["DATA"] = str(data)
    return words


# --- what a command has written: each function gets the case, the scene as read, the results (JSON) and the folder


def same(found: Any, wanted: Any, by: str, tol: float = 1e-7) -> str:
    """Compare results from JSON with those of a function; null stands for numbers that are not finite."""

    def numbers(x: Any) -> Any:
        if isinstance(x, dict):
            return {k: numbers(y) for k, y in x.items()}
        if isinstance(x, list):
            return [numbers(y) for y in x]
        return np.nan if x is None else x if isinstance(x, bool | int | float) else 0.0

    return agree(arrays(numbers(found)), arrays(numbers(plain(wanted))), by, tol)


def read_simulate(case: Case, scene: Any, results: Any, folder: Path) -> str:
    import xarray

    with xarray.open_dataset(folder / "out.nc", engine="h5netcdf") as data:
        agree([data["q"].values, data["v"].values], [case.alone.q, case.alone.v], "udk.simulate", 1e-5)
        claim(udk.loads(data.attrs["scene"]).body_names == case.model.body_names, "another scene")
    claim((folder / "out.png").stat().st_size > 1000 and results["result"] in ("successful", 0), "no picture, or no success")
    return "udk.simulate"


def read_animate(case: Case, scene: Any, results: Any, folder: Path) -> str:
    return shown(page_data((folder / "out.html").read_text(encoding="utf-8")), udk.simulate(scene, TS))


def read_kinematics(case: Case, scene: Any, results: Any, folder: Path) -> str:
    found = udk.kinematics(scene, case.driver, results["values"], rate=1.0)
    wanted = udk.kinematics(case.model, case.driver, case.values(2)[:1], rate=1.0)
    agree(np.array(results["q"])[0], np.asarray(wanted.q)[0], "the first value", 1e-6)
    return same(results["q"], found.q, "udk.kinematics", 1e-6)


def read_tolerances(case: Case, scene: Any, results: Any, folder: Path) -> str:
    measure = f"range(body.{scene.body_names[-1]}.angle)"
    found = udk.tolerances(scene, {case.number: 1e-3}, [measure], drive=case.driver, values=case.values(), samples=100)
    return same([results["quantiles"], results["yield"]], [found.quantiles(), found.yield_], "udk.tolerances", 1e-6)


def read_inverse(case: Case, scene: Any, results: Any, folder: Path) -> str:
    return same(results["efforts"], udk.inverse_dynamics(scene, TS).efforts, "udk.inverse_dynamics", 1e-6)


def read_gaps(case: Case, scene: Any, results: Any, folder: Path) -> str:
    found = udk.gaps(case.model, case.driver, values=case.values()[[0, -1]], shapes=dict.fromkeys(case.model.body_names, 0.01))
    wanted = [[gap.distance, gap.bound] for gap in found.pairs]
    return same([[gap["distance"], gap["bound"]] for gap in results["gaps"]], wanted, "udk.gaps", 1e-6)


def read_reactions(case: Case, scene: Any, results: Any, folder: Path) -> str:
    forces = udk.pin_reactions(case.model, case.alone)
    wanted = {p: {b: float(np.hypot(*np.asarray(x)[:, :2].T).max()) for b, x in by.items()} for p, by in forces.items()}
    return same({p: {b: x["force"] for b, x in by.items()} for p, by in results["peaks"].items()}, wanted,
                "udk.pin_reactions", 1e-4)  # fmt: skip


def read_statics(case: Case, scene: Any, results: Any, folder: Path) -> str:
    found = udk.equilibrium(case.model)
    found = found if found.balanced else udk.equilibrium(case.model, stable=True)
    return same([results["equilibria"][0][x] for x in ("q", "omega2")], [found.q, found.omega2], "udk.equilibrium", 1e-6)


def read_modes(case: Case, scene: Any, results: Any, folder: Path) -> str:
    rest = udk.equilibrium(case.model, stable=True)
    found = udk.modes(case.model, rest.state)
    return same([results[x] for x in ("q", "omega2", "damping")], [found.q, found.omega2, found.damping], "udk.modes", 1e-6)


def read_export(case: Case, scene: Any, results: Any, folder: Path) -> str:
    a = accelerations_by_c(folder / "out.c", results["prefix"], results["memory"]["accelerations"], case)
    return agree(a, np.ravel(udk.accelerations(case.model, 0.0, case.state.q, case.state.v)), "udk.accelerations", 1e-9)


def read_check(case: Case, scene: Any, results: Any, folder: Path) -> str:
    names = ("rows", "rank", "degrees_of_freedom", "length", "mass", "time", "closed")
    found = udk.check(case.model)
    return same([results[x] for x in names], [getattr(found, x) for x in names], "udk.check", 1e-9)


def read_convert(case: Case, scene: Any, results: Any, folder: Path) -> str:
    again = udk.load(folder / "out.toml")
    agree(list(again.parameters().values()), list(case.model.parameters().values()), "the numbers", 1e-12)
    return "the numbers of the scene"


def read_diagnose(case: Case, scene: Any, results: Any, folder: Path) -> str:
    wanted = udk.diagnose(case.model)
    names = ("rank", "ordinary_rank", "rows", "can_move", "degrees_of_freedom", "singular_values")
    return same([results[x] for x in names], [getattr(wanted, x) for x in names], "udk.diagnose", 1e-6)


def read_explain(case: Case, scene: Any, results: Any, folder: Path) -> str:
    found = udk.explain(case.model, 0.0, case.state)
    wanted = [found.a, found.multipliers, found.psi_q, found.gamma]
    return same([results[x] for x in ("a", "lambda", "psi_q", "gamma")], wanted, "udk.explain", 1e-6)


def read_sweep(case: Case, scene: Any, results: Any, folder: Path) -> str:
    import xarray

    value = float(np.ravel(case.model.parameters()[case.number])[0])
    runs = [udk.simulate(case.model.with_parameters({case.number: s * value}), TS, rtol=1e-10, atol=1e-10) for s in (1, 1.01)]
    with xarray.open_dataset(folder / "out.sweep" / "sweep.nc", engine="h5netcdf") as data:
        return agree(data["q_end"].values, np.stack([x.q[-1] for x in runs]), "udk.simulate", 1e-6)


def read_identify(case: Case, scene: Any, results: Any, folder: Path) -> str:
    found = udk.load(folder / "out.found" / "identified.toml")
    run = udk.simulate(found, TS, case.state, rtol=1e-10, atol=1e-10)
    size = float(np.ptp(np.asarray(case.alone.q)[:, 0, 2])) + 1e-3
    error = float(np.abs(np.asarray(run.q)[:, 0, 2] - np.asarray(case.alone.q)[:, 0, 2]).max())
    if error > 1e-5 * size:
        raise WrongError(f"the identified scene moves otherwise, by {error:.2g} of {size:.2g}")
    return "the motion that made the record"


READ: dict[str, Callable[[Case, Any, Any, Path], str]] = {name: globals()[f"read_{name}"] for name in COMMANDS}
