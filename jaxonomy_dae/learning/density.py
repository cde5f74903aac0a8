"""The posterior density, of which a fit finds the maximum, as a function of JAX.

With coordinates z as a fit has them, residuals r of the samples, weights w of experiments, and the fit's normal priors,

    ln p(z, σ) = −½ Σ w (r/σ)² − Σ w ln σ − ½ Σ precision·(z − mean)² + constant,

with the prior of smoothness of learned laws, linearized at the fit.

Noise levels that are estimated are among its arguments, with a flat prior of their logarithm; z is flat where it has
no prior. Coordinates with bounds are functions of free numbers y (`between`), and the logarithm of dz/dy is added. Its
argument is u in

    (y, ln σ) = centre + root·u,    root·rootᵀ = the inverse of the density's curvature,

so that where the fit's linearization holds, u is normal with covariance one. Derivatives of sums of squares are found
forwards, experiment by experiment, as those of a fit are, or backwards where there are many numbers; from there to u
they go backwards.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from ..base.errors import ModelError
from ..compile.diagnosis.wording import listed
from ..host.cache import compiled
from ..host.staging import is_staged
from ..run.system.system import AcausalSystem
from .coordinates import Shifts
from .descent import Minimum
from .devices import each, each_with_slopes
from .factors import Factors
from .objective import Objective
from .program import AbstractPredictor, Layout, Runs, Setting, Weighted, misfit, with_values

LOST = 100.0  # standard deviation of a coordinate, in its own size or as a logarithm, beyond which nothing is known


class Levels(eqx.Module):
    """Noise levels among the arguments: which there are by experiment and output, their places among the s levels, and
    for how many samples each counts."""

    sampled: Bool[Array, "e k"]
    place: Int[Array, " k"]
    count: Float[Array, "e k"]


class Posed(eqx.Module):
    """All that a program is told of a density over f coordinates and s noise levels; p coordinates in all."""

    told: Weighted
    levels: Levels
    natural: Float[Array, " p"]  # of coordinates that are no arguments
    chosen: Int[Array, " f"]  # those that are
    log: Bool[Array, " f"]
    size: Float[Array, " f"]
    shifts: Shifts | None
    low: Float[Array, " f"]
    high: Float[Array, " f"]
    precision: Float[Array, " f"]
    mean: Float[Array, " f"]
    bends: Float[Array, "r f"]  # rows of the prior of smoothness, linearized, and their values at z = 0
    bend: Float[Array, " r"]
    centre: Float[Array, " u"]
    root: Float[Array, "u u"]


class Program(NamedTuple):
    """The static and dynamic parts from which the density's program is built."""

    setting: Setting
    predictor: AbstractPredictor
    backwards: bool


def between(
    y: Float[Array, "*n f"], low: Float[Array, " f"], high: Float[Array, " f"]
) -> tuple[Float[Array, "*n f"], Float[Array, "*n f"]]:
    """z at free numbers y, and ln dz/dy: low + exp y, high − exp(−y), low + (high − low)/(1 + exp(−y)), or y for a
    lower, an upper, two, or no bounds."""
    has_low, has_high = jnp.isfinite(low), jnp.isfinite(high)
    lower, upper = jnp.where(has_low, low, 0.0), jnp.where(has_high, high, 0.0)
    one, two = has_low ^ has_high, has_low & has_high
    distance = jnp.exp(jnp.where(one, jnp.where(has_low, y, -y), 0.0))
    width = jnp.where(two, upper - lower, 1.0)
    inside = lower + width * jax.nn.sigmoid(y)
    z = jnp.where(two, inside, jnp.where(has_low, lower + distance, jnp.where(has_high, upper - distance, y)))
    slope = jnp.log(width) + jax.nn.log_sigmoid(y) + jax.nn.log_sigmoid(-y)
    return z, jnp.where(two, slope, jnp.where(has_low, y, jnp.where(has_high, -y, 0.0)))


def coordinates_at(posed: Posed, u: Float[Array, "*n u"]) -> tuple[Array, Array, Array]:
    """(free coordinates, logarithms of noise levels, Σ ln dz/dy) at u."""
    v = posed.centre + u @ posed.root.T
    f = len(posed.chosen)
    z, slope = between(v[..., :f], posed.low, posed.high)
    return z, v[..., f:], jnp.sum(slope, axis=-1)


def natural_at(posed: Posed, z: Float[Array, "*n f"]) -> Float[Array, "*n p"]:
    """The natural values of all coordinates."""
    values = jnp.where(posed.log, jnp.exp(jnp.where(posed.log, z, 0.0)), z * posed.size)
    natural = jnp.broadcast_to(posed.natural, (*z.shape[:-1], len(posed.natural))).at[..., posed.chosen].set(values)
    if posed.shifts is not None:
        natural = natural.at[..., posed.shifts.into].add(posed.shifts.factor * natural[..., posed.shifts.of])
    return natural


