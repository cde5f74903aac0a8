"""What a filter does from one sample to the next.

Of a filter, a state x and the covariance P of its f differential entries; between samples

    x ← φ(x),    P ← Φ P Φᵀ + Q,    Φ = ∂φ/∂x,    Q = ∫ exp(A s) σσᵀ exp(A s)ᵀ ds,

with φ the flow, by `simulate`, and Φ its derivative. Q depends on A = ∂f/∂x along the way. Noise that is gathered at s
is carried on from there, so that a Jacobian at time τ acts on a share τ/h of it: to second order, the constant matrix
that does the same is A(0)/3 + 2 A(h)/3. At samples, outputs correct the state one by one, linearized where all of them
were predicted, which is the same as at once; a missing sample corrects nothing. Of linear models, φ is a matrix
exponential, fifteen times faster than runs. Where constraints make states redundant, noise and covariance are kept in
their tangent space by the derivative of the projection.
"""

from typing import Any, NamedTuple, TypeAlias

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..run.simulation.simulate import simulate
from ..run.simulation.solution import Solution
from ..run.system.input_values import by_entry
from ..run.system.inputs import read_inputs, value_at
from ..run.system.nonlinear import Refinement
from ..run.system.system import AcausalSystem
from ..run.system.system_at import SystemAt
from .filter_data import Told
from .filtering import Structure
from .linear_models import affine_flow, linear_flow
from .program import Layout, Own, SensorLaw, Setting, Shared, outputs_of, placed, run_end, with_kinds

Instant: TypeAlias = Float[Array, ""]
State: TypeAlias = Float[Array, " x"]  # of which the first f entries are differential
Matrix: TypeAlias = Float[Array, "f f"]
Discrete: TypeAlias = Float[Array, " q"] | None

ITERATIONS = 4  # Gauss–Newton steps onto the constraints after a correction, which converge quadratically


class Model(NamedTuple):
    """One experiment's system with all numbers in their places: `here`, sensor laws, initial values by name, inputs;
    what the method adds: intensities of diffusion, shape (f, f), and of noise of inputs, noise levels, shape (k,), and
    K, shape (f, k); and the options of `simulate`."""

    here: AcausalSystem
    laws: dict[str, SensorLaw]
    initial: dict[str, Array]
    inputs: dict[str, tuple[Array, Array, str]]
    diffusion: Float[Array, "f f"]
    driven: dict[str, Float[Array, ""]]
    sigma: Float[Array, " k"]
    gain: Float[Array, "f k"]
    options: dict[str, Any]


def model_of(setting: Setting, structure: Structure, shared: Shared, own: Own, told: Told) -> Model:
    """The model of an experiment, with the numbers that a program is given; its inputs follow with each sample."""
    system, _, layout, _ = setting
    here, laws, initial = placed(setting, shared, own, told.known)
    end = len(shared) - len(layout.shared)
    extra = iter(shared[end - len(layout.extra) : end])
    f, k = len(system.plan.states), len(layout.outputs)
    diffusion, driven = jnp.zeros(f, shared.dtype), {}
    for place, factor in structure.noise:
        if isinstance(place, str):
            driven[place] = next(extra)
        else:
            diffusion = diffusion.at[place].set((next(extra) / factor) ** 2)
    sigma = told.sigma
    for j in structure.sigma:
        sigma = sigma.at[j].set(jnp.where(jnp.isnan(sigma[j]), next(extra), sigma[j]))
    gain = jnp.zeros((f, k), shared.dtype)
    for place, j, factor in structure.gain:
        gain = gain.at[place, j].set(next(extra) / factor)
    return Model(
        here, laws, initial, inputs={}, diffusion=jnp.diag(diffusion), driven=driven, sigma=sigma, gain=gain,
        options=setting.options,
    )  # fmt: skip


def start_of(setting: Setting, structure: Structure, shared: Shared, own: Own, told: Told) -> tuple[State, Matrix]:
    """The state at the start and the covariance that the priors of known starts give it."""
    system, _, layout, _ = setting
    f = len(system.plan.states)
    inputs = with_kinds(jax.tree.map(lambda a: a[0], told.inputs), layout)

    def at(known):
        here, _, initial = placed(setting, shared, own, known)
        found = here.initialize(told.t0, inputs or None, initial or None, throw=False)
        return found, found

    if not structure.is_filter or not layout.known:
        return at(told.known)[0], jnp.zeros((f, f), shared.dtype)
    slopes, found = jax.jacfwd(at, has_aux=True)(told.known)
    root = slopes[:f] * told.spread
    return found, root @ root.T


