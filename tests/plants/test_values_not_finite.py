"""Variables that no state reads, and that are not finite at a saved time: refused, or not-a-number."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sympy
from problems import compiled

from jaxonomy_dae import Component, Eq, EqnEnv, SimulationError, assign, der, simulate
from jaxonomy_dae.library import rotational as rot
from jaxonomy_dae.library import translational as line
from jaxonomy_dae.library.friction import Brake, StickingFriction

TS = jnp.linspace(0.0, 2.0, 5)


class Quotient(Component):
    """x' = −p from x(0) = 1.1; y = √x is not a number beyond x = 0, z reads it, and nothing determines f in mode 1."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        x, y, z, f = (self.variable(n, start=1.1, fixed=n == "x") for n in ("x", "y", "z", "f"))
        p, mode = self.parameter("p", 1.0), self.discrete("mode", start=0)
        self.add_equations(Eq(der(x), -p), Eq(y, sympy.sqrt(x)), Eq(z, 2 * y + 1))
        self.either(Eq(mode, 1), sympy.Integer(0), f - 2)
        self.when(x <= 0.3, assign(mode, 1))
        self.declare_energy(y**2)


@functools.cache
def quotient():
    return compiled(Quotient(EqnEnv(), "c"))


def run(system, **options):
    return simulate(system, 2.0, ts=TS, **options)


@pytest.mark.long("a run with an event is compiled")
def test_a_variable_that_is_not_finite_is_refused_where_it_is_read():
    """Kind: what no state reads is not judged by the run. Variables were not-a-number at saved times without a word;
    now an error names the variable, the time and the equation, and other variables can be read."""
    solution = run(quotient())
    np.testing.assert_allclose(solution["c.x"], 1.1 - np.asarray(TS), atol=1e-12)
    for read in ("c.z", ["c.x", "c.z"]):
        with pytest.raises(SimulationError, match=r"(?s)'c.z' is nan at t=1.5.*'c.y' follows.*sqrt.*'c.x' = -0.4"):
            solution[read]
    with pytest.raises(SimulationError, match=r"(?s)'c.f' is nan at t=1, and at 2 more.*'c.mode' = 1"):
        solution["c.f"]
    with pytest.raises(SimulationError, match="c.f"):
        solution.to_dict()
    with pytest.raises(SimulationError, match="the energy that 'c' declares is nan at t=1.5"):
        solution.energy()


@pytest.mark.slow
def test_in_batches_and_in_jit_it_is_not_a_number():
    """A member that fails does so alone; the warning outside of jit names it. With `throw=False` nothing is raised."""
    reached = 2 * np.sqrt(1.1 - np.asarray(TS[:3])) + 1

    def of(p, **options):
        return run(quotient().with_parameters({"c.p": p}), **options)

    np.testing.assert_allclose(of(1.0, throw=False)["c.z"], [*reached, np.nan, np.nan], atol=1e-7)
    inside = jax.jit(lambda p: of(p)["c.z"])(1.0)
    np.testing.assert_allclose(inside, [*reached, np.nan, np.nan], atol=1e-7)
    batch = eqx.filter_vmap(of)(jnp.array([0.25, 1.0]))
    with pytest.warns(RuntimeWarning, match="'c.z' is not a number at saved times of member 1 of 2"):
        values = batch["c.z"]
    np.testing.assert_allclose(values[0], 2 * np.sqrt(1.1 - 0.25 * np.asarray(TS)) + 1, atol=1e-7)
    assert np.isnan(values[1, 3:]).all()


class Prescribed(Component):
    """A flange that moves as a function of time says."""

    def __init__(self, ev, name, position):
        super().__init__(ev, name)
        flange = self.port("flange", line.Translational)
        self.add_equations(Eq(flange.s, position(ev.t)))


def _rests(t):
    """−(t − ½)² until t = ½, then rest, from t = 1 on (t − 1)² downward."""
    half = sympy.Rational(1, 2)
    return sympy.Piecewise((-((t - half) ** 2), t < half), (0, t < 1), (-((t - 1) ** 2), True))


def _jumps(t):
    """Rest, the speed 1 from t = ½ to t = 1, and rest again."""
    half = sympy.Rational(1, 2)
    return sympy.Piecewise((0, t < half), (t - half, t < 1), (half, True))


@pytest.mark.parametrize(
    ("position", "friction", "mode"),
    [(_rests, [2, 2, 0, -2], [1, 1, 0, -1]), (_jumps, [0, 0, 2, 0], [0, 0, 1, 0])],
)
@pytest.mark.slow
def test_prescribed_motion_that_rests_on_friction(position, friction, mode):
    """Kind: a mode that does not determine a variable. The friction of parts that a source holds at rest was 0/0; it is
    zero, and slides as soon as the source moves on, also where it jumps to a speed or onto rest."""
    ev = EqnEnv()
    moved, wall = Prescribed(ev, "moved", position), line.FixedPosition(ev, "wall")
    rubs = StickingFriction(ev, "rubs", 2.0, 3.0)
    system = compiled(moved, wall, rubs, connect=[(moved.flange, rubs.flange_b), (wall.flange, rubs.flange_a)])
    solution = simulate(system, 1.25, ts=jnp.array([0.0, 0.25, 0.75, 1.25]))
    np.testing.assert_array_equal(solution["rubs.f"], friction)
    np.testing.assert_array_equal(solution["rubs.mode"], mode)


@pytest.mark.slow
def test_a_brake_on_a_shaft_that_samples_move():
    """The same with samples as the input of a source: rest, a turn forth and back, rest."""
    ev = EqnEnv()
    turn, brake = rot.AngleSource(ev, "turn"), Brake(ev, "brake", mu=0.5, fn_max=8.0)
    system = compiled(turn, brake, connect=[(turn.flange, brake.flange)])
    samples = jnp.array([0.0, 1.0, 2.0, 3.0]), jnp.array([0.3, 0.3, 1.0, 1.0]), "cubic"
    solution = simulate(system, 2.5, ts=jnp.array([0.0, 0.5, 1.5, 2.5]), inputs={"turn.u": samples, "brake.u": 1.0})
    w = np.asarray(solution["brake.w"])
    np.testing.assert_array_equal(w[:2], 0)
    np.testing.assert_array_equal(solution["brake.flange.tau"], 4.0 * np.sign(w))
