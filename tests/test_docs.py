"""The documentation is correct: code blocks print the stated results; names, files, commands and links exist.

A block of Python states its output in a comment on the line, `print(x)  # -> 3.14 (m)`, or in a following block of `text`, in
which `...` stands for anything. Numbers agree to the digits that are shown; text in brackets after two spaces is a comment.
"""

import ast
import builtins
import importlib
import inspect
import re
import shlex
import sys
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import pytest

import udkjax
from udkjax.cli import COMMANDS, command
from udkjax.cli import main as udkjax_cli
from udkjax.scene.tables.schema import CLASSES_BY_TYPE, keys

ROOT = Path(__file__).parents[1]
OTHERS = [ROOT / name for name in ("CONTRIBUTING.md", "experiments/README.md", "benchmarks/README.md")]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")), *OTHERS]
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```", re.S | re.M)
LINK = re.compile(r"\]\(([^)#\s]+)")
NUMBER = re.compile(r"[-+]?\d+\.?\d*(?:e[-+]?\d+)?")
CODE = re.compile(r"`([^`\n]+)`")


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


every_page = pytest.mark.parametrize("page", PAGES, ids=name_of)


sys.path.insert(0, str(ROOT / "docs"))
pages = importlib.import_module("pages")
pictures = importlib.import_module("pictures")
reference = importlib.import_module("reference_tables")

# --- blocks


def agrees(printed: str, said: str) -> bool:
    """Return True if the output agrees with the stated one: numbers to the digits shown, other text exactly except for spaces."""
    pattern = "".join(".*" if part == "..." else re.escape(part) for part in re.split(r"(\.\.\.)", NUMBER.sub("0", said)))
    if not re.fullmatch(re.sub(r"(\\[ \n])+", r"\\s+", pattern), NUMBER.sub("0", printed).strip(), re.S):
        return False
    numbers = zip(NUMBER.findall(printed), NUMBER.findall(said))  # with `...`, those before it
    return "..." in said or all(abs(float(a) - float(b)) <= 0.501 * digit(b) for a, b in numbers)


def digit(number: str) -> float:
    """Return the value of one unit in the last digit of a number as written."""
    mantissa, _, exponent = number.partition("e")
    return 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))


def untrue(text: str, names: dict, after: Callable[[str, dict], object] | None = None) -> list[str]:
    """Run the blocks of a page in order; return the outputs that differ from the stated ones, by line.

    `after` is called with the text of a block of Python and with all names, after the block has run.
    """
    wrong, printed, lines = [], [], text.splitlines()

    def show(*values, sep=" ", **_):
        line = sys._getframe(1).f_lineno
        printed.append(sep.join(map(str, values)))
        said = lines[line - 1].partition("# -> ")[2].split("  (")[0].strip()
        if said and not agrees(printed[-1], said):
            wrong.append(f"line {line}: prints {printed[-1]}")

    names["print"], end = show, 0
    for found in BLOCK.finditer(text):
        start = text[: found.start(2)].count("\n")
        if found[1] == "python":
            printed.clear()
            exec(compile("\n" * start + found[2], "page", "exec"), names)  # so that an error names the line of the page
            if after is not None:
                after(found[2], names)
            end = found.end()
        elif (
            found[1] == "text"
            and end
            and not text[end : found.start()].strip()
            and not agrees("\n".join(printed), found[2].strip())
        ):
            wrong.append(f"line {start}: prints\n" + "\n".join(printed))
    return wrong


@pytest.mark.parametrize(
    ("page", "wrong"),
    [
        ("print(3.14159)  # -> 3.14", 0),
        ("print(3.14159)  # -> 3.15", 1),
        ("print('a', 2e-9)  # -> a 2e-09  (m)", 0),
        ("print('a', 2e-9)  # -> b 2e-09  (m)", 1),
        ("print(1)\nprint(2)\n```\n\n```text\n1\n2\n", 0),
        ("print(1)\nprint(2)\n```\n\n```text\n1\n3\n", 1),
        ("print(1, 'and much more')\n```\n\n```text\n1 and...\n", 0),
    ],
)
def test_a_false_claim_is_noticed(page, wrong):
    assert len(untrue(f"```python\n{page}\n```\n", {})) == wrong


