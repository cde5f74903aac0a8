"""Small arrays put together into few."""

import math
from collections.abc import Hashable

import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree, Shaped

LARGEST = 512  # bytes, see `apart`


class Packing:
    """A plan for packing the leaves of a tree into vectors of at most 512 bytes, each of one dtype; larger leaves stay
    alone.

    Every array that a loop carries costs XLA on CPU some copies an iteration, whatever its size.
    """

    def __init__(self, tree: PyTree):
        leaves, self.structure = jax.tree.flatten(tree)
        self.shapes = [jnp.shape(leaf) for leaf in leaves]
        unfilled: dict[Hashable, tuple[int, int]] = {}  # of each dtype, the vector being filled, and its bytes so far
        self.members: list[list[int]] = []  # the leaves in each vector
        for i, leaf in enumerate(leaves):
            dtype = jnp.result_type(leaf)
            size = math.prod(self.shapes[i]) * dtype.itemsize
            place, filled = unfilled.get(dtype, (-1, LARGEST))
            if filled + size > LARGEST:
                place, filled = len(self.members), 0
                self.members.append([])
            self.members[place].append(i)
            unfilled[dtype] = place, filled + size

    def pack(self, tree: PyTree) -> list[Shaped[Array, "..."]]:
        """Packs the leaves of a tree into the vectors."""
        leaves = jax.tree.leaves(tree)
        return [
            # A leaf by itself keeps its shape: ravelling and reshaping it would be two operations for nothing.
            leaves[inside[0]] if len(inside) == 1 else jnp.concatenate([jnp.ravel(leaves[i]) for i in inside])
            for inside in self.members
        ]

    def unpack(self, vectors: list[Shaped[Array, "..."]]) -> PyTree:
        """Rebuilds the tree from its vectors."""
        leaves: list[PyTree] = [None] * len(self.shapes)
        for inside, vector in zip(self.members, vectors, strict=True):
            start = 0
            for i in inside:
                size = math.prod(self.shapes[i])
                if len(inside) == 1:
                    leaves[i] = vector
                else:
                    leaves[i] = vector[start : start + size].reshape(self.shapes[i])
                start += size
        return jax.tree.unflatten(self.structure, leaves)
