"""How commands write arrays to a NetCDF file, with what a reader needs to trust them."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from udkjax.cli.common import refuse

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


def check_target(out: Path | None) -> None:
    """Refuse a file that has no folder."""
    if out is not None and not out.parent.is_dir():
        refuse(f"there is no folder {out.parent} to write {out.name} to")


def write(
    out: Path | None,
    scene: str,
    variables: Mapping[str, "tuple[Sequence[str], ArrayLike, str]"],
    coordinates: Mapping[str, "ArrayLike"],
    settings: Mapping[str, object],
) -> None:
    """Write variables, each its dimensions, values and unit, to a file if there is to be one, with the scene and versions.

    The coordinates of bodies are labelled where a variable lies along them.
    """
    if out is None:
        return
    from udkjax.extras import OptionalImport
    from udkjax.integrate.solution import versions
    from udkjax.scene.bodies import COORDINATES

    with OptionalImport():
        import h5netcdf  # noqa: F401  # the engine
        import xarray
    import numpy as np

    data = {name: (tuple(dims), np.asarray(values), {"units": unit}) for name, (dims, values, unit) in variables.items()}
    attributes = {"scene": scene, **{f"setting_{k}": v for k, v in settings.items() if v is not None}}
    attributes |= {f"version_{k}": v for k, v in versions().items()}
    labels = {"coordinate": list(COORDINATES)} if any("coordinate" in dims for dims, _, _ in variables.values()) else {}
    xarray.Dataset(data, {**coordinates, **labels}, attributes).to_netcdf(out, engine="h5netcdf")
