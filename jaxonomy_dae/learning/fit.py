"""Training: gradient descent with Optax, and nonlinear least squares with Optimistix."""

import dataclasses
import functools
import html
import math
import warnings
from collections.abc import Callable, Sequence
from typing import Any, Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
from tqdm import tqdm

from ..adjoint.default import forward_mode
from ..diagnosis.unused_parameters import unused_parameters
from ..diagnosis.wording import listed
from ..errors import InitializationError, ModelError, SimulationError, SteadyStateError
from ..modeling.interval import Interval
from ..private_names import with_high_cutoff
from ..programs.cache import compiled
from ..system.bounds import Unbounded, project
from ..system.system import AcausalSystem

Model = TypeVar("Model", bound=eqx.Module)


@dataclasses.dataclass(frozen=True, repr=False)
class Fit(Generic[Model]):
    """The outcome of a training run.

    - `model`: the best iterate, of the same structure as the model given.
    - `last`: the last iterate.
    - `history`: the losses, `history[k]` after k updates; shape `(steps + 1,)`, or shorter if stopped early.
    - `best_step`, `best_loss`: where the best iterate was found.
    - `message`: why the run ended.
    """

    model: Model
    last: Model
    history: np.ndarray
    best_step: int
    best_loss: float
    message: str

    def __repr__(self):
        first = f"{self.history[0]:.6g}" if len(self.history) else "none"
        return f"Fit(loss {first} → {self.best_loss:.6g}, best after {self.best_step} steps: {self.message})"

    def _repr_html_(self) -> str:
        """The outcome for a notebook; the model folds."""
        model = getattr(self.model, "_repr_html_", lambda: f"<code>{html.escape(repr(self.model))}</code>")()
        return f"<p><code>{html.escape(repr(self))}</code></p><details><summary>model</summary>{model}</details>"


def split(model: Any, train: Any) -> tuple[Any, Any]:
    """(trainable, frozen) parts of a model; `train` as in `fit`."""
    if isinstance(model, AcausalSystem):
        if train is None:
            train = tuple(model.neural)
            if not train:
                raise ModelError("this system has no networks: say what to train, train=['component.parameter', …]")
        if isinstance(train, str):
            train = (train,)
        trainable, frozen = model.partition(*train)
        _warn_of_unused(trainable)
        return trainable, frozen
    return eqx.partition(model, eqx.is_inexact_array if train is None else train)


def _warn_of_unused(trainable: AcausalSystem) -> None:
    """A loss may read such a parameter itself, so this is no error."""
    table = trainable.parameters.table
    free = trainable.parameters.free_index if trainable.parameters.free is not None else ()
    unused = [table.names[k] for k in unused_parameters(trainable.plan.flat) if k in free]
    if unused:
        warnings.warn(
            f"train: nothing in the model reads {listed(unused, 12)}, so no trajectory depends on it: was the number "
            "used in an equation, instead of what self.parameter(...) returns?",
            RuntimeWarning,
            stacklevel=4,
        )


def _merged(model: Any) -> Any:
    return model.merged() if isinstance(model, AcausalSystem) else model


def _bounds(trainable: Any) -> tuple[Interval, ...]:
    """The bounds of the parameters that are trained, in the order of `parameters.free`."""
    if not isinstance(trainable, AcausalSystem) or trainable.parameters.free is None:
        return ()
    parameters = trainable.parameters
    return tuple(parameters.table.intervals[k] for k in parameters.free_index)


def _with_free(trainable: Any, values: Any) -> Any:
    return eqx.tree_at(lambda s: s.parameters.free, trainable, values)


def _check_dependents(model: Any) -> None:
    problem = model.parameters.problem if isinstance(model, AcausalSystem) else None
    if problem is not None:
        warnings.warn(f"{problem}. Bound the parameters it depends on, too", RuntimeWarning, stacklevel=3)


def _check_data(args: tuple) -> None:
    for path, leaf in jax.tree_util.tree_leaves_with_path(args):
        if eqx.is_inexact_array_like(leaf) and not np.isfinite(np.asarray(leaf)).all():
            raise ModelError(f"the data are not finite: args{jax.tree_util.keystr(path)} has NaN or infinite entries")


def _why(function: Callable[..., Any], model: Any, args: tuple) -> str:
    """What a run inside a function says of its failure where it is not compiled into a program; or nothing."""
    try:
        function(model, *args)
    except (InitializationError, ModelError, SimulationError, SteadyStateError) as error:
        return str(error)
    return ""


