"""A function of arrays that is compiled where values are known, and so are its derivatives and its batches.

Under `jax.grad` and `jax.vmap` outside of jit, JAX would compile the derivative or the batch of a compiled function
with all optimizations. Here both are functions of arrays again, and are compiled as the function itself is. The
derivative in reverse mode is two programs: the values and all that the pullback needs, and the pullback. In forward
mode it is one, and a batch of it for the directions of `jax.jacfwd`. Whatever else is at work (`jax.jit` around, arrays
on several devices, `jax.debug_nans`), JAX transforms the function.
"""

import dataclasses
from collections.abc import Callable, Hashable
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import ShapedArray
from jax.custom_derivatives import SymbolicZero

from ..base.aliases import PyTree
from ..base.private_names import MissingName, clear_jitted, private
from .program import Program
from .staging import is_staged, is_traced, kind, layers, trace_of
from .whole_records import WHOLE, numbered, whole_records

Traceable: TypeAlias = Callable[[list[PyTree]], PyTree]


class Function:
    """A function of arrays of certain shapes that returns any pytree. Each call brings the function: it is traced where
    something of it is not compiled yet, and not held afterwards, with all that it closes over.

    - `name`: what profiles and records show; `why`: what made it necessary.
    - `optimize`: whether it is compiled with all optimizations.
    - `identity`: a digest of what it computes, the same in every process (`cache.py`); None if it has none.
    """

    def __init__(self, name: str, why: str, optimize: bool, identity: str | None = None):
        self.name, self.why, self.optimize, self.identity = name, why, optimize, identity
        self._transformed: Any = None  # for what JAX transforms
        self._held: list[Traceable] = []  # while `_transformed` is called
        self._program: Program | None = None
        self._derived: dict[Hashable, Function] = {}
        self.known = 0  # of `_pushed`: the first so many arrays are not directions
        self.pulls = False  # a part of a derivative in reverse mode: what is derived from it has no identity

    def __call__(self, function: Traceable, arrays: list[Any]) -> PyTree:
        work = _at_work(arrays)
        if not work and _is_plain(arrays):
            if self._program is None:
                placed = list(map(_placed, arrays))
                self._program = Program(function, placed, self.name, self.why, self.optimize, self.identity)
            if self._program.stands_alone:
                return self._program(arrays, function)
        arrays = list(map(_placed, arrays))
        if work == "LinearizeTracer":
            return self._differentiated(function, arrays)
        if work == "JVPTracer":
            return self._pushed(function, arrays)
        if work == "BatchTracer":
            return self._batched(function, arrays)
        return self._by_jax(function, arrays)

    @property
    def text(self) -> str | None:
        """A digest of the program that was compiled; None if there is none."""
        return getattr(self._program, "text", None)

    def _by_jax(self, function: Traceable, arrays: list[Array]) -> PyTree:
        """The outcome of a program that JAX makes, keeps and transforms."""
        if self._transformed is None:

            def run(arrays: list[Array]) -> PyTree:
                return self._held[-1](arrays)

            run.__name__ = run.__qualname__ = self.name
            # The function is looked up when it is traced, so that JAX's cache, which never forgets, holds no function
            # of the user's.
            self._transformed = eqx.filter_jit(run)
        self._held.append(function)
        try:
            return self._transformed(arrays)
        finally:
            self._held.pop()

    def regained(self, function: Traceable) -> Any:
        """The structure of the pullback that belongs to what a program from an earlier process returned.

        **Raises:**

        - `LostStructure` if that program would be another one now.
        """
        outcome = None if self._program is None else self._program.restaged(function)
        if outcome is None:
            raise LostStructure
        structure, fixed, _ = outcome
        return jax.tree.unflatten(structure, fixed)[2].structure.value

    def forget(self) -> None:
        """Lets go of a program from an earlier process: the next call traces it anew."""
        self._program = self.identity = None

    def clear(self) -> None:
        """Frees what was compiled."""
        if self._transformed is not None:
            clear_jitted(self._transformed)
        self._program = None
        for one in self._derived.values():
            one.clear()
        self._derived.clear()

    def _derive(self, key: Hashable, name: str, told: str | None = None) -> "Function":
        """The derivative or batch of this key; in all processes, `told` tells it from others of this function."""
        if key not in self._derived:
            identity = None if told is None or self.identity is None or self.pulls else f"{self.identity} {told}"
            self._derived[key] = Function(name, self.why, self.optimize, identity)
        return self._derived[key]

    def _differentiated(self, function: Traceable, arrays: list[Array]) -> PyTree:
        """The outcome in reverse mode, with respect to the arrays that are traced."""
        chosen = tuple(
            k for k, a in enumerate(arrays) if is_traced(a) and jnp.issubdtype(a.dtype, jnp.inexact)
        )  # fmt: skip
        values = self._derive(("values", chosen), self.name, f"values {chosen}")
        values.pulls = True
        shape: list[PyTree] = []  # what the outcome is, beside its arrays

        def valued(arrays: list[Array]) -> PyTree:
            return _values(function, chosen, arrays)

        @jax.custom_vjp
        def call(*arrays: Array) -> PyTree:
            return values(valued, [*arrays])[0]

        def forward(*given: PyTree) -> PyTree:
            known = [one.value for one in given]
            smooth, rest, pullback = values(valued, known)
            shape[:] = [rest]
            # A program that was recalled may have to be traced again for its pullback, and needs the arguments for
            # that.
            return smooth, (pullback, known if pullback.structure.value is None else [])

        def backward(residuals: tuple["_Pullback", list[Array]], cotangents: list[PyTree]) -> PyTree:
            pullback, known = residuals
            try:
                return pulled_through(pullback, cotangents)
            except LostStructure:
                values.forget()
                return pulled_through(values(valued, known)[2], cotangents)

        def pulled_through(residuals: "_Pullback", cotangents: list[PyTree]) -> PyTree:
            # JAX would make arrays of zeros for what is not read, by a program for each shape.
            read = tuple(not isinstance(c, SymbolicZero) for c in cotangents)
            leaves, structure = residuals.leaves, residuals.structure
            n = len(leaves)
            whole = () if is_traced(leaves) else whole_records(leaves)

            def pulled(arrays: list[Array]) -> list[PyTree]:
                with WHOLE(whole):
                    return pulled_back(arrays)

            def pulled_back(arrays: list[Array]) -> list[PyTree]:
                whole_structure = values.regained(valued) if structure.value is None else structure.value
                pullback = jax.tree.unflatten(whole_structure, arrays[:n])

                def pulled_by(zeros: list[PyTree]) -> list[PyTree]:
                    given = iter(arrays[n:])
                    return list(pullback([next(given) if r else z for r, z in zip(read, zeros, strict=True)]))

                try:
                    return pulled_by([_zero_like(c) for c in cotangents])
                except (TypeError, ValueError):  # JAX 0.10.2 takes a stacked zero of a scan for one of its steps
                    return pulled_by([jnp.zeros(c.shape, c.dtype) for c in cotangents])

            # A pullback may be kept for other processes. What is derived further, from it or from the values, may not.
            values.pulls = False
            transpose = values._derive(
                ("pullback", read, structure, whole), f"gradient of {self.name}", f"pullback {read} {whole}"
            )
            values.pulls = transpose.pulls = True
            found = iter(transpose(pulled, [*leaves, *(c for c, r in zip(cotangents, read, strict=True) if r)]))
            return tuple(next(found) if k in chosen else None for k in range(len(arrays)))

        call.defvjp(forward, backward, symbolic_zeros=True)
        smooth = call(*arrays)
        return _combined(smooth, shape[0])

    def _pushed(self, function: Traceable, arrays: list[Array]) -> PyTree:
        """The outcome in forward mode, with respect to the arrays that are traced."""
        chosen = tuple(k for k, a in enumerate(arrays) if is_traced(a))
        n = len(arrays)

        def along(arrays: list[Array]) -> PyTree:
            """(Values, the outcome without them), their derivatives along the last arrays."""
            split: list[PyTree] = []

            def of(*moved: Array) -> PyTree:
                given = list(arrays[:n])
                for k, value in zip(chosen, moved, strict=True):
                    given[k] = value
                smooth, rest = eqx.partition(function(given), eqx.is_inexact_array)
                others, fixed = eqx.partition(rest, eqx.is_array)
                split[:] = [jax.tree.structure(smooth), fixed]
                return jax.tree.leaves(smooth), others

            smooth, slopes, others = jax.jvp(of, [arrays[k] for k in chosen], arrays[n:], has_aux=True)
            structure, fixed = split
            return (smooth, (_Static(structure), eqx.combine(others, fixed))), slopes

        pushed = self._derive(("tangents", chosen), f"derivative of {self.name}", f"tangents {chosen}")
        pushed.known = n
        rest: list[PyTree] = []

        @jax.custom_jvp
        def call(*moved: Array) -> PyTree:
            raise AssertionError  # JAX calls the rule below

        @call.defjvp
        def _(moved: PyTree, tangents: PyTree) -> PyTree:
            given = list(arrays)
            for k, value in zip(chosen, moved, strict=True):
                given[k] = value
            (smooth, rest[:]), slopes = pushed(along, [*given, *tangents])
            return smooth, slopes

        smooth = call(*(arrays[k] for k in chosen))
        return _combined(smooth, (rest[0], rest[1]))

    def _batched(self, function: Traceable, arrays: list[Any]) -> Any:
        """The outcome under one `jax.vmap` of known values."""
        axes = [getattr(a, "batch_dim", None) for a in arrays]
        values = [[*layers(a)][-1] for a in arrays]
        # The batch is computed at once, outside of JAX's batching. One traced array then stands for its result, which
        # JAX asks for member by member.
        k = next(k for k, axis in enumerate(axes) if axis is not None)
        size = values[k].shape[axes[k]]

        # In `jax.jacfwd`, members differ in their directions alone, and JAX asks for one value of the function.
        alike = 0 < self.known and all(axis is None for axis in axes[: self.known])

        def many(arrays: list[Array]) -> PyTree:
            fixed: list[PyTree] = []

            def one(*arrays: Array) -> PyTree:
                moving, rest = eqx.partition(function([*arrays]), eqx.is_array)
                fixed[:] = [rest]
                return moving

            moving = jax.vmap(one, in_axes=axes, axis_size=size)(*arrays)
            if alike:
                moving = (jax.tree.map(lambda rows: rows[0], moving[0]), moving[1])
            return moving, fixed[0]

        told = f"batch {size} {axes} {self.known}"
        moving, rest = self._derive(("batch", size, tuple(axes)), f"batch of {self.name}", told)(many, values)
        differs = jax.tree.map(lambda rows: True, moving)
        if alike:
            differs = (jax.tree.map(lambda value: False, moving[0]), differs[1])

        @jax.custom_batching.custom_vmap
        def member(_: object) -> PyTree:
            shapes = jax.tree.map(lambda rows, some: rows.shape[some:], moving, differs)
            return jax.tree.map(lambda rows, shape: jnp.zeros(shape, rows.dtype), moving, shapes)

        @member.def_vmap
        def members(size: int, is_batched: PyTree, _: object) -> PyTree:
            return moving, differs

        return eqx.combine(member(arrays[k]), rest)


