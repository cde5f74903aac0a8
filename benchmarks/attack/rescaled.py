"""The same model in other units: every variable, parameter and equation multiplied by its own factor.

`rescaled` writes a diagram again as one component, connections as equations, with v → s·v for variables, p → q·p for
parameters and every equation times a number: the physics is the same, and so must be verdict, states and digits.
"""

import dataclasses
from collections.abc import Callable, Mapping

import numpy as np
import sympy

from jaxonomy_dae import AcausalDiagram, Component, EqnEnv
from jaxonomy_dae.modeling.symbols import ParameterSymbol, VariableSymbol

from .case import Case, Expected

NAME = "m"


@dataclasses.dataclass(frozen=True)
class Written:
    """A diagram as equations in full names: SymPy expressions in `variables[name]` and `parameters[name]`.

    `starts` are expressions in parameters, with whether they are fixed."""

    variables: list[str]
    parameters: dict[str, float]
    equations: list[sympy.Expr]
    starts: dict[str, tuple[sympy.Expr, bool]]
    nominal: dict[str, float]
    unit: dict[str, str]


def written(diagram: AcausalDiagram) -> Written:
    """The equations of a diagram without learned terms and inputs."""
    out = Written([], {}, [], {}, {}, {})

    def visit(component: Component, prefix: str):
        assert not component.learned_terms
        for name, variable in component.variables.items():
            assert variable.kind != "input"
            full = prefix + name
            out.variables.append(full)
            out.nominal[full], out.unit[full] = variable.nominal, variable.unit
            if variable.start is not None:
                out.starts[full] = (_renamed(variable.start, prefix), variable.fixed)
        for name, parameter in component.parameters.items():
            out.parameters[prefix + name] = parameter.value
        out.equations.extend(_renamed(e, prefix) for e in component.equations)
        connected(component.connections, prefix, component)
        for child in component.children.values():
            visit(child, f"{prefix}{child.name}.")

    outside: set[int] = set()

    def connected(connections, prefix: str, owner):
        sets: list[dict[int, tuple]] = []
        for ends in connections:
            merged = {id(port): port for port in ends}
            for other in [s for s in sets if s.keys() & merged.keys()]:
                merged |= other
                sets.remove(other)
            sets.append(merged)
        for ports in sets:
            paths = []
            for port in ports.values():
                own = port.component is owner
                if not own:
                    outside.add(id(port))
                paths.append((prefix + port.name if own else f"{prefix}{port.component.name}.{port.name}", own, port))
            domain = paths[0][2].domain
            for name, _ in domain.across:
                first = VariableSymbol(f"{paths[0][0]}.{name}")
                out.equations.extend(first - VariableSymbol(f"{path}.{name}") for path, _, _ in paths[1:])
            for name, _ in domain.through:
                out.equations.append(
                    sympy.Add(*((-1 if own else 1) * VariableSymbol(f"{path}.{name}") for path, own, _ in paths))
                )

    def loose(component: Component, prefix: str):
        for port in component.ports.values():
            if id(port) not in outside:
                for name, _ in port.domain.through:
                    out.equations.append(VariableSymbol(f"{prefix}{port.name}.{name}"))
        for child in component.children.values():
            loose(child, f"{prefix}{child.name}.")

    connected(diagram.connections, "", None)
    for component in diagram.components.values():
        visit(component, f"{component.name}.")
    for component in diagram.components.values():
        loose(component, f"{component.name}.")
    return out


def _renamed(expression: sympy.Expr, prefix: str) -> sympy.Expr:
    table = {}
    for s in expression.free_symbols:
        if isinstance(s, VariableSymbol):
            table[s] = VariableSymbol(prefix + s.path, s.order)
        elif isinstance(s, ParameterSymbol):
            table[s] = ParameterSymbol(prefix + s.path)
    return expression.xreplace(table)


@dataclasses.dataclass(frozen=True)
class Factors:
    """The factor of each variable and parameter (old value = factor · new value), and of each equation."""

    variable: Mapping[str, float]
    parameter: Mapping[str, float]
    equation: list[float]


def random_factors(rng: np.random.Generator, model: Written, kind: str) -> Factors:
    """`kind`: 'equations' scales only equations; 'parameters' these and parameters; 'units' also variables, all of one
    declared unit alike; 'all' everything by itself. Factors lie between 1e-12 and 1e9."""

    def factor() -> float:
        return float(10 ** rng.uniform(-12, 9))

    ones = dict.fromkeys(model.variables, 1.0)
    parameter = {p: factor() if kind != "equations" else 1.0 for p in model.parameters}
    equation = [factor() for _ in model.equations]
    if kind == "units":
        units = {u: factor() for u in dict.fromkeys(model.unit.values())}
        return Factors({v: units[model.unit[v]] for v in model.variables}, parameter, equation)
    return Factors({v: factor() for v in model.variables} if kind == "all" else ones, parameter, equation)


class _Whole(Component):
    def __init__(self, ev: EqnEnv, model: Written, factors: Factors, order: np.ndarray, rows: np.ndarray):
        super().__init__(ev, NAME)
        table = {}
        for name, value in model.parameters.items():
            q = factors.parameter[name]
            table[ParameterSymbol(name)] = q * self.parameter(f"p_{plain(name)}", value / q)

        def there(expression: sympy.Expr) -> sympy.Expr:
            swap = dict(table)
            for s in expression.free_symbols:
                if isinstance(s, VariableSymbol):
                    swap[s] = factors.variable[s.path] * VariableSymbol(plain(s.path), s.order)
            return expression.xreplace(swap)

        for k in order:
            name = model.variables[k]
            start, fixed = model.starts.get(name, (None, False))
            s = factors.variable[name]
            declared = {"nominal": model.nominal[name] / s} if model.nominal.get(name) else {}
            self.variable(plain(name), start=None if start is None else there(start) / s, fixed=fixed, **declared)
        for k in rows:
            self.add_equations(factors.equation[k] * there(model.equations[k]))


def plain(name: str) -> str:
    """A variable's name in the rescaled component."""
    return name.replace(".", "__")


def rescaled_diagram(
    rng: np.random.Generator, diagram: AcausalDiagram, kind: str
) -> tuple[EqnEnv, AcausalDiagram, Factors]:
    """The diagram in other units, its equations and variables in random order."""
    model = written(diagram)
    factors = random_factors(rng, model, kind)
    ev = EqnEnv()
    order, rows = rng.permutation(len(model.variables)), rng.permutation(len(model.equations))
    return ev, AcausalDiagram().add(_Whole(ev, model, factors, order, rows)), factors


def rescaled(case: Case, seed: int, kind: str) -> Case:
    """The case in other units."""
    rng = np.random.default_rng([seed, 9])
    ev, diagram, factors = rescaled_diagram(rng, case.diagram, kind)

    def values(table: Mapping[str, Expected]) -> dict[str, Expected]:
        out = {}
        for name, true in table.items():
            s = factors.variable[name]
            out[f"{NAME}.{plain(name)}"] = Expected(true.value / s, true.allowed / s)
        return out

    initial = {f"{NAME}.{plain(n)}": v / factors.variable[n] for n, v in case.initial.items()}
    return dataclasses.replace(
        case, ev=ev, diagram=diagram, initial=initial, expected=values(case.expected), rates=values(case.rates),
        motion=None, note=f"{case.note}; {kind} rescaled",
    )  # fmt: skip


def family(make: Callable[[int], Case], kind: str) -> Callable[[int], Case]:
    """A family in other units."""
    return lambda seed: rescaled(make(seed), seed, kind)
