"""How large a vector field is: whether a solver writes its stages out or loops over them.

Written out, the stages of a small field fuse into few kernels. A large one would be compiled once for each stage, and
the time that XLA takes grows faster than the program.
"""

from collections.abc import Callable
from typing import Any

import jax
from jax.extend import core

LARGE = 400  # operations from which stages are looped over: a pendulum has 150, a double pendulum 1,700


def is_large(function: Callable[..., Any], *arguments: Any) -> bool:
    """Whether the traced function has many operations."""
    return _operations(jax.make_jaxpr(function)(*arguments).jaxpr) > LARGE


def _operations(jaxpr: core.Jaxpr) -> int:
    return sum(1 + sum(map(_operations, _inside(equation.params))) for equation in jaxpr.eqns)


def _inside(params: dict[str, Any]) -> list[core.Jaxpr]:
    leaves = jax.tree.leaves(list(params.values()), is_leaf=lambda v: isinstance(v, core.Jaxpr | core.ClosedJaxpr))
    found = [v.jaxpr if isinstance(v, core.ClosedJaxpr) else v for v in leaves]
    return [v for v in found if isinstance(v, core.Jaxpr)]
