"""Sweep: from a mechanism and axes to a dataset with a result for every member."""

import os
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from inspect import isclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import numpy as np

from udkjax.annotations import Numbers
from udkjax.argument_types import BY_NAME, COUNT, TIMES, ArgumentRequirement, of_kind
from udkjax.equations.rows.analysis import Analysis
from udkjax.extras import require
from udkjax.integrate.solution import Result
from udkjax.progress import Progress, ProgressOption, report_progress
from udkjax.requirements import concrete_only
from udkjax.scene.arguments import checked
from udkjax.study.quantities import StudyModel
from udkjax.study.sweep.axes import AxisValues, SweepDesign
from udkjax.study.sweep.chunks import DEFAULT_MEMORY, compute_members
from udkjax.study.sweep.dataset import assemble, variables_of
from udkjax.study.sweep.executors import Executor, compute_on_devices, dask_engine
from udkjax.study.sweep.fingerprint import fingerprint
from udkjax.study.sweep.groups import RESULT
from udkjax.study.sweep.measures import MeasureChoice, Reference
from udkjax.study.sweep.plan import Chunk, make_plan
from udkjax.study.sweep.store import open_store, read_variable

if TYPE_CHECKING:  # imported only for results and clusters
    import distributed
    import xarray

Engine = Literal["auto", "devices", "dask"]


TEXTS_BY_NAME = ArgumentRequirement(
    "texts by name",
    of_kind(
        'map names to units, such as {name: "m"}',
        lambda x: isinstance(x, Mapping) and all(isinstance(text, str) for pair in x.items() for text in pair),
    ),
)
PATH = ArgumentRequirement("a path", of_kind("be a path, or None", lambda x: isinstance(x, str | os.PathLike)))
CLIENT = ArgumentRequirement(
    "a client of Dask", of_kind("be a dask.distributed.Client, or None", lambda x: hasattr(x, "submit") and not isclass(x))
)


