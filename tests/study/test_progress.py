import os

from udkjax.study import progress
from udkjax.study.progress import Line, Progress


def test_progress_writes_over_itself_on_a_terminal_and_is_sparing_elsewhere(streams):
    terminal, file = streams(True), streams(False)
    for stream in (terminal, file):
        tell = Progress(stream)
        for k in range(11):
            tell(f"run {k}", k / 10)
    assert terminal.text.count("\r") == 11 and terminal.text.count("\n") == 1
    assert file.text.count("\n") == 2  # the first and the last
    assert "run 10 (100 %" in file.text and "left" not in file.text.splitlines()[-1]


def test_what_was_longer_is_covered_and_nothing_goes_on_in_the_next_line(monkeypatch, streams, notebook):
    monkeypatch.setattr(progress.shutil, "get_terminal_size", lambda: os.terminal_size((10, 24)))
    terminal = streams(True)
    for stream in (terminal, notebook):
        line = Line(stream)
        line.say("123456789012")
        line.say("abc", last=True)
    assert terminal.text == "\r123456789\rabc      \n"
    assert notebook.text == "\r123456789012\rabc         \n"
