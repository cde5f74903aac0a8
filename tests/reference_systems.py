"""What is checked of a reference system: its solution, its account of energy, and its gradient by every parameter."""

import functools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import scipy.integrate
from scipy.linalg import expm

from jaxonomy_dae import AcausalSystem, simulate
from jaxonomy_dae.run.simulation.energy_balance import energy_balance
from jaxonomy_dae.solvers import Rodas5P
from jaxonomy_dae.testing import assert_energy_balance

MEASURED = 1e-7  # a hundred times the tolerance of the runs, whose errors add up over hundreds of steps and decay


class ReferenceSystem(NamedTuple):
    """A system of library components, and what is known of it without this package.

    `expected` maps values of parameters, by name, to values of variables at `ts`. Errors may be `tolerance` of the
    largest value. `output` is what is differentiated, at the last time. `balance` bounds the error of the account of
    energy, `differences` what differences of `expected` differ from the gradient by. Derivatives are in units of a
    parameter's value, and of `size` for those that are zero. Systems that are `stiff` are differentiated with Rodas5P,
    the others with Diffrax's Tsit5, whose gradient compiles in half the time of ours.
    """

    make: Callable[[], AcausalSystem]
    expected: Callable[[Mapping[str, float]], Mapping[str, Any]]
    ts: np.ndarray
    output: str
    inputs: Mapping[str, Any] = {}
    tolerance: float = MEASURED
    balance: float = MEASURED
    differences: float = 1e-5
    rtol: float = 1e-9
    size: float = 1.0
    stiff: bool = False


@functools.cache
def system_of(reference: Callable[[], ReferenceSystem]) -> tuple[ReferenceSystem, AcausalSystem]:
    found = reference()
    return found, found.make()


def run(reference: Callable[[], ReferenceSystem]):
    known, system = system_of(reference)
    return simulate(
        system, known.ts[-1], ts=known.ts, inputs=known.inputs, rtol=known.rtol, atol=1e-2 * known.rtol
    )  # fmt: skip


def values_of(system: AcausalSystem) -> dict[str, float]:
    """The parameters that can be set."""
    table = system.parameters.table
    names = [n for k, n in enumerate(system.parameters.names) if k not in table.expressions]
    return {n: float(system.parameters[n]) for n in names}


class Checked(NamedTuple):
    """What was found of a system: the error of its solution, relative to the largest value of each variable, that of
    its account of energy, relative to the largest term, and the solver that was chosen."""

    error: float
    energy: float
    solver: str


def check_solution(reference: Callable[[], ReferenceSystem], *, energy: bool = True) -> Checked:
    """The solution against the reference, and the account of energy along it, which takes two more programs."""
    known, system = system_of(reference)
    solution = run(reference)
    errors = {}
    for name, true in known.expected(values_of(system)).items():
        errors[name] = float(np.abs(solution[name] - true).max() / np.abs(true).max())
        assert errors[name] <= known.tolerance, f"{name}: off by {errors[name]:.3g} of its largest value"
    error = float("nan")
    if energy:
        error = float(np.abs(energy_balance(solution, 1e-8, 1e-10).error).max())
        if not error <= known.balance:
            assert_energy_balance(solution, rtol=known.balance)  # says where
    return Checked(max(errors.values()), error, solution.stats["solver"])


def check_gradient(reference: Callable[[], ReferenceSystem], *, modes: bool = False) -> None:
    """The gradient by every parameter against differences of the reference, and forward mode, which is one more
    program, if `modes`."""
    known, system = system_of(reference)
    at = values_of(system)
    solver = Rodas5P() if known.stiff else diffrax.Tsit5()

    def last(v, adjoint=None):
        changed = system.with_parameters(dict(zip(at, v, strict=True)))
        solution = simulate(
            changed, known.ts[-1], ts=jnp.asarray(known.ts[-1:]), inputs=known.inputs, adjoint=adjoint, solver=solver,
            rtol=known.rtol, atol=1e-2 * known.rtol,
        )  # fmt: skip
        return solution[known.output][0]

    values = jnp.array(list(at.values()))
    # Parameters have units and sizes of their own: each derivative is in units of the parameter's value.
    sizes = np.where(np.array(values) == 0, known.size, np.abs(np.array(values)))
    reverse = np.asarray(jax.jit(jax.grad(last))(values)) * sizes
    scale = np.abs(reverse).max()
    if modes:
        forward = jax.jit(jax.jacfwd(lambda v: last(v, diffrax.ForwardMode())))(values)
        np.testing.assert_allclose(reverse, np.asarray(forward) * sizes, rtol=0, atol=1e-8 * scale)

    def true(name, move):
        return float(known.expected(at | {name: at[name] + move})[known.output][-1])

    step = 1e-4  # relative: truncation is of the order of its square, 1e-8, times a third derivative
    differences = [
        (true(n, step * size) - true(n, -step * size)) / (2 * step) for n, size in zip(at, sizes, strict=True)
    ]  # fmt: skip
    np.testing.assert_allclose(reverse, differences, rtol=0, atol=known.differences * scale)


# --- references ----------------------------------------------------------------------------------------------------


def integrated(
    slopes: Callable,
    start: Any,
    ts: np.ndarray,
    method: str = "DOP853",
    ends: Any = (),
    rtol: float = 1e-12,
    aside: float = 0.0,
) -> np.ndarray:
    """SciPy's solution, begun anew at each of `ends`, where slopes may have kinks; shape (states, times).

    Where they jump, slopes at an end are taken `aside` of it, on the side where the solution is.
    """
    knots = np.unique([ts[0], *[e for e in ends if ts[0] < e < ts[-1]], ts[-1]])
    rows, state = [np.asarray(start, float)[:, None]], np.asarray(start, float)
    for a, b in zip(knots, knots[1:], strict=False):
        inside = ts[(ts > a) & (ts <= b)]
        solved = scipy.integrate.solve_ivp(
            lambda t, x, low=a + aside, high=b - aside: slopes(min(max(t, low), high), x),
            (a, b), state, method, np.union1d(inside, b), rtol=rtol, atol=0.1 * rtol,
        )  # fmt: skip
        assert solved.success
        state = solved.y[:, -1]
        rows.append(solved.y[:, : len(inside)])
    return np.concatenate(rows, axis=1)


def linear(a: Any, x0: Any, b: Any, ts: np.ndarray) -> np.ndarray:
    """x' = a·x + b from x0 at ts[0], shape (states, times)."""
    n = len(x0)
    whole = np.zeros((n + 1, n + 1))
    whole[:n, :n], whole[:n, n] = a, b
    return np.array([(expm(whole * (t - ts[0])) @ [*x0, 1.0])[:n] for t in ts]).T


def driven(a: Any, x0: Any, b: Any, times: np.ndarray, values: np.ndarray, ts: np.ndarray) -> np.ndarray:
    """x' = a·x + b @ (u, u', 1) with u in straight lines between samples, exactly; shape (states, times)."""
    n = len(x0)
    whole = np.zeros((n + 3, n + 3))
    whole[:n, :n], whole[:n, n:], whole[n, n + 1] = a, b, 1.0
    knots, state, found = np.union1d(times, ts), np.asarray(x0, float), {float(ts[0]): np.asarray(x0, float)}
    for start, end in zip(knots, knots[1:], strict=False):
        slope = (np.interp(end, times, values) - np.interp(start, times, values)) / (end - start)
        state = (expm(whole * (end - start)) @ [*state, np.interp(start, times, values), slope, 1.0])[:n]
        found[float(end)] = state
    return np.array([found[float(t)] for t in ts]).T
