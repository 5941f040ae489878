"""`udkjax export`."""

from pathlib import Path
from typing import Any, Literal

from udkjax.cli.common import Json, Scene, load, output_times, refuse, show
from udkjax.cli.datasets import check_folder
from udkjax.cli.options import refuse_without_effect

What = Literal[
    "run", "step_derivatives", "accelerations", "derivatives", "projection", "positions", "position_derivatives", "reactions"
]
DEFAULT_FUNCTIONS = "run", "accelerations"  # of C by default


def export(
    scene: Scene,
    /,
    c: Path | None = None,
    fmu: Path | None = None,
    what: tuple[What, ...] = DEFAULT_FUNCTIONS,
    kinds: tuple[Literal["co-simulation", "model-exchange"], ...] = ("co-simulation", "model-exchange"),
    parameters: tuple[str, ...] | None = None,
    inputs: tuple[str, ...] | None = None,
    outputs: tuple[str, ...] | None = None,
    platforms: tuple[str, ...] | None = None,
    t1: float = 20.0,
    dt: float = 0.05,
    t0: float = 0.0,
    rtol: float = 1e-8,
    atol: float = 1e-8,
    stiff: bool = True,
    json: Json = False,
) -> None:
    """Write a scene as C99 or as an FMU, which run without Python.

    Args:
        scene: the mechanism.
        c: folder to write; `cc -O2 -std=c99 *.c -lm` compiles it to a program that prints the motion as a table.
        fmu: FMU to write, by FMI 3.0.
        what: functions of C to write.
        kinds: interfaces of the FMU.
        parameters: numbers of the scene that can be set before a run, such as body.link1.mass or pin.A; by default none in C, and
            all in an FMU.
        inputs: numbers of the scene that can be set during a run of an FMU; by default those of torques and forces.
        outputs: outputs of an FMU besides the coordinates of bodies, such as pin.A.x or joint.A.angle; by default positions and
            velocities of all pins that move.
        platforms: platforms of the FMU, such as x86_64-linux; by default this one. Others need the extra zig.
        t1: end of the program's run, or of the FMU's default experiment (s).
        dt: time between outputs, or the step of the default experiment (s).
        t0: start of the run (s).
        rtol: relative tolerance of a step.
        atol: absolute tolerance of a step, in units of the scene's characteristic length and time.
        stiff: whether a run goes on by an implicit method where it is stiff; without, it needs less memory.
    """
    if (c is None) == (fmu is None):
        refuse("give --c FOLDER for C99, or --fmu FILE for an FMU")
    ts = output_times(t0, t1, dt)
    if fmu is not None:
        refuse_without_effect(["--what"], "with --fmu: it names functions of --c")
        if fmu.suffix != ".fmu" or not fmu.parent.is_dir() or fmu.is_dir():
            refuse(f"--fmu {fmu}: give the name of a file that ends in .fmu, in a folder that exists")
        mech, _ = load(scene)
        _fmu(mech, fmu, (kinds, parameters, inputs, outputs, t0, t1, dt, rtol, atol, stiff, platforms), json)
        return
    assert c is not None
    refuse_without_effect(["--kinds", "--inputs", "--outputs", "--platforms"], "with --c: it is for an FMU, --fmu")
    check_folder(c, "--c")
    if not what:
        refuse("--what: name at least one function")
    mech, _ = load(scene)

    import udkjax as udk
    from udkjax.show.summary import table

    found = udk.export_c(mech, c, what, ts, parameters or (), rtol, atol, stiff)
    lines = {
        "functions": f"{', '.join(found.memory)}; {found.prefix}.h describes them",
        "memory": ", ".join(f"{name} {size} bytes" for name, size in found.memory.items()),
        "accelerations": f"at most {found.flops} operations on numbers",
        "wrote": ", ".join(file.name for file in found.files),
        "compile": f"cd {c} && cc -O2 -std=c99 *.c {'-o run -lm' if 'run' in found.memory else '-c'}",
    }
    show(found._asdict(), table(f"{mech.name or 'mechanism'}, C99", lines), json)


def _fmu(mech: Any, fmu: Path, options: tuple[Any, ...], json: bool) -> None:
    import udkjax as udk
    from udkjax.show.summary import table

    found = udk.export_fmu(mech, fmu, *options)
    lines = {
        "interfaces": ", ".join(found.kinds),
        "outputs": f"{len(found.outputs)}, from {found.outputs[0]} to {found.outputs[-1]}",
        "parameters": str(len(found.parameters)),
        "inputs": ", ".join(found.inputs) or "none",
        "libraries": ", ".join(found.platforms) or "none: importers compile the sources",
        "wrote": str(found.file),
    }
    show(found._asdict(), table(f"{mech.name or 'mechanism'}, FMI 3.0", lines), json)
