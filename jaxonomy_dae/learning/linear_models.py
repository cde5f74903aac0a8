"""Whether a model is linear with constant coefficients, whatever its parameters: its flow is then a matrix exponential.

Slopes f(t, x, u) are traced, and so are their Jacobians by states and inputs. The model counts as linear if nothing
that these Jacobians compute leads from t, x or u to them, and nothing that slopes compute leads from t.
"""

from collections.abc import Callable
from typing import Any

import jax

from ..system.system import AcausalSystem


def is_linear(system: AcausalSystem) -> bool:
    """True if slopes are A x + B u + c. Models with events, hidden constraints or nonlinear blocks are not examined:
    False."""
    plan, dtype = system.plan, system.parameters.values.dtype
    if plan.events is not None or plan.n_projected or len(plan.carried):
        return False
    names = plan.inputs.names
    t, x, u = (jax.ShapeDtypeStruct(shape, dtype) for shape in ((), (plan.n_state,), (len(names),)))

    def slopes(t, x, u):
        return system.at(t, dict(zip(names, u, strict=True))).semi_explicit(x)

    def jacobians(t, x, u):
        return jax.jacfwd(slopes, argnums=(1, 2) if names else (1,))(t, x, u)

    return not _reaches(slopes, (t, x, u))[0] and not any(_reaches(jacobians, (t, x, u)))


def _reaches(function: Callable, arguments: tuple[Any, ...]) -> list[bool]:
    """True for the arguments on which the result may depend: those from which operations lead to it. All inputs of an
    operation with inner programs count as used."""
    jaxpr = jax.make_jaxpr(function)(*arguments).jaxpr
    needed = {id(v) for v in jaxpr.outvars}
    for equation in reversed(jaxpr.eqns):
        if any(id(v) in needed for v in equation.outvars):
            needed |= {id(v) for v in equation.invars}
    return [id(v) in needed for v in jaxpr.invars]
