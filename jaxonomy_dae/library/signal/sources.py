"""Signals that come from nowhere: functions of time."""

import jax
import jax.numpy as jnp
import numpy as np
from sympy import Expr, Max, Min

from ...base.errors import ModelError
from ...write import NONNEGATIVE, POSITIVE, Component, EqnEnv, Value
from .. import waveforms


class _Source(waveforms.Driven):
    def _drive(self, value: Expr) -> None:
        self.output("y", value)


class Constant(Component):
    """y = k."""

    def __init__(self, ev: EqnEnv, name: str, k: Value = 1.0):
        super().__init__(ev, name)
        self.output("y", self.parameter("k", k))


class Step(_Source, waveforms.Step):
    """y = offset, and offset + height from `start_time` (second) on. The step is an event."""


class Ramp(Component):
    """y rises from `offset` by `height` within `duration` > 0 seconds from `start_time` on, and stays."""

    def __init__(
        self,
        ev: EqnEnv,
        name: str,
        height: Value = 1.0,
        duration: Value = 1.0,
        start_time: Value = 0.0,
        offset: Value = 0.0,
    ):
        super().__init__(ev, name)
        h, o = self.parameter("height", height), self.parameter("offset", offset)
        length = self.parameter("duration", duration, unit="s", bounds=POSITIVE)
        t0 = self.parameter("start_time", start_time, unit="s")
        self.output("y", o + h * Min(Max((ev.t - t0) / length, 0), 1))


class Sine(_Source, waveforms.Sine):
    """y = offset + amplitude·sin(2π·frequency·t + phase), in hertz and radian."""


class Pulse(_Source, waveforms.Pulse):
    """y = offset + height in the first part `width` (0 to 1) of every `period` (second) from `start_time` on, else
    offset. Its edges are events."""


class Noise(Component):
    """y runs in straight lines between independent normal values of standard deviation `std`, one every `interval` > 0
    seconds: the same for the same `key` (`jax.random.key(0)`) however long the run. Its kinks are not step ends: give
    `simulate(dtmax=...)` where single values matter."""

    def __init__(self, ev: EqnEnv, name: str, key: jax.Array, std: Value = 1.0, interval: float = 1.0):
        super().__init__(ev, name)
        if isinstance(interval, bool) or not isinstance(interval, float | int | np.number) or not 0 < interval < np.inf:
            raise ModelError(f"'{name}': interval must be a number > 0; got {interval!r}")
        if not isinstance(key, jax.Array):
            raise ModelError(f"'{name}': key is a key of random numbers, such as jax.random.key(0); got {key!r}")
        size = self.parameter("std", std, bounds=NONNEGATIVE)

        def value(t):
            # The number of an interval seeds its value, so that no sequence is stored, and any time can be asked for.
            count = jnp.floor(t / interval)
            number = count.astype(jnp.int32)
            first, second = (jax.random.normal(jax.random.fold_in(key, number + k), dtype=t.dtype) for k in (0, 1))
            return first + (second - first) * (t / interval - count)

        (unit,) = self.function("unit", value, inputs=[ev.t])
        self.output("y", size * unit)
