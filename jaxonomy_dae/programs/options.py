"""How XLA compiles programs that run once."""

import functools

import jax
import jax.numpy as jnp

# XLA's older code generator for CPUs makes one kernel of what the newer one makes several. Of the tutorial's pendulum,
# a program takes 290 mappings, 66 MB and 4.5 s instead of 802, 234 MB and 8.8 s; of a double pendulum 679, 196 MB and
# 18 s instead of 1,702, 476 MB and 27 s. It runs in the same time (4.4 ms a call), and 1.25 times as long (49 ms): what
# is saved is spent after some hundred calls. (jax 0.10.2, two cores.)
_QUICK = {"xla_cpu_use_fusion_emitters": False}


@functools.cache
def quick() -> dict[str, bool]:
    """Options of `jax.jit` for a program of which compilation takes longer than its runs; none on other processors."""
    if jax.default_backend() != "cpu":
        return {}
    try:
        jax.jit(jnp.negative, compiler_options=_QUICK).lower(0.0).compile()
    except Exception:  # an XLA without the older code generator: JAX promises no type of error
        return {}
    return _QUICK