def fit(
    model: Model,
    loss: Callable[..., Any],
    optimizer: optax.GradientTransformation,
    steps: int,
    *,
    train: Sequence[str] | Any = None,
    args: tuple = (),
    progress: bool = True,
) -> Fit[Model]:
    """Minimises a loss by gradient steps; keeps the best iterate.

    Declared bounds of parameters hold in every iterate: a step is projected onto a closed end, and towards an open end
    goes nine tenths of the way at most. A parameter that is an expression in trained ones may leave its bounds, which a
    `RuntimeWarning` then says.

    **Arguments:**

    - `model`: an `AcausalSystem`, or any Equinox module.
    - `loss`: `loss(model, *args)`, a scalar; it is compiled once, with its gradient and the update.
    - `optimizer`: such as `optax.adam(0.02)`.
    - `steps`: how many updates.
    - `train`: for a system, names of networks and parameters (default: all its networks); for another module, a filter
        as in `equinox.partition` (default: all its inexact arrays).
    - `args`: further arguments of the loss, such as data.
    - `progress`: shows a bar with the loss.

    **Returns:**

    A `Fit`. If the loss or its gradient is not finite, the run stops with a `RuntimeWarning`, which says why where a
    simulation inside fails, and the best iterate so far is returned. Another one names trained parameters that nothing
    in the model reads.

    **Raises:**

    - `ModelError` if the loss is not a scalar or not finite at the start, if arrays in `args` are not finite, or if
        nothing is to be trained.
    """
    if not isinstance(steps, int) or steps < 0:
        raise ModelError(f"steps must be a number of updates ≥ 0; got {steps!r}")
    if not isinstance(optimizer, optax.GradientTransformation):
        raise ModelError(f"optimizer must be one of Optax, such as optax.adam(0.02); got {optimizer!r}")
    trainable, frozen = split(model, train)
    if not jax.tree.leaves(trainable):
        raise ModelError("nothing is to be trained: `train` selects no arrays of the model")
    _check_data(args)
    bounds = _bounds(trainable)
    # Updates make weakly typed leaves strong, which would compile the step again.
    trainable = jax.tree.map(lambda w: jnp.asarray(w, w.dtype) if eqx.is_array(w) else w, trainable)

    @functools.partial(compiled, runs_once=False)
    def step(trainable, frozen, state, args):
        def objective(trainable):
            value = loss(_merged(eqx.combine(trainable, frozen)), *args)
            if jnp.shape(value) != ():
                raise ModelError(f"the loss must return a scalar; got shape {jnp.shape(value)}")
            return value

        value, gradient = eqx.filter_value_and_grad(objective)(trainable)
        finite = jnp.array([jnp.isfinite(g).all() for g in jax.tree.leaves(gradient)]).all()
        with jax.numpy_dtype_promotion("standard"):  # Optax raises floats to integer powers
            updates, state = optimizer.update(gradient, state, trainable)
        following = eqx.apply_updates(trainable, updates)
        if bounds:
            old, new = trainable.parameters.free, following.parameters.free
            following = _with_free(following, project(new, old, bounds))
        return value, finite, following, state

    with jax.numpy_dtype_promotion("standard"):
        state = optimizer.init(eqx.filter(trainable, eqx.is_inexact_array))
    history: list[float] = []
    best, best_step, message = trainable, 0, f"all {steps} steps were taken"
    with tqdm(total=steps, disable=not progress, desc="fit", unit="step") as bar:
        for k in range(steps + 1):
            value, finite, following, following_state = step(trainable, frozen, state, args)
            number = float(value)
            if not (math.isfinite(number) and bool(finite)):
                what = (
                    f"the loss is {number}" if not math.isfinite(number) else "the gradient of the loss is not finite"
                )
                why = _why(loss, _merged(eqx.combine(trainable, frozen)), args)
                if k == 0:
                    raise ModelError(f"{what} at the start: {why or 'check the data, and what the loss computes'}")
                if math.isfinite(number):
                    history.append(number)
                    if number < history[best_step]:
                        best, best_step = trainable, k
                message = (
                    f"stopped after {k} updates: {what}{f' ({why})' if why else ''}. The best iterate, after "
                    f"{best_step} updates, is returned; a smaller learning rate or optax.clip_by_global_norm may help"
                )
                warnings.warn(message, RuntimeWarning, stacklevel=2)
                break
            history.append(number)
            if number < history[best_step]:
                best, best_step = trainable, k
            if k < steps:
                trainable, state = following, following_state
                bar.update()
                bar.set_postfix(loss=f"{number:.3e}", best=f"{history[best_step]:.3e}")
    fitted, last = (_merged(eqx.combine(weights, frozen)) for weights in (best, trainable))
    _check_dependents(fitted)
    return Fit(fitted, last, np.array(history), best_step, history[best_step], message)


