"""The identities of mechanics hold for all random mechanisms, and every malformed input is answered with an error message.

Claim: random mechanisms have loops, redundant copies of joints, joints implied by others, all types of joints, drivers and
forces, and sizes from a micrometre to a kilometre. For all of them, the terms of the equations agree with an independent
implementation (reference_equations.py), all methods, formulations and engines agree, and accelerations do not depend on names,
orders, axes, units or copies of constraints. Power is balanced, a is nearest to a_F in the metric of M, impulses are
reciprocal, impacts neither pull nor add energy, and derivatives are limits of differences. With friction in all joints the same
holds of runs, friction takes power, loads are those of repeated substitution, and `diagnose` knows which of them are unique.
Where many features meet, a scene moves alike in any view, order, batch and engine, at any tolerance, and as independent
equations say. Trained mechanisms are saved as they run. Derivatives hold where forces branch and where bodies have come to
rest, events at samples happen once, joints keep within their limits, and runs without projection agree with SciPy or report
that they do not.

Wrong scene files, arguments and command lines neither hang nor abort a process. Each has to end in a documented error that
names the place, without a traceback and without writing part of a file; any other result is a fault, which the page lists.

Most properties need no compilation: NumPy runs the scalar programs of a structure on many mechanisms at once. Runs are
compiled, and so there are fewer of them. The page properties.md lists the results. For a longer run, or an additional one:

    python -m experiments properties --set mechanisms=20000 --set seed=1 --set minutes=60
    python -m experiments properties --set first=400 --set add=1 --set files=0     # more mechanisms, and no more files
"""

import json
import sys
import time
from collections import Counter
from collections.abc import Iterator

import numpy as np
import xarray
from matplotlib.figure import Figure

from experiments.common import data_file, described, load, panels
from experiments.parts import (
    contact_properties,
    friction_properties,
    idiom_properties,
    mixed_properties,
    run_properties,
    state_properties,
)
from experiments.parts.fuzz import KINDS, Fault, cases_of, run, verdict
from experiments.parts.mixed_case import Failure
from experiments.parts.tally import Found, Tally

PROPERTIES = state_properties.PROPERTIES | run_properties.PROPERTIES | contact_properties.PROPERTIES
PROPERTIES |= friction_properties.PROPERTIES | idiom_properties.PROPERTIES | mixed_properties.PROPERTIES
MARGINS = 50.0, 10_000.0  # tolerance over worst error: below the first it is nearly exceeded, above the second it tests little
MEMBERS = 100  # mechanisms of each structure
LISTED, SHOWN = 100, 60  # faults that the data list, and kinds of faults that the page lists


