"""`udkjax export`."""

from pathlib import Path
from typing import Literal

from udkjax.cli.common import Json, Scene, load, output_times, refuse, show
from udkjax.cli.datasets import check_folder


def export(
    scene: Scene,
    /,
    c: Path,
    what: tuple[Literal["run", "accelerations", "projection", "positions"], ...] = ("run", "accelerations"),
    parameters: tuple[str, ...] = (),
    t1: float = 20.0,
    dt: float = 0.05,
    t0: float = 0.0,
    rtol: float = 1e-8,
    atol: float = 1e-8,
    stiff: bool = True,
    json: Json = False,
) -> None:
    """Write a scene as C99, which runs without Python.

    Args:
        scene: the mechanism.
        c: folder to write; `cc -O2 -std=c99 *.c -lm` compiles it to a program that prints the motion as a table.
        what: functions to write.
        parameters: numbers of the scene that can be set at run time, such as body.link1.mass or pin.A.
        t1: end of the program's run (s).
        dt: time between its outputs (s).
        t0: start of its run (s).
        rtol: relative tolerance of a step.
        atol: absolute tolerance of a step, in units of the scene's characteristic length and time.
        stiff: whether a run goes on by an implicit method where it is stiff; without, it needs less memory.
    """
    ts = output_times(t0, t1, dt)
    check_folder(c)
    if not what:
        refuse("--what: name at least one function")
    mech, _ = load(scene)

    import udkjax as udk
    from udkjax.show.summary import table

    found = udk.export_c(mech, c, what, ts, parameters, rtol, atol, stiff)
    lines = {
        "functions": ", ".join(f"{found.prefix}_{name}" for name in found.memory),
        "memory": ", ".join(f"{name} {size} bytes" for name, size in found.memory.items()),
        "accelerations": f"at most {found.flops} operations on numbers",
        "wrote": ", ".join(file.name for file in found.files),
        "compile": f"cd {c} && cc -O2 -std=c99 *.c -o run -lm",
    }
    show(found._asdict(), table(f"{mech.name or 'mechanism'}, C99", lines), json)
