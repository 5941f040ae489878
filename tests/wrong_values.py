"""Values of the wrong shape, and numbers beyond the range of floats, to be put at each place of a TOML file."""

import copy
import json

HUGE = int("1" + "0" * 400)
WRONG = {"ragged": [[1, 2], [3]], "empty": [[[]]], "huge": HUGE, "huge in a list": [HUGE, 0], "infinite": [float("inf"), 1]}


def toml(value) -> str:
    """Return a value as TOML, a table in one line."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(key)} = {toml(x)}" for key, x in value.items()) + "}"
    if isinstance(value, list):
        return f"[{', '.join(map(toml, value))}]"
    return str(value) if isinstance(value, float | int) and not isinstance(value, bool) else json.dumps(value)


def toml_text(scene: dict) -> str:
    """Return a table as the text of a TOML file."""
    return "\n".join(f"{key} = {toml(value)}" for key, value in scene.items())


def places(value, path=()):
    """Yield the paths of all numbers, texts and lists of a table."""
    for key, x in value.items() if isinstance(value, dict) else enumerate(value):
        if not isinstance(x, dict) and not (isinstance(x, list) and any(isinstance(entry, dict) for entry in x)):
            yield (*path, key)
        if isinstance(x, dict | list):
            yield from places(x, (*path, key))


def with_value(scene, path, value):
    """Return a copy of a scene with another value at a path."""
    changed = holder = copy.deepcopy(scene)
    for key in path[:-1]:
        holder = holder[key]
    holder[path[-1]] = value
    return changed
