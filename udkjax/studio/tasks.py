"""Tasks of the studio's worker processes: read, compile, diagnose and export drawings. Arguments and results are plain data."""

from collections.abc import Callable, Mapping
from importlib.resources import files
from typing import Any

import numpy as np

from udkjax.annotations import JsonObject
from udkjax.equations.rows.analysis import Analysis, analyse
from udkjax.integrate.portable import portable_engine
from udkjax.native.language.program import UnsupportedError
from udkjax.positions.answers.counting import Count
from udkjax.requirements import ArgumentError
from udkjax.scene import library
from udkjax.scene.drawing import Drawing
from udkjax.scene.drawing.drawn_quantities import Units
from udkjax.scene.files import loads
from udkjax.scene.mechanism import Mechanism
from udkjax.scene.tables.checks import SceneError
from udkjax.studio.drawn_scenes import drawing_text_of
from udkjax.studio.exports import exported
from udkjax.studio.findings import examine
from udkjax.studio.limits import RefusedError, require_few, require_size
from udkjax.studio.shown_runs import duration_of, effort_name, recorded_motion
from udkjax.studio.text_edits import merge_document, read_document
from udkjax.studio.wording import in_studio_words, studio_words

Maker = Callable[[], Mechanism]
# Templates for new drawings, files of the folder `drawings`: mechanisms that a motor or a spring moves.
DRAWN_TEMPLATES: Mapping[str, str] = {
    "crank_rocker": "Crank-rocker",
    "quick_return": "Quick return of a shaping machine",
    "toggle_press": "Toggle press",
    "cam_follower": "Cam and follower",
    "six_bar": "Six-bar",
    "jansen_leg": "Jansen's walking leg",
    "klann_leg": "Klann's walking leg",
    "door_closer": "Door closer",
}
# Further templates: mechanisms of the library, as drawings.
LIBRARY_TEMPLATES: Mapping[str, tuple[str, Maker]] = {
    "four_bar": ("Four-bar linkage", library.four_bar),
    "slider_crank": ("Slider-crank", library.slider_crank),
    "parallelogram": ("Five-bar parallelogram with a redundant link", library.parallelogram),
    "peaucellier": ("Peaucellier straight-line linkage", library.peaucellier),
    "planetary_gear": ("Planetary gear", library.planetary_gear),
    "scissor_lift": ("Scissor lift", library.scissor_lift),
    "excavator": ("Excavator", library.excavator),
    "andrews_squeezer": ("Andrews' squeezer mechanism", library.andrews_squeezer),
    "n_four_bar": ("Four-bars in a row", library.n_four_bar),
    "elliptic_trammel": ("Elliptic trammel", library.elliptic_trammel),
    "double_pendulum": ("Double pendulum", library.double_pendulum),
    "compound_pendulum": ("Compound pendulum", library.compound_pendulum),
    "driven_pendulum": ("Driven pendulum", library.driven_pendulum),
    "simple_pendulum": ("Simple pendulum", library.simple_pendulum),
    "chain": ("Chain of ten links", library.chain),
}


def list_templates() -> JsonObject:
    """Return the names and titles of the templates."""
    titles = {**DRAWN_TEMPLATES, **{name: title for name, (title, _) in LIBRARY_TEMPLATES.items()}}
    return {"templates": [{"name": name, "title": title} for name, title in titles.items()]}


def open_template(name: str) -> JsonObject:
    """Return a template as `open_text` does; raise `RefusedError` if there is no template of this name."""
    if not isinstance(name, str) or name not in {**DRAWN_TEMPLATES, **LIBRARY_TEMPLATES}:
        raise RefusedError(404, f"there is no template {name!r}")
    return open_text(template_text(name))


def open_text(text: str) -> JsonObject:
    """Return a scene file as the `text` and the tables, `document`, of a drawing.

    A scene of bodies and joints (format 1) is converted into a drawing; `drawn` is True then. If a text cannot be read or drawn,
    `problems` has the reasons, and the document is None.
    """
    problems: list[str] = []
    drawn = text
    try:
        document = read_document(text)
        if document.get("format") == 1:
            drawn = drawing_text_of(loads(text))
            document = read_document(drawn)
        else:
            text, document = _named_pins(text, document)
            drawn = text
    except SceneError as error:
        return {"text": text, "document": None, "problems": list(error.problems), "drawn": False}
    return {"text": drawn, "document": document, "problems": problems, "drawn": drawn != text}


