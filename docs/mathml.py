"""Equations as MathML, which browsers typeset without scripts; MyST reads them as `$...$` and `$$...$$`."""

import re
from typing import Any

# In docstrings, equations have the names of the code; `udk.equations` has functions of the same names.
SYMBOLS = {
    "alpha": r"\alpha",
    "beta": r"\beta",
    "gamma": r"\gamma",
    "lambda": r"\lambda",
    "omega": r"\omega",
    "theta": r"\theta",
    "phi": r"\varphi",
    "Psi": r"\Psi",
    "Psi_q": r"\Psi_q",
    "Psi_dot": r"\dot{\Psi}",
    "mu": r"\mu",
    "tanh": r"\tanh",
    "sin": r"\sin",
    "cos": r"\cos",
    "exp": r"\exp",
    "dot": r"\cdot",
    "sum": r"\sum",
    "max": r"\max",
    "min": r"\min",
}
WORD = re.compile(r"(?<!\\)\b[A-Za-z]+(?:_dot|_q)?")


def latex(text: str) -> str:
    """Return an equation of a docstring, `M a + Psi_q^T lambda = F`, in LaTeX."""
    text = text.replace("<=", r"\le ").replace(">=", r"\ge ").replace("->", r"\to ")
    text = WORD.sub(lambda found: SYMBOLS.get(found[0]) or (rf"\mathit{{{found[0]}}}" if len(found[0]) > 2 else found[0]), text)
    text = re.sub(r"sqrt\(([^()]*)\)", r"\\sqrt{\1}", text.replace(r"\mathit{sqrt}", "sqrt"))
    return re.sub(r"([\^_])\(([^()]*)\)", r"\1{\2}", text)


def mathml(text: str, display: bool = False) -> str:
    """Return an equation in LaTeX as an element of HTML."""
    from latex2mathml.converter import convert

    return convert(text, display="block" if display else "inline")


def visit_math(self: Any, node: Any) -> None:
    """Write an equation within a line."""
    from docutils.nodes import SkipNode

    self.body.append(mathml(node.astext()))
    raise SkipNode


def visit_display(self: Any, node: Any) -> None:
    """Write an equation on a line of its own."""
    from docutils.nodes import SkipNode

    self.body.append(f'<div class="equation">{mathml(node.astext(), display=True)}</div>')
    raise SkipNode
