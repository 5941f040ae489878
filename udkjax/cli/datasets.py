"""Files written by commands: arrays in the format given by the suffix, with the scene, settings and versions."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from udkjax.cli.common import load, refuse
from udkjax.extras import NETCDF_PACKAGES, OptionalImport, require

if TYPE_CHECKING:
    import numpy as np
    import xarray

    from udkjax import Mechanism
    from udkjax.annotations import Numbers

DATASET_SUFFIXES = (".nc", ".h5", ".csv", ".npz")  # .h5 is also NetCDF, which is based on HDF5
PICTURE_SUFFIXES = (".png", ".svg", ".pdf", ".jpg")
FILE_SUFFIXES = (*DATASET_SUFFIXES, *PICTURE_SUFFIXES, ".html", ".json", ".toml")  # not accepted for a folder

# Names of the columns of a .csv, as in files of measurements: `body.crank.vx [m/s]`.
COLUMN_NAMES = {"q": ("x", "y", "angle"), "v": ("vx", "vy", "omega"), "a": ("ax", "ay", "alpha")}


def check_target(out: Path | None, kinds: Sequence[str] = DATASET_SUFFIXES, option: str = "--out") -> None:
    """Exit with a message if the suffix of a file to write is not in `kinds`, or its folder does not exist; None is accepted."""
    if out is None:
        return
    if out.suffix.lower() not in kinds:
        refuse(f"{option} {out} must end with one of {', '.join(kinds)}")
    if not out.parent.is_dir():
        refuse(f"cannot write {out.name}: there is no folder {out.parent}")


def load_to_write(scene: Path, out: Path | None, plot: Path | None = None) -> tuple["Mechanism", str]:
    """Return a scene and its text; exit with a message if the output files `out` and `plot` cannot be written."""
    check_target(out)
    check_target(plot, PICTURE_SUFFIXES, "--plot")
    require(*(NETCDF_PACKAGES if out else ()), *(["matplotlib"] if plot else ()))
    return load(scene)


def check_folder(out: Path, option: str = "--out") -> None:
    """Exit with a message if a folder to write cannot be created, or is named like a file."""
    if out.exists() and not out.is_dir():
        refuse(f"{option} {out} is not a folder")
    if not out.exists() and out.suffix.lower() in FILE_SUFFIXES:
        refuse(f"{option} {out}: a folder with several files is written; give a name without {out.suffix}")
    if not out.parent.is_dir():
        refuse(f"cannot create {out.name}: there is no folder {out.parent}")


def write(
    out: Path | None,
    scene: str,
    variables: Mapping[str, "tuple[Sequence[str], Numbers, str]"],
    coordinates: Mapping[str, "Numbers"],
    settings: Mapping[str, object],
) -> None:
    """Write variables and coordinates with the scene, settings and versions to a file in the format given by its suffix.

    Args:
        out: the file; None to write nothing.
        scene: text of the scene.
        variables: dimensions, values and unit of each variable, by name.
        coordinates: values along dimensions, by dimension.
        settings: settings of the command by name; those with the value None are left out.
    """
    if out is None:
        return
    from udkjax.integrate.solution import versions
    from udkjax.scene.elements.bodies import COORDINATES

    with OptionalImport():
        import xarray
    import numpy as np

    data = {name: (tuple(dims), np.asarray(values), {"units": unit}) for name, (dims, values, unit) in variables.items()}
    attributes = {"scene": scene, **{f"setting_{k}": v for k, v in settings.items() if v is not None}}
    attributes |= {f"version_{k}": v for k, v in versions().items()}
    labels = {"coordinate": list(COORDINATES)} if any("coordinate" in dims for dims, _, _ in variables.values()) else {}
    save(xarray.Dataset(data, {**coordinates, **labels}, attributes), out)


def save(data: "xarray.Dataset", out: Path) -> None:
    """Write a dataset in the format given by the suffix of the file.

    A .csv contains only the numbers, one row per entry of the first dimension; the other formats contain the attributes, too.
    """
    kind = out.suffix.lower()
    if kind == ".csv":
        import numpy as np
        import pandas  # required by xarray

        pandas.DataFrame(dict(_columns(data))).replace([np.inf, -np.inf], np.nan).to_csv(out, index=False)
    elif kind == ".npz":
        import json

        import numpy as np

        arrays: dict[str, Any] = {str(name): np.asarray(values) for name, values in data.variables.items()}
        with out.open("wb") as file:
            np.savez_compressed(file, attributes=np.asarray(json.dumps(data.attrs, default=str)), **arrays)
    else:
        with OptionalImport():
            import h5netcdf  # noqa: F401  # the engine

        data.to_netcdf(out, engine="h5netcdf")


def _columns(data: "xarray.Dataset") -> "Iterator[tuple[str, np.ndarray]]":
    """Yield the columns of a table, each a heading and its values along the first dimension, from a dataset."""
    import numpy as np

    first_dim = str(next(iter(data.data_vars.values())).dims[0])
    count = data.sizes[first_dim]
    yield (
        _heading(first_dim, data[first_dim].attrs.get("units", "")),
        np.asarray(data[first_dim] if first_dim in data.coords else range(count)),
    )
    for name, variable in data.data_vars.items():
        other_dims = [str(dim) for dim in variable.dims if dim != first_dim]
        if first_dim not in variable.dims:
            variable = variable.expand_dims({first_dim: count})
        table = np.asarray(variable.transpose(first_dim, *other_dims)).reshape(count, -1)
        labels = [[str(x) for x in np.asarray(variable[dim])] if dim in data.coords else None for dim in other_dims]
        units = str(variable.attrs.get("units", "")).split(", ", 2)
        for k, index in enumerate(np.ndindex(*(variable.sizes[dim] for dim in other_dims))):
            words = [str(i) if names is None else names[i] for names, i in zip(labels, index, strict=True)]
            if name in COLUMN_NAMES and other_dims == ["body", "coordinate"]:
                words = ["body", words[0], COLUMN_NAMES[str(name)][index[1]]]
            else:
                words = [str(name), *words]
            unit = units[index[-1]] if other_dims and other_dims[-1] == "coordinate" and len(units) == 3 else ", ".join(units)
            yield _heading(".".join(words), unit), table[:, k]


def _heading(name: str, unit: str) -> str:
    return f"{name} [{unit}]" if unit else name
