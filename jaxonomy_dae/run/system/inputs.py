"""Inputs: what a user gives for them, as data that a compiled program reads.

`read_inputs` turns constants, samples, Diffrax interpolations and functions of time into callable pytrees or arrays:
everything a function reads from its surroundings is read when it is given, and is a leaf. What has been read already
passes unchanged; what is given for an array of inputs stays one array. `step_ends` says where steps must end, so that
no sample is stepped over.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ...base.errors import ModelError, nearest
from ...compile.lowering.plan import SystemPlan
from ...compile.model.array_names import regular_shape, wrong_shape
from ...host.staging import as_array, is_traced, on_device
from ...write.networks import uses_numpy, why_untraceable
from .closed_function import ClosedFunction, closed_function
from .splines import natural_spline

KINDS = ("linear", "spline", "cubic", "held")
CURVED = ("spline", "cubic")  # whose slopes follow from several samples
EXAMPLE = "inputs={'m.u': (times, values)}, or (times, values, 'held') or 'spline'"


class HeldPath(eqx.Module):
    """Samples held until the next one; where they jump, the new value counts."""

    ts: Float[Array, " n"]
    ys: Float[Array, " n *shape"]

    def evaluate(self, t: Any) -> Any:
        """The last sample at or before t."""
        return self.ys[jnp.clip(jnp.searchsorted(self.ts, t, side="right") - 1, 0, len(self.ts) - 1)]


class SampledInput(eqx.Module):
    """An interpolated input. Its derivatives up to order `smoothness` are continuous: 0 for linear interpolation, 1 for
    causal cubic curves, 2 for splines, −1 for samples that are held."""

    path: Any
    smoothness: int = eqx.field(static=True)

    def __call__(self, t: Any) -> Any:
        return self.path.evaluate(t)


def any_held(inputs: Mapping[str, Any]) -> bool:
    """True if there are samples that are held."""
    return any(isinstance(source, SampledInput) and source.smoothness < 0 for source in map(_whole, inputs.values()))


def _whole(source: Any) -> Any:
    return source.source if isinstance(source, Entry) else source


def from_then_on(inputs: Mapping[str, Any], resolution: Any) -> dict[str, Any]:
    """Inputs as what happens at an instant reads them: a sample that is held from that instant on is the new one, on
    whichever side of it rounding has put the sample's time. Times closer than the `resolution` are one instant."""

    def read(source: Any) -> Any:
        if isinstance(source, Entry):
            return Entry(read(source.source), source.index)
        if isinstance(source, SampledInput) and isinstance(source.path, HeldPath):
            return SampledInput(HeldPath(source.path.ts - resolution, source.path.ys), source.smoothness)
        return source

    return {name: read(source) for name, source in inputs.items()}


class Entry(eqx.Module):
    """One input of an array of them: `index` counts its entries row by row."""

    source: Any
    index: int = eqx.field(static=True)

    def __call__(self, t: Any) -> Any:
        found = value_at(self.source, t)
        return jnp.ravel(found)[self.index] if jnp.ndim(found) else found


def value_at(source: Any, t: Any) -> Any:
    """The value of what has been read, at a time."""
    return source(t) if callable(source) else source


def read_inputs(plan: SystemPlan, dtype: Any, inputs: Mapping[str, Any] | None) -> dict[str, Any]:
    """Inputs by name as callable pytrees and arrays of the given dtype: scalars, or for the name of an array of inputs,
    scalars for all of them or arrays in its shape.

    **Raises:**

    - `ModelError` that names an input which does not exist or cannot be read, and says what can be given.
    """
    if inputs is None:
        return {}
    if not isinstance(inputs, Mapping):
        raise ModelError(f"inputs is a dictionary by names: {EXAMPLE}; got {type(inputs).__name__}")
    found = {}
    covered = np.zeros(len(plan.inputs.names), bool)
    for name, value in inputs.items():
        places = plan.input_places(name)
        if places is None:
            raise ModelError(f"'{name}' is not an input of this system: " + nearest(name, plan.inputs.names))
        if covered[places].any():
            twice = plan.inputs.names[places[covered[places]][0] if places.ndim else places]
            raise ModelError(f"inputs: '{twice}' is given twice, by its own name and as part of an array")
        covered[places] = True
        found[name] = _read(name, value, dtype, places.shape)
    return found


