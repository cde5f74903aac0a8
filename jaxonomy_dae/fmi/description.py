"""`modelDescription.xml` of FMI 3.0: variables with their units, starts and bounds, and what depends on what."""

import dataclasses
import math
import re
from collections.abc import Sequence
from fractions import Fraction
from xml.sax.saxutils import quoteattr

import numpy as np

from ..base.errors import MissingPackage
from ..compile.model.array_names import inner_name
from ..graph.units.parse import UnknownUnit, read_unit
from ..graph.units.unit import Unit, rate
from .model_c import CVariable

STRUCTURED = re.compile(r"[A-Za-z_]\w*(\[\d+(,\d+)*\])?(\.[A-Za-z_]\w*(\[\d+(,\d+)*\])?)*", re.ASCII)
LOG_CATEGORIES = '  <LogCategories><Category name="logStatusError"/><Category name="logStatusDiscard"/></LogCategories>'
SI_IN_XML = ("kg", "m", "s", "A", "K", "mol", "cd")  # the order of the standard's schema


@dataclasses.dataclass(frozen=True)
class Variable:
    """A variable of an FMU: the attributes of the standard, and what it is in the C code. `derivative` is the place of
    the state whose derivative it is."""

    name: str
    causality: str
    variability: str
    c: CVariable
    initial: str | None = None
    start: np.ndarray | None = None
    unit: str = ""
    description: str = ""
    nominal: float = 0.0
    derivative: int | None = None
    reinit: bool = False
    shape: tuple[int, ...] = ()


@dataclasses.dataclass(frozen=True)
class Structure:
    """What depends on what: for each of these variables by their places, the places of those that it depends on, or
    None for all."""

    outputs: dict[int, Sequence[int] | None]
    derivatives: dict[int, Sequence[int] | None]
    indicators: dict[int, Sequence[int] | None]
    initial: Sequence[int]


def structured(name: str) -> str:
    """A name as the naming convention `structured` writes it: der(m.x,2) for a second derivative, and with a quoted
    part where it has letters that identifiers have not: 'm_u00fc.x' for mü.x."""
    order, inner = inner_name(name)
    if not STRUCTURED.fullmatch(inner):
        # The convention knows ASCII alone. Each other letter has its own number, so that two names stay two.
        legal = re.sub(r"[^A-Za-z0-9_!#$%&()*+,\-./:;<>=?@\[\]^{}|~ ]", lambda found: f"_u{ord(found[0]):04x}", inner)
        inner = f"'{legal}'"
    return inner if not order else f"der({inner})" if order == 1 else f"der({inner},{order})"


def unit_of_rate(unit: str) -> str:
    """The unit of a time derivative; none where it would need to be written anew."""
    found = _read(unit)
    if found is None:
        return ""
    if unit == "1":
        return "s-1"
    longer = f"{unit}2" if unit.endswith("/s") else f"({unit})/s"
    return str(rate(found, 1).text) or (longer if unit and _read(longer) else "")


def _read(unit: str) -> Unit | None:
    try:
        return read_unit(unit)
    except (UnknownUnit, MissingPackage):
        return None


