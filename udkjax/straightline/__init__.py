"""Straight-line programs: scalar expressions recorded once, with everything that is structurally zero or repeated left out."""

from udkjax.straightline.barrier import cut as cut
from udkjax.straightline.branching import after as after
from udkjax.straightline.branching import apart as apart
from udkjax.straightline.branching import when as when
from udkjax.straightline.derivative import Differential as Differential
from udkjax.straightline.derivative import cotangents as cotangents
from udkjax.straightline.derivative import tangents as tangents
from udkjax.straightline.directions import along as along
from udkjax.straightline.emit import Program as Program
from udkjax.straightline.emit import along_elements as along_elements
from udkjax.straightline.emit import frontier as frontier
from udkjax.straightline.emit import operations as operations
from udkjax.straightline.fusion import Loop as Loop
from udkjax.straightline.graph import Graph as Graph
from udkjax.straightline.graph import Scalar as Scalar
from udkjax.straightline.read import read as read
from udkjax.straightline.read import trace as trace
from udkjax.straightline.vector import vector as vector
