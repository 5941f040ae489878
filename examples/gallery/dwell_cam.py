"""A cam that lets its follower rest for a third of each turn, as a Geneva drive does.

The profile is a closed cubic spline; a motor turns the cam, and the joint holds the follower on the cam without a spring.
"""

import numpy as np
from matplotlib.figure import Figure

import udkjax as udk
from udkjax.show.style import COLOURS, plain

LOW, HIGH = 0.25, 0.40  # m: the radii of the cam
STEM = 0.15  # m: from the follower's tip to its centre
RATE = 2.0  # rad/s
LIVE = [
    "driver.motor.motion.coefficients",
    "gravity[1]",
    "body.follower.mass",
    "body.cam.inertia",
]  # changed by sliders of its page


def radius(angle):
    """Return the radius (m) at a polar angle (rad): a rise, a fall, and a rest of more than a third of a turn."""
    s = np.clip((np.abs(np.mod(angle, 2 * np.pi) - np.pi) - 0.35) / 1.5, 0.0, 1.0)
    return HIGH - (HIGH - LOW) * s**3 * (10 - 15 * s + 6 * s**2)  # no jump of the acceleration at the ends


def make():
    """Return facts of the dwell, the player, and the lift over a turn."""
    angle = np.linspace(0.0, 2 * np.pi, 24, endpoint=False)
    bodies = {"cam": udk.Body(2.0, 0.05), "follower": udk.Body(0.5, 0.01, (0.0, radius(np.pi / 2) + STEM))}  # its tip on the cam
    joints = {
        "axle": udk.Revolute(("ground", "cam"), [(0.0, 0.0), (0.0, 0.0)]),
        "guide": udk.Prismatic(("ground", "follower"), [(0.0, 0.45), (0.0, 0.2)], axis=np.pi / 2),
        "cam": udk.Cam(("cam", "follower"), [(0.0, 0.0), (0.0, -STEM)], udk.Profile(angle, radius(angle))),
    }
    motor = udk.Driver(("ground", "cam"), "angle", udk.Polynomial([0.0, RATE]))
    mech = udk.Mechanism(bodies, joints, {"motor": motor}, name="dwell cam")
    sol = udk.simulate(mech, np.linspace(0.0, 2 * np.pi / RATE, 121))
    turned, lift = RATE * np.asarray(sol.ts), np.asarray(sol.q)[:, 1, 1] - STEM
    figure = Figure(figsize=(7, 3.0), layout="constrained")
    axes = plain(figure.subplots())
    axes.plot(np.degrees(turned), 1e3 * lift, color=COLOURS[0], lw=1.6, label="simulated")
    axes.plot(np.degrees(turned), 1e3 * radius(np.pi / 2 - turned), "--", color=COLOURS[1], lw=1, label="the law that was meant")
    axes.set(xlabel="angle of the cam (degrees)", ylabel="radius below the follower (mm)")
    axes.legend(frameon=False)
    rests = lift < LOW + 1e-4
    facts = {
        "fraction of a turn during which the follower rests": float(rests.mean()),
        "lift (m)": float(np.ptp(lift)),
        "largest difference from the intended law (m)": float(np.abs(lift - radius(np.pi / 2 - turned)).max()),
    }
    return facts, {"motion": udk.animate(mech, sol, measures={"radius (m)": lift}, traces=(), live=LIVE), "lift": figure}


if __name__ == "__main__":
    facts, shown = make()
    print(facts)
    shown["motion"].save("dwell_cam.html")
