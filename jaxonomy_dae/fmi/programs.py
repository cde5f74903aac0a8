"""What an FMU computes, as functions of arrays that JAX traces: those that a run evaluates.

A point is (t, x, z, q, p, u, *weights): time, differential states, guesses of the tearing variables of nonlinear
blocks, discrete values, parameters, inputs, and the arrays of networks. `Programs` gives each function as a program
(`jax.make_jaxpr`):

- `field`, `outputs`, `guards`: dx/dt, the variables that are read, and the guards of conditions.
- `unsolved`: the same, with the residuals of nonlinear blocks in place of their solution.
- `opened`: dx/dt and residuals where unknowns of blocks are given, the last array of `weights` then (`open_blocks`).
- `forward`, `reverse`: the directional and the adjoint derivative of `field`, `outputs`, `guards` and `opened`, one
  after another, by (t, x, p, u, *weights). Nonlinear blocks are differentiated by the implicit function theorem.
- `start`: the consistent point at the initial time, after the events that happen there.
- `event`: what happens at an instant, by the map that a run uses.
- `step`: a step of Rodas5P, with its error and its dense output, for Co-Simulation.
- `accept`: what a step that was completed leaves behind: tearing variables, on which side of zero guards are, how far
  states are off their constraints.
"""

import copy
import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from ..base.errors import ModelError
from ..base.tolerances import WINDOW
from ..run.simulation.hybrid_problem import SystemProblem
from ..run.start.initialize import initialize, is_consistent
from ..run.system.nonlinear import Refinement
from ..run.system.system import AcausalSystem
from ..solve.events.event_map import handle
from ..solve.events.instant import Arrival
from ..solve.events.kinks import turned
from ..solve.events.log import EventRows
from ..solve.events.looking import FORGOTTEN
from ..solve.events.problem import HybridState
from ..solve.events.side import ABOVE, BELOW, RESTS, rounding
from ..solve.events.solver import MOVED
from ..solve.events.start import start
from ..solve.methods.rodas5p import Rodas5P
from ..write.events import EventFlag
from .open_blocks import given_quantities, opened, residual_equations

PROJECTIONS = 4  # Gauss–Newton steps onto the constraints, as many as leave rounding of any drift that is tolerated
RUN = 6  # numbers of a run in `HybridState.of_run`
NAMES = ("field", "outputs", "guards", "forward", "reverse", "start", "event", "step", "accept")


@dataclasses.dataclass(frozen=True)
class Weights:
    """One array of a network: its name, and its value."""

    name: str
    value: np.ndarray


