"""Sweep: from a mechanism and axes to a dataset with a result for every member."""

from collections.abc import Callable, Generator, Mapping, Sequence
from typing import Any

from udkjax.extras import require
from udkjax.scene.mechanism import Mechanism
from udkjax.study.progress import ProgressOption, reporting
from udkjax.study.sweep.axes import Design
from udkjax.study.sweep.cost import MEMORY, cut_chunks
from udkjax.study.sweep.dataset import assemble
from udkjax.study.sweep.executors import compute_on_devices, dask_engine
from udkjax.study.sweep.fingerprint import fingerprint
from udkjax.study.sweep.layout import SweepError
from udkjax.study.sweep.member import RESULT
from udkjax.study.sweep.plan import Chunk, Plan, make_plan
from udkjax.study.sweep.store import open_store, unfinished_chunks
from udkjax.study.sweep.sweep_progress import Watch

ENGINES = ("auto", "devices", "dask")


def sweep(
    mechanism: Mechanism,
    axes: Mapping[str, Any],
    ts: Any,
    measure: Any = "final",
    *,
    design: Design | None = None,
    reference: Any = None,
    derivatives: Sequence[str] = (),
    engine: str = "auto",
    client: Any = None,
    out: Any = None,
    memory: int = MEMORY,
    progress: ProgressOption = None,
    **settings: Any,
) -> Any:
    """Simulate a mechanism for all combinations of the values of some axes; return an xarray Dataset.

    `axes` maps names to values. A name is that of a parameter (`body.link1.mass`), of a setting of `simulate` (`rtol`, `atol`,
    `drift_tol`, `dt0`, `method`, `solver`, `stabilization`, `formulation`, `max_steps`, `state`), of one of its parts (`alpha`
    and `beta` of Baumgarte's stabilization, `rank_tol` and `branch_tol` of the method), `t1`, to which the output times are
    stretched, or `mechanism`, for mechanisms beside each other. `Axis(values, of=...)` gives an axis a name of its own and may
    tie several quantities; `Zipped({...})` lets axes advance together. With a `design` (`Sobol`, `LatinHypercube`, `Random`) the
    values of numeric axes are ranges (low, high), or frozen distributions of scipy.stats, and all of them lie along the dimension
    "member". All other arguments that `simulate` has are settings of all members.

    `measure` is what is kept of each member; nothing else is. By name: "final" (q and v at the end), "states" (at all `ts`),
    "violation" (the largest, m and rad), "energy_drift" (J), "error" (the largest of a coordinate and of an angle, against
    `reference`: a Solution, coordinates (T, bodies, 3), or a function (mechanism, ts) of them), "counts" and "rank" (of D at all
    `ts`). Or a function of (mechanism, solution), which returns an array or a dict of arrays; or several of these, in a list, or
    in a dict of names. `derivatives` names parameters and axes: the derivative of everything that is kept by each of them is in
    the dataset too, as `d_<variable>_d_<name>`, by forward mode.

    Each member's `result` says how it ended, as a number whose meanings are in its attributes; what failed is not a number, and
    nothing is raised for it. Members are computed in lanes, ordered by the steps that they are expected to take, on all devices
    or cores of the machine; `engine="dask"` on the workers of a `client` of dask.distributed instead. `out` names a folder in
    which finished chunks are kept: the same sweep again goes on from there. `memory` (bytes) bounds what members in computation
    take. `progress`: None shows a line where it takes longer than two seconds, True at once, False never; a function
    gets a `SweepProgress` after each chunk.

    Raises `SweepError`, which lists every mistake in the arguments.
    """
    if engine not in ENGINES:
        raise SweepError([f"engine: there is no {engine!r}; known are {', '.join(ENGINES)}"])
    require("xarray")
    plan = make_plan(mechanism, axes, ts, measure, design=design, reference=reference, derivatives=derivatives, **settings)
    compute = _engine(engine, client)
    with open_store(out, fingerprint(plan) if out is not None else {}) as kept:
        done, codes = kept.done(RESULT)
        with reporting(progress, plan.size, "sweep") as report:
            todo = unfinished_chunks(cut_chunks(plan, memory), done) if len(done) < plan.size else []
            watch = Watch(plan.size, todo, report.show, codes)
            for chunk, data, seconds in compute(plan, todo):
                kept.write(chunk, data)
                watch(chunk, data, seconds)
        return assemble(plan, kept.finished())


def _engine(engine: str, client: Any) -> Callable[[Plan, Sequence[Chunk]], Generator[Any, None, None]]:
    """What computes chunks: a client that is given is there to be used."""
    return dask_engine(client) if engine == "dask" or (engine == "auto" and client is not None) else compute_on_devices
