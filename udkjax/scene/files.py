"""Read and write scene files: mechanisms (TOML format 1), drawings (format 2) and MJCF models."""

import os
from pathlib import Path

from udkjax.scene import mechanism_tables as tables
from udkjax.scene.arguments import checked
from udkjax.scene.drawing import Drawing
from udkjax.scene.drawing.drawing_tables import drawing_of_tables, drawing_text
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.mechanism_tables import is_xml, parse_toml
from udkjax.scene.outlines.outline_tables import with_outlines
from udkjax.scene.tables.checks import SceneError
from udkjax.wording import abbreviate

DRAWN_VERSION = 2  # version of the format of drawings, with pins and links


def load(path: str | os.PathLike[str]) -> Mechanism:
    """Read a mechanism from a TOML file of format 1, a drawing of format 2, or an MJCF model (as `read_mjcf`).

    Outlines of links in other files are read from the folder of the file.

    Args:
        path: The file; if it begins like XML, it is read as MJCF.

    Returns:
        The mechanism; if it was drawn, `drawing` is its drawing.

    Raises:
        SceneError: The scene is wrong; the error lists every mistake in it.
        OSError: The file cannot be read.
    """
    try:
        return _read(Path(path).read_text(encoding="utf-8"), os.fspath(path))
    except UnicodeDecodeError as error:
        raise SceneError([f"not a text file in UTF-8 ({error})"], os.fspath(path)) from None


def loads(text: str) -> Mechanism:
    """Read a mechanism from the text of a file, as `load` does; outlines in other files from the current folder.

    Args:
        text: The text.

    Returns:
        The mechanism.

    Raises:
        SceneError: The scene is wrong; the error lists every mistake in it.
    """
    return _read(text, "")


@checked
def save(mechanism: Mechanism | Drawing, path: str | os.PathLike[str]) -> None:
    """Write a mechanism atomically to a TOML file (as `dumps`) or an MJCF model (as `mjcf_text`).

    Args:
        mechanism: The scene.
        path: The file, replaced if it exists; the suffix ".xml" selects MJCF.

    Raises:
        SceneError: The format cannot hold the mechanism, as in `dumps` and `mjcf_text`.
        OSError: The file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() == ".xml":
        from udkjax.scene.mjcf.mjcf_writer import mjcf_text  # deferred, as only MJCF needs XML

        text = mjcf_text(mechanism)
    else:
        text = dumps(mechanism)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        temporary.write_text(text, encoding="utf-8", newline="\n")
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


@checked
def dumps(mechanism: Mechanism | Drawing) -> str:
    """Return the mechanism as the text of a TOML file; reading it back gives bitwise identical numbers.

    A drawing, or a mechanism made from one, is written in format 2, in the units of the drawing. If numbers of the mechanism no
    longer follow from the drawing (`with_parameters({"body.crank.mass": ...})`), it is written in format 1.

    Args:
        mechanism: The scene.

    Returns:
        The text.

    Raises:
        SceneError: The format cannot hold the mechanism: user-written classes, traced numbers, batches of numbers.
    """
    drawing = mechanism if isinstance(mechanism, Drawing) else mechanism.drawing
    if isinstance(mechanism, Mechanism) and (mechanism.departs_from_drawing or not isinstance(drawing, Drawing)):
        return tables.mechanism_text(mechanism)
    assert isinstance(drawing, Drawing)
    return drawing_text(drawing)


def _read(text: str, source: str) -> Mechanism:
    if is_xml(text):
        from udkjax.scene.mjcf.mjcf_reader import mechanism_of_text  # deferred

        return mechanism_of_text(text, source, stacklevel=4)
    scene = parse_toml(text, source, SceneError)
    version = scene.get("format")
    if version == tables.FORMAT_VERSION and version is not True:
        return tables.mechanism_of_tables(scene, source)
    if version == DRAWN_VERSION:
        return drawing_of_tables(with_outlines(scene, source), source).mechanism()
    if version is None:
        formats = (
            f"write format = {DRAWN_VERSION} for a drawing, with pins, or format = {tables.FORMAT_VERSION} for bodies and joints"
        )
        raise SceneError([f"format: missing; {formats}"], source)
    known = f"{tables.FORMAT_VERSION} and {DRAWN_VERSION}"
    raise SceneError([f"format: this version of udkjax reads formats {known}, not {abbreviate(version)}"], source)
