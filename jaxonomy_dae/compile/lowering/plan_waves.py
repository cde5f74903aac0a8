"""Waves in time by which a model is driven: sin(a) and cos(a) whose argument turns at one rate.

Their angular frequencies ∂a/∂t are expressions in parameters, and so are their phases, unless a moves otherwise too.
"""

import dataclasses
import functools
import math
from collections.abc import Hashable, Sequence

import numpy as np

from ...graph.expressions.differentiate import partial_derivative
from ...graph.expressions.node import ZERO, Node, leaf, linear, postorder, power
from ...graph.expressions.node import constant as number
from ...graph.expressions.substitute import rebuilt, substitute
from ...write.symbols import TIME_LABEL
from ..model.group import Group
from ..model.symbolic import SymbolicTemplate, number_label, parameter_label, template_of
from ..model.template import AbstractTemplate
from .schedule import AnyStep

PERIODIC = ("sin", "cos")


# Operations that may be zero at one point and not at another, without a factor that is zero.
BRANCHES = frozenset(
    ("select", "less", "less_equal", "equal", "not", "and", "or", "max", "min", "abs", "sign", "floor")
)
WAVE = "wave"  # labels what stands for sin(a)
Wave = tuple[SymbolicTemplate, SymbolicTemplate | None, SymbolicTemplate | None]


@dataclasses.dataclass(frozen=True)
class WaveGroup(Group):
    """Waves of one form sin(ωt + φ): templates without slots for ω, `template`, and for φ, None for a phase that moves;
    and for what is zero if nothing depends on the wave, as where its amplitude is zero; None where that is unknown."""

    phase: SymbolicTemplate | None
    weight: SymbolicTemplate | None


def plan_waves(steps: Sequence[AnyStep]) -> tuple[WaveGroup, ...]:
    """The waves in the equations of these steps, each once."""
    found: dict[Wave, list[WaveGroup]] = {}
    for equation in (equation for step in steps for equation in step.equations):
        for wave in _waves(equation.template):
            none, (frequency, *others) = np.zeros((len(equation), 0)), wave
            group = WaveGroup(frequency, none, equation.parameter, equation.coefficient, *others)
            found.setdefault(wave, []).append(group)
    groups = map(WaveGroup.joined, found.values())
    return tuple(group.take(np.sort(_first_of_each(group))) for group in groups)


def _first_of_each(group: WaveGroup) -> np.ndarray:
    return np.unique(np.hstack([group.parameter, group.coefficient]), axis=0, return_index=True)[1]


@functools.lru_cache(maxsize=4096)
def _waves(template: AbstractTemplate) -> tuple[Wave, ...]:
    """(∂a/∂t, a at t = 0, weight) of each sin(a) and cos(a) in an equation whose ∂a/∂t is the same at all times."""
    if not isinstance(template, SymbolicTemplate) or TIME_LABEL not in template.graph.leaves:
        return ()
    constant = {parameter_label(k) for k in range(template.n_parameters)}
    constant |= {number_label(k) for k in range(template.n_coefficients)}
    counts = (template.n_parameters, template.n_coefficients)
    found: dict[Node, Wave] = {}
    for n in postorder([template.graph]):
        if n.operation in PERIODIC and TIME_LABEL in n.leaves:
            argument = n.arguments[0]
            frequency = partial_derivative(argument, TIME_LABEL)
            if frequency is not ZERO and frequency.leaves <= constant:
                fixed = argument.leaves <= constant | {TIME_LABEL}
                weight = _weight(template.graph, argument, constant)
                found[argument] = (
                    template_of(frequency, (), *counts),
                    template_of(substitute(argument, {TIME_LABEL: ZERO}), (), *counts) if fixed else None,
                    None if weight is None else template_of(weight, (), *counts),
                )
    # A sine and a cosine of one argument are one wave.
    return tuple(dict.fromkeys(found.values()))


def _weight(graph: Node, argument: Node, constant: set[Hashable]) -> Node | None:
    """The sum of squares of the derivatives of an equation by sin(argument) and cos(argument), where all that is not
    `constant` has some value: zero only if a factor in parameters is. None for equations with branches."""
    order = postorder([graph])
    if any(n.operation in BRANCHES for n in order):
        return None
    squares = []
    for operation in PERIODIC:
        known: dict[Node, Node] = {}
        for n in order:
            is_wave = n.operation == operation and n.arguments[0] is argument
            inside = [known[a] for a in n.arguments]
            same = all(a is b for a, b in zip(inside, n.arguments, strict=True))
            known[n] = leaf(WAVE) if is_wave else n if same else rebuilt(n, inside)
        slope = partial_derivative(known[graph], WAVE)
        moving = sorted(slope.leaves - constant, key=repr)
        # Squares, which cannot cancel each other.
        squares.append(power(substitute(slope, {v: _some(k) for k, v in enumerate(moving)}), number(2)))
    return linear([(1, square) for square in squares])


def _some(k: int) -> Node:
    """A number of no importance, another one for each k."""
    # Values such as 1 and 2 could make a factor of the model zero by chance. Fractional parts of square roots have no
    # simple relations.
    return number(0.5 + math.sqrt(2 + k) % 1)
