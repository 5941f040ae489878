"""Files of a sweep are complete, written once, and never mixed with those of another sweep."""

import json
import os
import signal
import subprocess
import sys

import numpy as np
import pytest

from udkjax.study.sweep import store
from udkjax.study.sweep.plan import Chunk
from udkjax.study.sweep.store import FolderStore, MemoryStore, StoreError, open_store, read_variable, write_whole

FINGERPRINT = {"settings": {"rtol": 1e-8}, "scene": "format = 1\nmass = 1.0\n", "axes": [1.0, 2.0, float("nan")]}


def chunk(index, members):
    return Chunk(index, 0, np.array(members), 6.0)


CHUNKS = [chunk(0, [4, 1]), chunk(1, [0, 5]), chunk(2, [3, 2])]


def data(chunk):
    return {"result": np.zeros(len(chunk.members), int), "q": np.sqrt(chunk.members[:, None] + np.arange(3.0))}


def not_done(stored):
    return [c for c in CHUNKS if not np.isin(c.members, read_variable(stored, "result")[0]).all()]


def collected(stored):
    """Return everything that is finished, by member."""
    return {int(m): d["q"][k].tolist() for members, d in stored.read_chunks() for k, m in enumerate(members)}


def files(folder):
    return sorted((folder / "chunks").iterdir())


@pytest.mark.parametrize("place", ["folder", None])
def test_what_is_finished_is_left_out_and_given_back(tmp_path, place):
    out = place and tmp_path / place
    with open_store(out, FINGERPRINT) as stored:
        assert not_done(stored) == CHUNKS
        stored.write(CHUNKS[1], data(CHUNKS[1]))
        assert not_done(stored) == [CHUNKS[0], CHUNKS[2]]
        done, codes = read_variable(stored, "result")
        np.testing.assert_array_equal(done, [0, 5])
        np.testing.assert_array_equal(codes, [0, 0])
        ((members, found),) = stored.read_chunks()
        np.testing.assert_array_equal(members, [0, 5])
        assert {name: values.dtype.kind for name, values in found.items()} == {"result": "i", "q": "f"}
        np.testing.assert_array_equal(found["q"], data(CHUNKS[1])["q"])
    assert isinstance(stored, MemoryStore if place is None else FolderStore)


def test_what_is_kept_may_have_any_name(tmp_path):
    given = {name: np.array([k, 2 * k]) for k, name in enumerate(("file", "members", "allow_pickle", "stored/x", "a b"))}
    with FolderStore(tmp_path, FINGERPRINT) as stored:
        stored.write(CHUNKS[0], given)
        ((members, found),) = stored.read_chunks()
    np.testing.assert_array_equal(members, CHUNKS[0].members)
    assert {name: values.tolist() for name, values in found.items()} == {name: v.tolist() for name, v in given.items()}


@pytest.mark.parametrize(
    "damage", [lambda content: content[:-1], lambda content: b"", lambda content: content[:40] + b"\1" + content[41:]]
)
def test_a_damaged_chunk_is_computed_again_and_no_other(tmp_path, damage):
    with FolderStore(tmp_path, FINGERPRINT) as stored:
        for c in CHUNKS:
            stored.write(c, data(c))
        whole = collected(stored)
        broken = files(tmp_path)[1]
        broken.write_bytes(damage(broken.read_bytes()))
    with FolderStore(tmp_path, FINGERPRINT) as stored:
        with pytest.warns(UserWarning, match=f"{broken.name} is damaged"):
            left = not_done(stored)
        assert left == [CHUNKS[1]]
        stored.write(left[0], data(left[0]))
        assert collected(stored) == whole


def test_another_sweep_is_refused_and_the_difference_spelled_out(tmp_path):
    with FolderStore(tmp_path, {"settings": "of a sweep that finished no chunk"}):
        pass
    with FolderStore(tmp_path, FINGERPRINT) as stored:
        stored.write(CHUNKS[0], data(CHUNKS[0]))
    before = (tmp_path / "sweep.json").read_bytes()
    other = {"settings": {"rtol": 1e-9}, "scene": "format = 1\nmass = 2.0\n", "axes": [1.0, 2.5, float("nan")]}
    with pytest.raises(StoreError) as caught:
        FolderStore(tmp_path, other)
    for line in (
        "settings.rtol: was 1e-08, is now 1e-09",
        "scene: was mass = 1.0",
        "scene: is mass = 2.0",
        "axes[1]: was 2.0, is now 2.5",
    ):
        assert line in str(caught.value)
    assert "format = 1" not in str(caught.value) and "axes[2]" not in str(caught.value)
    assert (tmp_path / "sweep.json").read_bytes() == before
    with FolderStore(tmp_path, FINGERPRINT):  # which gave the lock back
        pass


