"""Which property a learned law has, by the evidence: one word of physics that the data choose.

A network can be any law. One that is zero at zero, odd, a function of the input's size alone, or monotone is one of
fewer laws, so data that fit as well speak for it: the probability of the data whatever the weights is greater (MacKay
1992). Each property is built into the network (`laws/properties.py`), the problem is fitted again, and the evidence
compares.
"""

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import numpy as np

from ..base.errors import ModelError, SimulationError, nearest
from .band import law_of
from .evidence import log_evidence
from .laws.properties import AlongInput, OddPart, Property, ZeroAtZero, raw
from .laws.shapes import Monotone

if TYPE_CHECKING:
    from .estimate import Estimate

CLEAR = 3.0  # of 2 ln (ratio of evidences), from which one is worth more than a mention (Kass & Raftery 1995)
SMALL = 1e-2  # of the explored size of an input, below which its direction counts less


@dataclasses.dataclass(frozen=True, repr=False)
class Properties:
    """What the evidence says of properties of a learned law.

    - `name`: of the law.
    - `fits`: by property, the estimate with it; `"none"`: without.
    - `worth`: by property, twice the logarithm of the evidence's ratio to that of none: above 3 the data speak for it,
        below −3 against it.
    """

    name: str
    fits: "dict[str, Estimate]"
    worth: dict[str, float]

    @property
    def best(self) -> str:
        """The property of the greatest evidence, if it is clearly more than none's; else `"none"`."""
        found = max(self.worth, key=lambda key: self.worth[key])
        return found if self.worth[found] > CLEAR else "none"

    @property
    def fit(self) -> "Estimate":
        """The estimate with the best property."""
        return self.fits[self.best]

    def __repr__(self):
        rows = sorted(self.worth.items(), key=lambda row: -row[1])
        lines = [f"    {key:<32} {worth:+8.1f}   χ² {self.fits[key].chi2:.4g}" for key, worth in rows]
        says = "no property is clear" if self.best == "none" else f"'{self.name}' is {self.best}"
        return "\n".join([f"Properties: {says} (2 ln of the ratio of evidences)", *lines])


def properties(fit: "Estimate", name: str) -> Properties:
    """The properties of a raw `equinox.nn.MLP`, with fits of all of them."""
    networks = [one for one in fit.objective.layout.modules if one in fit.system.neural]
    if name not in networks:
        raise ModelError(f"properties: '{name}' is not a network that was trained: " + nearest(name, networks))
    problem, net = fit.problem, fit.problem.system.neural[name]
    if type(raw(net)) is not eqx.nn.MLP or isinstance(net, Property):
        raise ModelError(f"properties: those of an eqx.nn.MLP are looked for; '{name}' is a {type(net).__name__}")
    if problem.penalties.get(name) != "evidence":
        raise ModelError(f"properties: without a prior there is no evidence: leave regularize of '{name}' out")
    c, natural = fit.objective.coordinates, fit.objective.coordinates.natural(fit.point)
    numbers = [k for k in range(len(c)) if not c.is_weight[k]]
    frozen = {c.names[k]: float(natural[k]) for k in numbers if c.fixed[k]}
    bounds = {c.names[k]: (float(c.low[k]), float(c.high[k])) for k in numbers}
    fits, worth = {"none": fit}, {"none": 0.0}
    evidence = _evidence(fit)
    for label, build in _kinds(fit, name, net).items():
        try:
            other = problem.with_law(name, build(net), fit.objective.stacked, "evidence")
            found = other.fit(freeze=frozen, bounds=bounds, warn=False)
        except SimulationError:  # no run with this property: the data cannot speak for it
            continue
        fits[label], worth[label] = found, 2 * (_evidence(found) - evidence)
    return Properties(name, fits, worth)


def _evidence(fit: "Estimate") -> float:
    m = fit.minimum
    return log_evidence(m.z, m.found, m.weights) - fit.objective.colour.log_scale(m.weights.share)


def _kinds(fit: "Estimate", name: str, net: eqx.nn.MLP) -> dict[str, Callable[[Any], Any]]:
    """How networks with each property are made of a raw one."""
    ends = fit.explored(name)
    sizes = np.max(np.abs(ends), axis=1)
    kinds: dict[str, Callable[[Any], Any]] = {"zero at zero": ZeroAtZero, "odd": OddPart}
    if net.in_size == net.out_size and net.in_size not in (1, "scalar"):
        small = SMALL * float(np.linalg.norm(sizes))
        kinds["along its input, by its size"] = lambda g: AlongInput(g, small)
    if len(ends) == 1 and net.out_size in (1, "scalar"):
        grid = np.linspace(ends[0, 0], ends[0, 1], 50)
        module, law, points = law_of(fit, name, grid, None)  # a band would compile a program for its spread
        mean = np.asarray(jax.vmap(lambda u: law(module, u))(points))
        size, rises = float(np.max(np.abs(mean))) or 1.0, bool(mean[-1] > mean[0])  # the other way, nothing would fit
        kinds["rising" if rises else "falling"] = lambda g: Monotone(
            1, 1, rises, key=jax.random.key(0), width=g.width_size, inputs=float(sizes[0]) or 1.0, outputs=size
        )
    return kinds
