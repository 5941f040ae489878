"""Optional packages, and how to install missing ones."""

from importlib.util import find_spec
from types import TracebackType

# The extras of pyproject.toml by the top-level modules that they install.
EXTRAS = {
    "PIL": "plot",
    "anywidget": "notebook",
    "dask": "dask",
    "distributed": "dask",
    "ezdxf": "dxf",
    "h5netcdf": "io",
    "h5py": "io",
    "imageio_ffmpeg": "video",
    "matplotlib": "plot",
    "optax": "identify",
    "pandas": "io",
    "starlette": "studio",
    "tomlkit": "studio",
    "tyro": "cli",
    "uvicorn": "studio",
    "xarray": "io",
}


class MissingExtraError(ModuleNotFoundError):
    """A package is missing that an extra of udkjax installs."""


class OptionalImport:
    """Inside `with OptionalImport():`, a missing package of an extra raises an error that explains how to install it.

    Other import errors are passed on unchanged.
    """

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if isinstance(error, ModuleNotFoundError) and not isinstance(error, MissingExtraError) and cure(error):
            raise MissingExtraError(cure(error), name=error.name, path=error.path) from None


def require(*packages: str) -> None:
    """Raise `MissingExtraError` if one of these packages is missing, before work that needs them begins."""
    for package in packages:
        if find_spec(package) is None:
            raise MissingExtraError(cure(ModuleNotFoundError(name=package)), name=package)


def cure(error: ModuleNotFoundError) -> str:
    """Return the command that installs a missing package; an empty string if no extra contains it."""
    missing = (error.name or "").partition(".")[0]
    if missing not in EXTRAS:
        return ""
    return f"{missing} is not installed: pip install '.[{EXTRAS[missing]}]' in the folder of udkjax"
