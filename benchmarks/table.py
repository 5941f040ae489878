"""The promises as data: each claim with its target, and its place in the figures."""

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

from benchmarks.startup import RUNS, SCENES

Rows = list[dict[str, Any]]
Figures = dict[str, Rows]  # by benchmark


class Claim(NamedTuple):
    """A figure that must be at most, or at least, `target`."""

    name: str
    benchmark: str
    target: float
    read: Callable[[Rows], float | None]
    at_least: bool = False

    def judged(self, figures: Figures) -> dict[str, Any]:
        """Return the claim with the measured figure: `holds` is None without one."""
        figure = self.read(figures[self.benchmark]) if self.benchmark in figures else None
        if figure is not None and figure != figure:
            figure = None
        holds = None if figure is None else figure >= self.target if self.at_least else figure <= self.target
        bound = f"{'≥' if self.at_least else '≤'} {self.target:g}"
        return {"claim": self.name, "benchmark": self.benchmark, "target": bound, "figure": figure, "holds": holds}


def pick(rows: Rows, key: str, **wanted: Any) -> list[Any]:
    """Return the values of `key` in the rows that have the values `wanted`."""
    chosen = (row for row in rows if all(row.get(name) == value for name, value in wanted.items()))
    return [row[key] for row in chosen if row.get(key) is not None]


def value(key: str, **wanted: Any) -> Callable[[Rows], float | None]:
    """Read one value."""
    return lambda rows: next(iter(pick(rows, key, **wanted)), None)


def _reciprocal(read: Callable[[Rows], float | None]) -> Callable[[Rows], float | None]:
    def found(rows: Rows) -> float | None:
        number = read(rows)
        return None if number is None else 1 / number

    return found


def _least(key: str, names: tuple[str, ...], **wanted: Any) -> Callable[[Rows], float | None]:
    """Read the least of several; infinite if they were measured but none reached the required error."""

    def found(rows: Rows) -> float | None:
        chosen = [row for name in names for row in rows if all(row.get(k) == v for k, v in ({"name": name} | wanted).items())]
        reached = [row[key] for row in chosen if row.get(key) is not None and row[key] == row[key]]
        return min(reached, default=float("inf")) if chosen and pick(rows, "name", **wanted, name="udkjax") else None

    return found


def _sum(keys: tuple[str, ...], **wanted: Any) -> Callable[[Rows], float | None]:
    def found(rows: Rows) -> float | None:
        parts = [number for key in keys for number in pick(rows, key, **wanted)]
        return sum(parts) if len(parts) == len(keys) else None

    return found


