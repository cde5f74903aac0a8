"""Sampled blocks against loops over their samples, closed forms and SciPy."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.signal
from component_references import checks, measured
from problems import compiled
from switched_runs import ORIGIN, SMOOTH, ran

import jaxonomy_dae.library.signal as sig
from jaxonomy_dae import EqnEnv

T = 0.1


NUMERATOR, DENOMINATOR = [0.5, 0.2], [2.0, -1.2, 0.5]
MIDDLES = (np.arange(60) + 0.5) * T
PERIODS = np.arange(12)
BEFORE = (PERIODS + 1) * T - 1e-6  # just before the next pulse begins


def share(t):
    return 0.6 + 0.7 * jnp.sin(7.0 * t)


@functools.cache
def sampling():
    """Sampled blocks of a wave, and the mean of pulses, in one run of 6 s."""
    ev = EqnEnv()
    wave = sig.Sine(ev, "wave", 1.0, 3 / (2 * np.pi))
    blocks = [
        sig.SampleHold(ev, "hold", T, initial_y=7.0), sig.SampledDelay(ev, "late", 3, T, initial_y=0.4),
        sig.DiscreteTransferFunction(ev, "tf", NUMERATOR, DENOMINATOR, T),
        sig.DiscretePI(ev, "pi", 2.0, 3.0, T, high=np.inf),
        sig.DiscretePI(ev, "bounded", 2.0, 3.0, T, low=-0.8, high=1.0),
        sig.DiscretePI(ev, "reverse", -2.0, -3.0, T, low=-1.0, high=0.8),
        sig.Counter(ev, "count", 0.5), sig.Hysteresis(ev, "relay", -0.3, 0.6, low=-2.0, high=5.0),
    ]  # fmt: skip
    clock = sig.Integrator(ev, "nothing")
    pulse, mean = sig.PulseWidth(ev, "pulse", T, height=5.0), sig.Integrator(ev, "mean")
    system = compiled(
        wave, *blocks, clock, pulse, mean,
        connect=[(wave.y, *(b.u for b in [*blocks, clock])), (pulse.y, mean.u)],
    )  # fmt: skip
    names = [f"{block.name}.y" for block in blocks] + ["wave.y", "mean.y"]
    return ran(system, 6.0, np.unique([*MIDDLES, *BEFORE]), names, {}, {"pulse.u": share})


@pytest.mark.slow
@checks(
    {
        sig.SampleHold: ("the samples", "hold.y"),
        sig.SampledDelay: ("the samples, later", "late.y"),
        sig.DiscreteTransferFunction: ("SciPy's dlsim", "tf.y"),
        sig.DiscretePI: ("a loop over the samples", "pi.y", "bounded.y", "reverse.y"),
        sig.Counter: ("arcsin of the threshold", "count.y"),
        sig.Hysteresis: ("a loop over fine samples", "relay.y"),
    },
    origin="sums of a few hundred roundings",
)
def test_sampled_blocks():
    """All at once, of u = sin 3t: values at the middles of the periods are functions of samples at k·T."""
    numerator, denominator = NUMERATOR, DENOMINATOR
    u, ts = np.sin(3 * np.arange(60) * T), MIDDLES
    found = sampling()
    _, filtered = scipy.signal.dlsim((numerator, denominator, T), u)
    total = np.concatenate([[0.0], np.cumsum(3.0 * T * u)])[:-1]
    bounded, kept = [], 0.0
    for v in u:
        wished = 2.0 * v + kept
        bounded.append(np.clip(wished, -0.8, 1.0))
        kept += 0.0 if wished > 1.0 and v > 0 or wished < -0.8 and v < 0 else 3.0 * T * v
    rises = np.floor((3 * ts - np.arcsin(0.5)) / (2 * np.pi)) + 1
    on, relay = False, []
    for v in np.sin(3 * np.linspace(0.0, ts[-1], 20 * 119 + 1)):  # fine enough to see every crossing
        on = v > 0.6 or (on and v >= -0.3)
        relay.append(5.0 if on else -2.0)
    # Sampled values are sums of a few hundred roundings.
    for name, expected in {
        "hold": u, "late": np.concatenate([[0.4] * 3, u[:-3]]), "tf": filtered[:, 0], "pi": 2.0 * u + total,
        "bounded": bounded, "reverse": -np.array(bounded), "count": rises, "relay": relay[20::40],
    }.items():  # fmt: skip
        measured(f"{name}.y", found.values(f"{name}.y", ts), expected, 1e-12 * max(1.0, np.abs(expected).max()))
    np.testing.assert_allclose(found.values("wave.y", ts), np.sin(3 * ts), atol=1e-12)


@pytest.mark.slow
@checks({sig.PulseWidth: ("sum of the shares", "mean.y")}, origin=ORIGIN)
def test_pulse_width():
    """The share of every period is the input at its beginning, cut to what is possible."""
    k = PERIODS
    shares = np.clip(0.6 + 0.7 * np.sin(7.0 * k * T), 0.0, 1.0)
    lost = 5.0 * 1e-6 * (shares == 1)
    assert (shares == 0).any() and (shares == 1).any() and ((0 < shares) & (shares < 1)).any()
    measured("mean.y", sampling().values("mean.y", BEFORE), 5.0 * T * np.cumsum(shares) - lost, SMOOTH)
