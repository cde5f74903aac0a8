"""Functions that SymPy never sees: networks, tables, any JAX function, in equations y − N(u) = 0."""

import abc
import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ...base.aliases import PyTree
from ...host.cache import compiled
from .template import AbstractTemplate, Slot


class AbstractReplacement(eqx.Module):
    """A law in the place of a network, `law(u) -> (outputs,)`: it is called itself, also where a plain function of
    weights stood."""

    @abc.abstractmethod
    def __call__(self, u: Array) -> Array:
        """The law at its inputs, those that are time included."""


class OpaqueFunction:
    """A network in the equations: which weights it reads, and how it is called.

    `index` is the position of the weights in the compiled system's networks; `function` is None for a callable pytree
    (the weights are called), else a plain `function(t, u, theta)`. `time_positions` are the entries of u that are time.
    """

    def __init__(self, index: int, name: str, function: Callable | None, n_inputs: int, time_positions: frozenset[int]):
        self.index = index
        self.name = name
        self.function = function
        self.n_inputs = n_inputs
        self.time_positions = time_positions

    def __call__(self, weights: PyTree, t, u):
        """The outputs, in the dtype of `u`; the weights are used in their own."""
        dtypes = [leaf.dtype for leaf in jax.tree.leaves(weights) if hasattr(leaf, "dtype")]
        # The inputs are cast, not the weights: a network of single precision computes in it inside any model.
        floating = [d for d in dtypes if jnp.issubdtype(d, jnp.floating)]
        dtype = floating[0] if floating else u.dtype
        inside = u.astype(dtype)
        if self.function is None or isinstance(weights, AbstractReplacement):
            out = weights(inside)
        else:
            out = self.function(jnp.asarray(t, dtype), inside, weights)
        return out.astype(u.dtype)

    def derivatives(self, weights, order: int, t, inputs: list[list]):
        """The `order`-th time derivative of the outputs; inputs[k] lists the non-time inputs' k-th derivatives."""

        # Nested forward derivatives work for any function of JAX, and the orders are low.
        def level(k: int):
            if k == 0:
                return lambda time, u: self(weights, time[0], u[0])
            below = level(k - 1)

            def function(time, u):
                return jax.jvp(below, (time[:k], u[:k]), (time[1 : k + 1], u[1 : k + 1]))[1]

            return function

        shape = jnp.broadcast_shapes(*(jnp.shape(e) for entries in inputs for e in entries))
        if shape:  # over instances
            spread = [[jnp.broadcast_to(jnp.asarray(e, t.dtype), shape) for e in entries] for entries in inputs]
            return jax.vmap(lambda inner: self.derivatives(weights, order, t, inner), out_axes=-1)(spread)
        zero, one = jnp.zeros_like(t), jnp.ones_like(t)
        time = [t, one, *[zero] * order][: order + 1]
        us = []
        for k in range(order + 1):
            source = iter(inputs[k])
            entries = [time[k] if j in self.time_positions else next(source) for j in range(self.n_inputs)]
            us.append(jnp.stack([jnp.asarray(e, t.dtype) for e in entries]))
        return level(order)(time, us)


