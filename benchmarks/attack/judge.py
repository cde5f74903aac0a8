"""Right, refused or wrong: a compiled model against its independent solution."""

import gc
import re
import signal
import time

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxonomy_dae import AcausalCompiler, simulate
from jaxonomy_dae.errors import InitializationError, ModelError, SimulationError

from .case import Case, Expected
from .outcome import Outcome

# Compiling takes most of the time, and every model is run once.
CHEAP = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_backend_optimization_level": 0,
    "xla_llvm_disable_expensive_passes": True,
}


def read(system, x, names: list[str], t: float = 0.0, inputs: dict[str, float] | None = None):
    """Values of variables and d(state)/dt, by a program that XLA spends little time on."""
    arrays, static = eqx.partition(system, eqx.is_array)

    def both(arrays, x):
        whole = eqx.combine(arrays, static)
        return whole.observe(names, t, x, inputs), whole.vector_field(t, x, inputs)

    values, rates = jax.jit(both).lower(arrays, x).compile(compiler_options=CHEAP)(arrays, x)
    return np.asarray(values), np.asarray(rates)


def drop_programs() -> None:
    """Forgets what has been compiled: each program holds some memory maps, of which a process has 65,530 on Linux by
    default."""
    jax.clear_caches()
    gc.collect()


class TooLong(Exception):
    """A model took more than its time."""


def _expired(*_):
    raise TooLong


def judge(case: Case, moving: bool = False, seconds: int = 30) -> Outcome:
    """Compiles, initializes and compares; integrates as well if `moving` and the case has a motion. After so many
    seconds of processor time, it is 'late'."""
    before = signal.signal(signal.SIGVTALRM, _expired)
    signal.setitimer(signal.ITIMER_VIRTUAL, seconds)
    start = time.process_time()
    try:
        return _judge(case, moving, start)
    except TooLong:
        return Outcome("late", np.inf, f"stopped after {seconds} s", time.process_time() - start)
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.signal(signal.SIGVTALRM, before)


def _judge(case: Case, moving: bool, start: float) -> Outcome:
    def outcome(kind: str, error: float, text: str) -> Outcome:
        return Outcome(kind, error, text, time.process_time() - start)

    try:
        system = AcausalCompiler(case.ev, case.diagram)()
        offs = [_at_the_start(system, case)] if case.expected or case.refusal is not None else []
        if case.motion is not None and (moving or case.always_moves):
            offs.append(_moved(system, case) if case.slopes is None else _differentiated(system, case))
    except (ModelError, InitializationError, SimulationError) as error:
        text = f"{type(error).__name__}: {error}"
        is_true = any(re.search(word, text) for word in (*(case.refusal or ()), *case.may_refuse))
        return outcome("refused" if is_true else "untrue", np.inf, text)
    except eqx.EquinoxRuntimeError as error:
        return outcome("untrue", np.inf, f"{type(error).__name__}: {error}")
    except TooLong:
        raise
    except Exception as error:  # whatever is not the package's own
        return outcome("crashed", np.inf, f"{type(error).__name__}: {error}")
    if case.refusal is not None:
        return outcome("wrong", np.inf, "a model without a unique solution was accepted")
    worst = max(offs, key=lambda pair: pair[0])
    if not worst[0] <= 1.0:
        return outcome("wrong", worst[0], worst[1])
    if case.freedom is not None and len(system.states) != case.freedom:
        return outcome("wrong", worst[0], f"{len(system.states)} states instead of {case.freedom}: {system.states}")
    return outcome("right", worst[0], worst[1])


def _at_the_start(system, case: Case) -> tuple[float, str]:
    """The worst value or slope at the initial time, in units of what is allowed."""
    x = system.initialize(case.t0, initial={n: jnp.asarray(v) for n, v in case.initial.items()})
    found, rates = read(system, x, list(case.expected), case.t0)
    pairs = {n: (v, case.expected[n]) for n, v in zip(case.expected, found.tolist(), strict=True)}
    for name, rate in zip(system.states, rates.tolist(), strict=False):
        sign, bare = (-1.0, name[1:]) if name.startswith("-") else (1.0, name)
        if bare in case.rates:
            pairs[f"der({bare})"] = (sign * rate, case.rates[bare])
    return _worst(pairs)


