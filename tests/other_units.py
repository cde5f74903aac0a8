"""A model against itself in other units: verdict, states, start, slopes."""

import contextlib
import dataclasses
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from attack.judge import read
from rescaling import KINDS, new_name, rescaled

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, AcausalSystem, EqnEnv
from jaxonomy_dae.compile.model.tables import FlatModel
from jaxonomy_dae.compile.passes.flatten import flatten
from jaxonomy_dae.errors import InitializationError, ModelError, StructuralError

# What a value may be off by, relative to the largest of its unit; slopes, relative to the fastest.
TOLERANCE = 1e-9
INPUT = 0.7  # the value of inputs without a default


@dataclasses.dataclass(frozen=True)
class Pair:
    """A compiled model, the same in other units, and the old value of a variable whose new one is 1."""

    old: AcausalSystem
    new: AcausalSystem
    factor: dict[str, float]

    def old_quantities(self, names: list[str]) -> list[tuple[int, int, float]]:
        """For each new state: the old quantity, its value where the old variable of that name is 1, and the value of
        that variable where the new one is 1."""
        back = {new_name(n): n for n in self.factor}
        out = []
        for name in names:
            sign, bare = (-1, name[1:]) if name.startswith("-") else (1, name)
            order = bare.count("der(")
            variable = back[bare.replace("der(", "").replace(")", "")]
            quantity, alias = self.old.plan.variable_map[self.old.plan.variable_index[variable]]
            out.append((quantity + order, sign / alias if alias else 0.0, self.factor[variable]))
        return out


Compiled = tuple[AcausalCompiler, AcausalSystem | ModelError]


@contextlib.contextmanager
def watched() -> Iterator[list[Compiled]]:
    """All models that are compiled meanwhile: compilers, and systems or errors."""
    seen: list[Compiled] = []
    plain = AcausalCompiler.__call__

    def call(self: AcausalCompiler) -> AcausalSystem:
        try:
            system = plain(self)
        except ModelError as error:
            seen.append((self, error))
            raise
        seen.append((self, system))
        return system

    AcausalCompiler.__call__ = call
    try:
        yield seen
    finally:
        AcausalCompiler.__call__ = plain


def outcome(build: Callable[[], AcausalSystem]) -> Compiled:
    """The compiler of a model, with its system or the error that refuses it."""
    with watched() as seen:
        with contextlib.suppress(ModelError):
            build()
    return seen[-1]


def is_rescalable(compiler: AcausalCompiler) -> bool:
    """Whether there are equations to rescale: what is wrong is not found before."""
    try:
        flatten(compiler.diagram)
    except ModelError:
        return False
    return True


def compare_verdicts(
    compiler: AcausalCompiler, old: AcausalSystem | ModelError, kind: str, seed: int, shuffled: bool = False
) -> Pair | None:
    """Compiles the model in other units: it must be refused if `old` is an error, or else have the same states.
    Returns both systems, if there are any."""
    flat = flatten(compiler.diagram)
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    ev, diagram, factors = rescaled(rng, flat, kind, shuffled)
    preferred = [new_name(n) for name in compiler.prefer_states for n in _entries(flat, name)]

    def compiled(ev: EqnEnv, diagram: AcausalDiagram) -> AcausalSystem | ModelError:
        try:
            return AcausalCompiler(ev, diagram, state_selection=compiler.state_selection, prefer_states=preferred)()
        except ModelError as error:
            return error

    new = compiled(ev, diagram)
    if isinstance(old, ModelError) and len(flat.events):
        # What is written again has no events. Where they are not the reason, its equations are refused in any units.
        old = compiled(*rescaled(rng, flat, "none", shuffled=False)[:2])
        if not isinstance(old, ModelError):
            assert not isinstance(new, ModelError), f"{kind} {seed}: in new units {new}"
            return None
    if isinstance(old, StructuralError) and not isinstance(new, ModelError):
        # What depends on the point may be refused when it is compiled, or at the start.
        with pytest.raises(InitializationError):
            new.initialize()
        return None
    if isinstance(old, ModelError) or isinstance(new, ModelError):
        assert type(old) is type(new), f"{kind} {seed}: in old units {old}\nin new units {new}"
        return None
    pair = Pair(old, new, dict(zip(flat.variables.names, factors.variable.tolist(), strict=True)))
    states = sorted(q for q, _, _ in pair.old_quantities(new.states))
    assert states == sorted(old.plan.states.tolist()), f"{kind} {seed}: {old.states} in new units {new.states}"
    freedom = old.report.degrees_of_freedom, new.report.degrees_of_freedom
    assert freedom[0] == freedom[1], f"{kind} {seed}: {freedom} degrees of freedom, {old.states}, {new.states}"
    return pair


def _entries(flat: FlatModel, name: str) -> list[str]:
    """The full names that a name, or that of an array, stands for."""
    ids = flat.arrays.variables(name)
    return [name] if ids is None else [flat.variables.names[v] for v in ids.reshape(-1).tolist()]


def compare_starts(pair: Pair, t0: float = 0.0):
    """Initializes both: both must start, with the same values and slopes, or neither."""
    old, new, factor = pair.old, pair.new, pair.factor
    of_input = {n: INPUT for n, v in zip(old.plan.inputs.names, old.plan.inputs.defaults, strict=True) if v is None}
    results = []
    for system, inputs in ((old, of_input), (new, {new_name(n): v / factor[n] for n, v in of_input.items()})):
        try:
            results.append((system.initialize(t0, inputs=inputs), inputs))
        except InitializationError as error:
            results.append((error, inputs))
    (x, inputs), (y, new_inputs) = results
    if isinstance(x, InitializationError) or isinstance(y, InitializationError):
        assert type(x) is type(y), f"in old units {x}\nin new units {y}"
        return
    names = [n for n in old.variables if n not in old.inputs]
    expected, slopes = read(old, x, names, t0, inputs)
    found, new_slopes = read(new, y, [new_name(n) for n in names], t0, new_inputs)
    unit = dict(zip(old.plan.flat.variables.names, old.plan.flat.variables.unit, strict=True))
    back = found * np.array([factor[n] for n in names])
    size = {u: max(abs(v) for n, v in zip(names, expected, strict=True) if unit[n] == u) for u in set(unit.values())}
    wrong = [
        f"{n} = {b!r}, in old units {a!r}"
        for n, a, b in zip(names, expected.tolist(), back.tolist(), strict=True)
        if not abs(a - b) <= TOLERANCE * size[unit[n]]
    ]
    assert not wrong, "; ".join(wrong)
    place = {int(q): k for k, q in enumerate(old.plan.states)}
    fastest = np.max(np.abs(slopes[: len(place)]), initial=0.0)
    for k, (quantity, sign, s) in enumerate(pair.old_quantities(new.states)):
        if quantity not in place:
            continue
        a, b = float(slopes[place[quantity]]), sign * s * float(new_slopes[k])
        assert abs(a - b) <= TOLERANCE * fastest, f"the slope of {new.states[k]} is {b}, in old units {a}"
