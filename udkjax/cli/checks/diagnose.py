"""`udkjax diagnose`."""

from udkjax.cli.common import Json, Scene, fail, load, output_times, show
from udkjax.cli.options import refuse_without_effect


def diagnose(
    scene: Scene, /, t: float = 0.0, t1: float | None = None, dt: float = 0.05, fixes: bool = True, json: Json = False
) -> None:
    """Find redundant constraints and changes that remove them, singular configurations, and rank changes along a run.

    The rank is the number of independent constraint equations; it drops in singular configurations, such as dead points.

    Args:
        scene: the mechanism.
        t: time of the configuration, for drivers (s).
        t1: end of a run from `t` along which the rank is followed (s); by default there is no run.
        dt: time between outputs of the run (s); rank changes are also found between outputs.
        fixes: search for changes of joints that remove redundancy, and verify them.
    """
    if t1 is None:
        refuse_without_effect(["--dt"], "without a run: give its end, --t1")
    ts = None if t1 is None else output_times(t, t1, dt)
    mech, _ = load(scene)

    import udkjax as udk

    run = None if ts is None else udk.simulate(mech, ts, rtol=1e-10, atol=1e-10, throw=False)
    diagnosis = udk.diagnose(mech, solution=run, t=t, fixes=fixes)
    show(diagnosis.to_dict(), str(diagnosis), json)
    if run is not None and run.result:
        fail(run.cause)
