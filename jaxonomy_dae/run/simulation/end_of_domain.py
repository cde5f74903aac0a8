"""Which equation has no finite value where a run ends or just beyond, and which part of it: a root, a logarithm or a
division that leaves its domain."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
import sympy

from ...base.aliases import Inputs, State, Time
from ...compile.lowering.schedule import StepEquation
from ...compile.model.group import Point
from ...compile.model.opaque import Networks
from ...compile.model.symbolic import SymbolicTemplate, number_label, parameter_label, slot_label
from ...compile.model.tables import ZERO
from ...graph.expressions.node import postorder
from ...graph.expressions.to_sympy import shortened, write
from ...solve.methods.dae_term import FlatProblem
from ...solve.methods.index_one import consistent_slope
from ...write.symbols import TIME_LABEL
from ..system.system import AcausalSystem
from .failed_blocks import NEAR, SHOWN, quantities
from .preparation import term_of

ANY = 0.5  # the value given to the unknown of an equation that is only asked whether it is finite


@dataclasses.dataclass(frozen=True)
class NotFinite:
    """An equation that reads finite values and is not finite itself: a row of a group, and the point."""

    equation: StepEquation
    row: int
    values: np.ndarray
    finite: np.ndarray
    at: Point

    def text(self, system: AcausalSystem) -> str:
        """The equation, with what it reads."""
        plan, row = system.plan, self.row
        read = dict.fromkeys(self.equation.quantity[row].tolist())
        given = {plan.quantity_name[q]: self.values[q] for q in read if q >= 0 and self.finite[q]}
        given |= {plan.flat.parameters.names[p]: self.at.parameters[p] for p in self.equation.parameter[row].tolist()}
        shown = ", ".join(f"'{name}' = {value:.6g}" for name, value in list(given.items())[:SHOWN])
        return plan.locate(int(self.equation.equation[row])) + (f", with {shown}" if shown else "")

    def part(self, system: AcausalSystem) -> str:
        """The innermost part of the equation that has no value, in names of the model; "" if it cannot be told."""
        template = self.equation.template
        if not isinstance(template, SymbolicTemplate):
            return ""
        nodes = postorder([template.graph])
        quantities, factors = self.equation.quantity[self.row], self.equation.factor[self.row]
        parameters, numbers = self.equation.parameter[self.row], self.equation.coefficient[self.row]
        slots = [*(factors * self.at.values[quantities])]
        parts = template.values_of(nodes, slots, [*self.at.parameters[parameters]], [*numbers], self.at.t)
        bad = {n for n, value in zip(nodes, parts, strict=True) if not np.isfinite(np.asarray(value, float)).all()}
        first = next((n for n in nodes if n in bad and bad.isdisjoint(n.arguments)), None)
        if first is None:
            return ""
        plan = system.plan
        names: dict[Any, Any] = {TIME_LABEL: sympy.Symbol("t")}
        for label, q, factor in zip(
            map(slot_label, template.slots), quantities.tolist(), factors.tolist(), strict=True
        ):
            names[label] = _short(factor) * sympy.Symbol(plan.quantity_name[q]) if q != ZERO else sympy.Integer(0)
        for k, p in enumerate(parameters.tolist()):
            names[parameter_label(k)] = sympy.Symbol(plan.flat.parameters.names[p])
        for k, number in enumerate(numbers.tolist()):
            names[number_label(k)] = _short(number)
        return shortened(write(first, names.__getitem__))


def _short(number: float) -> Any:
    return sympy.Integer(int(number)) if number == int(number) else sympy.Float(number)


def equation_not_finite(system: AcausalSystem, inputs: Inputs, t: Time, x: State) -> NotFinite | None:
    """The first equation, in the order of solution, that reads finite values and is not finite itself."""
    plan = system.plan
    every = np.arange(plan.extended.quantities.n)
    found = quantities(system, t, jnp.asarray(x), inputs, tuple(every.tolist()))
    values = np.append(np.asarray(found, float), 0.0)  # ZERO is −1: the last entry
    finite = np.isfinite(values)
    parameters = np.asarray(system.numbers, float)
    networks = Networks(tuple(system.neural[n] for n in plan.network_names))
    at = Point(np.where(finite, values, ANY), parameters, float(t), networks)
    for step in plan.steps:
        own = np.zeros(len(values), bool)
        own[np.concatenate(step.unknown)] = True
        for equation in step.equations:
            # The unknowns of a step that failed are not finite, whichever equation is to blame: each is asked with ANY
            # in their place.
            known = (finite | own)[equation.quantity].all(axis=1)
            wrong = ~np.isfinite(equation.residual(at)) & known
            if wrong.any():
                return NotFinite(equation, int(np.argmax(wrong)), values, finite, at)
    return None


def end_of_domain(system: AcausalSystem, t: Time, x: State, t1: Time, inputs: Inputs) -> str:
    """Names the equation that has no finite value just beyond the last point (t, x), and which part of it; "" if all
    have one."""
    problem = FlatProblem(term_of(system, implicit=True), x, inputs)
    slope = np.asarray(consistent_slope(problem, None, jnp.asarray(t), jnp.asarray(x)))
    if not np.isfinite(slope).all():
        return ""
    # From the nearest point on: farther away other equations fail as well, and may come first.
    for part in NEAR:
        dt = part * float(t1 - t)
        found = equation_not_finite(system, inputs, t + dt, np.asarray(x) + dt * slope)
        if found is not None:
            # Values there are zero up to a rounding error: the boundary of the domain.
            which, where = found.part(system), system.plan.locate(int(found.equation.equation[found.row]))
            return (
                f"just beyond, {repr(which) if which else 'a function'} leaves its domain in {where}. Write the "
                "equation so that it has a value there (for instance with Max(…, small) as the argument), or end "
                "the run earlier"
            )
    return ""
