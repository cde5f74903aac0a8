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
import sympy
from problems import compiled

from jaxonomy_dae import Component, EqnEnv, InitializationError, ModelError, SimulationError, der, simulate
from jaxonomy_dae.solvers import BDF, DAETerm, Rodas5P, consistent_start, solve_dae

ONE, NONE = jnp.ones(1), jnp.zeros(1)
NAMES = ("a.x", "a.z")
TS = jnp.linspace(0.0, 2.0, 9)
SOLVERS = pytest.mark.parametrize("solver", [BDF(), Rodas5P()], ids=["bdf", "rodas5p"])
ALSO_RODAS5P = pytest.mark.parametrize(
    "solver", [BDF(), pytest.param(Rodas5P(), marks=pytest.mark.slow)], ids=["bdf", "rodas5p"]
)


def falling(t, x, z, args):
    return -ONE


# x' and 0 = g, the start, where the solution ends, and (x, z) until there.
ENDS = {
    "turning point": (falling, lambda t, x, z, a: z**2 - x, (ONE, ONE), 1.0, lambda t: (1 - t, np.sqrt(1 - t))),
    "root": (falling, lambda t, x, z, a: z - jnp.sqrt(x), (ONE, ONE), 1.0, lambda t: (1 - t, np.sqrt(1 - t))),
    "pole": (lambda t, x, z, a: z**2, lambda t, x, z, a: z - x, (ONE, ONE), 1.0, lambda t: (1 / (1 - t),) * 2),
    "not a number": (
        lambda t, x, z, a: -x,
        lambda t, x, z, a: z - x * jnp.where(t > 1, jnp.nan, 1.0),
        (ONE, ONE),
        1.0,
        lambda t: (np.exp(-t),) * 2,
    ),
}
CAUSES = {
    "turning point": "Look for a pole, a turning point, a jump (jump_ts= names their times), or a root or logarithm",
    "root": "Just beyond, row 1 of F is not finite: a root or logarithm leaves its domain",
    "pole": "and no solution continues beyond that",
    "not a number": "row 1 of F",
}
ENDS = {name: (DAETerm(f, g), *rest) for name, (f, g, *rest) in ENDS.items()}


@SOLVERS
@pytest.mark.parametrize(
    "end", [end if end == "turning point" else pytest.param(end, marks=pytest.mark.slow) for end in ENDS]
)
def test_an_end_of_the_solution_is_reported(end, solver):
    term, y0, time, exact = ENDS[end]
    with pytest.raises(SimulationError) as caught:
        solve_dae(term, 2.0, y0, ts=TS, solver=solver, names=NAMES)
    message = str(caught.value)
    assert message.startswith("the integration stopped at t=") and CAUSES[end] in message
    reached = float(message.split("t=")[1].split(":")[0])
    assert abs(reached - time) < 1e-4
    found = solve_dae(term, 2.0, y0, ts=TS, solver=solver, throw=False)
    assert found.result == diffrax.RESULTS.dt_min_reached
    before = np.asarray(TS) < 0.9
    for part, value in zip(found.ys, exact(np.asarray(TS)[before]), strict=True):
        # 1e-4 here too: errors of 1e-6 per step, amplified as the solution steepens.
        np.testing.assert_allclose(part[before, 0], value, rtol=1e-4)
        assert np.isnan(part[np.asarray(TS) > 1.1]).all()


# --- through a compiled model --------------------------------------------------------------------------------------


class Cell(Component):
    """x' = rate(x, z), 0 = law(x, z), a nonlinear block."""

    def __init__(self, ev, rate, law, x0, z0):
        super().__init__(ev, "cell")
        x, z = self.variable("x", start=x0, fixed=True), self.variable("z", start=z0)
        self.add_equations(der(x) - rate(x, z), law(x, z))


def cell(rate, law, x0, z0):
    return compiled(Cell(EqnEnv(), rate, law, x0, z0))


@pytest.fixture(scope="module")
def folded():
    """x falls from 2 along x = z³ − 3z, which turns back at z = 1, x = −2, t = 4."""
    system = cell(lambda x, z: -1, lambda x, z: z**3 - 3 * z - x, 2.0, 2.0)
    assert list(system.carried) == ["cell.z"]
    return system


FOLDED = (
    "the integration stopped at t=4: no step was short enough to be accepted. The nonlinear equation for 'cell.z' = 1 "
    "has no solution just beyond: Newton's method does not converge from these values (a turning point, at which two "
    "solutions meet and end; a jump to another branch; or a law without a solution).\n  cell: 0 = -x + z**3 - 3*z"
)


