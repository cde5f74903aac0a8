"""Gradient steps on a loss of one's own, where there are no records to fit: a design, a controller, a policy."""

import dataclasses
import html
import math
import numbers
import warnings
from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from tqdm import tqdm

from ..base.aliases import Numeric, PyTree
from ..base.errors import InitializationError, ModelError, SimulationError, SteadyStateError, explained_keywords
from ..compile.diagnosis.unused_parameters import unused_parameters
from ..compile.diagnosis.wording import listed
from ..host.cache import PROGRAMS
from ..host.staging import is_traced
from ..run.system.bounds import project
from ..run.system.system import AcausalSystem
from ..write.interval import Interval

# Steps from which their program is optimized: that takes 2.5 times the quick compilation, 10 to 30 processor seconds,
# and makes steps of 1 to 45 ms 5 % faster (tutorial, a large drive).
MANY = 10_000

Model = TypeVar("Model", bound=eqx.Module)


@dataclasses.dataclass(frozen=True, repr=False)
class Minimized(Generic[Model]):
    """The result of `minimize`.

    - `model`: the best iterate, of the same structure as the model given.
    - `last`: the last iterate.
    - `history`: the losses, `history[k]` after k updates; shape `(steps + 1,)`, or shorter if stopped early.
    - `best_step`, `best_loss`: where the best iterate was found.
    - `message`: why the steps ended.
    """

    model: Model
    last: Model
    history: np.ndarray
    best_step: int
    best_loss: float
    message: str

    def __repr__(self):
        first, best = self.history[0], self.best_loss
        return f"Minimized(loss {first:.6g} → {best:.6g}, best after {self.best_step} steps: {self.message})"

    def _repr_html_(self) -> str:
        """The outcome for a notebook; the model folds."""
        model = getattr(self.model, "_repr_html_", lambda: f"<code>{html.escape(repr(self.model))}</code>")()
        return f"<p><code>{html.escape(repr(self))}</code></p><details><summary>model</summary>{model}</details>"


@explained_keywords()
def minimize(
    model: Model,
    loss: Callable[..., Numeric],
    optimizer: optax.GradientTransformation,
    steps: int,
    *,
    train: Sequence[str] | PyTree = None,
    args: tuple = (),
    progress: bool = True,
) -> Minimized[Model]:
    """Minimizes any loss by gradient steps; keeps the best iterate.

    The loss, and whatever it reads of its surroundings, counts as it is when `minimize` is called.

    Use it for losses that are not fits to records: the losses of a converter, the error of a controller, the cost of a
    house. Fit records with `Problem`, which takes far better steps and returns intervals.

    Declared bounds of parameters hold in every iterate: a step is projected onto a closed end, and goes at most nine
    tenths of the way to an open end. A parameter that is an expression in trained ones may leave its bounds; a
    `RuntimeWarning` then says so.

    **Arguments:**

    - `model`: an `AcausalSystem`, or any Equinox module, such as a controller whose loss simulates a system.
    - `loss`: `loss(model, *args)`, a scalar; it is compiled once, with its gradient and the update.
    - `optimizer`: such as `optax.adam(0.02)`.
    - `steps`: the number of updates.
    - `train`: for a system, names of networks and parameters (default: all its networks); for another module, a filter
        as in `equinox.partition` (default: all its inexact arrays).
    - `args`: further arguments of the loss, such as a system. New values of arrays among them compile nothing.
    - `progress`: shows a bar with the loss.

    **Returns:**

    A `Minimized`. If the loss or its gradient is not finite, the steps stop with a `RuntimeWarning`, and the best
    iterate so far is returned. The warning gives the reason if a simulation failed. Another warning names trained
    parameters that nothing in the model reads.

    **Raises:**

    - `ModelError` if the loss is not a real scalar or not finite at the start, if arrays in `args` are not finite, if
        nothing is to be trained, and inside jit, grad and vmap.
    """
    _check(model, loss, optimizer, steps, args)
    trainable, frozen = _split(model, train)
    if not jax.tree.leaves(trainable):
        raise ModelError("nothing is to be trained: `train` selects no arrays of the model")
    _check_args(args)
    bounds = _bounds(trainable)
    # Updates make weakly typed leaves strong, which would compile the step again.
    trainable = jax.tree.map(lambda w: jnp.asarray(w, w.dtype) if eqx.is_array(w) else w, trainable)

    def step_of(trainable, frozen, state, args):
        def objective(trainable):
            value = loss(_merged(eqx.combine(trainable, frozen)), *args)
            is_array = isinstance(value, jax.Array | np.ndarray)
            is_real = jnp.issubdtype(value.dtype, jnp.floating) if is_array else isinstance(value, float)
            if not is_real or jnp.shape(value) != ():
                found = f"shape {value.shape} of {value.dtype}" if is_array else repr(value)
                raise ModelError(f"the loss must return a real scalar; got {found}")
            return value

        value, gradient = eqx.filter_value_and_grad(objective)(trainable)
        finite = jnp.array([jnp.isfinite(g).all() for g in jax.tree.leaves(gradient)]).all()
        with jax.numpy_dtype_promotion("standard"):  # Optax raises floats to integer powers
            updates, state = optimizer.update(gradient, state, trainable)
        following = eqx.apply_updates(trainable, updates)
        if bounds:
            old, new = trainable.parameters.free, following.parameters.free
            following = eqx.tree_at(lambda s: s.parameters.free, following, project(new, old, bounds))
        return value, finite, following, state

    step = PROGRAMS.looped(step_of, optimize=steps >= MANY)
    with jax.numpy_dtype_promotion("standard"):
        state = optimizer.init(eqx.filter(trainable, eqx.is_inexact_array))
    history: list[float] = []
    best, best_step, message = trainable, 0, f"all {steps} steps were taken"
    with tqdm(total=steps, disable=not progress, desc="minimize", unit="step") as bar:
        # A step returns the loss before its update, so the loss of the last iterate takes one more.
        for k in range(steps + 1):
            value, finite, following, following_state = step(trainable, frozen, state, args)
            number = float(value)
            is_finite = math.isfinite(number) and bool(finite)
            if not is_finite and k == 0:
                why = _why(loss, _merged(eqx.combine(trainable, frozen)), args)
                raise ModelError(f"{_what(number)} at the start: {why or 'check args, and what the loss computes'}")
            if math.isfinite(number):
                history.append(number)
                if number < history[best_step]:
                    best, best_step = trainable, k
            if not is_finite:
                why = _why(loss, _merged(eqx.combine(trainable, frozen)), args)
                message = (
                    f"stopped after {k} updates: {_what(number)}{f' ({why})' if why else ''}. The best iterate, after "
                    f"{best_step} updates, is returned; a smaller learning rate or optax.clip_by_global_norm may help"
                )
                warnings.warn(message, RuntimeWarning, stacklevel=3)
                break
            if k < steps:
                trainable, state = following, following_state
                bar.update()
                bar.set_postfix(loss=f"{number:.3e}", best=f"{history[best_step]:.3e}")
    found, last = (_merged(eqx.combine(weights, frozen)) for weights in (best, trainable))
    _check_dependents(found)
    return Minimized(found, last, np.array(history), best_step, history[best_step], message)


