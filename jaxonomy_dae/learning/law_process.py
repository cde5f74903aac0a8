"""The two models of a learned law near its fit, and which of them the data speak for.

One is the network's own: its weights with their prior, linearized. The other is a Gaussian process (`process.py`).
Where the evidence of both is e₁ and e₂, a band has the variance of the first with the probability e₁/(e₁ + e₂), and of
the second with the rest (Hoeting et al. 1999, Statistical Science 14:382). Kernels of the process are all as likely
before the data; taken at their best instead, bands of gaps covered 97 % and of smooth laws were twice as wide. Of a
spring with a gap, the process has 0.2 to 0.7: then 95 % cover 94 where weights alone cover 89. Of Stribeck's friction,
whose steep part no stationary process knows, it has next to nothing, and alone would make bands five times as wide.
The middle of the band stays what the network says, the law with which runs are made."""

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .law_changes import Bumps, answers, slopes_by_heights
from .laws.properties import Property, is_raw, raw
from .process import Kernel, Process
from .smoothness import spread_out

if TYPE_CHECKING:
    from .estimate import Estimate

APART = 4.0  # ℓ of the kernel that interpolates between places, in distances of neighbours


@dataclasses.dataclass(frozen=True)
class LawProcess:
    """The process of a law, the centre and the half range of its inputs, and the probability that it is the better
    model."""

    process: Process
    centre: Float[np.ndarray, " d"]
    half: Float[np.ndarray, " d"]
    share: float

    @classmethod
    def of(cls, estimate: "Estimate", name: str) -> "LawProcess | None":
        """The process of a raw network, or of one with a property, whose prior the evidence chooses. None of others,
        which say more of a law than that it is a function, and where a model says how large its residuals are."""
        o = estimate.objective
        if o.penalties.get(name) != "evidence" or name not in o.blocks or o.has_variances:
            return None
        module = estimate.system.neural[name]
        seen = o.seen(estimate.point)[name]
        seen = asked(module, seen[np.isfinite(seen).all(axis=1)])
        if not is_raw(module) or len(seen) < 2:
            return None
        places = spread_out(seen)
        low, high = seen.min(axis=0), seen.max(axis=0)
        centre, half = 0.5 * (low + high), np.where(high > low, 0.5 * (high - low), 1.0)
        scaled = (places - centre) / half
        dtype = o.system.parameters.values.dtype
        values = np.asarray(jax.vmap(lambda u: jnp.ravel(raw(module)(u)))(jnp.asarray(places, dtype)), float)
        # Answers are found at the places alone: between them, a kernel as smooth as the process's interpolates.
        gaps = np.linalg.norm(scaled[:, None] - scaled, axis=-1) + np.diag(np.full(len(scaled), np.inf))
        kernel = Kernel(1.0, 0.0, APART * float(np.median(gaps.min(axis=1))))
        bumps = Bumps.of(centre, half, scaled, kernel, dtype)
        found = answers(estimate, name, bumps, kernel, values.shape[1])
        if not np.isfinite(found).all():
            return None
        residual, columns, own = _reduced(estimate, name, found)
        process = Process.of(scaled, values, columns, residual)
        if process is None:
            return None
        odds = np.clip(process.surprise - own, -700, 700)  # exp of more overflows
        return cls(process, centre, half, float(1 / (1 + np.exp(odds))))

    def variance(self, module: Any, law: Callable, points: Any, grid: np.ndarray) -> Float[np.ndarray, " n"]:
        """The variance of a law's values at points by the process."""
        p, points = self.process, jnp.asarray(points)
        beyond = grid.reshape(len(grid), -1)
        beyond = asked(module, beyond) if beyond.shape[1] == len(self.centre) else beyond[:0, :1] + self.centre
        dtype = points.dtype

        def slopes(kernel, places):
            bumps = Bumps.of(self.centre, self.half, places, kernel, dtype)
            heights = jnp.zeros(len(p.size) * len(places), dtype)
            return np.asarray(slopes_by_heights(module, law, bumps, heights, points), float)

        return p.variance((beyond - self.centre) / self.half, slopes)


def asked(module: Any, points: Float[np.ndarray, "m d"]) -> Float[np.ndarray, "n d"]:
    """Where the raw network of a law is evaluated for these points."""
    return module.asked(points) if isinstance(module, Property) and len(points) else points


def _reduced(
    estimate: "Estimate", name: str, found: Float[np.ndarray, "m q"]
) -> tuple[Float[np.ndarray, " r"], Float[np.ndarray, "r q"], float]:
    """(residuals of unit noise; the answers to the law; −ln (evidence) of the network's own model), of the directions
    that no other coordinate explains: what these may do is integrated over, with their priors."""
    o, m = estimate.objective, estimate.minimum
    rows, prior = m.weights.expected(m.z, m.found), m.weights.prior(m.z)
    low, high = o.bounds
    weights = np.array([group == name for group in o.coordinates.group])[o.free]
    others = ~weights & ~((m.z <= low) | (m.z >= high))
    # Rows of priors of this law belong to the network's own model; the process has its kernel instead.
    about_law = (prior.jacobian[:, weights] != 0).any(axis=1)
    keep = np.concatenate([np.ones(len(found), bool), ~about_law])
    columns = np.zeros((len(keep), found.shape[1]))
    columns[: len(found)] = m.weights.informing[:, None] * found
    others = rows.jacobian[keep][:, others]
    residual, columns, own = (
        _beside(others, a[keep], m.noise) for a in (rows.residual[:, None], columns, rows.jacobian[:, weights])
    )
    inside = prior.jacobian[about_law][:, weights]
    stiff = inside.T @ inside
    logs = [np.linalg.slogdet(a)[1] for a in (stiff + own.T @ own, stiff)]
    misfit = np.sum(residual**2) + np.sum(prior.residual[about_law] ** 2)
    return residual[:, 0], columns, 0.5 * float(misfit + logs[0] - logs[1])


def _beside(
    others: Float[np.ndarray, "r s"], columns: Float[np.ndarray, "r q"], noise: float
) -> Float[np.ndarray, "r q"]:
    """Columns without what other columns explain."""
    size = np.linalg.norm(others, axis=0)
    left, singular, _ = np.linalg.svd(others / np.where(size > 0, size, 1.0), full_matrices=False)
    left = left[:, singular > noise * np.sqrt(max(len(size), 1))]
    return columns - left @ (left.T @ columns)
