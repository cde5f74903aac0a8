"""A function of time as a program and the numbers it reads.

Given any Python function of a scalar time, `closed_function` traces it and returns a callable pytree: its leaves are
all arrays and numbers the function read from its surroundings (globals, attributes, closures), its static part is the
program alone. So a function whose surroundings changed is a new function, and two functions of the same form share one
compiled program, whatever their numbers are.
"""

import dataclasses
import functools
import weakref
from collections.abc import Callable, Hashable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ...base.private_names import private
from ...host.content import Content, Hidden, content
from ...host.libraries import Owner, owner
from ...host.staging import is_traced

# Parameters of JAX's calls of functions with rules of their own for derivatives that hold the rules.
RULES = ("jvp_jaxpr_fun", "fwd_jaxpr_thunk", "bwd", "out_trees")


class _Program:
    """What a jaxpr computes: one object for all jaxprs that compute the same."""

    def __init__(self, key: Hashable):
        self._key = key

    @functools.cached_property
    def _content(self) -> Content:
        return content(self._key)

    def __content__(self) -> tuple[str, tuple]:
        """For `host/content.py`."""
        return self._content.digest, tuple(map(Hidden, self._content.unseen))


# All programs, by what they are made of. Parts of a key are programs of their own, so that keys stay flat: the rules
# for derivatives of a user's checks contain each other, and as nested tuples they were too deep to be compared.
_PROGRAMS: weakref.WeakValueDictionary[Hashable, _Program] = weakref.WeakValueDictionary()


def _program(key: Hashable) -> _Program:
    try:
        return _PROGRAMS.setdefault(key, _Program(key))
    except ValueError:  # of a comparison of arrays somewhere in parameters of users: nothing equals it
        return _Program(key)


@dataclasses.dataclass(frozen=True)
class _TracedFunction:
    """A traced function without its numbers, compared by what it computes."""

    jaxpr: Any = dataclasses.field(compare=False)
    program: _Program

    def __content__(self) -> tuple[str, tuple]:
        """For `host/content.py`."""
        return "", (self.program,)


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
    constants = [_own(c) for c in (*closed.consts, *numbers)]
    return ClosedFunction(constants, _TracedFunction(jaxpr, _program_of(jaxpr)))


def _with_numbers_lifted(jaxpr: Any) -> tuple[Any, list[Any]]:
    """The numbers written in a program become constants, so that other numbers are not another program."""
    literal = private("Literal")
    # Only numbers at the top level are lifted. Those inside loops and inner functions stay part of the program, so
    # another number there is compiled anew.
    atoms = [atom for equation in jaxpr.eqns for atom in equation.invars] + list(jaxpr.outvars)
    lifted = [atom for atom in atoms if isinstance(atom, literal) and _is_data(atom)]
    if not lifted:
        return jaxpr, []
    structs = [jax.ShapeDtypeStruct(atom.aval.shape, atom.aval.dtype) for atom in lifted]  # pyright: ignore
    # JAX has no public way to make a variable of a jaxpr. Tracing the identity makes some.
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
    return value if is_traced(value) else jnp.array(value, copy=True)


def _is_data(literal: Any) -> bool:
    """True if a literal is data rather than part of the program, as indices are."""
    return jnp.issubdtype(literal.aval.dtype, jnp.inexact) or bool(np.shape(literal.val))


def _program_of(jaxpr: Any, inside: tuple[Hashable, ...] = ()) -> _Program:
    """The object that two jaxprs share only if they compute the same from the same constants, derivatives included.
    `inside` are the functions with rules of their own for derivatives in whose rules the jaxpr stands."""
    number: dict[Any, int] = {}
    literal = private("Literal")

    def atom(a: Any) -> Hashable:
        if isinstance(a, literal):
            return "literal", _key(a.val), a.aval.str_short()
        return number.setdefault(a, len(number))

    head = tuple((atom(v), v.aval.str_short()) for v in (*jaxpr.constvars, *jaxpr.invars))
    body = tuple(
        (
            _Primitive(equation.primitive),
            tuple(atom(a) for a in equation.invars),
            tuple((atom(v), v.aval.str_short()) for v in equation.outvars),
            tuple((name, _key(value, inside)) for name, value in sorted(equation.params.items()) if name not in RULES),
            _key_of_rules(equation, inside),
        )
        for equation in jaxpr.eqns
    )
    return _program((head, body, tuple(atom(v) for v in jaxpr.outvars)))


