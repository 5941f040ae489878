"""Bodies thrown onto floors, beams and into wedges: energy, pulls and depths, as in `python -m experiments properties`."""

import pytest

pytest.importorskip("experiments", reason="not in a source tree")

from experiments.parts.contact_properties import PROPERTIES, check_contacts
from experiments.parts.tally import Tally


@pytest.mark.slow
def test_contacts_of_thrown_bodies_neither_pull_nor_gain_energy_nor_are_penetrated():
    tally = Tally()
    check_contacts(tally, seed=0, members=64)
    assert not tally.left_out
    for name, promised in PROPERTIES.items():
        found = tally.found[name]
        assert found.cases > 200 and found.worst <= promised.tolerance, f"{name}: {found.worst:.1e} at {found.at}"
