"""Graphs of scalar expressions, recorded once: what is structurally zero vanishes, what is repeated is computed once."""

from udkjax.expressions.differential import Differential as Differential
from udkjax.expressions.differential import cotangents as cotangents
from udkjax.expressions.differential import tangents as tangents
from udkjax.expressions.emit import Program as Program
from udkjax.expressions.emit import frontier as frontier
from udkjax.expressions.emit import operations as operations
from udkjax.expressions.graph import Graph as Graph
from udkjax.expressions.graph import Scalar as Scalar
from udkjax.expressions.read import read as read
from udkjax.expressions.read import trace as trace