def _worst(pairs: dict[str, tuple[float, Expected]]) -> tuple[float, str]:
    worst = (0.0, "")
    for name, (found, true) in pairs.items():
        error = abs(found - true.value) / true.allowed
        if not error <= worst[0]:  # NaN as well
            worst = (
                error if error == error else np.inf,
                f"{name} = {found!r}, true {true.value!r}, allowed error {true.allowed:.1e}",
            )
            if worst[0] == np.inf:
                break
    return worst


def _moved(system, case: Case) -> tuple[float, str]:
    """The worst value of the trajectory."""
    motion = case.motion
    assert motion is not None
    solution = simulate(
        system, float(motion.ts[-1]), ts=motion.ts, initial=dict(case.initial), rtol=motion.rtol, atol=motion.atol
    )
    pairs = {}
    for name, values in motion.values.items():
        for t, found, true in zip(motion.ts, np.asarray(solution[name]).tolist(), values.tolist(), strict=True):
            pairs[f"{name}({t:.17g})"] = (found, Expected(true, motion.allowed[name]))
    return _worst(pairs)


def _differentiated(system, case: Case) -> tuple[float, str]:
    """The worst derivative of the functional, in reverse mode by the default adjoint; and that in forward mode along a
    direction in which every part counts as much as its error is allowed."""
    motion, slopes = case.motion, case.slopes
    assert motion is not None and slopes is not None
    trainable, frozen = system.partition(*slopes.learned)
    arrays, static = eqx.partition(frozen, eqx.is_array)
    given = (
        {name: jnp.asarray(system.parameters[name]) for name in slopes.parameters},
        {name: jnp.asarray(case.initial[name]) for name in slopes.initial},
        trainable,
    )

    def functional(given, arrays, adjoint=None):
        # With its stages in a loop: written one after the other, as by default, they take XLA five times as long.
        parameters, initial, trainable = given
        whole = eqx.combine(trainable, arrays, static).with_parameters(parameters)
        solution = simulate(
            whole, float(motion.ts[-1]), ts=motion.ts, initial={**case.initial, **initial}, adjoint=adjoint,
            solver=diffrax.Tsit5(), rtol=motion.rtol, atol=motion.atol,
        )  # fmt: skip
        return sum(jnp.vdot(jnp.asarray(w), solution[name]) for name, w in slopes.weights.items())

    def run(function, *args):
        return jax.jit(function).lower(*args).compile(compiler_options=CHEAP)(*args)

    value, (by_parameter, by_start, by_weight) = run(jax.value_and_grad(functional), given, arrays)
    pairs = {"the functional": (float(value), slopes.value)}
    for found, true in ((by_parameter, slopes.parameters), (by_start, slopes.initial)):
        pairs |= {f"the derivative by {name}": (float(found[name]), true[name]) for name in true}
    for name, true in slopes.learned.items():
        found = np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(by_weight.neural[name])])
        pairs |= {f"the derivative by weight {k} of {name}": (float(found[k]), true[k]) for k in range(len(true))}

    weight = max((1.0 / true[0].allowed for true in slopes.learned.values()), default=0.0)
    direction = (
        {name: jnp.asarray(1.0 / true.allowed) for name, true in slopes.parameters.items()},
        {name: jnp.asarray(1.0 / true.allowed) for name, true in slopes.initial.items()},
        jax.tree.map(lambda leaf: jnp.full_like(leaf, weight), trainable),
    )
    products = jax.tree.map(lambda g, d: float(jnp.vdot(g, d)), (by_parameter, by_start, by_weight), direction)

    def forward(given, arrays):
        return jax.jvp(lambda g: functional(g, arrays, diffrax.ForwardMode()), (given,), (direction,))[1]

    # Each part is off by one at most, if its error is what is allowed.
    parts = len(slopes.parameters) + len(slopes.initial) + sum(map(len, slopes.learned.values()))
    pairs["the derivative in forward mode, against reverse mode,"] = (
        float(run(forward, given, arrays)),
        Expected(sum(jax.tree.leaves(products)), float(parts)),
    )
    return _worst(pairs)
