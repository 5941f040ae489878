"""A joint with set-valued friction that turns round more slowly than the tolerance of speeds has no event, at the end either."""

import numpy as np
import pytest

import udkjax as udk


def creeping(damping):
    """Return a body on a guide with friction, a weak spring and a stiff damper: it stops almost at once, and creeps back."""
    body = {"b": udk.Body(1.0, 0.1, [0.3, 0.0], velocity=[0.5, 0.0])}
    guide = {"guide": udk.Prismatic(["ground", "b"], [[0.0, 0.0], [0.0, 0.0]], axis=0.0)}
    spring = udk.Spring(["ground", "b"], [[-1.0, 0.0], [0.0, 0.0]], 200.0, damping=damping, length=1.0)
    rubs = udk.Friction("guide", coefficient=0.1, law="set-valued")
    return udk.Mechanism(body, guide, forces={"spring": spring, "rubs": rubs}, gravity=[0.0, -9.81])


@pytest.mark.parametrize("end", [0.05, 0.8])
def test_a_run_ends_with_no_event_that_it_has_not_had(end):
    loose = udk.simulate(creeping(2e7), [0.0, 0.5 * end, end], rtol=1e-6, atol=1e-6)
    assert loose.events is not None
    names = [loose.events.names[int(k)] for k in loose.events.index]
    assert not names or np.max(loose.events.time) < end
    exact = 0.3 - 0.5 / 2e7  # the way to the stop; creeping back takes days
    np.testing.assert_allclose(loose.q[-1, 0, 0], exact, atol=1e-5)


def test_a_reversal_that_tolerances_show_is_found():
    tight = udk.simulate(creeping(2e3), [0.0, 0.8], rtol=1e-10, atol=1e-10)
    assert tight.events is not None and [tight.events.names[int(k)] for k in tight.events.index] == ["guide turns round"]
    assert float(tight.v[-1, 0, 0]) < 0.0


def test_joints_that_turn_round_together_are_all_listed():
    """A motor turns a crank back: all joints of the linkage stop at that instant, whatever the tolerance."""
    linkage = udk.library.four_bar(angle=1.2)
    names = list(linkage.joints)
    motor = udk.Driver(("ground", "crank"), "angle", udk.Sine(0.3, np.pi, offset=1.2))
    rubs = {f"friction {name}": udk.Friction(name, radius=0.01, coefficient=0.1, law="set-valued") for name in names}
    driven = udk.Mechanism(linkage.bodies, linkage.joints, {"motor": motor}, rubs)
    for tol in (1e-6, 1e-9, 1e-11):
        run = udk.simulate(driven, [0.0, 1.0], rtol=tol, atol=tol)
        assert run.events is not None
        assert sorted(run.events.names[int(k)] for k in run.events.index) == sorted(f"{name} turns round" for name in names)
        np.testing.assert_allclose(run.events.time, 0.5, atol=1e-6)
