"""The plan of the house, read from its imports.

`python docs/architecture.py` prints it; `--write` writes the picture and the table of docs/theory/architecture.md;
`--root DIR` reads another checkout, to compare before and after.

A room is a folder of the package without its subfolders, which are rooms of their own. A floor holds the folders of the package
that import from lower floors only.
"""

import argparse
import ast
import os
import re
import subprocess
import sys
from collections import Counter
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

HERE = Path(__file__).parent
PICTURE, PAGE = HERE / "theory" / "architecture.svg", HERE / "theory" / "architecture.md"
BLOCK = re.compile(r"(?<=<!-- plan -->\n).*?(?=<!-- end of the plan -->)", re.S)
GROUND = "."  # the modules of the package that are in no folder
ASIDE = ("integrate",)  # folders drawn to the right of the wing of positions
Arrow = tuple[str, str]  # from the folder that imports to the one it imports from


@dataclass
class Module:
    """A module: its file, its lines, and the modules and names that it imports from the package, anywhere in its text."""

    name: str
    file: Path
    room: str
    lines: int
    imports: list[tuple[str, str]] = field(default_factory=list)

    @property
    def folder(self) -> str:
        """The folder of the package that it is in."""
        return self.room.partition("/")[0]


def modules(package: Path) -> dict[str, Module]:
    """Return the modules of a package by their full names, each with its imports."""
    found = {}
    for file in sorted(package.rglob("*.py")):
        place = file.relative_to(package)
        parts = [package.name, *place.with_suffix("").parts]
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        found[name] = Module(name, file, str(place.parent), len(file.read_text(encoding="utf-8").splitlines()))
    doors = package.name, f"{package.name}.__main__"  # they name what is public, and load it when it is asked for
    for module in found.values():
        if module.name not in doors:
            module.imports = [(name, thing) for name, thing in imports(module, found) if name not in (module.name, *doors)]
    return found