# With the slow tests, and where all checks run: the other pages, each of which compiles programs of its own.
FIRST = ("README.md",)


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(p, id=name_of(p), marks=[] if name_of(p) in FIRST else pytest.mark.slow)
        for p in PAGES
        if "```python" in p.read_text() or pictures.PICTURE.search(p.read_text())
    ],
)
def test_its_blocks_run_and_print_what_it_says(page, tmp_path, monkeypatch):
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.chdir(tmp_path)
    text, names = page.read_text(), {"__name__": "__page__"}
    if page.parent.name == "reference":
        examples = Examples(text)
        assert untrue(text, names, examples.after) == []
        assert examples.absent == []
        return
    assert untrue(text, names) == []
    for code, _, target in pictures.PICTURE.findall(text):
        drawn, there = pictures.draw(code, names), pictures.stored(page.parent / target)
        assert pictures.differ(pictures.numbers(drawn), there) == [], f"run: python docs/pictures.py {name_of(page)}"


class Examples:
    """The examples of a page of the reference: each runs after the first block alone, and has what it is an example of."""

    def __init__(self, text: str):
        self.groups = {found[4]: reference.DIRECTIVE.findall(found[1]) for found in pages.GROUP.finditer(text)}
        self.first: dict | None = None
        self.absent: list[str] = []

    def after(self, block: str, names: dict) -> None:
        """Note the names of a group that its example neither writes nor has as the type of a variable."""
        types = {cls.__name__ for value in names.values() for cls in type(value).__mro__}
        for name, _ in self.groups.get(block, []):
            own = name.rpartition(".")[2]
            if not re.search(rf"(?:\budk\.(?:\w+\.)?|import ){own}\b", block) and own not in types:
                self.absent.append(own)
        self.first = dict(names) if self.first is None else self.first
        names.clear()
        names.update(self.first)


@every_page
def test_its_links_lead_somewhere(page):
    for target in LINK.findall(page.read_text()):
        if not target.startswith(("http:", "https:", "mailto:")):
            assert (page.parent / target).exists(), target


@every_page
def test_a_page_with_commands_says_where_the_command_is(page):
    text = page.read_text()
    if re.search(r"```sh\n(?:[^`]*\n)?udkjax ", text):
        assert ".venv/bin" in text


# --- names


@cache
def sources() -> dict[Path, ast.Module]:
    """Return the modules of the package and of its studies."""
    files = (path for folder in ("udkjax", "experiments", "benchmarks") for path in (ROOT / folder).rglob("*.py"))
    return {path: ast.parse(path.read_text()) for path in files}


ELSEWHERE = "jax jnp numpy np scipy diffrax equinox eqx optax pandas lineax optimistix equinox.internal".split()
LONG = {"jnp": "jax.numpy", "np": "numpy", "eqx": "equinox", "eqxi": "equinox.internal"}


@cache
def identifiers() -> set[str]:
    """Return all names in the package, its studies and .ci/slow: of modules and of Python, keys of dictionaries, of scenes."""
    found = {*dir(builtins), "udk", "udkjax", "pytest", "Args", "Returns", "Raises", "Source"}
    for script in (ROOT / "udkjax/show/player").glob("*.js"):
        found |= set(re.findall(r"\w+", script.read_text()))
    tests = {
        path: ast.parse(path.read_text())
        for path in [ROOT / ".ci" / "slow", ROOT / "tests" / "elements.py", *(ROOT / "tests").glob("*/methods.py")]
    }
    for path, tree in (sources() | tests).items():
        found |= {path.stem, path.parent.name}
        for node in ast.walk(tree):
            for field in ("id", "attr", "arg", "name", "asname"):
                if isinstance(value := getattr(node, field, None), str):
                    found |= set(value.split("."))
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and re.fullmatch(r"[\w.\s]+", node.value):
                found |= set(re.findall(r"\w+", node.value))
    for page in PAGES:
        found |= {word for kind, block in BLOCK.findall(page.read_text()) for word in re.findall(r"\w+", block)}
    return found | {re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower() for name in found}  # types of scene files


def has(owner: object, name: str) -> bool:
    """Return True if an object has an attribute, or a field that only its instances have."""
    return hasattr(owner, name) or any(name in vars(cls).get("__annotations__", {}) for cls in getattr(owner, "__mro__", ()))


