"""Solutions: every variable by name."""

import operator
import warnings
from collections.abc import Callable, Hashable, Iterator, Sequence
from html import escape
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...base.aliases import Numeric, Result, Solver, State, Time, Times, Tolerance
from ...base.errors import ModelError
from ...base.optional import Axes
from ...compile.lowering.gather import times
from ...host.cache import compiled
from ...host.platform import precisely
from ...host.rows import at_times, filled_up, fit, size_for
from ...host.staging import as_argument, is_staged, is_traced, on_device, picked
from ..system.system import AcausalSystem
from .accounts import account_values, chosen_terms
from .amplified import amplified, is_looked_at, sentence
from .event_log import EventLog, Events
from .finite_values import refuse_account, refuse_not_finite, warn_of_members
from .labelled import data_frame, data_set
from .saved_state import Memory, SavedState

SHOWN = 8  # states that notebooks list


class Asked(eqx.Module):
    """How a run was asked for, beside its tolerances, so that another run of the same model is made alike.

    - `solver`: None if it was left to `simulate`, steps were prescribed, or it holds arrays.
    - `throw`: whether variables that are not finite are refused where they are read.
    """

    jump_ts: Times
    dtmax: Time
    max_steps: int = eqx.field(static=True)
    solver: Solver = eqx.field(static=True, default=None)
    control: tuple[str, ...] = eqx.field(static=True, default=())
    tolerances: tuple[Tolerance, Tolerance] | None = None  # rtol, and atol of each state
    throw: bool = eqx.field(static=True, default=True)

    @property
    def options(self) -> dict[str, Any]:
        """The arguments of `simulate`, without tolerances."""
        names = ("jump_ts", "dtmax", "max_steps", "solver", "control")
        return {name: getattr(self, name) for name in names}


def comparable(solver: Solver) -> Solver:
    """The solver; None if solutions that name it could not be compared."""
    known = not any(eqx.is_array(leaf) for leaf in jax.tree.leaves(solver)) and isinstance(solver, Hashable)
    return solver if known else None


