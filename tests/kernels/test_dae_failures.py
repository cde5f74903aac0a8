"""What users are told when a differential-algebraic equation cannot be solved, and what is returned instead.

Singularities have closed forms: their times are known. A solver stops short of one by at most the error it was allowed;
1e-4 is a hundred times the tolerance of 1e-6.
"""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxonomy_dae import InitializationError, ModelError, SimulationError
from jaxonomy_dae.solve.linear.sparse import SparsePattern
from jaxonomy_dae.solve.methods.dae_term import FlatProblem
from jaxonomy_dae.solve.methods.failures import explain_start, how_it_stopped, start_check
from jaxonomy_dae.solve.methods.solve import _on_constraints
from jaxonomy_dae.solvers import BDF, DAETerm, Rodas5P, StepControl, consistent_start, solve_dae

ONE, NONE = np.ones(1), np.zeros(1)
NAMES = ("a.x", "a.z")
TS = np.linspace(0.0, 2.0, 9)
ALSO_RODAS5P = pytest.mark.parametrize(
    "solver", [BDF(), pytest.param(Rodas5P(), marks=pytest.mark.slow)], ids=["bdf", "rodas5p"]
)


# --- ends ----------------------------------------------------------------------------------------------------------

# x' and 0 = g from the start (x, z) = (1, 1), and (x, z) until the end at t = 1.
ENDS = {
    "turning point": (lambda t, x, z: -1 + 0 * x, lambda t, x, z: z**2 - x, lambda t: (1 - t, np.sqrt(1 - t))),
    "root": (lambda t, x, z: -1 + 0 * x, lambda t, x, z: z - jnp.sqrt(x), lambda t: (1 - t, np.sqrt(1 - t))),
    "pole": (lambda t, x, z: z**2, lambda t, x, z: z - x, lambda t: (1 / (1 - t),) * 2),
    "not a number": (
        lambda t, x, z: -x,
        lambda t, x, z: z - x * jnp.where(t > 1, jnp.nan, 1.0),
        lambda t: (np.exp(-t),) * 2,
    ),
}
CAUSES = {
    "turning point": "Look for a pole, a turning point, a jump (jump_ts= names their times), or a root or logarithm",
    "root": "Just beyond, row 1 of F is not finite: a root or logarithm leaves its domain",
    "pole": "and no solution continues beyond that",
    "not a number": "row 1 of F",
}
FAST = 1e4  # 1/s
SMOOTH = (lambda t, x, z: FAST * z, lambda t, x, z: z - jnp.cos(FAST * t), None)  # x = sin(FAST·t)
EQUATIONS = [*ENDS.values(), SMOOTH]
# One program for all of them: `args` says which.
CHOSEN = DAETerm(
    lambda t, x, z, which: jax.lax.select_n(which, *(f(t, x, z) for f, _, _ in EQUATIONS)),
    lambda t, x, z, which: jax.lax.select_n(which, *(g(t, x, z) for _, g, _ in EQUATIONS)),
)


def solve_chosen(which, solver, y0=(ONE, ONE), **options):
    which = jnp.asarray(which, jnp.int32)
    return solve_dae(CHOSEN, 2.0, y0, ts=TS, solver=solver, names=NAMES, max_steps=1000, args=which, **options)


@pytest.mark.slow
@ALSO_RODAS5P
@pytest.mark.parametrize("end", ENDS)
def test_an_end_of_the_solution_is_reported(end, solver):
    which, exact = list(ENDS).index(end), ENDS[end][2]
    with pytest.raises(SimulationError) as caught:
        solve_chosen(which, solver)
    message = str(caught.value)
    assert message.startswith("the integration stopped at t=") and CAUSES[end] in message
    reached = float(message.split("t=")[1].split(":")[0])
    assert abs(reached - 1) < 1e-4
    found = solve_chosen(which, solver, throw=False)
    assert found.result == diffrax.RESULTS.dt_min_reached
    before = TS < 0.9
    for part, value in zip(found.ys, exact(TS[before]), strict=True):
        # 1e-4 here too: errors of 1e-6 per step, amplified as the solution steepens.
        part = np.asarray(part)
        np.testing.assert_allclose(part[before, 0], value, rtol=1e-4)
        assert np.isnan(part[TS > 1.1]).all()


