"""Posteriors of parameters: from a mechanism, records and priors to a density.

inference   the public function that returns the density
"""

from udkjax.study.belief.inference import inference as inference
from udkjax.study.identify.density.log_density import InferenceProblem as InferenceProblem
