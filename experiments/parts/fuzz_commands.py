"""Command lines that are wrong: options, values and files of every command."""

import contextlib
import functools
import io
import os
import shutil
import tempfile
from pathlib import Path

import numpy as np

from experiments.parts.fuzz import Case

SCENES = Path(__file__).parents[2] / "examples"
COMMANDS = {
    name: line.split()
    for name, line in {
        "check": "SCENE",
        "diagnose": "SCENE --t 0 --t1 0.1 --dt 0.05",
        "explain": "SCENE --t 0",
        "statics": "SCENE --starts 1 --seed 0 --t 0 --out found.csv",
        "modes": "SCENE --t 0 --out found.csv",
        "kinematics": "SCENE --driver body.rod.angle --from 0 --to 0.1 --count 3 --rate 1 --out found.csv",
        "inverse": "SCENE --t1 0.1 --t0 0 --dt 0.05 --drivers motor --out found.csv",
        "simulate": "SCENE --t1 0.1 --out run.npz --dt 0.05 --rtol 1e-6 --atol 1e-6 --method auto --solver dopri8 "
        "--formulation udwadia-kalaba --stabilization projection --max-steps 100",
        "animate": "SCENE --t1 0.1 --out film.html",
        "sweep": "grid.toml --out sweep",
        "identify": "SCENE data.csv --parameters body.rod.mass --out fit",
        "doctor": "--nothing 1",
    }.items()
}
WEIGHTS = {
    "check": 6,
    "simulate": 6,
    "kinematics": 4,
    "inverse": 4,
    "statics": 3,
    "modes": 3,
    "diagnose": 3,
    "explain": 3,
    "animate": 2,
}
VALUES = (
    *"nan inf -inf -1 0 1e999 1e308 1.5 text -- - true None [1] 1,2 ground ü / . found found.xyz found.csv motor".split(),
    *("", " ", "no/such/folder/file.csv", "x" * 300, "9" * 400, "body.nobody.angle"),
)
FILES: dict[str, bytes] = {
    "empty.toml": b"",
    "binary.toml": bytes(range(256)),
    "text.toml": b"this is no scene",
    "other.toml": b"format = 2\n",
    "nothing.toml": b"format = 1\n",
    "deep.toml": b"a = " + b"[" * 3000,
    "grid.toml": b"[axes]\nrtol = [1e-6]\n",
    "data.csv": b"time,x\n0,1\n0,nan\ntext\n",
    "scene.json": b'{"format": 1}',
}


def draw(rng: np.random.Generator) -> Case:
    """Draw a command line with one mistake or two."""
    names = list(COMMANDS)
    weights = np.array([WEIGHTS.get(name, 1) for name in names], float)
    command = str(rng.choice(names, p=weights / weights.sum()))
    scene = str(rng.choice(["simple_pendulum", "driven_pendulum"], p=[0.6, 0.4]))
    words = [f"{scene}.toml" if word == "SCENE" else word for word in COMMANDS[command]]
    what = []
    for _ in range(1 if rng.random() < 0.8 else 2):
        options = [k for k, word in enumerate(words) if word.startswith("--") and k + 1 < len(words)]
        kind = int(rng.integers(6))
        if kind < 3 and options:
            k = int(rng.choice(options))
            words[k + 1] = VALUES[rng.integers(len(VALUES))]
            what.append(words[k])
        elif kind == 3:
            words[0] = str(rng.choice([*FILES, ".", "/", "no_such.toml", "simple_pendulum", ""]))
            what.append("file")
        elif kind == 4:
            k = int(rng.integers(len(words)))
            what.append(f"without {words[k]}" if words[k].startswith("--") else "without a value")
            del words[k]
        else:
            k = int(rng.integers(len(words) + 1))
            word = str(rng.choice(["--no-such", "--t2=1", "-x", "--help", "extra", "--json", "--json", "--t1", "--out"]))
            words.insert(k, word)
            what.append(f"with {word}")
        if not words:
            break
    return Case(f"{command}: {', '.join(what)}", functools.partial(run, [command, *words]))


def run(words: list[str]) -> None:
    """Run a command line in an empty folder; raise what it lets through, or AssertionError for words and files that are wrong."""
    from udkjax.cli import main

    home, folder = Path.cwd(), Path(tempfile.mkdtemp(dir="."))
    os.chdir(folder)
    for name, content in FILES.items():
        Path(name).write_bytes(content)
    for scene in ("simple_pendulum", "driven_pendulum"):
        shutil.copy(SCENES / f"{scene}.toml", ".")
    before, code, out, err = set(os.listdir()), 0, io.StringIO(), io.StringIO()
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            try:
                main(words)
            except SystemExit as end:
                code = end.code if isinstance(end.code, int) else 0 if end.code is None else 1
        made = sorted(set(os.listdir()) - before)
        said = err.getvalue() + out.getvalue()
        if code not in (0, 1, 2):
            raise AssertionError(f"exit code {code}: {words}")
        if code and not said.strip():
            raise AssertionError(f"no word: {words}")
        if "Traceback" in said:
            raise AssertionError(f"a traceback: {words}")
        if code == 2 and made:
            raise AssertionError(f"refused, and leaves {made}: {words}")
        if hidden := [name for name in made if name.startswith(".") or name.endswith((".tmp", ".part"))]:
            raise AssertionError(f"leaves {hidden}: {words}")
    finally:
        os.chdir(home)
        shutil.rmtree(folder, ignore_errors=True)