def imports(module: Module, known: dict[str, Module]) -> list[tuple[str, str]]:
    """Return the modules of the package that a module imports, and the name it takes from each: "" for the module itself."""
    found = []
    package = module.name.split(".")[: None if module.file.name == "__init__.py" else -1]
    for node in ast.walk(ast.parse(module.file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found += [(alias.name, "") for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = ".".join([*package[: len(package) - node.level + 1 if node.level else 0], *filter(None, [node.module])])
            full = [f"{base}.{alias.name}" for alias in node.names]
            found += [(name, "") if name in known else tuple(name.rsplit(".", 1)) for name in full]
    return [(name, thing) for name, thing in found if name in known]


def up(weights: Counter[Arrow]) -> list[Arrow]:
    """Return the arrows that point up: those that have to go, the one of fewest imports first, until no circle is left."""
    found, rest = [], dict(weights)
    while circle := next((one for one in map(frozenset, circles(rest)) if len(one) > 1), None):
        least = min((a for a in rest if circle.issuperset(a)), key=lambda a: (rest[a], a))
        found.append(least)
        del rest[least]
    return found


def circles(arrows: dict[Arrow, int]) -> list[set[str]]:
    """Return the sets of nodes that reach each other along arrows."""
    reached = reach(arrows)
    found: list[set[str]] = []
    for node in sorted(reached):
        if not any(node in one for one in found):
            found.append({node} | {other for other in reached[node] if node in reached[other]})
    return found


def reach(arrows: dict[Arrow, int]) -> dict[str, set[str]]:
    """Return all nodes that each node reaches along arrows."""
    below: dict[str, set[str]] = {node: set() for arrow in arrows for node in arrow}
    for above, node in arrows:
        below[above].add(node)
    found = {}
    for node in below:
        found[node], new = set(), set(below[node])
        while new:
            found[node] |= new
            new = set().union(*(below[x] for x in new)) - found[node]
    return found


class House:
    """The package of a checkout."""

    def __init__(self, root: Path):
        self.root = root
        self.modules = modules(root / "udkjax")
        self.lines = sum(m.lines for m in self.modules.values())

    @cached_property
    def folders(self) -> list[str]:
        """The folders of the package, the highest first."""
        size = self.sizes("folder")
        return sorted(size, key=lambda x: (-self.floors[x], x in ASIDE, -size[x][1]))

    def sizes(self, kind: str) -> dict[str, tuple[int, int]]:
        """Return the numbers of modules and lines by "room" or "folder"."""
        files, lines = Counter(), Counter()
        for m in self.modules.values():
            files[getattr(m, kind)] += 1
            lines[getattr(m, kind)] += m.lines
        return {name: (files[name], lines[name]) for name in files}

    def arrows(self, kind: str) -> Counter[Arrow]:
        """Return how many imports go from one module, room or folder to another."""
        pairs = [(getattr(m, kind), getattr(self.modules[name], kind)) for m in self.modules.values() for name, _ in m.imports]
        return Counter((a, b) for a, b in pairs if a != b)

    @cached_property
    def floors(self) -> dict[str, int]:
        """The floor of each folder, from 0: one above the highest that it imports from."""
        weights = self.arrows("folder")
        upwards = up(weights)
        downwards = [a for a in weights if a not in upwards]
        floor = dict.fromkeys(self.sizes("folder"), 0)
        for _ in floor:
            floor |= {a: max(floor[b] + 1 for x, b in downwards if x == a) for a in {a for a, _ in downwards}}
        return floor

    @cached_property
    def needed(self) -> list[Arrow]:
        """The arrows between folders that no other arrows imply."""
        weights = {a: n for a, n in self.arrows("folder").items() if GROUND not in a}
        reached = reach(weights)
        return sorted((a, b) for a, b in weights if not any(b in reached[c] for x, c in weights if x == a and c != b))

    def below(self, folder: str) -> list[str]:
        """Return the folders that a folder imports from, the highest first."""
        return [x for x in self.folders if x != GROUND and (folder, x) in self.arrows("folder")]

    def taken(self, folder: str) -> set[tuple[str, str]]:
        """Return the names of a folder that other folders import."""
        given = [(m.folder, name, thing) for m in self.modules.values() for name, thing in m.imports]
        return {(name, thing) for user, name, thing in given if self.modules[name].folder == folder != user}

    def door(self, folder: str) -> int | None:
        """Return how many names the stub of a folder lists: its door; None where it has none."""
        stub = self.root / "udkjax" / folder / "__init__.pyi"
        if folder == GROUND or not stub.exists():
            return None
        return sum(len(n.names) for n in ast.parse(stub.read_text()).body if isinstance(n, ast.ImportFrom))

    def loaded(self, name: str) -> Counter[str]:
        """Return how many modules of each folder a fresh process loads that asks the package for a name."""
        code = f"import sys, udkjax; udkjax.{name}; print(*[m for m in sys.modules if m.split('.')[0] == 'udkjax'])"
        environment = os.environ | {"PYTHONPATH": str(self.root), "JAX_PLATFORMS": "cpu"}
        shown = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment, cwd=self.root
        )
        return Counter(self.modules[m].folder for m in shown.stdout.split() if m in self.modules)

    def report(self) -> str:
        """Return the tables of folders and rooms, and the figures of the whole house."""
        loaded, folder_size, room_size = self.loaded("kinematics"), self.sizes("folder"), self.sizes("room")
        lines = [
            "| floor | folder | files | lines | share | door lists | others take | loaded by udk.kinematics | imports from |",
            "|---|---|---|---|---|---|---|---|---|",
        ]
        for x in self.folders:
            files, n = folder_size[x]
            door = self.door(x)
            cells = self.floors[x], x, files, n, f"{100 * n / self.lines:.1f} %", "-" if door is None else door
            lines.append(cells_of(*cells, len(self.taken(x)), loaded[x], " ".join(self.below(x))))
        lines += ["", "| room | files | lines | share |", "|---|---|---|---|"]
        for x in sorted(room_size):
            files, n = room_size[x]
            lines.append(cells_of(x, files, n, f"{100 * n / self.lines:.1f} %"))
        rooms, folders = self.arrows("room"), self.arrows("folder")
        module_circles = [one for one in circles(self.arrows("name")) if len(one) > 1]
        room_circles = [one for one in circles(rooms) if len(one) > 1]
        return "\n".join(
            [
                *lines,
                "",
                f"files {len(self.modules)}, lines {self.lines}, folders {len(folder_size)}, rooms {len(room_size)}, "
                f"floors {max(self.floors.values()) + 1}",
                f"arrows between folders {len(folders)}, of these up {len(up(folders))}; between rooms {len(rooms)}",
                f"circles of modules {len(module_circles)}, of folders {sum(len(x) > 1 for x in circles(folders))}, "
                f"of rooms {len(room_circles)}: {'; '.join(' '.join(sorted(x)) for x in room_circles) or '-'}",
                *(f"largest {kind} {self.largest(kind)} of the lines" for kind in ("folder", "room")),
                f"names taken through walls {sum(len(self.taken(x)) for x in folder_size)}",
                f"modules loaded by udk.kinematics {sum(loaded.values())}",
            ]
        )

    def largest(self, kind: str) -> str:
        """Return the largest "room" or "folder", and its share."""
        name, (_, lines) = max(self.sizes(kind).items(), key=lambda item: item[1][1])
        return f"{name}, {100 * lines / self.lines:.0f} %"

    def table(self) -> str:
        """Return the table of the page: floors, folders, their shares, and the folders they import from."""
        size = self.sizes("folder")
        rows = [
            cells_of(self.floors[x], f"`{x}/`", f"{100 * size[x][1] / self.lines:.0f} %", ", ".join(self.below(x)) or "none")
            for x in self.folders
            if x != GROUND
        ]
        return "\n".join(["| Floor | Folder | Share of lines | Imports from |", "|---|---|---|---|", *rows, ""])


def cells_of(*cells: object) -> str:
    """Return a row of a table in Markdown."""
    return f"| {' | '.join(map(str, cells))} |"


# --- the picture

ROW, GAP, WIDTH, LEFT = 72, 22, 820, 20
COLOURS = {"positions": "#dcebdc", "statics": "#dcebdc", "synthesis": "#dcebdc", "integrate": "#f4e3cf"}


def draw(house: House) -> str:
    """Return the plan as SVG: floors as rows, folders as wide as they have lines, with their rooms, and the arrows needed."""
    place = places(house)
    height = max(y + h for _, y, _, h in place.values()) + LEFT
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH + 2 * LEFT} {height}" font-family="sans-serif">',
        "<title>The folders of udkjax by floors, and the imports between them</title>",
        '<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
        '<path d="M0 0L8 4L0 8z" fill="#555"/></marker></defs>',
        '<rect width="100%" height="100%" fill="#fff"/>',
    ]
    for above, below in house.needed:
        x, y, w, h = place[above]
        x2, y2, w2, _ = place[below]
        left, right = max(x, x2), min(x + w, x2 + w2)
        start, end = ((left + right) / 2,) * 2 if left < right else (x + w / 2, x2 + w2 / 2)
        parts.append(f'<path id="{above}-{below}" d="M{start:.0f} {y + h}L{end:.0f} {y2}" stroke="#555" marker-end="url(#tip)"/>')
    for folder, (x, y, w, h) in place.items():
        parts += box(house, folder, x, y, w, h)
    return "\n".join([*parts, "</svg>", ""])


