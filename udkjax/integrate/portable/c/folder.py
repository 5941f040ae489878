"""Export of a scene as a folder of C99 source that runs it: `export_c`."""

import re
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import numpy as np

from udkjax.annotations import Numbers
from udkjax.argument_types import NOT_NEGATIVE
from udkjax.integrate.portable.c.scene import INFO_PLACES, SceneCode, comment_text, string_text, table
from udkjax.integrate.solution import Result, versions
from udkjax.native.c import CUnit
from udkjax.native.runs import RunStates
from udkjax.requirements import ArgumentError, concrete_only
from udkjax.scene.arguments import checked
from udkjax.scene.elements.bodies import GROUND
from udkjax.scene.mechanism import Mechanism

What = Literal[
    "run", "step_derivatives", "accelerations", "derivatives", "projection", "positions", "position_derivatives", "reactions"
]
FUNCTION_COMMENTS = {
    "run": """/* Integrate, and project each step onto the constraints: positions qs and velocities vs (times, {N})
   at the times ts, which increase (s), from the closed state q, v; the largest violation of the constraints at each
   time, over the scales of their rows; and info, then the last q and v. Returns 0, or why the run ended ({p}_result_name).
   The numbers of info are {info}. */
int {p}_run(const double *numbers, const double *ts, int times, const double *q, const double *v, double *qs, double *vs,
    double *violation, double *info, double *memory);

/* Lead a state over one interval dt (s) from the time t. Returns 0, or why the run ended: q and v then stay. */
int {p}_step(const double *numbers, double t, double dt, double *q, double *v, double *memory);
""",
    "step_derivatives": """/* Lead a state over one interval, and its change dq, dv along changes dnumbers of the numbers. */
int {p}_step_along(const double *numbers, double t, double dt, double *q, double *v, const double *dnumbers, double *dq,
    double *dv, double *memory);
""",
    "accelerations": """/* Accelerations a of a state by the Udwadia-Kalaba equation. */
void {p}_accelerations(const double *numbers, double t, const double *q, const double *v, double *a, double *memory);
""",
    "derivatives": """/* Accelerations a of a state, and their derivative da along changes dnumbers of the numbers,
   dq of positions and dv of velocities. A column of a Jacobian is the derivative along a unit vector. */
void {p}_accelerations_along(const double *numbers, double t, const double *q, const double *v, const double *dnumbers,
    const double *dq, const double *dv, double *a, double *da, double *memory);
""",
    "projection": """/* Return a state that has drifted to the constraints. */
void {p}_project(const double *numbers, double t, double *q, double *v, double *memory);
""",
    "positions": """/* Close positions q and velocities v near a guess, with the drivers at the time t (s). Returns the
   largest violation of the constraints that is left, over the scales of their rows:
   below 1e-9 if the mechanism could be closed. */
double {p}_close(const double *numbers, double t, double *q, double *v, double *memory);
""",
    "position_derivatives": """/* Derivative dstate (of the closed q, then of v) of {p}_close from a guess q, v, along
   changes dnumbers of the numbers, dq and dv of the guess. At a closed state it is that of {p}_project as well. */
void {p}_close_along(const double *numbers, double t, const double *q, const double *v, const double *dnumbers,
    const double *dq, const double *dv, double *dstate, double *memory);
""",
    "reactions": """/* Loads of joints and drivers, of least norm where redundant constraints share them: force x and y (N) and
   torque (N m, about the centre of mass) of {loads}; and the efforts of drivers ({drivers}): torque (N m) or force (N)
   along each coordinate. Of a motion that drivers prescribe, {p}_close finds the state. */
void {p}_reactions(const double *numbers, double t, const double *q, const double *v, double *loads, double *efforts,
    double *memory);
""",
}
PARAMETERS_ALONG_TEXT = """/* Write changes of the numbers. `parameters` has the parameters, and then their changes. */
void {p}_set_parameters_along(const double *parameters, double *dnumbers);
"""
FILE_MARK = "/* Written by udkjax; a further export replaces this file of the scene "
DIFFERENTIATED_UNITS = {"step_derivatives", "derivatives", "position_derivatives"}
FUNCTIONS: dict[str, Callable[[SceneCode], tuple[str, CUnit]]] = {name: getattr(SceneCode, name) for name in FUNCTION_COMMENTS}


class ExportedCode(NamedTuple):
    """C99 that has been written.

    Attributes:
        files: the files.
        prefix: the beginning of the names of all functions.
        memory: number of bytes of memory that each function needs, by the name of the function in `what`.
        flops: largest number of operations on numbers in one evaluation of the accelerations.
    """

    files: list[Path]
    prefix: str
    memory: dict[str, int]
    flops: int


