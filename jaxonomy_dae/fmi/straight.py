"""Programs of JAX as one list of operations: calls of small functions are put in place, and what nobody reads is left
out."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from ..base.errors import ModelError

SMALL = 12  # operations: a function of so few is written where it is called, a larger one is a function in C, too

# Primitives that only call a function, by the name of the parameter that holds it.
CALLS = {
    "jit": "jaxpr", "pjit": "jaxpr", "closed_call": "call_jaxpr", "core_call": "call_jaxpr", "remat": "jaxpr",
    "checkpoint": "jaxpr", "custom_jvp_call": "call_jaxpr", "custom_vjp_call": "call_jaxpr",
    "custom_vjp_call_jaxpr": "fun_jaxpr", "custom_vmap_call": "call",
}  # fmt: skip
WHOLE = {"unvmap_any": "reduce_or", "unvmap_all": "reduce_and", "unvmap_max": "reduce_max"}
# Operations on known integers that are done at once: they compute the places that gathers read.
FOLDED = {
    "iota", "lt", "le", "gt", "ge", "eq", "ne", "add", "sub", "mul", "select_n", "convert_element_type", "clamp",
    "broadcast_in_dim", "reshape", "squeeze", "concatenate", "slice", "stack", "split", "transpose", "min", "max",
    "and", "or", "not", "gather",
}  # fmt: skip
PLACES = {"gather", "scatter", "scatter-add", "scatter_add", "scatter-mul", "scatter-min", "scatter-max"}
# Primitives that return what they are given.
SAME = {"optimization_barrier", "stop_gradient", "copy", "name", "device_put", "sharding_constraint"}


@dataclasses.dataclass(frozen=True)
class Kind:
    """The shape and the type of a value."""

    shape: tuple[int, ...]
    dtype: Any

    @property
    def size(self) -> int:
        return int(np.prod(self.shape, dtype=np.int64))

    @classmethod
    def of(cls, aval: Any) -> "Kind":
        return cls(tuple(aval.shape), aval.dtype)


@dataclasses.dataclass(frozen=True)
class Constant:
    """A number or an array that is known."""

    value: np.ndarray


Atom = int | Constant  # a value by its number, or a known one


@dataclasses.dataclass(frozen=True)
class Operation:
    """One operation: its primitive's name and parameters, what it reads, the numbers of what it computes, and where it
    comes from."""

    primitive: str
    params: Mapping[str, Any]
    given: tuple[Atom, ...]
    results: tuple[int, ...]
    source: Any
    source_primitive: Any  # as JAX has it


@dataclasses.dataclass(frozen=True)
class Straight:
    """A function as a list of operations on numbered values; `kinds` has an entry for each value."""

    arguments: tuple[int, ...]
    operations: tuple[Operation, ...]
    results: tuple[Atom, ...]
    kinds: Sequence[Kind]

    def kind(self, atom: Atom) -> Kind:
        if isinstance(atom, Constant):
            return Kind(atom.value.shape, atom.value.dtype)
        return self.kinds[atom]


def function_of(operation: Operation) -> tuple[Any, Sequence[Any]]:
    """The program that an operation calls, and the values that it closes over."""
    return open_program(operation.params[CALLS[operation.primitive]])


def open_program(program: Any) -> tuple[Any, Sequence[Any]]:
    """A program without the values that it closes over, and these."""
    return (program.jaxpr, program.consts) if hasattr(program, "consts") else (program, ())


def straight(program: Any, values: Sequence[np.ndarray | None] = ()) -> Straight:
    """The operations of a program (`jax.core.Jaxpr`); its closed-over values are its first arguments. `values` has the
    first arguments, as far as they are known."""
    return _Reader().read(program, values)


class _Reader:
    """Numbers the values of a program."""

    def __init__(self):
        self.kinds: list[Kind] = []
        self.operations: list[Operation] = []
        self.integers: dict[int, np.ndarray] = {}  # values that are known

    def new(self, aval: Any) -> int:
        self.kinds.append(Kind.of(aval))
        return len(self.kinds) - 1

    def read(self, program: Any, values: Sequence[np.ndarray | None]) -> Straight:
        arguments = tuple(self.new(v.aval) for v in (*program.constvars, *program.invars))
        known_ones = zip(arguments, values, strict=False)
        self.integers.update({a: v for a, v in known_ones if v is not None and v.dtype.kind in "iub"})
        results = self.inside(program, arguments)
        return Straight(arguments, _needed(self.operations, results), results, self.kinds)

    def inside(self, program: Any, given: Sequence[Atom]) -> tuple[Atom, ...]:
        """Reads a program's operations, given the values of its closed-over values and arguments."""
        at: dict[Any, Atom] = dict(zip((*program.constvars, *program.invars), given, strict=True))

        def atom(v: Any) -> Atom:
            return Constant(np.asarray(v.val, v.aval.dtype)) if hasattr(v, "val") else at[v]

        for equation in program.eqns:
            name, read = equation.primitive.name, tuple(map(atom, equation.invars))
            params = equation.params
            if name == "custom_linear_solve":
                name, params, read = _solve_alone(params, read)
            if name in SAME:
                at.update(zip(equation.outvars, read, strict=True))
                continue
            if name in CALLS:
                inner, closed = open_program(params[CALLS[name]])
                if len(inner.eqns) <= SMALL:
                    results = self.inside(inner, (*map(known, closed), *read))
                    at.update(zip(equation.outvars, results, strict=True))
                    continue
            if name == "platform_index":  # C runs on the processor
                at[equation.outvars[0]] = Constant(np.asarray(_of_processor(params["platforms"]), np.int32))
                continue
            if name == "cond" and isinstance(read[0], Constant):
                branches = params["branches"]
                chosen = branches[min(max(int(read[0].value), 0), len(branches) - 1)]
                results = self.inside(chosen.jaxpr, (*map(known, chosen.consts), *read[1:]))
                at.update(zip(equation.outvars, results, strict=True))
                continue
            if name in WHOLE:  # of Equinox: without `vmap`, a reduction of all entries
                name, params = WHOLE[name], {"axes": tuple(range(len(equation.invars[0].aval.shape)))}
            results = tuple(self.new(v.aval) for v in equation.outvars)
            if name in FOLDED:
                self._fold(equation, read, results)
            if name in PLACES and isinstance(read[1], int) and read[1] in self.integers:
                read = (read[0], Constant(self.integers[read[1]]), *read[2:])
            self.operations.append(Operation(name, params, read, results, equation.source_info, equation.primitive))
            at.update(zip(equation.outvars, results, strict=True))
        return tuple(map(atom, program.outvars))

    def _fold(self, equation: Any, read: Sequence[Atom], results: Sequence[int]) -> None:
        """Notes the values of results that follow from known integers."""
        if any(getattr(self.kinds[r].dtype, "kind", "V") not in "iub" for r in results):
            return
        values = [a.value if isinstance(a, Constant) else self.integers.get(a) for a in read]
        if any(v is None for v in values):
            return
        with jax.ensure_compile_time_eval():
            found = equation.primitive.bind(*map(jnp.asarray, values), **equation.params)
        all_found = found if equation.primitive.multiple_results else [found]
        self.integers.update(zip(results, map(np.asarray, all_found), strict=True))