@ALSO_RODAS5P
def test_too_few_steps(solver):
    which = EQUATIONS.index(SMOOTH)
    with pytest.raises(SimulationError, match="max_steps=1000 was reached. Changing fastest there: 'a.[xz]' = "):
        solve_chosen(which, solver, (NONE, ONE))
    found = solve_chosen(which, solver, (NONE, ONE), throw=False)
    assert found.result == diffrax.RESULTS.max_steps_reached
    x = np.asarray(found.ys[0])
    assert x[0] == 0 and np.isnan(x[1:]).all()


@ALSO_RODAS5P
def test_a_start_that_is_not_consistent_is_not_solved_from(solver):
    wrong = ONE, np.full(1, 2.0)
    with pytest.raises(InitializationError, match="inconsistent start, the algebraic equations do not hold: row 1"):
        solve_chosen(0, solver, wrong)
    assert solve_chosen(0, solver, wrong, throw=False).result == diffrax.RESULTS.nonlinear_divergence


# --- starts --------------------------------------------------------------------------------------------------------

# x' = −x, z + z³ = x, w = z·x: (q, r) = (z, w) follow from p = x.
TERM = DAETerm(lambda t, x, z, a: -x, lambda t, x, z, a: jnp.stack([z[0] + z[0] ** 3 - x[0], z[1] - z[0] * x[0]]))
WRONG = (ONE, np.array([0.5, 0.1]))
ROOT = np.real(np.roots([1, 0, 1, -1])[-1])  # the real root of z³ + z − 1
GOOD = (ONE, np.array([ROOT, ROOT]))
PQR = ("p", "q", "r")


def falling(t, x, z, args):
    return -jnp.ones(1)


def wrong_with_the_start(term, y0, names=NAMES):
    """What `solve_dae` says of a start, or nothing."""
    check = jax.jit(lambda y0: start_check(FlatProblem(term, y0, None), jnp.asarray(0.0), 1e-6, jnp.asarray(1e-8)))(y0)
    return explain_start(check, names)


def test_an_inconsistent_start_is_mended():
    assert wrong_with_the_start(TERM, WRONG, PQR) == (
        "inconsistent start, the algebraic equations do not hold: row 2 of F is off by 0.4, row 1 of F is off by "
        "0.375. To mend it 'r', 'q' must move: y0 = jaxonomy_dae.solvers.consistent_start(term, y0), or "
        "system.initialize() for a compiled model"
    )
    mended = jax.jit(lambda y0: consistent_start(TERM, y0))(WRONG)
    assert mended[0] == 1
    np.testing.assert_allclose(mended[1], GOOD[1], rtol=1e-14)
    assert wrong_with_the_start(TERM, mended, PQR) == ""


def end(z, throw=None):
    solution = solve_dae(TERM, 1.0, (ONE, z), throw=throw)
    return solution.ys[0], diffrax.is_okay(solution.result)


def start(z, throw=None):
    term = DAETerm(falling, lambda t, x, z, a: z**2 + x)
    return consistent_start(term, (ONE, z), throw=throw)[1]


def test_traced_starts_are_not_numbers():
    assert np.isnan(jax.jit(start)(jnp.array([0.5]))).all()


@pytest.mark.slow
def test_solves_from_traced_starts_are_not_numbers():
    y, okay = jax.jit(end)(WRONG[1])
    assert np.isnan(y).all() and not okay


@pytest.mark.slow
def test_traced_starts_fail_while_running():
    with pytest.raises(Exception, match="inconsistent start: see jaxonomy_dae.solvers.consistent_start"):
        jax.block_until_ready(jax.jit(functools.partial(end, throw=True))(WRONG[1]))
    with pytest.raises(Exception, match="no consistent start: Newton's method did not converge"):
        jax.block_until_ready(jax.jit(functools.partial(start, throw=True))(jnp.array([0.5])))


def test_no_consistent_start():
    with pytest.raises(InitializationError) as caught:
        consistent_start(DAETerm(falling, lambda t, x, z, a: z**2 + x), (ONE, np.array([0.5])), names=NAMES)
    assert str(caught.value) == (
        "no consistent start was found near y0; still moving: 'a.z'. Give a better y0, and check that the algebraic "
        "equations determine the algebraic unknowns (index 1)"
    )


