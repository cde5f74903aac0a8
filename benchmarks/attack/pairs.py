"""Two models in one process that differ in units, nominal values or parameters only, in both orders.

What is compiled for one of them is cached, and may serve the other. Everything that is said of a model (states, start,
report, typical sizes, slopes, all variables) must be what a process of its own says, to the last bit.
"""

import functools
import hashlib
import math
import multiprocessing
import time
from typing import Any

import numpy as np

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, EqnEnv, der

from .outcome import Outcome

DIFFERENT = ("unit", "nominal", "parameter", "start")
UNITS = ("m", "km", "mm", "um")
ORDERS = ((0,), (1,), (0, 1), (1, 0))


class Part(Component):
    """A few rates and cubic equations. Starts of states are guesses; those of the first links are fixed, which is less
    than determines the states."""

    def __init__(self, ev, name, n, links, numbers, starts, units, nominals):
        super().__init__(ev, name)
        y, z = [], []
        for k in range(n):
            given: dict[str, Any] = {"unit": units[k]} if units[k] else {}
            given |= {"nominal": nominals[k]} if nominals[k] else {}
            y.append(self.variable(f"y{k}", start=starts[k], **given))
        for k, (i, j, cubic) in enumerate(links):
            z.append(self.variable(f"z{k}", start=starts[n + k], fixed=k == 0))
            p = self.parameter(f"p{k}", numbers[k])
            law = z[k] + p * z[k] ** 3 if cubic else p * z[k]
            self.add_equations(law - y[i] + y[j])
        for k in range(n):
            flow = sum((z[m] if i == k else -z[m]) for m, (i, j, _) in enumerate(links) if k in (i, j) and i != j)
            self.add_equations(der(y[k]) + 0.3 * y[k] + flow)


def make(seed: int, which: int):
    """The first or the second model of a pair, and in what they differ."""
    rng = np.random.default_rng([seed, 17])
    n, m = int(rng.integers(2, 4)), int(rng.integers(1, 3))
    links = [(*map(int, rng.choice(n, 2, replace=False)), bool(rng.random() < 0.7)) for _ in range(m)]
    different = DIFFERENT[int(rng.integers(len(DIFFERENT)))]
    numbers, starts = 10.0 ** rng.uniform(-3, 3, m), rng.uniform(-2, 2, n + m)
    units = [UNITS[int(rng.integers(len(UNITS)))] if different == "unit" else "" for _ in range(n)]
    nominals = [float(10 ** rng.uniform(-6, 6)) if different == "nominal" else 0.0 for _ in range(n)]
    if which:
        if different == "unit":
            units = [UNITS[int(rng.integers(len(UNITS)))] for _ in range(n)]
        elif different == "nominal":
            nominals = [float(10 ** rng.uniform(-6, 6)) for _ in range(n)]
        elif different == "parameter":
            numbers = numbers * 10.0 ** rng.uniform(-6, 6, m)
        else:
            starts = starts * 10.0 ** rng.uniform(-6, 6, n + m)
    part = Part(EqnEnv(), "c", n, links, numbers.tolist(), starts.tolist(), units, nominals)
    return part, different


def everything(part: Component) -> dict[str, Any]:
    """What is said of a model: texts and numbers, these in hexadecimal."""
    import jax

    system = AcausalCompiler(part.ev, AcausalDiagram().add(part))()
    out: dict[str, Any] = {"states": system.states, "report": str(system.report), "shown": repr(system)}

    def exact(values) -> list[str]:
        return [float(v).hex() for v in np.ravel(np.asarray(values))]

    out["typical sizes"] = exact(system.typical_sizes)
    try:
        x = system.initialize()
    except Exception as error:
        return out | {"start": f"{type(error).__name__}: {error}"}
    out["start"] = exact(x)
    out["report of the start"] = str(system.initialization_report())
    names = system.variables
    values, rates = jax.jit(lambda s, x: (s.observe(names, 0.0, x), s.vector_field(0.0, x)))(system, x)
    return out | {"variables": exact(values), "slopes": exact(rates)}


def in_order(seed: int, order: tuple[int, ...]) -> tuple[list[dict[str, Any]], float]:
    """What is said of the models of a pair, one after the other; and processor time."""
    start = time.process_time()
    return [everything(make(seed, which)[0]) for which in order], time.process_time() - start


@functools.cache
def _fresh_processes():
    """A pool whose processes have imported everything, and run one task each."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["benchmarks.attack.pairs"])
    return context.Pool(1, maxtasksperchild=1)


def judged(seed: int) -> tuple[str, list[Outcome]]:
    """What a pair differs in, and whether anything depends on the order."""
    _, different = make(seed, 0)
    found, seconds = {}, 0.0
    for order in ORDERS:
        said, spent = _fresh_processes().apply(in_order, (seed, order))
        seconds += spent
        for which, one in zip(order, said, strict=True):
            found[order, which] = one
    faults = []
    for order in ORDERS[2:]:
        for which in order:
            alone, here = found[(which,), which], found[order, which]
            faults += [
                f"model {which} in order {order}, {key}: {here.get(key)!r:.150}, alone {alone[key]!r:.150}"
                for key in alone
                if here.get(key) != alone[key]
            ]
    refused = any(isinstance(one.get("start"), str) for one in found.values())
    kind = "wrong" if faults else "refused" if refused else "right"
    text = "; ".join(faults) or str(found[(0,), 0].get("start"))
    digest = hashlib.sha256(str(found[(0,), 0]).encode()).hexdigest()[:8]
    return f"{different}, {digest}", [Outcome(kind, math.inf if faults else 0.0, text, seconds)]