def exists(name: str) -> bool:
    """Return True if a dotted name exists: public names and names of other libraries exactly, otherwise each part somewhere."""
    head, *rest = name.replace("udkjax.paper", "experiments.paper").split(".")  # so it is called where it is installed
    if head in ("udk", "udkjax") or (head in udkjax.__all__ and head[0].isupper()):
        owner: object = udkjax if head in ("udk", "udkjax") else getattr(udkjax, head)
        for part in rest:
            if inspect.ismodule(owner) and not hasattr(owner, part):
                try:
                    owner = importlib.import_module(f"{owner.__name__}.{part}")
                    continue
                except ImportError:
                    return False
            if not has(owner, part):
                return False
            owner = getattr(owner, part, None)
            if owner is None:  # a field
                return True
        return True
    if rest and head in ELSEWHERE:
        owner = importlib.import_module(LONG.get(head, head))
        for part in rest:
            if not has(owner, part):
                return False
            owner = getattr(owner, part, None)
        return True
    if name.startswith("JAX_"):  # of the environment
        return hasattr(importlib.import_module("jax").config, name.lower())
    return all(part in identifiers() or part.rstrip("0123456789") in identifiers() for part in (head, *rest))  # spring1, spring2


NAME = re.compile(r"([A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*)(?:\(.*\)|=.*|\[.*)?")
PATH = re.compile(r"[\w.-]+(?:/[\w.-]+)+/?|[\w-]+\.(?:py|md|toml|sh|txt|cff)")
SCENE_NAMES = re.compile(
    r"(?:[A-Z]{4,}\.|body|joint|driver|force|pin|link|length|angle|point|gravity)\b[\w.(), -]*(?:\[.*\])*(?: \[.*\])?"
)


def missing(text: str) -> Iterator[str]:
    """Return the texts in backticks that look like a name or a file and do not exist."""
    for code in CODE.findall(text):
        if PATH.fullmatch(code):
            if not any(
                (base / code).exists() for base in (ROOT, ROOT / "udkjax", ROOT / "docs", *{p.parent for p in sources()})
            ) and not (
                ("." not in code and exists(code.replace("/", ".")))
                or re.match(r"[A-Za-z]\w*\.(toml|py|md)$|[\w/]*[A-Z]+[/.]", code)
            ):
                yield code
        elif (found := NAME.fullmatch(code)) and not SCENE_NAMES.fullmatch(code) and not exists(found[1]):
            yield code


@every_page
def test_its_names_and_files_exist(page):
    assert list(missing(BLOCK.sub("", page.read_text()))) == []


@pytest.mark.parametrize("section", CLASSES_BY_TYPE)
def test_the_page_of_the_format_has_a_row_for_each_type_with_its_keys(section):
    """A type may have several rows: together they name all keys. The introductions name the keys that all types share."""
    rows = re.findall(r"^\| `(\w+)` \| (.*)\|$", (ROOT / "docs" / "reference" / "format.md").read_text(), re.M)
    for name, cls in CLASSES_BY_TYPE[section].items():
        named = set(re.findall(r"\w+", " ".join(text for type_, text in rows if type_ == name)))
        assert named, f"docs/reference/format.md: no row for {name}"
        assert set(keys(cls)) - {"bodies"} <= named, f"docs/reference/format.md: keys of {name}"


def test_the_readme_names_each_joint():
    row = next(line for line in (ROOT / "README.md").read_text().splitlines() if line.startswith("| Joints, drivers |"))
    assert [name for name in CLASSES_BY_TYPE["joint"] if name.replace("_", " ") not in row] == []


def prose() -> Iterator[tuple[str, str]]:
    """Return each docstring and comment of the package and its studies, with its place."""
    for path, tree in sources().items():
        for node in ast.walk(tree):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and (text := ast.get_docstring(node)):
                yield f"{name_of(path)}: {getattr(node, 'name', 'module')}", text
        for line, text in enumerate(path.read_text().splitlines(), 1):
            if "# " in text and "`" in text:
                yield f"{name_of(path)}:{line}", text.partition("# ")[2]


def test_names_in_docstrings_and_comments_exist():
    assert [(where, name) for where, text in prose() for name in missing(text)] == []
    files = {path.name for path in [*sources(), *(ROOT / "tests").rglob("*.py")]}
    assert [(where, file) for where, text in prose() for file in re.findall(r"\w+\.py\b", text) if file not in files] == []


def test_a_name_that_does_not_exist_is_noticed():
    said = "`udk.load` `udk.laod` `Motion.position` `Spline.times` `jnp.linalg.svd` `jnp.linalg.sdv` `tests/no.py` `quooks`"
    assert list(missing(said)) == ["udk.laod", "Motion.position", "jnp.linalg.sdv", "tests/no.py", "quooks"]


