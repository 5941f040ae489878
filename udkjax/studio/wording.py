"""Messages of the package in the words of the studio: acts of the page instead of arguments, classes and commands.

`STUDIO_WORDS` has the messages whose cure is an act of the page. What then still speaks of Python is left out, clause by clause.
"""

import re
from collections.abc import Mapping
from typing import Any

# Patterns of messages, and the words in their place; tools have their names and keys in parentheses.
STUDIO_WORDS: Mapping[str, str] = {
    r"driver: the scene has no driver; name a coordinate, such as \S+": (
        "nothing drives the mechanism: put a motor on a pin or a slide (Motor, M)"
    ),
    r"driver: the scene has \d+ drivers; name one of (.+)": r"this needs one motor, and there are \1: delete the others",
    r"drive or hold what still moves, (.+), by drivers of the scene": (
        r"put a motor on what still moves, \1 (Motor, M), or fix a pin of it (Ground, G)"
    ),
    r"drive or hold the others by drivers of the scene": "put a motor on another pin (Motor, M), or fix a pin (Ground, G)",
    r"drive (that|one of them), or take (it|one) out of the scene": "delete one of the motors",
    r"; give width= to the link, or shapes=\{.*\}": ": select it, and type its width",
    r"; give its width or corners, shapes=\{.*\}": ": select it, and type its width",
    r"give each a density with a thickness, or a mass": "select each, and type its mass",
    r"give masses": "select each, and type its mass",
    r"or (give )?the scene gravity = \[0, 0\]": "or select nothing (Esc), and type [0, 0] as gravity",
    r"let motors determine the motion": "put a motor on a pin (Motor, M)",
    r"the number of degrees of freedom is unknown: .*": (
        "the loops do not close as drawn, or motors contradict each other: drag a pin (Select, V), or delete a motor"
    ),
    r"remove one, or change its motion": "delete one, or change its speed",
    r"remove the driver, or free the coordinate": "delete the motor, or a joint that holds what it should move",
    r"change it, or start in another position": "change its speed, or drag a pin (Select, V), to start in another position",
    r"[Cc]hange the drivers' motion, or bring the guess closer to it": "change the motion in the text, or drag a pin (Select, V)",
    r"give their friction law=\"smooth\", or leave out `live` to play the run as it is": (
        'write law = "smooth" in their friction, in the text'
    ),
    r"use an implicit one, such as solver=.*": "make it softer, or what it moves heavier",
    r"the constraints are violated by more than `drift_tol`: .*": (
        "the loops open: a motor asks for what the joints do not allow; change its speed, or drag a pin (Select, V)"
    ),
    r", [^,]* of the scene's scales, more than drift_tol=[\d.e+-]*": "",
    r"with its constraints too far open: .*": "where the loops open: drag a pin (Select, V), so that it moves past",
}
SENTENCE_KEYS = ("problems", "remarks", "cause", "conflict", "motion", "why", "title")  # keys of answers with sentences
PYTHON_WORDING = re.compile(r"`|\budk(jax)?\b|\w\(\)|\b\w+=\S|\bdiffrax\b|\btraced\b")
PARENTHESIS = re.compile(r" \(((?:[^()]|\(\))*)\)")
CLAUSE = re.compile(r'((?:"[^"]*"|(?![;:] ).)+)([;:] )?')
VOCABULARY = re.compile(r'"[^"]*"|\bdriver(s?)\b|\b[Tt]he scene\b')
UNKNOWN_CAUSE = "this cannot be computed for the drawing as it is: go back to an earlier one (Ctrl+Z)"


def studio_words(message: str) -> str:
    """Return a message of the package in the words of the studio."""
    for pattern, words in STUDIO_WORDS.items():
        message = re.sub(pattern, words, message)
    if PYTHON_WORDING.search(message):
        message = _without_python(message) or UNKNOWN_CAUSE
    return VOCABULARY.sub(_noun, message)


def in_studio_words(answer: Any) -> Any:
    """Return an answer of JSON values whose sentences, the values of `SENTENCE_KEYS`, are in the studio's words."""
    if isinstance(answer, list):
        return [in_studio_words(x) for x in answer]
    if not isinstance(answer, dict):
        return answer
    return {key: _said(x) if key in SENTENCE_KEYS else in_studio_words(x) for key, x in answer.items()}


def _said(given: Any) -> Any:
    if isinstance(given, list):
        return [_said(x) for x in given]
    return studio_words(given) if isinstance(given, str) else given


def _without_python(message: str) -> str:
    message = PARENTHESIS.sub(lambda found: "" if PYTHON_WORDING.search(found[1]) else found[0], message)
    kept = [clause for clause in CLAUSE.findall(message) if not PYTHON_WORDING.search(clause[0])]
    return "".join(words + mark for words, mark in kept).rstrip(":; ")


def _noun(found: re.Match[str]) -> str:
    words = found[0]
    return words if words[0] == '"' else f"motor{found[1]}" if words.startswith("driver") else words.replace("scene", "drawing")
