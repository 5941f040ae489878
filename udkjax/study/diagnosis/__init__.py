"""What depends on what in a mechanism, what to do about it, and where its rank changes."""

from udkjax.study.diagnosis.diagnose import diagnose as diagnose
from udkjax.study.diagnosis.diagnosis import Diagnosis as Diagnosis
