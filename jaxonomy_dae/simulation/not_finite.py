"""The equation that has no finite value at a point."""

from typing import Any

import numpy as np

from ..aliases import State, Time
from ..lowering.schedule import StepEquation
from ..model.group import Point
from ..model.networks import Networks
from ..system.system import AcausalSystem

SHOWN = 4  # variables with their values in an error
ANY = 0.5  # the value given to the unknown of an equation that is only asked whether it is finite


def equation_not_finite(system: AcausalSystem, inputs: Any, t: Time, x: State) -> str:
    """Names the first equation, in the order of solution, that reads finite values and is not finite itself, with what
    it reads; "" if there is none."""
    plan = system.plan
    every = np.arange(plan.extended.quantities.n)
    found = system.at(t, inputs).quantities(x, every, np.ones(len(every)))
    values = np.append(np.asarray(found, float), 0.0)  # ZERO is −1: the last entry
    finite = np.isfinite(values)
    parameters = np.asarray(system.numbers, float)
    networks = Networks(tuple(system.neural[n] for n in plan.network_names))
    at = Point(np.where(finite, values, ANY), parameters, float(t), networks)
    for step in plan.steps:
        own = np.zeros(len(values), bool)
        own[np.concatenate(step.unknown)] = True
        for equation in step.equations:
            known = (finite | own)[equation.quantity].all(axis=1)
            wrong = ~np.isfinite(equation.residual(at)) & known
            if wrong.any():
                return _text(system, equation, int(np.argmax(wrong)), values, finite, parameters)
    return ""


def _text(system: AcausalSystem, equation: StepEquation, place: int, values, finite, parameters) -> str:
    plan = system.plan
    read = dict.fromkeys(equation.quantity[place].tolist())
    given = {plan.quantity_name[q]: values[q] for q in read if q >= 0 and finite[q]}
    given |= {plan.flat.parameters.names[p]: parameters[p] for p in equation.parameter[place].tolist()}
    shown = ", ".join(f"'{name}' = {value:.6g}" for name, value in list(given.items())[:SHOWN])
    return plan.describe(int(equation.equation[place])) + (f", with {shown}" if shown else "")
