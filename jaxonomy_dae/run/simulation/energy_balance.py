"""Whether what components declare of energy and power balances along a solution."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...base.aliases import Times
from ...base.errors import ModelError
from ...host.staging import is_traced
from .accounts import account_values, chosen_terms
from .simulate import simulate
from .solution import Solution

MORE_STEPS = 4  # than in the run itself: tolerances of 1e-8 instead of 1e-6 take 2.5 times as many of order five
POINTS = 4  # Gauss points between neighbouring knots: exact for polynomials up to degree 7


class EnergyBalance(NamedTuple):
    """The account of energy at the saved times, shape (n,): the change of what is stored, what was supplied and what
    was lost since the first of them (joule), and the error of the balance relative to `scale` (joule)."""

    stored: Float[Array, " n"]
    supplied: Float[Array, " n"]
    lost: Float[Array, " n"]
    error: Float[Array, " n"]
    scale: float


def energy_balance(solution: Solution, rtol: float, atol: float) -> EnergyBalance:
    """The account of energy; `rtol` and `atol` are those of the run along which powers are integrated.

    **Raises:**

    - `ModelError` inside jit, of a batch, of a solution with rows that were not reached, and of a model whose
        events write states or discrete variables.
    """
    system, ts = solution.system, solution.ts
    if is_traced(solution):
        raise ModelError("the balance of energy needs numbers: ask for it outside jit, grad and vmap")
    if ts.ndim != 1:
        raise ModelError(f"the balance of energy is that of one solution; this is a batch of shape {ts.shape[:-1]}")
    events = system.plan.events
    if events is not None and (system.discretes or (events.state >= 0).any()):
        raise ModelError(
            "the balance of energy does not know what events do to the energies stored: this model has some that write "
            "states or discrete variables. solution.energy(), .supply() and .dissipation() can be read"
        )
    if not bool(jnp.all(jnp.isfinite(solution.states))):
        raise ModelError("the solution has rows that were not reached: there is nothing to balance")
    energies = [chosen_terms(system.plan, kind, None) for kind in ("energy", "supply", "dissipation")]
    change = np.asarray(account_values(system, ts, solution.states, solution.inputs, solution.discrete))
    change = (change - change[0])[:, energies[0]]
    work = _integrals(solution, rtol, atol)
    supplied, lost = (work[0][:, chosen].sum(axis=1) for chosen in energies[1:])
    passed = max((float(work[1][:, chosen].sum(axis=1).max()) for chosen in energies[1:]), default=0.0)
    scale = max(float(np.abs(change).sum(axis=1).max()), passed)
    stored = change.sum(axis=1)
    error = (stored - (supplied - lost)) / (scale if scale > 0 else 1.0)
    stored, supplied, lost, error = (jnp.asarray(a, solution.states.dtype) for a in (stored, supplied, lost, error))
    return EnergyBalance(stored, supplied, lost, error, scale)


def _integrals(solution: Solution, rtol: float, atol: float) -> tuple[np.ndarray, np.ndarray]:
    """The integrals of all terms, and of their absolute values, from the first saved time to each, shape (n, terms)."""
    system, saved = solution.system, np.asarray(solution.ts, float)
    terms = sum(len(group) for group in system.plan.flat.accounts)
    none = np.zeros((len(saved), terms))
    if not saved[-1] > saved[0]:
        return none, none
    names = [*system.states, *system.carried]
    first = {name: solution.states[0, k] for k, name in enumerate(names)}

    asked = {} if solution.asked is None else solution.asked.options
    # Steps are shorter by the fifth root of what the tolerances are.
    asked |= {"max_steps": MORE_STEPS * asked["max_steps"]} if asked else {}

    def again(ts: Times) -> Solution:
        return simulate(
            system, solution.ts[-1], t0=solution.ts[0], ts=ts, rtol=rtol, atol=atol, inputs=solution.inputs,
            initial=first, **asked,
        )  # fmt: skip

    # Steps end where inputs and equations have kinks and jumps, so that no piece of the quadrature holds one.
    knots = np.union1d(np.asarray(again(None).ts, float), saved)
    knots = knots[(knots >= saved[0]) & (knots <= saved[-1])]
    places, weights = np.polynomial.legendre.leggauss(POINTS)
    half = np.diff(knots)[:, None] / 2
    nodes = knots[:-1, None] + half * (1 + places)
    fine = again(jnp.asarray(nodes.ravel(), solution.ts.dtype))
    values = np.asarray(account_values(system, fine.ts, fine.states, fine.inputs, fine.discrete), float)
    values = values.reshape(*nodes.shape, terms)
    at_saved = np.searchsorted(knots, saved)
    sums = []
    for integrand in (values, np.abs(values)):
        pieces = np.einsum("ij,ijk->ik", half * weights, integrand)
        sums.append(np.concatenate([np.zeros((1, terms)), np.cumsum(pieces, axis=0)])[at_saved])
    return sums[0], sums[1]
