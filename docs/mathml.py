"""Equations as MathML, which browsers typeset without scripts; MyST reads them as `$...$` and `$$...$$`.

Docstrings have the names of the code, `M a + Psi_q^T lambda = F`, which `help` shows well; here they are found and typeset.
"""

import re
from typing import Any

GREEK = "alpha beta gamma lambda omega sigma theta phi Psi psi mu rho eta Lambda".split()
FUNCTIONS = "tanh", "sin", "cos"
SUPERSCRIPT = r"(?:\^(?:\([^()\s]*\)|-\d|[+\w](?!\w))|'+(?!\w))"
ATOM = rf"(?:(?:{'|'.join((*GREEK, *FUNCTIONS))})(?:_\w+)?|[A-Za-z]\d?(?:_\w{{1,4}})?|\d+(?:\.\d+)?)(?!\w)"
INNER = rf"(?:{ATOM}|{SUPERSCRIPT}|[\s,+\-/.=|])*"  # of brackets
GROUP = rf"\((?!(?:m|s|N|J|T)\)){INNER}\)|\|(?!\s){INNER}\|"
UNIT = rf"(?:\.\.\.|{ATOM}(?:\({INNER}\))?|{GROUP})(?:{SUPERSCRIPT}|(?<=\))_\w+)*"
EXPRESSION = re.compile(rf"(?<![\w/^.`])-?{UNIT}(?: ?(?:<=|>=|<-|[=+\-/<>]) ?-?{UNIT}| {UNIT})*")
MEASURE = re.compile(r"[kgmsNJ\d^/() .+-]+")  # nothing but units, as in m/s^2
NAMED = re.compile(rf"\^|(?<!\w)(?:{'|'.join(GREEK)})(?!\w*[a-z]{{3}})")
LONG = 80  # letters of an equation in LaTeX, from which it has terms that may stand on several lines
DISPLAY = re.compile(r"\n\n((?: {4}.*(?:\n|\Z))+)")


def latex(text: str) -> str:
    """Return an equation in the names of the code in LaTeX."""
    text = text.replace("<=", r"\le ").replace(">=", r"\ge ").replace("<-", r"\leftarrow ").replace("...", r"\dots")
    text = re.sub(r"\b([A-Za-z])(\d)\b", r"\1_{\2}", text)
    text = re.sub(r"([\^])\(([^()]*)\)", r"\1{\2}", text)
    text = re.sub(r"(?<!\\)\b([A-Za-z]+)_(d?)dot\b", lambda f: rf"\{f[2]}dot{{{symbol(f[1])}}}", text)
    text = re.sub(rf"(?<!\\)\b({'|'.join(GREEK)}|[A-Za-z])_(\w+)|\)_(\w+)", subscript, text)
    text = re.sub(r"(?<=[)a]) x (?=[rp]\b)", r" \\times ", text)  # of vectors
    text = re.sub(r"(?<![\\{_A-Za-z])[A-Za-z]+(?:[ _](?!tanh)[A-Za-z]{2,})*(?![A-Za-z])", lambda f: symbol(f[0]), text)
    return re.sub(r" {3,}", r" \\qquad ", text)


def subscript(found: re.Match[str]) -> str:
    """Return a name with a subscript, or the subscript of a bracket."""
    return f"{symbol(found[1])}_{{{found[2]}}}" if found[1] else f")_{{{found[3]}}}"


def symbol(word: str) -> str:
    """Return a name of the code in LaTeX."""
    if word in GREEK or word in FUNCTIONS:
        return rf"\{'varphi' if word == 'phi' else word}"
    words = word.replace("_", r"\_")
    if " " in word and (word.split()[0] in GREEK or len(word.split()[0]) == 1):
        first, _, rest = word.partition(" ")
        return f"{symbol(first)} {symbol(rest)}"
    return word if len(word) == 1 else rf"\text{{ {words} }}" if " " in word else rf"\text{{{words}}}"


def typeset(text: str) -> str:
    """Return a paragraph of a docstring with its equations between dollars; code stays code."""
    text = DISPLAY.sub(lambda found: shown(found[1]) or found[0], text)
    parts = re.split(r"(`[^`]*`|\$\$.*?\$\$)", text, flags=re.S)
    parts[::2] = [EXPRESSION.sub(inline, part) for part in parts[::2]]
    return "".join(parts)


def shown(block: str) -> str:
    """Return an indented block as equations of their own, one a line; empty if it is none, or a matrix drawn with characters."""
    lines = [line.strip() for line in block.strip().splitlines()]
    if not NAMED.search(block) or "=" not in block or "[" in block or '"' in block:
        return ""
    return "\n\n" + "".join(f"$$\n{latex(line)}\n$$\n\n" for line in lines)


def inline(found: re.Match[str]) -> str:
    """Return an expression between dollars if it is one, and not prose or a unit."""
    text = found[0]
    lead = re.match(r"(?:a |I )*", text)[0] if not re.match(r"[aI] [=+\-]", text) else ""  # articles
    text = text[len(lead) :]
    tail = re.search(r"(?: a| I)?$", text)[0] if not re.search(r"[=+\-/<>] ?\w$|\w a = ", text) else ""
    text = text[: len(text) - len(tail)]
    if not NAMED.search(text) or MEASURE.fullmatch(text):
        return found[0]
    return f"{lead}${latex(text)}${tail}"


def mathml(text: str, display: bool = False) -> str:
    """Return an equation in LaTeX as an element of HTML."""
    from latex2mathml.converter import convert

    return convert(text, display="block" if display else "inline").replace(r"\_", "_")  # it leaves escapes of words


def visit_math(self: Any, node: Any) -> None:
    """Write an equation within a line."""
    from docutils.nodes import SkipNode

    self.body.append(mathml(node.astext()))
    raise SkipNode


def visit_display(self: Any, node: Any) -> None:
    """Write an equation on a line of its own."""
    from docutils.nodes import SkipNode

    parts = re.split(r"\s*\\qquad\s*", node.astext().strip())  # each may stand on a line of its own, where there is little room
    shown = (" ".join(mathml(term, display=True) for term in terms(part)) for part in parts)
    self.body.append(f'<div class="equation">{" ".join(f"<div>{each}</div>" for each in shown)}</div>')
    raise SkipNode


def terms(text: str) -> list[str]:
    """Return the terms of a long equation, between which a line may end; others as a whole."""
    if len(text) < LONG or r"\begin" in text:
        return [text]
    found, depth = [""], 0
    for part in re.split(r"( \+ |[(){}])", text):
        depth += (part in ("(", "{")) - (part in (")", "}"))
        found += ["+ "] if part == " + " and depth == 0 else []
        found[-1] += "" if part == " + " and depth == 0 else part
    return found
