"""Make four_bar.csv: readings of encoders at two pins of examples/four_bar.toml, for a linkage that differs a little from it.

The coupler is heavier and longer than in the scene, the rocker is lighter, and the crank is released from another angle.
"""

from pathlib import Path

import numpy as np

import udkjax as udk

HERE = Path(__file__).parent
TRUTH = {"body.coupler.mass": 3.1, "body.rocker.mass": 1.6}
LENGTH = 2.53  # m: length of the coupler
ANGLE = np.radians(58.0)  # angle of the crank at its release, before the loop is closed
NOISE = 0.2  # standard deviation, degrees
SEED = 1


def main(folder: Path = HERE) -> None:
    """Simulate three seconds, sampled fifty times a second, and add noise."""
    mech = udk.load(HERE.parent / "four_bar.toml").with_parameters(TRUTH)
    mech = udk.with_angle(udk.with_length(mech, "coupler", LENGTH), "crank", ANGLE)
    ts = np.linspace(0.0, 3.0, 151)
    sol = udk.simulate(mech, ts, rtol=1e-10, atol=1e-10)
    angles = np.degrees(np.asarray(sol.q)[:, [mech.body_names.index(body) for body in ("crank", "rocker")], 2])
    angles += NOISE * np.random.default_rng(SEED).normal(size=angles.shape)
    lines = [
        "# encoders of a four-bar, made by four_bar.py",
        "time [ms],joint.A.angle [deg],joint.D.angle [deg]",
        *(f"{1e3 * t:.0f},{a:.2f},{d:.2f}" for t, (a, d) in zip(ts, angles, strict=True)),
    ]
    (folder / "four_bar.csv").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
