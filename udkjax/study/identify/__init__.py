"""Identification: parameters of mechanisms, found from measured motion."""

from udkjax.study.identify.agreement import GradientCheck as GradientCheck
from udkjax.study.identify.channels import Quantity as Quantity
from udkjax.study.identify.errors import IdentificationError as IdentificationError
from udkjax.study.identify.estimate import Estimate as Estimate
from udkjax.study.identify.experiment import Candidate as Candidate
from udkjax.study.identify.experiment import Design as Design
from udkjax.study.identify.experiment import design_experiment as design_experiment
from udkjax.study.identify.identify import identify as identify
from udkjax.study.identify.parameters import Parameter as Parameter
from udkjax.study.identify.parameters import length as length
from udkjax.study.identify.records import Record as Record
from udkjax.study.identify.records import Start as Start
from udkjax.study.identify.trust import check_gradients as check_gradients
