"""`simulate(solver=None)`: explicit where that pays, implicit where stability limits the steps, found by running."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sympy
from problems import compiled, damped_oscillation, oscillator
from sympy import Eq
from testset import PROBLEMS

from jaxonomy_dae import Component, EqnEnv, SimulationError, assign, der, simulate
from jaxonomy_dae.solve.methods.switching import STIFF
from jaxonomy_dae.solvers import Rodas5P, Tsit5

TS = np.array([0.5, 4.0, 10.0])


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


@pytest.mark.slow
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


def test_fast_decay_before_a_short_end_stays_explicit(stiff):
    """Explicit steps are limited here too, but few: another solver would cost more to compile."""
    solution = simulate(stiff.with_parameters({"f.k": 1e3}), 1.0, ts=TS / 10)
    assert solution.stats["solver"] == "Tsit5" and 250 < solution.stats["num_steps"] < 1000


class Stiffening(Component):
    """The follower above, with k = 1 up to t = 1/2 and 2e4 from then on."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        w, mode = self.parameter("w", 1.3), self.discrete("mode", start=0)
        x, k = self.variable("x", start=1.0, fixed=True), sympy.Piecewise((1.0, Eq(mode, 0)), (2e4, True))
        self.add_equations(Eq(der(x), -k * (x - sympy.cos(w * ev.t)) - w * sympy.sin(w * ev.t)))
        self.when(ev.t >= 0.5, assign(mode, 1))


@pytest.mark.slow
def test_steps_used_up_in_a_stiff_mode():
    """Explicit steps, 2000/3.3 of them, are too few to be given up early, and more than allowed: eigenvalues decide, in
    the mode in which steps ran out."""
    solution = simulate(compiled(Stiffening(EqnEnv(), "f")), 0.6, ts=TS[:1] / 2.5 + 0.4, max_steps=300)
    np.testing.assert_allclose(solution["f.x"], np.cos(1.3 * 0.6), rtol=0, atol=1e-5)
    assert solution.stats["solver"] == "Rodas5P" and solution.stats["num_explicit_steps"] == 300


def test_asked_for_solvers_are_not_replaced(stiff):
    solution = simulate(stiff, 10.0, ts=TS, solver=Rodas5P())
    assert "num_explicit_steps" not in solution.stats and solution.stats["reason"] == "as asked for"


@pytest.mark.slow
def test_many_unknowns_take_bdf():
    system = compiled(Followers(EqnEnv(), "f", 40, 1e6))
    solution = simulate(system, 10.0, ts=TS)
    assert solution.stats["solver"] == "BDF" and "cheaper for 40 unknowns" in solution.stats["reason"]
    np.testing.assert_allclose(solution["f.x39"], np.cos(1.3 * np.asarray(TS)), rtol=0, atol=1e-4)