def fit_least_squares(
    model: Model,
    residuals: Callable[..., Any],
    *,
    train: Sequence[str] | Any = None,
    args: tuple = (),
    steps: int = 60,
    rtol: float = 1e-8,
    atol: float = 1e-12,
) -> Fit[Model]:
    """Minimises ½ Σ residuals² by Levenberg–Marquardt steps.

    Where data are many and weights are few this is worth far more than gradient steps. The Jacobian is found by forward
    mode, so `simulate` and `solve_dae` take `adjoint=diffrax.ForwardMode()` inside unless they are given another one.
    Give them a moderate `max_steps`: a trial step may lead where the model cannot be integrated, and is then rejected.

    Declared bounds of parameters hold in every trial: the steps are taken in unbounded coordinates, close to the
    parameters themselves well inside the bounds. An open end is approached, never reached.

    **Arguments:**

    - `model`, `train`, `args`: as in `fit`.
    - `residuals`: `residuals(model, *args)`, an array of any shape.
    - `steps`: how many steps at most.
    - `rtol`, `atol`: when to stop, relative to the weights and to the sum of squares.

    **Returns:**

    A `Fit` whose `history` has the first and the last value of ½ Σ residuals². Its `message` says whether
    the steps sufficed. If no better point was found, a `RuntimeWarning` says so; another one names trained parameters
    that nothing in the model reads.

    **Raises:**

    - `ModelError` if the residuals or arrays in `args` are not finite at the start, if they cannot be differentiated
        forwards, or if nothing is to be trained.
    """
    trainable, frozen = split(model, train)
    if not jax.tree.leaves(trainable):
        raise ModelError("nothing is to be trained: `train` selects no arrays of the model")

    _check_data(args)
    bounds = _bounds(trainable)
    coordinates = Unbounded(trainable.parameters.free, bounds) if bounds else None

    def function(trainable, extra):
        frozen, args = extra
        return jnp.ravel(residuals(_merged(eqx.combine(trainable, frozen)), *args))

    def inside(weights):
        return weights if coordinates is None else _with_free(weights, coordinates.values(weights.parameters.free))

    @functools.partial(compiled, runs_once=False)
    def run(trainable, start, frozen, args):
        solver = optx.LevenbergMarquardt(rtol=rtol, atol=atol)
        if coordinates is not None:
            # Curved coordinates spoil the prediction: by default, only steps predicted to 1 % lengthen the next.
            solver = with_high_cutoff(solver, 0.5)
        found = optx.least_squares(
            lambda z, extra: function(inside(z), extra), solver, start, (frozen, args), max_steps=steps, throw=False
        )
        value = inside(found.value)
        cost = [0.5 * jnp.sum(function(w, (frozen, args)) ** 2) for w in (trainable, value)]
        converged = found.result == optx.RESULTS.successful
        return value, found.stats["num_steps"], cost, converged

    start = trainable if coordinates is None else _with_free(trainable, coordinates.start)
    try:
        with forward_mode():
            found, taken, cost, converged = run(trainable, start, frozen, args)
    except TypeError as error:
        if "forward-mode" not in str(error):
            raise
        raise ModelError(
            "the residuals cannot be differentiated forwards: a simulation inside was given another adjoint, or was "
            "traced before. Leave `adjoint` out, or give adjoint=diffrax.ForwardMode()"
        ) from error
    first, last = (float(c) for c in cost)
    if not math.isfinite(first):
        why = _why(residuals, model, args)
        raise ModelError(f"the residuals are not finite at the start: {why or 'check the data, and what they compute'}")
    if not last <= first:
        warnings.warn(
            "least squares found no better point; the model is returned unchanged", RuntimeWarning, stacklevel=2
        )
        return Fit(model, model, np.array([first]), 0, first, "no better point was found")
    fitted = _merged(eqx.combine(found, frozen))
    _check_dependents(fitted)
    message = f"converged after {int(taken)} steps"
    if not converged:
        message = f"stopped after {int(taken)} steps, not yet converged; `steps` allows more"
    return Fit(fitted, fitted, np.array([first, last]), int(taken), last, message)
