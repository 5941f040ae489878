"""Tolerances of dimensions: how far a mechanism deviates if its numbers do, and how often it stays within limits.

dimensions   tolerances of numbers, clearances of pins, ISO grades; the numbers of samples
measures     measures of samples: positions over a drive by machine code, or a function of the mechanism
second_order mean, variance and shares without samples
cheapest     the tolerances of least cost with a yield
tolerances   the public function, and its result
"""

from udkjax.study.tolerancing.dimensions import PinClearance as PinClearance
from udkjax.study.tolerancing.dimensions import Tolerance as Tolerance
from udkjax.study.tolerancing.tolerances import ToleranceAnalysis as ToleranceAnalysis
from udkjax.study.tolerancing.tolerances import tolerances as tolerances
