"""`udkjax studio`."""

from pathlib import Path
from typing import Annotated

import tyro

from udkjax.cli.common import Json, refuse, show

MOST_PORT = 65535  # of TCP


def studio(
    file: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="FILE.toml")] = None,
    /,
    browser: bool = True,
    port: int = 0,
    json: Json = False,
) -> None:
    """Draw mechanisms in the browser: a page that this machine serves to itself, until it is interrupted (Ctrl-C).

    The address is printed. It holds a token without which nothing is answered, and only files in the folder of FILE, by default
    the current one, are opened and saved.

    Args:
        file: drawing to open, or to make; or the folder to work in.
        browser: open a browser.
        port: port to listen at; by default one that is free.
        json: print the address as JSON.
    """
    if not 0 <= port <= MOST_PORT:
        refuse(f"--port {port}: must be between 0 and {MOST_PORT}")
    folder = Path.cwd() if file is None else file if file.is_dir() else file.parent
    if not folder.is_dir():
        refuse(f"there is no folder {folder}")
    opened = "" if file is None or file.is_dir() else file.name
    if opened and not opened.endswith(".toml"):
        refuse(f"{file}: the studio opens drawings, which end in .toml")

    from udkjax.studio.serving import serve

    serve(folder, opened, port, browser, lambda address: show({"address": address}, address, json))