def _named_pins(text: str, document: JsonObject) -> tuple[str, JsonObject]:
    """Return the text and the tables of a drawing in which links that take their pins from holes of files name these pins."""
    links, pins = document.get("link"), document.get("pins", {})
    if not isinstance(links, list) or all("pins" in link for link in links if isinstance(link, dict)):
        return text, document
    try:
        drawing = loads(text).drawing
    except (SceneError, ArgumentError):  # reported when it is compiled
        return text, document
    assert isinstance(drawing, Drawing)
    units, places = Units.of(drawing), {name: np.asarray(place, float).tolist() for name, place in drawing.pins.items()}
    new = {name: [units.write(x, "m") for x in place] for name, place in places.items() if name not in pins}
    named = [{"pins": list(link.pins), **given} for given, link in zip(links, drawing.links.values(), strict=True)]
    text = merge_document(text, {**document, "pins": pins | new, "link": named})
    return text, read_document(text)


def compile_drawing(text: str = "", document: Mapping[str, Any] | None = None, engine: str = "") -> JsonObject:
    """Return the text and tables of a drawing, its mistakes, and the data with which the page moves it.

    Args:
        text: text of the file; with `document`, the text before the document was changed.
        document: tables as changed in the page.
        engine: "wasm" asks for the engine as data for the page, with the places of pins as parameters; "recorded" for a motion
            that is computed here, for a browser without WebAssembly.
    """
    require_size(text)
    try:
        if document is not None:
            text = merge_document(text, document)
        tables = read_document(text)
        with np.errstate(over="ignore", invalid="ignore"):  # reported below
            mechanism = loads(text)
            if not np.isfinite(analyse(mechanism).length):
                raise SceneError(
                    ["the characteristic length is infinite: a mass is too close to zero, or a place is too far away"]
                )
        if not isinstance(mechanism.drawing, Drawing):
            raise SceneError(["format: the studio draws files of format 2"])
        Analysis.require_masses(mechanism, "free motions")
    except (SceneError, ArgumentError) as error:
        problems = list(error.problems) if isinstance(error, SceneError) else [studio_words(str(error))]
        return {"text": text, "document": _read(text), "problems": problems, "scene": None}
    engine_data = engine_of(mechanism, tables) if engine == "wasm" else {}
    if engine == "recorded":
        engine_data = {"motion": in_studio_words(recorded_motion(mechanism))}
    found = {"text": text, "document": tables, "problems": [], "scene": scene_of(mechanism), **engine_data}
    return found | {"outlines": outlines_of_files(mechanism.drawing, tables)}


def outlines_of_files(drawing: Drawing, document: JsonObject) -> list[JsonObject]:
    """Return the outlines that links take from files: the name of the `file`, and the corners of `outline` and `holes` (m)."""
    found = []
    for link, given in zip(drawing.links.values(), document.get("link", []), strict=True):
        if not isinstance(given.get("outline", []), list):
            holes = [] if link.holes is None else np.asarray(link.holes).tolist()
            found.append({"file": given["outline"], "outline": np.asarray(link.outline).tolist(), "holes": holes})
    return found


def engine_of(mechanism: Mechanism, document: JsonObject) -> JsonObject:
    """Return the `engine` with which the page moves a drawing, and an engine without motors, `hand`, for pulling.

    `hand` is None for a drawing without motors. If an engine is impossible, `why` has the reason.
    """
    pins = list(document.get("pins", {}))
    names = [f"pin.{pin}" for pin in pins]
    try:
        engine = portable_engine(_by_coordinates(mechanism), names, pull=False).data
        hand = None
        if mechanism.drivers:
            undriven = _by_coordinates(loads(merge_document("", _undriven(document))))
            hand = portable_engine(undriven, names, pull=False, runs=False).data
    except (UnsupportedError, SceneError) as error:
        return {"why": studio_words(str(error))}
    return {"engine": engine, "hand": hand, "pins": pins, "why": studio_words(engine["why"])}