def _claims() -> Iterable[Claim]:
    motions = {-45.0: "hanging", 60.0: "crossing"}
    scripts = ("script, 1e-04", "script, 1e-10")
    for start, motion in motions.items():
        for target in (1e-6, 1e-8, 1e-10):
            at: dict[str, Any] = {"start": start, "target": target}
            against = _reciprocal(value("times_ours", name="C++", **at))
            yield Claim(f"20 s, {motion}, error {target:.0e}: time relative to C++", "trajectory", 1.0, against)
            against = _least("times_ours", scripts, **at)
            yield Claim(
                f"20 s, {motion}, error {target:.0e}: a script's time relative to ours", "trajectory", 20.0, against, True
            )
    batch: dict[str, Any] = {"start": -45.0, "outputs": "end only"}
    for target, most in ((1e-6, 18_000.0), (1e-8, 11_000.0)):
        rate = value("per_second", name="udkjax", target=target, **batch)
        yield Claim(f"batch, 10 s, hanging, error {target:.0e}: trajectories per second and core", "batch", most, rate, True)
    against = _least("times_ours", ("script",), target=1e-6, **batch)
    yield Claim("batch, 10 s, hanging, error 1e-06: rate relative to the script by vmap", "batch", 50.0, against, True)
    yield Claim("batch on two cores, rate relative to one core", "batch", 1.9, value("speedup", name="two cores"), True)
    yield Claim("batch: tracing and compiling, s", "batch", 8.0, value("compile_seconds", name="compiled", **batch))
    share = value("throughput", name="sweep")
    yield Claim("sweep of 100,000: throughput of a core, relative to the batch's", "sweep", 0.8, share, True)
    yield Claim("sweep of 100,000: memory, GiB", "sweep", 2.0, value("gib", name="sweep"))
    grows = value("us", name="exponents, N-four-bar")
    yield Claim("N-four-bar, N = 10 to 1000: power of N of a right-hand side's time", "scaling", 1.05, grows)
    waits = _sum(("build_s", "analyse_s", "first_run_s"), name="N-four-bar", n=1000)
    yield Claim("N-four-bar, N = 1000: until the first run, s", "scaling", 10.0, waits)
    for count in (1, 2, 4, 8):
        forward = value("times_run", name="udkjax", mode="forward", parameters=count)
        yield Claim(f"gradient, {count} parameters, forward, time relative to the run", "gradients", 1.4 + 0.2 * count, forward)
    reverse = value("times_run", name="udkjax", mode="reverse", parameters=8)
    yield Claim("gradient, 8 parameters, reverse, time relative to the run", "gradients", 4.0, reverse)
    for power in (-1, 3, 5, 9):
        name = f"damper, {10.0**power:.0e}"
        yield Claim(f"four-bar with a {name} N m s, 5 s: ms", "stiff", 2.0, value("ms", name=name))
        yield Claim(f"four-bar with a {name} N m s, 5 s: error, rad", "stiff", 1e-5, value("error", name=name))
    yield Claim("64 dampers of 0.1 to 1e9 N m s in vmap: ms", "stiff", 20.0, value("ms", name="64 dampers in vmap"))
    for name, most in (("forward derivative", 3.0), ("gradient", 4.0)):
        yield Claim(f"stiff four-bar, {name}: time relative to the run", "stiff", most, value("times_run", name=name))
        yield Claim(f"stiff four-bar, {name}: first call, s", "stiff", 2.0, value("first", name=name))
    yield Claim("a bushing of 1e9 N/m, 20 s: ms", "stiff", 5.0, value("ms", name="bushing, 1e+09"))
    yield Claim("a bumper of 1e7 N m/rad, 20 s: ms", "stiff", 5.0, value("ms", name="bumper, 1e+07"))
    for name in ("four-bar", "slider-crank", "double pendulum", "chain of ten"):
        relative = value("times_run", name=name, law="speed 0.001 m/s")  # the default
        yield Claim(f"{name} with friction in all joints: time relative to the run without", "friction", 3.0, relative)
    for name, least in (("spatial pendulum", 20.0), ("1024 in vmap", 50.0), ('64 linkages, engine="diffrax"', 0.67)):
        yield Claim(f"{name}: a script's time relative to ours", "systems", least, value("times_ours", name=name), True)
    for name, most in (("spatial pendulum", 1.0), ("its gradient", 1.5)):
        yield Claim(f"{name}: first call, s", "systems", most, value("first", name=name))
    for rods, first, again in ((3, 3.0, 2.0), (6, 6.0, 4.0), (12, 15.0, 10.0), (24, 30.0, 25.0)):
        name = f"chain of {rods} rods"
        yield Claim(f"{name} in space: first run, CPU s", "systems", first, value("first", name=name))
        yield Claim(f"{name} in space: a run of 1 s, CPU ms", "systems", again, value("ms", name=name))
    for case in IDENTIFIED:
        reached = value("reached", name=case, protocol="without noise")
        yield Claim(f"identified from within 50 %, {case}: share right to 1e-8", "identification", 0.95, reached, True)
        covered = value("covered", name=case, protocol="1 % noise")
        yield Claim(f"identified with 1 % noise, {case}: share within two errors", "identification", 0.93, covered, True)
    for name in ("udkjax: q, q', q'' in a batch", "udkjax: kinematics() in a batch"):
        rate = value("per_second", name=name)
        yield Claim(f"{name}: closed positions of a four-bar per second and core", "mechanisms", 1e6, rate, True)
    for name, least in (("udkjax: PositionBatch", 5e6), ("udkjax: PositionBatch, derivatives with respect to all pins", 1e6)):
        rate = value("per_second", name=name)
        yield Claim(f"{name}: closed positions of a four-bar per second and core", "mechanisms", least, rate, True)
    for name, target in STARTS.items():
        yield Claim(f"start: {name}, s", "startup", target, value("seconds", name=name))
    for name, target in WAITS.items():
        yield Claim(f"cold: {name}, s", "waiting", target, value("seconds", name=name))
    yield Claim("simulate of known numbers, warm, ms", "waiting", 0.6, value("milliseconds", name="simulate of known numbers"))
    yield Claim("control step of known numbers, warm, ms", "waiting", 0.6, value("milliseconds", name="step"))
    for scene in SCENES:
        for run in RUNS:
            target = 3.0 if scene == LARGEST else 1.5 if run == "first" else 2.5
            yield Claim(f"start: {scene}, {run}, s", "startup", target, value("seconds", scene=scene, run=run))


IDENTIFIED = (
    "linkage",
    "four-bar",
    "slider-crank",
    "excavator, valves shut",
    "excavator, driven",
    "linkage, crossing",
)
WAITS = {
    "eager grad": 1.5,
    "eager vmap over 8": 1.0,
    "hessian of a four-bar": 10.0,
    "first event": 1.5,
    "gradient of an event's time": 5.0,
    "travel": 1.5,
    "udkjax kinematics": 2.0,
    "udkjax statics": 1.5,
    "udkjax modes": 1.5,
    "udkjax animate": 2.5,
}
STARTS = {
    "import udkjax and simulate": 1.5,
    "udkjax --help": 0.4,
    "first trajectory, no cache": 1.5,
    "first trajectory, cached": 1.5,
}
LARGEST = "n_four_bar(40)"
CLAIMS = tuple(_claims())


def judge(figures: Figures) -> Rows:
    """Compare every claim with the figures."""
    return [claim.judged(figures) for claim in CLAIMS]


def show(judged: Rows) -> None:
    """Print the table."""
    print(f"\n{'claim':72} {'target':>8} {'figure':>10}  holds")
    for row in judged:
        figure = "-" if row["figure"] is None else f"{row['figure']:.4g}"
        print(f"{row['claim']:72} {row['target']:>8} {figure:>10}  {VERDICT[row['holds']]}")


VERDICT = {True: "yes", False: "NO", None: "not measured"}
