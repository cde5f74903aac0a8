"""Whether a model is linear with constant coefficients, whatever its parameters: its flow is then a matrix exponential.

Slopes f(t, x, u) are traced, and so are their Jacobians by states and inputs. The model counts as linear if nothing
that these Jacobians compute leads from t, x or u to them, and nothing that slopes compute leads from t.

The flow of such a model over a time, and the noise that it gathers, are those of `linear_flow` and `affine_flow`.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..base.aliases import Numeric
from ..run.system.system import AcausalSystem

SMALL = 0.25  # of ‖A h‖, where the series begins
TERMS = 12  # of the series, which leave a remainder below rounding there: (2·¼)¹³/14! = 1e-15


def is_linear(system: AcausalSystem) -> bool:
    """True if slopes are A x + B u + c. Models with events, hidden constraints or nonlinear blocks are not examined:
    False."""
    plan, dtype = system.plan, system.parameters.values.dtype
    if plan.events is not None or plan.n_projected or len(plan.carried):
        return False
    names = plan.inputs.names
    t, x, u = (jax.ShapeDtypeStruct(shape, dtype) for shape in ((), (plan.n_state,), (len(names),)))

    def slopes(t, x, u):
        return system.at(t, dict(zip(names, u, strict=True))).semi_explicit(x)

    def jacobians(t, x, u):
        return jax.jacfwd(slopes, argnums=(1, 2) if names else (1,))(t, x, u)

    return not _reaches(slopes, (t, x, u))[0] and not any(_reaches(jacobians, (t, x, u)))


def _reaches(function: Callable, arguments: tuple[jax.ShapeDtypeStruct, ...]) -> list[bool]:
    """True for the arguments on which the result may depend: those from which operations lead to it. All inputs of an
    operation with inner programs count as used."""
    jaxpr = jax.make_jaxpr(function)(*arguments).jaxpr
    needed = {id(v) for v in jaxpr.outvars}
    for equation in reversed(jaxpr.eqns):
        if any(id(v) in needed for v in equation.outvars):
            needed |= {id(v) for v in equation.invars}
    return [id(v) in needed for v in jaxpr.invars]


def linear_flow(
    a: Float[Array, "f f"], g: Float[Array, "f f"], h: Numeric
) -> tuple[Float[Array, "f f"], Float[Array, "f f"]]:
    """exp(A h) − I, and ∫₀ʰ exp(A s) G exp(A s)ᵀ ds for symmetric G.

    By series over a short time, which is then doubled,

        Q(2h) = Q(h) + Φ Q(h) Φᵀ,    Φ(2h) − I = 2 (Φ − I) + (Φ − I)².

    Van Loan's exponential of a matrix of twice the size (1978) has exp(−A h) in it, which overflows for stiff systems.
    """
    size = jnp.max(jnp.sum(jnp.abs(jax.lax.stop_gradient(a)), axis=1)) * h
    times = jnp.where(jnp.isfinite(size), jnp.maximum(size / SMALL, 1.0), 1.0)
    doublings = jnp.ceil(jnp.log2(times))
    short = h * jnp.exp2(-doublings)
    ah = a * short
    moved, power, term, noise = ah, ah, g * short, g * short
    for k in range(2, TERMS + 1):
        power = power @ ah / k
        moved = moved + power
        term = (ah @ term + term @ ah.T) / k
        noise = noise + term

    def double(_, state):
        moved, noise = state
        across = moved @ noise
        return 2 * moved + moved @ moved, 2 * noise + across + across.T + across @ moved.T

    return jax.lax.fori_loop(0, doublings.astype(jnp.int32), double, (moved, noise))


def affine_flow(
    a: Float[Array, "f f"],
    first: Float[Array, " f"],
    rate: Float[Array, " f"],
    g: Float[Array, "f f"],
    h: Numeric,
) -> tuple[Float[Array, " f"], Float[Array, "f f"], Float[Array, "f f"]]:
    """Integrates δ' = A δ + `first` + s·`rate` from zero over a time h, by the exponential of the matrix of (δ, 1, s).
    Returns (δ, exp(A h), the covariance of the noise gathered)."""
    f = len(a)
    columns = jnp.concatenate([a, first[:, None], rate[:, None]], axis=1)
    big = jnp.zeros((f + 2, f + 2), a.dtype).at[:f].set(columns).at[f + 1, f].set(1.0)
    moved, noise = linear_flow(big, jnp.zeros_like(big).at[:f, :f].set(g), h)
    return moved[:f, f], jnp.eye(f, dtype=a.dtype) + moved[:f, :f], noise[:f, :f]
