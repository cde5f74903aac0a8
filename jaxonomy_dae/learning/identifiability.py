"""What data can tell: the Fisher information, scaled, and what is not determined, in words.

Each coordinate is measured by what it would be natural to be unsure of: a parameter on a logarithmic scale by a factor
of e, one with a normal prior by its spread, and any other by its own size or by the change that moves predictions as
much as the data vary, whichever is more. An offset near zero is thus known, if it is small beside what is measured. A
direction is not determined if the data leave it as unsure as that, or more. Nothing of this depends on units, or on
where a search began.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

from ..base.optional import Axes, new_axes
from .evaluation import Evaluation, Weights
from .factors import Factors
from .objective import Objective


@dataclasses.dataclass(frozen=True)
class Direction:
    """A combination of coordinates that the data do not determine: `parts` of each, of length one together, and its
    `spread` on the natural scale; infinite if the data do not depend on it."""

    parts: dict[str, float]
    spread: float

    def __str__(self):
        names = list(self.parts)
        known = "nothing measured depends on" if np.isinf(self.spread) else f"known to {self.spread:.2g} only:"
        if len(names) == 1:
            return f"{known} '{names[0]}'"
        mixed = ", ".join(f"{part:+.2f} '{name}'" for name, part in self.parts.items())
        return f"{known} the combination {mixed}: only others of them can be told"


@dataclasses.dataclass(frozen=True, repr=False)
class Identifiability:
    """A printable report.

    - `spectrum`: eigenvalues of the scaled Fisher information, the greatest first. The standard deviation of a
        direction is 1/√ of its eigenvalue, in natural units of the coordinates.
    - `directions`: the directions that the data do not determine.
    - `alone`, `together`: standard deviations of parameters and starts on the coordinates' scale: conditional on all
        others, and marginal.
    - `confounded`: for each name, the other name whose exact value would help most, and the standard deviation that
        would remain.
    """

    spectrum: Float[np.ndarray, " k"]
    directions: tuple[Direction, ...]
    alone: dict[str, float]
    together: dict[str, float]
    confounded: dict[str, tuple[str, float]]

    def __repr__(self):
        low, high = self.spectrum.min(initial=np.inf), self.spectrum.max(initial=0.0)
        lines = [f"Fisher information: eigenvalues from {high:.3g} down to {low:.3g}"]
        lines += [f"not determined: {direction}" for direction in self.directions]
        for name, together in self.together.items():
            text = f"{name}: {self.alone[name]:.3g} if all else were known, {together:.3g} together"
            if name in self.confounded:
                other, helped = self.confounded[name]
                text += f" ({helped:.3g} if '{other}' were known)"
            lines.append(text)
        return "\n".join(lines)

    def plot(self, ax: Axes | None = None) -> Axes:
        """Draws the eigenvalues of the scaled Fisher information; returns Matplotlib axes."""
        ax = new_axes(ax)
        floor = np.finfo(float).tiny
        ax.semilogy(np.arange(1, len(self.spectrum) + 1), np.maximum(self.spectrum, floor), "o", markersize=4)
        ax.axhspan(ax.get_ylim()[0], 1.0, color="C3", alpha=0.1, linewidth=0, label="not determined")
        ax.set_xlabel("Direction")
        ax.set_ylabel("Eigenvalue")
        ax.grid(True, alpha=0.3)
        ax.legend()
        return ax


def natural_scale(objective: Objective, z: Float[np.ndarray, " f"], found: Evaluation) -> Float[np.ndarray, " f"]:
    """The uncertainty of each free coordinate that counts as complete, on the coordinates' scale, shape (f,)."""
    c, free = objective.coordinates, objective.free
    size, plain = np.abs(z), ~(c.log | c.is_weight | np.isfinite(c.spread))[free]
    # Where shifts measure biases of networks, columns of weights say nothing about a number by itself.
    by_signal = np.abs(found.jacobian[:, plain]) / signals(objective)[:, None]
    reach = np.sum(by_signal**2, axis=0) / np.maximum(np.sum(by_signal > 0, axis=0), 1)
    size[plain] = np.maximum(size[plain], 1 / np.sqrt(np.where(reach > 0, reach, np.inf)))
    return np.where((c.log | np.isfinite(c.spread))[free] | (size == 0), 1.0, size)


