"""A function of time as a program and the numbers it reads.

Given any Python function of a scalar time, `closed_function` traces it and returns a callable pytree: its leaves are
all arrays and numbers the function read from its surroundings (globals, attributes, closures), its static part is the
program alone. So a function whose surroundings changed is a new function, and two functions of the same form share one
compiled program, whatever their numbers are.
"""

import dataclasses
from collections.abc import Callable, Hashable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from ..private_names import private


@dataclasses.dataclass(frozen=True)
class _TracedFunction:
    """A traced function without its numbers, compared by what it computes."""

    jaxpr: Any = dataclasses.field(compare=False)
    key: Hashable
    hashed: int

    def __hash__(self):
        return self.hashed


class ClosedFunction(eqx.Module):
    """A function of time that closes over nothing: `program` reads `constants`, the numbers written in it included."""

    constants: list[Any]
    program: _TracedFunction = eqx.field(static=True)

    def __call__(self, t: Any) -> Any:
        jaxpr = self.program.jaxpr
        time = jnp.asarray(t, jaxpr.invars[0].aval.dtype)  # pyright: ignore[reportAttributeAccessIssue]
        return private("jaxpr_as_fun")(private("ClosedJaxpr")(jaxpr, self.constants))(time)[0]


def closed_function(function: Callable[[Any], Any], dtype: Any) -> ClosedFunction:
    """Traces a function of a scalar time of the given dtype; what it returns must be one array."""
    closed = jax.make_jaxpr(function)(jax.ShapeDtypeStruct((), dtype))
    jaxpr, numbers = _with_numbers_lifted(closed.jaxpr)
    key = _key_of_jaxpr(jaxpr)
    return ClosedFunction([_own(c) for c in (*closed.consts, *numbers)], _TracedFunction(jaxpr, key, hash(key)))


def _with_numbers_lifted(jaxpr: Any) -> tuple[Any, list[Any]]:
    """The numbers written in a program become constants, so that other numbers are not another program."""
    literal = private("Literal")
    atoms = [atom for equation in jaxpr.eqns for atom in equation.invars] + list(jaxpr.outvars)
    lifted = [atom for atom in atoms if isinstance(atom, literal) and _is_data(atom)]
    if not lifted:
        return jaxpr, []
    structs = [jax.ShapeDtypeStruct(atom.aval.shape, atom.aval.dtype) for atom in lifted]  # pyright: ignore
    fresh = jax.make_jaxpr(lambda *values: values)(*structs).jaxpr.invars
    name = {id(atom): variable for atom, variable in zip(lifted, fresh, strict=True)}

    def renamed(atoms: Any) -> list[Any]:
        return [name.get(id(atom), atom) for atom in atoms]

    equations = [equation.replace(invars=renamed(equation.invars)) for equation in jaxpr.eqns]
    changed = jaxpr.replace(
        constvars=[*jaxpr.constvars, *fresh], eqns=equations, outvars=renamed(jaxpr.outvars)
    )  # fmt: skip
    return changed, [np.asarray(atom.val, atom.aval.dtype) for atom in lifted]  # pyright: ignore


def _own(value: Any) -> Any:
    """A copy: NumPy arrays may be written to later, and JAX may share their memory."""
    return value if isinstance(value, Tracer) else jnp.array(value, copy=True)


def _is_data(literal: Any) -> bool:
    """True if a literal is data rather than part of the program, as indices are."""
    return jnp.issubdtype(literal.aval.dtype, jnp.inexact) or bool(np.shape(literal.val))


def _key_of_jaxpr(jaxpr: Any) -> Hashable:
    """A hashable value that two jaxprs share only if they compute the same from the same constants."""
    number: dict[Any, int] = {}
    literal = private("Literal")

    def atom(a: Any) -> Hashable:
        if isinstance(a, literal):
            return "literal", _key(a.val), a.aval.str_short()
        return number.setdefault(a, len(number))

    head = tuple((atom(v), v.aval.str_short()) for v in (*jaxpr.constvars, *jaxpr.invars))
    body = tuple(
        (
            equation.primitive,
            tuple(atom(a) for a in equation.invars),
            tuple((atom(v), v.aval.str_short()) for v in equation.outvars),
            tuple((name, _key(value)) for name, value in sorted(equation.params.items())),
        )
        for equation in jaxpr.eqns
    )
    return head, body, tuple(atom(v) for v in jaxpr.outvars)


def _key(value: Any) -> Hashable:
    if isinstance(value, private("ClosedJaxpr")):
        return _key_of_jaxpr(value.jaxpr), tuple(_key(c) for c in value.consts)
    if isinstance(value, private("Jaxpr")):
        return _key_of_jaxpr(value)
    if isinstance(value, tuple | list):
        return type(value).__name__, tuple(_key(v) for v in value)
    if isinstance(value, dict):
        return tuple((k, _key(v)) for k, v in sorted(value.items()))
    if isinstance(value, Tracer):
        return _Same(value)
    if isinstance(value, np.ndarray | np.generic | jax.Array) or hasattr(value, "__array__"):
        array = np.asarray(value)
        return array.shape, str(array.dtype), array.tobytes()
    try:
        hash(value)
    except TypeError:
        return _Same(value)
    return type(value), value


class _Same:
    """Wraps an object so that it is compared by identity, and kept alive while it is compared."""

    def __init__(self, value: Any):
        self.value = value

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and self.value is other.value

    def __hash__(self) -> int:
        return id(self.value)