def test_the_readme_counts_and_lists_what_there_is():
    text = (ROOT / "README.md").read_text()
    (count,) = re.findall(r"(\d+) mechanisms in `udk\.library`", text)
    assert int(count) == len(udkjax.library.__all__)
    (row,) = re.findall(r"\| Command line \|(.*)\|", text)
    assert set(CODE.findall(row)) == {"--json", "udkjax simulate", *COMMANDS} - {"simulate"}


# --- the reference

CLASSES = sorted(
    name
    for page in (ROOT / "docs/reference").glob("*.md")
    for name, _ in reference.DIRECTIVE.findall(page.read_text())
    if inspect.isclass(reference.resolve(name))
)


def test_the_reference_names_all_that_is_public():
    named = {
        name
        for page in (ROOT / "docs/reference").glob("*.md")
        for name in re.findall(r"^::: udkjax\.(?:pinv\.)?(\w+)$", page.read_text(), re.M)
    }
    assert named >= set(udkjax.__all__) - {"pinv", "equations", "library", "GROUND"}


@pytest.mark.parametrize("name", CLASSES)
def test_every_argument_is_described(name):
    cls = reference.resolve(name)
    assert [row[0] for row in reference.described(cls) if not row[3] or not row[1]] == []


def test_tables_say_types_units_and_defaults():
    table = reference.table(udkjax.Body)
    assert "| `position` | `array (2,)` | `(0.0, 0.0)` | of the centre of mass (m). |" in table
    assert "| `mass` | `number` | required |" in table


@pytest.mark.parametrize("name", COMMANDS)
def test_every_option_is_described_as_the_help_does(name, capsys):
    with pytest.raises(SystemExit):
        udkjax_cli([name, "--help"])
    shown, page = capsys.readouterr().out, reference.command(name)
    for option in re.findall(r"^\| `(--[\w-]+)`", page, re.M):
        assert option in shown
    assert " |  |\n" not in page


# --- commands


def commands(text: str) -> Iterator[list[str]]:
    """Return the command lines of a page without the surrounding text."""
    shell = "\n".join(block for kind, block in BLOCK.findall(text) if kind == "sh").replace("\\\n", " ")
    for line in [*shell.splitlines(), *CODE.findall(BLOCK.sub("", text))]:
        for part in re.split(r"&&|#|;", line):
            if re.match(r"\s*(\S*/)?(udkjax|python|pytest|sh|pip)\s", part):
                words = shlex.split(part)
                yield [Path(words[0]).name, *words[1:]]


def wrong(words: list[str]) -> str:
    """Return the mistake in a command line; an empty string if there is none."""
    program, *rest = words
    options = [word.partition("=")[0] for word in rest if word.startswith("--")]
    if program == "udkjax":
        named = [word for word in rest if word in COMMANDS]
        if not named:
            return "" if not rest or rest[0] in ("COMMAND", "--version", "--help") else f"no command {rest[0]}"
        function = command(named[0])
        known = {f"--{name.strip('_').replace('_', '-')}" for name in inspect.signature(function).parameters}
        known |= {f"--no-{option[2:]}" for option in known} | {"--help"}
        return " ".join(option for option in options if option not in known)
    if program == "python" and rest[:1] == ["-m"] and rest[1].split(".")[0] in ("experiments", "benchmarks", "examples"):
        folder = ROOT / rest[1].replace(".", "/")
        names = [word for word in rest[2:] if re.fullmatch(r"[a-z_]+", word) and word not in ("all", "figures")]
        return " ".join(name for name in names if not (folder / f"{name}.py").exists())
    if program == "sh" and rest:
        script = ROOT / rest[0]
        return rest[0] if not script.exists() else " ".join(o for o in options if o not in script.read_text())
    if program == "pip" and re.search(r"udkjax(\[|$)", " ".join(rest)):
        return "udkjax is not in any package index: install it from its folder"
    return ""


@every_page
def test_its_commands_exist(page):
    assert [(" ".join(words), wrong(words)) for words in commands(page.read_text()) if wrong(words)] == []


def test_a_command_that_does_not_exist_is_noticed():
    said = [
        "udkjax simulat a.toml",
        "udkjax simulate a.toml --t1 5 --outt x",
        "python -m experiments wire_lore",
        "pip install 'udkjax[io]'",  # which is in no index
    ]
    assert [bool(wrong(shlex.split(line))) for line in said] == [True] * 4
    assert not wrong(shlex.split("udkjax simulate a.toml --t1 5 --out x.nc"))
