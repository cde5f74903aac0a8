"""What tests of components that switch share: runs with derivatives and event times, and SciPy's from mode to mode.

Runs are made at rtol = atol = 1e-10. Between events most of what is integrated is smooth on scales of a second, so that
a state is right to some tens of tolerances: 1e-8 and tighter, unless a comment says what else limits it.
"""

import functools
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import scipy.integrate

from jaxonomy_dae import simulate

TIGHT = dict(rtol=1e-10, atol=1e-10)
ORIGIN = "some tens of tolerances of 1e-10"
SMOOTH = 1e-8  # what the tolerances leave of states and event times
EXACT = dict(rtol=1e-12, atol=1e-13)  # of SciPy's references


def events(solution):
    return np.asarray(solution.events.ts)[: len(solution.events)]


class Run(NamedTuple):
    """Values and derivatives of variables at times, by name, and when events happened, by the name of the component."""

    ts: np.ndarray
    names: list[str]
    parameters: list[str]
    rows: np.ndarray
    jacobian: np.ndarray
    happened: list[tuple[float, str]]

    def _at(self, ts):
        return np.argmin(np.abs(self.ts[:, None] - ts), axis=0)

    def values(self, name, ts):
        return self.rows[self.names.index(name)][self._at(ts)]

    def slopes(self, name, parameter, ts):
        return self.jacobian[self.names.index(name), :, self.parameters.index(parameter)][self._at(ts)]

    def events(self, component):
        return np.array([t for t, name in self.happened if name.startswith(f"{component}: ")])


def ran(system, t1, ts, names, parameters, inputs=None) -> Run:
    """One run in one program, with derivatives by parameters."""

    def run(p):
        changed = system.with_parameters(dict(zip(parameters, p, strict=True)))
        solution = simulate(
            changed, t1, ts=jnp.asarray(ts), inputs=inputs, solver=diffrax.Tsit5(), adjoint=diffrax.ForwardMode(),
            throw=False, max_events=200, **TIGHT,
        )  # fmt: skip
        values = jnp.stack([solution[name] for name in names])
        return values, (values, solution.events.ts, solution.events.which)

    by = jax.jacfwd(run, has_aux=True) if parameters else lambda p: (jnp.zeros((len(names), len(ts), 0)), run(p)[1])
    jacobian, (values, times, which) = jax.tree.map(np.asarray, jax.jit(by)(jnp.array([*parameters.values()])))
    happened = [(t, system.plan.events.names[int(k)]) for t, k in zip(times, which, strict=True) if k >= 0]
    return Run(ts, names, [*parameters], values, jacobian, happened)


def central(f, p, h):
    return (f(p + h) - f(p - h)) / (2 * h)


def by_modes(ts, x, on, guard, slopes):
    """A system that switches where a guard changes its sign: states at ts and the times, by SciPy's own events."""
    guard = functools.partial(guard)  # SciPy reads its options from attributes
    guard.terminal = True
    t, end, rows, switched = ts[0], ts[-1], [], []
    while t < end:
        guard.direction = -1.0 if on else 1.0
        run = scipy.integrate.solve_ivp(
            slopes(on), (t, end), x, "DOP853", dense_output=True, events=guard, max_step=0.05, **EXACT
        )
        inside = (ts >= t) & (ts < run.t[-1]) if run.status else ts >= t
        rows.append(run.sol(ts[inside]))
        t, x = run.t[-1], run.y[:, -1]
        if run.status:
            switched.append(t)
            on = not on
    return np.concatenate(rows, axis=1), switched
