"""The server of the studio: the files of the page, and seven routes with JSON requests and answers.

    POST /api/list        {}                                          -> {files, templates, folder}
    POST /api/open        {path}, {template} or {address}             -> {text, document, path, revision, problems}
    POST /api/share       {text}                                      -> {address} of a drawing
    POST /api/save        {path, text, revision, export?, table?,     -> {path, revision}, or 409 with the revision on disk
                           pose?, gaps?}
    POST /api/compile     {text, document?, engine?}                  -> {text, document, problems, scene, engine}
    POST /api/diagnose    {text, about?, end?}                        -> findings about the drawing
    POST /api/design      {path, unit?, seed?}                        -> mechanisms with a point on a wanted path
                          {table, name, unit?}                        -> {path} of a table's text

A refused request is answered by {problem} and an HTTP status.
"""

import json
from collections.abc import Awaitable, Callable, Mapping
from functools import partial
from importlib.resources import files
from pathlib import Path

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp

from udkjax.annotations import JsonObject
from udkjax.scene.drawing.drawn_quantities import Units
from udkjax.studio.addresses import address_of, text_of
from udkjax.studio.folder import Folder
from udkjax.studio.gate import API_PREFIX, Gate
from udkjax.studio.limits import COMPILE_SECONDS, DIAGNOSE_SECONDS, EXPORT_SECONDS, RefusedError, require_size
from udkjax.studio.worker import Worker, WorkerPool

