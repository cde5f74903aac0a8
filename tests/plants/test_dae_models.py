"""Models solved by `BDF` and `Rodas5P`: constraints, units, the choice of a solver, gradients, and what is said where
the solution ends."""

from typing import Any

import diffrax
import jax
import numpy as np
import pytest
import sympy
from problems import angle_solution, compiled, pendulum, without_lines
from testset import PROBLEMS

from jaxonomy_dae import Component, EqnEnv, ModelError, SimulationError, der, simulate
from jaxonomy_dae.run.simulation.step_sizes import scaled_atol
from jaxonomy_dae.run.system.solver_choice import solver_choice
from jaxonomy_dae.solvers import BDF, Rodas5P

SOLVERS = pytest.mark.parametrize("solver", [BDF(), Rodas5P()], ids=["bdf", "rodas5p"])
slow = pytest.mark.slow


# --- constraints ---------------------------------------------------------------------------------------------------


@slow
@SOLVERS
def test_the_rod_keeps_its_length(solver):
    # Saved values are projected; 1e-10 is far above rounding and far below the tolerance of the integration, 1e-6.
    system = pendulum(L=1.3)
    for end in (20.0, 1000.0):
        solution = simulate(system, end, ts=np.linspace(0.0, end, 501), solver=solver, max_steps=400_000)
        x, y = np.asarray(solution["pend.x"]), np.asarray(solution["pend.y"])
        vx, vy = np.asarray(solution["pend.vx"]), np.asarray(solution["pend.vy"])
        assert np.abs(x**2 + y**2 - 1.3**2).max() <= 1e-10
        assert np.abs(x * vx + y * vy).max() <= 1e-10
        assert np.isfinite(solution["pend.lam"]).all()
        assert (solution.stats["solver"], solution.stats["reason"]) == (type(solver).__name__, "as asked for")
        if isinstance(solver, BDF):
            assert 0 < solution.stats["num_jacobians"] < solution.stats["num_steps"]


# --- units ---------------------------------------------------------------------------------------------------------


class Decay(Component):
    """x' = −x·(1 + z²/unit²), z + z³/unit² = x, all in some unit."""

    def __init__(self, ev, unit, nominal):
        super().__init__(ev, "d")
        unit = self.parameter("unit", unit)
        x = self.variable("x", start=unit, fixed=True, nominal=nominal)
        z = self.variable("z", start=0.5 * unit, nominal=nominal)
        self.add_equations(der(x) + x * (1 + z**2 / unit**2), z + z**3 / unit**2 - x)


UNIT = 2.0**20  # a power of two: no rounding differs


def test_absolute_tolerances_are_in_units_of_nominal_values():
    plain, scaled = (compiled(Decay(EqnEnv(), UNIT, nominal)) for nominal in (1.0, UNIT))
    assert list(plain.carried) == ["d.z"]
    atol = np.array(1e-5)
    np.testing.assert_array_equal(np.broadcast_to(scaled_atol(plain, atol), (2,)), [1e-5, 1e-5])
    np.testing.assert_array_equal(scaled_atol(scaled, atol), [1e-5 * UNIT, 1e-5 * UNIT])


@slow
def test_nominal_values_scale_tolerances():
    options: dict[str, Any] = dict(solver=Rodas5P(), atol=1e-5, rtol=1e-6)

    def steps(unit, nominal=1.0):
        solution = simulate(compiled(Decay(EqnEnv(), unit, nominal)), 20.0, ts=np.array([20.0]), **options)
        return solution.stats["num_steps"], float(solution["d.x"][0]) / unit

    (small, value), (large, scaled) = steps(1.0), steps(UNIT, UNIT)
    assert abs(small - large) <= 2
    assert abs(value - scaled) < 1e-6
    assert steps(UNIT)[0] > small + 5  # an absolute tolerance of 1e-5 is far stricter there


# --- the choice of a solver ----------------------------------------------------------------------------------------


class Blocks(Component):
    """n unknowns xₖ' = zₖ with zₖ + zₖ³ = xₖ."""

    def __init__(self, ev, n):
        super().__init__(ev, "b")
        for k in range(n):
            x, z = self.variable(f"x{k}", start=1.0 + k / n, fixed=True), self.variable(f"z{k}", start=0.5)
            self.add_equations(der(x) - z, z + z**3 - x)


CHOICES = [
    (0, "Tsit5", "explicit: no nonlinear block is left; implicit if a run turns out to be stiff"),
    (1, "Rodas5P", "nonlinear blocks leave the algebraic unknowns b.z0"),
    (16, "BDF", "nonlinear blocks leave the algebraic unknowns b.z0, b.z1, b.z2 and 13 more; cheaper for 32 unknowns"),
]