class Solution(eqx.Module):
    """The result of `simulate`. `solution["pend.x"]` has shape `(n,)`, one value for each saved time.

    - `ts`: the saved times, shape `(n,)`.
    - `states`: the state array at these times, shape `(n, len(system.states) + len(system.carried))`, on the hidden
        constraints. `at(k)` is the whole state at one of them, with discrete variables and the memory of events.
    - `system`, `inputs`: the system and the inputs as they were read.
    - `counts`: steps taken, accepted, rejected, and Jacobians of implicit solvers; `stats` adds the name of the solver
        and the reason for choosing it.
    - `discrete`: the values of discrete variables at these times, shape `(n, len(system.discretes))`; None without
        events. At the time of an event, they are the values after it.
    - `memory`: the memory of the events for another run, see `at`.
    - `asked`: the options of the run.
    - `result`: Diffrax's result code. If the integration stopped early, later rows are NaN.

    If `equinox.filter_vmap` returns the solution, it is a batch: all shapes have a leading batch axis.
    """

    ts: Float[Array, " n"]
    states: Float[Array, "n x"]
    system: AcausalSystem
    inputs: dict[str, Any]
    counts: dict[str, Numeric]
    result: Result
    solver: str = eqx.field(static=True, default="")
    reason: str = eqx.field(static=True, default="")
    discrete: Float[Array, "n q"] | None = None
    event_log: EventLog | None = None
    memory: Memory | None = None
    asked: Asked | None = None

    def at(self, k: Numeric) -> SavedState:
        """The whole state at the saved time number `k`. Another run continues from it: `simulate(system, t1,
        initial=solution.at(-1))` goes on as if this run had not stopped. Inside jit, `k` may be traced. A batch has a
        batch of states.

        **Raises:**

        - `ModelError` if there is no such row, or the run did not reach it.
        """
        n = self.ts.shape[-1]
        if not is_traced(k):
            try:
                k = operator.index(k)
            except TypeError:
                raise ModelError(f"solution.at takes the number of a saved time, an integer; got {k!r}") from None
            if not -n <= k < n:
                raise ModelError(f"solution.at({k}): there are {n} saved times")

        def cut(rows: Numeric, place: Numeric) -> Numeric:
            return rows[place] if is_traced(k) else picked(rows, place)

        row = (..., k, slice(None))
        # Without events there is no memory: an empty array, with the axes of a batch.
        t, x, none = cut(self.ts, (..., k)), cut(self.states, row), cut(self.states, (..., k, slice(0)))
        if not is_traced(x) and x.ndim == 1 and not np.isfinite(x).all():
            raise ModelError(f"solution.at({k}): the run did not get to t={float(t):g} ({self.result})")
        of = self.system.plan.digest_of_states
        if self.discrete is None or self.memory is None:
            return SavedState(t, x, none, none, none, none, of)
        memory = self.memory
        sides, ticked = cut(memory.sides, row), cut(memory.ticked, row)
        return SavedState(t, x, cut(self.discrete, row), sides, ticked, memory.sizes, of)

    def __getitem__(self, name: Any) -> Any:
        """The values of a variable, or of several: `solution["pend.x"]` has shape `(n,)`, and
        `solution[["pend.x", "pend.y"]]` shape `(n, 2)`. `"time"` is accepted, and `"der(...)"` of what the model
        differentiates. `solution["cell.v"]` of an array has shape `(n, *shape)`; among several names, it stands for
        those of all entries.

        **Raises:**

        - `ModelError` for an unknown name.
        - `SimulationError` for a variable that is not finite at a saved time. Inside jit and vmap, and of a run with
            `throw=False`, it is not-a-number there.
        """
        if not isinstance(name, str):
            if not isinstance(name, Sequence) or not all(isinstance(one, str) for one in name):
                raise ModelError(f"read a solution by names, solution['m.x'] or solution[['m.x', 'm.y']]; got {name!r}")
            return self._columns(tuple(self.system.plan.entry_names(name)))
        if name == "time":
            return self.ts
        if self.states.ndim > 2:
            values = _each(self, lambda one: one[name])
            if self.asked is not None and self.asked.throw:
                warn_of_members(name, values, self.states)
            return values
        if self.discrete is not None and name in self.system.discretes:
            return picked(self.discrete, (slice(None), self.system.discretes.index(name)))
        entries = self.system.plan.entries(name)
        if entries is not None:
            names, shape = entries
            return self._columns(tuple(names)).reshape(*self.ts.shape, *shape)
        quantity, factor = self.system.plan.resolve([name])
        column = self._state(int(quantity[0]), float(factor[0]))
        if column is not None:
            return column
        return picked(self._columns((name,)), (slice(None), 0))

    def _evaluated(
        self, ts: Numeric, states: Numeric, discrete: Numeric, quantity: np.ndarray, factor: np.ndarray
    ) -> tuple[Numeric, Numeric]:
        """The values of quantities at times, shape (times, at least len(quantity)), and those of all quantities at
        `_some` times where they are looked at. Numbers of names, and names of one step of a large model, share a
        program."""
        plan, n = self.system.plan, 1 << (len(quantity) - 1).bit_length()
        few = fit(ts.shape[0], plan.extended.quantities.n) or is_looked_at(self.system)
        owners = None if few else plan.owners(quantity)
        place = quantity if owners is None else np.searchsorted(plan.owned(owners), quantity)
        padded = as_argument(np.resize(place, n)), as_argument(np.resize(factor, n), self.states.dtype)
        return _chosen(self.system.without_stiffness, ts, states, self.inputs, discrete, *padded, owners)

    def _where_reached(self, values: Numeric) -> Numeric:
        """The values, shape (n, k), with not-a-number where they are not finite, and in rows that the run did not
        reach. Constants and functions of time could be evaluated there, too."""
        known = not is_traced((self.states, values))
        xp: Any = np if known else jnp
        states, values = (np.asarray(self.states), np.asarray(values)) if known else (self.states, values)
        reached = xp.isfinite(states).all(axis=-1, keepdims=True)
        found = xp.where(reached & xp.isfinite(values), values, xp.nan)
        return on_device(found) if known else found

    def _state(self, quantity: int, factor: float) -> Numeric:
        """The values of quantities that are zero or part of the state array; None for others."""
        if quantity < 0:
            zeros = np.zeros((*self.ts.shape, 1), self.states.dtype)
            return picked(self._where_reached(zeros), (slice(None), 0))
        plan = self.system.plan
        place = np.flatnonzero(np.concatenate([plan.states, plan.carried]) == quantity)
        if not len(place):
            return None
        column = picked(self.states, (slice(None), int(place[0])))
        return column if factor == 1 else times(factor, column)

    def _look_at(
        self, names: Sequence[str], quantity: np.ndarray, factor: np.ndarray, values: Numeric, some: Numeric
    ) -> None:
        """Outside of jit, refuses variables that are not finite, and warns of those that amplify the tolerances of the
        run; `some` are the values of all quantities at a few times."""
        asked = self.asked
        if asked is None or is_traced((self, values)):
            return
        if asked.throw:
            rows = self.ts, self.states, self.discrete
            refuse_not_finite(self.system, names, quantity, values, rows, self.inputs)
        if asked.tolerances is None or not is_looked_at(self.system):
            return
        rows = np.minimum(_some(size_for(self.ts.shape[0])), self.ts.shape[0] - 1)
        rtol, atol = map(np.asarray, asked.tolerances)
        at = list(zip(np.asarray(self.ts, float)[rows].tolist(), np.asarray(some, float), strict=True))
        tolerances = rtol * np.abs(np.asarray(self.states, float)[rows]) + atol
        found = amplified(self.system, names, quantity, factor, np.asarray(values, float), at, tolerances, float(rtol))
        # What is under the error control is as exact as was asked for.
        found = [one for one in found if one.name not in asked.control]
        if found:
            warnings.warn(sentence(found), RuntimeWarning, stacklevel=5)

    def _columns(self, names: tuple[str, ...]) -> Numeric:
        """The values of several variables, shape `(n, len(names))`, evaluated at once."""
        if self.states.ndim > 2:
            return _each(self, lambda one: one._columns(names))
        own = {"time": self.ts} if "time" in names else {}
        if self.discrete is not None:
            places = {n: k for k, n in enumerate(self.system.discretes)}
            own |= {n: picked(self.discrete, (slice(None), places[n])) for n in names if n in places}
        quantity, factor = self.system.plan.resolve([name for name in names if name not in own])
        given = (self.system, self.ts, self.states, self.inputs, self.discrete)
        inside = _places(self.system, quantity)
        if not is_traced((given, own)):
            return self._known_columns(names, own, quantity, factor, inside)
        if inside is not None:
            values = jnp.where(quantity < 0, 0.0, self.states[:, inside] * jnp.asarray(factor, self.states.dtype))
        elif not (quantity >= 0).any():
            values = jnp.zeros((*self.ts.shape, len(quantity)), self.states.dtype)
        elif is_staged(given):
            values = _observed(*given, quantity, factor)
        else:
            chosen, _ = self._evaluated(self.ts, self.states, self.discrete, quantity, factor)
            values = jnp.where(quantity < 0, 0.0, chosen[:, : len(quantity)])
        values = self._where_reached(values)
        if not own:
            return values
        place = {name: k for k, name in enumerate(own)}
        others = iter(range(len(own), len(own) + values.shape[-1]))
        order = np.array([place[name] if name in place else next(others) for name in names])
        return jnp.concatenate([jnp.stack([*own.values()], axis=-1), values], axis=-1)[:, order]

    def _known_columns(
        self, names: tuple[str, ...], own: dict[str, Numeric], quantity: np.ndarray, factor: np.ndarray, inside: Numeric
    ) -> Numeric:
        """`_columns` outside of jit, grad and vmap: one program at most."""
        read = [name for name in names if name not in own]
        values = np.zeros((*self.ts.shape, len(read)), self.states.dtype)
        if inside is not None:
            values = np.asarray(self.states)[:, inside] * factor.astype(values.dtype)
        elif (quantity >= 0).any():
            # Filled up, so that a run of a few rows more or less needs no other program.
            ts, states, discrete = filled_up((self.ts, self.states, self.discrete))
            chosen, some = self._evaluated(ts, states, discrete, quantity, factor)
            values = np.asarray(chosen)[: len(self.ts), : len(quantity)]
            self._look_at(read, quantity, factor, np.where(quantity < 0, 0.0, values), some)
        values = np.where(quantity < 0, 0.0, values)
        reached = np.isfinite(np.asarray(self.states)).all(axis=-1, keepdims=True)
        values = np.where(reached & np.isfinite(values), values, np.nan)
        columns = dict(zip(read, values.T, strict=True)) | {name: np.asarray(one) for name, one in own.items()}
        empty = np.zeros((*self.ts.shape, 0), self.states.dtype)
        return on_device(np.stack([columns[name] for name in names], axis=-1) if names else empty)

    @property
    def events(self) -> Events:
        """The events of conditions: `.ts`, `.names`, `.before["m.x"]`, `.after["m.x"]`, `.transversality`.
        Empty if the model has none."""
        log = self.event_log
        if log is None:
            log = EventLog.empty(self.ts.shape[:-1], self.states.shape[-1], self.states.dtype)
        return Events(log, self.system, self.inputs, self._first)

    def _first(self) -> tuple[Time, State]:
        """The first saved time, and (x, q) there."""
        parts = [self.states] if self.discrete is None else [self.states, self.discrete]
        return self.ts[..., 0], jnp.concatenate([rows[..., 0, :] for rows in parts], axis=-1)

    @property
    def stats(self) -> dict[str, Numeric]:
        """The counts of steps, the solver's name, and the reason for choosing it."""
        return {**self.counts, "solver": self.solver, "reason": self.reason}

    def __contains__(self, name: str) -> bool:
        known = name == "time" or name in self.system.plan.variable_index or name in self.system.discretes
        return known or self.system.plan.entries(name) is not None

    def __iter__(self) -> Iterator[str]:
        return iter([*self.system.variables, *self.system.discretes])

    def constraint_residual(self) -> Float[Array, "*batch n m"]:
        """The residuals of all hidden constraints at the saved times, shape `(n, constraints)`."""
        if self.states.ndim > 2:
            return _each(self, Solution.constraint_residual)
        system = self.system.without_stiffness
        if is_traced(self):
            return _constraint_residual(system, self.ts, self.states, self.inputs, self.discrete)
        ts, states, discrete = filled_up((self.ts, self.states, self.discrete))
        return picked(_constraint_residual(system, ts, states, self.inputs, discrete), slice(len(self.ts)))

    def to_dict(self) -> dict[str, Numeric]:
        """All variables, and `"time"`, by name."""
        names = ("time", *self)
        columns = self._columns(names)
        return {name: picked(columns, (..., k)) for k, name in enumerate(names)}

    def energy(self, component: str | None = None) -> Float[Array, "*batch n"]:
        """The energy stored at the saved times (joule), shape `(n,)`: of all components, or of one component and its
        children.

        **Raises:**

        - `ModelError` for an unknown component, and if no component of the model declares energies or powers.
        """
        return self._account("energy", component)

    def dissipation(self, component: str | None = None) -> Float[Array, "*batch n"]:
        """The power that is lost (watt), shape `(n,)`; otherwise as `energy`."""
        return self._account("dissipation", component)

    def supply(self, component: str | None = None) -> Float[Array, "*batch n"]:
        """The power that comes from outside (watt), shape `(n,)`, negative where it leaves; otherwise as `energy`."""
        return self._account("supply", component)

    def _account(self, kind: str, component: str | None) -> Numeric:
        chosen = chosen_terms(self.system.plan, kind, component)
        if self.states.ndim > 2:
            return _each(self, lambda one: one._account(kind, component))
        if is_traced(self):
            values = account_values(self.system, self.ts, self.states, self.inputs, self.discrete)
            return jnp.sum(values[:, chosen], axis=1)
        ts, states, discrete = filled_up((self.ts, self.states, self.discrete))
        values = np.asarray(account_values(self.system, ts, states, self.inputs, discrete))[: len(self.ts), chosen]
        if self.asked is not None and self.asked.throw:
            refuse_account(self.system.plan, kind, chosen, values, (self.ts, self.states))
        return on_device(values.sum(axis=1))

    def energy_balance_error(self, *, rtol: float = 1e-8, atol: float = 1e-10) -> Float[Array, " n"]:
        """The error of the energy balance at the saved times, shape `(n,)`:

            [stored(t) − stored(t0) − ∫(supply − dissipation) dt] / scale

        from the first saved time t0 on. The scale is the largest energy that was stored, supplied or lost during the
        run. So 0 is a perfect balance, and an error of 1 is as large as the energies themselves.

        A second run from the first saved state, with the tolerances `rtol` and `atol`, gives the integral: it evaluates
        powers at four Gauss points between its steps and saved times, along its dense output. The remaining error is
        that of the saved states, or of a wrong or missing declaration.

        **Raises:**

        - `ModelError` inside jit, for a batch, for a solution with rows that were not reached, and for a model whose
            events write states or discrete variables, because such events may change the stored energy at an instant.
        """
        # Imported here, because it runs `simulate`, which imports this module.
        from .energy_balance import energy_balance

        return energy_balance(self, rtol, atol).error

    def to_pandas(self, *names: str) -> Any:
        """The variables named, or all, as a `pandas.DataFrame` indexed by time (extra `pandas`)."""
        return data_frame(self, names)

    def to_xarray(self, *names: str) -> Any:
        """The variables named, or all, as an `xarray.Dataset` over `time`, with units (extra `xarray`); a batch adds
        the dimensions `batch_0`, `batch_1`, …"""
        return data_set(self, names)

    def plot(self, *names: str, ax: Axes | None = None, events: bool = True) -> Any:
        """Draws variables over time with Matplotlib (extra `plot`), discrete ones as steps, and marks events unless
        `events=False`; returns the axes."""
        from ...plotting import plot_solution

        return plot_solution(self, *names, ax=ax, events=events)

    def plot_phase(self, x: str, y: str, ax: Axes | None = None) -> Any:
        """Draws variable `y` over variable `x`, with a dot at the start; returns the Matplotlib axes."""
        from ...plotting import phase

        return phase(self, x, y, ax)

    def __repr__(self):
        return f"Solution({self.ts.shape[-1]} times, {len(self.system.variables)} variables)"

    def _repr_html_(self) -> str:
        rows = {"shape of states": self.states.shape, "states": ", ".join(self.system.states[:SHOWN])}
        if len(self.system.states) > SHOWN:
            rows["states"] += f", … ({len(self.system.states)})"
        if not is_traced((self.ts, self.result, self.counts)) and self.ts.size and self.ts.ndim == 1:
            rows["time"] = f"{float(self.ts[0]):g} to {float(self.ts[-1]):g}, saved {self.ts.shape[0]} times"
            rows["result"] = "finished" if self.result == diffrax.RESULTS.successful else f"failed: {self.result}"
            rows["steps"] = self.counts.get("num_steps", "")
        rows["solver"] = f"{self.solver} ({self.reason})"
        cells = "".join(f"<tr><th>{escape(k)}</th><td>{escape(str(v))}</td></tr>" for k, v in rows.items())
        return f"<table><caption>Solution</caption>{cells}</table>"


