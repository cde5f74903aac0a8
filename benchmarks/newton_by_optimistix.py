"""What the modified Newton iteration of BDF would cost as an `optimistix.AbstractRootFinder`.

The same iteration for Robertson's equations with algebraic conservation, once as `lax.while_loop` with a derivative by
the implicit function theorem, as `solve/methods/newton.py` has it, and once behind `optimistix.root_find` with its
implicit adjoint. Prints, forward and for the gradient of a scan over steps: lines of StableHLO, CPU seconds of tracing
and of compilation, CPU microseconds of a step, and whether the program calls back to the host.

    python benchmarks/newton_by_optimistix.py
"""

import time
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx

MASS = (1.0, 1.0, 0.0)
WEIGHT = (1e6, 1e8, 1e6)
STEPS = {"forward": 20_000, "gradient": 2_000}
REPETITIONS = 6


def right(y, k):
    a, b, c = y
    return jnp.stack([-k[0] * a + k[2] * b * c, k[0] * a - k[2] * b * c - k[1] * b * b, a + b + c - 1])


def residual(y, args):
    predicted, cj, k = args
    return jnp.array(MASS) * cj * (y - predicted) - right(y, k)


def judged(change, m, first, contraction):
    """(first size, contraction, done, failed) after a change, as in BDF."""
    size = jnp.sqrt(jnp.mean((change * jnp.array(WEIGHT)) ** 2))
    first = jnp.where(m == 0, size, first)
    rate = jnp.where(m == 0, 0.0, (size / jnp.where(first == 0, 1, first)) ** (1 / jnp.maximum(m, 1)))
    failed = ~jnp.isfinite(size) | (rate > 0.9)
    contraction = jnp.where((m == 0) | failed, contraction, rate / (1 - rate))
    return first, contraction, (contraction * size <= 0.1) & ~failed & (m > 0), failed


def own(args, factor):
    @eqx.filter_custom_jvp
    def root(args, factor):
        def body(carry):
            y, m, first, contraction, _, _ = carry
            change = -factor @ residual(y, args)
            return y + change, m + 1, *judged(change, m, first, contraction)

        start = args[0], 0, 0.0, 100.0, False, False
        y, m, *_ = jax.lax.while_loop(lambda c: ~c[4] & ~c[5] & (c[1] < 6), body, start)
        return y, m

    @root.def_jvp
    def _(primals, tangents):
        args, factor = primals
        y, m = root(args, factor)
        _, moved = eqx.filter_jvp(lambda a: residual(y, a), (args,), (tangents[0],))
        return (y, m), (jnp.linalg.solve(jax.jacfwd(lambda v: residual(v, args))(y), -moved), None)

    return root(args, factor)[0]


class Chord(optx.AbstractRootFinder):
    """The same iteration."""

    rtol: float = 1e-6
    atol: float = 1e-8
    norm: Any = optx.max_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        zero, no = jnp.array(0.0), jnp.array(False)
        return jnp.array(0), zero, zero + 100.0, no, no, options["factor"]

    def step(self, fn, y, args, options, state, tags):
        m, first, contraction, _, _, factor = state
        value, aux = fn(y, args)
        change = -factor @ value
        return y + change, (m + 1, *judged(change, m, first, contraction), factor), aux

    def terminate(self, fn, y, args, options, state, tags):
        *_, done, failed, _ = state
        return done | failed, optx.RESULTS.where(failed, optx.RESULTS.nonlinear_divergence, optx.RESULTS.successful)

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        return y, aux, {}


def by_optimistix(args, factor):
    options = dict(factor=factor)
    return optx.root_find(residual, Chord(), args[0], args, options=options, max_steps=6, throw=False).value


def end(solve, k, steps):
    """The solution after many steps."""

    def step(y, _):
        cj = jnp.array(1e4)
        factor = jnp.linalg.inv(jnp.diag(jnp.array(MASS)) * cj - jax.jacfwd(lambda v: right(v, k))(y))
        return solve((y, cj, k), jax.lax.stop_gradient(factor)), None

    return jax.lax.scan(step, jnp.array([1.0, 0.0, 0.0]), None, length=steps)[0]


def clocked(function):
    start = time.process_time()
    out = jax.block_until_ready(function())
    return out, time.process_time() - start


def main():
    jax.config.update("jax_enable_x64", True)
    k = jnp.array([0.04, 3e7, 1e4])
    for mode, steps in STEPS.items():
        for solve in (own, by_optimistix):

            def value(k, solve=solve, steps=steps):
                return end(solve, k, steps)

            function = value if mode == "forward" else jax.grad(lambda k, value=value: value(k)[1])
            tracing, compiling = [], []
            for _ in range(REPETITIONS):
                jax.clear_caches()
                lowered, seconds = clocked(lambda f=function: jax.jit(f).lower(k))
                tracing.append(seconds)
                start = time.process_time()
                compiled = lowered.compile()
                compiling.append(time.process_time() - start)
            running = min(clocked(lambda c=compiled: c(k))[1] for _ in range(REPETITIONS))
            text = lowered.as_text()
            print(
                f"{mode:9} {solve.__name__:14} {len(text.splitlines()):4} lines; "
                f"tracing {min(tracing):.2f} s, compiling {min(compiling):.2f} s, "
                f"{1e6 * running / steps:.2f} µs a step; callbacks: {'callback' in text}"
            )


if __name__ == "__main__":
    main()
