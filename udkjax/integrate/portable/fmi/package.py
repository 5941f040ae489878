"""The FMU of a scene: `export_fmu`."""

import hashlib
import json
import tempfile
import zipfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import numpy as np

from udkjax.argument_types import NOT_NEGATIVE, POSITIVE
from udkjax.equations.rows.position_closure import CLOSURE
from udkjax.integrate.portable.c.folder import scene_files
from udkjax.integrate.portable.c.scene import SceneCode, string_text, table
from udkjax.integrate.portable.fmi.compilers import LIBRARY_SUFFIXES, Platform, compile_library, compiler_for, this_platform
from udkjax.integrate.portable.fmi.description import INTERFACE_KINDS, build_description, model_description
from udkjax.integrate.portable.fmi.variables import FMUVariables, least_of
from udkjax.integrate.portable.parameters import guess_of, places_of_numbers
from udkjax.native.c import c_function
from udkjax.requirements import ArgumentError
from udkjax.scene.arguments import checked
from udkjax.scene.mechanism import Mechanism

Kind = Literal["co-simulation", "model-exchange"]
SOURCES_FOLDER = Path(__file__).parent / "sources"
DRIFT_DECAY = 10.0  # of drift, in units of the rate of the scene: faster than the motion, and not stiff for explicit methods
FILE_TIME = 1980, 1, 1, 0, 0, 0  # of files: the same scene gives the same bytes
FUNCTION_ALIASES = {
    "positions": ("SCENE_CLOSE", "close"),
    "projection": ("SCENE_PROJECT", "project"),
    "accelerations": ("SCENE_ACCELERATIONS", "accelerations"),
    "derivatives": ("SCENE_ACCELERATIONS_ALONG", "accelerations_along"),
    "position_derivatives": ("SCENE_CLOSE_ALONG", "close_along"),
}


class ExportedFMU(NamedTuple):
    """An FMU that has been written.

    Attributes:
        file: the FMU.
        kinds: its interfaces.
        platforms: the platforms for which it has a library.
        outputs: names of its outputs.
        parameters: names of its parameters.
        inputs: names of its inputs.
    """

    file: Path
    kinds: list[str]
    platforms: list[str]
    outputs: list[str]
    parameters: list[str]
    inputs: list[str]


@checked
def export_fmu(
    mechanism: Mechanism,
    file: Path | str,
    kinds: Sequence[Kind] = ("co-simulation", "model-exchange"),
    parameters: Sequence[str] | None = None,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    t0: float = 0.0,
    t1: float = 20.0,
    dt: Annotated[float, POSITIVE] = 0.05,
    rtol: Annotated[float, NOT_NEGATIVE] = 1e-8,
    atol: Annotated[float, NOT_NEGATIVE] = 1e-8,
    stiff: bool = True,
    platforms: Sequence[Platform] | None = None,
    options: Sequence[str] = ("-O2",),
) -> ExportedFMU:
    """Write a scene as an FMU by FMI 3.0, for co-simulation and model exchange, with its sources in C.

    In co-simulation, each step of the importer is an interval as by `step`. In model exchange the importer integrates; the FMU
    evaluates the equations at the state projected onto the constraints, so that its outputs satisfy these. FMUs with
    model exchange have directional and adjoint derivatives.

    Args:
        mechanism: the scene, with concrete numbers. Its thresholds of rank follow from these numbers.
        file: the FMU to write.
        kinds: interfaces: "co-simulation", "model-exchange" or both.
        parameters: names of numbers that can be set before a run, as in `with_parameters`; None: all numbers of the scene. Poses
            are set by the start values of states.
        inputs: names of numbers that can be set during a run; None: those of `Torque` and `Force` elements.
        outputs: names of outputs besides the coordinates of bodies, such as "pin.A.x" or "joint.A.angle"; None: positions and
            velocities of all pins that move.
        t0: start of the default experiment (s).
        t1: end of the default experiment (s).
        dt: step of the default experiment (s).
        rtol: relative tolerance of a step, in co-simulation.
        atol: absolute tolerance of a step, in units of the scene's characteristic length and time.
        stiff: whether co-simulation goes on by an implicit method where it is stiff.
        platforms: platforms to compile for, such as "x86_64-linux"; None: this one. Others need the extra `zig`.
        options: options of the C compiler, such as ["-O2", "-march=native"].

    Returns:
        The file, and the names of its variables.

    Raises:
        ArgumentError: the scene has joints that stick, forces with kinks, or equations without machine code; model exchange is
            impossible; there is no compiler; or the times are wrong.
        AssemblyError: the initial guess cannot be closed.
    """
    mechanism.require_masses("exported accelerations")
    chosen: list[str] = [kind for kind in INTERFACE_KINDS if kind in kinds]
    if not kinds or set(kinds) - set(INTERFACE_KINDS):
        raise ArgumentError(f"kinds must be a list of {', '.join(INTERFACE_KINDS)}, not {', '.join(map(str, kinds)) or 'empty'}")
    if not t1 > t0:
        raise ArgumentError(f"t1 must be later than t0 = {t0:g} s, not {t1:g} s")
    to = [this_platform()] if platforms is None else [str(x) for x in platforms]
    commands = {name: compiler_for(name) for name in to}
    scene = SceneCode(mechanism, np.array([t0, t1], float), rtol, atol, stiff)
    what = ["run", *_further(scene, chosen)]
    variables = FMUVariables(scene, parameters, inputs, outputs)
    texts, units = scene_files(scene, what, [x.name for x in variables.values])
    if variables.measures:
        head = f"void {scene.prefix}_measure(const double *at, double *found)"
        body = "{\n    measure((double *)(uintptr_t)at, found);\n}\n"
        texts[f"{scene.prefix}_measure.c"] = f"{c_function(variables.measure())}\n{head};\n{head}\n{body}"
    model = _model(scene, variables, what, max(unit.memory for unit in units.values()), chosen)
    texts |= {name: (SOURCES_FOLDER / name).read_text(encoding="ascii") for name in ("fmi3.h", "fmu.c")}
    token = hashlib.sha256(json.dumps([texts, model], sort_keys=True).encode()).hexdigest()
    texts["model.h"] = f'{model}#define TOKEN "{token}"\n\n#endif\n'
    times = t0, t1, dt
    description = model_description(mechanism.name or "mechanism", scene.prefix, token, chosen, variables, times, rtol)
    _write(Path(file), scene.prefix, texts, description, commands, options)
    shown = variables.coordinates if "model-exchange" in chosen else variables.coordinates[: 2 * scene.n]
    names = [[x.name for x in found] for found in ([*shown, *variables.measures], variables.parameters, variables.inputs)]
    return ExportedFMU(Path(file), list(chosen), to, *names)


