import os

from udkjax.study import progress
from udkjax.study.progress import Line, Progress


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


def test_progress_writes_over_itself_on_a_terminal_and_is_sparing_elsewhere():
    terminal, file = Stream(True), Stream(False)
    for stream in (terminal, file):
        tell = Progress(stream)  # pyright: ignore[reportArgumentType]
        for k in range(11):
            tell(f"run {k}", k / 10)
    assert terminal.text.count("\r") == 11 and terminal.text.count("\n") == 1
    assert file.text.count("\n") == 2  # the first and the last
    assert "run 10 (100 %" in file.text and "left" not in file.text.splitlines()[-1]


def test_what_was_longer_is_covered_and_nothing_goes_on_in_the_next_line(monkeypatch):
    monkeypatch.setattr(progress.shutil, "get_terminal_size", lambda: os.terminal_size((10, 24)))
    terminal, notebook = Stream(True), Notebook(False)
    for stream in (terminal, notebook):
        line = Line(stream)  # pyright: ignore[reportArgumentType]
        line.say("123456789012")
        line.say("abc", last=True)
    assert terminal.text == "\r123456789\rabc      \n"
    assert notebook.text == "\r123456789012\rabc         \n"
