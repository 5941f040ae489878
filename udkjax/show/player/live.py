"""The additional data of a live page: the engines of its mechanisms, sliders, and updates of symbols.

sliders  live_parameters.py
engines  udkjax/integrate/portable; runs of one mechanism share an engine
runs     for each run: the index of its engine; sliders: [index of a slider, this mechanism's value] for each parameter of the
         engine; symbol_updates (symbol_updates.py); start: the state that closure starts from, or null for the scene's guess;
         times: all output times of a motion that failed or was stopped, or null
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from udkjax.annotations import JsonObject
from udkjax.equations.rows.analysis import analyse
from udkjax.integrate.events.law.event import ExpandsToEvents, expand_events
from udkjax.integrate.portable import names_of_run, portable_engine
from udkjax.native.language.program import UnsupportedError
from udkjax.positions.assembling.assembly import close
from udkjax.requirements import ArgumentError
from udkjax.scene.mechanism import Mechanism
from udkjax.show.player.live_parameters import Live, Slider, in_sections, names_in, sliders_of
from udkjax.show.player.marks.measure_curves import ShownMotion
from udkjax.show.player.marks.symbol_updates import symbol_updates
from udkjax.show.player.player_data import MOST_INSTANTS

DEFAULT_TOL = 1e-8  # rtol and atol of a run that does not record its tolerances: the defaults of `simulate`
SAME_STATE = 1e-6  # tolerance (characteristic lengths or rad, per characteristic time) for an initial state to be the scene's


def live_data(
    runs: Sequence[tuple[Mechanism, ShownMotion, Mapping[str, Any]]], live: Live, events: Sequence[ExpandsToEvents] = ()
) -> JsonObject:
    """Return the additional data of a live page, as described at the top of this file.

    Args:
        runs: mechanism, motion and player data of each run.
        live: parameters that get sliders.
        events: events of all runs.

    Raises:
        SceneError: no mechanism has a parameter with a name in `live`.
        ArgumentError: a page cannot simulate a mechanism or a run; the message gives the reason.
    """
    sliders: dict[str, Slider] = {}
    engines: dict[tuple[int, float, float], int] = {}
    data: JsonObject = {"engines": [], "runs": []}
    unknown = [] if isinstance(live, bool) else [n for n in live if not any(names_in(m, [n]) for m, _, _ in runs)]
    for mechanism, solution, record in runs:
        _require_solvable(mechanism, solution, events)
        run_sliders = sliders_of(mechanism, unknown or names_in(mechanism, live))
        sliders = {slider.name: slider for slider in run_sliders} | sliders
        rtol, atol = (float(getattr(solution, name, DEFAULT_TOL)) for name in ("rtol", "atol"))
        key = id(mechanism), rtol, atol
        if key not in engines:
            engines[key] = len(engines)
            data["engines"].append(_engine(mechanism, run_sliders, rtol, atol, events))
        engine = data["engines"][engines[key]]
        drawn = engine["count"] + engine["knots"] + sum(engine["of_events"])
        updates = symbol_updates(mechanism, record, record["symbols"], drawn)
        start, times = _start(mechanism, solution), _times(solution)
        data["runs"].append(
            {"engine": engines[key], "sliders": run_sliders, "symbol_updates": updates, "start": start, "times": times}
        )
    order = {slider.name: k for k, slider in enumerate(in_sections(sliders.values()))}
    for run in data["runs"]:
        run["sliders"] = [[order[slider.name], slider.value] for slider in run["sliders"]]
    return data | {"sliders": [slider.data for slider in in_sections(sliders.values())]}


def _require_solvable(mechanism: Mechanism, solution: ShownMotion, events: Sequence[ExpandsToEvents]):
    happened, own = getattr(solution, "events", None), tuple(expand_events(events, mechanism) if events else ())
    expected, names = names_of_run(mechanism, own), [event.name for event in own]
    if happened is not None and not events and tuple(happened.names) != expected:
        raise ArgumentError("live: the run has events, whose conditions the page needs: give `animate` the same `events`")
    if names and (happened is None or tuple(happened.names) != expected):
        raise ArgumentError(f"live: the run was not simulated with the events {', '.join(names)}: give them to `simulate`, too")
    stabilization = getattr(solution, "settings", {}).get("stabilization", "Projection")
    if stabilization != "Projection":
        raise ArgumentError(
            f"live: a page simulates with projection, but the run has stabilization={stabilization}: leave out `live`"
        )


def _engine(
    mechanism: Mechanism, sliders: Sequence[Slider], rtol: float, atol: float, events: Sequence[ExpandsToEvents]
) -> JsonObject:
    try:
        engine = portable_engine(mechanism, [slider.name for slider in sliders], rtol, atol, events=events, drawn=True)
    except UnsupportedError as error:
        raise ArgumentError(f"live: a page cannot compute {error}: choose parameters that do not need it") from None
    if engine.data["why"]:
        raise ArgumentError(f"live: a page cannot simulate this motion: {engine.data['why']}")
    return engine.data


def _times(solution: ShownMotion) -> list[float] | None:
    """Return the output times of a run that ended early, at most `MOST_INSTANTS`; None for a complete run.

    A page needs them because the run may be complete with other numbers of the scene.
    """
    ts = np.asarray(solution.ts, float)
    if len(ts) < 2:
        raise ArgumentError("live: the run has a single instant, and no motion to simulate")
    if np.isfinite(np.asarray(solution.q)).all():
        return None
    return np.interp(np.linspace(0, len(ts) - 1, min(len(ts), MOST_INSTANTS)), np.arange(len(ts)), ts).tolist()


def _start(mechanism: Mechanism, solution: ShownMotion) -> JsonObject | None:
    """Return the initial state {q, v} of a run; None if it equals the state to which the scene is assembled."""
    t = float(np.asarray(solution.ts)[0])
    q, v = (np.asarray(x, float)[0] for x in (solution.q, solution.v))
    closed, scales = close(mechanism, t).state, analyse(mechanism).scales
    length, rate = float(scales.length), float(scales.rate) or 1.0
    unit = np.array([length, length, 1.0])
    off = max(np.abs((q - np.asarray(closed.q)) / unit).max(), np.abs((v - np.asarray(closed.v)) / (unit * rate)).max())
    return None if off < SAME_STATE else {"q": q.ravel().tolist(), "v": v.ravel().tolist()}
