"""modelDescription.xml and buildDescription.xml of an FMU."""

import re
from collections.abc import Iterable, Sequence
from xml.sax.saxutils import quoteattr

from udkjax.integrate.portable.fmi.variables import FMUVariable, FMUVariables
from udkjax.integrate.solution import versions

BASE_UNITS = {"m": {"m": 1}, "kg": {"kg": 1}, "s": {"s": 1}, "rad": {"rad": 1}, "N": {"kg": 1, "m": 1, "s": -2}}
STATE_CAPABILITIES = {"canGetAndSetFMUState": "true", "canSerializeFMUState": "true"}
DERIVATIVE_CAPABILITIES = {"providesDirectionalDerivatives": "true", "providesAdjointDerivatives": "true"}
INTERFACE_KINDS = {  # in the order of the schema
    "model-exchange": ("ModelExchange", {"needsCompletedIntegratorStep": "true"}),
    "co-simulation": ("CoSimulation", {"canHandleVariableCommunicationStepSize": "true"}),
}


def model_description(
    name: str, prefix: str, token: str, kinds: Sequence[str], variables: FMUVariables, times: Sequence[float], rtol: float
) -> str:
    """Return the text of modelDescription.xml.

    Args:
        name: the name of the scene.
        prefix: the model identifier.
        token: the instantiation token.
        kinds: "co-simulation", "model-exchange" or both.
        variables: the variables of the FMU.
        times: start and stop time, and the step of the default experiment (s).
        rtol: relative tolerance.
    """
    exchange = "model-exchange" in kinds
    able = STATE_CAPABILITIES | (DERIVATIVE_CAPABILITIES if exchange else {})
    interfaces = [_tag(INTERFACE_KINDS[kind][0], {"modelIdentifier": prefix} | INTERFACE_KINDS[kind][1] | able) for kind in kinds]
    start, stop, step = times
    experiment = {"startTime": start, "stopTime": stop, "tolerance": rtol, "stepSize": step}
    units = sorted(
        {x.unit for x in (*variables.coordinates, *variables.rates, *variables.values, *variables.measures)} - {""} | {"s"}
    )
    about = {
        "fmiVersion": "3.0",
        "modelName": name,
        "instantiationToken": token,
        "generationTool": f"udkjax {versions()['udkjax']}",
        "variableNamingConvention": "flat",
    }
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        _tag("fmiModelDescription", about, closed=False),
        *interfaces,
        "<UnitDefinitions>",
        *(f"<Unit name={quoteattr(unit)}>{_tag('BaseUnit', base_unit(unit))}</Unit>" for unit in units),
        "</UnitDefinitions>",
        "<LogCategories>",
        *(_tag("Category", {"name": x}) for x in ("logStatusDiscard", "logStatusError")),
        "</LogCategories>",
        _tag("DefaultExperiment", {key: repr(float(x)) for key, x in experiment.items()}),
        "<ModelVariables>",
        *_variables(variables, exchange),
        "</ModelVariables>",
        "<ModelStructure>",
        *_structure(variables, exchange),
        "</ModelStructure>",
        "</fmiModelDescription>",
    ]
    return "\n".join(lines) + "\n"


def build_description(prefix: str, sources: Iterable[str]) -> str:
    """Return the text of sources/buildDescription.xml, from which a tool learns how to compile the FMU."""
    files = "".join(f"{_tag('SourceFile', {'name': name})}\n" for name in sources)
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<fmiBuildDescription fmiVersion="3.0">
<BuildConfiguration modelIdentifier={quoteattr(prefix)}>
<SourceFileSet language="C99">
{files}</SourceFileSet>
</BuildConfiguration>
</fmiBuildDescription>
"""


def base_unit(unit: str) -> dict[str, str]:
    """Return the exponents, as strings, of FMI's base units in a unit such as "N m/rad" or "kg m2"."""
    found: dict[str, int] = {}
    for side, sign in zip(unit.split("/"), (1, -1), strict=False):
        for name, exponent in re.findall(r"([A-Za-z]+)(\d*)", side):
            for base, count in BASE_UNITS[name].items():
                found[base] = found.get(base, 0) + sign * count * int(exponent or 1)
    return {base: str(count) for base, count in found.items() if count}


def _variables(variables: FMUVariables, exchange: bool) -> Iterable[str]:
    n = len(variables.states) // 2
    yield _variable(0, FMUVariable("time", "s"), causality="independent", variability="continuous")
    shown = variables.coordinates if exchange else variables.coordinates[: 2 * n]
    for k, x in enumerate(shown):
        yield _variable(1 + k, x, causality="output", variability="continuous", initial="calculated")
    for k, x in enumerate(variables.states):
        yield _variable(1 + 3 * n + k, x, causality="local", variability="continuous", initial="approx")
    for k, x in enumerate(variables.rates if exchange else ()):
        kind = {"causality": "local", "variability": "continuous", "initial": "calculated"}
        yield _variable(1 + 5 * n + k, x, **kind, derivative=str(1 + 3 * n + k))
    for k, x in enumerate(variables.parameters):
        yield _variable(1 + 7 * n + k, x, causality="parameter", variability="fixed", initial="exact")
    for k, x in enumerate(variables.inputs):
        yield _variable(1 + 7 * n + len(variables.parameters) + k, x, causality="input", variability="continuous")
    for k, x in enumerate(variables.measures, 1 + 7 * n + len(variables.values)):
        yield _variable(k, x, causality="output", variability="continuous", initial="calculated")


def _variable(reference: int, x: FMUVariable, **kinds: str) -> str:
    given = {"name": x.name, "valueReference": str(reference)} | kinds
    given |= {"unit": x.unit} if x.unit else {}
    given |= {} if x.start is None else {"start": repr(float(x.start))}
    return _tag("Float64", given)


def _structure(variables: FMUVariables, exchange: bool) -> Iterable[str]:
    n = len(variables.states) // 2
    first = 1 + 7 * n + len(variables.values)
    outputs = *range(1, 1 + (3 if exchange else 2) * n), *range(first, first + len(variables.measures))
    states, rates = range(1 + 3 * n, 1 + 5 * n), range(1 + 5 * n, 1 + 7 * n) if exchange else ()
    for name, found in (("Output", outputs), ("ContinuousStateDerivative", rates)):
        yield from (_tag(name, {"valueReference": str(k)}) for k in found)
    for k in (*outputs, *(states if exchange else ()), *rates):
        yield _tag("InitialUnknown", {"valueReference": str(k)})


def _tag(name: str, attributes: dict[str, str], closed: bool = True) -> str:
    return f"<{name}{''.join(f' {key}={quoteattr(x)}' for key, x in attributes.items())}{'/' if closed else ''}>"
