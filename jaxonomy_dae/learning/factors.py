"""One factorization of a weighted Jacobian, from which steps, variances and effective numbers of parameters follow.

The columns are divided by their norms, so that nothing depends on units; then J = Q R and R = U S Vᵀ.
"""

import dataclasses

import numpy as np
import scipy.linalg
from jaxtyping import Bool, Float

from ..host.threads import one_thread


@dataclasses.dataclass(frozen=True)
class Factors:
    """J = (Q U) S Vᵀ diag(scale), for a Jacobian J of shape (m, p); `projected` is (Q U)ᵀ r for the residual r."""

    singular: Float[np.ndarray, " k"]
    right: Float[np.ndarray, "p k"]
    scale: Float[np.ndarray, " p"]
    projected: Float[np.ndarray, " k"]

    @classmethod
    def of(cls, residual: Float[np.ndarray, " m"], jacobian: Float[np.ndarray, "m p"], noise: float) -> "Factors":
        """Factorizes a Jacobian whose columns are known to `noise`, relative to the largest: smaller ones are not blown
        up to its size."""
        scale = np.linalg.norm(jacobian, axis=0)
        # What rounding alone leaves of a column that is zero (of a mass that cancels, say) points anywhere.
        seen = scale > max(jacobian.shape, default=0) * np.finfo(float).eps * scale.max(initial=0.0)
        jacobian, scale = np.where(seen, jacobian, 0.0), np.where(seen, scale, 0.0)
        scale = np.maximum(scale, noise * scale.max(initial=0.0))
        scale[scale == 0] = 1.0
        columns = np.column_stack([jacobian / scale, residual])
        with one_thread(columns.shape[0] * columns.shape[1] ** 2):
            triangle = np.asarray(scipy.linalg.qr(columns, mode="r", check_finite=False)[0])[: columns.shape[1]]
            left, singular, right = scipy.linalg.svd(triangle[:, :-1], full_matrices=False, check_finite=False)
        return cls(singular, right.T, scale, left.T @ triangle[:, -1])

    def alike(self, columns: Bool[np.ndarray, " p"]) -> "Factors":
        """Factors with one scale for some columns, the largest of theirs: damping then treats their coordinates as
        equals in the units that they have. Scaled one by one, weights that have no effect yet go furthest: those of
        inner layers, while the last one is zero. Then 12 of 20 searches for laws of one input ended, and all so."""
        if not columns.any():
            return self
        scale = np.where(columns, self.scale[columns].max(), self.scale)
        rows = self.singular[:, None] * self.right.T * (self.scale / scale)
        with one_thread(rows.shape[0] * rows.shape[1] ** 2):
            left, singular, right = scipy.linalg.svd(rows, full_matrices=False, check_finite=False)
        return Factors(singular, right.T, scale, left.T @ self.projected)

    def rank(self, noise: float) -> int:
        """The number of singular values beyond the `noise` of the columns, relative to their norms: perturbed by as
        much each, p columns move no singular value by more than noise·√p (Weyl)."""
        return int(np.sum(self.singular > noise * np.sqrt(len(self.scale))))

    def step(self, damping: float, rank: int) -> Float[np.ndarray, " p"]:
        """The Levenberg–Marquardt step: the least of |r + J d|² + damping·|scale·d|², among directions of this rank."""
        gain = self.singular[:rank] / (self.singular[:rank] ** 2 + damping)
        return -(self.right[:, :rank] @ (gain * self.projected[:rank])) / self.scale

    def solved(self, gradient: Float[np.ndarray, " p"], damping: float, rank: int) -> Float[np.ndarray, " p"]:
        """The step for another residual, of which the gradient is given."""
        right = self.right[:, :rank]
        return -(right @ ((right.T @ (gradient / self.scale)) / (self.singular[:rank] ** 2 + damping))) / self.scale

    def directions(self, noise: float) -> Float[np.ndarray, "p r"]:
        """The directions whose singular values are beyond the noise, shape (p, rank)."""
        return self.right[:, : self.rank(noise)] / self.scale[:, None]

    def root(self, rank: int) -> Float[np.ndarray, "p r"]:
        """A, with the covariance A Aᵀ = (JᵀJ)⁻¹ on the directions that are determined."""
        return self.right[:, :rank] / self.singular[:rank] / self.scale[:, None]