def _each(batch: Solution, read: Callable[[Solution], Numeric]) -> Numeric:
    """Reads every solution of a batch, by mapping over the batch axes."""
    return eqx.filter_vmap(read)(batch)


def _places(system: AcausalSystem, quantity: np.ndarray) -> np.ndarray | None:
    """The places of quantities in the state array; −1 in `quantity` stands for zero and gets any place. None if one is
    not part of the state array."""
    plan = system.plan
    place = np.full(plan.extended.quantities.n + 1, -1)  # the last entry stands for zero
    place[np.concatenate([plan.states, plan.carried])] = np.arange(plan.n_state)
    found = place[quantity]
    return np.maximum(found, 0) if plan.n_state and (found[quantity >= 0] >= 0).all() else None


def _held(system: AcausalSystem, values: Numeric) -> AcausalSystem:
    return system if values is None else system.holding(values)


def _observed(system: AcausalSystem, ts, states, inputs, discrete, quantity: np.ndarray, factor: np.ndarray):
    """Quantities at all times, shape (n, quantities)."""
    read = np.maximum(quantity, 0)

    def one(t, x, q):
        return _held(system, q).at(t, inputs).quantities(x, read, factor)

    values = at_times(one, ts, states, discrete, width=system.plan.width(read))
    return jnp.where(quantity < 0, 0.0, values)


