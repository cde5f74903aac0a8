"""Types by what they mean, shared by the rooms that integrate.

Several are `Any` to a type checker: a time may be a Python float, a NumPy scalar or a traced array, and arguments are
any pytree of the user's. Their names say which of these is meant.
"""

from typing import Any, TypeAlias

Time: TypeAlias = Any  # an instant, or a length of time: a number or an array of shape ()
Times: TypeAlias = Any  # instants: an array of shape (n,), or a list of numbers
State: TypeAlias = Any  # what is integrated: an array of shape (n,), or of a user's equation, any pytree of arrays
Tolerance: TypeAlias = Any  # a number, an array of the state's shape, or a pytree like the state
Args: TypeAlias = Any  # what equations get beside time and state: any pytree; of a compiled system, its `Inputs`
Inputs: TypeAlias = dict[str, Any]  # by name: a constant, a `system.inputs.SampledInput`, or a function of time
Terms: TypeAlias = Any  # a Diffrax term, or one in a direction of time, as Diffrax hands it to a solver
Solver: TypeAlias = Any  # a Diffrax solver, of this package or another one, wrapped or not
Controller: TypeAlias = Any  # a Diffrax step-size controller, wrapped or not
Result: TypeAlias = Any  # a code of `diffrax.RESULTS`, which may be traced
