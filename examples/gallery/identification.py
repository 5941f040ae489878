"""Two masses of a four-bar, identified from its motion: the motions with the first guess and with the result.

The measurements are simulated, with noise of 0.01 rad, so that the true values are known.
"""

import numpy as np
from matplotlib.figure import Figure

import udkjax as udk
from udkjax.show import plots

TRUE = {"body.coupler.mass": 3.4, "body.rocker.mass": 1.2}  # kg
NOISE = 0.01  # rad


def make():
    """Return the errors of the results in standard errors, the player, and the fit."""
    guess = udk.library.four_bar()
    ts = np.linspace(0.0, 4.0, 101)
    measured = udk.simulate(guess.with_parameters(TRUE), ts).q
    noise = NOISE * np.random.default_rng(1).normal(size=(2, len(ts)))
    record = {"time": ts, "body.crank.angle": measured[:, 0, 2] + noise[0], "body.rocker.angle": measured[:, 2, 2] + noise[1]}
    estimate = udk.identify(guess, record, list(TRUE))
    data = estimate.to_xarray()
    values, errors = data["value"].values, data["standard_error"].values
    figure = Figure(figsize=(7, 3.2), layout="constrained")
    plots.draw_fit(figure.subplots(), data, str(data["channel"].values[0]))
    off = np.abs(values - list(TRUE.values())) / errors
    facts = {
        "largest error (in standard errors)": float(off.max()),
        "coupler (kg)": float(values[0]),
        "rocker (kg)": float(values[1]),
    }
    runs = {"guessed": udk.simulate(guess, ts), "identified": udk.simulate(estimate.mechanism, ts)}
    crank = {"crank angle (rad)": {label: run.q[:, 0, 2] for label, run in runs.items()}}
    return facts, {"motion": udk.animate(guess, runs, measures=crank), "fit": figure}


if __name__ == "__main__":
    facts, shown = make()
    print(facts)
    shown["motion"].save("identification.html")