def blocks(n):
    return compiled(Blocks(EqnEnv(), n)) if n else pendulum()


@pytest.mark.parametrize("n, expected, reason", CHOICES)
def test_the_choice_is_said(n, expected, reason):
    system = blocks(n)
    assert f"simulate(solver=None) takes {expected}: {reason}" in str(system.report)
    assert solver_choice(system.plan)[:2] == (expected, reason)


@slow
@pytest.mark.parametrize("n, expected, reason", CHOICES)
def test_the_choice_is_taken(n, expected, reason):
    solution = simulate(blocks(n), 0.3, ts=np.array([0.3]))
    assert (solution.stats["solver"], solution.stats["reason"]) == (expected, reason)
    if n:
        assert np.isfinite(np.asarray(solution["b.z0"])).all()


# --- gradients -----------------------------------------------------------------------------------------------------


def final(system, names, starts, t1, variable, solver):
    """(parameters and starts, rtol, adjoint) to a variable at t1."""

    def at_end(v, rtol, adjoint):
        changed = system.with_parameters(dict(zip(names, v[: len(names)], strict=True)))
        start = dict(zip(starts, v[len(names) :], strict=True))
        return simulate(
            changed, t1, ts=np.array([t1]), solver=solver, rtol=rtol, atol=rtol * 1e-2, adjoint=adjoint, initial=start,
            max_steps=4000,
        )[variable][0]  # fmt: skip

    return at_end


def by_differences(function, values):
    """Central differences of a function of an array, with steps of 1e-4 relative."""
    found = []
    for k, value in enumerate(np.asarray(values)):
        move = np.zeros(len(values))
        move[k] = 1e-4 * abs(value)
        found.append(float(function(values + move) - function(values - move)) / (2 * move[k]))
    return np.array(found)


@slow
@pytest.mark.parametrize("solver", [BDF()], ids=["bdf"])
def test_gradients_of_a_constrained_model(solver):
    # The multiplier is not a state: its gradient goes through hidden constraints and the projection. The reference is
    # SciPy's solution for the angle, at 1e-13.
    names, values = ("pend.L", "pend.g_y", "pend.m", "pend.initial_theta"), np.array([1.3, -9.81, 0.6, -1.2])
    at_end = final(pendulum(), names, (), 0.7, "pend.lam", solver)
    found = jax.jit(jax.grad(lambda v: at_end(v, 1e-8, None)))(values)

    def exact(v):
        return angle_solution(v[3], 0.0, [0.7], g=-v[1], L=v[0], m=v[2]).lam[0]

    np.testing.assert_allclose(found, by_differences(exact, values), rtol=1e-5)


@slow
def test_gradients_of_a_model_of_reactions():
    """By parameters and starts: both modes, and differences at a tighter tolerance."""
    system, starts = PROBLEMS["chemakzo"].compile(), {"chemakzo.FLB": 0.444, "chemakzo.ZLA": 0.007}
    names = ("chemakzo.k1", "chemakzo.klA")
    at_end = final(system, names, tuple(starts), 20.0, "chemakzo.FLB_ZHU", Rodas5P())
    values = np.array([float(system.parameters[n]) for n in names] + list(starts.values()))
    both = jax.jit(lambda v, rtol: jax.value_and_grad(lambda v: at_end(v, rtol, None))(v))
    reverse = np.asarray(both(values, np.array(1e-8))[1])
    expected = by_differences(lambda v: both(v, np.array(1e-11))[0], values)
    np.testing.assert_allclose(reverse, expected, rtol=1e-5)
    forward = jax.jit(jax.jacfwd(lambda v: at_end(v, np.array(1e-8), diffrax.ForwardMode())))(values)
    size = np.max(np.abs(reverse * values))
    np.testing.assert_allclose(reverse * values, forward * values, rtol=0, atol=1e-8 * size)


def test_backsolve_is_refused():
    with pytest.raises(ModelError) as caught:
        simulate(pendulum(), 1.0, solver=BDF(), adjoint=diffrax.BacksolveAdjoint())
    assert str(caught.value) == (
        "adjoint=BacksolveAdjoint() is wrong for constrained systems: it integrates the state backwards without its "
        "constraints and leaves the algebraic variables out. Use the default StoredAdjoint(), "
        "RecursiveCheckpointAdjoint(), or ForwardMode() for few parameters"
    )


# --- ends ----------------------------------------------------------------------------------------------------------


class Cell(Component):
    """x' = rate(x, z), 0 = law(x, z), a nonlinear block."""

    def __init__(self, ev, rate, law, x0, z0):
        super().__init__(ev, "cell")
        a, b = self.parameter("a", 0.0), self.parameter("b", -10.0)
        x, z = self.variable("x", start=x0, fixed=True), self.variable("z", start=z0)
        self.add_equations(der(x) - rate(x, z, a, b), law(x, z))


