"""Signals that come from nowhere: functions of time."""

import jax
import jax.numpy as jnp
import numpy as np
from sympy import Max, Min

from ...errors import ModelError
from ...modeling import NONNEGATIVE, POSITIVE, Component, EqnEnv, Value
from ..laws import pulse, sine, step


class Constant(Component):
    """y = k."""

    def __init__(self, ev: EqnEnv, name: str, k: Value = 1.0):
        super().__init__(ev, name)
        self.output("y", self.parameter("k", k))


class Step(Component):
    """y = offset, and offset + height from `start_time` (second) on. The step is an event."""

    def __init__(self, ev: EqnEnv, name: str, height: Value = 1.0, start_time: Value = 0.0, offset: Value = 0.0):
        super().__init__(ev, name)
        self.output("y", step(self, height, start_time, offset, unit=""))


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


class Sine(Component):
    """y = offset + amplitude·sin(2π·frequency·t + phase), in hertz and radian."""

    def __init__(
        self,
        ev: EqnEnv,
        name: str,
        amplitude: Value = 1.0,
        frequency: Value = 1.0,
        phase: Value = 0.0,
        offset: Value = 0.0,
    ):
        super().__init__(ev, name)
        self.output("y", sine(self, amplitude, frequency, phase, offset, unit=""))


class Pulse(Component):
    """y = offset + height in the first part `width` (0 to 1) of every `period` (second) from `start_time` on, else
    offset. Its edges are events."""

    def __init__(
        self,
        ev: EqnEnv,
        name: str,
        height: Value = 1.0,
        period: Value = 1.0,
        width: Value = 0.5,
        start_time: Value = 0.0,
        offset: Value = 0.0,
    ):
        super().__init__(ev, name)
        self.output("y", pulse(self, height, period, width, start_time, offset, unit=""))


class Noise(Component):
    """y runs in straight lines between independent normal values of standard deviation `std`, one every `interval` > 0
    seconds: the same for the same `key` (`jax.random.key(0)`) however long the run. Its kinks are not step ends: give
    `simulate(dtmax=...)` where single values matter."""

    def __init__(self, ev: EqnEnv, name: str, key: jax.Array, std: Value = 1.0, interval: float = 1.0):
        super().__init__(ev, name)
        if not isinstance(interval, float | int | np.number) or not interval > 0:
            raise ModelError(f"'{name}': interval must be a number > 0; got {interval!r}")
        if not isinstance(key, jax.Array):
            raise ModelError(f"'{name}': key is a key of random numbers, such as jax.random.key(0); got {key!r}")
        size = self.parameter("std", std, bounds=NONNEGATIVE)

        def value(t):
            count = jnp.floor(t / interval)
            number = count.astype(jnp.int32)
            first, second = (jax.random.normal(jax.random.fold_in(key, number + k), dtype=t.dtype) for k in (0, 1))
            return first + (second - first) * (t / interval - count)

        (unit,) = self.function("unit", value, inputs=[ev.t])
        self.output("y", size * unit)
