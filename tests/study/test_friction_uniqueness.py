"""`diagnose` says where friction depends on loads that equilibrium does not determine."""

import pytest

import udkjax as udk
from tests.friction import rubbing

pytestmark = pytest.mark.slow


def test_parallelogram_is_not_unique():
    """The loads in its pins are shared by redundant constraints, and with them its accelerations."""
    diagnosis = udk.diagnose(rubbing(udk.library.parallelogram()), fixes=False, walk=False)
    assert any(not x.accelerations for x in diagnosis.friction.values())
    assert "not unique, nor are the accelerations" in str(diagnosis)


def test_four_bar_is_unique():
    diagnosis = udk.diagnose(rubbing(udk.library.four_bar()), fixes=False, walk=False)
    assert all(x.load and x.accelerations for x in diagnosis.friction.values())
    assert "all loads are unique" in str(diagnosis)
