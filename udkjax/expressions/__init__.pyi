"""The door of `expressions`: the names that floors above import, each from its own module."""

from udkjax.expressions.complex_scalars import ComplexScalar as ComplexScalar
from udkjax.expressions.complex_scalars import solve_complex as solve_complex
from udkjax.expressions.differential import Differential as Differential
from udkjax.expressions.differential import SparseRow as SparseRow
from udkjax.expressions.differential import cotangents as cotangents
from udkjax.expressions.differential import tangents as tangents
from udkjax.expressions.elimination import SymbolicFactors as SymbolicFactors
from udkjax.expressions.graph import Graph as Graph
from udkjax.expressions.graph import Scalar as Scalar
from udkjax.expressions.jaxpr_reader import read_jaxpr as read_jaxpr
from udkjax.expressions.jaxpr_reader import trace as trace
from udkjax.expressions.kinks import smooth_pieces as smooth_pieces
from udkjax.expressions.loop_derivative import COTANGENT as COTANGENT
from udkjax.expressions.loop_derivative import FORWARD as FORWARD
from udkjax.expressions.loop_derivative import OTHER as OTHER
from udkjax.expressions.loop_derivative import PREFIXES as PREFIXES
from udkjax.expressions.loop_derivative import REVERSE as REVERSE
from udkjax.expressions.loop_derivative import SECOND as SECOND
from udkjax.expressions.loop_derivative import TANGENT as TANGENT
from udkjax.expressions.loop_derivative import TWICE as TWICE
from udkjax.expressions.loop_derivative import LoopDerivative as LoopDerivative
from udkjax.expressions.loop_program import ADD as ADD
from udkjax.expressions.loop_program import ALL as ALL
from udkjax.expressions.loop_program import MAXIMUM as MAXIMUM
from udkjax.expressions.loop_program import SET as SET
from udkjax.expressions.loop_program import Address as Address
from udkjax.expressions.loop_program import ArrayLoops as ArrayLoops
from udkjax.expressions.loop_program import Kernel as Kernel
from udkjax.expressions.loop_program import KernelLoop as KernelLoop
from udkjax.expressions.loop_program import KernelWriter as KernelWriter
from udkjax.expressions.loop_program import LoopProgram as LoopProgram
from udkjax.expressions.loop_program import Reset as Reset
from udkjax.expressions.scalar_program import ScalarProgram as ScalarProgram
from udkjax.expressions.scalar_program import frontier as frontier
from udkjax.expressions.scalar_program import operations as operations
from udkjax.expressions.selection import absolute as absolute
from udkjax.expressions.selection import greater as greater
from udkjax.expressions.selection import maximum as maximum
from udkjax.expressions.selection import where as where
from udkjax.expressions.unroll import ArrayPlace as ArrayPlace
from udkjax.expressions.unroll import Arrays as Arrays
from udkjax.expressions.unroll import unroll as unroll

__all__: list[str]