@checked
@concrete_only()
def sweep(
    mechanism: StudyModel,
    axes: Annotated[Mapping[str, AxisValues], BY_NAME],
    ts: Annotated[Numbers, TIMES],
    measure: MeasureChoice = "final",
    *,
    design: SweepDesign | None = None,
    reference: Reference = None,
    derivatives: Sequence[str] = (),
    units: Annotated[Mapping[str, str], TEXTS_BY_NAME] = MappingProxyType({}),
    engine: Engine = "auto",
    client: Annotated["distributed.Client", CLIENT] | None = None,
    out: Annotated[str | os.PathLike[str], PATH] | None = None,
    memory: Annotated[int, COUNT] = DEFAULT_MEMORY,
    progress: ProgressOption = None,
    **settings: Any,
) -> "xarray.Dataset":
    """Simulate a mechanism for all combinations of the values of axes.

    Members (the single runs) are computed concurrently, in chunks of a few seconds, on all devices or cores of the machine.

    Args:
        mechanism: the scene, or a `ConstrainedSystem`, whose numbers have the names of its `parameters`.
        axes: values by name. A name is a parameter (`body.link1.mass`), a setting of `simulate` (`rtol`, `atol`, `drift_tol`,
            `dt0`, `method`, `solver`, `stepsize_controller`, `stabilization`, `formulation`, `max_steps`, `state`), an attribute
            of settings (`alpha` and `beta` of Baumgarte's stabilization, `rank_tol` and `branch_tol` of the method), `t1`, to
            which the output times are stretched, or `mechanism`, to compare mechanisms. `Axis(values, of=...)` allows another
            name of an axis and may tie several quantities; `Zipped({...})` varies axes together. Numbers of
            settings apply to the members that have them: "alpha" and "beta" to those with Baumgarte's stabilization. Zipped with
            the choices, they may be NaN for the others.
        ts: output times (T,), s.
        measure: measures to store for each member; nothing else is stored. A measure is a name: "final" (q and v at the end),
            "states" (at all `ts`), "violation" (the largest, m or rad), "energy_drift" (J), "error" (the largest error of a
            position and of an angle, against `reference`), "counts", "seconds" (computing time), "rank" (of D at all `ts`), or a
            channel, such as "pin.C.x" (at all `ts`), or "q[0]" of a `ConstrainedSystem`. Members are computed together: "seconds"
            is the time of a chunk, shared among its members in proportion to their steps. A measure may also be a function of
            (mechanism, solution), in jax.numpy, that returns an array or a dict of arrays. Several measures are given in a list,
            or a dict by name.
        design: `Sobol`, `LatinHypercube` or `Random`: the values of numeric axes are then ranges (low, high) or frozen
            distributions of scipy.stats, and all of them lie along the dimension "member".
        reference: for the measure "error": a Solution, coordinates (T, bodies, 3), or a function of (mechanism, ts).
        derivatives: names of parameters and axes: the dataset also has the derivatives of all stored variables with respect to
            each of them, as `d_<variable>_d_<name>`, in forward mode.
        units: units of the variables that functions store, by name, such as {"height": "m"}.
        engine: "dask": on the workers of a `client`; "devices": in this process; "auto": on a client if one is given.
        client: a client of dask.distributed; by default the most recent one.
        out: a folder for finished chunks; if the same sweep is run again, it continues from these.
        memory: limit of the memory for members that are being computed (bytes).
        progress: None shows a line after two seconds, True at once, False never; a function gets a `SweepProgress` after each
            chunk.
        settings: further arguments of `simulate`, for all members.

    Returns:
        A dataset along the axes. The dimension of an axis "method" is called "pseudoinverse", since `data.sel(method=...)` of
        xarray does not select by it: write data.sel(pseudoinverse="SVD"), or data.sel({"method": "SVD"}). `result` is the result
        of each member, a number that its attributes explain. The variables of failed members are NaN; no exception is raised for
        them.

    Raises:
        SweepError: lists every mistake in the arguments.
        StoreError: `out` cannot be written to, or contains another sweep.
        ClusterError: there is no client, or its workers cannot compute the sweep.
    """
    Analysis.require_masses(mechanism, "free motions")
    require("xarray", *(("dask", "distributed") if engine == "dask" else ()))
    studied = {"design": design, "reference": reference, "derivatives": derivatives, "units": units}
    plan = make_plan(mechanism, axes, ts, measure, **studied, **settings)
    variables_of(plan)  # traces every program, and finds mistakes before anything is computed or stored
    compute = _engine(engine, client)
    with open_store(out, fingerprint(plan) if out is not None else {}) as store:
        done, codes = read_variable(store, RESULT)
        with report_progress(progress, plan.size, "sweep") as report:
            watch = Watch(plan.size, len(done), report.show, codes)
            for chunk, data, seconds in compute_members(plan, compute, done, memory, watch.expect):
                store.write(chunk, data)
                watch(chunk, data, seconds)
        return assemble(plan, store.read_chunks())


def _engine(engine: str, client: "distributed.Client | None") -> Executor:
    """Return the executor of chunks; "auto" uses a client if one is given."""
    return dask_engine(client) if engine == "dask" or (engine == "auto" and client is not None) else compute_on_devices


T = TypeVar("T", int, float)
STEPS_VARIABLE = "steps"  # variable by which members are compared


@dataclass(frozen=True)
class SweepProgress(Progress):
    """The progress of a sweep: `done` of `total` members, including members of an earlier run.

    Attributes:
        rate: members per second in this run; None before the first chunk.
        remaining: estimated remaining time (s); None until it can be estimated.
        failures: number of members for each `Result` other than success.
        slowest: the member with the most steps, and its number of steps; None if steps are not stored.
        slowest_chunk: the chunk with the longest duration, and the duration (s).
    """

    rate: float | None = None
    remaining: float | None = None
    failures: Mapping[str, int] = field(default_factory=dict)
    slowest: tuple[int, int] | None = None
    slowest_chunk: tuple[int, float] | None = None

    @property
    def left(self) -> float | None:
        return self.remaining

    def __str__(self) -> str:
        percent = 100 * self.done / self.total if self.total else 100.0
        time_left = duration(self.seconds) if self.left is None or self.done == self.total else f"{duration(self.left)} left"
        rate = [] if self.rate is None else [f"{self.rate:.3g} per second"]
        return "; ".join([f"{self.done:g} of {self.total:g} members ({percent:.0f} %)", *rate, time_left, self.message])


