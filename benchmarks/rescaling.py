"""The same model in other units: every variable, parameter and equation multiplied by its own factor.

A flat model is written again as one component, connections and learned terms included, with v → s·v for variables,
p → q·p for parameters and every equation times a number: the physics is the same, and so must be verdict, states and
digits.
"""

import collections
import dataclasses
import re
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import sympy

from jaxonomy_dae import AcausalDiagram, Component, EqnEnv, Interval, NeuralDAEBlock
from jaxonomy_dae.compile.model.linear_template import LinearTemplate
from jaxonomy_dae.compile.model.opaque import OpaqueFunction
from jaxonomy_dae.compile.model.starts import Start
from jaxonomy_dae.compile.model.tables import EquationGroup, FlatModel
from jaxonomy_dae.graph.expressions.to_sympy import write
from jaxonomy_dae.write.symbols import TIME_LABEL, ParameterSymbol, VariableSymbol

NAME = "m"
SMALLEST, LARGEST = -12, 9  # exponents of ten

KINDS = ("equations", "parameters", "units", "all")


@dataclasses.dataclass(frozen=True)
class Factors:
    """The factor of each variable and parameter (old value = factor · new value), and of each equation, in the order of
    the flat model's groups."""

    variable: np.ndarray
    parameter: np.ndarray
    equation: np.ndarray


def random_factors(rng: np.random.Generator, model: FlatModel, kind: str) -> Factors:
    """`kind`: 'equations' scales only equations; 'parameters' these and parameters; 'units' also variables, all of one
    declared unit alike; 'all' everything by itself; 'none' nothing. Factors lie between 1e-12 and 1e9."""

    def factors(n: int, wanted: bool = True) -> np.ndarray:
        return 10 ** rng.uniform(SMALLEST, LARGEST, n) if wanted else np.ones(n)

    assert kind in (*KINDS, "none"), kind
    equation = factors(model.n_equations, kind != "none")
    parameter = factors(len(model.parameters), kind not in ("equations", "none"))
    # Discrete variables number modes: they are compared with whole numbers, and have no unit.
    parameter[model.parameters.discrete] = 1.0
    parameter[model.parameters.n_declared :] = 1.0
    if kind == "units":
        units = sorted(set(model.variables.unit))
        of_unit = dict(zip(units, factors(len(units)), strict=True))
        return Factors(np.array([of_unit[u] for u in model.variables.unit]), parameter, equation)
    return Factors(factors(len(model.variables), kind == "all"), parameter, equation)


def plain(name: str) -> str:
    """A variable's or parameter's name in the rescaled component."""
    return re.sub(r"[^\w]", "__", name)


def new_name(name: str) -> str:
    """The full name, in the rescaled model, of a variable or parameter."""
    return f"{NAME}.{plain(name)}"


class Scaled(eqx.Module):
    """A network, or a function(t, u, theta), between quantities in other units."""

    network: Any
    function: Callable | None = eqx.field(static=True)
    inputs: tuple[float, ...] = eqx.field(static=True)
    outputs: tuple[float, ...] = eqx.field(static=True)

    def __call__(self, u):
        scaled = u[: len(self.inputs)] * jnp.asarray(self.inputs, u.dtype)
        if self.function is None:
            out = self.network(scaled)
        else:
            out = self.function(u[-1], scaled, self.network)
        return out / jnp.asarray(self.outputs, out.dtype)


