"""`simulate(solver=None)`: explicit where that pays, implicit where stability limits the steps, found by running."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sympy
from problems import compiled, damped_oscillation, oscillator, pendulum, rc_circuit
from sympy import Eq
from testset import PROBLEMS

from jaxonomy_dae import Component, EqnEnv, der, simulate
from jaxonomy_dae.solvers import Rodas5P
from jaxonomy_dae.system import solver_choice
from jaxonomy_dae.system.stiffness import fastest_decay

TS = jnp.array([0.5, 4.0, 10.0])


class Followers(Component):
    """x_i' = −k·(x_i − cos(w·t)) − w·sin(w·t), x_i(0) = 1: x_i = cos(w·t), however large k is (Prothero & Robinson)."""

    def __init__(self, ev, name, count, k):
        super().__init__(ev, name)
        k, w = self.parameter("k", k), self.parameter("w", 1.3)
        for i in range(count):
            x = self.variable(f"x{i}", start=1.0, fixed=True)
            self.add_equations(Eq(der(x), -k * (x - sympy.cos(w * ev.t)) - w * sympy.sin(w * ev.t)))


@pytest.fixture(scope="module")
def stiff():
    return compiled(Followers(EqnEnv(), "f", 1, 1e6))


@pytest.fixture
def forgotten():
    """What earlier runs found is forgotten."""
    solver_choice._stiffness.clear()


def test_a_stiff_model_is_finished(stiff):
    solution = simulate(stiff, 10.0, ts=TS)
    np.testing.assert_allclose(solution["f.x0"], np.cos(1.3 * np.asarray(TS)), rtol=0, atol=1e-5)
    stats = solution.stats
    assert stats["solver"] == "Rodas5P" and stats["reason"].startswith("stiff: stability limits explicit steps from t=")
    # 1e7/3.5 steps otherwise
    assert stats["num_steps"] < 300 and stats["num_explicit_steps"] < 300 and 0 < stats["stiff_from"] < 0.1


def test_the_same_model_with_other_values_is_not_stiff(stiff):
    mild = stiff.with_parameters({"f.k": 2.0})
    for _ in range(2):
        solution = simulate(mild, 10.0, ts=TS)
        assert solution.stats["solver"] == "Tsit5" and "num_explicit_steps" not in solution.stats
        np.testing.assert_allclose(solution["f.x0"], np.cos(1.3 * np.asarray(TS)), rtol=0, atol=1e-5)
        simulate(stiff, 10.0, ts=TS)


@pytest.mark.slow
def test_many_unknowns_take_bdf():
    system = compiled(Followers(EqnEnv(), "f", 40, 1e6))
    solution = simulate(system, 10.0, ts=TS)
    assert solution.stats["solver"] == "BDF" and "cheaper for 40 unknowns" in solution.stats["reason"]
    np.testing.assert_allclose(solution["f.x39"], np.cos(1.3 * np.asarray(TS)), rtol=0, atol=1e-4)