@pytest.mark.parametrize("damage", [b"", b"{", b"[1]", b"\xff\xfe{", b"[" * 100_000, None])
def test_a_damaged_description_is_made_again_where_all_chunks_are_of_the_sweep(tmp_path, damage):
    with FolderStore(tmp_path, FINGERPRINT) as stored:
        for c in CHUNKS:
            stored.write(c, data(c))
        whole, description = collected(stored), (tmp_path / "sweep.json").read_bytes()

    def spoil():
        (tmp_path / "sweep.json").unlink()
        if damage is not None:
            (tmp_path / "sweep.json").write_bytes(damage)

    spoil()
    with FolderStore(tmp_path, FINGERPRINT) as stored:
        assert collected(stored) == whole
    assert (tmp_path / "sweep.json").read_bytes() == description
    spoil()
    files(tmp_path)[0].write_bytes(b"")  # a damaged chunk is of no sweep
    with FolderStore(tmp_path, FINGERPRINT) as stored, pytest.warns(UserWarning, match="is damaged"):
        assert not_done(stored) == [CHUNKS[0]]
    spoil()
    with pytest.raises(StoreError, match=r"sweep\.json is (damaged|missing).* chunks of another sweep.*choose another folder"):
        FolderStore(tmp_path, FINGERPRINT | {"scene": "another"})


def test_what_is_no_file_is_named(tmp_path):
    (tmp_path / "sweep.json").mkdir()
    with pytest.raises(StoreError, match="cannot write to the folder"):
        FolderStore(tmp_path, FINGERPRINT)
    (tmp_path / "sweep.json").rmdir()
    with FolderStore(tmp_path, FINGERPRINT) as stored, pytest.raises(StoreError, match=r"0\.npz.*remove it"):
        (tmp_path / "chunks" / "0.npz").mkdir()
        list(stored.read_chunks())
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match="cannot write to the folder"):
        FolderStore(tmp_path / "file", FINGERPRINT)


def test_two_processes_do_not_write_the_same_sweep(tmp_path):
    code = (
        "import os, sys; from filelock import FileLock; from pathlib import Path\n"
        "lock = FileLock(Path(sys.argv[1]) / 'lock'); lock.acquire()\n"
        "(Path(sys.argv[1]) / 'writer').write_text(f'process {os.getpid()} on this machine')\n"
        "print('taken', flush=True); sys.stdin.read()"
    )
    words = [sys.executable, "-c", code, str(tmp_path)]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout and other.stdout.readline() == "taken\n"
        with pytest.raises(StoreError, match=f"process {other.pid} on .* is writing to "):
            FolderStore(tmp_path, FINGERPRINT)
        other.send_signal(signal.SIGKILL)
    with FolderStore(tmp_path, FINGERPRINT), pytest.raises(StoreError, match=f"process {os.getpid()} on .* is writing to "):
        FolderStore(tmp_path, FINGERPRINT)


def test_what_was_being_written_when_the_process_died_is_removed(tmp_path):
    with FolderStore(tmp_path, FINGERPRINT) as stored:
        stored.write(CHUNKS[0], data(CHUNKS[0]))
    torn = tmp_path / "chunks" / f"000001-abc.npz.123{store.UNFINISHED_SUFFIX}"
    torn.write_bytes(b"half")
    with FolderStore(tmp_path, FINGERPRINT) as stored:
        assert not torn.exists()
        assert not_done(stored) == CHUNKS[1:]


def test_the_manifest_says_what_the_sweep_is(tmp_path):
    with FolderStore(tmp_path, FINGERPRINT):
        pass
    said = json.loads((tmp_path / "sweep.json").read_text())
    assert said["settings"] == {"rtol": 1e-8} and said["scene"] == FINGERPRINT["scene"]


def test_a_file_that_cannot_be_written_to_its_end_is_not_there(tmp_path):
    """With a limit on the size of files, which the system enforces in the middle of a write."""
    write_whole(tmp_path / "a", b"before")
    code = (
        "import resource, signal, sys; from pathlib import Path; from udkjax.study.sweep.store import write_whole\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN); resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))\n"
        "write_whole(Path(sys.argv[1]), b'x' * 5000)"
    )
    ran = subprocess.run([sys.executable, "-c", code, str(tmp_path / "a")], capture_output=True, text=True, check=False)
    assert "File too large" in ran.stderr
    assert [f.name for f in tmp_path.iterdir()] == ["a"] and (tmp_path / "a").read_bytes() == b"before"
