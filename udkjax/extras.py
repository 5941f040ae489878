"""Optional packages, and how to install missing ones."""

from collections.abc import Sequence
from importlib.util import find_spec
from types import TracebackType

# The extras of pyproject.toml by the top-level modules that they install.
EXTRAS = {
    "PIL": "plot",
    "anywidget": "notebook",
    "arviz": "bayes",
    "dask": "dask",
    "distributed": "dask",
    "ezdxf": "dxf",
    "flatbuffers": "export",
    "h5netcdf": "io",
    "h5py": "io",
    "imageio_ffmpeg": "video",
    "matplotlib": "plot",
    "optax": "identify",
    "pandas": "io",
    "starlette": "studio",
    "svgelements": "svg",
    "tomlkit": "studio",
    "tyro": "cli",
    "uvicorn": "studio",
    "xarray": "io",
    "ziglang": "zig",
}
# Extras that others bring along.
IMPLIED_EXTRAS = {
    "identify": ("io",),
    "bayes": ("io", "identify"),
    "cli": ("io", "plot", "identify"),
    "dask": ("io",),
    "notebook": ("io", "plot"),
    "video": ("plot",),
    "dxf": ("plot",),
    "studio": ("cli", "io", "plot", "identify"),
}
# The packages that write a pose or a film, by the suffix of its file.
WRITING_PACKAGES = {".png": ("PIL",), ".gif": ("PIL",), ".mp4": ("PIL", "imageio_ffmpeg"), ".dxf": ("ezdxf",)}
NETCDF_PACKAGES = "xarray", "h5netcdf"  # the packages that read and write runs
BAYES_PACKAGES = ("arviz",)  # the package that judges draws from posteriors
EXPORT_PACKAGES = ("flatbuffers",)  # the package with which JAX writes exported functions
ZIG_PACKAGES = ("ziglang",)  # the package with a C compiler for all platforms
STUDIO_PACKAGES = "starlette", "uvicorn", "tomlkit"  # the packages that serve the studio


class MissingExtraError(ModuleNotFoundError):
    """A package that an extra of udkjax installs is missing."""


class OptionalImport:
    """A context for imports of optional packages: if a package of an extra is missing, the error explains how to install it.

    The error is a `MissingExtraError`; other import errors are passed on unchanged.
    """

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if isinstance(error, ModuleNotFoundError) and not isinstance(error, MissingExtraError):
            missing = (error.name or "").partition(".")[0]
            if missing in EXTRAS:
                raise MissingExtraError(cure([missing]), name=error.name, path=error.path) from None


def require(*packages: str) -> None:
    """Raise `MissingExtraError` if some of these packages are missing, before work that needs them begins."""
    missing = [package for package in packages if find_spec(package) is None]
    if missing:
        raise MissingExtraError(cure(missing), name=missing[0])


def cure(missing: Sequence[str]) -> str:
    """Return a message that names missing packages, with the command that installs them by as few extras as possible."""
    extras = {EXTRAS[package] for package in missing}
    brought = {other for extra in extras for other in IMPLIED_EXTRAS.get(extra, ())}
    names = ",".join(sorted(extras - brought))
    packages = " and ".join(filter(None, [", ".join(missing[:-1]), missing[-1]]))
    return f"{packages} {'is' if len(missing) == 1 else 'are'} not installed: pip install 'udkjax[{names}]'"
