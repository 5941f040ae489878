"""The documentation's table of what can be exported states what each target does with each feature."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import udkjax as udk
from udkjax.integrate.portable import portable_engine

PAGE = Path(__file__).parents[3] / "docs" / "how-to" / "export.md"
TS = np.array([0.0, 0.1])
YES, NO = "yes", "refused"


class Wall(udk.ForceElement):
    """An elastic wall, whose force has a kink where the body meets it."""

    def potential(self, t, *frames):
        return 5.0 * jnp.maximum(frames[0].x - 0.2, 0.0) ** 2


def pendulum(**forces: udk.ForceElement) -> udk.Mechanism:
    one = udk.library.compound_pendulum()
    return udk.Mechanism(one.bodies, one.joints, {}, forces, one.gravity, "pendulum")


def rubbing(law: Any) -> udk.Mechanism:
    joint = next(iter(pendulum().joints))
    return pendulum(rub=udk.Friction(joint, coefficient=0.2, radius=0.01, law=law))


BODY = next(iter(udk.library.compound_pendulum().bodies))
FEATURES: dict[str, Callable[[], udk.Mechanism]] = {
    "joints, drivers, drawings, springs, dampers": pendulum,
    "redundant constraints": udk.library.parallelogram,
    "no constraints": lambda: udk.Mechanism({"a": udk.Body(1.0, 1.0, velocity=[1.0, 0.0])}),
    'friction by load, `law="smooth"`': lambda: rubbing("smooth"),
    'joints that stick, `law="set-valued"`': lambda: rubbing("set-valued"),
    "forces with jumps or kinks of the state": lambda: pendulum(wall=Wall([BODY])),
    "inputs over time, `udk.Held`": lambda: pendulum(
        motor=udk.Torque(["ground", BODY], udk.Held(np.array([0.0, 1.0]), 0.05)),
    ),
}


def compiled(mechanism: udk.Mechanism, folder: Path) -> object:
    state = udk.assemble(mechanism)
    return udk.export_compiled(lambda q: udk.simulate(mechanism, TS, udk.State(q, state.v), throw=False).q, np.asarray(state.q))


def on_page(mechanism: udk.Mechanism, folder: Path) -> object:
    why = portable_engine(mechanism, pull=False).data["why"]
    if why:
        raise ValueError(why)
    return None


def in_c(*what: Any) -> Callable[[udk.Mechanism, Path], object]:
    return lambda mechanism, folder: udk.export_c(mechanism, folder / "c", what, TS, stiff=False)


def as_fmu(kind: Any) -> Callable[[udk.Mechanism, Path], object]:
    options: Any = {"parameters": [], "inputs": [], "stiff": False, "platforms": []}
    return lambda mechanism, folder: udk.export_fmu(mechanism, folder / "a.fmu", [kind], **options)


TARGETS = {
    "C, run": in_c("run"),
    "C, reactions": in_c("reactions"),
    "C, other functions": in_c("accelerations", "derivatives", "projection"),
    "FMU, co-simulation": as_fmu("co-simulation"),
    "FMU, model exchange": as_fmu("model-exchange"),
    "compiled JAX": compiled,
    "live page": on_page,
}


def rows() -> dict[str, list[str]]:
    found = [[x.strip() for x in line.strip("| \n").split("|")] for line in re.findall(r"^\|.*\|$", PAGE.read_text(), re.M)]
    head = next(k for k, row in enumerate(found) if row[0] == "Feature")
    assert found[head][1:] == [*TARGETS]
    return {row[0]: row[1:] for row in found[head + 2 :] if len(row) == len(TARGETS) + 1}


def test_the_table_has_a_row_for_each_feature():
    assert [*rows()] == [*FEATURES]


@pytest.mark.parametrize("feature", FEATURES)
@pytest.mark.slow
def test_each_target_does_what_the_table_says(feature, tmp_path):
    mechanism, outcomes = FEATURES[feature](), []
    for export in TARGETS.values():
        try:
            export(mechanism, tmp_path)
            outcomes.append(YES)
        except ValueError as error:
            assert len(str(error)) > 20  # it says what cannot be exported
            outcomes.append(NO)
    assert outcomes == rows()[feature]
