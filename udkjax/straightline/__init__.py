"""Straight-line programs: scalar expressions recorded once, with everything that is structurally zero or repeated left out."""

from udkjax.straightline.derivative import Differential as Differential
from udkjax.straightline.derivative import cotangents as cotangents
from udkjax.straightline.derivative import tangents as tangents
from udkjax.straightline.emit import Program as Program
from udkjax.straightline.emit import frontier as frontier
from udkjax.straightline.emit import operations as operations
from udkjax.straightline.graph import Graph as Graph
from udkjax.straightline.graph import Scalar as Scalar
from udkjax.straightline.read import read as read
from udkjax.straightline.read import trace as trace