def _read(name: str, value: Any, dtype: Any, shape: tuple[int, ...]) -> Any:
    """Reads the value given for an input, or for an array of inputs of this shape."""
    if isinstance(value, SampledInput | ClosedFunction | Entry):
        return value
    if isinstance(value, diffrax.LinearInterpolation | diffrax.CubicInterpolation):
        return _interpolation(name, value, shape)
    # A path of another kind shows no samples at which steps could end, so it is read as a function of time.
    if isinstance(value, diffrax.AbstractPath):
        value = value.evaluate
    if callable(value):
        return _function(name, value, dtype, shape)
    if isinstance(value, tuple | list) and len(value) in (2, 3):
        if shape and regular_shape(value) == shape:
            raise ModelError(
                f"inputs: '{name}' is an array of shape {shape}, and a list may be samples: give values as a NumPy "
                "array, or samples of shape (times, *shape) as (times, values)"
            )
        if len(regular_shape(value[0]) or ()) == 1:
            return _samples(name, value, dtype, shape)
    if shape:
        return _constants(name, value, dtype, shape)
    return _constant(name, value, dtype)


def _constants(name: str, value: Any, dtype: Any, shape: tuple[int, ...]) -> Any:
    """Numbers for an array of inputs, in its shape."""
    found = regular_shape(value)
    if found == ():
        return _constant(name, value, dtype)
    if found != shape:
        raise ModelError(f"inputs: {wrong_shape(name, shape, value)}")
    array = value if isinstance(value, jax.Array) else as_array(value)
    if array.dtype.kind not in "biuf":
        raise ModelError(f"inputs: '{name}' must be real numbers; got {array.dtype}")
    if not is_traced(array) and not np.isfinite(array).all():
        index = tuple(np.argwhere(~np.isfinite(np.asarray(array)))[0].tolist())
        raise ModelError(f"input '{name}' must be finite; its entry {list(index)} is {array[index]}")
    return on_device(array, dtype)


def _constant(name: str, value: Any, dtype: Any) -> Any:
    if isinstance(value, str):
        raise ModelError(f"input '{name}' must be a number, samples or a function of time; got the text {value!r}")
    try:
        # By NumPy where the value is known, since JAX would compile a program for the conversion.
        array = jnp.asarray(value) if is_traced(value) else np.asarray(value)
        if array.dtype.kind not in "biufcV":  # V: numbers of eight bits and the like
            raise TypeError
    except (TypeError, ValueError):
        raise ModelError(
            f"input '{name}' must be a number, samples or a function of time; got {type(value).__name__}. For samples "
            f"give {EXAMPLE}"
        ) from None
    if array.shape != ():
        raise ModelError(
            f"input '{name}' must be a number, samples or a function of time; got shape {array.shape}. For samples "
            f"give their times too: {EXAMPLE}"
        )
    if jnp.issubdtype(array.dtype, jnp.complexfloating):
        raise ModelError(
            f"input '{name}' must be real; got {array.dtype}: give jnp.real(…) and jnp.imag(…) as two inputs"
        )
    if not is_traced(array) and not np.isfinite(array):
        raise ModelError(f"input '{name}' must be finite; got {array}")
    return on_device(array, dtype)


# --- functions -----------------------------------------------------------------------------------------------------


