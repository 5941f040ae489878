"""`udkjax explain`."""

import math

from udkjax.cli.common import Json, Scene, load, refuse, show


def explain(scene: Scene, /, t: float = 0.0, json: Json = False) -> None:
    """Derive the accelerations and multipliers of one state with the paper's symbols and numbers, and check them.

    Args:
        scene: the mechanism.
        t: time of the state along the motion from the scene's start (s).
        json: write all arrays as JSON.
    """
    if not 0 <= t < math.inf:
        refuse(f"--t {t:g} must not be negative")
    mech, _ = load(scene)
    import udkjax as udk

    try:
        state = udk.assemble(mech)
        if t > 0:
            run = udk.simulate(mech, [0.0, t], state, rtol=1e-10, atol=1e-10)
            state = udk.State(run.q[-1], run.v[-1])
        found = udk.explain(mech, t, state)
    except udk.AssemblyError as problem:
        refuse(problem)
    except udk.SimulationError as problem:
        refuse(f"--t {t:g}: {problem}")
    show(found.to_dict(), str(found), json)
