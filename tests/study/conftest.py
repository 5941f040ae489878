"""What tests of progress write to."""

import pytest


class Stream(list):
    def __init__(self, terminal):
        self.terminal = terminal

    def isatty(self):
        return self.terminal

    def write(self, text):
        self.append(text)

    def flush(self):
        pass

    @property
    def text(self):
        return "".join(self)


class Notebook(Stream):
    __module__ = "ipykernel.iostream"


@pytest.fixture
def streams():
    """Makes what stands for a terminal, or for a file."""
    return Stream


@pytest.fixture
def notebook():
    return Notebook(False)