@pytest.fixture(scope="module")
def later():
    """x' = −10^t·(x − cos t) − sin t: stiff from t = 3 on."""

    class Later(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            x = self.variable("x", start=1.0, fixed=True)
            self.add_equations(Eq(der(x), -(10**ev.t) * (x - sympy.cos(ev.t)) - sympy.sin(ev.t)))

    return compiled(Later(EqnEnv(), "c"))


@pytest.mark.slow
def test_stiffness_that_comes_later(later):
    solution = simulate(later, 7.0, ts=np.array([7.0]))
    assert solution.stats["solver"] == "Rodas5P" and 2 < solution.stats["stiff_from"] < 5
    np.testing.assert_allclose(solution["c.x"], np.cos(7.0), rtol=0, atol=1e-5)


# --- inside jit, grad and vmap -------------------------------------------------------------------------------------


def test_the_choice_inside_transformations(stiff):
    def last(w):
        solution = simulate(stiff.with_parameters({"f.w": w}), 10.0, ts=TS)
        found.append((solution.stats["solver"], solution.stats["reason"]))
        return solution["f.x0"][-1]

    found = []
    jax.eval_shape(last, 1.3)
    solver, reason = found[0]
    assert solver == "Rodas5P" and "stiff: at the declared start" in reason


@pytest.mark.slow
def test_what_ran_before_changes_no_choice(later):
    """A run outside finds that this model becomes stiff; inside jit it is what it would be in a new process."""

    def choice():
        found = []
        jax.eval_shape(lambda x0: found.append(simulate(later, 7.0, initial={"c.x": x0}).stats["solver"]), 1.0)
        return found

    first = choice()
    assert simulate(later, 7.0, ts=np.array([7.0])).stats["solver"] == "Rodas5P"
    assert choice() == first == ["Tsit5"]


@pytest.mark.slow
def test_inside_transformations(stiff):
    """x = cos(w·t), ∂x/∂w = −t·sin(w·t)."""

    @jax.jit
    @jax.vmap
    def last(w):
        def x(w):
            return simulate(stiff.with_parameters({"f.w": w}), 10.0, ts=TS, rtol=1e-8, atol=1e-8)["f.x0"][-1]

        return jax.value_and_grad(x)(w)

    w = np.array([1.3, 0.4])
    value, slope = last(w)
    np.testing.assert_allclose(value, np.cos(10 * w), rtol=0, atol=1e-7)
    np.testing.assert_allclose(slope, -10 * np.sin(10 * w), rtol=0, atol=1e-6)


# --- saved rows inside jit -----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_last_row_inside_jit():
    """`ts=None`: rows beyond the last step repeat it, with its derivatives."""
    system = oscillator()

    def last(x0, read=-1):
        solution = simulate(system, 1.1, initial={"mass.s": x0}, rtol=1e-9, atol=1e-11, max_steps=64)
        x = solution["mass.s"][read]
        return x, (x, solution.ts[read], solution["spring.f"][read])

    slope, (x, t, force) = jax.jit(jax.grad(last, has_aux=True))(np.array(0.2))
    np.testing.assert_allclose(x, damped_oscillation(np.array(1.1), x0=0.2)[0], atol=1e-8)
    assert float(t) == 1.1 and float(force) == pytest.approx(5 * float(x), rel=1e-12)
    unit = damped_oscillation(np.array(1.1), x0=1.0, v0=0.0)[0]
    np.testing.assert_allclose(slope, unit, atol=1e-8)


@pytest.mark.slow
def test_the_last_row_outside_of_jit():
    """There are no more rows than steps."""
    solution = simulate(oscillator(), 1.1, initial={"mass.s": 0.2}, rtol=1e-9, atol=1e-11, max_steps=64)
    x = damped_oscillation(np.array(1.1), x0=0.2)[0]
    assert len(solution.ts) < 65 and float(solution.ts[-1]) == 1.1
    np.testing.assert_allclose(np.asarray(solution["mass.s"])[-1], x, atol=1e-8)
    np.testing.assert_allclose(np.asarray(solution["spring.f"])[-1], 5 * x, atol=5e-8)


class Blowup(Component):
    """dx/dt = k·x², from x0: x = x0/(1 − k·x0·t)."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        x, k = self.variable("x", start=1.0, fixed=True), self.parameter("k", 1.0)
        self.add_equations(Eq(der(x), k * x**2))


@pytest.mark.slow
@pytest.mark.parametrize("ts", [np.array([0.3, 1.5]), None], ids=["times", "steps"])
def test_a_member_that_fails_is_not_a_number(ts):
    """Value and derivative; where it is left out of the loss, the others' derivatives are untouched."""
    system = compiled(Blowup(EqnEnv(), "c"))

    def ends(k, starts):
        def end(x0):
            chosen = system.with_parameters({"c.k": k})
            return simulate(chosen, 1.5, ts=ts, initial={"c.x": x0}, max_steps=100, throw=False)["c.x"][-1]

        return jax.vmap(end)(starts)

    @jax.jit
    def slopes(k, starts):
        """(values, and for each of them and for the sum of those that did not fail: by k, by the starts)"""
        value, back = jax.vjp(ends, k, starts)
        _, of_loss = jax.vjp(lambda value: jnp.sum(jnp.where(jnp.isnan(value), 0.0, value)), value)
        return value, jax.vmap(back)(jnp.concatenate([jnp.eye(3), of_loss(jnp.ones(()))[0][None]]))

    starts = np.array([0.5, 1.0, -1.0])
    value, (by_k, by_start) = jax.tree.map(np.asarray, slopes(np.array(1.0), starts))
    for found in (value, by_k[:3], np.diag(by_start[:3])):
        assert np.isnan(found).tolist() == [False, True, False]
    s = starts[[0, 2]]
    np.testing.assert_allclose(value[[0, 2]], s / (1 - 1.5 * s), rtol=1e-3)
    np.testing.assert_allclose(by_k[[0, 2]], 1.5 * s**2 / (1 - 1.5 * s) ** 2, rtol=1e-2)
    np.testing.assert_allclose(by_k[3], np.sum(1.5 * s**2 / (1 - 1.5 * s) ** 2), rtol=1e-2)


# --- published problems --------------------------------------------------------------------------------------------


@pytest.mark.slow
# At rtol 1e-4 the tolerance of a position leaves 0.26 % of the car axis' force open, as the warning says: 26·rtol.
@pytest.mark.filterwarnings("ignore:'caraxis.lam1' hangs on the state")
@pytest.mark.parametrize("name", PROBLEMS)
def test_published_problems_with_nothing_said(name):
    """All within 50·rtol, as test_testset.py asks of every solver, and errors fall with the tolerance."""
    problem = PROBLEMS[name]
    system = problem.compile()
    uncertain, found = 10.0**-problem.digits, {}
    for rtol in (1e-4, 1e-6, 1e-8):
        solution = simulate(system, problem.t1, t0=problem.t0, ts=np.array([problem.t1]), **problem.tolerances(rtol))
        found[rtol] = max(problem.errors({n: float(solution[n][-1]) for n in problem.reference}).values())
        assert found[rtol] <= 50 * rtol + uncertain
        if problem.stiff:
            assert solution.stats["stiff_from"] > 0
    for coarse, fine in ((1e-4, 1e-6), (1e-6, 1e-8)):
        # Below the tolerance itself an error may be small by chance (its sign changes) and has nothing to prove.
        assert found[fine] < found[coarse] or found[fine] <= max(fine, uncertain), found


# --- steps that are rejected ---------------------------------------------------------------------------------------


class Burning(Component):
    """Cells of fuel that heat themselves up and run out: c' = −k(T)·(1 − exp(−c/50)), T' by c'. Long steps lead to
    c ≪ 0, where the exponential overflows."""

    def __init__(self, ev, name, count=2):
        super().__init__(ev, name)
        for i in range(count):
            T, c = self.variable(f"T{i}", start=300.0, fixed=True), self.variable(f"c{i}", start=3000.0, fixed=True)
            rate = 5.5e6 * sympy.exp(-5680 / T) * (1 - sympy.exp(-c / 50))
            self.add_equations(Eq(der(c), -rate), Eq(der(T), (900.0 + 50 * i - T) / 200 + 0.01 * rate))


@pytest.mark.slow
def test_rejected_steps_do_not_repeat():
    """Kind: a run that rejects steps without end. A step that ended at infinity had an error that is not a number, from
    which the controller proposed the same step again: 8 steps accepted and 16,376 rejected."""
    system, ts = compiled(Burning(EqnEnv(), "b")), np.array([1000.0])
    solution = simulate(system, 1000.0, ts=ts)
    reference = simulate(system, 1000.0, ts=ts, solver=Rodas5P(), rtol=1e-9, atol=1e-10)
    assert solution.stats["solver"] == "Rodas5P" and solution.stats["num_explicit_steps"] < 2000
    np.testing.assert_allclose(solution["b.T1"], reference["b.T1"], rtol=1e-5)
    explicit = simulate(system, 300.0, ts=ts * 0.3, solver=Tsit5(), throw=False)
    assert explicit.stats["num_rejected_steps"] < 2000


class Depleting(Component):
    """x' = −k·(x − cos t), k' = k: stability shortens explicit steps more and more."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        x, k = self.variable("x", start=1.0, fixed=True), self.variable("k", start=1.0, fixed=True)
        self.add_equations(Eq(der(x), -k * (x - sympy.cos(ev.t))), Eq(der(k), k))


@pytest.mark.slow
def test_explicit_steps_that_do_not_suffice():
    """Kind: a run that cannot end is stopped by the number of its steps. Explicit steps that the user chose went on, a
    fifth of them rejected, to max_steps; the run ends where they will not suffice, and inside jit with that code."""
    system, ts = compiled(Depleting(EqnEnv(), "c")), jnp.array([11.0])
    for solver in (Tsit5(), diffrax.Tsit5()):
        with pytest.raises(SimulationError, match="the system is stiff.* hardly suffice to t=11. Write .*Rodas5P"):
            simulate(system, 11.0, ts=ts, solver=solver)
    stopped = simulate(system, 11.0, ts=ts, solver=Tsit5(), throw=False)
    assert stopped.result == STIFF and stopped.counts["num_rejected_steps"] < 2000
    inside = jax.jit(lambda: simulate(system, 11.0, ts=ts, solver=Tsit5()))()
    assert inside.result == STIFF and np.isnan(inside["c.x"]).all()
    allowed = simulate(system, 11.0, ts=ts, solver=Tsit5(), max_steps=100_000)
    np.testing.assert_allclose(allowed["c.x"], np.cos(ts), atol=1e-3)
