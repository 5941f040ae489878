"""Scenes in which up to nine features meet: one after another, each check with its own time limit."""

import signal
import threading
import traceback
from collections.abc import Callable, Iterable
from contextlib import contextmanager
from typing import Any

import jax

import udkjax as udk
from experiments.parts import mixed_runs, mixed_states
from experiments.parts.mixed_case import Case, Failure
from experiments.parts.mixed_scenes import mixed_scene
from experiments.parts.tally import Property, Tally

PROPERTIES = mixed_runs.PROPERTIES | mixed_states.PROPERTIES
PROPERTIES |= {"no crash": Property("No call raises an error or takes longer than its limit", 0.5, "a count")}
PROPERTIES = {f"mixed: {name}": it for name, it in PROPERTIES.items()}
ALONE: dict[str, Callable[[Case], None]] = {
    "tolerances": mixed_runs.check_tolerances,
    "views": mixed_runs.check_views,
    "parts": mixed_runs.check_parts,
    "engines": mixed_runs.check_engines,
    "sweep": mixed_runs.check_sweep,
    "derivatives": mixed_runs.check_derivatives,
    "second derivatives": mixed_runs.check_second_derivatives,
    "states": mixed_states.check_states,
    "energy": mixed_states.check_energy,
    "reference": mixed_states.check_reference,
    "statics": mixed_states.check_statics,
    "driven": mixed_states.check_driven,
    "identification": mixed_states.check_identification,
}
OF_ALL = "tolerances", "states", "energy"  # checks of each member; the others take the first of its structure alone
RARE = {"engines": 4}  # checks of every n-th structure alone: other engines compile for a minute
LIMIT = 600.0  # s of processor time for one check; those of other engines compile four programs of up to 130 s


class _TooLong(BaseException):
    """A check exceeds its time limit."""


@contextmanager
def _limited(seconds: float):
    """Interrupt what takes longer, where signals can: in the main thread."""
    if threading.current_thread() is not threading.main_thread() or not hasattr(signal, "SIGPROF"):
        yield
        return

    def interrupt(*_: Any) -> None:
        raise _TooLong

    before = signal.signal(signal.SIGPROF, interrupt)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


def _guarded(case: Case, name: str, check: Callable[[], None]) -> None:
    """Run a check, and count an error or a time that is too long as its failure."""
    error, detail = 0.0, ""
    try:
        with _limited(LIMIT):
            check()
    except _TooLong:
        error, detail = 1.0, f"{name} takes longer than {LIMIT:g} s of processor time"
    except Exception:
        error, detail = 1.0, f"{name}: {traceback.format_exc(limit=-3)}"
    case.check("no crash", error, detail)


def check_mixed(
    tally: Tally,
    failures: list[Failure],
    seed: int,
    structures: Iterable[int],
    members: int = 1,
    checks: Iterable[str] = tuple(ALONE),
    features: tuple[str, ...] | None = None,
) -> int:
    """Check all properties on random scenes; return their number.

    Args:
        tally: The results.
        failures: The comparisons that do not hold are appended.
        seed: Seed of the series.
        structures: Numbers of the structures.
        members: Number of scenes of each structure, which differ in their numbers and run as one batch.
        checks: names of the checks of single scenes.
        features: those of each scene, instead of random ones.
    """
    own, count = Tally(), 0
    tolerances = {name.removeprefix("mixed: "): it.tolerance for name, it in PROPERTIES.items()}
    for structure in structures:
        cases = []
        for k in range(members):
            try:
                cases.append(Case(mixed_scene(seed, structure, k, features), own, failures, tolerances))
            except udk.SceneError as error:
                own.leave_out(f"a scene that is refused: {str(error).splitlines()[-1][:100]}")
        for k, case in enumerate(cases):
            for name in checks:
                if (k == 0 or name in OF_ALL) and structure % RARE.get(name, 1) == 0:
                    _guarded(case, name, lambda check=ALONE[name], case=case: check(case))
        if len(cases) > 1:
            _guarded(cases[0], "lanes", lambda cases=cases: mixed_runs.check_lanes(cases))
        count += len(cases)
        jax.clear_caches()  # no later structure uses the compiled programs of this one
    tally.merge(Tally({f"mixed: {name}": found for name, found in own.found.items()}, own.left_out))
    return count
