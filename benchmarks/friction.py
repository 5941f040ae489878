"""Cost of friction in all joints: operations and time of an evaluation, steps and time of a run, relative to those without."""

from functools import partial
from statistics import median
from typing import Any

import numpy as np

import udkjax as udk
from benchmarks.common import cpu_seconds, in_turn, ratio
from udkjax.equations.programs.unrolled import Unrolled
from udkjax.equations.states.textbook import prepare

MACHINES = {
    "four-bar": udk.library.four_bar,
    "slider-crank": udk.library.slider_crank,
    "double pendulum": udk.library.double_pendulum,
    "chain of ten": partial(udk.library.chain, 10, 0.4),
}
ACCELERATIONS = "a", "safe", "unsettled"  # the outputs of a stage
COEFFICIENT, RADIUS = 0.15, 0.005  # of all joints; of pins (m)
SPEEDS = (0.1, 0.01, 0.001)  # of sliding at which friction is largest (m/s), the last is the default
END, OUTPUTS, TOLERANCE = 2.0, 41, 1e-8
ROUNDS, AT_LEAST = 9, 0.02  # s


def with_friction(mechanism: udk.Mechanism, **law: Any) -> udk.Mechanism:
    """Return a mechanism with friction in all of its pins, slides and slots."""
    forces, base = dict(mechanism.forces), mechanism.without_origin
    for name, joint in base.joints.items():
        if isinstance(joint, udk.Revolute | udk.Prismatic | udk.Slot):
            arm: dict[str, Any] = {"radius": RADIUS} if isinstance(joint, udk.Revolute) else {}
            forces[f"friction of {name}"] = udk.Friction(name, coefficient=COEFFICIENT, **arm, **law)
    return udk.Mechanism(base.bodies, base.joints, base.drivers, forces, base.gravity, base.name)


def operations(mechanism: udk.Mechanism) -> int:
    """Return the number of operations of an evaluation of the accelerations, at the stages of a step."""
    return len(Unrolled(prepare(mechanism).programs, [ACCELERATIONS]).program(*ACCELERATIONS).program.order)


def main(smoke: bool = False) -> list[dict[str, Any]]:
    """Run each machine without friction, with the smooth law at several speeds, and with joints that stick, in turn."""
    machines, rounds, at_least = (["four-bar"], 1, 0.0) if smoke else (list(MACHINES), ROUNDS, AT_LEAST)
    laws: dict[str, dict[str, Any]] = {f"speed {speed:g} m/s": {"speed": speed} for speed in (SPEEDS[:1] if smoke else SPEEDS)}
    laws |= {"sticks": {"law": "set-valued"}}
    ts, rows = np.linspace(0.0, 0.2 if smoke else END, OUTPUTS), []
    print(f"{'':16} {'law':16} {'operations':>10} {'us a call':>10} {'steps':>7} {'ms a run':>9}    relative to without friction")
    for machine in machines:
        without = MACHINES[machine]()
        variants = {"none": without} | {law: with_friction(without, **numbers) for law, numbers in laws.items()}
        runs = {law: partial(udk.simulate, x, ts, rtol=TOLERANCE, atol=TOLERANCE) for law, x in variants.items()}
        stats = {law: run().stats for law, run in runs.items()}
        times = in_turn({law: partial(cpu_seconds, run, at_least) for law, run in runs.items()}, rounds)
        counts = {law: operations(x) for law, x in variants.items() if law != "sticks"}
        calls = {law: float(stats[law]["right_hand_sides"]) for law in runs}
        for law in runs:
            per_call = [seconds / calls[law] for seconds in times[law]]
            none = [seconds / calls["none"] for seconds in times["none"]]
            row: dict[str, Any] = {"name": machine, "law": law, "us": 1e6 * median(per_call), "ms": 1e3 * median(times[law])}
            row |= {"steps": int(stats[law]["steps"]), "times_call": ratio(per_call, none)}
            row |= {"times_steps": row["steps"] / int(stats["none"]["steps"]), "times_run": ratio(times[law], times["none"])}
            if law in counts:
                row |= {"operations": counts[law], "times_operations": counts[law] / counts["none"]}
            rows.append(row)
            relative = [row.get(f"times_{x}", float("nan")) for x in ("operations", "call", "steps", "run")]
            shown = f"{row.get('operations', '-'):>10} {row['us']:10.2f} {row['steps']:7} {row['ms']:9.3f}"
            print(f"{machine:16} {law:16} {shown}    " + " ".join(f"{x:6.2f}" for x in relative))
    return rows
