"""What streams bring into the ports of a junction: the mixture of what leaves the others.

Of two ports, each receives what leaves the other. Of more, port i receives

    Σ w_j h_j / Σ w_j,    w_j = positiveMax(-m_j, s_i),    s_i = Σ max(-m_j, 0),    the sums over j ≠ i,

with the regularization of the Modelica Language Specification 3.6, section 15.2: below a small flow eps, the weights
pass smoothly into eps each, so that nothing is divided by zero where nothing flows.
"""

import dataclasses
import functools
from collections.abc import Hashable

import numpy as np
import sympy

from ...graph.expressions.from_sympy import read
from ...graph.expressions.node import Node, leaf
from ...graph.expressions.substitute import substitute
from ...write.symbols import VariableSymbol, symbol_label
from ..model.provenance import Provenances
from ..model.symbolic import SymbolicTemplate, number_label, slot_label, template_of
from ..model.tables import EquationGroup

SMALL = 1e-6  # the flow below which a junction counts as at rest, over the least nominal flow of its ports


@functools.cache
def mixing(n: int) -> SymbolicTemplate:
    """The residual of what enters, in it, then the flows and the streams of the n other ports. Its coefficient is
    eps."""
    eps = sympy.Symbol("eps", positive=True)
    enters, *rest = (VariableSymbol(f"x{k}") for k in range(1 + 2 * n))
    flows, streams = rest[:n], rest[n:]
    leaving = [sympy.Piecewise((-m, m < 0), (0, True)) for m in flows]
    at = sum(leaving) / eps
    part = sympy.Piecewise((1, at > 1), (at**2 * (3 - 2 * at), at > 0), (0, True))
    weights = [part * m + (1 - part) * eps for m in leaving]
    mixture = sum(w * h for w, h in zip(weights, streams, strict=True)) / sum(weights)
    replaced: dict[Hashable, Node] = {symbol_label(v): leaf(slot_label((k, 0))) for k, v in enumerate([enters, *rest])}
    replaced[symbol_label(eps)] = leaf(number_label(0))
    graph = substitute(read(enters - mixture, symbol_label), replaced)
    return template_of(graph, tuple((k, 0) for k in range(1 + 2 * n)), 0, 1)


def mixed(
    enters: np.ndarray, flow: np.ndarray, stream: np.ndarray, sign: np.ndarray, small: np.ndarray, source: Provenances
) -> EquationGroup:
    """The equations of what enters, one a row: `enters` of shape (rows,), the flows and streams of the others and the
    signs of the flows (rows, others), `small` (rows,)."""
    n = flow.shape[1]
    variable = np.concatenate([enters[:, None], flow, stream], axis=1)
    factor = np.ones(variable.shape)
    # The sign goes into the slot's factor, so that faces seen from inside and outside share one template.
    factor[:, 1 : n + 1] = sign
    group = EquationGroup.of(mixing(n), variable, np.zeros(variable.shape), source, coefficient=small[:, None])
    return dataclasses.replace(group, factor=factor)
