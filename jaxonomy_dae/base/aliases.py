"""Types by what they mean, shared by several rooms.

Some are `Any` to a type checker: a time may be a Python float, a NumPy scalar or a traced array, and no type admits the
operators of all three. Their names say which of these is meant. Nothing is known of the leaves of a pytree.
"""

from typing import Any, TypeAlias

from jaxtyping import PyTree as PyTree

Time: TypeAlias = Any  # an instant, or a length of time: a number or an array of shape ()
Times: TypeAlias = Any  # instants: an array of shape (n,), or a list of numbers
State: TypeAlias = PyTree  # what is integrated: an array of shape (n,), or of a user's equation, any pytree of arrays
Tolerance: TypeAlias = PyTree  # a number, an array of the state's shape, or a pytree like the state
Args: TypeAlias = PyTree  # what equations get beside time and state; of a compiled system, its `Inputs`
Inputs: TypeAlias = dict[str, Any]  # by name: a constant, a `system.inputs.SampledInput`, or a function of time
Terms: TypeAlias = PyTree  # a Diffrax term, or one in a direction of time, as Diffrax hands it to a solver
Solver: TypeAlias = Any  # a Diffrax solver, of this package or another one, wrapped or not
Controller: TypeAlias = Any  # a Diffrax step-size controller, wrapped or not
Result: TypeAlias = Any  # a code of `diffrax.RESULTS`, which may be traced

# SymPy declares its parts too widely to be checked: an `Eq` may be an Integer, and what stands in an expression or in a
# condition is a `Basic`, which has no arithmetic and which `And`, `Or` and `Not` do not take.
Condition: TypeAlias = Any  # true, false, a relation, or relations in `And`, `Or` and `Not`
Expression: TypeAlias = Any  # a `sympy.Expr` that was part of another one

# What kernels compute with: floats, NumPy's arrays or JAX's. No type has the operators of all three.
Numeric: TypeAlias = Any
