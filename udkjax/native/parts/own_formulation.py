"""A user-defined formulation (`udkjax.equations.PointwiseFormulation`), written in jax.numpy, as machine code."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp

from udkjax.native.code import processor
from udkjax.native.lowering.own_objects import Input, OwnObject, Written, named, written
from udkjax.native.module.module import Module
from udkjax.native.parts.formulations import MASS_SETTING, FormulatedAccelerations, FormulationCode, ScaledAccelerations
from udkjax.native.pseudoinverses.dense import DenseLayout, DenseMatrices, MatrixRow

_TRIAL_SHAPE = (2, 3)  # the numbers of rows and coordinates by which the operations of a formulation are looked at


@dataclass(frozen=True)
class OwnFormulationCode(FormulationCode):
    """A user-defined formulation, lowered to machine code; the numbers in its arrays are settings of the run."""

    own: OwnObject

    needs_diagonal_mass = True

    @classmethod
    def of(cls, formulation: Any) -> "OwnFormulationCode":
        """Return the machine code of a formulation.

        Raises:
            UnsupportedError: the formulation uses an operation without machine code; the message names it.
        """
        with named("formulation", formulation):
            code = cls(OwnObject.of(formulation))
            code.written(*_TRIAL_SHAPE)
        return code

    @property
    def settings(self) -> tuple[str, ...]:
        return (MASS_SETTING, *number_names(sum(self.own.sizes)))

    def prepare(self, module: Module) -> FormulatedAccelerations:
        return OwnAccelerations(module, self)

    def evaluate(self, mass: Any, F: Any, A: Any, c: Any, numbers: Any) -> Any:
        """Return the accelerations (n,) that the user's `solve` computes, from the diagonal `mass` of M, F, A and c.

        `numbers`: the numbers in the arrays of the formulation, one after another. Inputs "D" and "b" of `written` are A and c.
        """
        n = len(F)
        a = self.own.filled(numbers).solve(jnp.where(jnp.eye(n, dtype=bool), mass, 0.0), F, A, c)
        if a.shape != (n,):
            raise ValueError(f"solve(M, F, A, c) must have the shape {(n,)}, not {a.shape}")
        return a

    def written(self, m: int, n: int, width: int = 1, stride: int | None = None) -> Written:
        """Return the lowered function `evaluate` for m rows, n coordinates and `width` lanes.

        `stride`: the distance between the beginnings of two rows of A, in numbers; None: that of a single member.
        """
        stride = -(-n // processor.lanes()) * processor.lanes() if stride is None else stride
        shapes = {"mass": (n,), "force": (n,), "D": (m, n), "b": (m,), "numbers": (sum(self.own.sizes),)}
        inputs = [Input(name, shape, stride if name == "D" else None) for name, shape in shapes.items()]
        return written(self, tuple(inputs), width)


class OwnAccelerations(ScaledAccelerations):
    """The writer of accelerations by a user-defined formulation, from M, F = M a_F, A and c = b + A a_F."""

    def __init__(self, module: Module, code: OwnFormulationCode):
        m, n, self._code = module.m, module.n, code
        self._numbers = code.settings[1:]
        vectors = {"mass": n, "force": n, "free": n, "numbers": len(self._numbers), "scratch": code.written(m, n).size}
        super().__init__(module, DenseLayout(module, {name: (1, k) for name, k in vectors.items()}, (m, n), "own formulation"))

    def solve(self, d: DenseMatrices) -> MatrixRow:
        f, x, c, free = d.f, d.row("x"), d.row("b"), d.row("free")
        free.clear()
        with f.each(d.n) as i:
            mass = self.mass(f, i)
            free.put(i, self._array(f, "terms", i) * self._array(f, "inverse unit", i))
            d.row("mass").put(i, mass)
            d.row("force").put(i, mass * free.entry(i))
        with f.each(d.m) as i:
            d.row("D", i).clear()
        for row, column, value in self.each_entry(f):
            d.row("D", row).put(column, value)
        with f.each(d.m) as i:
            c.put(i, self.right(f, i) + d.dot(d.row("D", i), free))
        for k, name in enumerate(self._numbers):
            d.row("numbers").put(k, self._array(f, name))
        found = self._code.written(d.m, d.n, f.width, d.row("D").registers * d.vector // f.width)
        function = found.within(d.columns("scratch"))
        function.call_in(f, *(d.row(name).address for name in ("mass", "force", "D", "b", "numbers", "scratch")))
        with f.each(d.n) as i:
            x.put(i, d.row("scratch").entry(i) - free.entry(i))
        return x


def number_names(count: int) -> Sequence[str]:
    """Return the names of the settings that hold the `count` numbers of a user-defined formulation."""
    return [f"formulation number {k}" for k in range(count)]
