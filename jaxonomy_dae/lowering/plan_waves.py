"""Waves in time by which a model is driven: sin(a) and cos(a) whose argument turns at one rate.

Their angular frequencies ∂a/∂t are expressions in parameters, and so are their phases, unless a moves otherwise too.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..expressions.differentiate import partial_derivative
from ..expressions.node import ZERO, Node, postorder
from ..expressions.substitute import substitute
from ..model.symbolic import SymbolicTemplate, number_label, parameter_label, template_of
from ..model.template import AbstractTemplate
from ..modeling.symbols import TIME_LABEL
from .schedule import AnyStep

PERIODIC = ("sin", "cos")


@dataclasses.dataclass(frozen=True)
class WaveGroup:
    """Waves of one form sin(ωt + φ): templates without slots for ω and φ, None for a phase that moves."""

    frequency: SymbolicTemplate
    phase: SymbolicTemplate | None
    parameter: np.ndarray  # (n, parameters)
    coefficient: np.ndarray  # (n, coefficients)


def plan_waves(steps: Sequence[AnyStep]) -> tuple[WaveGroup, ...]:
    """The waves in the equations of these steps, each once."""
    found: dict[tuple[SymbolicTemplate, SymbolicTemplate | None], list[tuple[np.ndarray, np.ndarray]]] = {}
    for step in steps:
        for equation in step.equations:
            for wave in _waves(equation.template):
                found.setdefault(wave, []).append((equation.parameter, equation.coefficient))
    groups = []
    for (frequency, phase), tables in found.items():
        parameter, coefficient = (np.concatenate(column) for column in zip(*tables, strict=True))
        _, first = np.unique(np.hstack([parameter, coefficient]), axis=0, return_index=True)
        rows = np.sort(first)
        groups.append(WaveGroup(frequency, phase, parameter[rows], coefficient[rows]))
    return tuple(groups)


@functools.lru_cache(maxsize=4096)
def _waves(template: AbstractTemplate) -> tuple[tuple[SymbolicTemplate, SymbolicTemplate | None], ...]:
    """(∂a/∂t, a at t = 0) of each sin(a) and cos(a) in an equation whose ∂a/∂t is the same at all times."""
    if not isinstance(template, SymbolicTemplate) or TIME_LABEL not in template.graph.leaves:
        return ()
    constant = {parameter_label(k) for k in range(template.n_parameters)}
    constant |= {number_label(k) for k in range(template.n_coefficients)}
    counts = (template.n_parameters, template.n_coefficients)
    found: dict[Node, Any] = {}
    for n in postorder([template.graph]):
        if n.operation in PERIODIC and TIME_LABEL in n.leaves:
            argument = n.arguments[0]
            frequency = partial_derivative(argument, TIME_LABEL)
            if frequency is not ZERO and frequency.leaves <= constant:
                fixed = argument.leaves <= constant | {TIME_LABEL}
                found[argument] = (
                    template_of(frequency, (), *counts),
                    template_of(substitute(argument, {TIME_LABEL: ZERO}), (), *counts) if fixed else None,
                )
    return tuple(dict.fromkeys(found.values()))