def numbers_at(posed: Posed, layout: Layout, z: Float[Array, " f"]) -> tuple[Float[Array, " s"], Float[Array, "e o"]]:
    """(shared, own) natural values as programs take them."""
    natural, e = natural_at(posed, z), posed.told.row.shape[0]
    split = len(natural) - e * layout.n_own
    return natural[:split], natural[split:].reshape(e, layout.n_own)


def density(program: Program, posed: Posed, u: Float[Array, " u"]) -> Float[Array, ""]:
    """ln p; −∞ where a run fails. It has a rule for its own gradient, which is zero there."""

    layout = program.setting.layout

    def one(shared, own, c):
        return misfit(program.setting, program.predictor, shared, own, c)

    def all_squares(shared, own):
        return each(one, layout.mesh, shared, own, posed.told)

    def with_slopes(shared, own):
        found, *slopes = each_with_slopes(one, layout.mesh, shared, own, posed.told)
        return found, slopes

    squares = jax.custom_vjp(all_squares)

    def backwards(slopes, out):
        by_shared, by_own = slopes
        return jnp.einsum("ek,eks->s", out, by_shared), jnp.einsum("ek,eko->eo", out, by_own)

    squares.defvjp(with_slopes, backwards)
    if program.backwards:
        squares = all_squares

    def value(u):
        z, logs, slope = coordinates_at(posed, u)
        found, levels = squares(*numbers_at(posed, layout, z)), posed.levels
        if len(logs):
            level = logs[levels.place]
            scaled = found * jnp.exp(-2 * level) + 2 * levels.count * level
            found = jnp.where(levels.sampled, scaled, found)
        prior = jnp.sum(posed.precision * (z - posed.mean) ** 2) + jnp.sum((posed.bends @ z + posed.bend) ** 2)
        return slope - 0.5 * jnp.sum(found) - 0.5 * prior

    @jax.custom_vjp
    def safe(u):
        return with_gradient(u)[0]

    def with_gradient(u):
        found, gradient = jax.value_and_grad(value)(u)
        fine = jnp.isfinite(found) & jnp.isfinite(gradient).all()
        return jnp.where(fine, found, -jnp.inf), jnp.where(fine, gradient, 0.0)

    safe.defvjp(with_gradient, lambda gradient, out: (out * gradient,))
    return safe(u)


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class LogDensity:
    """ln p of all that a fit estimates, up to a constant, from `Estimate.log_density`: `density(u)`, for u of shape
    `(density.size,)`, under `jit`, `grad` and `vmap`; −∞ where a run fails.

    It is whitened: u = 0 is the estimate, and where the fit's linearization holds, u is normal with covariance one.
    Bounds are at infinity.

    - `names`: parameters, starts and weights, as in `fit.values`, and noise levels, `"sigma of cell.v"`.
    """

    program: Program
    posed: Posed
    names: tuple[str, ...]

    @property
    def size(self) -> int:
        """The number of arguments."""
        return len(self.names)

    def __call__(self, u: Float[Array, " u"]) -> Float[Array, ""]:
        """ln p, shape ()."""
        # A program of its own inside of others would be differentiated when what its rules close over is gone.
        call = density if is_staged(u) else _density
        return call(self.program, self.posed, jnp.asarray(u, self.posed.centre.dtype))

    def __repr__(self):
        return f"LogDensity({self.size} arguments: {listed(self.names, 6)})"

    def values(self, u: Float[Array, "*n u"]) -> dict[str, Float[Array, "*n"]]:
        """What u says, by name, in the variables' units."""
        z, logs, _ = coordinates_at(self.posed, jnp.asarray(u, self.posed.centre.dtype))
        natural = natural_at(self.posed, z)[..., self.posed.chosen]
        columns = jnp.concatenate([natural, jnp.exp(logs)], axis=-1)
        return {name: columns[..., k] for k, name in enumerate(self.names)}

    def system(self, u: Float[Array, " u"]) -> AcausalSystem:
        """The system with the parameters and weights at u, for runs of your own. Starts and sensor laws are in
        `values`."""
        z, _, _ = coordinates_at(self.posed, jnp.asarray(u, self.posed.centre.dtype))
        setting = self.program.setting
        return with_values(setting, numbers_at(self.posed, setting.layout, z)[0])[0]


@compiled
def _density(program: Program, posed: Posed, u: Float[Array, " u"]) -> Float[Array, ""]:
    return density(program, posed, u)


