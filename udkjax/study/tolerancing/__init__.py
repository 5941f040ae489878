"""Tolerances of dimensions: how far a mechanism deviates if its numbers do, and how often it stays within limits.

dimensions   numbers with tolerances and clearances, and their values in samples
measures     measures of samples: positions over a drive by machine code, or a function of the mechanism
cheapest     the tolerances of least cost with a yield
tolerances   the public function, and its result
"""

from udkjax.study.tolerancing.tolerances import ToleranceAnalysis as ToleranceAnalysis
from udkjax.study.tolerancing.tolerances import tolerances as tolerances
