"""Laws that take energy out, or none."""

import abc
from typing import Any

import equinox as eqx
from jaxtyping import Array, Float, PRNGKeyArray

from ...errors import whole_number
from .network import divided, multiplied, sizes, tanh_network, typical
from .structure import response


class AbstractPassive(eqx.Module):
    """A law N with `size` outputs, which do work on its first `size` inputs v: N(v, …)·v ≤ 0 for all inputs and all
    weights.

    If v is a velocity and N a force in its direction, or v a voltage and −N the current through an element, the law
    never brings energy into the model. `Component.learned(..., kind=learning.AbstractPassive)` accepts only such laws.
    """

    size: eqx.AbstractVar[int]

    @abc.abstractmethod
    def __call__(self, u: Float[Array, " inputs"]) -> Float[Array, " size"]:
        """The law at its inputs."""


class Passive(AbstractPassive):
    """N(v, p) = (J(v, p) − R(v, p)) v, with R symmetric and positive semidefinite, J skew, both from a tanh network.

    Passive because N·v = vᵀ J v − vᵀ R v = −vᵀ R v ≤ 0: a skew J has vᵀ J v = 0, and R = L D Lᵀ with D ≥ 0 has vᵀ R v =
    Σ D (Lᵀ v)² ≥ 0 (`Dissipation` says more). Where v ≠ 0, every passive law is of this form: R = −(N·v) v vᵀ/|v|⁴ and
    J = (w vᵀ − v wᵀ)/|v|² with w = N + R v, which is orthogonal to v. At v = 0, N = 0, as for every continuous passive
    law. In floating-point numbers, N·v exceeds zero by no more than the rounding errors of its summands, and with one
    output not at all.

    **Arguments:**

    - `size`: how many entries v and N have.
    - `context`: the number of further inputs p after v, on which R and J may depend, too.
    - `key`: for the weights. `width`, `depth`: of the hidden layers.
    - `inputs`: typical sizes of v and p in their units, one number or one for each.
    - `power`: the typical size of |N·v| at such v, in its unit (watt for forces and velocities). It is one number,
        because different sizes of outputs would destroy passivity.

    **Raises:**

    - `ModelError` for counts and sizes that are not positive.
    """

    network: eqx.nn.MLP
    size: int = eqx.field(static=True)
    inputs: tuple[float, ...] = eqx.field(static=True)
    power: float = eqx.field(static=True)

    def __init__(self, size: int = 1, *, key: PRNGKeyArray, context: int = 0, width: int = 8, depth: int = 2,
                 inputs: Any = 1.0, power: Any = 1.0):  # fmt: skip
        self.size = whole_number(size, "Passive: size")
        total = size + whole_number(context, "Passive: context", 0)
        self.network = tanh_network(total, size * size, whole_number(width, "Passive: width"), depth, key)
        self.inputs = sizes(inputs, total, "Passive: inputs")
        self.power = typical(power, "Passive: power")

    def __call__(self, u: Float[Array, " inputs"]) -> Float[Array, " size"]:
        scaled = divided(u, self.inputs)
        own = self.inputs[: self.size]
        found = response(self.network(scaled).reshape(self.size, self.size), scaled[: self.size])
        # N·v = Σ (power/own) found · (own·scaled) = power·(found·scaled): passive in scaled values is passive.
        return multiplied(found, tuple(self.power / s for s in own))