def study(
    smoke: bool,
    mechanisms: int = 10_000,
    files: int = 88_000,
    arguments: int = 12_000,
    commands: int = 500,
    runs: int = 8,
    contacts: int = 64,
    rubbing: int = 1000,
    redundant: int = 1000,
    rubbing_runs: int = 8,
    idioms: int = 24,
    mixed: int = 40,
    variations: int = 8,
    seed: int = 0,
    first: int = 0,
    minutes: float = 60.0,
    add: bool = False,
) -> xarray.Dataset:
    """Check all properties.

    Args:
        smoke: Whether to run a small version.
        mechanisms: Number of mechanisms whose equations are checked at single states.
        files: Number of malformed scene files.
        arguments: Number of calls with wrong arguments.
        commands: Number of wrong command lines.
        runs: Number of structures to integrate; every other one also by diffrax, every third with derivatives.
        contacts: Number of plates and wheels to throw, of each of four kinds.
        rubbing: Number of mechanisms with friction in all joints whose equations are checked at single states.
        redundant: Number of redundant mechanisms with friction in all joints of which `diagnose` says what is unique.
        rubbing_runs: Number of structures with friction to integrate; every third also by diffrax, with derivatives.
        idioms: Number of mechanisms of each kind that are trained, have conditions in forces, limits, or run without projection.
        mixed: Number of structures in which up to nine features meet.
        variations: Number of scenes of each of them, which differ in their numbers.
        seed: Seed of all random numbers.
        first: The number of the first structure and of the first input.
        minutes: Time limit.
        add: Whether to add the results to the existing data.
    """
    if smoke:
        mechanisms, files, arguments, rubbing, redundant, minutes = 20, 30, 10, 2, 2, 5.0
        commands = runs = contacts = rubbing_runs = idioms = mixed = 0
    members = 5 if smoke else MEMBERS
    sets = "mechanisms", "large", "runs", "contacts", "rubbing", "redundant", "rubbing runs", "idioms", "mixed"
    end, tally = time.time() + 60 * minutes, Tally()
    count: dict[str, int] = dict.fromkeys(sets, 0)
    for structure in _until(end, first, mechanisms // members, "structures"):
        count["mechanisms"] += state_properties.check_states(tally, seed, [structure], members, structure % 4 == 0)
    for structure in _until(end, first, min(mechanisms // 250, 40), "large scenes"):
        count["large"] += state_properties.check_large(tally, seed, [structure])
    for structure in _until(end, first, runs, "structures of runs"):
        choices = 24, structure % 2 == 0, structure % 3 == 0
        count["runs"] += run_properties.check_runs(tally, seed, [structure], *choices)
    if contacts and time.time() < end:
        count["contacts"] += contact_properties.check_contacts(tally, seed + first, contacts)
    for structure in _until(end, first, 8 * max(rubbing, redundant), "structures with friction"):
        if count["rubbing"] >= rubbing and count["redundant"] >= redundant:
            break
        if count["rubbing"] < rubbing:
            count["rubbing"] += friction_properties.check_friction(tally, seed, [structure], -(-members // 4))
        if count["redundant"] < redundant:
            count["redundant"] += friction_properties.check_uniqueness(tally, seed, [structure], -(-members // 10))
    integrated = 0
    for structure in _until(end, first, 8 * rubbing_runs, "structures of runs with friction"):
        if integrated < rubbing_runs:
            tried = friction_properties.check_friction_runs(tally, seed, structure, 24, integrated % 3 == 0)
            count["rubbing runs"] += tried
            integrated += tried > 0
    if idioms and time.time() < end:
        count["idioms"] += idiom_properties.check_idioms(tally, seed + first, idioms)
    failures: list[Failure] = []
    for structure in _until(end, first, mixed, "structures in which features meet"):
        count["mixed"] += mixed_properties.check_mixed(tally, failures, seed, [structure], variations)
    faults: list[Fault] = []
    done = dict.fromkeys(KINDS, 0)
    for kind, wanted in {"commands": commands, "arguments": arguments, "files": files}.items():  # the quickest last
        found: list[Fault] = []
        for done[kind], found in run(kind, seed, first, wanted, max(1.0, end - time.time())):  # noqa: B020
            print(f"{kind}: {done[kind]} of {wanted}, {len(found)} faults", file=sys.stderr, flush=True)
        faults += found
    data = _dataset(tally, count, done, faults, failures)
    if add and data_file("properties").exists():
        data = _merged(load("properties"), data)
    settings = {"mechanisms": mechanisms, "members": members, "runs": runs, "first": first}
    return described(data, "random: experiments/parts/random_scenes.py", settings, seed)


def _until(end: float, first: int, count: int, what: str) -> Iterator[int]:
    for k in range(first, first + count):
        if time.time() > end:
            return
        if (k - first) % 10 == 0:
            print(f"{what}: {k - first} of {count}, {(end - time.time()) / 60:.0f} min left", file=sys.stderr, flush=True)
        yield k


def _dataset(
    tally: Tally, count: dict[str, int], done: dict[str, int], faults: list[Fault], failures: list[Failure]
) -> xarray.Dataset:
    found = [tally.found.get(name, Found()) for name in PROPERTIES]
    return xarray.Dataset(
        {
            "cases": ("property", [f.cases for f in found]),
            "worst": ("property", [f.worst for f in found]),
            "mechanisms": ("set", list(count.values())),
            "inputs": ("kind", list(done.values())),
            "faults": ("kind", [sum(f.kind == kind for f in faults) for kind in done]),
        },
        {"property": list(PROPERTIES), "set": list(count), "kind": list(done)},
        {
            "worst_at": json.dumps([f.at for f in found]),
            "left_out": json.dumps(tally.left_out),
            "listed": json.dumps(sorted(faults, key=_is_severe, reverse=True)[:LISTED]),
            "failures": json.dumps(failures),
        },
    )


def _merged(old: xarray.Dataset, new: xarray.Dataset) -> xarray.Dataset:
    """Return the combined results of two runs; properties and sets that the older one did not have are empty in it."""
    at = dict(zip(old.property.values, json.loads(old.worst_at), strict=True))
    old = (
        old.assign_coords(property=old.property.astype(object))
        .assign_coords(set=old["set"].astype(object))
        .reindex({"property": new.property, "set": new["set"]}, fill_value=0)
        .assign_attrs(worst_at=json.dumps([at.get(name, "") for name in new.property.values]))
    )
    both = new.copy()
    for name in ("cases", "mechanisms", "inputs", "faults"):
        both[name] = old[name] + new[name]
    both["worst"] = np.maximum(old.worst, new.worst)
    at = zip(json.loads(old.worst_at), json.loads(new.worst_at), old.worst.values >= new.worst.values, strict=True)
    out = Counter(json.loads(old.left_out)) + Counter(json.loads(new.left_out))
    # Faults that have been fixed since are left out.
    faults = [Fault(*f) for f in json.loads(old.listed)]
    stands = [f for f in faults if _is_severe(f) or verdict(cases_of(f.kind, f.seed)(f.case))[0]]
    gone = Counter(f.kind for f in faults) - Counter(f.kind for f in stands)
    both["faults"] = both.faults - [gone[str(kind)] for kind in both.kind.values]
    return both.assign_attrs(
        worst_at=json.dumps([a if is_old and a else b or a for a, b, is_old in at]),
        left_out=json.dumps({reason: n for reason, n in out.items() if n}),
        listed=json.dumps([*stands, *json.loads(new.listed)][:LISTED]),
        failures=json.dumps([*json.loads(old.attrs.get("failures", "[]")), *json.loads(new.failures)]),
    )


def holds(data: xarray.Dataset) -> dict[str, bool]:
    """Return whether each property that the run checked holds, and whether no input hangs or aborts a process."""
    found = {
        name: bool(worst <= PROPERTIES[name].tolerance)
        for name, cases, worst in zip(data.property.values, data.cases.values, data.worst.values, strict=True)
        if cases
    }
    faults = [Fault(*f) for f in json.loads(data.listed)]
    severe = {f.kind for f in faults if _is_severe(f)}
    return found | {f"{kind}: no hang, no abort": kind not in severe for kind in data.kind.values}


def _is_severe(fault: Fault) -> bool:
    return fault.wrong.startswith(("hangs", "ends the process"))


def _margins(data: xarray.Dataset) -> np.ndarray:
    tolerance = np.array([PROPERTIES[name].tolerance for name in data.property.values])
    worst = data.worst.values
    return np.where(worst > 0, tolerance / np.where(worst > 0, worst, 1.0), np.inf)


def headline(data: xarray.Dataset) -> str:
    """Return the numbers of cases, and the smallest margin between an error and its tolerance."""
    margins = _margins(data)[data.cases.values > 0]
    tried = f"{int(data.mechanisms.sum())} random mechanisms, {int(data.cases.sum())} comparisons in {len(margins)} properties"
    smallest = f"smallest margin {margins.min(initial=np.inf):.2g}"
    return f"{tried}, {smallest}; {int(data.inputs.sum())} fuzzed inputs, {int(data.faults.sum())} faults"


def figure(data: xarray.Dataset) -> Figure:
    """Draw the margin of each property: its tolerance over its worst error."""
    names, margins, cases = data.property.values, _margins(data), data.cases.values
    picture, axes = panels(1, 1, 8, 0.24 * len(names) + 1)
    one = axes[0, 0]
    shown = np.where(np.isfinite(margins), margins, 1e6)
    one.barh(range(len(names)), np.where(cases > 0, shown, np.nan), color="tab:blue", left=1)
    one.axvspan(*MARGINS, color="tab:green", alpha=0.15, lw=0)
    one.set(xscale="log", xlim=(1, 1e6), xlabel="tolerance over worst error", yticks=range(len(names)))
    one.set_yticklabels([f"{name} ({n:,})" for name, n in zip(names, cases, strict=True)], fontsize=7)
    one.invert_yaxis()
    return picture


def _about_friction(sets: dict[str, int]) -> str:
    if not sets.get("rubbing"):
        return ""
    return (
        f"With friction in all joints, the equations of {sets['rubbing']:,} mechanisms are evaluated, {sets['rubbing runs']} "
        f"mechanisms are integrated, and a linear program decides for {sets['redundant']:,} redundant mechanisms whether their "
        "accelerations are unique. "
    )


def _about_idioms(sets: dict[str, int]) -> str:
    if not sets.get("idioms"):
        return ""
    return f"{sets['idioms']} mechanisms are trained, differentiated across conditions, and run with limits, without projection. "


def _about_mixed(sets: dict[str, int]) -> str:
    if not sets.get("mixed"):
        return ""
    return (
        f"Up to nine features meet in {sets['mixed']:,} scenes of experiments/parts/mixed_scenes.py: linkages and trees with "
        "springs, stiff dampers, drivers, samples, friction of both laws, contacts, limits and other events, and kinked forces. "
    )


def _failures(data: xarray.Dataset) -> list[str]:
    """Return the table of comparisons in mixed scenes that do not hold."""
    found = [Failure(*f) for f in json.loads(data.attrs.get("failures", "[]"))]
    if not found:
        return []
    lines = ["", "Scenes in which features meet, and a comparison does not hold:", ""]
    lines += ["| Property | Scene | Error | Circumstances |", "|---|---|---|---|"]
    for f in found:
        text = f.detail[:300].replace("|", "\\|").replace("\n", " ").replace("`", "'")
        lines.append(f"| {f.name} | `{f.at}` | {f.error:.1e} | `{text}` |")
    return lines


def page(data: xarray.Dataset) -> str:
    """Return properties.md: the result for each property, and each remaining fault."""
    at, margins = json.loads(data.worst_at), _margins(data)
    sets = dict(zip(data.set.values, map(int, data.mechanisms.values), strict=True))
    kinds = zip(data.kind.values, map(int, data.inputs.values), map(int, data.faults.values), strict=True)
    versions = ", ".join(f"{key[8:]} {data.attrs[key]}" for key in sorted(data.attrs) if key.startswith("version_"))
    lines = [
        "# Properties of random mechanisms and malformed input",
        "",
        f"Written by `python -m experiments properties` (seed {data.attrs['seed']}, {data.attrs['seconds']:.0f} s; {versions}).",
        "",
        f"The equations of {sets['mechanisms']:,} mechanisms are evaluated by NumPy at single states, those of "
        f"{sets['large']} large mechanisms by loops. {sets['runs']} mechanisms are integrated by machine code, a part of them "
        f"also by diffrax and with derivatives; {sets['contacts']} bodies are thrown onto a floor and onto other bodies. "
        f"{_about_friction(sets)}{_about_idioms(sets)}{_about_mixed(sets)}The "
        "call next to an error reproduces the case: "
        "`random_scene(seed, structure, numbers)` of "
        "experiments/parts/random_scenes.py, or `mixed_scene` of experiments/parts/mixed_scenes.py. "
        "The margin is the tolerance divided by the worst error, marked `!` below 50 and "
        "`?` above 10,000. Errors are relative, in the scene's own units; if the condition number of the rows exceeds "
        f"{state_properties.ORDINARY:g}, they are also divided by its amplification of rounding.",
        "",
        "| Property | Claim | Cases | Worst error | Tolerance | Margin | Because | Worst at |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, cases, worst, margin, where in zip(
        data.property.values, data.cases.values, data.worst.values, margins, at, strict=True
    ):
        it = PROPERTIES[name]
        flag = "" if not cases or not worst else " !" if margin < MARGINS[0] else " ?" if margin > MARGINS[1] else ""
        size = "not tried" if not cases else f"{worst:.1e}"
        ratio = "none" if not worst else f"{margin:,.0f}{flag}"
        lines.append(
            f"| {name} | {it.claim} | {cases:,} | {size} | {it.tolerance:g} | {ratio} | {it.tolerance_because} | `{where}` |"
        )
    lines += ["", "Not compared:", "", *(f"- {n:,}: {reason}" for reason, n in json.loads(data.left_out).items())]
    lines += ["", "| Input | Cases | Faults |", "|---|---|---|", *(f"| {kind} | {n:,} | {bad:,} |" for kind, n, bad in kinds)]
    lines += _failures(data)
    faults = [Fault(*f) for f in json.loads(data.listed)]
    example = {f.signature: f for f in reversed(faults)}
    if faults:
        lines += ["", "Faults; `python -m experiments.parts.fuzz KIND SEED CASE` reproduces one:", ""]
        lines += ["| Times | Kind, seed, case | About | Wrong | Text |", "|---|---|---|---|---|"]
    for signature, times in Counter(f.signature for f in faults).most_common(SHOWN):
        f = example[signature]
        text = f.text[:120].replace("|", "\\|").replace("\n", " ").replace("`", "'")
        lines.append(f"| {times} | {f.kind} {f.seed} {f.case} | `{f.about}` | {f.wrong} | `{text}` |")
    return "\n".join(lines) + "\n"