class Watch:
    """The progress of a sweep of `members`; an earlier run has completed `done` of them, with the results `codes`.

    `show` is called with the `SweepProgress` at the start and after each chunk.
    """

    def __init__(self, members: int, done: int, show: Callable[[SweepProgress], object], codes: Numbers = ()):
        self.show, self.new = show, 0
        self.begun = time.monotonic()
        self.since, self.work, self.work_done = self.begun, 0.0, 0.0  # start, amount and completed part of the known work
        failures = _count_failures({}, codes)
        self.state = SweepProgress("sweep", done, members, 0.0, _message(failures), failures=failures)
        self.show(self.state)

    def expect(self, chunks: Sequence[Chunk]) -> None:
        """Set the remaining work to that of `chunks`, which are all of the remaining chunks."""
        self.since, self.work = time.monotonic(), sum(chunk.work for chunk in chunks)

    def __call__(self, chunk: Chunk, data: Mapping[str, np.ndarray], seconds: float | None = None) -> None:
        """Update the progress with a finished chunk, its stored variables, and its duration (s), if known."""
        before, now = self.state, time.monotonic()
        self.new += len(chunk.members)
        self.work_done += chunk.work if self.work else 0.0
        failures = _count_failures(before.failures, data["result"])
        slowest = _find_slowest(before.slowest, chunk.members, data.get(STEPS_VARIABLE))
        slowest_chunk = _find_slowest(before.slowest_chunk, [chunk.index], seconds)
        self.state = replace(
            before,
            done=before.done + len(chunk.members),
            seconds=now - self.begun,
            message=_message(failures, slowest, slowest_chunk),
            rate=self.new / max(now - self.begun, 1e-9),
            remaining=(now - self.since) / self.work_done * (self.work - self.work_done) if self.work_done > 0 else None,
            failures=failures,
            slowest=slowest,
            slowest_chunk=slowest_chunk,
        )
        self.show(self.state)


def _message(
    failures: Mapping[str, int], slowest: tuple[int, int] | None = None, slowest_chunk: tuple[int, float] | None = None
) -> str:
    failed = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in failures.items())
    remarks = [f"failed: {failed}" if failed else "no failures"]
    remarks += [] if slowest_chunk is None else ["slowest chunk {}: {:.1f} s".format(*slowest_chunk)]
    remarks += [] if slowest is None else ["slowest member {}: {} steps".format(*slowest)]
    return "; ".join(remarks)


def _count_failures(previous: Mapping[str, int], codes: Numbers) -> dict[str, int]:
    """Return the number of members for each `Result` other than success: `previous` numbers plus those of the results `codes`."""
    counts = Counter(previous)
    for code, count in zip(*np.unique(np.asarray(codes, int), return_counts=True), strict=True):
        if code != Result.successful:
            counts[Result(code).name] += int(count)
    return dict(counts)


def _find_slowest(previous: tuple[int, T] | None, indices: Numbers, values: Numbers | None) -> tuple[int, T] | None:
    """Return the largest of `values` with its index in `indices`, as (index, value), unless `previous` is at least as large."""
    if values is None:
        return previous
    values = np.atleast_1d(values)
    largest = int(np.argmax(values))
    return (
        previous
        if previous is not None and previous[1] >= values[largest]
        else (int(np.asarray(indices)[largest]), values[largest].item())
    )


def duration(seconds: float) -> str:
    """Return a duration (s) as text, in suitable units."""
    if seconds < 120:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60} min"
