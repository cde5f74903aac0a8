"""Letter b: eager, jit, vmap over one and many, jit(vmap), a loop, inside a gradient; members of a batch of which some
fail."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

from jaxonomy_dae import simulate

from .said import ALONG, REFUSALS, TOLERANCES, Pairs, Said, difference, said, times
from .subject import Subject, subject

INSIDE = ("jit", "vmap", "vmap of one", "jit(vmap)", "map", "grad")
DRAWN = 2  # ways inside, for one model


@dataclasses.dataclass(frozen=True)
class Member:
    """What differs between runs of one program: parameters, starts, samples of inputs."""

    parameters: Mapping[str, Any]
    initial: Mapping[str, Any]
    inputs: Mapping[str, Any]
    what: str = "ordinary"

    @property
    def tree(self):
        return {k: np.float64(v) for k, v in self.parameters.items()}, dict(self.initial), self.samples()[0]

    def samples(self):
        """Arrays of samples, and the kinds of interpolation."""
        arrays = {k: v[:2] if isinstance(v, tuple) else v for k, v in self.inputs.items()}
        kinds = {k: v[2:] for k, v in self.inputs.items() if isinstance(v, tuple)}
        return arrays, kinds


def members_of(s: Subject, rng: np.random.Generator) -> list[Member]:
    """Three ordinary ones, and one or two that fail, in random order."""
    found = [Member(values, s.initial, s.inputs) for values in s.values]
    if not s.values[0] and s.initial:
        starts = list(s.initial)
        for k in (1, 2):
            factor = {n: float(rng.uniform(0.95, 1.05)) for n in starts}
            found[k] = dataclasses.replace(found[k], initial={n: v * factor[n] for n, v in s.initial.items()})
    base = found[0]
    failing = []
    if base.parameters:
        name = list(base.parameters)[int(rng.integers(len(base.parameters)))]
        failing.append(dataclasses.replace(base, parameters={**base.parameters, name: np.nan}, what=f"{name} is NaN"))
        for grows in (n for n in base.parameters if s.sketch is not None and "grows" in s.note and ".k" in n):
            failing.append(dataclasses.replace(base, parameters={**base.parameters, grows: 9.0}, what=f"{grows} = 9"))
    for name, (low, high) in s.bounds.items():
        value = high * 2 if rng.random() < 0.5 else low - 1
        failing.append(
            dataclasses.replace(
                base, parameters={**base.parameters, name: value}, what=f"{name} = {value}, out of bounds"
            )
        )
    for name, value in s.inputs.items():
        if isinstance(value, tuple):
            short = (value[0] * 0.5, *value[1:])
            failing.append(dataclasses.replace(base, inputs={**base.inputs, name: short}, what="samples end too early"))
            holed = (value[0], np.where(np.arange(len(value[1])) == 2, np.nan, value[1]), *value[2:])
            failing.append(dataclasses.replace(base, inputs={**base.inputs, name: holed}, what="a sample is NaN"))
    for k in rng.permutation(len(failing))[:2]:
        found.append(failing[k])
    return [found[k] for k in rng.permutation(len(found))]


def runner(s: Subject, ts: np.ndarray, kinds: Mapping[str, tuple], names: list[str]) -> Callable:
    """(values, result code) by a member's tree."""

    def run(tree, **options):
        parameters, initial, arrays = tree
        inputs = {k: (*v, *kinds.get(k, ())) if isinstance(v, tuple) else v for k, v in arrays.items()}
        system = s.system.with_parameters(parameters) if parameters else s.system
        solution = simulate(system, s.end, ts=ts, initial=initial, inputs=inputs, **TOLERANCES, **options)
        return jnp.stack([jnp.asarray(solution[n]) for n in names]), solution.result

    return run


def code(result: Any) -> np.ndarray:
    """A result, or a batch of them, as numbers."""
    return np.asarray(result._value)


