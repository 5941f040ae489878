"""A user-defined stabilization (`udkjax.integrate.stabilization`), written in jax.numpy, as machine code.

The methods of a stabilization receive a `ConstraintState`. Its answers at a state (t, q, v) become calls of functions of the
module:

    stabilization_psi, stabilization_rate           compute Psi; Psi_dot and phi
    stabilization_factor, stabilization_solve       factorize the rows A; find the least change w with A w = residual
    stabilization_accelerate, stabilization_mass    compute a; the diagonal of M

Arguments and results of these functions have their own places in memory, and the call of a method does not change the state of
the module.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from udkjax.equations.programs.run_programs import RunPrograms
from udkjax.native.language.ir import DOUBLE, INT, Function, Value
from udkjax.native.language.program import UnsupportedError
from udkjax.native.lowering.module_calls import ModuleCall
from udkjax.native.lowering.own_objects import Input, OwnObject, Written, named, numbers_of, written
from udkjax.native.module.layout import Lane
from udkjax.native.module.module import Module
from udkjax.native.module.parts import AccelerationPart
from udkjax.native.pseudoinverses.householder import HouseholderCode
from udkjax.native.pseudoinverses.weighted_rows import WeightedRows

TOL_SETTING = "stabilization_tol"
STATE_PLACES = "at_t", "at_q", "at_v"  # the places of the state of a call


class ModuleEquations(eqx.Module):
    """The equations that a stabilization asks for while it is traced: each answer becomes a call of functions of the module."""

    n: int = eqx.field(static=True)
    rows: int = eqx.field(static=True)
    position_rows: int = eqx.field(static=True)
    is_diagonal: bool = eqx.field(static=True)

    def violation(self, t: Any, q: Any, v: Any) -> tuple[Array, Array]:
        return self._of_rows("psi", self.position_rows, t, q, v), self._of_rows("rate", self.rows, t, q, v)

    def _of_rows(self, name: str, count: int, *state: Any) -> Array:
        return self._found(name, f"at_{name}", count, *state) if count else jnp.zeros(0)

    def accelerations(self, t: Any, q: Any, v: Any) -> Array:
        return self._found("accelerate", "at_x", self.n, t, q, v)

    def mass(self, t: Any, q: Any, v: Any) -> Array:
        if not self.is_diagonal:
            raise UnsupportedError("a mass matrix that is not diagonal")
        return jnp.diag(self._found("mass", "at_x", self.n, t, q, v))

    def _found(self, function: str, place: str, count: int, *state: Any) -> Array:
        return ModuleCall((f"stabilization_{function}",), STATE_PLACES, ((place, (count,)),))(*state)[0]

    def least_change(self, t: Any, q: Any, v: Any, residual: Any, count: int) -> Array:
        if jnp.shape(residual) != (count,):
            raise ValueError(f"the residual must have the shape {(count,)}, not {jnp.shape(residual)}")
        if not count:
            return jnp.zeros(self.n)
        given = jnp.concatenate([jnp.asarray(residual, float), jnp.zeros(self.rows - count)])
        factor = "stabilization_factor" + ("_positions" if count < self.rows else "")
        call = ModuleCall((factor, "stabilization_solve"), (*STATE_PLACES, "at_b"), (("at_x", (self.n,)),), len(STATE_PLACES))
        return call(t, q, v, given)[0]


@dataclass(frozen=True)
class OwnText:
    """One method of a stabilization: `text(stabilization, t, q, v, h, a, equations)` returns two arrays (n,)."""

    own: OwnObject
    text: Callable[..., Any]
    sizes: ModuleEquations

    def evaluate(self, t: Any, q: Any, v: Any, h: Any, a: Any, numbers: Any, *_: Any) -> Any:
        found = self.text(self.own.filled(numbers), t, q, v, h, a, self.sizes)
        found = tuple(jnp.asarray(x, float) for x in found)
        if [x.shape for x in found] != 2 * [q.shape]:
            raise ValueError(f"a stabilization must return two arrays of the shape {q.shape}")
        return found

    @property
    def inputs(self) -> dict[str, tuple[int, ...]]:
        """The shapes of the inputs of the lowered function, by name.

        They are the arguments of `evaluate`, and the places "at_..." of the arguments and results of calls.
        """
        n, m, size = self.sizes.n, self.sizes.rows, sum(self.own.sizes)
        given = {"t": (), "q": (n,), "v": (n,), "h": (), "a": (n,), "numbers": (size,)}
        of_calls = {"t": (), "q": (n,), "v": (n,), "b": (m,), "psi": (self.sizes.position_rows,), "rate": (m,), "x": (n,)}
        return given | {f"at_{name}": shape for name, shape in of_calls.items()}

    def written(self, width: int = 1) -> Written:
        """Return the lowered function for `width` lanes."""
        return written(self, tuple(Input(name, shape) for name, shape in self.inputs.items()), width, (self.text, self.sizes))


@dataclass(frozen=True)
class StabilizationCode:
    """The code of a user-defined stabilization: that of the methods it overrides; None for the others."""

    rates: OwnText | None
    end_of_step: OwnText | None
    number_count: int

    @classmethod
    def of(cls, stabilization: Any, methods: Mapping[str, Callable[..., Any]], code: RunPrograms) -> "StabilizationCode":
        """Return the machine code of a stabilization for the programs of a scene or a system.

        Raises:
            UnsupportedError: a method uses an operation without machine code; the message names it.
        """
        sizes = ModuleEquations(code.coordinate_count, code.row_count, code.position_rows, not code.couples)
        with named("stabilization", stabilization):
            own = OwnObject.of(stabilization)
            texts = {name: OwnText(own, text, sizes) for name, text in methods.items()}
            for text in texts.values():
                text.written()
        return cls(texts.get("rates"), texts.get("end_of_step"), sum(own.sizes))

    @property
    def methods(self) -> list[OwnText]:
        """The methods that the stabilization overrides."""
        return [x for x in (self.rates, self.end_of_step) if x is not None]

    @property
    def slips(self) -> bool:
        """True if the stabilization integrates positions at rates q' other than v."""
        return self.rates is not None and self.rates.written().unchanged[0] != list(self.rates.inputs).index("v")

    @property
    def numbers(self) -> list[str]:
        """The names of the settings that hold the numbers of the stabilization."""
        return [f"stabilization number {k}" for k in range(self.number_count)]

    @property
    def settings(self) -> tuple[str, ...]:
        """The names of all settings of the stabilization: the threshold of the rank of rows, then its numbers."""
        return (TOL_SETTING, *self.numbers)

    def settings_of(self, stabilization: Any, tol: Any) -> dict[str, Any]:
        """Return the settings by name: `tol`, the threshold of the rank of rows, and the numbers of a stabilization."""
        numbers = [number for x in numbers_of(stabilization) for number in x.reshape(-1)]
        return {TOL_SETTING: tol, **dict(zip(self.numbers, numbers, strict=True))}