@pytest.mark.slow
def test_stiffness_that_comes_later():
    """x' = −10^t·(x − cos t) − sin t: stiff from t = 3 on."""

    class Later(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            x = self.variable("x", start=1.0, fixed=True)
            self.add_equations(Eq(der(x), -(10**ev.t) * (x - sympy.cos(ev.t)) - sympy.sin(ev.t)))

    solution = simulate(compiled(Later(EqnEnv(), "c")), 7.0, ts=jnp.array([7.0]))
    assert solution.stats["solver"] == "Rodas5P" and 2 < solution.stats["stiff_from"] < 5
    np.testing.assert_allclose(solution["c.x"], np.cos(7.0), rtol=0, atol=1e-5)


def test_fast_decay_before_a_short_end_stays_explicit():
    """Explicit steps are limited here too, but few: another solver would cost more to compile."""
    ts = jnp.array([1.0])
    solution = simulate(compiled(Followers(EqnEnv(), "f", 1, 1e3)), 1.0, ts=ts)
    assert solution.stats["solver"] == "Tsit5" and 250 < solution.stats["num_steps"] < 1000


def test_asked_for_solvers_are_not_replaced(stiff):
    solution = simulate(stiff, 10.0, ts=TS, solver=Rodas5P())
    assert "num_explicit_steps" not in solution.stats and solution.stats["reason"] == "as asked for"


# --- inside jit, grad and vmap -------------------------------------------------------------------------------------


@pytest.mark.parametrize("before", ["never run", "run"])
def test_inside_transformations(before, stiff, forgotten):
    """x = cos(w·t), ∂x/∂w = −t·sin(w·t)."""
    if before == "run":
        simulate(stiff, 10.0, ts=TS)

    @jax.jit
    @jax.vmap
    def last(w):
        def x(w):
            solution = simulate(stiff.with_parameters({"f.w": w}), 10.0, ts=TS, rtol=1e-8, atol=1e-8)
            reasons.append(solution.stats["reason"])
            return solution["f.x0"][-1]

        return jax.value_and_grad(x)(w)

    reasons = []
    w = jnp.array([1.3, 0.4])
    value, slope = last(w)
    assert ("an earlier run" if before == "run" else "stiff: at the declared start") in reasons[0]
    np.testing.assert_allclose(value, np.cos(10 * w), rtol=0, atol=1e-7)
    np.testing.assert_allclose(slope, -10 * np.sin(10 * w), rtol=0, atol=1e-6)


def test_eigenvalues_at_the_start(stiff):
    """Against closed forms: 1/(R·C), the larger root of an overdamped oscillator, none where all oscillates."""
    assert fastest_decay(rc_circuit(R=2e-3, C=0.5).plan) == pytest.approx(1e3, rel=1e-9)
    assert fastest_decay(stiff.plan) == pytest.approx(1e6, rel=1e-9)
    overdamped = oscillator(M=2.0, D=600.0, K=5.0)
    assert fastest_decay(overdamped.plan) == pytest.approx((600 + np.sqrt(600**2 - 4 * 2 * 5)) / 4, rel=1e-9)
    for system in (oscillator(), pendulum()):
        assert fastest_decay(system.plan) == 0.0


def test_eigenvalues_are_those_of_the_values_not_the_structure():
    assert [fastest_decay(rc_circuit(R=r, C=1.0).plan) for r in (1.0, 1e-3)] == pytest.approx([1.0, 1e3], rel=1e-9)


# --- saved rows inside jit -----------------------------------------------------------------------------------------


def test_the_last_row_inside_jit():
    """`ts=None`: rows beyond the last step repeat it, with its derivatives."""
    system = oscillator()

    def last(x0, read=-1):
        solution = simulate(system, 1.1, initial={"mass.s": x0}, rtol=1e-9, atol=1e-11, max_steps=64)
        return solution["mass.s"][read], solution.ts[read], solution["spring.f"][read]

    x0 = jnp.array(0.2)
    unit = damped_oscillation(np.array(1.1), x0=1.0, v0=0.0)[0]
    for run in (last, jax.jit(last)):
        x, t, force = run(x0)
        np.testing.assert_allclose(x, damped_oscillation(np.array(1.1), x0=0.2)[0], atol=1e-8)
        assert float(t) == 1.1 and float(force) == pytest.approx(5 * float(x), rel=1e-12)
    np.testing.assert_allclose(jax.grad(lambda x0: last(x0)[0])(x0), unit, atol=1e-8)


class Blowup(Component):
    """dx/dt = k·x², from x0: x = x0/(1 − k·x0·t)."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        x, k = self.variable("x", start=1.0, fixed=True), self.parameter("k", 1.0)
        self.add_equations(Eq(der(x), k * x**2))


@pytest.mark.parametrize(
    "ts", [pytest.param(jnp.array([0.3, 1.5]), marks=pytest.mark.slow), None], ids=["times", "steps"]
)
def test_a_member_that_fails_is_not_a_number(ts):
    """Value and derivative; where it is left out of the loss, the others' derivatives are untouched."""
    system = compiled(Blowup(EqnEnv(), "c"))

    def end(k, x0):
        chosen = system.with_parameters({"c.k": k})
        solution = simulate(chosen, 1.5, ts=ts, initial={"c.x": x0}, max_steps=100, throw=False)
        return solution["c.x"][-1]

    starts = jnp.array([0.5, 1.0, -1.0])
    batch = jax.jit(jax.vmap(jax.value_and_grad(end, argnums=(0, 1)), in_axes=(None, 0)))
    value, slopes = batch(jnp.array(1.0), starts)
    for found in (value, *slopes):
        assert np.isnan(np.asarray(found)).tolist() == [False, True, False]
    s = np.asarray(starts)[[0, 2]]
    np.testing.assert_allclose(np.asarray(value)[[0, 2]], s / (1 - 1.5 * s), rtol=1e-3)
    np.testing.assert_allclose(np.asarray(slopes[0])[[0, 2]], 1.5 * s**2 / (1 - 1.5 * s) ** 2, rtol=1e-2)

    @eqx.filter_jit
    def loss(k):
        ends = jax.vmap(end, in_axes=(None, 0))(k, starts)
        return jnp.sum(jnp.where(jnp.isnan(ends), 0.0, ends))

    np.testing.assert_allclose(
        jax.grad(loss)(jnp.array(1.0)), np.sum(1.5 * s**2 / (1 - 1.5 * s) ** 2), rtol=1e-2
    )  # fmt: skip


# --- published problems --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", [n if n == "robertson" else pytest.param(n, marks=pytest.mark.slow) for n in PROBLEMS]
)  # fmt: skip
def test_published_problems_with_nothing_said(name):
    problem = PROBLEMS[name]
    system = problem.compile()
    for rtol in (1e-4, 1e-6):
        solution = simulate(system, problem.t1, t0=problem.t0, ts=jnp.array([problem.t1]), **problem.tolerances(rtol))
        worst = problem.errors({n: float(solution[n][-1]) for n in problem.reference})
        assert max(worst.values()) <= 50 * rtol + 10.0**-problem.digits
        if problem.stiff:
            assert solution.stats["stiff_from"] > 0
