"""Published DAE problems (benchmarks/testset): their data agree with each other, and the solvers reach them.

The accuracy demanded is the same everywhere: solved with `problem.tolerances(rtol)`, every compared component at the
end has |found − reference| ≤ 50·rtol·max(|reference|, scale), and errors fall with rtol. Tolerances are local, per
step; the factor 50 is for what steps add up to. `scale`, per component, is in the problem's definition.
"""

import functools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from testset import PROBLEMS, competitors, ours
from testset.problem import load

from jaxonomy_dae import simulate, solvers

TOLERANCES = (1e-4, 1e-6, 1e-8)
FACTOR = 50

SOLVERS = {"bdf": solvers.BDF(), "rodas5p": solvers.Rodas5P()}
INDEX_ONE = [name for name, problem in PROBLEMS.items() if problem.given]
MODELS = list(PROBLEMS)

# One program serves all tolerances of a case. Each form with both solvers, and some models; all models with the solver
# that `simulate` chooses are in test_default_solver.py.
CASES = [
    ("transamp", "rodas5p", "raw"),
    ("chemakzo", "bdf", "semi-explicit"),
    ("robertson", "bdf", "raw"),
    ("robertson", "rodas5p", "raw"),
    ("chemakzo", "rodas5p", "semi-explicit"),
    ("transamp", "bdf", "raw"),
    ("sundials_heat2d", "bdf", "raw"),
    ("sundials_heat2d", "rodas5p", "semi-explicit"),
    ("robertson", "bdf", "model"),
    ("robertson", "rodas5p", "model"),
    ("chemakzo", "rodas5p", "model"),
    ("msl_cauer", "bdf", "model"),
    ("andrews", "bdf", "model"),
    ("pendulum_cash", "rodas5p", "model"),
    ("pendulum_period2", "bdf", "model"),
]


@functools.cache
def program(name, solver, form):
    problem = PROBLEMS[name]
    if form == "model":
        return ours.model_program(problem, SOLVERS[solver])
    return ours.raw_program(problem, SOLVERS[solver], semi_explicit=form == "semi-explicit")


def errors(name, solver, form, rtol):
    problem = PROBLEMS[name]
    outcome = ours.outcome(problem, program(name, solver, form), **problem.tolerances(rtol), repeat=lambda s: 0)
    assert not outcome.failure
    return problem.errors(outcome.values)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "solver", "form"), CASES, ids=["-".join(case) for case in CASES])
def test_errors_are_within_the_tolerances_and_fall_with_them(name, solver, form):
    uncertain = 10.0 ** -PROBLEMS[name].digits  # of the reference itself
    found = {rtol: errors(name, solver, form, rtol) for rtol in TOLERANCES}
    for rtol, each in found.items():
        worst = max(each, key=lambda n, each=each: each[n])
        assert each[worst] <= FACTOR * rtol + uncertain, f"{worst}: error {each[worst] / rtol:.1f}·rtol"
    worst = [max(each.values()) for each in found.values()]
    for coarse, fine, before, rtol in zip(worst, worst[1:], TOLERANCES, TOLERANCES[1:], strict=False):
        # Below the tolerance itself an error may be small by chance (its sign changes) and has nothing to prove; and
        # one of a tenth of its tolerance or less is no measure of the next.
        assert fine < max(coarse, 0.1 * before) or fine <= max(rtol, uncertain), worst


# --- starts ------------------------------------------------------------------------------------------------------


