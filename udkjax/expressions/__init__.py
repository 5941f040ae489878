"""Graphs of scalar expressions, recorded once: structural zeros vanish, and equal expressions are computed once."""

from udkjax.expressions.differential import Differential as Differential
from udkjax.expressions.differential import cotangents as cotangents
from udkjax.expressions.differential import tangents as tangents
from udkjax.expressions.graph import Graph as Graph
from udkjax.expressions.graph import Scalar as Scalar
from udkjax.expressions.jaxpr_reader import read_jaxpr as read_jaxpr
from udkjax.expressions.jaxpr_reader import trace as trace
from udkjax.expressions.scalar_program import ScalarProgram as ScalarProgram
from udkjax.expressions.scalar_program import frontier as frontier
from udkjax.expressions.scalar_program import operations as operations
