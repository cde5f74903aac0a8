"""Small arrays put together into few."""

import math
from typing import Any

import jax
import jax.numpy as jnp

LARGEST = 512  # bytes, see `apart`


class Parcels:
    """How the leaves of a tree go into vectors of at most 512 bytes, each of one dtype; larger leaves stay alone.

    Every array that a loop carries costs XLA on CPU some copies an iteration, whatever its size.
    """

    def __init__(self, tree: Any):
        leaves, self.structure = jax.tree.flatten(tree)
        self.shapes = [jnp.shape(leaf) for leaf in leaves]
        open_parcels: dict[Any, tuple[int, int]] = {}
        self.parcels: list[list[int]] = []
        for i, leaf in enumerate(leaves):
            dtype = jnp.result_type(leaf)
            size = math.prod(self.shapes[i]) * dtype.itemsize
            parcel, filled = open_parcels.get(dtype, (-1, LARGEST))
            if filled + size > LARGEST:
                parcel, filled = len(self.parcels), 0
                self.parcels.append([])
            self.parcels[parcel].append(i)
            open_parcels[dtype] = parcel, filled + size

    def pack(self, tree: Any) -> list[Any]:
        """The vectors."""
        leaves = jax.tree.leaves(tree)
        return [
            leaves[parcel[0]] if len(parcel) == 1 else jnp.concatenate([jnp.ravel(leaves[i]) for i in parcel])
            for parcel in self.parcels
        ]

    def unpack(self, vectors: list[Any]) -> Any:
        """The tree."""
        leaves: list[Any] = [None] * len(self.shapes)
        for parcel, vector in zip(self.parcels, vectors, strict=True):
            start = 0
            for i in parcel:
                size = math.prod(self.shapes[i])
                if len(parcel) == 1:
                    leaves[i] = vector
                else:
                    leaves[i] = vector[start : start + size].reshape(self.shapes[i])
                start += size
        return jax.tree.unflatten(self.structure, leaves)