def log_density(objective: Objective, minimum: Minimum, point: Float[np.ndarray, " p"]) -> LogDensity:
    """The density around an estimate. `point`: all its coordinates.

    **Raises:**

    - `ModelError` where the density has no finite integral: what neither data, priors nor bounds determine, by name.
    """
    s, c, free = objective.stacked, objective.coordinates, objective.free
    s.check_plain("the density of a posterior")
    names, dtype = objective.evidence.labels, objective.system.parameters.values.dtype
    low, high = objective.bounds
    z, weights = minimum.z, minimum.weights
    r, jacobian = weights.applied(z, minimum.found)
    y, slope, curvature = _centre(z, jacobian, jacobian.T @ r, low, high)
    rows = np.concatenate([jacobian * slope, np.diag(np.sqrt(curvature))])
    factors = Factors.of(np.zeros(len(rows)), rows, minimum.noise)
    root = np.zeros((len(z) + len(names), len(z) + len(names)))
    root[: len(z), : len(z)] = _root(objective, factors, weights.precision > 0, minimum.noise)
    places = [s.outputs.index(name) for name in names]
    counted = np.zeros(s.values.shape, bool)
    counted[objective.rows] = True
    counts = counted.sum(axis=1) * s.weight[:, None]  # by experiment and output
    sampled = s.estimated & np.isin(np.arange(len(s.outputs)), places)
    place = np.zeros(len(s.outputs), int)
    place[places] = np.arange(len(places))
    total = np.array([counts[sampled[:, j], j].sum() for j in places])
    root[len(z) :, len(z) :] = np.diag(1 / np.sqrt(2 * total))
    found = objective.sigma(z, weights)
    centre = np.concatenate([y, np.log([found[name] for name in names])])

    def array(values: ArrayLike) -> Array:
        return jnp.asarray(values, dtype)

    priors = weights.prior(z)
    bent = slice(np.count_nonzero(weights.precision), None)
    bends, bend = priors.jacobian[bent], priors.residual[bent] - priors.jacobian[bent] @ z
    levels = Levels(jnp.asarray(sampled), jnp.asarray(place), array(np.where(sampled, counts, 0.0)))
    told = Posed(
        told=objective.weighted, levels=levels, natural=array(c.natural(point)),
        chosen=jnp.asarray(np.flatnonzero(free)), log=jnp.asarray(c.log[free]), size=array(c.size[free]),
        shifts=None if c.shifts is None else c.shifts._replace(factor=array(c.shifts.factor)),
        low=array(low), high=array(high), precision=array(weights.precision), mean=array(weights.mean),
        bends=array(bends), bend=array(bend), centre=array(centre), root=array(root),
    )  # fmt: skip
    backwards = objective.has_many and isinstance(objective.predictor, Runs)  # filters are differentiated forwards
    predictor = Runs(None) if backwards else objective.predictor
    program = Program(objective.setting, predictor, backwards)
    labels = (*np.array(c.names)[free].tolist(), *(f"sigma of {name}" for name in names))
    return LogDensity(program, told, labels)


def _root(objective: Objective, factors: Factors, has_prior: np.ndarray, noise: float) -> Float[np.ndarray, "f f"]:
    """A square root of the covariance; raises a `ModelError` for what is not known at all."""
    rank, (low, high) = factors.rank(noise), objective.bounds
    inside = np.sum(factors.right[:, :rank] ** 2, axis=1)
    spread = np.linalg.norm(factors.root(rank), axis=1)
    endless = ~(np.isfinite(low) & np.isfinite(high)) & ~has_prior
    lost = (inside < 1 - noise) | (endless & (spread > LOST))
    if lost.any():
        names = np.array(objective.coordinates.names)[objective.free][lost]
        raise ModelError(
            "the posterior density has no finite integral: neither data, priors nor bounds determine "
            + ", ".join(f"'{n}'" for n in names[:6])
            + ": freeze it, give it two bounds, or a start a spread"
        )
    return factors.root(rank)


def _centre(
    z: np.ndarray, jacobian: np.ndarray, gradient: np.ndarray, low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(y, dz/dy, curvature of −ln p by y besides that of the rows) at the minimum; for coordinates that lie on a bound,
    or closer to it than they are known, at a point so far inside as their density reaches."""
    has_low, has_high = np.isfinite(low), np.isfinite(high)
    reach = 1 / (np.abs(gradient) + np.linalg.norm(jacobian, axis=0) + np.finfo(float).tiny)
    with np.errstate(invalid="ignore"):
        width = np.where(has_low & has_high, high - low, np.inf)
    reach = np.minimum(reach, 0.5 * width)
    z = np.where(has_low, np.maximum(z, low + reach), z)
    z = np.where(has_high, np.minimum(z, high - reach), z)
    two = has_low & has_high
    above = np.where(has_low, z - np.where(has_low, low, 0.0), 1.0)
    below = np.where(has_high, np.where(has_high, high, 0.0) - z, 1.0)
    bounded = has_low | has_high
    y = np.where(bounded, np.log(above) - np.log(below), z)
    share = above / np.where(two, width, 1.0)
    slope = np.where(two, above * (1 - share), np.where(has_low, above, np.where(has_high, below, 1.0)))
    bend = np.where(two, slope * (1 - 2 * share), np.where(has_low, above, np.where(has_high, -below, 0.0)))
    own = np.where(two, 2 * share * (1 - share), 0.0)
    return y, slope, np.maximum(gradient * bend, 0.0) + own
