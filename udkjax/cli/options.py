"""Options of commands: limits of their numbers, options that have no effect, and their names in messages of the package."""

import inspect
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from functools import wraps
from typing import Annotated, Any, NamedTuple, get_type_hints

from udkjax.cli.exits import refuse


class Limit(NamedTuple):
    """A condition on the number of an option, written at the parameter: `fps: Positive`."""

    text: str
    holds: Callable[[Any], bool]


Positive = Annotated[float, Limit("must be positive", lambda x: x > 0)]
NotNegative = Annotated[float, Limit("must not be negative", lambda x: x >= 0)]
PositiveCount = Annotated[int, Limit("must be positive", lambda x: x > 0)]
NotNegativeCount = Annotated[int, Limit("must not be negative", lambda x: x >= 0)]

_given: ContextVar[frozenset[str]] = ContextVar("given", default=frozenset())  # the options in the words of the command line

# Patterns of messages whose cure is an argument in Python, and the words in its place by command, "" for all others.
OPTION_WORDS: Mapping[str, Mapping[str, str]] = {
    r"; give width= to the link, or shapes=\{.*?\}": {
        "gaps": "; give it a width in the drawing, or --width for all links",
        "": "; give it a width in the drawing",
    },
    r"; give its width or corners, shapes=\{.*?\}": {
        "gaps": "; give --width for all links",
        "": "; only links of a drawing have one",
    },
    r"; name (at least one pair|pairs), pairs=\[.*?\]": {"": ""},
}


def with_checked_options(command: Callable[..., None], words: Sequence[str]) -> Callable[..., None]:
    """Return a command that refuses numbers of options that are not finite or beyond their limits.

    Errors of the package become messages that name the options instead of the arguments of Python.

    Args:
        command: the command.
        words: the words of the command line.
    """

    @wraps(command)
    def checked(*args: Any, **kwargs: Any) -> None:
        _given.set(frozenset(_options_of_words(words)))
        names, hints = option_names(command), get_type_hints(command, include_extras=True)
        for parameter, value in inspect.signature(command).bind(*args, **kwargs).arguments.items():
            limits = [x for x in _metadata(hints.get(parameter)) if isinstance(x, Limit)]
            for problem in _number_mistakes(value, limits):
                refuse(f"{names.get(parameter, parameter)} {problem}")
        try:
            command(*args, **kwargs)
        except ValueError as error:
            if not type(error).__module__.startswith("udkjax."):
                raise
            refuse(in_option_words(str(error), command))

    return checked


def refuse_without_effect(options: Iterable[str], phrase: str) -> None:
    """Exit with a message if the command line gives one of the options, which has no effect in this case.

    Args:
        options: the options, such as "--alpha".
        phrase: the case, which completes "--alpha has no effect ...".
    """
    for option in options:
        if option in _given.get():
            refuse(f"{option} has no effect {phrase}")


def option_names(command: Callable[..., None]) -> dict[str, str]:
    """Return the names of the options of a command, such as "--rank-tol", by parameter."""
    hints = get_type_hints(command, include_extras=True)
    names = {}
    for parameter in inspect.signature(command).parameters.values():
        if parameter.kind is not parameter.POSITIONAL_ONLY:
            own = [x.name for x in _metadata(hints.get(parameter.name)) if isinstance(getattr(x, "name", None), str)]
            names[parameter.name] = "--" + (own or [parameter.name.replace("_", "-")])[0]
    return names


def in_option_words(message: str, command: Callable[..., None]) -> str:
    """Return a message of the package with options of the command in place of arguments of Python."""
    names = option_names(command)
    for pattern, choices in OPTION_WORDS.items():
        message = re.sub(pattern, choices.get(command.__name__, choices[""]), message)
    first = re.match(r"(\w+)(?=:| must | \d)", message)
    return names[first[1]] + message[first.end() :] if first and first[1] in names else message


def _options_of_words(words: Sequence[str]) -> Iterator[str]:
    """Yield the options that words of a command line give, `--no-fixes` as `--fixes`."""
    for word in words:
        if word.startswith("--"):
            yield "--" + word.partition("=")[0][2:].replace("_", "-").removeprefix("no-")


def _metadata(hint: Any) -> Iterator[Any]:
    """Yield the metadata of `Annotated` anywhere in a type, as in `Annotated[int, ...] | None`."""
    yield from getattr(hint, "__metadata__", ())
    for part in getattr(hint, "__args__", ()):
        yield from _metadata(part)


def _number_mistakes(value: object, limits: Iterable[Limit]) -> Iterator[str]:
    """Yield the mistakes in the number, or the numbers, of an option, each preceded by the number; other values have none."""
    for x in value if isinstance(value, tuple) else (value,):
        if isinstance(x, bool) or not isinstance(x, int | float):
            continue
        if not math.isfinite(x):
            yield f"{x:g}: must be finite"
        else:
            yield from (f"{x:g}: {limit.text}" for limit in limits if not limit.holds(x))