class _Whole(Component):
    def __init__(self, ev: EqnEnv, model: FlatModel, factors: Factors, order: np.ndarray, rows: np.ndarray):
        super().__init__(ev, NAME)
        table, variables = model.parameters, model.variables
        declared: dict[int, sympy.Expr] = {}

        def parameter(p: int) -> sympy.Expr:
            """The old parameter, in the new one."""
            return factors.parameter[p] * ParameterSymbol(f"p_{plain(table.names[p])}")

        computed = {
            int(target): write(group.template.graph, lambda label, ids=ids: parameter(int(ids[label[1]])))
            for group in table.dependents
            for target, ids in zip(group.target, group.parameter, strict=True)
        }
        for p, name in enumerate(table.names):
            value = (
                computed[p] / factors.parameter[p] if p in computed else model.declares.values[p] / factors.parameter[p]
            )
            declared[p] = self.parameter(f"p_{plain(name)}", value)

        def start_of(start: Start, s: float) -> sympy.Expr:
            return write(start.template.graph, lambda label: parameter(start.parameters[label[1]])) / s

        def at(v: int, order: int) -> sympy.Expr:
            return factors.variable[v] * VariableSymbol(plain(variables.names[v]), order)

        for k in order.tolist():
            name, s, default = plain(variables.names[k]), factors.variable[k], variables.default[k]
            if variables.is_input[k]:
                self.input(name, default=None if default is None else default / s)
                continue
            start = variables.start[k]
            low, high = (variables.bounds[k] / s).tolist()
            given = {"nominal": variables.nominal[k] / s} if variables.nominal[k] else {}
            self.variable(
                name,
                start=None if start is None else start_of(start, s),
                fixed=bool(variables.fixed[k]),
                bounds=Interval(low, high),
                unit=variables.unit[k],
                **given,
            )
        equations: list[Any] = []
        uses: dict[Any, dict[int, tuple[EquationGroup, int]]] = {}
        for group in model.groups:
            seen: collections.Counter = collections.Counter()
            for i in range(len(group)):
                equations.append(_residual(ev, group, i, at, parameter))
                if equations[-1] is None:
                    # One use of the network has one output of each number, and its own inputs.
                    use = group.template.opaque, *group.variable[i, 1:].tolist(), *group.order[i, 1:].tolist()
                    uses.setdefault((*use, seen[use]), {})[group.template.output] = (group, i)
                    seen[use] += 1
        for k in rows.tolist():
            if equations[k] is not None:
                self.add_equations(factors.equation[k] * equations[k])
        for k, ((function, *_), written) in enumerate(uses.items()):
            self._learn(ev, model, factors, function, written, f"n_{k}_{plain(function.name)}")

    def _learn(self, ev: EqnEnv, model: FlatModel, factors: Factors, function: OpaqueFunction, written, name: str):
        """The outputs of a network equal the variables that stood for them."""
        group, i = written[0]
        variable, order = group.variable[i, 1:].tolist(), group.order[i, 1:].tolist()
        source = iter(zip(variable, order, strict=True))
        inputs, scales = [], []
        for j in range(function.n_inputs):
            if j in function.time_positions:
                inputs.append(ev.t)
                scales.append(1.0)
            else:
                v, q = next(source)
                inputs.append(VariableSymbol(plain(model.variables.names[v]), q))
                scales.append(float(factors.variable[v]))
        results = [int(written[k][0].variable[written[k][1], 0]) for k in range(len(written))]
        old = tuple(factors.variable[results].tolist())
        network = Scaled(model.declares.networks[function.name], function.function, tuple(scales), old)
        if function.function is not None:
            inputs.append(ev.t)
        outputs = self.learned(name, network, inputs)
        for v, y in zip(results, outputs, strict=True):
            self.add_equations(VariableSymbol(plain(model.variables.names[v])) - y)


def _residual(ev: EqnEnv, group: EquationGroup, i: int, at, parameter) -> sympy.Expr | None:
    """The residual of one equation in new symbols; None for a network's."""
    slots = [at(v, q) for v, q in zip(group.variable[i].tolist(), group.order[i].tolist(), strict=True)]
    if isinstance(group.template, LinearTemplate):
        return sympy.Add(*(c * s for c, s in zip(group.coefficient[i].tolist(), slots, strict=True)))
    if group.template.opaque is not None:
        return None

    def symbol(label):
        if label == TIME_LABEL:
            return ev.t
        return slots[label[1]] if label[0] == "slot" else parameter(int(group.parameter[i, label[1]]))

    return write(group.template.graph, symbol)


def rescaled(
    rng: np.random.Generator, model: FlatModel, kind: str, shuffled: bool = True
) -> tuple[EqnEnv, AcausalDiagram, Factors]:
    """The model in other units; its equations and variables in random order, if `shuffled`."""
    factors = random_factors(rng, model, kind)
    ev = EqnEnv()
    order, rows = np.arange(len(model.variables)), np.arange(model.n_equations)
    if shuffled:
        order, rows = rng.permutation(order), rng.permutation(rows)
    diagram = AcausalDiagram().add(_Whole(ev, model, factors, order, rows))
    for row in model.rows:
        targets = [new_name(model.variables.names[v]) for v in row.targets]
        source = iter(row.inputs)
        inputs: list[str] = []
        scales: list[float] = []
        for j in range(row.opaque.n_inputs):
            v = -1 if j in row.opaque.time_positions else next(source)
            inputs.append("time" if v < 0 else new_name(model.variables.names[v]))
            scales.append(1.0 if v < 0 else float(factors.variable[v]))
        if row.opaque.function is not None:
            inputs.append("time")
        old = tuple(factors.variable[list(row.targets)].tolist())
        network = Scaled(model.declares.networks[row.opaque.name], row.opaque.function, tuple(scales), old)
        diagram.add_neural_correction_block(
            NeuralDAEBlock(network, targets=targets, inputs=inputs, name=f"n_{plain(row.opaque.name)}", inject="row")
        )
    return ev, diagram, factors
