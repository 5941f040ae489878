"""Hostile requests: only the studio's own page on this machine gets answers."""

import json
import re
import socket
import subprocess
import sys
import urllib.request

import pytest

from tests.studio.conftest import BASE, PORT
from udkjax.studio.limits import MOST_BODY_BYTES

ROUTES = ("list", "open", "save", "compile", "diagnose")
SECRET = 'name = "do not show"\n'


@pytest.fixture
def secret(client):
    (client.folder / "secret.toml").write_text(SECRET)
    return client


def is_refused(client, answer, status):
    assert answer.status_code == status
    assert "do not show" not in answer.text
    assert sorted(p.name for p in client.folder.iterdir()) == ["secret.toml"]
    assert (client.folder / "secret.toml").read_text() == SECRET


@pytest.mark.parametrize("route", ROUTES)
@pytest.mark.parametrize(
    "host",
    [
        "evil.example",
        f"evil.example:{PORT}",
        "127.0.0.1",
        "127.0.0.1:80",
        f"127.0.0.1.evil.example:{PORT}",
        "",
        f"[::1]:{PORT}",
        f"0:{PORT}",
    ],
)
def test_another_host_is_refused(secret, route, host):
    is_refused(secret, secret.ask(route, {"host": host}, path="secret.toml", text="x"), 421)


def test_another_host_does_not_get_the_page_either(client):
    assert client.send("GET", "/", headers={"host": "evil.example"}).status_code == 421
    assert client.send("GET", "/", without=("origin", "x-studio-token", "content-type")).status_code == 200


@pytest.mark.parametrize("route", ROUTES)
@pytest.mark.parametrize(
    "origin", ["https://evil.example", "null", f"https://127.0.0.1:{PORT}", "http://127.0.0.1", f"{BASE}.evil.example"]
)
def test_another_origin_is_refused(secret, route, origin):
    is_refused(secret, secret.ask(route, {"origin": origin}, path="secret.toml", text="x"), 403)


@pytest.mark.parametrize("route", ROUTES)
def test_a_missing_origin_is_refused(secret, route):
    is_refused(secret, secret.ask(route, _without=("origin",), path="secret.toml", text="x"), 403)


@pytest.mark.parametrize("route", ROUTES)
@pytest.mark.parametrize("token", [None, "", "a-token-of-a-tesT", "a-token-of-a-test ", "a-token", "é"])
def test_a_missing_or_wrong_token_is_refused(secret, route, token):
    headers = {} if token is None else {"x-studio-token": token.encode()}
    without = ("x-studio-token",) if token is None else ()
    is_refused(secret, secret.ask(route, headers, without, path="secret.toml", text="x"), 401)


@pytest.mark.parametrize("route", ROUTES)
@pytest.mark.parametrize("kind", ["text/plain", "application/x-www-form-urlencoded", "multipart/form-data", ""])
def test_content_types_of_forms_are_refused(secret, route, kind):
    is_refused(secret, secret.ask(route, {"content-type": kind}, path="secret.toml", text="x"), 415)


@pytest.mark.parametrize("method", ["GET", "PUT", "DELETE", "OPTIONS", "HEAD", "PATCH"])
def test_other_methods_are_refused(secret, method):
    is_refused(secret, secret.send(method, "/api/open", json.dumps({"path": "secret.toml"}).encode()), 405)


HALF = b'{"path": "secret.toml", "text": "\\ud800"}'  # half of a surrogate pair


@pytest.mark.parametrize("route", ROUTES)
@pytest.mark.parametrize("body", [b"", b"[]", b"null", b"{", b"\xff", b'{"path": ' + b"[" * 100_000, b"NaN", HALF])
def test_bodies_that_are_not_objects_are_refused(secret, route, body):
    is_refused(secret, secret.send("POST", f"/api/{route}", body), 400)


def test_huge_bodies_are_refused(secret):
    is_refused(secret, secret.send("POST", "/api/save", b" " * (MOST_BODY_BYTES + 1)), 413)

    parts = [b" " * (MOST_BODY_BYTES // 10)] * 100  # without a declared length
    is_refused(secret, secret.send("POST", "/api/save", parts), 413)
    is_refused(secret, secret.send("POST", "/api/save", b"{}", {"content-length": str(MOST_BODY_BYTES + 1)}), 413)
    for length in ("-1", b"\xb2", "9" * 5000, "1e3", ""):  # a superscript two is a digit in Unicode; int() refuses long numbers
        is_refused(secret, secret.send("POST", "/api/save", b"{}", {"content-length": length}), 413)


@pytest.mark.parametrize(
    "path",
    [
        "/../pyproject.toml",
        "/%2e%2e/gate.py",
        "/player/../../gate.py",
        "/gate.py",
        "/player/page.py",
        "/secret.toml",
        "/engine/target.py",
    ],
)
def test_only_the_files_of_the_page_are_served(secret, path):
    assert secret.send("GET", path).status_code == 404


def test_every_answer_isolates_the_page(client):
    for answer in (client.send("GET", "/"), client.send("GET", "/nothing"), client.ask("list"), client.send("PUT", "/")):
        policy = answer.headers["content-security-policy"]
        assert "default-src 'none'" in policy and "unsafe-inline" not in policy and "'unsafe-eval'" not in policy
        assert "http" not in policy
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert answer.headers["referrer-policy"] == "no-referrer"
        assert "access-control-allow-origin" not in answer.headers


def test_the_page_names_no_other_address(client):
    page = client.send("GET", "/").text
    names = [name for name in re.findall(r"(?:src|href)=\"([^\"]+)\"", page) if not name.startswith("data:")]
    assert names
    for name in names:
        answer = client.send("GET", f"/{name.removeprefix('./')}")
        assert answer.status_code == 200, name
        assert not re.search(r"(?:from|import\() ?[\"']https?:", answer.text)


@pytest.mark.slow
def test_the_command_serves_only_this_machine_until_it_is_stopped(tmp_path):
    (tmp_path / "x.toml").write_text("format = 2\n")
    with subprocess.Popen(
        [sys.executable, "-c", "from udkjax.cli import main; main()", "studio", str(tmp_path / "x.toml"), "--no-browser"],
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            assert process.stdout is not None
            address = process.stdout.readline().strip()
            found = re.fullmatch(r"http://127\.0\.0\.1:(\d+)/#t=([\w-]{40,})&f=x\.toml", address)
            assert found, address
            port, token = int(found[1]), found[2]
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/") as page:
                assert b"<!doctype html>" in page.read(100)
            own = {"Origin": f"http://127.0.0.1:{port}", "X-Studio-Token": token, "Content-Type": "application/json"}
            request = urllib.request.Request(f"http://127.0.0.1:{port}/api/list", b"{}", own)
            with urllib.request.urlopen(request) as answer:
                assert json.load(answer)["files"] == ["x.toml"]
            others = {str(info[4][0]) for info in socket.getaddrinfo(socket.gethostname(), port, socket.AF_INET)} - {"127.0.0.1"}
            for other in others:
                with pytest.raises(OSError, match=r"refused|timed out|unreachable"):
                    socket.create_connection((other, port), 2).close()
        finally:
            process.terminate()
