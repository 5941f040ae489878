"""`udkjax diagnose`."""

from udkjax.cli.common import Json, Scene, fail, load, output_times, show


def diagnose(
    scene: Scene, /, t: float = 0.0, t1: float | None = None, dt: float = 0.05, fixes: bool = True, json: Json = False
) -> None:
    """Say what depends on what in a scene and how to mend it, where it is singular, and when its rank changes along a run.

    Args:
        scene: the mechanism.
        t: time of the configuration, for drivers (s).
        t1: end of a run from `t` along which the rank is followed (s); by default none.
        dt: time between two instants of the run (s); changes of the rank are located between them.
        fixes: look for changes of joints that take redundancy away, and verify them.
    """
    ts = None if t1 is None else output_times(t, t1, dt)
    mech, _ = load(scene)

    import udkjax as udk

    run = None if ts is None else udk.simulate(mech, ts, rtol=1e-10, atol=1e-10, throw=False)
    found = udk.diagnose(mech, solution=run, t=t, fixes=fixes)
    show(found.to_dict(), str(found), json)
    if run is not None and run.result:
        fail(run.cause)
