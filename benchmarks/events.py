"""A batch of bouncing balls, value and gradient: one solve with events, the same without events, and an outer loop of
`diffrax.diffeqsolve(event=...)`, which is what one writes by hand.

    python -m benchmarks.events [members]

The balls fall from 1 m, with restitutions of 0.75 to 0.9, and bounce for 2.6 s. Times are the best of five, compilation
apart, all in one process. Heights and gradients of both ways are compared.
"""

import sys
import time

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, AcausalSystem, Component, EqnEnv, der, pre, reinit, simulate
from jaxonomy_dae.write import Eq

END, MOST = 2.6, 10
RTOL, ATOL = 1e-8, 1e-10


class Ball(Component):
    """A ball that bounces, or falls through the floor."""

    def __init__(self, ev: EqnEnv, bounces: bool):
        super().__init__(ev, "ball")
        e, g = self.parameter("e", 0.8), self.parameter("g", 9.81)
        h, v = self.variable("h", start=1.0, fixed=True), self.variable("v", start=0.0, fixed=True)
        self.add_equations(Eq(der(h), v), Eq(der(v), -g))
        if bounces:
            self.when(h <= 0, reinit(v, -e * pre(v)), reinit(h, 0))


def ball(bounces: bool) -> AcausalSystem:
    """The model."""
    ev, diagram = EqnEnv(), AcausalDiagram()
    diagram.add(Ball(ev, bounces))
    return AcausalCompiler(ev, diagram)()


def height(system: AcausalSystem, p):
    """The height at the end, for a restitution and gravity p."""
    changed = system.with_parameters({"ball.e": p[0], "ball.g": p[1]})
    solution = simulate(
        changed, END, ts=jnp.array([END]), rtol=RTOL, atol=ATOL, max_events=MOST, solver=diffrax.Tsit5()
    )
    return solution["ball.h"][-1]


def by_hand(p):
    """The same by solves that end at events, one after another."""
    term = diffrax.ODETerm(lambda t, y, p: jnp.stack([y[1], -p[1]]))
    finder = optx.Newton(rtol=1e-12, atol=1e-12)
    event = diffrax.Event(lambda t, y, args, **_: y[0], finder, direction=False)
    control = diffrax.PIDController(rtol=RTOL, atol=ATOL)

    def segment(carry, _):
        t, y = carry
        solved = diffrax.diffeqsolve(
            term, diffrax.Tsit5(), t, END, 1e-2, y, p, event=event, stepsize_controller=control, throw=False
        )
        t1, y1 = solved.ts[0], solved.ys[0]
        hit = solved.result == diffrax.RESULTS.event_occurred
        y1 = jnp.where(hit, jnp.stack([jnp.asarray(1e-14), -p[0] * y1[1]]), y1)
        over = t >= END
        return (jnp.where(over, t, t1), jnp.where(over, y, y1)), None

    (_, y), _ = jax.lax.scan(segment, (jnp.zeros(()), jnp.array([1.0, 0.0])), length=MOST)
    return y[0]


def timed(function, given):
    """(seconds of the first call, best of five after it, result)."""
    start = time.perf_counter()
    out = jax.block_until_ready(function(given))
    first, best = time.perf_counter() - start, float("inf")
    for _ in range(5):
        start = time.perf_counter()
        out = jax.block_until_ready(function(given))
        best = min(best, time.perf_counter() - start)
    return first, best, out


def main():
    jax.config.update("jax_enable_x64", True)
    members = int(sys.argv[1]) if len(sys.argv) > 1 else 10_000
    e = jnp.linspace(0.75, 0.9, members)
    given = jnp.stack([e, jnp.full_like(e, 9.81)], axis=1)
    runs = {
        "one solve with events": lambda p: height(bouncing, p),
        "without events": lambda p: height(falling, p),
        "outer loop by hand": by_hand,
    }
    bouncing, falling = ball(True), ball(False)
    found = {}
    print(f"{members} balls, value and gradient")
    print(f"{'':24s}{'first':>10s}{'steady':>12s}")
    for name, run in runs.items():
        function = eqx.filter_jit(jax.vmap(jax.value_and_grad(run)))
        first, best, found[name] = timed(function, given)
        print(f"{name:24s}{first:9.2f}s{1e3 * best:10.1f}ms", flush=True)
    ours, theirs = found["one solve with events"], found["outer loop by hand"]
    print(f"largest difference of heights {jnp.abs(ours[0] - theirs[0]).max():.1e}, ", end="")
    print(f"of gradients {jnp.abs(ours[1] - theirs[1]).max():.1e}")


if __name__ == "__main__":
    main()