class OpaqueTemplate(AbstractTemplate):
    """y − N(u)[output] = 0, or its q-th time derivative; base slot 0 is y, the others are the non-time inputs."""

    n_parameters = 0
    n_coefficients = 0

    def __init__(self, opaque: OpaqueFunction, output: int, q: int = 0):
        self.opaque = opaque
        self.output = output
        self._q = q
        self._n = opaque.n_inputs - len(opaque.time_positions)
        self.slots: tuple[Slot, ...] = ((0, q), *((1 + k, r) for r in range(q + 1) for k in range(self._n)))
        self.key = f"network|{opaque.index}|{output}|{q}|{opaque.n_inputs}|{sorted(opaque.time_positions)}"

    @functools.cached_property
    def derivative(self) -> "OpaqueTemplate":
        return OpaqueTemplate(self.opaque, self.output, self._q + 1)

    def slots_of_partial(self, position: int) -> frozenset[int]:
        return frozenset(range(1, len(self.slots))) if position else frozenset()

    def coefficient_is_constant(self, position: int) -> bool:
        return position == 0

    coefficient_is_number = coefficient_is_constant
    coefficient_never_vanishes = coefficient_is_constant

    def numbers(self, coefficients: np.ndarray) -> np.ndarray:
        row = np.array([1.0, *[np.nan] * (len(self.slots) - 1)])
        return np.broadcast_to(row, (len(coefficients), len(self.slots)))

    def is_unmoved(self, direction: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
        return ~(direction != 0).any(axis=1)

    def __reduce__(self):
        return OpaqueTemplate, (self.opaque, self.output, self._q)

    def _grouped(self, inputs) -> list[list]:
        """The inputs' derivatives, one list for each order."""
        n = self._n
        return [list(inputs[r * n : (r + 1) * n]) for r in range(self._q + 1)]

    def _function(self, inputs, t, networks, like):
        return networks.evaluate(self.opaque, self._q, jnp.asarray(t, like.dtype), self._grouped(inputs))[self.output]

    @functools.cached_property
    def _batched(self) -> dict[str, Callable]:
        """Functions of (weights, slots (n, slots), t) that act on each instance alone, compiled once."""

        def value(weights, slots, t):
            return self.opaque.derivatives(weights, self._q, t, self._grouped(list(slots[1:])))[self.output]

        def residual(weights, slots, t):
            return slots[0] - value(weights, slots, t)

        def partials(weights, slots, t):
            return jax.jacfwd(lambda s: residual(weights, s, t))(slots)

        def over_instances(function):
            return compiled(lambda weights, slots, t: jax.vmap(lambda s: function(weights, s, t))(slots))

        return {
            "value": over_instances(value),
            "residual": over_instances(residual),
            "partials": over_instances(partials),
        }

    def _numpy(self, what: str, slots, t, networks) -> np.ndarray:
        if not networks.weights:  # none is known: they count as zero
            # A plan knows no weights: they belong to the system. Structure may not depend on them.
            columns = np.stack(np.broadcast_arrays(*slots), axis=-1).astype(float)
            one_hot = np.arange(len(slots)) == 0
            return {
                "value": np.zeros(columns.shape[:-1]),
                "residual": columns[..., 0],
                "partials": np.broadcast_to(one_hot.astype(float), columns.shape),
            }[what]
        # These are constants, also while a user's function is being traced.
        with jax.ensure_compile_time_eval():
            columns = jnp.asarray(np.stack(np.broadcast_arrays(*slots), axis=-1), dtype=float)
            flat = columns.reshape(-1, columns.shape[-1])
            weights = networks.weights[self.opaque.index]
            out = np.asarray(self._batched[what](weights, flat, jnp.asarray(t, flat.dtype)), float)
        return out.reshape(*columns.shape[:-1], *out.shape[1:])

    def residual(self, slots, parameters, coefficients, t, networks, backend="jax"):
        if backend == "numpy":
            return self._numpy("residual", slots, t, networks)
        like = jnp.asarray(slots[0], dtype=None if hasattr(slots[0], "dtype") else jnp.asarray(t).dtype)
        return like - self._function(slots[1:], t, networks, like)

    def magnitude(self, sizes, slots, parameters, coefficients, t, networks, backend="jax"):
        return sizes[0] + abs(slots[0] - self.residual(slots, parameters, coefficients, t, networks, backend))

    def solve(self, position, slots, parameters, coefficients, t, networks, backend="jax"):
        if position != 0:
            raise AssertionError("a function is solved for its outputs only")
        if backend == "numpy":
            return self._numpy("value", [np.zeros_like(slots[-1]), *slots[1:]], t, networks)
        return self._function(slots[1:], t, networks, jnp.asarray(t))

    def partial_values(self, slots, parameters, coefficients, t, networks, backend="jax"):
        if backend == "numpy":
            return tuple(np.moveaxis(self._numpy("partials", slots, t, networks), -1, 0))
        # Each instance is a function of its own slots alone: one direction moves the same slot of all.
        values = jnp.stack(jnp.broadcast_arrays(*(jnp.asarray(s, jnp.asarray(t).dtype) for s in slots)))

        def along(direction):
            return jax.jvp(lambda v: self.residual(list(v), (), (), t, networks), (values,), (direction,))[1]

        basis = jnp.eye(len(slots), dtype=values.dtype).reshape(len(slots), len(slots), *[1] * (values.ndim - 1))
        return tuple(jax.vmap(along)(jnp.broadcast_to(basis, (len(slots), *values.shape))))


class Networks:
    """The weights of learned terms, and each network's value, computed once for equal arguments."""

    def __init__(self, weights: tuple[PyTree, ...]):
        self.weights = weights
        self._seen: dict[tuple, tuple[Any, Any]] = {}

    def evaluate(self, opaque: OpaqueFunction, order: int, t, inputs: list[list]) -> Array:
        """The outputs' `order`-th time derivative, shape (outputs,) or (outputs, instances)."""
        # By identity of the arguments, which are tracers and have no value: an equation for each output asks for the
        # same evaluation.
        key = (opaque.index, order, id(t), *(id(x) for level in inputs for x in level))
        if key not in self._seen:
            value = opaque.derivatives(self.weights[opaque.index], order, t, inputs)
            self._seen[key] = (value, (t, inputs))  # the arguments are kept, so that their ids stay taken
        return self._seen[key][0]
