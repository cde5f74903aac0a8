"""Constant mass matrices."""

import functools
import hashlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ...base.errors import ModelError
from ...base.tolerances import ILL_CONDITIONED


class Mass:
    """A constant mass matrix, known when the program is traced: its diagonal, shape (n,), or the matrix, (n, n)."""

    def __init__(self, matrix: Any):
        if callable(matrix):
            raise ModelError(
                "the mass matrix of a DAETerm is constant; got a function. Where M varies, make the slopes z unknowns: "
                "DAETerm(lambda t, x, z, args: z, lambda t, x, z, args: M(t, x) @ z - F(t, x, args))"
            )
        try:
            # A copy: it is made read-only below.
            array = np.array(matrix, complex if np.iscomplexobj(matrix) else float)
        except (jax.errors.TracerArrayConversionError, jax.errors.ConcretizationTypeError):
            raise ModelError(
                "the mass matrix of a DAETerm is constant: it cannot be traced. Move what varies into F, or solve for "
                "other variables"
            ) from None
        except (TypeError, ValueError):
            raise ModelError(f"mass must be a matrix of numbers (n, n), or its diagonal (n,); got {matrix!r}") from None
        if np.iscomplexobj(array):
            raise ModelError("mass must be real; it is complex")
        # A matrix that is diagonal is kept as such: products are cheaper, and sparse steps need it.
        if array.ndim == 2 and array.shape[0] == array.shape[1] and not (array - np.diag(np.diag(array))).any():
            array = np.diag(array).copy()
        square = array.ndim == 1 or (array.ndim == 2 and array.shape[0] == array.shape[1])
        if not square or not np.isfinite(array).all():
            raise ModelError(
                f"mass must be a finite square matrix (n, n), or its diagonal (n,); got shape {array.shape}"
                + ("" if np.isfinite(array).all() else " with entries that are not finite")
            )
        # The digest and what is cached below follow from the entries.
        array.setflags(write=False)
        self.array = array
        self._digest = hashlib.sha256(array.tobytes() + repr(array.shape).encode()).hexdigest()

    def __eq__(self, other):
        return isinstance(other, Mass) and self._digest == other._digest

    def __hash__(self):
        return hash(self._digest)

    def __content__(self) -> tuple[str, tuple]:
        """For `host/content.py`."""
        return self._digest, ()

    def __repr__(self):
        return f"Mass{self.array.shape}"

    @property
    def is_diagonal(self) -> bool:
        return self.array.ndim == 1

    def times(self, v: Any) -> Any:
        """M v."""
        m = jnp.asarray(self.array, v.dtype)
        return m * v if self.is_diagonal else m @ v

    @functools.cached_property
    def algebraic(self) -> np.ndarray:
        """The projector onto the left null space of M: its rows pick out the algebraic equations."""
        if self.is_diagonal:
            return (self.array == 0).astype(float)
        u, s, _ = np.linalg.svd(self.array)
        # By singular values rather than by rows of zeros: an algebraic equation may be a combination of rows.
        null = u[:, s <= s.max(initial=0.0) / ILL_CONDITIONED]
        return null @ null.T

    @property
    def is_singular(self) -> bool:
        return bool(self.algebraic.any())

    @functools.cached_property
    def differential(self) -> np.ndarray:
        """The part of y that is differentiated: its places, shape (n,), or the projector onto the range of Mᵀ."""
        if self.is_diagonal:
            return (self.array != 0).astype(float)
        _, s, vt = np.linalg.svd(self.array)
        kept = vt[s > s.max(initial=0.0) / ILL_CONDITIONED]
        return kept.T @ kept

    def differential_part(self, v: Any) -> Any:
        """v without what is algebraic."""
        p = jnp.asarray(self.differential, v.dtype)
        return p * v if self.is_diagonal else p @ v