def _key_of_rules(equation: Any, inside: tuple[Hashable, ...]) -> Hashable:
    """The derivatives of a function that has rules of its own, such as `jax.nn.relu`, by what the rules compute.

    JAX holds the rules as functions made anew whenever the function is traced, so that they tell nothing themselves.
    Rules that cannot be traced by themselves are compared as objects.
    """
    rules = {name: equation.params[name] for name in RULES if name in equation.params}
    if not rules:
        return None
    own = _key(equation.params["call_jaxpr"], inside)
    if inside.count(own) > 1:
        return "again"  # the rule of relu calls relu
    inside = (*inside, own)
    nonzero = [False] * len(equation.invars)
    try:
        if "jvp_jaxpr_fun" in rules:
            jaxpr, constants, zeros = rules["jvp_jaxpr_fun"].call_wrapped(*nonzero)
            return _program_of(jaxpr, inside), _key(constants), tuple(zeros)
        forwards, constants = rules["fwd_jaxpr_thunk"].call_wrapped(*nonzero)
        computed = iter(forwards.outvars)  # what is kept for the way back, but for arguments that are kept as they are
        kept = [next(computed) if k is None else equation.invars[k] for k in rules["out_trees"]()[2]]
        given = [jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in (*kept, *equation.outvars)]
        backwards = jax.make_jaxpr(lambda *values: rules["bwd"].call_wrapped(*values))(*given)
        return _program_of(forwards, inside), _key(constants), _key(backwards, inside)
    except Exception:  # JAX promises nothing of how it holds them
        return tuple((name, _Same(rule)) for name, rule in rules.items())


def _key(value: Any, inside: tuple[Hashable, ...] = ()) -> Hashable:
    if isinstance(value, private("ClosedJaxpr")):
        return _program_of(value.jaxpr, inside), tuple(_key(c) for c in value.consts)
    if isinstance(value, private("Jaxpr")):
        return _program_of(value, inside)
    if isinstance(value, tuple | list):
        return type(value).__name__, tuple(_key(v, inside) for v in value)
    if isinstance(value, dict):
        return tuple((k, _key(v, inside)) for k, v in sorted(value.items()))
    if is_traced(value):
        return _Same(value)
    if isinstance(value, np.ndarray | np.generic | jax.Array) or hasattr(value, "__array__"):
        array = np.asarray(value)
        return array.shape, str(array.dtype), array.tobytes()
    try:
        hash(value)
    except TypeError:
        return _Same(value)
    # With the type, because 1, 1.0 and True are equal in Python, and are different parameters of a primitive.
    return type(value), value


@dataclasses.dataclass(frozen=True)
class _Primitive:
    """A primitive of JAX's, which has one object for each, or of the user's, compared as an object."""

    primitive: Any

    def __content__(self) -> tuple[str, tuple]:
        """For `host/content.py`."""
        kind = type(self.primitive)
        is_own = owner(getattr(getattr(self.primitive, "impl", None), "__module__", kind.__module__)) is Owner.KNOWN
        return str(self.primitive), () if is_own else (Hidden(f"the primitive {self.primitive}"),)


class _Same:
    """Wraps an object so that it is compared by identity, and kept alive while it is compared."""

    def __init__(self, value: Any):
        self.value = value

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and self.value is other.value

    def __hash__(self) -> int:
        return id(self.value)

    def __content__(self) -> tuple[str, tuple]:
        """For `host/content.py`."""
        return "", (self.value,)