def _function(name: str, function: Callable[[Any], Any], dtype: Any, allowed: tuple[int, ...]) -> ClosedFunction:
    try:
        out = jax.eval_shape(lambda t: function(t), jax.ShapeDtypeStruct((), dtype))
    except Exception as error:
        why = why_untraceable(error, "the time", "t")
        samples = f", or give the samples themselves: {EXAMPLE}" if uses_numpy(error) else ""
        raise ModelError(f"input '{name}' {why}{samples}") from error
    shape = getattr(out, "shape", None)
    if shape not in ((), allowed):
        found = "nothing" if out is None else f"shape {shape}" if shape is not None else type(out).__name__
        wanted = f"one number or an array of shape {allowed}" if allowed else "one number"
        raise ModelError(f"input '{name}' must return {wanted} for a time; it returned {found}")
    if jnp.issubdtype(out.dtype, jnp.complexfloating):  # pyright: ignore[reportAttributeAccessIssue]
        raise ModelError(f"input '{name}' must be real; it returned {out.dtype}")  # pyright: ignore
    return closed_function(lambda t: jnp.asarray(function(t), dtype), dtype)


# --- samples -------------------------------------------------------------------------------------------------------


def _samples(name: str, given: tuple[Any, ...] | list[Any], dtype: Any, shape: tuple[int, ...]) -> SampledInput:
    kind = given[2] if len(given) == 3 else "linear"
    if kind not in KINDS:
        raise ModelError(f"input '{name}': samples are 'linear', 'spline', 'cubic' or 'held'; got {kind!r}")
    times = _column(name, "times", given[0], dtype)
    for_each = shape and len(regular_shape(given[1]) or ()) > 1
    values = _column(name, "values", given[1], dtype, shape if for_each else ())
    if times.shape != values.shape[:1]:
        raise ModelError(
            f"input '{name}' needs a value for every time; got {times.shape[0]} times and {values.shape[0]} values"
        )
    least = 1 if kind == "held" else 2
    if times.shape[0] < least:
        raise ModelError(f"input '{name}': {kind} samples are at least {least}; got {times.shape[0]}")
    _check_times(name, times)
    return interpolated(times, values, kind)


def interpolated(times: Float[Array, " n"], values: Float[Array, " n *shape"], kind: str) -> SampledInput:
    """Samples as an input of a kind."""
    if kind == "held":
        return SampledInput(HeldPath(times, values), -1)
    if kind == "linear":
        return SampledInput(diffrax.LinearInterpolation(times, values), 0)
    if kind == "spline":
        return SampledInput(natural_spline(times, values), 2)
    # Slopes that look backwards: no value depends on samples that come after the interval it lies in.
    return SampledInput(diffrax.CubicInterpolation(times, diffrax.backward_hermite_coefficients(times, values)), 1)


def _column(name: str, which: str, values: Any, dtype: Any, shape: tuple[int, ...] = ()) -> Any:
    """Real and finite numbers of shape (n, *shape)."""
    wanted = f"({', '.join(['n', *map(str, shape)])}{'' if shape else ','})"
    try:
        array = as_array(values)
    except (TypeError, ValueError):
        raise ModelError(f"input '{name}': {which} must have shape {wanted}") from None
    if array.ndim == 0 or array.shape[1:] != shape or array.dtype.kind not in "biuf":
        raise ModelError(
            f"input '{name}': {which} must be real numbers of shape {wanted}; got {array.dtype} of shape {array.shape}"
        )
    if not is_traced(array) and not np.isfinite(array).all():
        index = tuple(np.argwhere(~np.isfinite(array))[0].tolist())
        where = ", ".join(map(str, index))
        raise ModelError(f"input '{name}': {which}[{where}] is {array[index]}; leave the sample out")
    # A copy: JAX may share memory with NumPy's array, to which its owner may write later.
    return jnp.array(array, dtype, copy=True)


def _check_times(name: str, times: Any):
    if is_traced(times):
        return
    found = np.flatnonzero(~(np.diff(np.asarray(times, float)) > 0))
    if len(found):
        k = int(found[0])
        raise ModelError(
            f"input '{name}': times must increase; times[{k}]={times[k]} is followed by times[{k + 1}]={times[k + 1]}. "
            "Where the input jumps, give (times, values, 'held')"
        )


