"""How large a vector field is: whether a solver writes its stages out or loops over them.

Written out, the stages of a small field fuse into few kernels. A large one would be compiled once for each stage, and
the time that XLA takes grows faster than the program.
"""

from collections.abc import Callable
from typing import Any

import jax

from ...base.aliases import PyTree
from ...base.private_names import MissingName, private

LARGE = 400  # operations from which stages are looped over: a pendulum has 150, a double pendulum 1,700


def is_large(function: Callable[..., PyTree], *arguments: PyTree) -> bool:
    """True if the traced function has more than `LARGE` operations."""
    program = jax.make_jaxpr(function)(*arguments)
    try:
        kinds = private("Jaxpr"), private("ClosedJaxpr")
    except MissingName:
        return True  # a loop is never wrong
    return _operations(program.jaxpr, *kinds) > LARGE


def _operations(jaxpr: Any, plain: type, closed: type) -> int:
    """The number of operations in a jaxpr, those of inner programs included; `plain` and `closed` are JAX's two classes
    of them."""
    total = 0
    for equation in jaxpr.eqns:
        leaves = jax.tree.leaves(list(equation.params.values()), is_leaf=lambda v: isinstance(v, plain | closed))
        inside = [leaf.jaxpr if isinstance(leaf, closed) else leaf for leaf in leaves]
        total += 1 + sum(_operations(program, plain, closed) for program in inside if isinstance(program, plain))
    return total
