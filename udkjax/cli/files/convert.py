"""`udkjax convert`."""

from pathlib import Path
from typing import Annotated, Literal

import tyro

from udkjax.cli.common import Json, Scene, load, show
from udkjax.cli.datasets import check_target


def convert(
    scene: Scene,
    target: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="TARGET.toml|TARGET.xml")],
    /,
    leave_out: tuple[Literal["limits", "frictionloss", "forceranges", "contacts"], ...] = (),
    key: str | None = None,
    json: Json = False,
) -> None:
    """Convert between scene files and MJCF models; refuse elements that the target format cannot represent.

    Loops are closed first.

    Args:
        scene: a scene file, or an MJCF model.
        target: file to write: .toml, a scene file; .xml, an MJCF model.
        leave_out: elements of an MJCF model that may be left out.
        key: keyframe of an MJCF model that gives the initial state.
    """
    check_target(target, (".toml", ".xml"), "target")
    mechanism, _ = load(scene, leave_out, key)

    import udkjax as udk

    if target.suffix.lower() == ".xml":
        state = udk.assemble(mechanism)
        fields = ("position", "angle", "velocity", "angular_velocity")
        values = (state.q[:, :2], state.q[:, 2], state.v[:, :2], state.v[:, 2])
        assembled = {
            f"body.{name}.{f}": x[k] for k, name in enumerate(mechanism.body_names) for f, x in zip(fields, values, strict=True)
        }
        mechanism = mechanism.with_parameters(assembled)
    udk.save(mechanism, target)
    counts = {"bodies": len(mechanism.bodies), "joints": len(mechanism.joints), "forces": len(mechanism.forces)}
    text = ", ".join(f"{count} {name}" for name, count in counts.items())
    show({"file": target, **counts}, f"wrote {target} ({text})", json)