@SOLVERS
def test_a_model_reports_its_turning_point(folded, solver):
    ts = jnp.linspace(0.0, 6.0, 13)
    with pytest.raises(SimulationError) as caught:
        simulate(folded, 6.0, ts=ts, solver=solver)
    assert str(caught.value) == FOLDED
    found = simulate(folded, 6.0, ts=ts, solver=solver, throw=False)
    assert found.result == diffrax.RESULTS.dt_min_reached
    before = np.asarray(ts) < 3.9
    # z is solved for again at saved times: as exact as x, which is linear in time.
    x, z = np.asarray(found["cell.x"])[before], np.asarray(found["cell.z"])[before]
    np.testing.assert_allclose(x, 2 - np.asarray(ts)[before], atol=1e-9)
    np.testing.assert_allclose(z**3 - 3 * z, x, atol=1e-9)
    assert np.isnan(np.asarray(found.states)[np.asarray(ts) > 4.1]).all()


@ALSO_RODAS5P
def test_a_model_reports_too_few_steps(folded, solver):
    with pytest.raises(SimulationError) as caught:
        simulate(folded, 3.0, solver=solver, max_steps=5)
    message = str(caught.value)
    assert "max_steps=5 was reached. Changing fastest there: 'cell.x' = " in message
    assert "Raise max_steps, loosen rtol=1e-06 and atol, or look for a jump or a pole: jump_ts= names" in message
    found = simulate(folded, 3.0, solver=solver, max_steps=5, throw=False)
    assert found.result == diffrax.RESULTS.max_steps_reached
    assert np.isfinite(np.asarray(found.states)).all() and 1 < len(found.ts) <= 6


@pytest.mark.slow
@SOLVERS
@pytest.mark.parametrize(
    "rate, law",
    [
        (lambda x, z: z**2, lambda x, z: z + z**3 - x - x**3),
        (lambda x, z: -1, lambda x, z: z + sympy.exp(z) - sympy.sqrt(x) - sympy.exp(sympy.sqrt(x))),
    ],
    ids=["pole", "root"],
)
def test_models_report_poles_and_roots(rate, law, solver):
    system = cell(rate, law, 1.0, 1.0)
    with pytest.raises(SimulationError, match="the integration stopped at t=") as caught:
        simulate(system, 6.0, solver=solver)
    assert abs(float(str(caught.value).split("t=")[1].split(":")[0]) - 1) < 1e-4
    assert "'cell.z'" in str(caught.value) or "not finite" in str(caught.value) or "infinite" in str(caught.value)


def test_a_model_that_is_not_finite_at_its_start():
    system = cell(lambda x, z: -sympy.sqrt(x - 2) + z, lambda x, z: z + z**3 - x - x**3, 1.0, 1.0)
    with pytest.raises(SimulationError) as caught:
        simulate(system, 1.0)
    assert str(caught.value) == (
        "the integration stopped at t=0: an equation is not finite at the start, cell: 0 = der(x) - z + sqrt(x - 2), "
        "with 'cell.x' = 1, 'cell.z' = 1. Start elsewhere, or look for a division by zero, or a root or logarithm "
        "without a real value."
    )
    found = simulate(system, 1.0, ts=TS[:4], throw=False)
    assert found.result != diffrax.RESULTS.successful


# --- steps ---------------------------------------------------------------------------------------------------------


@ALSO_RODAS5P
def test_too_few_steps(solver):
    term = DAETerm(lambda t, x, z, a: 50 * z, lambda t, x, z, a: z - jnp.cos(50 * t))  # x = sin(50·t)
    with pytest.raises(SimulationError, match="max_steps=20 was reached. Changing fastest there: 'a.[xz]' = "):
        solve_dae(term, 2.0, (NONE, ONE), ts=TS, solver=solver, names=NAMES, max_steps=20)
    found = solve_dae(term, 2.0, (NONE, ONE), ts=TS, solver=solver, max_steps=20, throw=False)
    assert found.result == diffrax.RESULTS.max_steps_reached
    assert np.asarray(found.ys[0])[0] == 0 and np.isnan(np.asarray(found.ys[0])[1:]).all()


# --- starts --------------------------------------------------------------------------------------------------------