def at_start(name):
    """All variables of the compiled model at t0, from the consistent initialization alone."""
    problem = PROBLEMS[name]
    names = [n.lstrip("-") for n in problem.index_one().names]

    @eqx.filter_jit
    def start(system):
        x = system.initialize(t0=problem.t0)
        return system.constraint_residual(problem.t0, x), system.observe(names, problem.t0, x)

    residual, values = start(problem.compile())
    assert np.abs(np.asarray(residual)).max(initial=0.0) < 1e-12
    return problem, dict(zip(names, np.asarray(values), strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["robertson", "transamp", "sundials_slcrank", "msl_cauer", "caraxis", "pendulum_cash"])
def test_models_start_where_the_index_one_equations_do(name):
    # The index-1 equations start from published values, algebraic unknowns solved in closed form where they are not
    # published: rounding is the only difference, amplified by the condition of the constraints (below 1e3 here).
    problem, found = at_start(name)
    one = problem.index_one()
    for variable, value in one.values(one.y0).items():
        assert found[variable] == pytest.approx(value, rel=1e-11, abs=1e-11), variable


@pytest.mark.slow
def test_andrews_starts_as_published():
    # Published to 28 digits; positions, and the accelerations and multipliers that follow from them.
    _, found = at_start("andrews")
    np.testing.assert_allclose(list(found.values()), load("andrews")["initial"]["y0"], rtol=1e-12, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", INDEX_ONE)
def test_published_slopes_solve_the_raw_equations(name):
    one = PROBLEMS[name].index_one()
    right = one.numpy(0.0, one.y0)
    found = one.F(jnp.asarray(0.0), jnp.asarray(one.y0), one.args())
    np.testing.assert_allclose(np.asarray(found), right, rtol=1e-14)
    published = load(name)["initial"].get("yp0")
    if published is not None:
        np.testing.assert_allclose(one.matrix() @ np.array(published), right, rtol=1e-10, atol=1e-15)


# --- references --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [n for n, p in PROBLEMS.items() if p.published])
def test_references_agree_with_their_publication(name):
    # Where the publication has few digits, the reference is exact or recomputed: it must agree in those digits.
    problem = PROBLEMS[name]
    for variable, value in problem.published.items():
        unit = max(abs(value), problem.scale[variable])
        assert abs(problem.reference[variable] - value) <= 10**-problem.published_digits * unit, variable


def radau(problem, ts, rtol):
    """The index-1 equations' solution at the times `ts` by SciPy, algebraic unknowns eliminated."""
    one = problem.index_one()
    tolerances = problem.tolerances(rtol)
    solved = scipy.integrate.solve_ivp(
        one.ode, (problem.t0, problem.t1), one.y0[: one.split()], method="Radau", t_eval=ts, **tolerances
    )
    values = [one.values(np.concatenate([x, one.algebraics(t, x)])) for t, x in zip(solved.t, solved.y.T, strict=True)]
    return {name: np.array([v[name] for v in values]) for name in values[0]}


RADAU = [n for n in MODELS if n != "transamp"]


@pytest.mark.parametrize("name", [n if n == "chemakzo" else pytest.param(n, marks=pytest.mark.slow) for n in RADAU])
def test_index_one_equations_reach_the_references(name):
    # What the other programs solve in the benchmark, by SciPy: one loose tolerance, 50 × of it, and published tables.
    problem = PROBLEMS[name]
    ts = np.array([problem.t1]) if problem.table is None else np.union1d(problem.table.ts, [problem.t1])
    found = radau(problem, ts, 1e-6)
    worst = problem.errors({n: found[n][-1] for n in problem.reference})
    assert max(worst.values()) <= 50e-6, worst
    if problem.table is not None:
        rows = np.searchsorted(ts, problem.table.ts)
        for variable, values in problem.table.values.items():
            unit = np.maximum(np.abs(values), problem.scale[variable])
            np.testing.assert_array_less(np.abs(found[variable][rows] - values) / unit, 10**-problem.table.digits)


@pytest.mark.slow
@pytest.mark.parametrize("name", list(PROBLEMS))
def test_sundials_reaches_the_references(name):
    # The benchmark's yardstick is fair only if it solves the same problem: CasADi's IDAS, error within 2,000·rtol.
    pytest.importorskip("casadi")
    problem = PROBLEMS[name]
    outcome = competitors.casadi_idas(problem, **problem.tolerances(1e-7), repeat=competitors.no_repeat)
    assert not outcome.failure
    assert max(problem.errors(outcome.values).values()) <= 2e-4


@pytest.mark.slow
@pytest.mark.parametrize("name", [n for n, p in PROBLEMS.items() if p.table is not None and not p.stiff])
def test_models_follow_published_trajectories(name):
    problem = PROBLEMS[name]
    ts = problem.table.ts
    solution = simulate(problem.compile(), problem.t1, t0=problem.t0, ts=ts, rtol=1e-8, atol=1e-8 * problem.atol)
    for variable, values in problem.table.values.items():
        unit = np.maximum(np.abs(values), problem.scale[variable])
        np.testing.assert_array_less(np.abs(np.asarray(solution[variable]) - values) / unit, 10**-problem.table.digits)
    assert np.abs(np.asarray(solution.constraint_residual())).max(initial=0.0) < 1e-12


@pytest.mark.slow
def test_filter_steps_at_its_break():
    # Integrated from t = 0 through the source's step at t = 1, without being told: at rest before, exact after.
    problem = PROBLEMS["msl_cauer"]
    ts = np.array([0.5, 0.999, problem.t1])
    solution = simulate(problem.compile(), problem.t1, ts=ts, rtol=1e-8, atol=1e-8)
    for variable, value in problem.reference.items():
        before, after = np.split(np.asarray(solution[variable]), [2])
        assert not before.any()
        assert abs(after[0] - value) <= FACTOR * 1e-8
