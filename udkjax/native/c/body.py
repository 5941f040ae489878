"""The body of a function in C: its lines, variables and blocks."""

import re
from collections import Counter
from collections.abc import Mapping

from udkjax.native.c.instructions import Instructions
from udkjax.native.c.names import Names
from udkjax.native.c.syntax import C_TYPES, CExpression, FunctionText, function_head, literal, number_at, pointer_type

MOST_CHARACTERS = 90  # characters of an expression: a longer one gets a name


class FunctionBody(Instructions):
    """The translation of one function of LLVM's text to C.

    Results that are used once wait in `_pending`, until they become part of the expression that uses them.

    Args:
        f: The function.
        functions: All functions of the unit, by name.
        names: The names of places in memory.
    """

    def __init__(self, f: FunctionText, functions: Mapping[str, FunctionText], names: Names):
        self._f, self._functions, self._names = f, functions, names
        self._hoisted: dict[str, str] = {}

    def text(self) -> str:
        """Return the definition of the function in C."""
        self._f.lines = without_dead(self._f.lines)
        while True:
            count = len(self._hoisted)
            body = self._write()
            if len(self._hoisted) == count:
                break
        declared = [f"    {x} = 0;" for x in self._hoisted.values()]
        words = {*re.findall(r"\w+", "\n".join(body))}
        unused = [f"    (void){n};" for _, n in self._f.arguments if n not in words]
        return "\n".join([f"{function_head(self._f)}", "{", *declared, *self._variables, *unused, *body, "}", ""])

    def _write(self) -> list[str]:
        self._lines: list[str] = []
        self._variables: list[str] = []
        self._pending: dict[str, CExpression] = {}
        self._known: dict[str, CExpression] = {}
        self._scopes: dict[str, tuple[int, ...]]
        self._scopes, self._blocks = {n: (0,) for _, n in self._f.arguments}, [0]
        self._next_block, self._loops = 1, []
        self._slots: dict[str, str] = {}
        for kind, n in self._f.arguments:
            self._known[n] = CExpression(n, kind, set(), self._f.elements.get(n, "double"))
        self._uses = Counter(x for line in self._f.lines for x in re.findall(r"%([\w.]+)", right_side(line)))
        places = (re.search(r"(?:load \w+|^store .*), ptr %([\w.]+)(?:,|$)", line) for line in self._f.lines)
        self._direct = Counter(place[1] for place in places if place)
        lines = self._f.lines
        for k, line in enumerate(lines):
            self._line(line, lines[k + 1] if k + 1 < len(lines) else "")
        return self._lines

    # --- lines

    def _emit(self, text: str):
        self._lines.append("    " * len(self._blocks) + text)

    def _open(self, text: str):
        self._emit(text)
        self._blocks.append(self._next_block)
        self._next_block += 1

    def _close(self):
        self._blocks.pop()
        self._emit("}")

    def _flush(self, changed: str | None = None):
        """Assign the pending expressions that read `changed`, a variable or "memory", to names of C; all of them if None."""
        for name in [n for n, e in self._pending.items() if changed is None or changed in e.reads]:
            self._name(name, self._pending.pop(name))

    def _name(self, name: str, e: CExpression):
        kind = pointer_type(e.element) if e.kind == "ptr" else f"{C_TYPES[e.kind]} "
        self._known[name] = CExpression(name, e.kind, set(), e.element)
        self._scopes[name] = tuple(self._blocks)
        if name in self._hoisted:
            self._emit(f"{name} = {e.text};")
        else:
            self._emit(f"{kind if kind.startswith('const ') else kind if e.kind == 'ptr' else f'const {kind}'}{name} = {e.text};")

    def _value(self, text: str, kind: str) -> CExpression:
        """Return an operand of LLVM's text, of the type `kind`, as an expression of C; it is no longer pending."""
        text = text.strip()
        if text.startswith("<"):
            text = text[1:].split(",")[0].split()[-1]
        if text.startswith("@"):
            return CExpression(text[1:], "ptr", set(), "table")
        if not text.startswith("%"):
            return CExpression(literal(text, kind), kind, set())
        name = text[1:]
        if name in self._pending:
            return self._pending.pop(name)
        e = self._known[name]
        scope = self._scopes.get(name, (0,))
        if tuple(self._blocks[: len(scope)]) != scope:
            self._hoisted[name] = f"{pointer_type(e.element) if e.kind == 'ptr' else f'{C_TYPES[e.kind]} '}{name}"
        return e

    def _line(self, line: str, following: str):
        if match := re.match(r"%([\w.]+) = (.*)", line):
            self._assign(match[1], match[2])
        elif line.startswith("store "):
            self._store(line)
        elif line.startswith("call void"):
            text, _ = self._called(line[len("call ") :])
            self._flush("memory")
            self._emit(f"{text};")
        elif line.startswith("ret"):
            result = "" if line == "ret void" else f" {self._value(line.split()[2], line.split()[1]).text}"
            self._flush()
            if following or result:
                self._emit(f"return{result};")
        elif line.startswith("br "):
            self._branch(line, following)
        elif re.match(r"else\d+:", line):
            self._flush()
            self._blocks.pop()
            self._open("} else {")
        elif re.match(r"end\d+:", line):
            self._flush()
            self._close()
        elif not re.match(r"(then|while|do|after)\d+:", line):
            raise ValueError(f"no C for {line}")

    def _branch(self, line: str, following: str):
        words = line.split("%")
        if line.startswith("br label"):
            self._flush()
            if words[1].startswith("while") and following == f"{words[1]}:":
                self._open("for (;;) {")
                self._loops.append(len(self._lines))
            return
        condition = self._value(line[len("br i1 ") :].split(",")[0], "i1").text
        self._flush()
        if following.startswith("do"):
            if self._loops.pop() == len(self._lines):
                self._lines[-1] = self._lines[-1].replace("for (;;)", f"while ({condition})")
            else:
                self._emit(f"if (!({condition})) break;")
        else:
            self._open(f"if ({condition}) {{")

    def _store(self, line: str):
        match = re.match(r"store (\w+) (.*), ptr ([%@][\w.]+)(?:, align \d+)?$", line)
        assert match, line
        kind, value, place = match[1], self._value(match[2], match[1]), match[3]
        if place[1:] in self._slots:
            name = self._slots[place[1:]]
            self._flush(name)
            self._emit(f"{name} = {value.text};")
            return
        to = self._value(place, "ptr")
        self._flush("memory")
        if kind == "double":
            self._emit(f"{number_at(to)} = {value.text};")
        else:
            self._emit(f"store_{'address' if kind == 'ptr' else 'integer'}({to.text}, {value.text});")

    def _assign(self, name: str, text: str):
        operation = text.split()[0]
        if operation == "alloca":
            self._reserve(name, text)
            return
        e = getattr(self, f"_{operation}", self._binary)(text)
        if (
            e.kind == "ptr"
            and e.text.startswith("&")
            and self._uses[name] > 1
            and len(e.text) < MOST_CHARACTERS // 2
            and not e.reads
        ):
            self._known[name] = e  # an address by names that stay
            self._scopes[name] = (0,)
        elif self._uses[name] == 1 and len(e.text) < MOST_CHARACTERS:
            self._pending[name] = e
        else:
            self._name(name, e)

    def _reserve(self, name: str, text: str):
        match = re.match(r"alloca (\w+), i64 (\d+)", text)
        assert match, text
        kind = "double *" if match[1] == "ptr" else f"{C_TYPES[match[1]]} "
        direct = self._uses[name] == self._direct[name]
        if int(match[2]) == 1 and direct:
            self._slots[name] = name
            self._variables.append(f"    {kind}{name} = 0;")
        else:
            self._variables.append(f"    {kind}{name}[{match[2]}];")
            self._known[name] = CExpression(name, "ptr", set(), match[1])