# x' = −x, z + z³ = x, w = z·x: (q, r) = (z, w) follow from p = x.
TERM = DAETerm(lambda t, x, z, a: -x, lambda t, x, z, a: jnp.stack([z[0] + z[0] ** 3 - x[0], z[1] - z[0] * x[0]]))
WRONG = (ONE, jnp.array([0.5, 0.1]))
PQR = ("p", "q", "r")


def test_an_inconsistent_start_is_mended():
    with pytest.raises(InitializationError) as caught:
        solve_dae(TERM, 1.0, WRONG, names=PQR)
    assert str(caught.value) == (
        "inconsistent start, the algebraic equations do not hold: row 2 of F is off by 0.4, row 1 of F is off by "
        "0.375. To mend it 'r', 'q' must move: y0 = jaxonomy_dae.solvers.consistent_start(term, y0), or "
        "system.initialize() for a compiled model"
    )
    assert solve_dae(TERM, 1.0, WRONG, throw=False).result == diffrax.RESULTS.nonlinear_divergence
    mended = consistent_start(TERM, WRONG)
    z = np.real(np.roots([1, 0, 1, -1])[-1])  # the real root of z³ + z − 1
    assert mended[0] == 1
    np.testing.assert_allclose(mended[1], [z, z], rtol=1e-14)
    found = solve_dae(TERM, 1.0, mended)
    assert found.result == diffrax.RESULTS.successful
    np.testing.assert_allclose(found.ys[0][0], np.exp(-1.0), rtol=1e-6)  # a few times rtol would do


def test_traced_starts_fail_while_running():
    def end(z, throw=None):
        solution = solve_dae(TERM, 1.0, (ONE, z), throw=throw)
        return solution.ys[0], diffrax.is_okay(solution.result)

    def start(z, throw=None):
        term = DAETerm(falling, lambda t, x, z, a: z**2 + x)
        return consistent_start(term, (ONE, z), throw=throw)[1]

    y, okay = jax.jit(end)(WRONG[1])
    assert np.isnan(y).all() and not okay
    assert np.isnan(jax.jit(start)(jnp.array([0.5]))).all()
    with pytest.raises(Exception, match="inconsistent start: see jaxonomy_dae.solvers.consistent_start"):
        jax.block_until_ready(jax.jit(functools.partial(end, throw=True))(WRONG[1]))
    with pytest.raises(Exception, match="no consistent start: Newton's method did not converge"):
        jax.block_until_ready(jax.jit(functools.partial(start, throw=True))(jnp.array([0.5])))


def test_no_consistent_start():
    with pytest.raises(InitializationError) as caught:
        consistent_start(DAETerm(falling, lambda t, x, z, a: z**2 + x), (ONE, jnp.array([0.5])), names=NAMES)
    assert str(caught.value) == (
        "no consistent start was found near y0; still moving: 'a.z'. Give a better y0, and check that the algebraic "
        "equations determine the algebraic unknowns (index 1)"
    )


@ALSO_RODAS5P
def test_an_index_above_one_is_named(solver):
    term = DAETerm(lambda t, x, z, a: z, lambda t, x, z, a: x - 1)  # x = 1, z = 0: consistent, but z needs x'
    with pytest.raises(InitializationError) as caught:
        solve_dae(term, 1.0, (ONE, NONE), solver=solver, names=NAMES)
    assert str(caught.value) == (
        "the index is above 1, or the equations are singular at the start: they do not determine 'a.z'. Differentiate "
        "the constraints, or write the model as a Component: jaxonomy_dae.AcausalCompiler reduces the index"
    )
    assert solve_dae(term, 1.0, (ONE, NONE), solver=solver, throw=False).result != diffrax.RESULTS.successful


def test_not_finite_at_the_start():
    term = DAETerm(falling, lambda t, x, z, a: z - jnp.sqrt(x - 2))
    with pytest.raises(InitializationError) as caught:
        solve_dae(term, 1.0, (ONE, ONE), names=NAMES)
    assert str(caught.value) == "the equations are not finite at the start: row 1 of F is nan. Start elsewhere"
    assert solve_dae(term, 1.0, (ONE, ONE), throw=False).result != diffrax.RESULTS.successful


# --- arguments -----------------------------------------------------------------------------------------------------


def minus(t, y, args):
    return -y


