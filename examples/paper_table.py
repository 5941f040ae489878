"""The paper's whole table as one sweep: five pseudoinverses, three tolerances, with and without Baumgarte's stabilization.

De Falco, Pennestrì and Vita (2005), section 6: the five-bar parallelogram is released from rest and simulated for 20 s. As in the
paper the rank threshold is the tolerance, in the units of D, and the integrator is Adams-Moulton of variable order and step. Each
run is compared with the exact solution, which the paper did not have.

    python examples/paper_table.py [--end 20] [--out FOLDER]

Thirty runs; the stiff ones, with the paper's gains of 1000 and 100, take two minutes on two cores, after a minute to compile.
With a folder, finished runs are kept there, and repeating the command continues. `udkjax report` explains the figures.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np

import udkjax as udk
from udkjax.study.accuracy import exact_coordinates

TOLERANCES = (1e-10, 1e-8, 1e-6)
METHODS = (udk.SVD, udk.Varga, udk.Greville, udk.Householder, udk.GramSchmidt)
LOST = 0.1  # rad: a run whose angles are this wrong has lost the motion


def table(end: float = 20.0, out: Path | None = None, progress: Any = None) -> Any:
    """Return the table as a dataset over pseudoinverse, tol and stabilization."""
    mech = udk.library.parallelogram()
    state = udk.assemble(mech)
    ts = np.linspace(0.0, end, 401)
    return udk.sweep(
        mech,
        {
            "method": [method.absolute(1e-6) for method in METHODS],
            "tol": udk.Axis(TOLERANCES, of=("rtol", "atol", "rank_tol")),
            "stabilization": [udk.Baumgarte(0.0, 0.0), udk.Baumgarte(1000.0, 100.0)],
        },
        ts,
        ("error", "violation", "counts", "rank"),
        reference=exact_coordinates(mech, ts, state.q, state.v),
        solver=udk.Adams(),
        dt0=0.66e-2,  # s, of the paper
        drift_tol=np.inf,  # a run continues, however open its loops
        max_steps=200_000,
        out=out,
        progress=progress,
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="The paper's table as one sweep.")
    parser.add_argument("--end", type=float, default=20.0, help="end of the runs, s")
    parser.add_argument("--out", type=Path, help="folder for what is finished")
    given = parser.parse_args()
    data = table(given.end, given.out)
    names = dict(zip(data.result.flag_values, data.result.flag_meanings.split(), strict=True))
    for number, stabilization in enumerate(data.stabilization.values):
        print(f"\n{stabilization}")
        print(f"{'method':12} {'tol':>6} {'NSTEPS':>7} {'NFUNC':>8} {'violation':>10} {'angle off by':>12} {'rank':>6}  ended")
        for tol in data.tol.values[::-1]:
            for method in data.method.values:
                run = data.isel(stabilization=number).sel(pseudoinverse=method, tol=tol)
                rank = run["rank"].values[run["rank"].values >= 0]
                ended = names[int(run.result)] + (", lost" if run.angle_error > LOST else "")
                print(
                    f"{method:12.12} {tol:6.0e} {int(run.accepted):7} {int(run.right_hand_sides):8} {float(run.violation):10.1e}"
                    f" {float(run.angle_error):12.1e} {rank.min():3}-{rank.max():<2}  {ended}, {float(run.end_time):.4g} s"
                )


if __name__ == "__main__":
    main()