def signals(objective: Objective) -> Float[np.ndarray, " m"]:
    """For each sample, by how much its output varies in the data; the output's size if it does not vary."""
    s, rows = objective.stacked, objective.rows
    values, out = s.values[rows], np.ones(len(rows[0]))
    for j in np.unique(rows[2]):
        own = values[rows[2] == j]
        out[rows[2] == j] = np.std(own) or np.max(np.abs(own)) or 1.0
    return out


def identifiability(
    objective: Objective, weights: Weights, found: Evaluation, z: Float[np.ndarray, " f"], noise: float
) -> Identifiability:
    """The report at a point; `noise` is the relative error of the Jacobian's columns, the tolerance of integration."""
    c, free = objective.coordinates, objective.free
    names = np.array(c.names)[free]
    groups = np.array(c.group)[free]
    weight = c.is_weight[free]
    scale = natural_scale(objective, z, found)
    r, jacobian = weights.applied(z, found)
    scaled = jacobian * scale
    singular, right = np.linalg.svd(scaled, full_matrices=False)[1:]
    columns = np.linalg.norm(scaled, axis=0)
    floor = noise * np.sqrt(len(names)) * columns.max(initial=0.0)
    silent = columns <= floor  # the error of the largest column
    directions = [Direction({names[k]: 1.0}, np.inf) for k in np.flatnonzero(silent & ~weight)]
    for value, vector in zip(singular, right, strict=True):
        parts = np.where(weight | silent, 0.0, vector)
        if value > 1.0 or np.sum(parts**2) < 0.5:  # directions among weights are what a prior is for
            continue
        chosen = np.flatnonzero(np.abs(parts) > 0.1 * np.abs(parts).max())
        spread = np.inf if value <= floor else 1 / value
        directions.append(Direction({names[k]: float(parts[k]) for k in chosen}, spread))
    alone, together, confounded = {}, {}, {}
    plain = np.flatnonzero(~weight)
    full = _spread(r, jacobian, np.ones(len(z), bool), noise)
    norms = np.linalg.norm(jacobian, axis=0)
    for k in plain:
        alone[names[k]] = float(1 / norms[k]) if norms[k] > 0 else np.inf
        together[names[k]] = float(full[k])
    best: dict[str, tuple[str, float]] = {}
    for other in dict.fromkeys([*names[plain], *groups[weight]]):
        without = (names != other) & ~(weight & (groups == other))
        if not without.any():
            continue
        spread = np.full(len(z), np.inf)
        spread[without] = _spread(r, jacobian, without, noise)
        for k in plain:
            if names[k] != other and spread[k] < best.get(names[k], ("", np.inf))[1]:
                best[names[k]] = other, float(spread[k])
    for name, (other, value) in best.items():
        if value < together[name] / 2:  # more than half of its uncertainty is the other's
            confounded[name] = other, value
    return Identifiability(singular**2, tuple(directions), alone, together, confounded)


def _spread(r: np.ndarray, jacobian: np.ndarray, chosen: Bool[np.ndarray, " f"], noise: float) -> np.ndarray:
    """Standard deviations of the chosen coordinates, infinite for those that have a part in what is not determined."""
    return spreads(Factors.of(r, jacobian[:, chosen], noise), noise)


def spreads(factors: Factors, noise: float) -> Float[np.ndarray, " p"]:
    """Standard deviations of coordinates; infinite for those that have a part in a direction not determined."""
    rank = factors.rank(noise)
    found = np.sqrt(np.sum(factors.root(rank) ** 2, axis=1))
    inside = np.sum(factors.right[:, :rank] ** 2, axis=1)
    return np.where(inside < 1 - noise, np.inf, found)
