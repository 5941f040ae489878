"""Files that are whole, or not there."""

import subprocess
import sys

import numpy as np

from udkjax.study.sweep import store as disk
from udkjax.study.sweep.store import pack, unpack, write_whole


def test_an_archive_with_any_bit_changed_or_cut_off_is_none(tmp_path):
    content = pack({"q": np.arange(3.0)})
    np.testing.assert_array_equal((unpack(content) or {})["q"], np.arange(3.0))
    for place in range(len(content)):
        damaged = bytearray(content)
        damaged[place] ^= 1 << place % 8
        assert unpack(bytes(damaged)) is None
        assert unpack(content[:place]) is None
    (tmp_path / "chunk.npz").write_bytes(content)  # which anyone can read
    np.testing.assert_array_equal(np.load(tmp_path / "chunk.npz")["q"], np.arange(3.0))


def test_a_file_that_cannot_be_written_to_its_end_is_not_there(tmp_path):
    """With a limit on the size of files, which the system enforces in the middle of a write."""
    write_whole(tmp_path / "a", b"before")
    code = (
        "import resource, runpy, signal, sys; from pathlib import Path\n"
        f"write_whole = runpy.run_path({disk.__file__!r})['write_whole']\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN); resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))\n"
        "write_whole(Path(sys.argv[1]), b'x' * 5000)"
    )
    ran = subprocess.run([sys.executable, "-c", code, str(tmp_path / "a")], capture_output=True, text=True, check=False)
    assert "File too large" in ran.stderr
    assert [f.name for f in tmp_path.iterdir()] == ["a"] and (tmp_path / "a").read_bytes() == b"before"
