"""Diagnosis of a mechanism: dependent constraints, changes that remove them, and configurations where the rank changes."""

from udkjax.study.diagnosis.diagnose import diagnose as diagnose
from udkjax.study.diagnosis.diagnosis import Diagnosis as Diagnosis
from udkjax.study.diagnosis.system_diagnosis import SystemDiagnosis as SystemDiagnosis
