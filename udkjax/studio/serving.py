"""Serving the studio on this machine: a socket on the loopback interface, a token, and the address that opens the page."""

import secrets
import socket
import webbrowser
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from urllib.parse import quote

from udkjax.extras import OptionalImport
from udkjax.studio.addresses import DRAWING_KEY, is_address
from udkjax.studio.folder import Folder

with OptionalImport():
    import tomlkit as tomlkit
    import uvicorn

    from udkjax.studio.application import Studio, application
from udkjax.studio.worker import Worker, WorkerPool

LOOPBACK = "127.0.0.1"
COMPILERS = 2  # an outdated drawing and the current one
TOKEN_BYTES = 32  # random bytes: too many to guess


def serve(root: Path, opened: str = "", port: int = 0, browse: bool = True, say: Callable[[str], None] = print) -> None:
    """Serve the studio until it is interrupted.

    Args:
        root: the folder whose files may be opened and saved.
        opened: path of a file in the folder, or address of a drawing, that the page opens; "" for neither.
        port: port at which to listen; 0 for any free port.
        browse: True to open a browser.
        say: function that shows the address to the user.
    """
    token = secrets.token_urlsafe(TOKEN_BYTES)
    workers = Worker(root), WorkerPool(COMPILERS, root), Worker(root)
    with closing(socket.socket(socket.AF_INET, socket.SOCK_STREAM)) as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((LOOPBACK, port))
        listener.listen()  # so that early connections wait for the server instead of being refused
        bound = listener.getsockname()[1]
        app = application(Studio(Folder(root), *workers), bound, token)
        drawing = (
            f"&{DRAWING_KEY}{quote(opened.partition(DRAWING_KEY)[2])}"
            if is_address(opened)
            else f"&f={quote(opened)}"
            if opened
            else ""
        )
        address = f"http://{LOOPBACK}:{bound}/#t={token}{drawing}"
        config = uvicorn.Config(app, log_level="warning", access_log=False, server_header=False, lifespan="off", ws="none")
        try:
            for worker in workers:
                worker.start()
            say(address)
            if browse:
                webbrowser.open(address)
            uvicorn.Server(config).run([listener])
        finally:
            for worker in workers:
                worker.close()