def _of_processor(platforms: Sequence[Sequence[str] | None]) -> int:
    """Which of the branches for platforms is that of the processor; the one for all others if none is."""
    own = [k for k, names in enumerate(platforms) if names is not None and "cpu" in names]
    return own[0] if own else list(platforms).index(None)


def _solve_alone(params: Mapping[str, Any], read: tuple[Atom, ...]) -> tuple[str, Mapping[str, Any], tuple[Atom, ...]]:
    """The call that solves, taken out of a linear solve with its products and its transpose."""
    lengths = params["const_lengths"]
    begin = lengths.matvec + lengths.vecmat
    end = begin + lengths.solve
    return (
        "closed_call",
        {"call_jaxpr": params["jaxprs"].solve},
        (*read[begin:end], *read[end + lengths.transpose_solve :]),
    )


def known(value: Any) -> Constant:
    """A value that a program closes over.

    **Raises:**

    - `ModelError` for one that is being traced.
    """
    if isinstance(value, Tracer):
        raise ModelError("code is written for a function that is not inside jit, grad or vmap")
    return Constant(np.asarray(value))


def _needed(operations: Sequence[Operation], results: Sequence[Atom]) -> tuple[Operation, ...]:
    """The operations that results depend on."""
    needed = {a for a in results if isinstance(a, int)}
    kept = []
    for operation in reversed(operations):
        if needed.isdisjoint(operation.results):
            continue
        kept.append(operation)
        needed.update(a for a in operation.given if isinstance(a, int))
    return tuple(reversed(kept))