def _run(m: Model, t0: Instant, t1: Instant, x: State) -> tuple[State, Discrete]:
    """(state, discrete values) at t1 of a run from a state at t0; padded times repeat."""
    t1 = run_end(t0, t1)
    solution = simulate(
        m.here, t1, t0=t0, ts=t1[None], initial=x, adjoint=diffrax.ForwardMode(), throw=False,
        inputs=m.inputs, **m.options,
    )  # fmt: skip
    return solution.states[-1], None if solution.discrete is None else solution.discrete[-1]


def _held(m: Model, discrete: Discrete) -> AcausalSystem:
    return m.here if discrete is None else m.here.holding(discrete)


def _jacobian(m: Model, t: Instant, x: State) -> Matrix:
    """∂f/∂x of the differential states, algebraic unknowns following them."""
    f, here = len(m.here.plan.states), m.here.at(t, m.inputs)
    return jax.jacfwd(lambda first: slopes_of(here, jnp.concatenate([first, x[f:]])))(x[:f])


def slopes_of(here: SystemAt, x: State) -> Float[Array, " f"]:
    """The slopes of the differential states, algebraic unknowns following them."""
    if len(here.plan.carried):
        x = here.refined(x, Refinement.ROOT)
    return here.semi_explicit(x)[: len(here.plan.states)]


def _intensity(m: Model, t: Instant, x: State) -> Matrix:
    """σσᵀ at a state, that of noise of inputs included; kept in the tangent space of the constraints."""
    plan = m.here.plan
    tangent = _tangent(m, t, x, None)
    g = m.diffusion if tangent is None else tangent @ m.diffusion @ tangent.T
    if not m.driven:
        return g
    sources = by_entry(plan, read_inputs(plan, x.dtype, m.inputs))
    names = list(m.driven)
    given = (sources.get(name, plan.inputs.defaults[plan.inputs.place[name]]) for name in names)
    at = jnp.stack([jnp.asarray(value_at(source, t), x.dtype) for source in given])

    def slopes(values):
        return slopes_of(m.here.at(t, {**sources, **dict(zip(names, values, strict=True))}), x)

    b = jax.jacfwd(slopes)(at) * jnp.stack([m.driven[name] for name in names])
    return g + b @ b.T


def _tangent(m: Model, t: Instant, x: State, discrete: Discrete) -> Matrix | None:
    """The derivative of the projection onto hidden constraints; None if there are none."""
    plan = m.here.plan
    f = len(plan.states)
    if not plan.n_projected:
        return None
    here = _held(m, discrete)
    return jax.jacfwd(lambda first: here.project(t, jnp.concatenate([first, x[f:]]), m.inputs)[:f])(x[:f])


def read(
    m: Model, layout: Layout, t: Instant, x: State, discrete: Discrete
) -> tuple[Float[Array, " k"], Float[Array, "k f"]]:
    """Outputs at a state, and their derivatives by its differential entries."""
    f, here = len(m.here.plan.states), _held(m, discrete)

    def outputs(first):
        full = jnp.concatenate([first, x[f:]])
        full = here.project(t, full, m.inputs) if m.here.is_constrained else full
        found = read_values(m, layout, t, full, discrete)
        return found, found

    slopes, found = jax.jacfwd(outputs, has_aux=True)(x[:f])
    return found, slopes


def _forward(m: Model, substeps: int, t0: Instant, t1: Instant, x: State, p: Matrix) -> tuple[State, Matrix, Matrix]:
    """State, covariance and Φ at t1, from those at t0."""
    f = len(m.here.plan.states)

    def part(carry, ends):
        x, p, through = carry
        start, stop = ends

        def flow(first):
            found, _ = _run(m, start, stop, jnp.concatenate([first, x[f:]]))
            return found[:f], found

        first, g = _jacobian(m, start, x), _intensity(m, start, x)
        phi, x = jax.jacfwd(flow, has_aux=True)(x[:f])
        a = first / 3 + 2 / 3 * _jacobian(m, stop, x)
        g = (g + _intensity(m, stop, x)) / 2
        q = linear_flow(a, g, stop - start)[1]
        tangent = _tangent(m, stop, x, None)
        q = q if tangent is None else tangent @ q @ tangent.T
        return (x, phi @ p @ phi.T + q, phi @ through), None

    first = (x, p, jnp.eye(f, dtype=x.dtype))
    if substeps == 1:
        return part(first, (t0, t1))[0]
    ends = t0 + (t1 - t0) * jnp.asarray(np.arange(substeps + 1) / substeps, x.dtype)
    ends = ends.at[-1].set(t1)  # not beyond it by rounding
    return jax.lax.scan(part, first, (ends[:-1], ends[1:]))[0]