class LostStructure(Exception):
    """The structure of a pullback is needed, and the program that made its arrays cannot be traced again."""


@dataclasses.dataclass(frozen=True, eq=False)
class _Structure:
    """The structure of a pullback: programs, which are not written to files. There, `value` is None."""

    value: Any = None

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Structure) and self.value == other.value

    def __hash__(self) -> int:
        return hash(self.value)

    def as_data(self) -> "_Structure":
        """What is written of it."""
        return _Structure()


class _Pullback(eqx.Module):
    """The arrays of a pullback, and its structure."""

    leaves: list[PyTree]
    structure: _Structure = eqx.field(static=True)


def _values(function: Callable[[list[PyTree]], PyTree], chosen: tuple[int, ...], arrays: list[Array]) -> PyTree:
    """The inexact arrays of the outcome in a list, the outcome without them, and the pullback."""

    def of(*moved: PyTree) -> PyTree:
        given = list(arrays)
        for k, value in zip(chosen, moved, strict=True):
            given[k] = value
        smooth, rest = eqx.partition(function(given), eqx.is_inexact_array)
        others, fixed = eqx.partition(rest, eqx.is_array)
        shape[:] = [jax.tree.structure(smooth), fixed]
        return jax.tree.leaves(smooth), others

    shape: list[PyTree] = []
    with numbered():
        smooth, pullback, others = jax.vjp(of, *(arrays[k] for k in chosen), has_aux=True)
    structure, fixed = shape
    leaves, of_pullback = jax.tree.flatten(pullback)
    return smooth, (_Static(structure), eqx.combine(others, fixed)), _Pullback(leaves, _Structure(of_pullback))


