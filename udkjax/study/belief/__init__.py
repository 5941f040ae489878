"""Posteriors of parameters: from a mechanism, records and priors to a density, and to draws from it.

inference   the public function that returns the density
chains      Hamiltonian Monte Carlo: chunks of draws of all chains, and their tuning
sampling    the public function that draws, `sample`, with its store
posterior   the draws, their summary, and the data for ArviZ
comparison  the public function that compares models, `compare`
experiment_design  the public function that chooses the next experiment, by an estimate or by draws
"""

from udkjax.study.belief.comparison import Comparison as Comparison
from udkjax.study.belief.comparison import compare as compare
from udkjax.study.belief.experiment_design import Candidate as Candidate
from udkjax.study.belief.experiment_design import Design as Design
from udkjax.study.belief.experiment_design import design_experiment as design_experiment
from udkjax.study.belief.inference import inference as inference
from udkjax.study.belief.posterior import Posterior as Posterior
from udkjax.study.belief.sampling import sample as sample
from udkjax.study.identify.density.log_density import InferenceProblem as InferenceProblem
