"""Identification of a mechanism's parameters from measured motion.

records/           measurements, from files and tables
problem/           unknowns, predictions, and residuals with their Jacobian in blocks of rows
search/            minimization, and the search for the global minimum
answers/           the estimate, its uncertainty, and gradient checks
identification     the public function
"""

from udkjax.positions.assembling.channels import Quantity as Quantity
from udkjax.study.identify.answers.estimate import Estimate as Estimate
from udkjax.study.identify.answers.gradient_agreement import GradientCheck as GradientCheck
from udkjax.study.identify.answers.gradient_check import check_gradients as check_gradients
from udkjax.study.identify.identification import identify as identify
from udkjax.study.identify.problem.parameters import Parameter as Parameter
from udkjax.study.identify.problem.parameters import length as length
from udkjax.study.identify.records.records import IdentificationError as IdentificationError
from udkjax.study.identify.records.records import Record as Record
from udkjax.study.identify.records.records import Start as Start