def cell(rate, law, x0, z0):
    return compiled(Cell(EqnEnv(), rate, law, x0, z0))


@pytest.fixture(scope="module")
def folded():
    """x falls from 2 along x = z³ − 3z, which turns back at z = 1, x = −2, t = 4. With b above 2 its rate is not
    finite."""
    system = cell(lambda x, z, a, b: -1 + a * sympy.sqrt(x - b), lambda x, z: z**3 - 3 * z - x, 2.0, 2.0)
    assert list(system.carried) == ["cell.z"]
    return system


FOLDED = (
    "the integration stopped at t=4: no step was short enough to be accepted. The nonlinear equation for 'cell.z' = 1 "
    "has no solution just beyond: Newton's method does not converge from these values (a turning point, at which two "
    "solutions meet and end; a jump to another branch; or a law without a solution).\n  cell: 0 = -x + z**3 - 3*z"
)
TS = np.linspace(0.0, 6.0, 13)
# None takes Rodas5P.
ALSO_BDF = pytest.mark.parametrize("solver", [None, pytest.param(BDF(), marks=slow)], ids=["default", "bdf"])


@pytest.mark.slow
@pytest.mark.long("compiles the program that the tests beside it share")
@ALSO_BDF
def test_a_model_reports_its_turning_point(folded, solver):
    with pytest.raises(SimulationError) as caught:
        simulate(folded, 6.0, ts=TS, solver=solver)
    assert without_lines(caught.value) == FOLDED
    found = simulate(folded, 6.0, ts=TS, solver=solver, throw=False)
    assert found.result == diffrax.RESULTS.dt_min_reached
    assert found.stats["solver"] == ("Rodas5P" if solver is None else "BDF")
    before = TS < 3.9
    # z is solved for again at saved times: as exact as x, which is linear in time.
    x, z = np.asarray(found["cell.x"])[before], np.asarray(found["cell.z"])[before]
    np.testing.assert_allclose(x, 2 - TS[before], atol=1e-9)
    np.testing.assert_allclose(z**3 - 3 * z, x, atol=1e-9)
    assert np.isnan(np.asarray(found.states)[TS > 4.1]).all()


@pytest.mark.slow
@ALSO_BDF
def test_a_model_that_is_not_finite_at_its_start(folded, solver):
    system = folded.with_parameters({"cell.a": 1.0, "cell.b": 3.0})
    with pytest.raises(SimulationError) as caught:
        simulate(system, 6.0, ts=TS, solver=solver)
    assert without_lines(caught.value) == (
        "the integration stopped at t=0: an equation is not finite at the start, cell: 0 = -a*sqrt(-b + x) + der(x) + "
        "1, with 'cell.x' = 2, 'cell.a' = 1, 'cell.b' = 3. Start elsewhere, or look for a division by zero, or a root "
        "or logarithm without a real value."
    )
    found = simulate(system, 6.0, ts=TS, solver=solver, throw=False)
    assert found.result != diffrax.RESULTS.successful


@slow
@pytest.mark.parametrize("solver", [BDF()], ids=["bdf"])
def test_a_model_reports_too_few_steps(folded, solver):
    with pytest.raises(SimulationError) as caught:
        simulate(folded, 3.0, solver=solver, max_steps=5)
    message = str(caught.value)
    assert "max_steps=5 was reached. Changing fastest there: 'cell.x' = " in message
    assert "Raise max_steps, loosen rtol=1e-06 and atol, or look for a jump or a pole: jump_ts= names" in message
    found = simulate(folded, 3.0, solver=solver, max_steps=5, throw=False)
    assert found.result == diffrax.RESULTS.max_steps_reached
    assert np.isfinite(np.asarray(found.states)).all() and 1 < len(found.ts) <= 6


@slow
@pytest.mark.parametrize(
    "solver, rate, law",
    [
        (Rodas5P(), lambda x, z, a, b: z**2, lambda x, z: z + z**3 - x - x**3),
        (BDF(), lambda x, z, a, b: -1, lambda x, z: z + sympy.exp(z) - sympy.sqrt(x) - sympy.exp(sympy.sqrt(x))),
    ],
    ids=["pole-rodas5p", "root-bdf"],
)
def test_models_report_poles_and_roots(rate, law, solver):
    system = cell(rate, law, 1.0, 1.0)
    with pytest.raises(SimulationError, match="the integration stopped at t=") as caught:
        simulate(system, 6.0, solver=solver)
    assert abs(float(str(caught.value).split("t=")[1].split(":")[0]) - 1) < 1e-4
    assert "'cell.z'" in str(caught.value) or "not finite" in str(caught.value) or "infinite" in str(caught.value)
