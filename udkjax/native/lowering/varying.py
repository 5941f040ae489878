"""Find the arrays of a jaxpr that may differ between lanes, from the inputs that do; others are computed once for all lanes."""

from collections.abc import Sequence
from typing import Any

from jax.extend import core

INLINED = frozenset("jit pjit closed_call core_call custom_jvp_call custom_vjp_call remat checkpoint".split())


def without_constants(jaxpr: Any) -> Any:
    """Return the jaxpr of a closed jaxpr, or a jaxpr itself."""
    return getattr(jaxpr, "jaxpr", jaxpr)


def inlined(equation: Any) -> Any:
    """Return the jaxpr that an equation calls, if its operations are to be lowered in place of the call; None otherwise."""
    if equation.primitive.name not in INLINED:
        return None
    return next(equation.params[k] for k in ("jaxpr", "call_jaxpr", "fun_jaxpr") if k in equation.params)


def parts_of(equation: Any) -> list[Any]:
    """Return the jaxprs within an equation: of calls, loops and branches."""
    found = (x for p in equation.params.values() for x in (p if isinstance(p, tuple | list) else (p,)))
    return [x for x in found if hasattr(without_constants(x), "eqns")]


def places_of_calls(jaxpr: Any) -> set[str]:
    """Return the names of the places that the calls of a module's functions in a jaxpr use for arguments and results."""
    found: set[str] = set()
    for e in without_constants(jaxpr).eqns:
        if (call := e.params.get("call")) is not None and hasattr(call, "functions"):
            found |= {*call.arguments, *(name for name, _ in call.results)}
        for part in parts_of(e):
            found |= places_of_calls(part)
    return found


def counts_of_scan(equation: Any) -> tuple[int, int]:
    """Return the numbers of constants and of states of a scan, by shapes: its parameters have other names in each release."""
    inner = without_constants(equation.params["jaxpr"])
    rows = sum(a.aval.shape != b.aval.shape for a, b in zip(equation.invars, inner.invars, strict=True))
    states = sum(a.aval.shape == b.aval.shape for a, b in zip(equation.outvars, inner.outvars, strict=True))
    return len(equation.invars) - states - rows, states


def varying(jaxpr: Any, given: Sequence[bool]) -> list[bool]:
    """Return, for each output of a jaxpr, whether it may differ between lanes; `given` tells this of its inputs."""
    jaxpr = without_constants(jaxpr)
    varies: dict[Any, bool] = dict(zip(jaxpr.invars, given, strict=True))

    def of(a: Any) -> bool:
        return not isinstance(a, core.Literal) and varies.get(a, False)

    for e in jaxpr.eqns:
        flags, inner, p = [of(a) for a in e.invars], inlined(e), e.params
        if inner is not None:
            out = varying(inner, flags)
        elif e.primitive.name == "scan":
            consts, carry = counts_of_scan(e)
            states = varying_states(p["jaxpr"], flags[:consts], flags[consts : consts + carry], flags[consts + carry :])
            out = [*states, *varying(p["jaxpr"], [*flags[:consts], *states, *flags[consts + carry :]])[carry:]]
        elif e.primitive.name == "while":
            a, b = p["cond_nconsts"], p["body_nconsts"]
            out = states_of_while(p["cond_jaxpr"], p["body_jaxpr"], flags[:a], flags[a : a + b], flags[a + b :])
        elif e.primitive.name == "cond":
            found = [varying(branch, flags[1:]) for branch in p["branches"]]
            out = [flags[0] or any(x) for x in zip(*found, strict=True)]
        else:
            out = [any(flags)] * len(e.outvars)
        varies.update(zip(e.outvars, out, strict=True))
    return [of(a) for a in jaxpr.outvars]


def varying_states(body: Any, constants: Sequence[bool], start: Sequence[bool], rows: Sequence[bool] = ()) -> list[bool]:
    """Return, for each state of a loop, whether it may differ between lanes, at the start or after any number of passes."""
    states = list(start)
    while True:
        out = varying(body, [*constants, *states, *rows])[: len(states)]
        now = [a or b for a, b in zip(states, out, strict=True)]
        if now == states:
            return now
        states = now


def states_of_while(test: Any, body: Any, of_test: Sequence[bool], of_body: Sequence[bool], start: Sequence[bool]) -> list[bool]:
    """Return, for each state of a while loop, whether it may differ between lanes; if the test may, all states may."""
    states = varying_states(body, of_body, start)
    return [True] * len(states) if varying(test, [*of_test, *states])[0] else states
