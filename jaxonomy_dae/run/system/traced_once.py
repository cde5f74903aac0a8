"""Functions of a system that are functions of their own in the program around them.

A run evaluates the field and the guards at a dozen places and more: for the first step, in the stages, in the second
run beside a state at rest, before and after an event, in a step backwards. Written there, they would be traced,
differentiated, batched and lowered at each place. A function is traced once for each kind of arguments, differentiated
and batched once, and stands once for each of these forms in the program that JAX hands to XLA. XLA puts it where it is
called, so that its share of compilation hardly changes.
"""

import functools
from collections.abc import Callable, Hashable
from typing import Any

import equinox as eqx
import jax
from jax import Array

from ...base.aliases import PyTree


class TracedOnce:
    """The functions of one system in one program. It is let go with the program, as are their traces: what the user's
    own functions read may have changed when the next one is traced."""

    def __init__(self):
        self._calls: dict[Any, Callable[..., Array]] = {}

    def __call__(self, method: Callable[..., Array], remade: Callable[..., Any], own: PyTree, given: PyTree) -> Array:
        """`method(remade(*own), *given)`."""
        arrays, rest = eqx.partition((own, given), eqx.is_array)
        leaves, structure = jax.tree.flatten(rest)
        if not all(isinstance(leaf, Hashable) for leaf in leaves):
            return method(remade(*own), *given)
        if method not in self._calls:

            def evaluate(leaves: tuple[Hashable, ...], structure: Any, arrays: PyTree) -> Array:
                own, given = eqx.combine(arrays, jax.tree.unflatten(structure, leaves))
                return method(remade(*own), *given)

            evaluate.__name__ = evaluate.__qualname__ = getattr(method, "__name__", "evaluate")
            # One function object for each method, since JAX keeps traces by it. What is static of the arguments is part
            # of the key.
            self._calls[method] = jax.jit(evaluate, static_argnums=(0, 1))
        return self._calls[method](tuple(leaves), structure, arrays)


def traced_once(method: Callable[..., Array]) -> Callable[..., Array]:
    """Makes a method of `SystemAt` a function of its own where the system asks for it, by its `once`."""

    @functools.wraps(method)
    def call(self: Any, *given: Any) -> Array:
        if self.once is None:
            return method(self, *given)
        own = self.parameters, self.networks, self.t, self.inputs, self.typical, self.past
        # Those that it calls are functions of their own, too.
        return self.once(method, functools.partial(type(self), self.plan, once=self.once), own, given)

    return call