INDEX_TWO = DAETerm(lambda t, x, z, a: z, lambda t, x, z, a: x - 1)  # x = 1, z = 0: consistent, but z needs x'


def test_an_index_above_one_is_named():
    assert wrong_with_the_start(INDEX_TWO, (ONE, NONE)) == (
        "the index is above 1, or the equations are singular at the start: they do not determine 'a.z'. Differentiate "
        "the constraints, or write the model as a Component: jaxonomy_dae.AcausalCompiler reduces the index"
    )


@pytest.mark.slow
@pytest.mark.parametrize("solver", [BDF(), Rodas5P()], ids=["bdf", "rodas5p"])
def test_an_index_above_one_is_not_solved(solver):
    with pytest.raises(InitializationError, match="the index is above 1"):
        solve_dae(INDEX_TWO, 1.0, (ONE, NONE), solver=solver, names=NAMES)
    found = solve_dae(INDEX_TWO, 1.0, (ONE, NONE), solver=solver, throw=False)
    assert found.result != diffrax.RESULTS.successful


def test_not_finite_at_the_start():
    term = DAETerm(falling, lambda t, x, z, a: z - jnp.sqrt(x - 2))
    assert wrong_with_the_start(term, (ONE, ONE)) == (
        "the equations are not finite at the start: row 1 of F is nan. Start elsewhere"
    )


@pytest.mark.parametrize("n", [1, 160])
def test_index_two_is_not_called_an_inconsistent_start(n):
    """x' = z − x, 0 = x − 0.3, from x = 0.1 + 0.2: a rounding error off, which no step can mend. Matrices of more than
    300 unknowns are not looked at."""
    term = DAETerm(lambda t, x, z, a: z - x, lambda t, x, z, a: x - 0.3)
    said = wrong_with_the_start(term, (np.full(n, 0.1 + 0.2), np.full(n, 0.3)), [f"y[{k}]" for k in range(2 * n)])
    singular = "singular" if n == 1 else "nearly singular"
    assert said.startswith(f"the index is above 1, or the equations are {singular}")


# --- arguments -----------------------------------------------------------------------------------------------------


def minus(t, y, args):
    return -y