GOOD = consistent_start(TERM, WRONG)
SINGLE = jax.tree.map(lambda v: v.astype(jnp.float32), GOOD)
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
    "mass of another size": (
        lambda: solve_dae(DAETerm(minus, mass=np.ones(3)), 1.0, jnp.ones(2)),
        "mass has shape (3,), but y has 2 values: it must be (2, 2) or (2,)",
    ),
    "traced mass": (
        lambda: jax.jit(lambda m: solve_dae(DAETerm(minus, mass=m), 1.0, jnp.ones(2)).ys)(jnp.ones(2)),
        "the mass matrix of a DAETerm is constant: it cannot be traced. Move what varies into F, or solve for other "
        "variables",
    ),
    "F": (
        lambda: solve_dae(DAETerm(lambda t, y, a: y[:1], mass=np.ones(2)), 1.0, jnp.ones(2)),
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
        lambda: solve_dae(TERM, 1.0, jnp.ones(3)),
        "the solution of DAETerm(f, g) is a pair (x, z); got PyTreeDef(*)",
    ),
    "names": (lambda: solve_dae(TERM, 1.0, GOOD, names=["p"]), "names must name every unknown: 3 of them; got 1"),
    "negative rtol": (lambda: solve_dae(TERM, 1.0, GOOD, rtol=-1.0), "rtol must be a number ≥ 0; got -1.0"),
    "atol": (
        lambda: solve_dae(TERM, 1.0, GOOD, atol=jnp.ones(2)),
        "atol must be one number or look like y: expected shapes [(1,), (2,)], found [(2,)]",
    ),
    "single precision": (
        lambda: solve_dae(TERM, 1.0, SINGLE, rtol=1e-8),
        'rtol=1e-08 cannot be reached in float32 (eps 1.2e-07). Switch to double precision with jax.config.update("jax_'
        'enable_x64", True) before the model is compiled, or use rtol ≥ 2e-06.',
    ),
    "no end": (lambda: solve_dae(TERM, np.nan, GOOD), "t1 must be a finite number; got nan"),
    "times outside": (
        lambda: solve_dae(TERM, 1.0, GOOD, ts=jnp.array([0.5, 2.0])),
        "ts must lie between t0=0 and t1=1; they reach from 0.5 to 2",
    ),
    "times backwards": (
        lambda: solve_dae(TERM, 1.0, GOOD, ts=jnp.array([0.5, 0.2])),
        "ts must be sorted in the direction of integration",
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


def test_bdf_needs_tolerances_outside_of_diffrax():
    solver = BDF()
    state = solver.init(TERM, jnp.asarray(0.0), jnp.asarray(0.1), GOOD, None)
    with pytest.raises(ValueError, match="BDF needs tolerances"):
        solver.step(TERM, jnp.asarray(0.0), jnp.asarray(0.1), GOOD, None, state, False)


@ALSO_RODAS5P
def test_a_regular_mass_matrix_is_an_ordinary_equation(solver):
    matrix, field = np.array([[2.0, 1.0], [1.0, 3.0]]), np.array([[-1.0, 0.5], [0.0, -2.0]])
    term = DAETerm(lambda t, y, a: jnp.asarray(field) @ y, mass=matrix)
    solution = solve_dae(term, 1.0, jnp.array([1.0, 2.0]), solver=solver, rtol=1e-8, atol=1e-10)
    values, vectors = np.linalg.eig(np.linalg.solve(matrix, field))
    exact = np.real(vectors @ (np.exp(values) * np.linalg.solve(vectors, [1.0, 2.0])))
    np.testing.assert_allclose(solution.ys[0], exact, rtol=1e-6)  # a hundred steps' worth of rtol


@pytest.mark.parametrize("n", [1, 160])
def test_index_two_is_not_called_an_inconsistent_start(n):
    """x' = z − x, 0 = x − 0.3, from x = 0.1 + 0.2: a rounding error off, which no step can mend. Matrices of more than
    300 unknowns are not looked at."""
    term = DAETerm(lambda t, x, z, a: z - x, lambda t, x, z, a: x - 0.3)
    start = jnp.full(n, 0.1 + 0.2), jnp.full(n, 0.3)
    with pytest.raises(InitializationError, match="the index is above 1, or the equations are (nearly )?singular"):
        solve_dae(term, 1.0, start, solver=BDF())


def test_a_mass_matrix_that_is_a_function():
    with pytest.raises(ModelError, match="is constant; got a function. Where M varies, make the slopes z unknowns"):
        DAETerm(lambda t, y, args: y, mass=lambda t, y: jnp.eye(2))
