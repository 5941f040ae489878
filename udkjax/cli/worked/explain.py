"""`udkjax explain`."""

import math

from udkjax.cli.common import Json, Scene, load, refuse, show


def explain(scene: Scene, /, t: float = 0.0, json: Json = False) -> None:
    """Derive the accelerations and multipliers of one state, in the paper's symbols and with numbers, and check them.

    Args:
        scene: the mechanism.
        t: time of the state, reached by a simulation from the scene's initial state (s).
        json: write all arrays as JSON.
    """
    if not 0 <= t < math.inf:
        refuse(f"--t {t:g} must not be negative")
    mech, _ = load(scene)
    import udkjax as udk

    state = udk.assemble(mech)
    if t > 0:
        try:
            run = udk.simulate(mech, [0.0, t], state, rtol=1e-10, atol=1e-10)
        except udk.SimulationError as problem:
            refuse(f"--t {t:g}: {problem}")
        state = udk.State(run.q[-1], run.v[-1])
    explanation = udk.explain(mech, t, state)
    show(explanation.to_dict(), str(explanation), json)