class _Static(eqx.Module):
    """A structure that passes through compiled programs."""

    structure: Any = eqx.field(static=True)


def _combined(smooth: list[PyTree], rest: tuple[_Static, PyTree]) -> PyTree:
    return eqx.combine(jax.tree.unflatten(rest[0].structure, smooth), rest[1])


_SOMETHING = np.zeros((), bool)


def _at_work(arrays: list[Array]) -> str:
    """The kind of tracer that wraps the others, if these wrap values; "other" if that is not one of two that are
    dealt with, or cannot be told; "" if nothing is traced."""
    if not is_traced(arrays):
        return ""
    if is_staged(arrays):
        return "other"
    chains = [[*layers(a)][:-1] for a in arrays]
    # Whose a tracer is tells its trace, not its class: in a grid by two `jax.vmap`, one array is a batch of the outer
    # one, and another is a batch of the inner one, which are two axes.
    traces = [tuple(map(trace_of, chain)) for chain in chains]
    whole = max(traces, key=len)
    # All others must be wrapped by the same, or by what it wraps.
    if any(trace != whole[len(whole) - len(trace) :] and trace[:1] != whole[:1] for trace in traces):
        return "other"
    deepest = tuple(map(kind, max(chains, key=len)))
    if deepest[0] == "LinearizeTracer" or deepest == ("BatchTracer",):
        return deepest[0]
    # Numbers that are not differentiable have a derivative of a type of its own, which programs do not take.
    if deepest == ("JVPTracer",) and all(jnp.issubdtype(a.dtype, jnp.inexact) for a in arrays if is_traced(a)):
        return deepest[0]
    return "other"


def _placed(array: Any) -> Any:
    """An array of JAX, of its own kind of float."""
    return array if isinstance(array, jax.Array) else jax.device_put(array)


def _is_plain(arrays: list[Array]) -> bool:
    """True if a program may be called as it is: arrays lie on one device, and nothing asks JAX for more checks."""
    config: Any = jax.config
    if config.jax_disable_jit or config.jax_debug_nans or config.jax_debug_infs or config.jax_check_tracer_leaks:
        return False
    if len({d for a in arrays if isinstance(a, jax.Array) for d in a.devices()}) > 1:
        return False
    # Inside another program, what is computed becomes a part of it, also where no argument is traced.
    return not is_staged(jax.device_put(_SOMETHING))


def _zero_like(cotangent: PyTree) -> PyTree:
    """The cotangent of what is not read: not an array of zeros, which would be computed with, and times infinity
    is not a number."""
    try:
        return private("Zero")(ShapedArray(cotangent.shape, cotangent.dtype))
    except MissingName:
        return jnp.zeros(cotangent.shape, cotangent.dtype)
