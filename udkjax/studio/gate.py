"""The gate of the server: checks of every request, and security headers of every response.

A page of another site can reach a server on this machine in three ways: by DNS rebinding, a host name that it points here (so
Host is checked); by requests from its scripts or forms, CSRF (so Origin is checked, and the body must be JSON, which no form
sends); and by guesses (so each request to the interface needs a random token, in the fragment of the address, which browsers
never send).
"""

import hmac
import re
from collections.abc import Mapping

from starlette.datastructures import Headers
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from udkjax.studio.limits import MOST_BODY_BYTES, RefusedError

TOKEN_HEADER = "x-studio-token"
API_PREFIX = "/api/"
HOST_NAMES = ("127.0.0.1", "localhost")  # names of this machine
POLICY = (
    "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; style-src 'self'; img-src 'self' blob: data:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
HEADERS: Mapping[str, str] = {
    "content-security-policy": POLICY,
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-store",
}


class Gate:
    """ASGI middleware that refuses requests of other sites, and adds headers that isolate the page.

    Args:
        app: application that gets the accepted requests.
        port: port of the server, which is part of its Host and Origin.
        token: token that each request to the interface must carry.
    """

    def __init__(self, app: ASGIApp, port: int, token: str):
        self.app, self.token = app, token
        self.hosts = {f"{name}:{port}" for name in HOST_NAMES}
        self.origins = {f"http://{host}" for host in self.hosts}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            if scope["type"] == "lifespan":
                await self.app(scope, receive, send)
            return  # a WebSocket is not answered

        async def sent(message: Message) -> None:
            if message["type"] == "http.response.start":
                extra = [(key.encode(), value.encode()) for key, value in HEADERS.items()]
                message = {**message, "headers": [*message["headers"], *extra]}
            await send(message)

        try:
            body = None
            self._check(scope)
            if scope["path"].startswith(API_PREFIX):
                body = await _read(receive, Headers(scope=scope))
        except RefusedError as error:
            await JSONResponse({"problem": str(error)}, error.status)(scope, receive, sent)
            return
        await self.app(scope, receive if body is None else _Replay(body, receive), sent)

    def _check(self, scope: Scope) -> None:
        """Raise `RefusedError` if a request does not come from the studio's own page."""
        headers = Headers(scope=scope)
        hosts, origins = headers.getlist("host"), headers.getlist("origin")
        if len(hosts) != 1 or hosts[0].lower() not in self.hosts:
            raise RefusedError(421, "this server answers only as 127.0.0.1 or localhost")
        if any(origin not in self.origins for origin in origins):
            raise RefusedError(403, "requests from other sites are refused")
        if not scope["path"].startswith(API_PREFIX):
            if scope["method"] not in ("GET", "HEAD"):
                raise RefusedError(405, "the files of the page are read-only")
            return
        if scope["method"] != "POST":
            raise RefusedError(405, "the interface accepts only POST")
        if not hmac.compare_digest(headers.get(TOKEN_HEADER, "").encode(), self.token.encode()):
            raise RefusedError(401, "the token is missing or wrong: open the address that udkjax studio printed")
        if not origins:
            raise RefusedError(403, "the Origin header is missing")
        if headers.get("content-type", "").partition(";")[0].strip().lower() != "application/json":
            raise RefusedError(415, "the body must be application/json")


async def _read(receive: Receive, headers: Headers) -> bytes:
    """Return the body of a request; raise `RefusedError` as soon as it is too long."""
    declared = headers.get("content-length", "0")
    if not re.fullmatch(r"[0-9]{1,20}", declared) or int(declared) > MOST_BODY_BYTES:
        raise RefusedError(413, f"the request is longer than {MOST_BODY_BYTES} bytes")
    body = bytearray()
    while True:
        message = await receive()
        if message["type"] == "http.disconnect":
            raise RefusedError(400, "the request was interrupted")
        body += message.get("body", b"")
        if len(body) > MOST_BODY_BYTES:
            raise RefusedError(413, f"the request is longer than {MOST_BODY_BYTES} bytes")
        if not message.get("more_body"):
            return bytes(body)


class _Replay:
    """A `receive` that returns a body that has been read already."""

    def __init__(self, body: bytes, receive: Receive):
        self.body, self.receive = body, receive
        self.is_given = False

    async def __call__(self) -> Message:
        if self.is_given:
            return await self.receive()
        self.is_given = True
        return {"type": "http.request", "body": self.body, "more_body": False}