@checked
@concrete_only()
def export_c(
    mechanism: Mechanism,
    folder: Path | str,
    what: Sequence[What] = ("run", "accelerations"),
    ts: Numbers | None = None,
    parameters: Sequence[str] = (),
    rtol: Annotated[float, NOT_NEGATIVE] = 1e-8,
    atol: Annotated[float, NOT_NEGATIVE] = 1e-8,
    stiff: bool = True,
) -> ExportedCode:
    """Write a scene as C99 code that depends only on the C standard library, and allocates no memory.

    The C is a translation of the machine code that `simulate` runs, for one lane: it takes the same steps, and falls back to
    rank-revealing methods in the same singular configurations. `cc -O2 -std=c99 *.c -lm` compiles the folder. The program runs
    the scene, and prints the table that `udkjax simulate --out run.csv` writes. Results equal those of machine code for one
    lane (`UDKJAX_LANES=1`) bit for bit if neither or both fuse products with sums, as C does with -march=native; otherwise
    they differ by rounding.

    Args:
        mechanism: the scene, with concrete numbers. Its thresholds of rank follow from these numbers.
        folder: the folder to write, which is made if it does not exist.
        what: the functions to write: "run" (whole runs, and a single step with projection); "accelerations"; "derivatives" (of
            accelerations, along a direction); "step_derivatives"; "projection" (of a state); "positions" (closed from a guess, as
            for a driven mechanism); "position_derivatives"; "reactions" (loads of joints and efforts of drivers).
        ts: output times of the program (s); by default 0 to 20 s in steps of 0.05 s.
        parameters: names of the numbers that the C code can set, as in `with_parameters`.
        rtol: relative tolerance of a step.
        atol: absolute tolerance of a step, in units of the scene's characteristic length and time.
        stiff: whether a run switches to an implicit method where it is stiff; without this it needs less memory.

    Returns:
        The files written, with the memory and the number of operations that each function needs.

    Raises:
        ArgumentError: the scene has joints that stick, forces with kinks, or equations without machine code; or a file
            that udkjax did not write would be replaced.
        AssemblyError: the initial guess cannot be closed.
    """
    mechanism.require_masses("exported accelerations")
    times = 0.05 * np.arange(401) if ts is None else np.asarray(ts, float)
    if times.ndim != 1 or len(times) < 2 or not (np.diff(times) > 0).all():
        raise ArgumentError("ts must be at least two increasing times")
    unknown = [name for name in what if name not in FUNCTIONS]
    if unknown or not what:
        raise ArgumentError(f"what must be a list of {', '.join(FUNCTIONS)}, not {', '.join(unknown) or 'empty'}")
    scene = SceneCode(mechanism, times, rtol, atol, stiff)
    found, units = scene_files(scene, what, parameters)
    if "run" in units:
        found["main.c"] = _main(scene)
    to = Path(folder)
    mark = f"{FILE_MARK}{scene.prefix}. */\n"
    _clear(to, found, mark)
    for name, text in found.items():
        (to / name).write_text(mark + text, encoding="ascii", errors="backslashreplace")
    flops = max((unit.flops.get("accelerations", 0) for unit in units.values()), default=0)
    return ExportedCode([to / name for name in found], scene.prefix, {k: 8 * u.memory for k, u in units.items()}, flops)


def _clear(folder: Path, names: Collection[str], mark: str) -> None:
    """Make a folder, and remove files of earlier exports of the scene from it: `cc *.c` would compile these as well.

    Raise `ArgumentError` if it has a file with one of the `names` that udkjax did not write.
    """
    folder.mkdir(parents=True, exist_ok=True)
    heads = {file: file.read_bytes()[: len(mark)].decode(errors="replace") for file in folder.glob("*.[ch]") if file.is_file()}
    if foreign := [file.name for file, head in heads.items() if file.name in names and not head.startswith(FILE_MARK)]:
        raise ArgumentError(f"{folder} has {', '.join(foreign)}, which udkjax did not write: choose another folder")
    for file, head in heads.items():
        if head == mark:
            file.unlink()


def scene_files(scene: SceneCode, what: Sequence[str], parameters: Sequence[str]) -> tuple[dict[str, str], dict[str, CUnit]]:
    """Return the texts of the files of a scene by name, and the units of the functions in `what` by their names there."""
    units = {name: FUNCTIONS[name](scene) for name in FUNCTIONS if name in what}
    names = scene.parameters(parameters)
    header = _header(scene, {name: unit for name, (_, unit) in units.items()}, names[1])
    files = {f"{scene.prefix}.h": header, f"{scene.prefix}_numbers.c": _numbers(scene, names)}
    files |= {f"{scene.prefix}_{name}.c": text for name, (text, _) in units.items()}
    if DIFFERENTIATED_UNITS & {*units}:
        files[f"{scene.prefix}_along.c"] = f'#include "{scene.prefix}.h"\n{scene.parameters(parameters, along=True)[0]}'
    return files, {name: unit for name, (_, unit) in units.items()}


