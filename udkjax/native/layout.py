"""What a trajectory's code depends on, what it is called with, and where its numbers lie in memory."""

from dataclasses import dataclass, field
from typing import Any

from udkjax.native.ir import DOUBLE, Function, Value
from udkjax.native.steps import POINTS
from udkjax.native.tableau import Method

SETTINGS = ("rtol", "atol", "smallest", "first", "length", "omega", "care", "max_steps")
INPUTS = ("numbers", "ts", "q", "v", "settings", "rows", "breaks")
OUTPUTS = ("qs", "vs", "violation", "info")
INFO = ("code", "t", "tried", "accepted", "evaluations", "written")  # then the last q and v


@dataclass(frozen=True)
class Plan:
    """What a trajectory's code depends on."""

    code: Any  # `ScenePrograms` or `LoopPrograms`
    method: Method
    projected: bool
    breaks: bool
    width: int  # lanes
    vector: int  # numbers that a register holds


@dataclass
class Layout:
    """Where everything lies in the memory of a run, in numbers of W lanes each; arrays of coordinates fill whole registers."""

    width: int
    vector: int
    places: dict[str, int] = field(default_factory=dict)
    size: int = 0

    def add(self, name: str, count: int = 1) -> int:
        """A new array, from a register's boundary on."""
        step = max(self.vector // self.width, 1)
        self.places[name] = self.size
        self.size += -(-count // step) * step
        return self.places[name]

    def __getitem__(self, name: str) -> int:
        return self.places[name]


LANE_NUMBERS = (  # numbers of each lane; `call` and `ways` are addresses
    *("call", "ways"),
    *(
        "t1",
        "step",
        "error",
        "distance",
        "last",
        "lands",
        "h",
        "rate",
        "code",
        "doubt",
        "retries",
        "tried",
        "accepted",
        "evaluations",
    ),
    *("written", "steps", "member", "active", "judged", "begin", "careful", "ok", "until", "due", "next", "tolerance", "moving"),
    *(f"T{k}" for k in range(POINTS)),
    *(f"distance{k}" for k in range(POINTS - 1)),
    *SETTINGS,
    *("start", "end", "safe", "behind", "violated", "rank"),
    *("crossing", "aim", "tries", "share", "low", "again"),
)


class Lane:
    """The numbers of each lane, as attributes: read, and written for all lanes (or by `where` for some)."""

    def __init__(self, f: Function, layout: Layout):
        self.__dict__.update(_f=f, _layout=layout)

    def __getattr__(self, name: str) -> Value:
        f: Any = self.__dict__["_f"]
        return f.load(f.given["work"], self.__dict__["_layout"][name] * f.width, f.width)

    def __setattr__(self, name: str, value: Any):
        f: Any = self.__dict__["_f"]
        f.store(value, f.given["work"], self.__dict__["_layout"][name] * f.width, f.width)

    def where(self, mask: Value, **named: Any):
        f: Any = self.__dict__["_f"]
        for name, value in named.items():
            setattr(self, name, f.select(mask, f.like(value, DOUBLE, f.width), getattr(self, name)))
