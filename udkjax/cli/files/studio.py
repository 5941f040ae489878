"""`udkjax studio`."""

from pathlib import Path
from typing import Annotated

import tyro

from udkjax.cli.common import Json, refuse, show

MOST_PORT = 65535


def studio(
    file: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="FILE.toml")] = None,
    /,
    browser: bool = True,
    port: int = 0,
    json: Json = False,
) -> None:
    """Draw mechanisms in the browser, on a page that is served locally until you press Ctrl-C.

    The address is printed; it contains a token, without which all requests are refused. Only files in the folder of FILE, by
    default the current one, can be opened and saved.

    Args:
        file: drawing to open or create; or the folder to work in; or the address of a shared drawing, udkjax:drawing=...
        browser: open a browser.
        port: port to listen on; by default a free one.
        json: print the address as JSON.
    """
    if not 0 <= port <= MOST_PORT:
        refuse(f"--port {port}: must be between 0 and {MOST_PORT}")
    from udkjax.studio.addresses import is_address, text_of
    from udkjax.studio.limits import RefusedError

    folder, opened = Path.cwd(), ""
    if file is not None and is_address(str(file)):
        try:
            text_of(opened := str(file))
        except RefusedError as error:
            refuse(str(error))
    elif file is not None:
        folder, opened = (file, "") if file.is_dir() else (file.parent, file.name)
        if not folder.is_dir():
            refuse(f"there is no folder {folder}")
        if opened and not opened.endswith(".toml"):
            refuse(f"{file}: must be a drawing (.toml)")

    from udkjax.studio.serving import serve

    serve(folder, opened, port, browser, lambda address: show({"address": address}, address, json))