@compiled
@precisely
def _chosen(system: AcausalSystem, ts, states, inputs, discrete, place, factor, owners: tuple[int, ...] | None):
    """The values of quantities, shape (n, quantities), and those of all quantities at `_some` times. Which they are is
    traced: their places among all quantities, or among those that `owners` compute, so that one program serves as many
    names whichever they are. With `owners`, only what they need is computed, and the values at `_some` times are
    None."""
    plan = system.plan
    every = np.arange(plan.extended.quantities.n) if owners is None else plan.owned(owners)

    def all_at(t, x, q):
        return _held(system, q).at(t, inputs).quantities(x, every, np.ones(len(every)))

    rows, some = (ts, states, discrete), _some(ts.shape[0])
    # Of a small model all quantities are computed at all times, and those that are asked for picked: one program for
    # all names.
    if owners is None and fit(ts.shape[0], len(every)):
        found = jax.vmap(all_at)(*rows)
        return factor * found[:, place], found[some]
    values = at_times(lambda *row: factor * all_at(*row)[place], *rows, width=plan.width(every))
    if owners is not None:
        return values, None
    return values, jax.vmap(all_at)(*jax.tree.map(lambda row: row[some], rows))


def _some(n: int) -> np.ndarray:
    """The first, the middle and the last of n places."""
    return np.unique([0, n // 2, n - 1])


@compiled
def _constraint_residual(system: AcausalSystem, ts, states, inputs, discrete):
    return jax.vmap(lambda t, x, q: _held(system, q).constraint_residual(t, x, inputs))(ts, states, discrete)
