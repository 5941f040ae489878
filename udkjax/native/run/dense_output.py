"""States between steps: Newton's divided differences of the last four states with their velocities and accelerations."""

from udkjax.native.language.ir import BOOL, DOUBLE, POINTER, Function, Value
from udkjax.native.module.layout import Lane, Layout
from udkjax.native.module.module import Module
from udkjax.native.module.steps import LARGEST_STRETCH, NODE_COUNT, SHORT_STEP


def write_differences(module: Module, name: str = "differences", to: tuple[str, Layout] | None = None):
    """Write the function `name`: Newton's divided differences of the last points, the latest first, of states or tangents.

    `to`: the name of a pointer to tangents, an argument of the function, with their layout; None: states, in `work`.
    """
    pointer = to[0] if to else "work"
    f, s = module.function(name, [(POINTER, x) for x in ("work", *([pointer] if to else []))])
    inverse, used = _spacing(module, f, s)
    short = _short_steps(module, f, s)
    with f.each(module.registers(pointer)) as r:
        points = {x: [module.vector(f, f"point{NODE_COUNT - 1 - k} {x}", r, pointer) for k in range(NODE_COUNT)] for x in "qva"}
        if module.projection.slips:
            points["q"] = [q - module.vector(f, f"point{NODE_COUNT - 1 - k} slipped", r) for k, q in enumerate(points["q"])]
        column = [x for x in points["q"] for _ in range(3)]  # each point is a triple node, of its q, v and a (Hermite)
        given = {1: points["v"], 2: [a * 0.5 for a in points["a"]]}
        module.put(f, "difference0", r, column[0], pointer)
        for degree in range(1, 3 * NODE_COUNT):
            following = []
            for i in range(3 * NODE_COUNT - degree):
                first, last = i // 3, (i + degree) // 3  # points
                difference = given[degree][first] if first == last else (column[i + 1] - column[i]) * inverse[first, last]
                if degree == 1 and first != last:
                    mask, step = short[first]
                    mean, change = (points["v"][first] + points["v"][last]) * 0.5, points["a"][first] - points["a"][last]
                    difference = f.select(mask, mean - change * step * (1 / 12), difference)
                following.append(difference)
            column = following
            mask = used[degree // 3]
            module.put(f, f"difference{degree}", r, column[0] if mask is None else f.select(mask, column[0], 0.0), pointer)


def _spacing(module: Module, f: Function, s: Lane) -> tuple[dict[tuple[int, int], Value], list[Value | None]]:
    """Return the inverses of the times between any two points, and masks of the lanes in which the polynomial uses each point.

    Points have indices from the latest on; a mask None means all lanes. A point is not used if the steps before the last one are
    much shorter than it. A polynomial of high degree through such close points would multiply rounding errors; a jump of the
    accelerations, as between the two states at a breakpoint; and errors of accelerations from an implicit method.
    """
    times = [getattr(s, f"point{NODE_COUNT - 1 - k}_t") for k in range(NODE_COUNT)]
    step = times[0] - times[1]
    inverse: dict[tuple[int, int], Value] = {}
    for i in range(NODE_COUNT):
        for j in range(i + 1, NODE_COUNT):
            d = times[j] - times[i]
            inverse[i, j] = module.broadcast(f, 1.0 / f.select(d.is_(0.0), 1.0, d))
    used: list[Value | None] = [None, None]
    all_near = f.const(not module.method.is_implicit, BOOL, f.width)
    for k in range(1, NODE_COUNT - 1):
        near = (times[k] - times[k + 1]) * LARGEST_STRETCH >= step
        all_near = all_near & module.stiffness.between_explicit(s, near, NODE_COUNT - k)
        used.append(all_near)
    return inverse, used


def _short_steps(module: Module, f: Function, s: Lane) -> list[tuple[Value, Value]]:
    """Return for each step between points, the latest first, the mask of the lanes in which it is short, and its length (s)."""
    steps = [
        getattr(s, f"point{NODE_COUNT - 1 - k}_t") - getattr(s, f"point{NODE_COUNT - 2 - k}_t") for k in range(NODE_COUNT - 1)
    ]
    return [(step * s.omega < SHORT_STEP, module.broadcast(f, step)) for step in steps]


def write_differences_back(module: Module):
    """Write `differences_back(work)`: pull the cotangents of the divided differences back to the points, and clear them."""
    f, s = module.function("differences_back")
    active, (inverse, used), short = s.at > 0.5, _spacing(module, f, s), _short_steps(module, f, s)
    zero, count = f.const(0.0, DOUBLE, module.plan.vector), 3 * NODE_COUNT
    with f.each(module.rowcount) as r:
        bars: dict[str, list[Value]] = {x: [zero] * NODE_COUNT for x in "qva"}
        column: list[Value] = []
        for degree in reversed(range(count)):
            leading, mask = module.vector(f, f"bar difference{degree}", r), used[degree // 3]
            leading = leading if mask is None else f.select(mask, leading, 0.0)
            bars_of_column = [zero] * (count - degree)
            for i, bar in enumerate(column):  # cotangents of the next column
                first, last = i // 3, (i + degree + 1) // 3  # points
                if first == last:
                    x, share = ("v", bar) if degree == 0 else ("a", bar * 0.5)
                    bars[x][first] = bars[x][first] + share
                else:
                    if degree == 0:
                        mask, step = short[first]
                        mean, change = f.select(mask, bar * 0.5, 0.0), f.select(mask, bar * step * (1 / 12), 0.0)
                        bars["v"][first], bars["v"][last] = bars["v"][first] + mean, bars["v"][last] + mean
                        bars["a"][first], bars["a"][last] = bars["a"][first] - change, bars["a"][last] + change
                        bar = f.select(mask, 0.0, bar)
                    part = bar * inverse[first, last]
                    bars_of_column[i + 1] = bars_of_column[i + 1] + part
                    bars_of_column[i] = bars_of_column[i] - part
            bars_of_column[0] = bars_of_column[0] + leading
            column = bars_of_column
            module.put(f, f"bar difference{degree}", r, zero)
        for i, bar in enumerate(column):
            bars["q"][i // 3] = bars["q"][i // 3] + bar
        for k in range(NODE_COUNT):
            for x in "qva":
                name = f"bar point{NODE_COUNT - 1 - k} {x}"
                old = module.vector(f, name, r)
                module.put(f, name, r, f.select(active, old + bars[x][k], old))


def write_between(module: Module, name: str = "between", to: tuple[str, Layout] | None = None):
    """Write the function `name`: evaluate the polynomial at the time `next`, as `state q` and `state v`.

    `to`: as in `write_differences`, the memory of the tangents whose polynomial is evaluated; None: that of the states.
    """
    pointer = to[0] if to else "work"
    f, s = module.function(name, [(POINTER, x) for x in ("work", *([pointer] if to else []))])
    ahead = [module.broadcast(f, s.next - getattr(s, f"point{NODE_COUNT - 1 - k}_t")) for k in range(NODE_COUNT)]
    if not to:
        setattr(s, "state t", s.next)
    with f.each(module.registers(pointer)) as r:
        q, v = module.vector(f, f"difference{3 * NODE_COUNT - 1}", r, pointer), f.const(0.0, DOUBLE, module.plan.vector)
        for k in reversed(range(3 * NODE_COUNT - 1)):
            d = ahead[k // 3]
            v = f.fma(v, d, q)
            q = f.fma(q, d, module.vector(f, f"difference{k}", r, pointer))
        q = q + module.projection.slipped_between(f, s, r) if module.projection.slips else q
        module.put(f, "state q", r, q, pointer)
        module.put(f, "state v", r, v, pointer)


def write_outputs(module: Module):
    """Write `outputs(work, call)`: project the states at all output times up to `until`, and store them in the outputs."""
    f, s = module.function("outputs", [(POINTER, "work"), (POINTER, "call")])
    inner = module.field(f, "times") - 1

    def due() -> Value:
        s.due = f.select((s.next <= s.until) & (s.written + 1.0 < inner), f.const(1.0, DOUBLE, f.width), 0.0)
        return f.any_of(s.due > 0.5)

    with f.if_(due()):
        f.call("differences", f.given["work"])
        with f.while_(due):
            f.call("between", f.given["work"])
            module.projection.project_output(f, s, s.due > 0.5)
            module.record_output(f, s)
            with module.each_lane(f, s.due) as k:
                number = module.to_int(f, f.lane(s.written, k)) + 1
                module.write_state(f, s, k, number, "state q", "result v")
                module.put_lane_entry(f, "next", k, module.input_number(f, "ts", f.lane(s.member, k), number + 1))
            s.where(s.due > 0.5, written=s.written + 1.0)