class Programs:
    """Those of these functions of a system that have `names`; its continuous `outputs` are variables by name, and
    `starts` are variables with values that can be set at the initial time."""

    def __init__(
        self, system: AcausalSystem, outputs: Sequence[str], starts: Sequence[str], names: Sequence[str] = NAMES
    ):  # fmt: skip
        # Functions of the system that several programs need are functions of their own, written once for all of them:
        # but for derivatives, where the field and what is read share more if both stand in one function.
        self.system, self.plan, self.names = system.traced_once(), system.plan, tuple(names)
        self.nx, self.nz = len(self.plan.states), len(self.plan.carried)
        self.starts = tuple(starts)
        self._quantity = self.plan.resolve(outputs) if outputs else (np.zeros(0, np.int64), np.zeros(0))
        self.ny = len(outputs)
        found, self._tree = jax.tree_util.tree_flatten_with_path(eqx.filter(system.neural, eqx.is_inexact_array))
        self.networks = tuple(Weights(_name_of_leaf(path), np.asarray(leaf)) for path, leaf in found)
        given = (Weights("dae.algebraic", _given_at_start(system)),) if "opened" in self.names else ()
        self.weights = (*self.networks, *given)
        self.n_opened = self.nx + len(residual_equations(self.plan)) if given else 0
        self.p = np.asarray(system.parameters.values)
        events = self.plan.events
        self.nq = 0 if events is None else len(events.discrete)
        self.ng = 0 if events is None else events.facts.n_guards
        self.nc = 0 if events is None else events.n_clocks
        self.n_unknowns = self.nx + self.ny + self.ng + self.n_opened

    # --- the system at a point --------------------------------------------------------------------------------------

    def at(self, p: Array, weights: Sequence[Array]) -> AcausalSystem:
        """The system with these parameters and weights, which are of double precision, whatever the network's are."""
        own = [w.astype(leaf.value.dtype) for w, leaf in zip(weights, self.networks, strict=False)]
        networks = jax.tree.unflatten(self._tree, own)
        neural = eqx.combine(networks, self.system.neural)
        return eqx.tree_at(lambda s: (s.parameters.values, s.neural), self.system, (p, neural))

    def args(self, u: Array) -> dict[str, Array]:
        return {name: u[k] for k, name in enumerate(self.plan.inputs.names)}

    def whole(self, system: AcausalSystem, t: Array, x: Array, z: Array, u: Array) -> Array:
        """The state array with the tearing variables that belong to x, not-a-number where there are none."""
        if not self.nz:
            return x
        return system.at(t, self.args(u)).refined(jnp.concatenate([x, z]), Refinement.ROOT)

    def problem(self, system: AcausalSystem, resolution: Array) -> SystemProblem:
        """The system as a problem with events."""
        facts = self.plan.some_events.facts
        return SystemProblem(
            system=system, watch=None, tolerance=0.0, resolution=resolution, implicit=False, facts=facts
        )  # fmt: skip

    # --- continuous functions ---------------------------------------------------------------------------------------

    def field(self, t: Array, x: Array, z: Array, q: Array, p: Array, u: Array, *weights: Array) -> Array:
        """dx/dt, shape (nx,)."""
        system = self.at(p, weights).holding(q)
        return system.semi_explicit(t, self.whole(system, t, x, z, u), self.args(u))[: self.nx]

    def outputs(self, t: Array, x: Array, z: Array, q: Array, p: Array, u: Array, *weights: Array) -> Array:
        """The continuous outputs, shape (ny,)."""
        if not self.ny:
            return jnp.zeros((0,), self.p.dtype)
        system = self.at(p, weights).holding(q)
        return system.at(t, self.args(u)).quantities(self.whole(system, t, x, z, u), *self._quantity)

    def guards(self, t: Array, x: Array, z: Array, q: Array, p: Array, u: Array, *weights: Array) -> Array:
        """The guards, shape (ng,)."""
        if not self.ng:
            return jnp.zeros((0,), self.p.dtype)
        system = self.at(p, weights).holding(q)
        return system.at(t, self.args(u)).guards(self.whole(system, t, x, z, u))

    def opened(self, t: Array, x: Array, z: Array, q: Array, p: Array, u: Array, *weights: Array) -> Array:
        """dx/dt, then what equations leave, with given unknowns: shape (n_opened,)."""
        return opened(self.at(p, weights).holding(q).at(t, self.args(u)), x, weights[-1])

    def unknowns(self, *point: Array) -> Array:
        """The field, the outputs, the guards and what blocks leave, shape (n_unknowns,)."""
        left = [self.opened(*point)] if self.n_opened else []
        return jnp.concatenate([self.field(*point), self.outputs(*point), self.guards(*point), *left])

    def unsolved(
        self, t: Array, x: Array, z: Array, q: Array, p: Array, u: Array, *weights: Array
    ) -> tuple[Array, Array, Array, Array]:
        """At any z, whether the equations of nonlinear blocks hold or not: (dx/dt, the residuals of these equations,
        the continuous outputs, the guards)."""
        here = self.at(p, weights).holding(q).at(t, self.args(u))
        whole, none = jnp.concatenate([x, z]), jnp.zeros((0,), self.p.dtype)
        found = here.semi_explicit(whole)
        outputs = here.quantities(whole, *self._quantity, Refinement.NONE) if self.ny else none
        guards = here.guards(whole, Refinement.NONE) if self.ng else none
        return found[: self.nx], found[self.nx :], outputs, guards

    def _moving(self, z: Array, q: Array) -> Callable[..., Array]:
        """`unknowns` of what they are differentiated by."""
        inside = copy.copy(self)
        inside.system = dataclasses.replace(self.system, once=None)
        return lambda t, x, p, u, *weights: inside.unknowns(t, x, z, q, p, u, *weights)

    def forward(self, z: Array, q: Array, at: Sequence[Array], along: Sequence[Array]) -> Array:
        """The derivative of `unknowns` along a direction."""
        return jax.jvp(self._moving(z, q), tuple(at), tuple(along))[1]

    def reverse(self, z: Array, q: Array, at: Sequence[Array], weight: Array) -> tuple[Array, ...]:
        """The derivative of `weight`·`unknowns` by each of (t, x, p, u, *weights)."""
        return jax.vjp(self._moving(z, q), *at)[1](weight)

    # --- instants ---------------------------------------------------------------------------------------------------

    def start(self, t: Array, p: Array, u: Array, s: Array, resolution: Array, *weights: Array) -> tuple[Array, ...]:
        """Returns (x, z, q, the guards' memory, the clocks', the run's, whether all of this is right, the residuals of
        the start's equations, their limits); `s` has the values of `starts`."""
        system, args = self.at(p, weights), self.args(u)
        initial = {name: s[k] for k, name in enumerate(self.starts)}
        found = initialize(system, t, args, initial)
        fine, whole = is_consistent(found), found.x
        if self.plan.events is None:
            none = jnp.zeros((2, 0), p.dtype)
            memory = jnp.zeros((0,), p.dtype), none, none, jnp.zeros((RUN,), p.dtype)
        else:
            state = start(self.problem(system, resolution), t, whole, system.discrete_values, args, 0, False)
            whole, memory = state.x, (state.q, state.of_guards, state.of_clocks, state.of_run)
        x, z = whole[: self.nx], whole[self.nx :]
        return x, z, *memory, fine & jnp.all(jnp.isfinite(whole)), found.residual, found.limit

    def event(
        self, t: Array, x: Array, z: Array, q: Array, p: Array, u: Array, of_guards: Array, of_clocks: Array,
        of_run: Array, resolution: Array, tolerance: Array, *weights: Array,
    ) -> tuple[Array, ...]:  # fmt: skip
        """What happens at t. Returns (x, z, q, the guards' memory, the clocks', the run's, whether anything did,
        whether all numbers are finite)."""
        system, args = self.at(p, weights), self.args(u)
        held = system.holding(q) if self.nq else system
        whole = self.whole(held, t, x, z, u)
        if self.plan.n_projected:
            whole = jnp.where(
                self._drift(held, t, whole, args, tolerance) > 1.0, held.project(t, whole, args, PROJECTIONS), whole
            )
        fired = jnp.zeros((), bool)
        memory = q, of_guards, of_clocks, of_run
        if self.plan.events is not None:
            problem = self.problem(system, resolution)
            state = HybridState(
                x=whole, q=q, of_guards=of_guards, of_clocks=of_clocks, of_run=of_run, table=None
            )  # fmt: skip
            arrival, values, armed = self._arrival(problem, t, state, args)
            state = state.but(armed=armed, size=arrival.size)
            fired = jnp.any(arrival.due)
            if problem.facts.only_kinks:
                after = turned(problem, t, state, values, arrival.due, args)
            else:
                noted = EventRows.empty(0, False, len(whole) + len(q), p.dtype)
                after = lax.cond(fired, lambda: handle(problem, t, state, arrival, args, noted)[0], lambda: state)
            state = jax.tree.map(lambda a, b: jnp.where(fired, a, b), after, state)
            whole, memory = state.x, (state.q, state.of_guards, state.of_clocks, state.of_run)
            if self.nz:
                whole = self.whole(system.holding(state.q), t, whole[: self.nx], whole[self.nx :], u)
        fine = jnp.all(jnp.isfinite(whole)) & jnp.all(jnp.isfinite(memory[0]))
        return whole[: self.nx], whole[self.nx :], *memory, fired, fine

    def _arrival(self, problem: SystemProblem, t: Array, state: HybridState, args: Any) -> tuple[Arrival, Array, Array]:
        """Returns (the events that are due at t, the guards' values, the sides on which they are armed): as where a
        run's step ends, of which nothing but its end is known."""
        g, facts = self.ng, problem.facts
        window = jnp.maximum(WINDOW * state.span, problem.resolution)
        ticking = state.due <= t + 0.25 * problem.resolution
        slope = problem.slope(t, state.x, state.q, args)
        none = jnp.zeros((g,), bool)
        if not g:
            return Arrival(slope, state.size, ticking, none, state.size, window, state.span), state.size, state.armed
        values, rates = problem.rates(t, state.x, state.q, args, slope)
        size = jnp.maximum(jnp.abs(values), state.size)
        band = rounding(size)
        raised = jnp.where(state.armed == RESTS, values + band, values)
        strict = facts.are(EventFlag.STRICT)[facts.n_clocks :]
        near = (rates < 0) & (jnp.abs(raised) <= jnp.maximum(-rates * window, band))
        stays = (raised == 0) & (rates == 0) & (state.armed == ABOVE) & ~strict
        due = (state.armed > BELOW) & (near | stays | (raised < 0))
        jumped = due & ~near & ~stays
        # Half of the band: an importer finds the place where a guard rises to the band from either side.
        armed = jnp.where(~due & (values > 0.5 * band), ABOVE, state.armed)
        arrival = Arrival(slope, rates, jnp.concatenate([ticking, due]), jumped, size, window, state.span)
        return arrival, values, armed.astype(values.dtype)

    def accept(
        self, t: Array, x: Array, z: Array, q: Array, p: Array, u: Array, of_guards: Array, of_clocks: Array,
        of_run: Array, resolution: Array, tolerance: Array, step: Array, *weights: Array,
    ) -> tuple[Array, ...]:  # fmt: skip
        """After a step of length `step` to t. Returns (z, the guards' memory, the run's, whether an event is due,
        or the states are farther from their constraints than `tolerance` allows)."""
        system, args = self.at(p, weights), self.args(u)
        held = system.holding(q) if self.nq else system
        whole = self.whole(held, t, x, z, u)
        wants = jnp.zeros((), bool)
        if self.plan.n_projected:
            wants = wants | (self._drift(held, t, whole, args, tolerance) > 1.0)
        if self.plan.events is not None:
            problem = self.problem(system, resolution)
            state = HybridState(
                x=whole, q=q, of_guards=of_guards, of_clocks=of_clocks, of_run=of_run, table=None
            )  # fmt: skip
            span = jnp.maximum(step, FORGOTTEN * state.span)
            turns = jnp.where(step > MOVED * resolution, 0.0, state.turns)
            state = state.but(span=span, turns=turns)
            arrival, _, armed = self._arrival(problem, t, state, args)
            wants = wants | jnp.any(arrival.due)
            state = state.but(armed=armed, size=arrival.size)
            of_guards, of_run = state.of_guards, state.of_run
        return whole[self.nx :], of_guards, of_run, wants

    def step(self, t: Array, x: Array, z: Array, q: Array, p: Array, u: Array, h: Array, *weights: Array) -> Any:
        """A step of length h. Returns (x after it, its error, shape (nx,) each, and the coefficients of the dense
        output, shape (3, nx))."""
        if not self.nx:
            return x, x, jnp.zeros((3, 0), p.dtype)
        term = diffrax.ODETerm(lambda t, x, args: self.field(jnp.asarray(t), x, z, q, p, u, *weights))
        x1, error, dense, _, _ = Rodas5P(looped=True).step(term, t, t + h, x, None, None, made_jump=False)
        return x1, error, dense["k"]

    def _drift(self, system: AcausalSystem, t: Array, whole: Array, args: Any, tolerance: Array) -> Array:
        """How far the states are from their constraints, in units of what is tolerated."""
        moved = system.project(t, whole, args)[: self.nx] - whole[: self.nx]
        sizes = jnp.abs(whole[: self.nx]) + jnp.asarray(self.system.state_sizes)[: self.nx]
        return jnp.max(jnp.abs(moved) / (tolerance * sizes))

    # --- programs ---------------------------------------------------------------------------------------------------

    @functools.cached_property
    def _numbers(self) -> dict[str, Any]:
        """Arrays in the shapes of all arguments."""
        dtype = self.p.dtype
        shapes = {
            "t": (), "x": (self.nx,), "z": (self.nz,), "q": (self.nq,), "u": (len(self.plan.inputs.names),),
            "s": (len(self.starts),), "of_guards": (2, self.ng), "of_clocks": (2, self.nc), "of_run": (RUN,),
            "unknowns": (self.n_unknowns,),
        }  # fmt: skip
        return {name: jax.ShapeDtypeStruct(shape, dtype) for name, shape in shapes.items()} | {
            "p": jax.ShapeDtypeStruct(self.p.shape, dtype),
            "weights": tuple(jax.ShapeDtypeStruct(w.value.shape, dtype) for w in self.weights),
        }

    @functools.cached_property
    def traced(self) -> dict[str, Any]:
        """The functions as programs by name."""
        n = self._numbers
        number, weights = n["t"], n["weights"]
        point = (n["t"], n["x"], n["z"], n["q"], n["p"], n["u"])
        moving = (n["t"], n["x"], n["p"], n["u"], *weights)
        memory = (n["of_guards"], n["of_clocks"], n["of_run"], number, number)
        given: dict[str, tuple[Callable[..., Any], tuple[Any, ...]]] = {
            "field": (self.field, (*point, *weights)),
            "outputs": (self.outputs, (*point, *weights)),
            "guards": (self.guards, (*point, *weights)),
            "unsolved": (self.unsolved, (*point, *weights)),
            "opened": (self.opened, (*point, *weights)),
            "forward": (
                lambda z, q, *both: self.forward(z, q, both[: len(moving)], both[len(moving) :]),
                (n["z"], n["q"], *moving, *moving),
            ),
            "reverse": (
                lambda z, q, weight, *at: self.reverse(z, q, at, weight),
                (n["z"], n["q"], n["unknowns"], *moving),
            ),
            "start": (self.start, (number, n["p"], n["u"], n["s"], number, *weights)),
            "event": (self.event, (*point, *memory, *weights)),
            "step": (self.step, (*point, number, *weights)),
            "accept": (self.accept, (*point, *memory, number, *weights)),
        }
        return {name: _program_of(*given[name]) for name in self.names}