def batched(trees: list[Any]) -> Any:
    return jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(leaf) for leaf in leaves]), *trees)


def inside(way: str, run: Callable, trees: list[Any]) -> list[tuple[np.ndarray, int]]:
    """Values and codes of each member."""
    if way == "jit":
        program = jax.jit(run)
        found = [program(tree) for tree in trees]
        return [(np.asarray(v), int(code(c))) for v, c in found]
    if way == "grad":

        def total(tree):
            values, result = run(tree)
            return jnp.sum(values), (values, result)

        program = jax.jit(jax.value_and_grad(total, has_aux=True))
        found = [program(jax.tree.map(jnp.asarray, tree))[0][1] for tree in trees]
        return [(np.asarray(v), int(code(c))) for v, c in found]
    if way == "vmap of one":
        alone = [jax.jit(jax.vmap(run))(batched([tree])) for tree in trees]
        return [(np.asarray(v[0]), int(code(c)[0])) for v, c in alone]
    all_of = batched(trees)
    if way == "map":
        values, result = jax.jit(lambda trees: jax.lax.map(run, trees))(all_of)
    elif way == "jit(vmap)":
        values, result = jax.jit(jax.vmap(run))(all_of)
    else:
        values, result = jax.vmap(lambda tree: run(tree, throw=False))(all_of)
    return list(zip(np.asarray(values), map(int, code(result)), strict=True))


def modes(number: int) -> Pairs:
    """Letter b."""
    s, rng = subject(number)
    pairs = Pairs("b", s.note)
    members = members_of(s, rng)
    ts = times(rng, s.end)
    names = list(s.names.values())
    kinds = members[0].samples()[1]
    run = runner(s, ts, kinds, names)
    trees = [m.tree for m in members]
    outside, quiet = [], []
    for tree in trees:
        outside.append(said(lambda tree=tree: dict(zip(s.names, np.asarray(run(tree)[0]), strict=True))))
        try:
            values, result = run(tree, throw=False)
            quiet.append((np.asarray(values), int(code(result))))
        except REFUSALS:
            quiet.append(None)  # what is known without running is refused even then
    okay = int(code(diffrax.RESULTS.successful))
    stopped = int(code(diffrax.RESULTS.event_occurred))
    for member, out, q in zip(members, outside, quiet, strict=True):
        if q is not None:
            _compare(pairs, f"{member.what}: throw=False", s, out, q, (okay, stopped), None)
    ways = INSIDE if jax.tree.leaves(trees[0]) else ("jit",)
    for way in (ways[k] for k in sorted(rng.permutation(len(ways))[:DRAWN])):

        def pair(way=way):
            found = inside(way, run, trees)
            for member, out, q, one in zip(members, outside, quiet, found, strict=True):
                _compare(pairs, f"{member.what}: {way}", s, out, one, (okay, stopped), q)

        pairs.attempt(way, pair)
    return pairs


def _compare(pairs: Pairs, what: str, s: Subject, outside: Said, found: Any, good: tuple[int, int], quiet: Any) -> None:
    """What is accepted outside has the same values inside; what is refused outside has a code, and NaN at the end."""
    values, result = found
    okay = result in good
    if outside.refusal:
        ended = bool(np.isnan(values[:, -1]).all())
        right = not okay and ended and (quiet is None or quiet[1] == result)
        codes = f"code {result}" + (f", {quiet[1]} outside with throw=False" if quiet else "")
        text = f"refused outside, {outside.text[:200]}; inside {codes}, ends with {values[:, -1][:3]}"
        pairs.add(what, 0.0 if right else np.inf, text, refused=True)
        return
    if not okay:
        pairs.add(what, np.inf, f"accepted outside; inside code {result}")
        return
    inside_said = Said(dict(zip(s.names, values, strict=True)))
    off, where = difference(outside, inside_said, ALONG, sizes=s.sizes)
    pairs.add(what, off, where)