MEDIA_TYPES = {".html": "text/html", ".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}
# Package and folder of each address prefix.
PAGE_FOLDERS = {"": ("udkjax.studio", "page"), "player/": ("udkjax.show.player", ".")}
UNIT_SIZES = "unit_sizes.js"  # a module of the page that is made from the package's table of units
EXPORT_SUFFIXES = (".html", ".svg", ".png", ".gif", ".mp4", ".dxf", ".csv", ".py")


class Studio:
    """The actions of the server's routes, on the files of one folder; the top of this file lists their requests and answers.

    Args:
        folder: folder of the files to open and save.
        reader: process that reads and merges texts, which takes milliseconds.
        compiler: processes that compile engines.
        examiner: process that diagnoses and exports, which takes longest.
    """

    def __init__(self, folder: Folder, reader: Worker, compiler: Worker | WorkerPool, examiner: Worker):
        self.folder, self.reader, self.compiler, self.examiner = folder, reader, compiler, examiner

    def list(self, request: JsonObject) -> JsonObject:
        """Return the paths of the folder's scene files, the folder's name, and the templates."""
        templates = self.reader.call("list_templates", {}, COMPILE_SECONDS)
        return {"files": self.folder.list(), "folder": self.folder.root.name, **templates}

    def open(self, request: JsonObject) -> JsonObject:
        """Return the text and the tables of a file, of a template, or of a drawing shared by address."""
        if "template" in request:
            opened = self.reader.call("open_template", {"name": request["template"]}, COMPILE_SECONDS)
            return {**opened, "path": "", "revision": None}
        if isinstance(request.get("address"), str):
            opened = self.reader.call("open_text", {"text": text_of(request["address"])}, COMPILE_SECONDS)
            return {**opened, "path": "", "revision": None}
        text, revision = self.folder.read(request.get("path"))
        opened = self.reader.call("open_text", {"text": text}, COMPILE_SECONDS)
        return {**opened, "path": request["path"], "revision": revision}

    def share(self, request: JsonObject) -> JsonObject:
        """Return the address of a drawing."""
        return {"address": address_of(require_size(request.get("text")))}

    def save(self, request: JsonObject) -> JsonObject:
        """Write a drawing or an export of it, unless the file on disk has another revision than the page expects."""
        text, path, revision = require_size(request.get("text")), request.get("path"), request.get("revision")
        if not (revision is None or isinstance(revision, str)):
            raise RefusedError(400, "revision: must be a string, or null for a new file")
        if not request.get("export"):
            return {"path": path, "revision": self.folder.write(path, text.encode(), revision)}
        suffix = self.folder.locate(path, EXPORT_SUFFIXES).suffix.lower()
        if suffix == ".csv" and isinstance(request.get("table"), str):  # the curves of the page
            data = request["table"].encode()
            return {"path": path, "revision": self.folder.write(path, data, revision, EXPORT_SUFFIXES), "bytes": len(data)}
        shown = {"pose": request.get("pose") or {}, "has_gaps": request.get("gaps") is True}
        if not isinstance(shown["pose"], dict):
            raise RefusedError(400, "pose: must be an object")
        exported = self.examiner.call("export", {"text": text, "suffix": suffix, **shown}, EXPORT_SECONDS)
        data = bytes.fromhex(exported["data"])
        return {"path": path, "revision": self.folder.write(path, data, revision, EXPORT_SUFFIXES), "bytes": len(data)}

    def compile(self, request: JsonObject) -> JsonObject:
        """Return a drawing's text and tables, its mistakes, and, if an `engine` is requested, the data that move it."""
        given = {key: request[key] for key in ("text", "document", "engine") if request.get(key) is not None}
        require_size(given.get("text"))
        if not isinstance(given.get("document", {}), dict):
            raise RefusedError(400, "document: must be an object")
        worker = self.compiler if "engine" in given else self.reader
        return worker.call("compile_drawing", given, COMPILE_SECONDS)

    def diagnose(self, request: JsonObject) -> JsonObject:
        """Return findings about a drawing: degrees of freedom, redundant constraints and their fixes, travel, curves."""
        given = {"text": require_size(request.get("text")), "about": str(request.get("about", "structure"))}
        if isinstance(request.get("end"), dict):
            given["end"] = request["end"]
        return self.examiner.call("diagnose_drawing", given, DIAGNOSE_SECONDS)

    def design(self, request: JsonObject) -> JsonObject:
        """Return mechanisms with a pin that draws a wanted path; or, for a request with a `table`, the path in this table."""
        path, unit, seed = request.get("path"), request.get("unit", "mm"), request.get("seed", 0)
        if "table" in request and unit in Units.sizes("m"):
            given = {"text": require_size(request["table"]), "name": str(request.get("name", "the table")), "unit": unit}
            return self.reader.call("read_path", given, COMPILE_SECONDS)
        if not isinstance(path, list) or unit not in Units.sizes("m") or type(seed) is not int or seed < 0:
            raise RefusedError(400, "path: must be a list of places [x, y] in m; unit: a unit of lengths; seed: a natural number")
        return self.examiner.call("find_path", {"path": path, "unit": unit, "seed": seed}, DIAGNOSE_SECONDS)


def application(studio: Studio, port: int, token: str) -> ASGIApp:
    """Return the server of the studio as an ASGI application, protected by a `Gate`.

    Args:
        studio: the actions of its routes.
        port: port at which it listens.
        token: token that each request to the interface must carry.
    """
    actions = [studio.list, studio.open, studio.share, studio.save, studio.compile, studio.diagnose, studio.design]
    routes = [Route(f"{API_PREFIX}{action.__name__}", _answering(action), methods=["POST"]) for action in actions]
    return Gate(Starlette(routes=[*routes, Route("/{path:path}", _page_file)]), port, token)


def _answering(action: Callable[[JsonObject], JsonObject]) -> Callable[[Request], Awaitable[Response]]:
    async def answer(request: Request) -> Response:
        try:
            given = json.loads(await request.body())
            json.dumps(given, ensure_ascii=False).encode()  # raises for an unpaired surrogate, which no answer can contain
        except (ValueError, RecursionError):
            given = None
        if not isinstance(given, dict):
            return JSONResponse({"problem": "the body must be a JSON object"}, 400)
        try:
            return JSONResponse(await run_in_threadpool(partial(action, given)))
        except RefusedError as error:
            return JSONResponse({"problem": str(error), **error.details}, error.status)

    return answer


async def _page_file(request: Request) -> Response:
    content = page_files().get(request.path_params["path"] or "index.html")  # only files of the package
    if content is None:
        return JSONResponse({"problem": "there is no such file"}, 404)
    data, media_type = content
    return Response(data, media_type=media_type)


def page_files() -> Mapping[str, tuple[bytes, str]]:
    """Return the content and the media type of each file of the page, by its path on the server."""
    contents = {UNIT_SIZES: (_unit_sizes().encode(), MEDIA_TYPES[".js"])}
    for prefix, (package, folder) in PAGE_FOLDERS.items():
        root = files(package).joinpath(folder)
        if root.is_dir():
            for entry in root.iterdir():
                suffix = Path(entry.name).suffix
                if suffix in MEDIA_TYPES and entry.is_file() and (not prefix or suffix == ".js"):
                    contents[prefix + entry.name] = (entry.read_bytes(), MEDIA_TYPES[suffix])
    return contents


def _unit_sizes() -> str:
    """Return a JavaScript module with the sizes of all units of length (m) and angle (rad), by each of their spellings."""
    tables = {"LENGTHS": Units.sizes("m"), "ANGLES": Units.sizes("rad")}
    return "".join(f"export const {name} = {json.dumps(sizes)};\n" for name, sizes in tables.items())
