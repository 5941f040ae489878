"""Sweep: from a mechanism and axes to a dataset with a result for every member."""

import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

from numpy.typing import ArrayLike

from udkjax.extras import require
from udkjax.scene.arguments import checked
from udkjax.scene.mechanism import Mechanism
from udkjax.study.progress import ProgressOption, report_progress
from udkjax.study.sweep.axes import AxisValues, SweepDesign
from udkjax.study.sweep.chunks import MEMORY, compute_members
from udkjax.study.sweep.dataset import assemble
from udkjax.study.sweep.executors import Engine as Compute
from udkjax.study.sweep.executors import compute_on_devices, dask_engine
from udkjax.study.sweep.fingerprint import fingerprint
from udkjax.study.sweep.groups import RESULT
from udkjax.study.sweep.measures import MeasureChoice, Reference
from udkjax.study.sweep.plan import make_plan
from udkjax.study.sweep.store import open_store, read_variable
from udkjax.study.sweep.sweep_progress import Watch

if TYPE_CHECKING:  # neither is needed before a sweep has results, or a cluster
    import distributed
    import xarray

Engine = Literal["auto", "devices", "dask"]


@checked
def sweep(
    mechanism: Mechanism,
    axes: Mapping[str, AxisValues],
    ts: ArrayLike,
    measure: MeasureChoice = "final",
    *,
    design: SweepDesign | None = None,
    reference: Reference = None,
    derivatives: Sequence[str] = (),
    engine: Engine = "auto",
    client: "distributed.Client | None" = None,
    out: str | os.PathLike[str] | None = None,
    memory: int = MEMORY,
    progress: ProgressOption = None,
    **settings: Any,
) -> "xarray.Dataset":
    """Simulate a mechanism for all combinations of the values of some axes.

    Members are computed side by side, in chunks of a few seconds, on all devices or cores of the machine.

    Args:
        mechanism: the scene.
        axes: values by name. A name is that of a parameter (`body.link1.mass`), of a setting of `simulate` (`rtol`, `atol`,
            `drift_tol`, `dt0`, `method`, `solver`, `stabilization`, `formulation`, `max_steps`, `state`), of one of its parts
            (`alpha` and `beta` of Baumgarte's stabilization, `rank_tol` and `branch_tol` of the method), `t1`, to which the
            output times are stretched, or `mechanism`, for mechanisms beside each other. `Axis(values, of=...)` gives an axis a
            name of its own and may tie several quantities; `Zipped({...})` lets axes advance together.
        ts: output times (T,), s.
        measure: what is stored of each member; nothing else is. By name: "final" (q and v at the end), "states" (at all `ts`),
            "violation" (the largest, m and rad), "energy_drift" (J), "error" (the largest of a coordinate and of an angle,
            against `reference`), "counts", "rank" (of D at all `ts`), or a channel, such as "pin.C.x" (at all `ts`). Or a
            function of (mechanism, solution), which returns an array or a dict of arrays; or several of these, in a list, or in
            a dict of names.
        design: `Sobol`, `LatinHypercube` or `Random`: the values of numeric axes are ranges (low, high), or frozen distributions
            of scipy.stats, and all of them lie along the dimension "member".
        reference: of the measure "error": a Solution, coordinates (T, bodies, 3), or a function (mechanism, ts) of them.
        derivatives: names of parameters and axes: the derivative of everything that is stored by each of them is in the dataset
            too, as `d_<variable>_d_<name>`, by forward mode.
        engine: "dask": on the workers of a `client`; "devices": in this process; "auto": on a client where one is given.
        client: of dask.distributed; by default the one that was made last.
        out: a folder in which finished chunks are stored: the same sweep again goes on from there.
        memory: what members in computation take at most (bytes).
        progress: None shows a line where it takes longer than two seconds, True at once, False never; a function gets a
            `SweepProgress` after each chunk.
        settings: any other that `simulate` has, of all members.

    Returns:
        A dataset along the axes. Each member's `result` says how it ended, as a number whose meanings are in its attributes;
        what failed is not a number, and nothing is raised for it.

    Raises:
        SweepError: with every mistake in the arguments.
        StoreError: `out` cannot be written to, or holds another sweep.
        ClusterError: there is no client, or its workers cannot do it.
    """
    require("xarray")
    plan = make_plan(mechanism, axes, ts, measure, design=design, reference=reference, derivatives=derivatives, **settings)
    compute = _engine(engine, client)
    with open_store(out, fingerprint(plan) if out is not None else {}) as store:
        done, codes = read_variable(store, RESULT)
        with report_progress(progress, plan.size, "sweep") as report:
            watch = Watch(plan.size, len(done), report.show, codes)
            for chunk, data, seconds in compute_members(plan, compute, done, memory, watch.expect):
                store.write(chunk, data)
                watch(chunk, data, seconds)
        return assemble(plan, store.read_chunks())


def _engine(engine: str, client: "distributed.Client | None") -> Compute:
    """Return what computes chunks: a client that is given is there to be used."""
    return dask_engine(client) if engine == "dask" or (engine == "auto" and client is not None) else compute_on_devices
