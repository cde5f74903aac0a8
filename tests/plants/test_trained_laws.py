"""Every kind of law is learned from noisy records, with a prior whose precision the data choose: one model for all."""

import jax
import numpy as np
import pytest
import scipy.integrate
from problems import compiled
from sympy import Eq

from jaxonomy_dae import Component, EqnEnv, der
from jaxonomy_dae.learning import (
    Bounded,
    Conservative,
    Dissipation,
    Experiment,
    IsotropicPassive,
    Monotone,
    Odd,
    Passive,
    PortHamiltonian,
    Positive,
    Problem,
)

SMALL = {"width": 6, "depth": 1}
NOISE = 1e-2
TIMES = np.linspace(0.0, 3.0, 61)[1:]


def zoo():
    """By law: the network, its states and their starts; x' = law(x) but where said below. Truths are of other forms
    than the networks."""
    keys = iter(jax.random.split(jax.random.key(4), 9))
    return {
        "passive": (Passive(key=next(keys), inputs=2.0, power=4.0, **SMALL), {"a": 2.0}),
        "isotropic": (IsotropicPassive(2, key=next(keys), inputs=2.0, power=4.0, **SMALL), {"b": 2.0, "c": -0.5}),
        "dissipation": (Dissipation(2, key=next(keys)), {"d": 1.0, "e": 0.5}),
        "port": (PortHamiltonian(2, key=next(keys), **SMALL), {"f": 1.0, "g": 0.0}),
        "conservative": (Conservative(1, key=next(keys), **SMALL), {"h": 1.0, "i": 0.0}),  # h' = i, i' = law(h)
        "odd": (Odd(key=next(keys), **SMALL), {"j": 1.5}),
        "monotone": (Monotone(1, 1, False, key=next(keys), width=6), {"k": 2.0}),
        "bounded": (Bounded(-2.0, 0.0, key=next(keys), **SMALL), {"m": 2.0}),
        "positive": (Positive(key=next(keys), **SMALL), {"n": 0.1}),
    }


def truth(t, s):
    a, b, c, d, e, f, g, h, i, j, k, m, n = s
    speed = np.hypot(b, c)
    return [
        -a - 0.5 * a * abs(a), -0.8 * speed * b, -0.8 * speed * c, -0.6 * d + 1.2 * e, -1.2 * d - 0.1 * e,
        g, -f - 0.5 * f**3 - 0.3 * g, i, -h - h**3, -1.2 * np.sin(j), 1.0 - k - 0.2 * k**3,
        -1.0 - 0.8 * np.cos(m), 0.5 + 0.3 * n**2,
    ]  # fmt: skip


class Zoo(Component):
    """Systems that know nothing of each other."""

    def __init__(self, ev, laws):
        super().__init__(ev, "z")
        for name, (law, starts) in laws.items():
            x = [self.variable(n, start=s, fixed=True) for n, s in starts.items()]
            found = self.learned(name, law, x[:1] if name == "conservative" else x)
            right = (x[1], *found) if name == "conservative" else found
            self.add_equations(*(Eq(der(v), f) for v, f in zip(x, right, strict=True)))


@pytest.mark.slow
def test_every_law_is_learned_from_noise():
    laws = zoo()
    names = [n for _, starts in laws.values() for n in starts]
    starts = [s for _, starts in laws.values() for s in starts.values()]
    clean = scipy.integrate.solve_ivp(truth, (0, 3), starts, "DOP853", TIMES, rtol=1e-11, atol=1e-12).y
    rng = np.random.default_rng(0)
    data = {f"z.{n}": x + NOISE * rng.standard_normal(len(TIMES)) for n, x in zip(names, clean, strict=True)}
    fit = Problem(compiled(Zoo(EqnEnv(), laws)), Experiment(TIMES, data, sigma=NOISE)).fit(adam=100)
    assert fit.minimum.converged and 0.85 < fit.chi2 / fit.freedom < 1.15
    assert all(1 <= fit.effective[f"z.{name}"] <= 20 for name in laws)  # of 4 to 60 weights
    predicted = fit.predict([f"z.{n}" for n in names])
    for name, x in zip(names, clean, strict=True):
        error = predicted.mean[f"z.{name}"] - x
        assert np.sqrt(np.mean(error**2)) < NOISE, name  # better than any one sample