def _by_coordinates(mechanism: Mechanism) -> Mechanism:
    """Return the mechanism of a drawing with all pins given by coordinates, as the page sends them however they were drawn."""
    assert isinstance(mechanism.drawing, Drawing)
    return mechanism.drawing.by_coordinates().mechanism()


def _undriven(document: JsonObject) -> JsonObject:
    """Return a drawing without prescribed motions; cylinders become dampers without damping, which keep their pins."""
    motors = document.get("motor", [])
    idle = [{"between": motor["between"], "damping": 0} for motor in motors if "between" in motor]
    torques = [motor for motor in motors if "torque" in motor]
    return {**document, "motor": torques, "driver": [], "damper": [*document.get("damper", []), *idle]}


def _read(text: str) -> JsonObject | None:
    try:
        return read_document(text)
    except SceneError:
        return None


def scene_of(mechanism: Mechanism) -> JsonObject:
    """Return the data with which the page shows a mechanism's positions and energies."""
    analysis = analyse(mechanism)
    bodies = mechanism.bodies.values()
    return {
        "bodies": list(mechanism.bodies),
        "frames": [[*np.asarray(body.position).tolist(), float(body.angle)] for body in bodies],
        "masses": [float(body.mass) for body in bodies],
        "massless": list(mechanism.massless),
        "inertias": [float(body.inertia) for body in bodies],
        "gravity": np.asarray(mechanism.gravity).tolist(),
        "length": float(analysis.length),
        "duration": duration_of(mechanism),
        "drivers": [
            {
                "name": name,
                "effort": effort_name(name, driver, "driving"),
                "unit": driver.effort_unit,
                **turning_of(mechanism, name),
            }
            for name, driver in mechanism.drivers.items()
        ],
    }


def turning_of(mechanism: Mechanism, name: str) -> JsonObject:
    """Return the bodies of a driver of an angle (`pair`, -1 for the ground) and the `offset` (rad) added to show its values.

    Return {} for a driver of any other coordinate.
    """
    driver = mechanism.drivers[name]
    if driver.coordinate != "angle":
        return {}
    names = list(mechanism.bodies)
    pair = [names.index(body) if body in names else -1 for body in driver.bodies]
    return {"pair": pair, "offset": float(Count.of(mechanism, name).offset)}


def diagnose_drawing(text: str, about: str = "structure", end: JsonObject | None = None) -> JsonObject:
    """Return the findings about a drawing; for the subject `about` and for `end`, see `examine` in findings.py."""
    try:
        require_few(read_document(text))
        return in_studio_words(examine(loads(text), text, about, end))
    except SceneError as error:
        return in_studio_words({"problems": list(error.problems)})
    except ArgumentError as error:  # such as links without mass
        return in_studio_words({"problems": [str(error)]})


def export(text: str, suffix: str, pose: JsonObject | None = None, has_gaps: bool = False) -> JsonObject:
    """Return an export of a drawing as hexadecimal bytes; for `pose` and `has_gaps`, see `exported` in exports.py."""
    try:
        require_few(read_document(text))
        mechanism = loads(text)
        data = exported(mechanism, text, suffix, pose, has_gaps)
        return {"data": data.hex()}
    except (SceneError, ArgumentError) as error:
        problems = error.problems if isinstance(error, SceneError) else [str(error)]
        raise RefusedError(422, studio_words("; ".join(problems))) from None
    except ImportError as error:
        raise RefusedError(422, str(error)) from None


def find_path(path: object, unit: str = "mm", seed: int = 0) -> JsonObject:
    """Return mechanisms with a pin that draws a wanted path, as `find_mechanisms` in path_search.py does."""
    from udkjax.studio.path_search import find_mechanisms  # imports the synthesis, which other tasks need not

    return find_mechanisms(path, unit, seed)


def read_path(name: str, text: str, unit: str) -> JsonObject:
    """Return the wanted path of a table, with lengths in `unit`."""
    from udkjax.studio.path_search import path_of_table

    return {"path": path_of_table(name, text, unit)}


def template_text(name: str) -> str:
    """Return a template as the text of a drawing."""
    if name in DRAWN_TEMPLATES:
        return files("udkjax.studio").joinpath(f"drawings/{name}.toml").read_text(encoding="utf-8")
    return drawing_text_of(LIBRARY_TEMPLATES[name][1]())
