"""Right, refused or wrong: a compiled model against its independent solution."""

import gc
import re
import signal
import time
from collections.abc import Callable, Mapping
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxonomy_dae import AcausalCompiler, AcausalSystem, simulate
from jaxonomy_dae.errors import InitializationError, ModelError, SimulationError
from jaxonomy_dae.host.cache import PROGRAMS

from .case import Case, Expected, Motion, Slopes, Variant
from .outcome import Outcome

# Compiling takes most of the time, and every model is run once.
CHEAP = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_backend_optimization_level": 0,
    "xla_llvm_disable_expensive_passes": True,
}

LISTED = 100  # events for which `simulate` has room at first: for more, it makes another program


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


def judge(case: Case, moving: bool = False, seconds: int = 60) -> list[Outcome]:
    """Compiles, initializes and compares; integrates as well if `moving` and the case has a motion. After so many
    seconds of processor time, it is 'late'. One outcome for the case, and one for each of its variants: these are run
    by the programs at hand, with other parameters, and are wrong where something is compiled anew."""
    subject = _Subject(case)
    outcomes = [_timed(lambda: subject.judged(moving), case, seconds)]
    if subject.system is not None:
        outcomes += [_timed(lambda v=v: subject.varied(v), case, seconds) for v in case.variants]
    return outcomes


def timed(judged: Callable[[], tuple[str, list[Outcome]]], seconds: int = 60) -> tuple[str, list[Outcome]]:
    """What a family says that judges its own models; 'late' after so many seconds of processor time, 'crashed' by an
    error."""
    start = time.process_time()
    before = signal.signal(signal.SIGVTALRM, _expired)
    signal.setitimer(signal.ITIMER_VIRTUAL, seconds)
    try:
        return judged()
    except TooLong:
        return "", [Outcome("late", np.inf, f"stopped after {seconds} s", time.process_time() - start)]
    except Exception as error:
        return "", [Outcome("crashed", np.inf, f"{type(error).__name__}: {error}", time.process_time() - start)]
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.signal(signal.SIGVTALRM, before)


def _timed(offs: Callable[[], list[tuple[float, str]]], case: Case, seconds: int) -> Outcome:
    before = signal.signal(signal.SIGVTALRM, _expired)
    signal.setitimer(signal.ITIMER_VIRTUAL, seconds)
    start = time.process_time()
    try:
        return _judge(offs, case, start)
    except TooLong:
        return Outcome("late", np.inf, f"stopped after {seconds} s", time.process_time() - start)
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.signal(signal.SIGVTALRM, before)


class _Subject:
    """A case, its system once compiled, and what its programs are called by."""

    def __init__(self, case: Case):
        self.case = case
        self.system: AcausalSystem | None = None
        self.gradients: _Gradients | None = None
        self.solvers: set[str] = set()

    def judged(self, moving: bool) -> list[tuple[float, str]]:
        """The errors of the case."""
        case = self.case
        system = self.system = AcausalCompiler(case.ev, case.diagram)()
        if case.freedom is not None and case.refusal is None and len(system.states) != case.freedom:
            return [(np.inf, f"{len(system.states)} states instead of {case.freedom}: {system.states}")]
        offs = [_at_the_start(system, case)] if case.expected or case.refusal is not None else []
        if case.motion is not None and (moving or case.always_moves):
            if case.slopes is None:
                offs.append(self._moved(system, case.motion, case.initial))
            else:
                self.gradients = _Gradients(system, case.initial, case.motion, case.slopes)
                offs.append(self.gradients.off(system, case.initial, case.motion, case.slopes))
                if case.slopes.forward:
                    offs.append(self.gradients.off_forwards(case.slopes))
        return offs

    def varied(self, variant: Variant) -> list[tuple[float, str]]:
        """The errors of a variant."""
        assert self.system is not None
        system = self.system.with_parameters(variant.parameters)
        if self.gradients is not None:
            assert variant.slopes is not None
            return [self.gradients.off(system, variant.initial, variant.motion, variant.slopes)]
        return [self._moved(system, variant.motion, variant.initial)]

    def _moved(self, system: AcausalSystem, motion: Motion, initial: Mapping[str, float]) -> tuple[float, str]:
        """The worst value of the trajectory."""
        programs = len(PROGRAMS)
        solution = simulate(
            system, float(motion.ts[-1]), ts=motion.ts, initial=dict(initial), rtol=motion.rtol, atol=motion.atol
        )
        if solution.solver in self.solvers and len(PROGRAMS) > programs and len(solution.events) <= LISTED:
            return np.inf, f"compiled anew for other parameters, with {solution.solver}"
        self.solvers.add(solution.solver)
        pairs = {}
        for name, values in motion.values.items():
            for t, found, true in zip(motion.ts, np.asarray(solution[name]).tolist(), values.tolist(), strict=True):
                pairs[f"{name}({t:.17g})"] = (found, Expected(true, motion.allowed[name]))
        return _worst(pairs)


