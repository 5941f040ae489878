"""Second derivatives of a motion that passes from one smooth piece of the state space to another.

Where pieces meet, on a surface g = 0, the accelerations a are continuous and their derivatives jump, by [a'] = c g' with a vector
c. The second derivatives of the positions are continuous. Those of the velocities along two changes x and y of the state jump by

    c (g' x) (g' y) / (g' f) = [a' x] (w . [a' y]) / (w . w)        with w = [a' f]

and f the rate of the state (the saltation matrix, one order higher: Leine and Nijmeijer 2004, section 7.5). A step of nearly no
length leads across (run/pieces.py), so that [a' x] is the difference of the tangents of the accelerations at its two ends.
"""

from udkjax.expressions.loops.loop_derivative import TWICE
from udkjax.native.derivatives.differentiated import Differentiated
from udkjax.native.language.ir import DOUBLE, POINTER, Value
from udkjax.native.module.steps import EDGE_STEP

MOTION_TANGENTS, LINEARIZATION_BEFORE = "tangents of the motion", "linearization before"  # arrays
AFTER_STEP, BEFORE_STEP = "difference0", "difference1"  # tangents of accelerations along the motion
NO_JUMP = 100 * EDGE_STEP  # a smaller relative difference is no jump: a step across takes EDGE_STEP of an ordinary step


def add_memory(module: Differentiated):
    """Reserve memory for the linearization before a step across, and for three tangents, the first of which is the motion."""
    module.places.add(LINEARIZATION_BEFORE, module.of_accelerations.stored_size)
    module.places.add(MOTION_TANGENTS, len(module.ways) * module.tangents.size * (module.tangents.width // module.plan.width))


def write_saltation(module: Differentiated):
    """Write `along_motion` and `jump`, which together add the jump to the second derivatives at the end of a step across."""
    _write_along_motion(module)
    _write_jump(module)


def _write_along_motion(module: Differentiated):
    """Write `along_motion(work)`: differentiate the accelerations along the motion, at both ends of the step across.

    The step leads from point 2 to point 3.

    The state is point 3, where the accelerations have been evaluated, and is so again afterwards.
    """
    f, s = module.function("along_motion")
    f.given["tangent"] = module.address(f, MOTION_TANGENTS)

    def differentiate(point: str, stored: str, to: str):
        with f.each(module.n) as i:
            for x, rate in zip("qv", "va", strict=True):
                change = f.like(module.entry(f, f"{point} {rate}", i), DOUBLE, module.tangents.width)
                module.put_entry(f, f"state {x}", i, change, "tangent")
        out = f.at(f.given["tangent"], module.start(to, "tangent"))
        f.call(TWICE, f.given["work"], module.address(f, stored), f.given["tangent"], out)

    def go_to(point: str):
        setattr(s, "state t", getattr(s, f"{point}_t"))
        for x in "qv":
            module.copy(f, f"{point} {x}", f"state {x}")

    differentiate("point3", f"stage{module.last} linearization", AFTER_STEP)
    go_to("point2")
    module.evaluate_settled(f, "corrected q", LINEARIZATION_BEFORE)
    differentiate("point2", LINEARIZATION_BEFORE, BEFORE_STEP)
    go_to("point3")


def _write_jump(module: Differentiated):
    """Write `jump(work, tangent)`: add the jump to `result v` of the third tangent of a group, in lanes that cross.

    The tangents of the accelerations are `point2 a` before the step, and `difference0` after it.
    """
    f, s = module.function("jump", ((POINTER, "work"), (POINTER, "tangent")))
    first, width, size = f.given["tangent"], module.tangents.width, module.tangents.size * module.tangents.width
    x, y, both = (f.at(first, k * size) for k in range(3))
    changes = {"x": (x, "point2 a"), "y": (y, "point2 a"), "f": (module.address(f, MOTION_TANGENTS), BEFORE_STEP)}

    def ends(name: str, i: Value) -> tuple[Value, Value]:
        """Return the tangents of an acceleration before and after the step."""
        f.given["tangent"], before = changes[name]
        return module.entry(f, before, i, "tangent"), module.entry(f, AFTER_STEP, i, "tangent")

    zero = f.const(0.0, DOUBLE, width)
    jumps, sizes = ({name: f.variable(zero, DOUBLE, width) for name in changes} for _ in range(2))
    product = f.variable(zero, DOUBLE, width)
    with f.each(module.n) as i:
        unit, jump = f.like(module.entry(f, "inverse unit", i), DOUBLE, width), {}
        for name in changes:
            before, after = (a * unit for a in ends(name, i))
            jump[name] = after - before
            jumps[name].value = f.fma(jump[name], jump[name], jumps[name].value)
            sizes[name].value = f.fma(before, before, f.fma(after, after, sizes[name].value))
        product.value = f.fma(jump["y"], jump["f"], product.value)
    crosses = f.like(s.crosses, DOUBLE, width) > 0.5
    for name in changes:
        crosses = crosses & (jumps[name].value > sizes[name].value * NO_JUMP**2)
    share = f.select(crosses, product.value / f.select(crosses, jumps["f"].value, 1.0), 0.0)
    with f.each(module.n) as i:
        before, after = ends("x", i)
        f.given["tangent"] = both
        old = module.entry(f, "result v", i, "tangent")
        module.put_entry(f, "result v", i, f.fma(after - before, share, old), "tangent")