def _header(scene: SceneCode, units: dict[str, CUnit], parameters: dict[str, float]) -> str:
    p, big = scene.prefix, scene.prefix.upper()
    flops = max((unit.flops.get("accelerations", 0) for unit in units.values()), default=0)
    fill = {"loads": "; ".join(f"{name} on {body}" for name, body in scene.load_names)}
    fill |= {"drivers": ", ".join(scene.mechanism.driver_names) or "none"}
    fill = {key: comment_text(x) for key, x in fill.items()}
    fill |= {"p": p, "N": f"{big}_COORDINATES", "info": ", ".join(RunStates.info_names)}
    memory = "\n".join(
        f"#define {big}_{k.upper()}_MEMORY {u.memory} /* numbers, {8 * u.memory} bytes */" for k, u in units.items()
    )
    documented = "\n".join(FUNCTION_COMMENTS[name].format(**fill) for name in units)
    documented += f"\n{PARAMETERS_ALONG_TEXT.format(p=p)}" if DIFFERENTIATED_UNITS & {*units} else ""
    bodies = comment_text(", ".join(scene.mechanism.body_names))
    return f"""/* {comment_text(scene.mechanism.name or "a mechanism")}, by udkjax {versions()["udkjax"]}.

   A state is q, with x and y (m) and the angle (rad) of each body ({bodies}), and v, their rates. `numbers` are
   the scene's numbers, {p}_numbers or a copy with other parameters. `memory` is given by the caller: as many numbers as
   the constant of its function says, with any content. Functions keep nothing else, so that threads may call them at the
   same time, each with its own memory. The accelerations take {flops} operations, plus divisions and roots. */

#ifndef {big}_H
#define {big}_H

#define {big}_COORDINATES {scene.n}
#define {big}_NUMBERS {len(scene.numbers)}
#define {big}_PARAMETERS {len(parameters)}
#define {big}_INFO {len(INFO_PLACES) + 2 * scene.n}
{memory}

extern const double {p}_numbers[{big}_NUMBERS];
extern const double {p}_q0[{big}_COORDINATES], {p}_v0[{big}_COORDINATES]; /* the closed initial state */

/* Write the numbers that depend on the parameters ({comment_text(", ".join(parameters)) or "none"}) into `values`. */
void {p}_set_parameters(const double *parameters, double *values);

/* Describe the result of a run. */
const char *{p}_result_name(int result);

{documented}
#endif
"""


def _numbers(scene: SceneCode, parameters: tuple[str, dict[str, float]]) -> str:
    p, big = scene.prefix, scene.prefix.upper()
    results = {int(result): str(result.label) for result in Result}
    cases = "\n".join(f'    case {k}: return "{text}";' for k, text in sorted(results.items()))
    return f"""#include "{p}.h"
{parameters[0]}
const double {p}_numbers[{big}_NUMBERS] = {{
    {table(scene.numbers)}}};
const double {p}_q0[{big}_COORDINATES] = {{
    {table(scene.inputs["q"])}}};
const double {p}_v0[{big}_COORDINATES] = {{
    {table(scene.inputs["v"])}}};

const char *{p}_result_name(int result)
{{
    switch (result) {{
{cases}
    default: return "unknown";
    }}
}}
"""


def _main(scene: SceneCode) -> str:
    p, big, rates = scene.prefix, scene.prefix.upper(), ("vx", "vy", "omega")
    bodies = [x for x in scene.mechanism.body_names if x != GROUND]
    units = ("m", "m", "rad"), ("m/s", "m/s", "rad/s")
    columns = [f"body.{b}.{x} [{u}]" for names, of in zip((("x", "y", "angle"), rates), units, strict=True)
               for b in bodies for x, u in zip(names, of, strict=True)]  # fmt: skip
    counts = ", ".join(f"info[{INFO_PLACES[name]}]" for name in ("t", "tried", "accepted", "evaluations"))
    quoted = [f'"{x.replace(chr(34), 2 * chr(34))}"' if re.search(r'[",\n\r]', x) else x for x in columns]  # as in tables of runs
    heading = ",\n    ".join(string_text(f",{x}") for x in quoted)
    return f"""/* Run the scene, and print its motion: a table with a row for each time. */
#include <stdio.h>
#include "{p}.h"

enum {{ N = {big}_COORDINATES, TIMES = {len(scene.ts)} }};

static const double ts[TIMES] = {{
    {table(scene.ts)}}};
static const char *const columns[] = {{
    {heading}}};
static double qs[TIMES * N], vs[TIMES * N], violation[TIMES], info[{big}_INFO], memory[{big}_RUN_MEMORY];

int main(void)
{{
    const int result = {p}_run({p}_numbers, ts, TIMES, {p}_q0, {p}_v0, qs, vs, violation, info, memory);
    double worst = 0.0;
    fputs("time [s]", stdout);
    for (int i = 0; i < 2 * N; i++) fputs(columns[i], stdout);
    putchar('\\n');
    for (int k = 0; k < TIMES; k++) {{
        printf("%.17g", ts[k]);
        for (int i = 0; i < N; i++) printf(",%.17g", qs[k * N + i]);
        for (int i = 0; i < N; i++) printf(",%.17g", vs[k * N + i]);
        putchar('\\n');
        worst = violation[k] > worst ? violation[k] : worst;
    }}
    fprintf(stderr, "%s at %g s: %g steps, %g accepted, %g right-hand sides; constraint violation at most %.3g\\n",
        {p}_result_name(result), {counts}, worst);
    return result != 0;
}}
"""