def _further(scene: SceneCode, kinds: Sequence[str]) -> list[str]:
    """Return the names of the C functions (`FUNCTION_ALIASES`) that an FMU needs in addition to the run."""
    closing = ["positions"] if scene.analysis.scales.rows.size else []
    if "model-exchange" not in kinds:
        return closing
    try:
        _ = scene.evaluation
    except ArgumentError as error:
        raise ArgumentError(f"no model exchange: {error}; give kinds=['co-simulation']") from None
    return [*closing, "projection", "accelerations", "derivatives", "position_derivatives"]


def _model(scene: SceneCode, variables: FMUVariables, what: Sequence[str], memory: int, kinds: Sequence[str]) -> str:
    """Return the text of model.h without its last lines: the constants of the scene for fmu.c."""
    p, big, values = scene.prefix, scene.prefix.upper(), variables.values
    lines = [f"#define {name} {p}_{function}" for key, (name, function) in FUNCTION_ALIASES.items() if key in what]
    lines += [f"#define scene_{x} {p}_{x}" for x in ("numbers", "q0", "v0", "set_parameters", "result_name", "step")]
    if "model-exchange" in kinds:
        lines += ["#define MODEL_EXCHANGE", f"#define SCENE_SET_ALONG {p}_set_parameters_along"]
    if variables.measures:
        lines += [f"void {p}_measure(const double *at, double *found);", f"#define SCENE_MEASURE {p}_measure"]
    breaks, scales = scene.inputs["breaks"], scene.analysis.scales
    length, rate = float(np.ravel(scales.length)[0]), float(np.ravel(scales.rate)[0])
    size = np.tile([length, length, 1.0], scene.n // 3)
    nominal = np.concatenate([size, size * rate])
    least = ", ".join(least_of(scene.mechanism, x.name) for x in values)
    guess = guess_of(places_of_numbers(scene.mechanism))
    places = ", ".join(str(int(k)) for k in np.concatenate([guess["q"], guess["v"]]))
    return f"""/* The constants of the scene for fmu.c. */
#ifndef MODEL_H
#define MODEL_H

#include "{p}.h"

#define N {big}_COORDINATES
#define NUMBERS {big}_NUMBERS
#define VALUES {len(values)} /* parameters, then inputs */
#define INPUTS {len(variables.inputs)}
#define MEASURES {len(variables.measures)}
#define BREAKS {len(breaks)}
#define MEMORY {memory}
#define CLOSED {CLOSURE.tol!r} /* largest violation of constraints, over the scales of their rows, that counts as closed */
#define DECAY {DRIFT_DECAY * rate!r} /* rate at which drift from the constraints decays in model exchange (1/s) */
#define START_TIME {float(scene.ts[0])!r}
{chr(10).join(lines)}

enum {{ ANY_NUMBER, NOT_NEGATIVE, POSITIVE }};

static const double start_values[VALUES + 1] = {{{table(np.array([*(x.start for x in values), 0.0]))}}};
static const int least[VALUES + 1] = {{{least or 0}}}; /* which values are allowed */
static const double nominal[2 * N] = {{{table(nominal)}}};
static const double breaks[BREAKS + 1] = {{{table(np.array([*breaks, 0.0]))}}};
static const int guess[2 * N] = {{{places}}}; /* places in the numbers of the scene's guess of its state */
static const char *const names[3 * N] = {{{_texts(x.name for x in variables.coordinates)}}};
static const char *const value_names[VALUES + 1] = {{{_texts([*(x.name for x in values), ""])}}};

"""


def _texts(names: Iterable[str]) -> str:
    """Return names as string constants of C, separated by commas."""
    return ",\n    ".join(map(string_text, names))


def _write(
    file: Path, prefix: str, texts: dict[str, str], description: str, commands: dict[str, list[str]], options: Sequence[str]
) -> None:
    """Compile the sources for each platform, and write the FMU, a zip archive."""
    code = sorted(name for name in texts if name.endswith(".c"))
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        for name, text in texts.items():
            (folder / name).write_text(text, encoding="ascii", errors="backslashreplace")
        contents = {"modelDescription.xml": description.encode(), "sources/buildDescription.xml": b""}
        contents["sources/buildDescription.xml"] = build_description(prefix, code).encode()
        contents |= {f"sources/{name}": (folder / name).read_bytes() for name in texts}
        for platform, command in commands.items():
            name = f"{prefix}{LIBRARY_SUFFIXES[platform.rpartition('-')[2]]}"
            compile_library(command, platform, [folder / x for x in code], folder / name, options)
            contents[f"binaries/{platform}/{name}"] = (folder / name).read_bytes()
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, data in contents.items():
                archive.writestr(zipfile.ZipInfo(name, FILE_TIME), data, zipfile.ZIP_DEFLATED)
