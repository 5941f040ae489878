"""Counts of the calls of machine code in runs with events, and runs whose events are all left to the loop of events."""

import numpy as np

from tests.calls import calls_of
from udkjax.integrate.events.run.machine_system import MachineSystem
from udkjax.integrate.events.run.phase_code import PhaseCode


def by_the_loop(monkeypatch, passed: int = 0):
    """Leave all events to the loop of events, but those that a call has `passed` before."""
    monkeypatch.setattr(MachineSystem, "_events_to_pass", lambda self, runs, members, most: np.full(len(members), passed))


def counted(run):
    """Return the result of a run, the number of its stretches, and the most events that one of them passes."""
    with calls_of(PhaseCode.run) as calls:
        found = run()
    return found, len(calls), calls[0].arguments["self"].plan.run.passing.most
