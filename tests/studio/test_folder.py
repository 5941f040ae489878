"""Files of the studio's folder: never outside of it, written atomically, and never over a file that changed in the meantime."""

import os

import pytest

from udkjax.studio.folder import Folder, revision_of
from udkjax.studio.limits import RefusedError


@pytest.fixture
def folder(tmp_path):
    root = tmp_path / "root"
    (root / "sub").mkdir(parents=True)
    (tmp_path / "outside.toml").write_text("outside")
    (root / "a.toml").write_text("a")
    (root / "sub" / "b.toml").write_text("b")
    (root / "note.txt").write_text("note")
    (root / ".hidden.toml").write_text("hidden")
    (root / "link.toml").symlink_to(tmp_path / "outside.toml")
    (root / "away").symlink_to(tmp_path)
    return Folder(root)


def test_scene_files_below_are_listed_and_read(folder):
    assert folder.list() == ["a.toml", "sub/b.toml"]
    assert folder.read("sub/b.toml") == ("b", revision_of(b"b"))


OUTSIDE = ["../outside.toml", "sub/../../outside.toml", "/etc/hosts.toml", "away/outside.toml", "link.toml", "C:\\x.toml"]
NO_SCENES = [".hidden.toml", "note.txt", "a.toml\0", "", "sub", "nowhere/x.toml", "x" * 300 + ".toml", "~/x.toml:y.toml"]


@pytest.mark.parametrize("path", [*OUTSIDE, *NO_SCENES, "a.toml/x.toml", None, 3, ["a.toml"]])
def test_no_path_leads_out(folder, path):
    before = sorted(os.walk(folder.root.parent))
    for attempt in (lambda: folder.read(path), lambda: folder.write(path, b"x", None), lambda: folder.write(path, b"x", "r")):
        with pytest.raises(RefusedError):
            attempt()
    assert sorted(os.walk(folder.root.parent)) == before
    assert (folder.root.parent / "outside.toml").read_text() == "outside"


def test_a_saved_file_is_read_again(folder):
    text = 'name = "Pennestr\u00ec"\r\n'
    revision = folder.write("sub/new.toml", text.encode(), None)
    assert folder.read("sub/new.toml") == (text, revision)
    assert [name for name in os.listdir(folder.root / "sub") if name.startswith(".")] == []


def test_a_file_that_changed_on_disk_is_not_overwritten(folder):
    _, revision = folder.read("a.toml")
    (folder.root / "a.toml").write_text("changed by an editor")
    with pytest.raises(RefusedError, match="created or changed by another program") as caught:
        folder.write("a.toml", b"mine", revision)
    assert caught.value.status == 409
    assert (folder.root / "a.toml").read_text() == "changed by an editor"
    folder.write("a.toml", b"mine", caught.value.details["revision"])  # as after a question to the user
    assert (folder.root / "a.toml").read_text() == "mine"


def test_a_new_file_does_not_overwrite_an_existing_one(folder):
    with pytest.raises(RefusedError) as caught:
        folder.write("a.toml", b"mine", None)
    assert caught.value.status == 409
    assert (folder.root / "a.toml").read_text() == "a"


def test_a_deleted_file_is_reported(folder):
    _, revision = folder.read("a.toml")
    (folder.root / "a.toml").unlink()
    with pytest.raises(RefusedError, match="has been deleted since it was opened here"):
        folder.write("a.toml", b"mine", revision)


def test_permissions_stay(folder):
    os.chmod(folder.root / "a.toml", 0o640)
    folder.write("a.toml", b"mine", folder.read("a.toml")[1])
    assert (folder.root / "a.toml").stat().st_mode & 0o777 == 0o640


def test_a_failed_write_leaves_the_old_file(folder, monkeypatch):
    def broken(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", broken)
    with pytest.raises(RefusedError, match="No space"):
        folder.write("a.toml", b"mine", folder.read("a.toml")[1])
    assert (folder.root / "a.toml").read_text() == "a"
    assert folder.list() == ["a.toml", "sub/b.toml"]


def test_a_file_that_is_not_text_is_refused(folder):
    (folder.root / "a.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(RefusedError, match="UTF-8"):
        folder.read("a.toml")
