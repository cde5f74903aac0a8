"""Programs of JAX as one list of operations: calls of small functions are put in place, known integers are computed,
what is computed twice is computed once, and what nobody reads is left out.

JAX traces a model's functions without looking for what they have in common: the field and the outputs each complete the
parameters, solve the same blocks and work out the same places for gathers. XLA finds that in its own passes. Compilers
of C do not, where arrays are written in loops.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from ..base.errors import ModelError

TABLE = 512  # entries: a known array of integers up to this size is a table where it is read, a longer one is computed
SMALL = 12  # operations: a function of so few is written where it is called, a larger one is a function in C, too

# Primitives that only call a function, by the name of the parameter that holds it.
CALLS = {
    "jit": "jaxpr", "pjit": "jaxpr", "closed_call": "call_jaxpr", "core_call": "call_jaxpr", "remat": "jaxpr",
    "checkpoint": "jaxpr", "custom_jvp_call": "call_jaxpr", "custom_vjp_call": "call_jaxpr",
    "custom_vjp_call_jaxpr": "fun_jaxpr", "custom_vmap_call": "call",
}  # fmt: skip
WHOLE = {"unvmap_any": "reduce_or", "unvmap_all": "reduce_and", "unvmap_max": "reduce_max"}
# Operations on known values that are done at once: they compute the places that gathers read, and arrays of zeros and
# ones. All of them have one result in floating-point numbers, on every machine.
FOLDED = {
    "iota", "lt", "le", "gt", "ge", "eq", "ne", "add", "sub", "mul", "neg", "select_n", "convert_element_type", "clamp",
    "broadcast_in_dim", "reshape", "squeeze", "concatenate", "slice", "stack", "split", "transpose", "min", "max",
    "and", "or", "not", "gather",
}  # fmt: skip
LARGEST = 100_000  # entries: longer arrays are not computed beforehand
PLACES = {"gather", "scatter", "scatter-add", "scatter_add", "scatter-mul", "scatter-min", "scatter-max"}
# Primitives of one array that may leave all of its entries in their order: those that add an axis of length one do.
MOVED = {"broadcast_in_dim", "transpose", "concatenate", "slice", "split"}
# Primitives that return what they are given.
SAME = {"optimization_barrier", "stop_gradient", "copy", "name", "device_put", "sharding_constraint"}


def _broadcast(params: Mapping[str, Any], x: np.ndarray) -> np.ndarray:
    own = [1] * len(params["shape"])
    for d, n in zip(params["broadcast_dimensions"], x.shape, strict=True):
        own[d] = n
    return np.broadcast_to(x.reshape(own), params["shape"])


def _iota(params: Mapping[str, Any]) -> np.ndarray:
    along = [1] * len(params["shape"])
    along[params["dimension"]] = -1
    return np.broadcast_to(np.arange(params["shape"][params["dimension"]]).reshape(along), params["shape"])


def _selected(params: Mapping[str, Any], which: np.ndarray, *cases: np.ndarray) -> np.ndarray:
    return np.choose(which.astype(np.int64), cases)


# Operations of `FOLDED` that NumPy does alike.
_NUMPY: Mapping[str, Callable[..., np.ndarray]] = {
    "add": lambda _, a, b: a + b, "sub": lambda _, a, b: a - b, "mul": lambda _, a, b: a * b, "neg": lambda _, a: -a,
    "lt": lambda _, a, b: a < b, "le": lambda _, a, b: a <= b, "gt": lambda _, a, b: a > b,
    "ge": lambda _, a, b: a >= b, "eq": lambda _, a, b: a == b, "ne": lambda _, a, b: a != b,
    "broadcast_in_dim": _broadcast, "iota": _iota, "select_n": _selected,
    "reshape": lambda params, a: a.reshape(params["new_sizes"]),
    "squeeze": lambda params, a: np.squeeze(a, tuple(params["dimensions"])),
    "concatenate": lambda params, *parts: np.concatenate(parts, params["dimension"]),
    "transpose": lambda params, a: np.transpose(a, params["permutation"]),
}  # fmt: skip


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
        self.values: dict[int, np.ndarray] = {}  # those that are known
        self.done: dict[Any, tuple[int, ...]] = {}  # the results of operations, by what they do

    def new(self, aval: Any) -> int:
        self.kinds.append(Kind.of(aval))
        return len(self.kinds) - 1

    def read(self, program: Any, values: Sequence[np.ndarray | None]) -> Straight:
        arguments = tuple(self.new(v.aval) for v in (*program.constvars, *program.invars))
        self.values.update({a: v for a, v in zip(arguments, values, strict=False) if v is not None})
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
            if name in MOVED and self._is_same(equation, results):
                name = "reshape"
            operation = Operation(
                name, params, self._known(name, read), results, equation.source_info, equation.primitive
            )
            key = _key(operation)
            if key is not None:
                results = self.done.setdefault(key, results)
            if results is operation.results:
                self.operations.append(operation)
            at.update(zip(equation.outvars, results, strict=True))
        return tuple(map(atom, program.outvars))

    def _is_same(self, equation: Any, results: Sequence[int]) -> bool:
        """True if the result has the entries that are read, in their order."""
        if len(equation.invars) != 1 or len(results) != 1 or not hasattr(equation.invars[0], "aval"):
            return False
        own, new, params = equation.invars[0].aval.shape, self.kinds[results[0]].shape, equation.params
        if equation.primitive.name == "transpose":
            long = [d for d in params["permutation"] if own[d] != 1]
            return long == sorted(long)
        return int(np.prod(own)) == int(np.prod(new)) and not any(step != 1 for step in params.get("strides") or ())

    def _known(self, name: str, read: Sequence[Atom]) -> tuple[Atom, ...]:
        """What an operation reads, with the values that are known. Long ones stay as they are computed, so that code
        does not grow with arrays; the places of gathers are tables in any case, and equal numbers need none."""
        out = list(read)
        for k, atom in enumerate(read):
            value = self.values.get(atom) if isinstance(atom, int) else None
            if value is not None and (value.size <= TABLE or (k == 1 and name in PLACES) or is_uniform(value)):
                out[k] = Constant(value)
        return tuple(out)

    def _fold(self, equation: Any, read: Sequence[Atom], results: Sequence[int]) -> None:
        """Notes the values of results that follow from known ones."""
        if any(
            getattr(self.kinds[r].dtype, "kind", "V") not in "iubf" or self.kinds[r].size > LARGEST for r in results
        ):
            return
        values = [a.value if isinstance(a, Constant) else self.values.get(a) for a in read]
        if any(v is None for v in values):
            return
        by_numpy = _NUMPY.get(equation.primitive.name)
        if by_numpy is not None:  # JAX would compile each of them for each shape
            with np.errstate(all="ignore"):
                all_found = [by_numpy(equation.params, *values)]
        else:
            with jax.ensure_compile_time_eval():
                found = equation.primitive.bind(*map(jnp.asarray, values), **equation.params)
            all_found = found if equation.primitive.multiple_results else [found]
        for result, value in zip(results, all_found, strict=True):
            self.values[result] = np.asarray(value, self.kinds[result].dtype)


def _key(operation: Operation) -> Any:
    """What an operation computes: equal keys, equal results. None if it cannot be said."""
    params = operation.params
    if operation.primitive in CALLS:  # its rules for derivatives, other objects each time, do not matter any more
        name = CALLS[operation.primitive]
        params = {name: params[name]}
    # By type and text, too, since 0 == 0.0 == -0.0 == False.
    told = tuple((k, type(v), str(v) if isinstance(v, float) else v) for k, v in sorted(params.items()))
    read = tuple(
        (a.value.dtype, a.value.shape, a.value.tobytes()) if isinstance(a, Constant) else a for a in operation.given
    )
    key = operation.primitive, told, read
    try:
        hash(key)
    except TypeError:
        return None
    return key


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


def is_uniform(value: np.ndarray) -> bool:
    """True if there are entries, and all of them are one number, bit for bit."""
    first = value.ravel()[:1].tobytes()
    return value.size > 0 and value.tobytes() == first * value.size


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


def where_written(operation: Operation) -> str:
    """The line of a user's code that an operation comes from: the innermost one outside of JAX and of this package."""
    traceback = getattr(operation.source, "traceback", None)
    for frame in getattr(traceback, "frames", ()):
        file = frame.file_name.replace("\\", "/")
        if "/site-packages/" not in file and "/jaxonomy_dae/" not in file and not file.startswith("<"):
            return f" ({file}:{frame.line_num}, in {frame.function_name})"
    return ""