def _check(model: object, loss: object, optimizer: object, steps: object, args: object) -> None:
    """Refuses arguments that `minimize` does not take."""
    if not isinstance(steps, numbers.Integral) or isinstance(steps, bool) or steps < 0:
        raise ModelError(f"steps must be a number of updates ≥ 0; got {steps!r}")
    if not callable(loss):
        raise ModelError(f"loss is a function of the model, loss(model, *args); got {loss!r}")
    if not isinstance(args, tuple):
        raise ModelError(f"args is a tuple of further arguments, args=(data,); got {type(args).__name__}")
    if is_traced((model, args)):
        raise ModelError("minimize takes its steps in Python: call it outside jit, grad and vmap")
    if not isinstance(optimizer, optax.GradientTransformation):
        raise ModelError(f"optimizer must be one of Optax, such as optax.adam(0.02); got {optimizer!r}")


def _split(model: PyTree, train: PyTree) -> tuple[PyTree, PyTree]:
    """(trainable, frozen) parts of a model."""
    if isinstance(model, AcausalSystem):
        names = tuple(model.neural) if train is None else (train,) if isinstance(train, str) else tuple(train)
        if train is None and not names:
            raise ModelError("this system has no networks: say what to train, train=['component.parameter', …]")
        trainable, frozen = model.partition(*names)
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
            stacklevel=5,
        )


def _merged(model: PyTree) -> PyTree:
    return model.merged() if isinstance(model, AcausalSystem) else model


def _bounds(trainable: PyTree) -> tuple[Interval, ...]:
    """The bounds of the parameters that are trained, in the order of `parameters.free`."""
    if not isinstance(trainable, AcausalSystem) or trainable.parameters.free is None:
        return ()
    parameters = trainable.parameters
    return tuple(parameters.table.intervals[k] for k in parameters.free_index)


def _check_dependents(model: PyTree) -> None:
    problem = model.parameters.problem if isinstance(model, AcausalSystem) else None
    if problem is not None:
        warnings.warn(f"{problem}. Bound the parameters it depends on, too", RuntimeWarning, stacklevel=4)


def _check_args(args: tuple) -> None:
    for path, leaf in jax.tree_util.tree_leaves_with_path(args):
        if eqx.is_inexact_array_like(leaf) and not np.isfinite(np.asarray(leaf)).all():
            raise ModelError(f"arguments are not finite: args{jax.tree_util.keystr(path)} has NaN or infinite entries")


def _what(loss: float) -> str:
    return "the gradient of the loss is not finite" if math.isfinite(loss) else f"the loss is {loss}"


def _why(loss: Callable[..., Numeric], model: PyTree, args: tuple) -> str:
    """The text of the error that a run inside the loss raises outside a compiled program; "" if it raises none."""
    try:
        loss(model, *args)
    except (InitializationError, ModelError, SimulationError, SteadyStateError) as error:
        return str(error)
    return ""