def places(house: House) -> dict[str, tuple[int, int, int, int]]:
    """Return where each folder is drawn: x, y, width, height."""
    size = house.sizes("folder")
    rows: dict[int, list[str]] = {}
    for folder in house.folders:
        if folder != GROUND:
            rows.setdefault(house.floors[folder], []).append(folder)
    widest = max(sum(size[x][1] for x in row) for row in rows.values())
    found, y = {}, LEFT
    for row in rows.values():
        x = LEFT
        for folder in row:
            w = max(round(size[folder][1] / widest * (WIDTH - 12 * len(row))), 70)
            found[folder] = x, y, w, ROW - GAP
            x += w + 12
        y += ROW
    return found


def box(house: House, folder: str, x: int, y: int, w: int, h: int) -> list[str]:
    """Return a folder as a rectangle with its name, divided into its rooms."""
    rooms = {room: n for room, (_, n) in house.sizes("room").items() if room.partition("/")[0] == folder}
    total, colour = sum(rooms.values()), COLOURS.get(folder, "#e6e8ee")
    parts = [f'<g id="{folder}"><rect x="{x}" y="{y}" width="{w}" height="{h}" rx="4" fill="{colour}" stroke="#555"/>']
    parts.append(f'<text x="{x + 6}" y="{y + 16}" font-size="13">{folder}</text>')
    start = 0
    for k, room in enumerate(sorted(rooms, key=lambda r: (r != folder, -rooms[r]))):
        left, name = round(x + w * start / total), room.partition("/")[2]
        start += rooms[room]
        if name:
            is_last = left + 6 * len(name) > x + w  # its name ends at the edge
            where = f'x="{x + w - 3}" text-anchor="end"' if is_last else f'x="{left + 3}"'
            parts.append(f'<g id="{room}"><path d="M{left} {y + 20}V{y + h}" stroke="#999"/>')
            parts.append(f'<text {where} y="{y + 31 + k % 2 * 12}" font-size="10">{name}</text></g>')
    return [*parts, "</g>"]


def structure(picture: str) -> set[str]:
    """Return the rooms and arrows of a picture."""
    return set(re.findall(r'id="([^"]+)"', picture))


def main() -> None:
    """Print the plan, or write it."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--root", type=Path, default=HERE.parent, help="the checkout to read")
    parser.add_argument("--write", action="store_true", help=f"write {PICTURE.name}, and the table in {PAGE.name}")
    options = parser.parse_args()
    house = House(options.root.resolve())
    if options.write:
        PICTURE.write_text(draw(house), encoding="utf-8")
        PAGE.write_text(BLOCK.sub(lambda _: house.table(), PAGE.read_text(encoding="utf-8")), encoding="utf-8")
    else:
        print(house.report())


if __name__ == "__main__":
    main()
