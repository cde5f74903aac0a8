"""Chains of the No-U-Turn sampler (Hoffman & Gelman 2014, J. Mach. Learn. Res. 15:1593), by BlackJAX."""

import types
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..base.errors import SimulationError
from ..base.optional import optional_module
from ..host.cache import compiled
from .density import Posed, Program, density, density_and_gradient

Begun: TypeAlias = tuple[Float[Array, " u"], Float[Array, ""], Float[Array, " u"]]  # a point, ln p, its gradient

ACCEPTED = 0.8  # the share of proposals that the step size aims at, as Stan's
DOUBLINGS = 8  # a trajectory has at most 2⁸ steps: whitened densities need less than ten
APART = 1.5  # standard deviations of the points where chains begin, in those of the linearized posterior
HALVINGS = 8  # of the way from the centre to where a chain begins, if a run fails there


def blackjax() -> types.ModuleType:
    """The library."""
    return optional_module("blackjax", "bayes", "posterior samples need BlackJAX")


@compiled
def chain(
    program: Program, posed: Posed, warmup: int, draws: int, begun: Begun, seed: Int[Array, ""]
) -> tuple[Float[Array, "draws u"], Float[Array, " draws"], Bool[Array, " draws"], Int[Array, " draws"]]:
    """(points, ln p, whether the trajectory diverged, how many steps it had) of one chain from where it begins, after
    `warmup` steps in which the step size is found by dual averaging."""
    mcmc = blackjax()
    kernel = mcmc.nuts.build_kernel()
    first, update, final = mcmc.adaptation.step_size.dual_averaging_adaptation(ACCEPTED)
    u, value, gradient = begun
    size = len(u)

    def step(carry, row):
        state, adaptation = carry
        key, warming = row
        length = jnp.where(warming, jnp.exp(adaptation.log_step_size), final(adaptation)).astype(u.dtype)
        state, info = kernel(
            key, state, lambda u: density(program, posed, u), length, jnp.ones(size, u.dtype), DOUBLINGS
        )
        rate = jnp.where(jnp.isfinite(info.acceptance_rate), info.acceptance_rate, 0.0)
        moved = update(adaptation, rate)
        adaptation = jax.tree.map(lambda new, old: jnp.where(warming, new, old), moved, adaptation)
        return (state, adaptation), (
            state.position, state.logdensity, info.is_divergent, info.num_integration_steps,
        )  # fmt: skip

    begin = mcmc.mcmc.hmc.HMCState(u, value, gradient)
    adaptation = jax.tree.map(lambda a: jnp.asarray(a, u.dtype), first(1.0))
    adaptation = adaptation._replace(step=jnp.asarray(adaptation.step, int))
    keys = jax.random.split(jax.random.key(seed), warmup + draws)
    warming = jnp.asarray(np.arange(warmup + draws) < warmup)
    _, found = jax.lax.scan(step, (begin, adaptation), (keys, warming))
    return jax.tree.map(lambda a: a[warmup:], found)


def begin(program: Program, posed: Posed, rng: np.random.Generator) -> Begun:
    """The start of a chain, drawn around the centre, wider than the linearized density. Returns (point, ln p, its
    gradient)."""
    u = APART * rng.standard_normal(len(posed.centre))
    for _ in range(HALVINGS):
        point = jnp.asarray(u, posed.centre.dtype)
        value, gradient = density_and_gradient(program, posed, point)
        if np.isfinite(value):
            return point, value, gradient
        u = u / 2
    raise SimulationError("the posterior cannot be sampled: runs fail all around the estimate, however close")