class OwnStabilization:
    """The writer of the functions of a stabilization in a module, and of the functions that its methods call.

    stabilize_rates(work, a, slip)    replace the accelerations at the place `a` by the rates v' at the state, and store q' - v
                                      at the place `slip`
    stabilize_end(work)               replace the state at the end of a step by that from which the next step starts
    """

    arrays: ClassVar = ("psi_q", "root")
    shared: ClassVar = ("couplings", "rows")

    def __init__(self, module: Module, code: StabilizationCode, accelerations: AccelerationPart):
        self._in, self.code, self._accelerations = module, code, accelerations
        self._written = [x.written(module.plan.width) for x in code.methods]
        programs = {"rate": "psi_dot", "factor": "dense_newton_q", "factor_positions": "dense_newton_q", "mass": "dense_newton_q"}
        self.programs = list(dict.fromkeys(x for name, x in programs.items() if self._calls(name)))

    def _calls(self, name: str) -> bool:
        return any(x.calls(f"stabilization_{name}") for x in self._written)

    def reserve(self):
        """Reserve memory, also for the factors of the rows A if a method asks for least changes."""
        module, method = self._in, self.code.methods[0] if self.code.methods else None
        for name, shape in method.inputs.items() if method else ():
            module.places.add(f"stabilization {name}", math.prod(shape) or 1)
        if self._written:
            module.places.add("stabilization scratch", max(x.size for x in self._written))
        self._rows = None
        if self._calls("solve"):
            self._rows = WeightedRows(module, HouseholderCode(relative=True), prefix="least_change", tol=TOL_SETTING)

    # --- functions

    def write(self):
        """Write the functions of the overridden methods, and those that they call."""
        if self._rows is not None:
            self._rows.write()
        module = self._in
        of_name: dict[str, Callable[[Function], None]] = {
            "psi": lambda f: self._rows_of(f, "psi", "at_psi", module.code.position_rows),
            "rate": lambda f: self._rows_of(f, "psi_dot", "at_rate", module.m),
            "factor": lambda f: self._factor(f, False),
            "factor_positions": lambda f: self._factor(f, True),
            "accelerate": self._accelerate,
            "mass": self._mass,
        }
        for name, write in of_name.items():
            if self._calls(name):
                f, s = module.function(f"stabilization_{name}")
                self._enter(f, s, "at_")
                write(f)
        if self._rows is not None:
            self._solve(module.function("stabilization_solve")[0])
        if self.code.rates is not None:
            self._write_rates()
        if self.code.end_of_step is not None:
            self._write_end()

    def _place(self, name: str) -> str:
        return f"stabilization {name}"

    def _enter(self, f: Function, s: Lane, prefix: str):
        """Set the state (t, q, v) of the module to that at the places whose names begin with `prefix`."""
        setattr(s, "state t", getattr(s, self._place(f"{prefix}t")))
        for x in "qv":
            self._in.copy(f, self._place(prefix + x), f"state {x}")

    def _rows_of(self, f: Function, program: str, to: str, count: int):
        module = self._in
        module.invoke(f, program)
        with f.each(count) as i:
            module.put_entry(f, self._place(to), i, module.entry(f, "psi", i))

    def _factor(self, f: Function, of_positions: bool):
        assert self._rows is not None
        self._in.invoke(f, "dense_newton_q")
        self._rows.factor(f, of_positions)

    def _solve(self, f: Function):
        assert self._rows is not None
        x, to = self._rows.solve(f, self._place("at_b")), self._place("at_x")
        with f.each(self._in.n) as i:
            self._in.put_entry(f, to, i, f.const(0.0, DOUBLE, f.width))
        self._rows.correct(f, x, to, to, 1.0)

    def _accelerate(self, f: Function):
        self._accelerations.accelerate(f, self._place("at_x"))
        self._accelerations.check_pivots(f, Lane(f, self._in.places), self._place("at_x"))

    def _mass(self, f: Function):
        module = self._in
        module.invoke(f, "dense_newton_q")
        with f.each(module.n) as i:
            root = module.entry(f, "root", i)
            module.put_entry(f, self._place("at_x"), i, 1.0 / (root * root))

    def _run(self, f: Function, s: Lane, method: OwnText, a: Value | None) -> Callable[[int, Value], Value]:
        """Call a method at the state, which is the same afterwards.

        `a`: the place of the accelerations that the method receives; None: it receives none.

        Returns:
            A function of k and i that reads entry i of the k-th result.
        """
        module, width = self._in, f.width
        begins = s.begin > 0.5
        setattr(s, self._place("t"), getattr(s, "state t"))
        for x in "qv":
            module.copy(f, f"state {x}", self._place(x))
        setattr(s, self._place("h"), f.select(begins, f.const(1.0, DOUBLE, width), s.step))
        if a is not None:
            with f.each(module.n) as i:
                module.put_entry(f, self._place("a"), i, f.load(f.given["work"], a + i * width, width))
        for k, name in enumerate(self.code.numbers):
            module.put_entry(f, self._place("numbers"), k, module.entry(f, name))
        kept = {name: getattr(s, name) for name in ("distance", "safe")}
        places = [f.const(module.start(self._place(name), "work"), INT) for name in (*method.inputs, "scratch")]
        method.written(width).function.call_in(f, f.given["work"], *places)
        self._enter(f, s, "")
        for name, value in kept.items():
            setattr(s, name, value)
        return lambda k, i: module.entry(f, self._place("scratch"), i + k * module.n)

    def _write_rates(self):
        module, (f, s) = self._in, self._in.function("stabilize_rates", [("ptr", "work"), (INT, "a"), (INT, "slip")])
        assert self.code.rates is not None
        found, work, a, width = self._run(f, s, self.code.rates, f.given["a"]), f.given["work"], f.given["a"], f.width
        steps = s.begin < 0.5
        with f.each(module.n) as i:
            old = f.load(work, a + i * width, width)
            f.store(f.select(steps, found(1, i), old), work, a + i * width, width)
            if self.code.slips:
                slip = f.select(steps, found(0, i) - module.entry(f, "state v", i), 0.0)
                f.store(slip, work, f.given["slip"] + i * width, width)

    def change_rates(self, f: Function, a: str, slip: str):
        """Replace the accelerations in the array `a` by the rates v' of the stabilization at the state; `slip` becomes q' - v."""
        if self.code.rates is not None:
            places = (f.const(self._in.start(x, "work") if x in self._in.places.places else 0, INT) for x in (a, slip))
            f.call("stabilize_rates", f.given["work"], *places)

    def _write_end(self):
        module, (f, s) = self._in, self._in.function("stabilize_end")
        assert self.code.end_of_step is not None
        found, moves = self._run(f, s, self.code.end_of_step, None), (s.begin < 0.5) & (s.stepping > 0.5)
        with f.each(module.n) as i:
            for k, x in enumerate("qv"):
                module.put_entry(f, f"state {x}", i, f.select(moves, found(k, i), module.entry(f, f"state {x}", i)))

    def end_step(self, f: Function):
        """Change the state at the end of a step to that from which the stabilization starts the next step."""
        if self.code.end_of_step is not None:
            f.call("stabilize_end", f.given["work"])