def right_side(line: str) -> str:
    """Return the part of a line of LLVM's text that uses values: all of it, or the part after the name of the result."""
    match = re.match(r"%[\w.]+ = (.*)", line)
    return match[1] if match else line


def without_dead(lines: list[str]) -> list[str]:
    """Return the lines of LLVM's text, except those for results that no line uses and for variables that no line reads."""
    while True:
        uses = Counter(x for line in lines for x in re.findall(r"%([\w.]+)", right_side(line)))
        stored = {x for line in lines if (m := re.match(r"store .*, ptr %([\w.]+)(?:, align \d+)?$", line)) for x in [m[1]]}
        reserved = {m[1] for line in lines if (m := re.match(r"%([\w.]+) = alloca", line))}
        stores = Counter(m[1] for line in lines if (m := re.match(r"store .*, ptr %([\w.]+)(?:, align \d+)?$", line)))
        unread = {x for x in reserved & stored if uses[x] == stores[x]}
        kept = []
        for line in lines:
            match = re.match(r"%([\w.]+) = ", line)
            target = re.match(r"store .*, ptr %([\w.]+)(?:, align \d+)?$", line)
            if (match and (not uses[match[1]] or match[1] in unread)) or (target and target[1] in unread):
                continue
            kept.append(line)
        if len(kept) == len(lines):
            return lines
        lines = kept