def _interpolation(name: str, path: Any, shape: tuple[int, ...]) -> SampledInput:
    out = jax.eval_shape(path.evaluate, jax.ShapeDtypeStruct((), path.ts.dtype))
    if getattr(out, "shape", None) not in ((), shape):
        shapes = [leaf.shape for leaf in jax.tree.leaves(out)]
        either = f" or {('n', *shape)}".replace("'", "") if shape else ""
        raise ModelError(f"input '{name}' needs an interpolation of values of shape (n,){either}; it returns {shapes}")
    for leaf in jax.tree.leaves(path):
        if not is_traced(leaf) and not np.isfinite(np.asarray(leaf)).all():
            raise ModelError(
                f"input '{name}': a value of {type(path).__name__} is not finite: leave the sample out, or fill it "
                "with diffrax.linear_interpolation"
            )
    _check_times(name, path.ts)
    return SampledInput(path, 0 if isinstance(path, diffrax.LinearInterpolation) else 1)


SLACK = 1e-6  # of the interval: by how much samples may miss its ends, which are computed


def check_range(inputs: Mapping[str, Any], t0: Any, t1: Any):
    """Raises a `ModelError` if samples do not reach over the interval; held ones may end before it does."""
    if is_traced((t0, t1)):
        return
    for name, value in inputs.items():
        if not isinstance(value, SampledInput) or is_traced(value.path.ts):
            continue
        first, last = float(value.path.ts[0]), float(value.path.ts[-1])
        # An instant has no length by which samples may miss its ends: that of the samples stands for it.
        if not _reach_over(value, float(t0), float(t1), last - first if t0 == t1 else t1 - t0):
            if t0 == t1:
                raise ModelError(
                    f"the samples of input '{name}' reach from {first:g} to {last:g}, and t={float(t0):g} is not among "
                    "them: give samples there too"
                )
            raise ModelError(
                f"the samples of input '{name}' reach from {first:g} to {last:g}, the run from {float(t0):g} to "
                f"{float(t1):g}: give samples for all of it, or integrate over less"
            )


def _reach_over(sampled: SampledInput, t0: Any, t1: Any, length: Any) -> Any:
    ts, slack = sampled.path.ts, SLACK * length
    begins = ts[0] <= t0 + slack
    return begins & (ts[-1] >= t1 - slack) if sampled.smoothness >= 0 else begins


def samples_fit(inputs: Mapping[str, Any], t0: Any, t1: Any) -> Bool[Array, ""]:
    """True if the times of samples increase and reach over the interval. Where values are known, those that do not are
    refused by name."""
    sampled = [source for source in inputs.values() if isinstance(source, SampledInput)]
    fine = [_reach_over(s, t0, t1, t1 - t0) & jnp.all(jnp.diff(s.path.ts) > 0) for s in sampled]
    return jnp.all(jnp.stack(fine)) if fine else jnp.array(True)


class StepEnds(NamedTuple):
    """Times at which steps must end: `jumps` of what the equations read, where a method starts anew, and `kinks`."""

    jumps: list[Any]
    kinks: list[Any]

    @property
    def count(self) -> int:
        """The number of instants."""
        return sum(len(ts) for ts in (*self.jumps, *self.kinks))


def step_ends(plan: SystemPlan, inputs: Mapping[str, Any]) -> StepEnds:
    """The times at which samples of inputs, or the derivatives of them that the model reads, have kinks and jumps.

    **Raises:**

    - `ModelError` for an input that the model differentiates and that has no such derivative.
    """
    ends = StepEnds([], [])
    for name, value in inputs.items():
        if not isinstance(value, SampledInput):
            continue
        places = plan.input_places(name)
        highest = 0 if places is None else plan.inputs.highest(places)
        if highest > value.smoothness + 1:
            kind = {-1: "held", 0: "linear", 1: "cubic", 2: "spline"}[value.smoothness]
            better = "'spline'" if highest <= 3 else "a smooth function of time"
            raise ModelError(
                f"the model differentiates input '{name}' {_times(highest)}: {kind} samples do not have that "
                f"derivative at their times. Give {better}"
            )
        # Of samples, the derivative of order smoothness + 1 is the first that jumps.
        (ends.jumps if highest > value.smoothness else ends.kinks).append(value.path.ts)
    return ends


def _times(count: int) -> str:
    return {1: "once", 2: "twice"}.get(count, f"{count} times")
