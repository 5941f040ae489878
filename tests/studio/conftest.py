import asyncio
import json
from types import SimpleNamespace

import pytest

from tests.studio.browsing import served, studio_page

PORT, TOKEN = 8123, "a-token-of-a-test"
BASE = f"http://127.0.0.1:{PORT}"


class HereWorker:
    """A worker that runs its tasks in this process."""

    def call(self, name, arguments, seconds):
        from udkjax.studio import tasks

        return json.loads(json.dumps(getattr(tasks, name)(**arguments), allow_nan=False))


class Answer:
    """The answer of a server."""

    def __init__(self, messages):
        start, *parts = messages
        self.status_code = start["status"]
        self.headers = {key.decode(): value.decode() for key, value in start["headers"]}
        self.text = b"".join(part["body"] for part in parts if part["type"] == "http.response.body").decode()

    def json(self):
        return json.loads(self.text)


def exchange(app, method, path, parts, headers):
    """Send a request to an ASGI application, its body in parts, and return the answer."""
    messages, left = [], list(parts)

    async def receive():
        body = left.pop(0) if left else b""
        return {"type": "http.request", "body": body, "more_body": bool(left)}

    async def send(message):
        messages.append(message)

    raw = [(key.encode(), value if isinstance(value, bytes) else value.encode()) for key, value in headers.items()]
    scope = {"type": "http", "asgi": {"version": "3.0"}, "http_version": "1.1", "method": method, "scheme": "http", "path": path}
    scope |= {"raw_path": path.encode(), "query_string": b"", "root_path": "", "headers": raw, "server": ("127.0.0.1", PORT)}
    asyncio.run(app(scope | {"client": ("127.0.0.1", 1)}, receive, send))
    return Answer(messages)


@pytest.fixture
def client(tmp_path):
    """Send requests to a studio in a temporary folder, by default as its own page does."""
    from udkjax.studio.application import Studio, application
    from udkjax.studio.folder import Folder

    worker = HereWorker()
    app = application(Studio(Folder(tmp_path), worker, worker, worker), PORT, TOKEN)  # pyright: ignore[reportArgumentType]

    def send(method, path, content=b"", headers=None, without=()):
        given = {"host": f"127.0.0.1:{PORT}", "x-studio-token": TOKEN, "origin": BASE, "content-type": "application/json"}
        given = {key: value for key, value in (given | (headers or {})).items() if key not in without}
        parts = [content] if isinstance(content, bytes) else content
        return exchange(app, method, path, parts, given)

    def ask(route, _headers=None, _without=(), **request):
        return send("POST", f"/api/{route}", json.dumps(request).encode(), _headers, _without)

    return SimpleNamespace(send=send, ask=ask, folder=tmp_path)


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    """Serve a studio in a new folder; the fixture is its address and the folder."""
    folder = tmp_path_factory.mktemp("drawings")
    with served(folder) as address:
        yield address, folder


@pytest.fixture
def studio(browser, server):
    """Open the page of the module's studio."""
    with studio_page(browser, *server) as page:
        yield page
