"""Instructions of LLVM's text as expressions of C."""

import re
from collections.abc import Mapping

from udkjax.native.c.names import Names
from udkjax.native.c.syntax import C_TYPES, CExpression, FunctionText, array_and_index, number_at, operand, pointer_type

SIGNS = {"add": "+", "sub": "-", "mul": "*", "div": "/", "and": "&", "or": "|", "xor": "^", "shl": "<<", "lshr": ">>"}
COMPARISONS = {"lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "==", "ne": "!="}
INTRINSICS = {"fmuladd": "FMA", "maximum": "maximum", "minimum": "minimum", "roundeven": "rint"}  # others have their names


class Instructions:
    """Translations of instructions: the method `_x` returns the expression of C for an instruction `x` of LLVM's text."""

    _f: FunctionText
    _functions: Mapping[str, FunctionText]
    _names: Names
    _slots: dict[str, str]

    def _value(self, text: str, kind: str) -> CExpression:
        """Return an operand of LLVM's text, of the type `kind`, as an expression of C."""
        raise NotImplementedError

    def _load(self, text: str) -> CExpression:
        match = re.match(r"load (\w+), ptr ([%@][\w.]+)", text)
        assert match, text
        kind, place = match[1], match[2]
        if place[1:] in self._slots:
            name = self._slots[place[1:]]
            return CExpression(name, kind, {name})
        at = self._value(place, "ptr")
        reads = at.reads | {"memory"}
        if kind == "ptr":
            if at.element == "i64":
                return CExpression(f"(double *)(intptr_t){number_at(at)}", "ptr", reads)
            return CExpression(f"load_address({at.text})", "ptr", reads)
        if at.element in (kind, "table"):
            return CExpression(number_at(at), kind, reads - {"memory"} if at.element != "double" else reads)
        return CExpression(f"load_integer({at.text})", kind, reads)

    def _getelementptr(self, text: str) -> CExpression:
        match = re.match(r"getelementptr (\w+), ptr ([%@][\w.]+), i64 (.*)", text)
        assert match, text
        base, index, element = self._value(match[2], "ptr"), self._value(match[3], "i64"), match[1]
        if base.element not in (element, "table"):
            base = CExpression(f"(({C_TYPES[element]} *){operand(base.text)})", "ptr", base.reads, element)
        if base.element == "table":
            element = "table" if element != "i8" else "double"
        if index.text == "0":
            return CExpression(base.text, "ptr", base.reads, element)
        reads = base.reads | index.reads
        if base.text.startswith("&"):  # an index in an array
            pointer, inner = array_and_index(base.text)
            return CExpression(f"&{pointer}[{inner} + {operand(index.text)}]", "ptr", reads, element)
        if not re.fullmatch(r"\w+", base.text):
            base.text = operand(base.text)
        plain = index.text[1:-1] if re.fullmatch(r"\([^()]*\)", index.text) else index.text
        return CExpression(f"&{base.text}[{self._names.index(base.text, plain)}]", "ptr", reads, element)

    def _binary(self, text: str) -> CExpression:
        match = re.match(r"([fs]?)(add|sub|mul|div|and|or|xor|shl|lshr) (\w+) (.*), (.*)", text)
        if not match:
            raise ValueError(f"no C for {text}")
        kind = match[3]
        a, b = self._value(match[4], kind), self._value(match[5], kind)
        if match[2] == "xor" and b.text == "1" and kind == "i1":
            return CExpression(f"!{operand(a.text)}", kind, a.reads)
        left, right = operand(a.text), operand(b.text)
        if kind == "i64" and (match[2], b.text) in (("mul", "1"), ("add", "0")):
            return a
        if match[2] in ("shl", "lshr"):
            return CExpression(f"(int64_t)((uint64_t){left} {SIGNS[match[2]]} {right})", kind, a.reads | b.reads)
        if match[2] == "add" and kind == "i64" and re.fullmatch(r"-\d+", b.text):
            return CExpression(f"{left} - {b.text[1:]}", kind, a.reads)
        return CExpression(f"{left} {SIGNS[match[2]]} {right}", kind, a.reads | b.reads)

    def _fneg(self, text: str) -> CExpression:
        a = self._value(text.split(" ", 2)[2], "double")
        return CExpression(f"-{operand(a.text)}", "double", a.reads)

    def _fcmp(self, text: str) -> CExpression:
        match = re.match(r"([fi])cmp (\w+) (\w+) (.*), (.*)", text)
        assert match, text
        a, b = self._value(match[4], match[3]), self._value(match[5], match[3])
        predicate = match[2][1:] if len(match[2]) == 3 else match[2]
        if match[2][0] == "u" and match[1] == "f" and match[2] != "une":
            raise ValueError(f"no C for {text}")
        cast = "(uint64_t)" if match[2][0] == "u" and match[1] == "i" else ""
        signed = f"{cast}{operand(a.text)} {COMPARISONS[predicate]} {cast}{operand(b.text)}"
        return CExpression(signed, "i1", a.reads | b.reads)

    _icmp = _fcmp

    def _select(self, text: str) -> CExpression:
        match = re.match(r"select i1 (.*), (\w+) ([^ ]+), \w+ ([^ ]+)$", text)
        assert match, text
        c, a, b = self._value(match[1], "i1"), self._value(match[3], match[2]), self._value(match[4], match[2])
        parts = [operand(x.text) for x in (c, a, b)]
        return CExpression("{} ? {} : {}".format(*parts), match[2], c.reads | a.reads | b.reads, a.element)

    def _cast(self, text: str) -> CExpression:
        match = re.match(r"(\w+) (\w+) (.*) to (\w+)", text)
        assert match, text
        a = self._value(match[3], match[2])
        if match[1] == "bitcast" and match[2] != match[4]:
            return CExpression(f"{'bits_of' if match[4] == 'i64' else 'from_bits'}({a.text})", match[4], a.reads)
        if match[1] in ("ptrtoint", "inttoptr"):
            through = "(intptr_t)"
            kind = "double *" if match[4] == "ptr" else C_TYPES[match[4]]
            return CExpression(f"({kind}){through}{operand(a.text)}", match[4], a.reads)
        return CExpression(f"({C_TYPES[match[4]]}){operand(a.text)}", match[4], a.reads)

    _bitcast = _sitofp = _uitofp = _fptosi = _zext = _sext = _ptrtoint = _inttoptr = _cast

    def _insertelement(self, text: str) -> CExpression:
        match = re.match(r"insertelement \w+ poison, (\w+) ([^ ]+), i64 0", text)
        assert match, text
        return self._value(match[2], match[1])

    def _extractelement(self, text: str) -> CExpression:
        match = re.match(r"extractelement (\w+) ([^ ]+), i64 0", text)
        assert match, text
        return self._value(match[2], match[1])

    def _call(self, text: str) -> CExpression:
        kind = text.split()[1]
        called, reads = self._called(text[len("call ") :])
        return CExpression(called, kind, reads)

    def _called(self, text: str) -> tuple[str, set[str]]:
        match = re.match(r"\w+ @([\w.]+)\((.*)\)$", text)
        assert match, text
        name, given = match[1], [x.split(" ", 1) for x in match[2].split(", ") if x]
        values = [self._value(x, kind) for kind, x in given]
        reads: set[str] = set().union(*(x.reads for x in values))
        if name.startswith("llvm."):
            name = name.split(".")[1]
            return f"{INTRINSICS.get(name, name)}({', '.join(x.text for x in values)})", reads
        if name == "meet":
            return values[0].text, reads
        f = self._functions[name]
        texts = []
        for (kind, argument), x in zip(f.arguments, values, strict=True):
            cast = kind == "ptr" and x.element not in (f.elements[argument], "table")
            texts.append(f"({pointer_type(f.elements[argument])}){operand(x.text)}" if cast else x.text)
        return f"{name}({', '.join(texts)})", reads