def _judge(offs_of: Callable[[], list[tuple[float, str]]], case: Case, start: float) -> Outcome:
    def outcome(kind: str, error: float, text: str) -> Outcome:
        return Outcome(kind, error, text, time.process_time() - start)

    try:
        offs = offs_of()
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


class _Gradients:
    """The derivatives of a case's functional, by programs that are compiled once for all its variants.

    In reverse mode by the default adjoint; and in forward mode along a direction in which every part counts as much as
    its error is allowed.
    """

    def __init__(self, system: AcausalSystem, initial: Mapping[str, float], motion: Motion, slopes: Slopes):
        self.of, self.learned, self.starts = tuple(slopes.parameters), tuple(slopes.learned), tuple(slopes.initial)
        trainable, frozen = system.partition(*self.learned)
        _, static = eqx.partition(frozen, eqx.is_array)
        weights = {name: jnp.asarray(w) for name, w in slopes.weights.items()}

        def functional(given, arrays, others, ts, adjoint=None):
            # With its stages in a loop: written one after the other, as by default, they take XLA five times as long.
            parameters, initial, trainable = given
            whole = eqx.combine(trainable, arrays, static).with_parameters(parameters)
            solution = simulate(
                whole, ts[-1], ts=ts, initial={**others, **initial}, adjoint=adjoint, solver=diffrax.Tsit5(),
                rtol=motion.rtol, atol=motion.atol,
            )  # fmt: skip
            return sum(jnp.vdot(w, solution[name]) for name, w in weights.items())

        def forward(given, direction, *rest):
            return jax.jvp(lambda g: functional(g, *rest, diffrax.ForwardMode()), (given,), (direction,))[1]

        self.args = self._args(system, initial, motion)
        self.reverse: Any = jax.jit(jax.value_and_grad(functional)).lower(*self.args).compile(compiler_options=CHEAP)
        self.forward, self.found = jax.jit(forward), None

    def _args(self, system: AcausalSystem, initial: Mapping[str, float], motion: Motion) -> tuple[Any, ...]:
        trainable, frozen = system.partition(*self.learned)
        arrays, _ = eqx.partition(frozen, eqx.is_array)
        given = (
            {name: jnp.asarray(system.parameters[name]) for name in self.of},
            {name: jnp.asarray(initial[name]) for name in self.starts},
            trainable,
        )
        return given, arrays, {name: jnp.asarray(v) for name, v in initial.items()}, jnp.asarray(motion.ts)

    def off(self, system: AcausalSystem, initial: Mapping[str, float], motion: Motion, slopes: Slopes):
        """The worst part in reverse mode, and where."""
        value, found = self.reverse(*self._args(system, initial, motion))
        by_parameter, by_start, by_weight = self.found = found
        pairs = {"the functional": (float(value), slopes.value)}
        for parts, true in ((by_parameter, slopes.parameters), (by_start, slopes.initial)):
            pairs |= {f"the derivative by {name}": (float(parts[name]), true[name]) for name in true}
        for name, true in slopes.learned.items():
            weights = np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(by_weight.neural[name])])
            pairs |= {f"the derivative by weight {k} of {name}": (float(weights[k]), t) for k, t in enumerate(true)}
        return _worst(pairs)

    def off_forwards(self, slopes: Slopes) -> tuple[float, str]:
        """What forward mode differs by from the derivatives found last."""
        weight = max((1.0 / true[0].allowed for true in slopes.learned.values()), default=0.0)
        direction = (
            {name: jnp.asarray(1.0 / true.allowed) for name, true in slopes.parameters.items()},
            {name: jnp.asarray(1.0 / true.allowed) for name, true in slopes.initial.items()},
            jax.tree.map(lambda leaf: jnp.full_like(leaf, weight), self.args[0][2]),
        )
        products = jax.tree.map(lambda g, d: float(jnp.vdot(g, d)), self.found, direction)
        args = self.args[0], direction, *self.args[1:]
        found = float(self.forward.lower(*args).compile(compiler_options=CHEAP)(*args))
        # Each part is off by one at most, if its error is what is allowed.
        parts = len(slopes.parameters) + len(slopes.initial) + sum(map(len, slopes.learned.values()))
        true = Expected(sum(jax.tree.leaves(products)), float(parts))
        return _worst({"the derivative in forward mode, against reverse mode,": (found, true)})
