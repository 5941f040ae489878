"""What the commands share: how they read a scene, refuse wrong input, and end."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import tyro

if TYPE_CHECKING:
    from udkjax import Mechanism

BAD_RUN, BAD_INPUT, INTERRUPTED = 1, 2, 130  # exit codes; the last as of a shell

Scene = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE.toml")]


def load(scene: Path) -> tuple["Mechanism", str]:
    """Read a scene and its text, or say everything that is wrong with it and exit."""
    import udkjax as udk

    try:
        return udk.load(scene), scene.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as problem:
        refuse(f"cannot read {scene}: {problem}")
    except udk.SceneError as problem:
        refuse(str(problem))


def refuse(problem: str) -> NoReturn:
    """Say what is wrong with the input, and exit."""
    print(f"udkjax: {problem}", file=sys.stderr)
    sys.exit(BAD_INPUT)
