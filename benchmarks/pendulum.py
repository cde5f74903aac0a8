"""The pendulum of the tutorial, compiled by jaxonomy_dae, beside the same model written by hand in Diffrax.

Prints value-and-gradient times of the tutorial's loss, the time from a cold process to the fitted network, and a
batch of 10,000 rollouts. Compile with first run and steady run are timed apart, ours and the hand-written one
alternately in one run.

    python benchmarks/pendulum.py
"""

import subprocess
import sys
import time
from pathlib import Path

import diffrax
import equinox as eqx
import handwritten
import jax
import jax.numpy as jnp
import optax

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, EqnEnv, NeuralDAEBlock, learning, simulate
from jaxonomy_dae.library.planar import PlanarPendulum

TS = jnp.array(handwritten.HORIZONS)
BATCH = 10_000


def network(t, u, theta):
    """The tutorial's 1 → 6 → 1 tanh network."""
    del t
    return handwritten.tutorial_network(u[0], theta)[None]


def network_unrolled(t, u, theta):
    """The same, unit by unit: what is best in a batch."""
    del t
    return handwritten.tutorial_network_unrolled(u[0], theta)[None]


def build(inject: str, state_selection: str, network=network):
    """The pendulum with the network's correction on vx."""
    ev = EqnEnv()
    diagram = AcausalDiagram()
    bob = PlanarPendulum(ev, name="pend", initial_theta=handwritten.RELEASE)
    diagram.add(bob)
    theta = handwritten.tutorial_weights()
    diagram.add_neural_correction_block(
        NeuralDAEBlock(network, theta, targets=[(bob, "vx")], name="drag", inject=inject)
    )
    return AcausalCompiler(ev, diagram, state_selection=state_selection)()


def tutorial_loss(system, truth):
    """Σ over the three horizons of |(vx, x) − truth|²."""
    solution = simulate(system, t1=1.5, ts=TS, rtol=handwritten.RTOL, atol=handwritten.ATOL)
    return jnp.sum((solution["pend.vx"] - truth[:, 0]) ** 2 + (solution["pend.x"] - truth[:, 1]) ** 2)


def with_weights(system, theta):
    return eqx.tree_at(lambda s: s.neural["drag"], system, theta)


def clock(functions: dict, arguments: tuple, rounds: int, calls: int) -> dict:
    """(first call, best steady call) in seconds for each function; steady calls alternate between them."""
    first, best = {}, dict.fromkeys(functions, float("inf"))
    for name, function in functions.items():
        start = time.perf_counter()
        jax.block_until_ready(function(*arguments))
        first[name] = time.perf_counter() - start
    for _ in range(rounds):
        for name, function in functions.items():
            start = time.perf_counter()
            for _ in range(calls):
                out = function(*arguments)
            jax.block_until_ready(out)
            best[name] = min(best[name], (time.perf_counter() - start) / calls)
    return {name: (first[name], best[name]) for name in functions}


def table(title: str, timings: dict, reference: str):
    print(f"\n{title}")
    print(f"{'':44s}{'compile + first':>16s}{'steady':>12s}{'ratio':>8s}")
    for name, (first, steady) in timings.items():
        ratio = steady / timings[reference][1]
        print(f"{name:44s}{first:14.2f} s{1e3 * steady:9.3f} ms{ratio:8.2f}")


def value_and_gradient():
    theta, truth = handwritten.tutorial_weights(), handwritten.tutorial_truth()
    functions = {"hand-written (diffrax.Tsit5)": jax.jit(jax.value_and_grad(handwritten.tutorial_loss))}
    for inject, selection in (("row", "dummy_derivatives"), ("equation", "dummy_derivatives"), ("equation", "auto")):
        system = build(inject, selection)
        functions[f"ours, {inject}, {selection}"] = jax.jit(
            jax.value_and_grad(lambda w, truth, system=system: tutorial_loss(with_weights(system, w), truth))
        )
    timings = clock(functions, (theta, truth), rounds=8, calls=100)
    table("Value and gradient of the tutorial's loss (the tutorial: 7200 ms)", timings, "hand-written (diffrax.Tsit5)")


def rollouts():
    angles, theta = jnp.linspace(-1.2, -0.6, BATCH), handwritten.tutorial_weights()
    stock = {"reduced": diffrax.Tsit5(), "cartesian": handwritten.ProjectedTsit5()}
    unrolled = {"reduced": handwritten.UnrolledTsit5(), "cartesian": handwritten.ProjectedUnrolledTsit5()}
    for model, inject, selection in (("reduced", "row", "dummy_derivatives"), ("cartesian", "equation", "auto")):
        functions = {}
        for label, kwargs in (
            ("diffrax.Tsit5", {"solver": stock[model]}),
            ("stages unrolled", {"solver": unrolled[model]}),
        ):
            functions[f"hand-written, {model} ({label})"] = jax.jit(
                lambda angles, theta, model=model, kwargs=kwargs: handwritten.rollouts(
                    angles, theta, model=model, batching="vmap", **kwargs
                )
            )
        system = build(inject, selection, network_unrolled)

        def ours(angles, theta, system=system):
            def one(angle):
                released = with_weights(system, theta).with_parameters({"pend.initial_theta": angle})
                solution = simulate(released, t1=1.5, ts=TS, rtol=handwritten.RTOL, atol=handwritten.ATOL)
                return solution["pend.vx"], solution["pend.x"]

            return jax.vmap(one)(angles)

        functions[f"ours, {inject}, {selection}"] = jax.jit(ours)
        timings = clock(functions, (angles, theta), rounds=6, calls=1)
        table(f"{BATCH} rollouts of 1.5 s, vmap, {model} coordinates", timings, next(iter(functions)))


def cold():
    """From a cold process to the fitted network, in a process of its own."""
    print("\nFrom a cold process to the network fitted by 25 steps (the tutorial: 180 s)")
    start = time.perf_counter()
    subprocess.run([sys.executable, str(Path(__file__)), "--fit"], check=True)
    print(f"{time.perf_counter() - start:.1f} s in all, imports included")


def fit():
    system = build("row", "dummy_derivatives")
    truth = jnp.array([[-1.03427, 0.02632], [-0.03996, -0.29260], [0.84903, -0.02937]])  # as the tutorial prints it
    outcome = learning.minimize(system, tutorial_loss, optax.adam(0.02), 25, args=(truth,), progress=False)
    print(f"best loss {outcome.best_loss:.6e} after {outcome.best_step} steps")


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    TS = jnp.array(handwritten.HORIZONS)
    if "--fit" in sys.argv:
        fit()
    else:
        print(f"jax {jax.__version__}, diffrax {diffrax.__version__}, {jax.devices()[0].device_kind}")
        cold()
        value_and_gradient()
        rollouts()