SINGLE = jax.tree.map(lambda v: v.astype(np.float32), GOOD)
FUNCTIONS = "a DAETerm is made of functions: DAETerm(f, g), or DAETerm(F, mass=M)"
SHAPE = "mass must be a finite square matrix (n, n), or its diagonal (n,); got shape "
BAD = {
    "no function": (lambda: DAETerm(1.0, mass=[1.0]), FUNCTIONS),  # pyright: ignore[reportArgumentType]
    "no constraint": (lambda: DAETerm(minus, 2.0), FUNCTIONS),  # pyright: ignore[reportArgumentType]
    "both": (
        lambda: DAETerm(minus, minus, mass=np.ones(2)),
        "give a DAETerm either g, or the mass matrix: DAETerm(f, g) or DAETerm(F, mass=M)",
    ),
    "neither": (
        lambda: DAETerm(minus),
        "a DAETerm needs g(t, x, z, args), or the mass matrix: DAETerm(f, g) or DAETerm(F, mass=M). For dy/dt = F "
        "alone use diffrax.ODETerm(F)",
    ),
    "mass not square": (lambda: DAETerm(minus, mass=np.ones((2, 3))), SHAPE + "(2, 3)"),
    "mass of rank 3": (lambda: DAETerm(minus, mass=np.ones((2, 2, 2))), SHAPE + "(2, 2, 2)"),
    "mass not finite": (
        lambda: DAETerm(minus, mass=np.array([1.0, np.nan])),
        SHAPE + "(2,) with entries that are not finite",
    ),
    "complex mass": (lambda: DAETerm(minus, mass=np.array([1j])), "mass must be real; it is complex"),
    "mass of rows of two lengths": (
        lambda: DAETerm(minus, mass=[[1.0], [2.0, 3.0]]),
        "mass must be a matrix of numbers (n, n), or its diagonal (n,); got [[1.0], [2.0, 3.0]]",
    ),
    "places that are no integers": (
        lambda: SparsePattern(np.array([0.5]), np.array([0]), 1),
        "rows must be integers; got float64",
    ),
    "mass of another size": (
        lambda: solve_dae(DAETerm(minus, mass=np.ones(3)), 1.0, np.ones(2)),
        "mass has shape (3,), but y has 2 values: it must be (2, 2) or (2,)",
    ),
    "traced mass": (
        lambda: jax.jit(lambda m: solve_dae(DAETerm(minus, mass=m), 1.0, np.ones(2)).ys)(np.ones(2)),
        "the mass matrix of a DAETerm is constant: it cannot be traced. Move what varies into F, or solve for other "
        "variables",
    ),
    "F": (
        lambda: solve_dae(DAETerm(lambda t, y, a: y[:1], mass=np.ones(2)), 1.0, np.ones(2)),
        "F must return what it is the derivative of: expected shapes [(2,)], found [(1,)]",
    ),
    "f": (
        lambda: solve_dae(DAETerm(lambda t, x, z, a: jnp.ones(2), lambda t, x, z, a: z), 1.0, GOOD),
        "f must return what it is the derivative of: expected shapes [(1,)], found [(2,)]",
    ),
    "g": (
        lambda: solve_dae(DAETerm(lambda t, x, z, a: x, lambda t, x, z, a: z[:1]), 1.0, GOOD),
        "g must return as many values as z has: 2; it returned 1. Every algebraic unknown needs one equation",
    ),
    "no pair": (
        lambda: solve_dae(TERM, 1.0, np.ones(3)),
        "the solution of DAETerm(f, g) is a pair (x, z); got PyTreeDef(*)",
    ),
    "names": (lambda: solve_dae(TERM, 1.0, GOOD, names=["p"]), "names must name every unknown: 3 of them; got 1"),
    "negative rtol": (lambda: solve_dae(TERM, 1.0, GOOD, rtol=-1.0), "rtol must be a number ≥ 0; got -1.0"),
    "complex": (
        lambda: solve_dae(DAETerm(minus, mass=np.ones(1)), 1.0, np.array([1j])),
        "y0 must be real: make the real and the imaginary parts unknowns of their own",
    ),
    "rtol of each": (
        lambda: solve_dae(TERM, 1.0, GOOD, rtol=np.array([0.1, 0.1])),
        "rtol must be one number; got [0.1 0.1]. Where unknowns differ, give atol in the shape of y",
    ),
    "longest step beside a controller": (
        lambda: solve_dae(TERM, 1.0, GOOD, dtmax=0.1, stepsize_controller=StepControl(1e-3, 1e-3)),
        "dtmax and stepsize_controller both say how long steps are: leave one out, or put dtmax into the controller "
        "(StepControl(..., dtmax=...), diffrax.ClipStepSizeController(..., jump_ts=...))",
    ),
    "atol": (
        lambda: solve_dae(TERM, 1.0, GOOD, atol=np.ones(2)),
        "atol must be one number or look like y: expected shapes [(1,), (2,)], found [(2,)]",
    ),
    "single precision": (
        lambda: solve_dae(TERM, 1.0, SINGLE, rtol=1e-8),
        'rtol=1e-08 cannot be reached in float32 (eps 1.2e-07). Switch to double precision with jax.config.update("jax_'
        'enable_x64", True) before the model is compiled, or use rtol ≥ 2e-06.',
    ),
    "no end": (lambda: solve_dae(TERM, np.nan, GOOD), "t1 must be a finite number; got nan"),
    "times outside": (
        lambda: solve_dae(TERM, 1.0, GOOD, ts=np.array([0.5, 2.0])),
        "ts must lie between t0=0 and t1=1; they reach from 0.5 to 2",
    ),
    "times backwards": (
        lambda: solve_dae(TERM, 1.0, GOOD, ts=np.array([0.5, 0.2])),
        "ts must be sorted in the direction of integration",
    ),
    "times of steps": (
        lambda: solve_dae(TERM, 1.0, GOOD, stepsize_controller=diffrax.StepTo(ts=np.array([0.0, 0.25, 0.5]))),
        "the times of StepTo must lead from t0=0 to t1=1, each farther than the one before; they lead from 0 to 0.5",
    ),
    "times of rank 0": (lambda: solve_dae(TERM, 1.0, GOOD, ts=0.5), "ts must have shape (n,), n ≥ 1; got ()"),
    "adjoint": (
        lambda: solve_dae(TERM, 1.0, GOOD, adjoint=diffrax.BacksolveAdjoint()),
        "adjoint=BacksolveAdjoint() is wrong for differential-algebraic equations: integrated backwards, the state "
        "leaves its constraints. Use the default, or diffrax.ForwardMode() for few parameters",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_arguments_that_cannot_work(case):
    call, message = BAD[case]
    with pytest.raises(ModelError) as caught:
        call()
    assert str(caught.value) == message


def test_results_are_told_by_their_names():
    """Whatever ended a run was called steps that are too long."""
    told = [
        (diffrax.RESULTS.max_steps_reached, "max_steps=7 was reached"),
        (diffrax.RESULTS.dt_min_reached, "no step was short enough to be accepted"),
        (diffrax.RESULTS.nonlinear_divergence, "the solver gave up (Nonlinear solve diverged)"),
    ]
    for result, reason in told:
        assert how_it_stopped(result, 0.5, 7) == f"the integration stopped at t=0.5: {reason}. "


def test_rows_that_were_not_reached_are_solved_for_at_the_start():
    """z = p·log t from t = 1 on: at time 0 the logarithm and with it all derivatives by p were infinite."""
    term = DAETerm(lambda t, x, z, p: x, lambda t, x, z, p: z - p * jnp.log(t))

    def saved(p):
        rows = (jnp.array([[3.0], [jnp.nan]]), jnp.array([[0.5], [jnp.nan]]))
        return _on_constraints(term, p, jnp.array([2.0, jnp.inf]), rows, (jnp.array(1.0), (ONE, NONE)))[1][0, 0]

    value, slope = jax.jit(jax.value_and_grad(saved))(2.0)
    np.testing.assert_allclose([value, slope], [2 * np.log(2), np.log(2)], rtol=1e-12)


@pytest.mark.parametrize("stock", ["Euler", "Heun", "Tsit5", "Dopri8", "ImplicitEuler", "Kvaerno5"])
def test_stock_solvers_name_ours(stock):
    with pytest.raises(ModelError) as caught:
        solve_dae(TERM, 1.0, GOOD, solver=getattr(diffrax, stock)())
    assert str(caught.value) == (
        "this is a differential-algebraic equation: a solver for ordinary differential equations cannot step it. Use "
        "jaxonomy_dae.solvers.BDF() or jaxonomy_dae.solvers.Rodas5P()"
    )


def test_max_order_is_checked():
    with pytest.raises(ValueError, match="max_order must be 1, 2, 3, 4 or 5; got 6"):
        BDF(max_order=6)


@pytest.mark.slow
def test_bdf_needs_tolerances_outside_of_diffrax():
    solver = BDF()
    state = solver.init(TERM, jnp.asarray(0.0), jnp.asarray(0.1), GOOD, None)
    with pytest.raises(ValueError, match="BDF needs tolerances"):
        solver.step(TERM, jnp.asarray(0.0), jnp.asarray(0.1), GOOD, None, state, False)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [BDF(), Rodas5P()], ids=["bdf", "rodas5p"])
def test_a_regular_mass_matrix_is_an_ordinary_equation(solver):
    matrix, field = np.array([[2.0, 1.0], [1.0, 3.0]]), np.array([[-1.0, 0.5], [0.0, -2.0]])
    term = DAETerm(lambda t, y, a: jnp.asarray(field) @ y, mass=matrix)
    solution = solve_dae(term, 1.0, np.array([1.0, 2.0]), solver=solver, rtol=1e-8, atol=1e-10)
    values, vectors = np.linalg.eig(np.linalg.solve(matrix, field))
    exact = np.real(vectors @ (np.exp(values) * np.linalg.solve(vectors, [1.0, 2.0])))
    np.testing.assert_allclose(solution.ys[0], exact, rtol=1e-6)  # a hundred steps' worth of rtol


def test_a_mass_matrix_that_is_a_function():
    with pytest.raises(ModelError, match="is constant; got a function. Where M varies, make the slopes z unknowns"):
        DAETerm(lambda t, y, args: y, mass=lambda t, y: jnp.eye(2))


def test_a_mass_matrix_stays_the_users():
    for mine in (np.ones(2), np.array([[1.0, 2.0], [0.0, 1.0]])):
        term = DAETerm(minus, mass=mine)
        mine[:] = 3.0
        assert not (term.mass.array == 3.0).any()
