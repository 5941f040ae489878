"""Diagnosis of a mechanism: dependent constraints, fixes, and the configurations where its rank changes."""

from udkjax.study.diagnosis.diagnose import diagnose as diagnose
from udkjax.study.diagnosis.diagnosis import Diagnosis as Diagnosis