def _forward_linear(m: Model, ends: Float[Array, " m"], x: State, p: Matrix) -> tuple[State, Matrix, Matrix]:
    """As `_forward`, for a linear model, part by part; in each part, inputs are linear in time."""
    f = len(x)

    def slopes(t, x):
        return m.here.at(t, m.inputs).semi_explicit(x)

    def part(carry, ends):
        x, p, through = carry
        start, h = ends[0], ends[1] - ends[0]
        early = start + h / 4  # inside, where jumps at the ends do not show
        a, g, one = jax.jacfwd(slopes, argnums=1)(early, x), _intensity(m, early, x), slopes(early, x)
        rate = jnp.where(h > 0, (slopes(start + 3 * h / 4, x) - one) / jnp.where(h > 0, h / 2, 1.0), 0.0)
        moved, phi, q = affine_flow(a, one - rate * h / 4, rate, g, h)
        return (x + moved, phi @ p @ phi.T + q, phi @ through), None

    first = (x, p, jnp.eye(f, dtype=x.dtype))
    pairs = jnp.stack([ends[:-1], ends[1:]], axis=1)
    if len(pairs) == 1:
        return part(first, pairs[0])[0]
    return jax.lax.scan(part, first, pairs)[0]


def read_values(m: Model, layout: Layout, t: Instant, x: State, discrete: Discrete) -> Float[Array, " k"]:
    """Outputs at a state."""
    inputs = read_inputs(m.here.plan, x.dtype, m.inputs)
    values = None if discrete is None else discrete[None]
    solution = Solution(t[None], x[None], m.here, inputs, {}, diffrax.RESULTS.successful, discrete=values)
    return outputs_of(solution, m.laws, layout, x.dtype)[0]


def onwards(
    m: Model, layout: Layout, structure: Structure, ends: Float[Array, " m"], x: State, p: Matrix
) -> tuple[State, Matrix, Matrix, Discrete]:
    """(state, covariance, Φ, discrete values) after the parts of a step, from those before it: by matrix exponentials
    of a linear model, by the flow and its derivative, or by the flow alone, where no covariance is carried on."""
    if structure.is_linear:
        return *_forward_linear(m, ends, x, p), None
    if structure.is_filter:
        return *_forward(m, structure.substeps, ends[0], ends[-1], x, p), None
    x, discrete = _run(m, ends[0], ends[-1], x)
    return x, p, jnp.zeros_like(p), discrete


def corrected_by(
    x: State, p: Matrix, row: tuple[Array, ...], is_drawn: bool = False
) -> tuple[Float[Array, " f"], Matrix, tuple[Float[Array, " k"], Float[Array, " k"]]]:
    """(state less the prediction, covariance, (variances, predictions)) after the outputs of one time, taken one by one
    (Joseph's form, in which rounding leaves the covariance positive). Samples that are drawn are told as `Structure`
    says."""
    eye = jnp.eye(len(p), dtype=p.dtype)

    def one(carry, given):
        d, p = carry
        y, predicted, slope, seen, sigma = given
        across = p @ slope
        s = slope @ across + sigma**2
        gain = jnp.where(seen, across / s, 0.0)
        if is_drawn:
            y = jax.lax.stop_gradient(predicted + slope @ d + jnp.sqrt(s) * y)
        d = d + gain * (y - predicted - slope @ d)
        rest = eye - jnp.outer(gain, slope)
        return (d, rest @ p @ rest.T + jnp.outer(gain, gain) * sigma**2), (s, predicted + slope @ carry[0])

    (d, p), (variance, predicted) = jax.lax.scan(one, (jnp.zeros_like(x[: len(p)]), p), row)
    return d, p, (variance, predicted)


def moved_by(
    m: Model, t: Instant, x: State, d: Float[Array, " f"], p: Matrix, discrete: Discrete
) -> tuple[State, Matrix]:
    """The state moved by a correction of its differential entries, onto the constraints, and the covariance there."""
    f = len(d)
    x = jnp.concatenate([x[:f] + d, x[f:]])
    if not m.here.is_constrained:
        return x, p
    x = _held(m, discrete).project(t, x, m.inputs, iterations=ITERATIONS)
    tangent = _tangent(m, t, x, discrete)
    return x, p if tangent is None else tangent @ p @ tangent.T
