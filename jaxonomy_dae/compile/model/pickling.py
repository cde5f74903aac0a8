"""Pickling of networks: functions in them, such as the activation `jnp.tanh`, are stored by module and name."""

import dataclasses
import importlib
import sys

import equinox as eqx
import jax

from ...base.aliases import PyTree


@dataclasses.dataclass(frozen=True)
class NamedFunction:
    """A function to be imported: jitted ones and lambdas cannot be pickled themselves."""

    module: str
    name: str

    def load(self) -> PyTree:
        return getattr(importlib.import_module(self.module), self.name)


def functions_by_name(tree: PyTree) -> PyTree:
    """The tree with functions that a module holds replaced by their names."""

    def named(leaf: PyTree) -> PyTree:
        module = sys.modules.get(getattr(leaf, "__module__", None) or "")
        if eqx.is_array(leaf) or module is None or not callable(leaf):
            return leaf
        # The identity that ends an `eqx.nn.MLP` is a lambda, which its module holds under another name.
        names = [getattr(leaf, "__name__", ""), *vars(module)]
        for name in names:
            if vars(module).get(name) is leaf:
                return NamedFunction(module.__name__, name)
        return leaf

    return jax.tree.map(named, tree)


def named_functions(tree: PyTree) -> PyTree:
    """The tree with names replaced by the functions again."""
    return jax.tree.map(lambda leaf: leaf.load() if isinstance(leaf, NamedFunction) else leaf, tree)
