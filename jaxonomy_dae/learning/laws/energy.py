"""Laws that take energy out of a model, keep it, or have a potential, for all weights and all inputs.

The matrices of dissipation and interconnection are read from an n × n matrix W of any numbers,

    R = L D Lᵀ,   L = I + (what stands below W's diagonal),   D = diag(softplus(W's diagonal)) ≥ 0,
    J = U − Uᵀ,   U = what stands above W's diagonal.

For all vectors e, eᵀ R e = Σ D (Lᵀe)² ≥ 0 and eᵀ J e = 0. All positive definite R and all skew J are reached, each by
one W (the LDLᵀ factorization is unique).
"""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PRNGKeyArray

from ...base.errors import whole_number
from .network import Sizes, divided, multiplied, sizes, tanh_network, typical

REST = 0.01  # of the typical input: below it, |v| is rounded off, so that N is smooth at rest


def dissipation(w: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """R, symmetric and positive semidefinite."""
    lower = _unit_lower(w)
    product = (lower * _diagonal(w)) @ lower.T
    return (product + product.T) / 2  # also symmetric in the last place


def interconnection(w: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """J, skew-symmetric."""
    upper = jnp.triu(w, 1)
    return upper - upper.T


def response(w: Float[Array, "n n"], e: Float[Array, " n"]) -> Float[Array, " n"]:
    """(J − R) e. In order: R is applied by its factors, so that eᵀ R e is a sum of squares in rounded numbers too."""
    lower = _unit_lower(w)
    return interconnection(w) @ e - lower @ (_diagonal(w) * (lower.T @ e))


def _unit_lower(w: Float[Array, "n n"]) -> Float[Array, "n n"]:
    return jnp.tril(w, -1) + jnp.eye(w.shape[0], dtype=w.dtype)


def _diagonal(w: Float[Array, "n n"]) -> Float[Array, " n"]:
    return jax.nn.softplus(jnp.diagonal(w))


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
                 inputs: Sizes = 1.0, power: Sizes = 1.0):  # fmt: skip
        self.size = whole_number(size, "Passive: size")
        total = size + whole_number(context, "Passive: context", 0)
        self.network = tanh_network("Passive", total, size * size, width, depth, key)
        self.inputs = sizes(inputs, total, "Passive: inputs")
        self.power = typical(power, "Passive: power")

    def __call__(self, u: Float[Array, " inputs"]) -> Float[Array, " size"]:
        scaled = divided(u, self.inputs)
        own = self.inputs[: self.size]
        found = response(self.network(scaled).reshape(self.size, self.size), scaled[: self.size])
        # N·v = Σ (power/own) found · (own·scaled) = power·(found·scaled): passive in scaled values is passive.
        return multiplied(found, tuple(self.power / s for s in own))


class IsotropicPassive(AbstractPassive):
    """N(v) = −k(|v|) v with k > 0 from a tanh network: the drag of still air, friction on a plane without grain.

    It is passive because N·v = −k |v|² ≤ 0. This also holds exactly in floating-point numbers, where each entry of N
    has the opposite sign of its entry of v. Rotating v rotates N. In place of |v|, the network gets √(|v|² + δ²) − δ
    with δ = 0.01·`inputs`, so that N has derivatives of all orders at rest, too.

    **Arguments:**

    - `size`: the number of entries of v and N.
    - `key`: for the weights. `width`, `depth`: of the hidden layers.
    - `inputs`, `power`: typical sizes of |v| and |N·v|.

    **Raises:**

    - `ModelError` for counts and sizes that are not positive.
    """

    network: eqx.nn.MLP
    size: int = eqx.field(static=True)
    inputs: float = eqx.field(static=True)
    power: float = eqx.field(static=True)

    def __init__(self, size: int = 1, *, key: PRNGKeyArray, width: int = 8, depth: int = 2, inputs: Sizes = 1.0,
                 power: Sizes = 1.0):  # fmt: skip
        self.size = whole_number(size, "IsotropicPassive: size")
        self.network = tanh_network("IsotropicPassive", 1, 1, width, depth, key)
        self.inputs = typical(inputs, "IsotropicPassive: inputs")
        self.power = typical(power, "IsotropicPassive: power")

    def rate(self, speed: ArrayLike) -> Float[Array, ""]:
        """k at a speed |v|, in units of N per v."""
        scaled = jnp.asarray(speed) / self.inputs
        rounded = scaled**2 / (jnp.sqrt(scaled**2 + REST**2) + REST)  # √(s² + δ²) − δ without cancellation
        return self._rate(rounded)

    def _rate(self, rounded: Float[Array, ""]) -> Float[Array, ""]:
        return jax.nn.softplus(self.network(rounded[None])[0]) * (self.power / self.inputs**2)

    def __call__(self, u: Float[Array, " size"]) -> Float[Array, " size"]:
        square = jnp.sum((u / self.inputs) ** 2)
        return -self._rate(square / (jnp.sqrt(square + REST**2) + REST)) * u


class Dissipation(AbstractPassive):
    """f(e, x) = (J(x) − R(x)) e, linear in the efforts e, with R(x) symmetric and positive semidefinite and J(x) skew
    (van der Schaft & Jeltsema 2014, Port-Hamiltonian systems theory).

    Efforts are velocities, voltages or pressures; f are the resulting forces, currents or flows, with signs such that
    f·e is the power into the model. From the numbers W(x) of a tanh network, R = L D Lᵀ with L unit lower triangular
    and D = diag(softplus(…)) ≥ 0, and J = U − Uᵀ. So eᵀ R e = Σ D (Lᵀ e)² ≥ 0 and eᵀ J e = 0, and f·e = −eᵀ R e ≤ 0
    whatever the weights. All positive definite R and all skew J are of this form. In floating-point numbers, f·e
    exceeds zero by no more than the rounding errors of its summands.

    **Arguments:**

    - `size`: the number of efforts, which are the first inputs.
    - `states`: the number of inputs x after them. Without any, R and J are constant.
    - `key`: for the weights. `width`, `depth`: of the hidden layers.
    - `inputs`: typical sizes of e and x, one number or one for each. `power`: the typical size of |f·e|.

    **Raises:**

    - `ModelError` for counts and sizes that are not positive.
    """

    network: eqx.nn.MLP | Float[Array, " sizes"]  # numbers, if nothing moves them
    size: int = eqx.field(static=True)
    inputs: tuple[float, ...] = eqx.field(static=True)
    power: float = eqx.field(static=True)

    def __init__(self, size: int, states: int = 0, *, key: PRNGKeyArray, width: int = 8, depth: int = 2,
                 inputs: Sizes = 1.0, power: Sizes = 1.0):  # fmt: skip
        self.size = whole_number(size, "Dissipation: size")
        total = size + whole_number(states, "Dissipation: states", 0)
        whole_number(width, "Dissipation: width")
        self.network = jax.random.normal(key, (size * size,))
        if states:
            self.network = tanh_network("Dissipation", states, size * size, width, depth, key)
        self.inputs = sizes(inputs, total, "Dissipation: inputs")
        self.power = typical(power, "Dissipation: power")

    def _matrix(self, x: Float[Array, " states"]) -> Float[Array, "size size"]:
        network = self.network
        w = network(divided(x, self.inputs[self.size :])) if isinstance(network, eqx.nn.MLP) else network
        return w.reshape(self.size, self.size)

    def _per_effort(self, scaled: Float[Array, "size size"]) -> Float[Array, "size size"]:
        """A matrix in units of flow per effort: scaled[i, j]·power/(eᵢ eⱼ), a congruence, which keeps signs."""
        own = np.array(self.inputs[: self.size])
        return scaled * jnp.asarray(self.power / np.outer(own, own), scaled.dtype)

    def R(self, x: Float[Array, " states"]) -> Float[Array, "size size"]:
        """The dissipation, symmetric and positive semidefinite."""
        return self._per_effort(dissipation(self._matrix(x)))

    def J(self, x: Float[Array, " states"]) -> Float[Array, "size size"]:
        """The interconnection, skew-symmetric."""
        return self._per_effort(interconnection(self._matrix(x)))

    def __call__(self, u: Float[Array, " inputs"]) -> Float[Array, " size"]:
        e, x = u[: self.size], u[self.size :]
        own = self.inputs[: self.size]
        found = response(self._matrix(x), divided(e, own))
        return multiplied(found, tuple(self.power / s for s in own))


class Conservative(eqx.Module):
    """F(x) = −∇V(x), with the potential V from a tanh network.

    The work of F along a path is V at its beginning minus V at its end. It is zero around a closed path, because F is a
    gradient (its Jacobian, minus the Hessian of V, is symmetric). V is bounded: |V| ≤ 2 · energy · Σ|weights of the
    last layer|, because |tanh| ≤ 1 and V(0) = 0. So no path can extract more energy.

    **Arguments:**

    - `size`: the number of entries of x and F.
    - `key`: for the weights. `width`, `depth`: of the hidden layers; depth ≥ 1.
    - `inputs`: typical sizes of x, one number or one for each. `energy`: the typical size of V (joule for forces and
        positions in SI units).

    **Raises:**

    - `ModelError` for counts and sizes that are not positive.
    """

    network: eqx.nn.MLP
    size: int = eqx.field(static=True)
    inputs: tuple[float, ...] = eqx.field(static=True)
    energy: float = eqx.field(static=True)

    def __init__(self, size: int, *, key: PRNGKeyArray, width: int = 8, depth: int = 2,
                 inputs: Sizes = 1.0, energy: Sizes = 1.0):  # fmt: skip
        self.size = whole_number(size, "Conservative: size")
        depth = whole_number(depth, "Conservative: depth")
        self.network = tanh_network("Conservative", size, 1, width, depth, key)
        self.inputs = sizes(inputs, size, "Conservative: inputs")
        self.energy = typical(energy, "Conservative: energy")

    def potential(self, x: Float[Array, " size"]) -> Float[Array, ""]:
        """V(x), zero at x = 0."""
        scaled = divided(x, self.inputs)
        return (self.network(scaled)[0] - self.network(jnp.zeros_like(scaled))[0]) * self.energy

    def __call__(self, u: Float[Array, " size"]) -> Float[Array, " size"]:
        slope = jax.grad(lambda scaled: self.network(scaled)[0])(divided(u, self.inputs))
        return multiplied(slope, tuple(-self.energy / s for s in self.inputs))


class PortHamiltonian(eqx.Module):
    """f(x) = (J(x) − R(x)) ∇H(x): the right-hand side of an autonomous system with a learned energy H, a learned
    dissipation R (symmetric, positive semidefinite) and a learned interconnection J (skew).

    Along x' = f(x), dH/dt = ∇H·f = −∇Hᵀ R ∇H ≤ 0 for all weights, as for `Dissipation`, whose efforts ∇H is. And with
    H(x) = energy·(½|x/inputs|² + network(x/inputs) − network(0)), whose network is bounded, H → ∞ with |x|: as H never
    rises, no solution leaves the bounded set {H ≤ H(x(0))}. With R = 0 the energy is conserved.

    **Arguments:**

    - `size`: the number of states x.
    - `key`: for the weights. `width`, `depth`: of the hidden layers; depth ≥ 1.
    - `inputs`: typical sizes of x, one number or one for each. `energy`: the typical size of H. `time`: the time in
        which x changes by its typical size.

    **Raises:**

    - `ModelError` for counts and sizes that are not positive.
    """

    storage: eqx.nn.MLP
    network: eqx.nn.MLP
    size: int = eqx.field(static=True)
    inputs: tuple[float, ...] = eqx.field(static=True)
    scale: float = eqx.field(static=True)
    time: float = eqx.field(static=True)

    def __init__(self, size: int, *, key: PRNGKeyArray, width: int = 8, depth: int = 2,
                 inputs: Sizes = 1.0, energy: Sizes = 1.0, time: Sizes = 1.0):  # fmt: skip
        self.size = whole_number(size, "PortHamiltonian: size")
        depth = whole_number(depth, "PortHamiltonian: depth")
        storage_key, key = jax.random.split(key)
        self.storage = tanh_network("PortHamiltonian", size, 1, width, depth, storage_key)
        self.network = tanh_network("PortHamiltonian", size, size * size, width, depth, key)
        self.inputs = sizes(inputs, size, "PortHamiltonian: inputs")
        self.scale = typical(energy, "PortHamiltonian: energy")
        self.time = typical(time, "PortHamiltonian: time")

    def _energy(self, scaled: Float[Array, " size"]) -> Float[Array, ""]:
        learned = self.storage(scaled)[0] - self.storage(jnp.zeros_like(scaled))[0]
        return 0.5 * jnp.sum(scaled**2) + learned

    def energy(self, x: Float[Array, " size"]) -> Float[Array, ""]:
        """H(x), zero at x = 0."""
        return self._energy(divided(x, self.inputs)) * self.scale

    def __call__(self, u: Float[Array, " size"]) -> Float[Array, " size"]:
        scaled = divided(u, self.inputs)
        matrix = self.network(scaled).reshape(self.size, self.size)
        return multiplied(response(matrix, jax.grad(self._energy)(scaled)), tuple(s / self.time for s in self.inputs))
