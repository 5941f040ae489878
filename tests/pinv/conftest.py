"""A fixture for each method, and for matrices with exactly known pseudoinverses."""

import pytest

from tests.pinv.matrices import Exact, read_exact
from tests.pinv.methods import METHODS, Entry


@pytest.fixture(scope="session")
def exact() -> list[Exact]:
    return read_exact()


@pytest.fixture(scope="session", params=METHODS, ids=lambda entry: entry.name)
def entry(request) -> Entry:
    return request.param