def model_description(
    model: str, identifier: str, token: str, variables: Sequence[Variable], structure: Structure, completed: bool,
    co_simulation: bool, stop: float, tolerance: float,
) -> str:  # fmt: skip
    """The XML text; the place of a variable is its value reference. `completed` says whether integrators must tell
    of completed steps."""
    abilities = (
        f'modelIdentifier="{identifier}" canGetAndSetFMUState="true" canSerializeFMUState="true" '
        'providesDirectionalDerivatives="true" providesAdjointDerivatives="true"'
    )
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        f'<fmiModelDescription fmiVersion="3.0" modelName={quoteattr(model)} instantiationToken="{token}" '
        'generationTool="jaxonomy_dae" variableNamingConvention="structured">',
        f"  <ModelExchange {abilities}" + ' needsCompletedIntegratorStep="true"' * completed + "/>",
        *([f'  <CoSimulation {abilities} canHandleVariableCommunicationStepSize="true"/>'] if co_simulation else []),
        *unit_definitions(variables),
        LOG_CATEGORIES,
        f'  <DefaultExperiment startTime="0" stopTime="{in_xml(stop)}" tolerance="{in_xml(tolerance)}"/>',
        "  <ModelVariables>",
        *(line for k, variable in enumerate(variables) for line in _variable(k, variable)),
        "  </ModelVariables>",
        "  <ModelStructure>",
    ]
    for tag, group in (
        ("Output", structure.outputs), ("ContinuousStateDerivative", structure.derivatives),
        ("InitialUnknown", dict.fromkeys(structure.initial)), ("EventIndicator", structure.indicators),
    ):  # fmt: skip
        for place, dependencies in group.items():
            listed = "" if dependencies is None else f' dependencies="{" ".join(map(str, dependencies))}"'
            lines.append(f'    <{tag} valueReference="{place}"{listed}/>')
    return "\n".join([*lines, "  </ModelStructure>", "</fmiModelDescription>", ""])


def in_xml(x: float) -> str:
    """A number in XML."""
    return str(float(x))


def unit_definitions(variables: Sequence[Variable]) -> list[str]:
    """The lines of all units that variables have."""
    texts = dict.fromkeys(v.unit for v in variables if v.unit)
    if not texts:
        return []
    lines = ["  <UnitDefinitions>"]
    for text in texts:
        unit = _read(text)
        base = "" if unit is None else _base_unit(unit, text)
        lines.append(
            f"    <Unit name={quoteattr(text)}>{base}</Unit>" if base else f"    <Unit name={quoteattr(text)}/>"
        )
    return [*lines, "  </UnitDefinitions>"]


def _base_unit(unit: Unit, text: str) -> str:
    """The exponents of base units, with what takes values to them; empty for exponents that are no integers."""
    exponents = dict(unit.dimension)
    if any(e != int(e) for e in exponents.values()):
        return ""
    if text in ("rad", "rad/s"):  # angles are numbers to `units`, and a unit of their own to the standard
        exponents = exponents | {"rad": Fraction(1)}
    parts = [f'{name}="{int(exponents[name])}"' for name in (*SI_IN_XML, "rad") if exponents.get(name)]
    parts += [f'factor="{in_xml(unit.scale)}"'] if unit.scale != 1.0 else []
    parts += [f'offset="{in_xml(unit.zero)}"'] if unit.zero else []
    return f"<BaseUnit {' '.join(parts)}/>" if parts else "<BaseUnit/>"


def of_variable(place: int, v: Variable) -> list[str]:
    """The attributes of a variable that say what it is."""
    attributes = [
        f"name={quoteattr(v.name)}", f'valueReference="{place}"', f'causality="{v.causality}"',
        f'variability="{v.variability}"',
    ]  # fmt: skip
    if v.description:
        attributes.append(f"description={quoteattr(v.description)}")
    if v.initial:
        attributes.append(f'initial="{v.initial}"')
    return attributes


def of_number(v: Variable, first: int) -> list[str]:
    """The attributes of a variable's values. `first` is the number of the first variable."""
    attributes = [f"unit={quoteattr(v.unit)}"] if v.unit else []
    if v.nominal > 0 and v.nominal != 1.0:
        attributes.append(f'nominal="{in_xml(v.nominal)}"')
    attributes += [f'{end}="{in_xml(x)}"' for end, x in (("min", v.c.low), ("max", v.c.high)) if math.isfinite(x)]
    if v.derivative is not None:
        attributes.append(f'derivative="{v.derivative + first}"')
    if v.reinit:
        attributes.append('reinit="true"')
    if v.start is not None:
        attributes.append(f'start="{" ".join(map(in_xml, np.ravel(v.start)))}"')
    return attributes


def _variable(place: int, v: Variable) -> list[str]:
    head = f"    <Float64 {' '.join([*of_variable(place, v), *of_number(v, 0)])}"
    if not v.shape:
        return [f"{head}/>"]
    return [f"{head}>" + "".join(f'<Dimension start="{n}"/>' for n in v.shape) + "</Float64>"]