def _program_of(function: Callable[..., Any], given: tuple[Any, ...]) -> Any:
    """A function as a program; where JAX cannot differentiate a call of the host in it, that is what stands in the way
    of C code, too."""
    try:
        return jax.make_jaxpr(function)(*given)
    except ValueError as error:
        if "callback" not in str(error):
            raise
        raise ModelError(
            "a function of this model calls the host (jax.pure_callback or io_callback), which C code cannot: write it "
            "with jax.numpy"
        ) from error


def _given_at_start(system: AcausalSystem) -> np.ndarray:
    """The unknowns of blocks at the start."""
    quantities = given_quantities(system.plan)
    return np.asarray(system.at(0.0).quantities(system.initialize(), quantities, np.ones(len(quantities))))


def _name_of_leaf(path: Sequence[Any]) -> str:
    """The name of an array of a network: 'drag.layers[0].weight'."""
    out = ""
    for key in path:
        if isinstance(key, jax.tree_util.DictKey):
            out += f".{key.key}"
        elif isinstance(key, jax.tree_util.GetAttrKey):
            out += f".{key.name}"
        elif isinstance(key, jax.tree_util.SequenceKey):
            out += f"[{key.idx}]"
        else:
            out += f"[{getattr(key, 'key', 0)}]"
    return out.removeprefix(".")


def check_exportable(system: AcausalSystem) -> None:
    """Checks that an FMU can be made of a system.

    **Raises:**

    - `ModelError` for a batch of systems, for single precision, and for an input that the model differentiates.
    """
    if system.parameters.batch:
        raise ModelError("an FMU is one system, and this is a batch of them: take one, with its own parameters")
    if system.parameters.values.dtype != np.float64:
        raise ModelError(
            f"an FMU computes in double precision, and this system has {system.parameters.values.dtype} numbers: "
            'jax.config.update("jax_enable_x64", True) before it is compiled'
        )
    system.plan.refuse_delays("an exported model keeps no past: put library.signal.PadeDelay in its place")
    table = system.plan.inputs
    differentiated = [table.names[k] for k, order in zip(table.owner, table.order, strict=True) if order]
    if differentiated:
        raise ModelError(
            f"the model differentiates the input '{differentiated[0]}', whose derivatives an FMU is not given: put a "
            "state between, as a filter of first order"
        )
