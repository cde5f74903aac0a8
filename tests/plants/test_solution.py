"""What `simulate` returns: saved times, names, residuals, failures, figures."""

import diffrax
import equinox as eqx
import hybrid_models
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import angle_solution, compiled, component, damped_oscillation, oscillator, pendulum
from sympy import Eq
from trajectories import solution_of

from jaxonomy_dae import AcausalSystem, Component, EqnEnv, ModelError, SimulationError, Solution, der, simulate
from jaxonomy_dae.run.simulation import solution as solution_module

TS = jnp.array([0.0, 0.4, 1.1])


@pytest.fixture(scope="module")
def system():
    return oscillator()


@pytest.fixture(scope="module")
def solution(system):
    return simulate(system, 1.1, ts=TS, rtol=1e-9, atol=1e-11)


# --- names -------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_variables_by_name(solution):
    x, v = damped_oscillation(np.asarray(TS))
    assert isinstance(solution, Solution) and isinstance(solution.system, AcausalSystem)
    for name, expected in {
        "mass.s": x,  # a state
        "mass.v": v,
        "der(mass.s)": v,
        "der(mass.v)": (-0.6 * v - 5.0 * x) / 2.0,
        "der(der(mass.s))": (-0.6 * v - 5.0 * x) / 2.0,
        "mass.flange.s": x,  # equal to a state
        "spring.f": 5.0 * x,  # solved for
        "spring.flange_a.f": -5.0 * x,  # eliminated, with a sign
        "wall.flange.s": 0.0 * x,  # a parameter
    }.items():
        assert solution[name].shape == (3,)
        np.testing.assert_allclose(solution[name], expected, rtol=0, atol=1e-7, err_msg=name)  # 100 × tolerance
    np.testing.assert_array_equal(solution["time"], TS)
    np.testing.assert_array_equal(solution.ts, TS)
    assert "mass.s" in solution and "time" in solution and "mass.y" not in solution


def test_unknown_names(solution):
    with pytest.raises(ModelError, match=r"'mass\.ss' is not a variable: did you mean 'mass\.s'"):
        solution["mass.ss"]
    with pytest.raises(ModelError, match=r"'der\(der\(der\(mass\.s\)\)\)' occurs nowhere.*only 'mass\.s'"):
        solution["der(der(der(mass.s)))"]


def test_to_dict_has_everything(solution, system):
    everything = solution.to_dict()
    assert list(everything) == ["time", *system.variables]
    for name in ("time", "mass.s", "spring.f", "spring.flange_a.f", "wall.flange.s"):
        np.testing.assert_array_equal(everything[name], solution[name], err_msg=name)


def test_to_dict_evaluates_once(solution, monkeypatch):
    evaluated = []
    chosen = solution_module._chosen
    monkeypatch.setattr(solution_module, "_chosen", lambda *given: (evaluated.append(1), chosen(*given))[1])
    solution.to_dict()
    assert len(evaluated) == 1


def test_several_names_are_columns(solution):
    names = ["spring.f", "time", "mass.s", "spring.flange_a.f", "der(mass.v)", "wall.flange.s"]
    found = solution[names]
    assert found.shape == (3, 6)
    for k, name in enumerate(names):
        np.testing.assert_array_equal(found[:, k], solution[name], err_msg=name)
    assert solution[[]].shape == (3, 0)
    inside = eqx.filter_jit(lambda s: s[names])(solution)
    np.testing.assert_allclose(inside, found, rtol=1e-14)
    batch = eqx.filter_vmap(lambda x: solution_of(solution.system, TS, x))(jnp.ones((2, 3, 2)))
    assert batch[names].shape == (2, 3, 6)
    for wrong in (0, None, ["mass.s", 1]):
        with pytest.raises(ModelError, match=r"by names, solution\['m\.x'\] or solution\[\['m\.x', 'm\.y'\]\]"):
            solution[wrong]
    with pytest.raises(ModelError, match=r"'mass\.ss'"):
        solution[["mass.s", "mass.ss"]]


def test_html(solution):
    text = solution._repr_html_()
    for part in ("finished", "0 to 1.1", "mass.s, mass.v", "Tsit5"):
        assert part in text


def test_a_solution_is_a_pytree(solution):
    doubled = jax.tree.map(lambda leaf: 2 * leaf if isinstance(leaf, jax.Array) else leaf, solution)
    np.testing.assert_array_equal(doubled.ts, 2 * TS)
    assert "3 times" in repr(solution)


@pytest.mark.slow
def test_solutions_may_leave_jit(system):
    @eqx.filter_jit
    def run(x0):
        solution = simulate(system, 1.1, ts=TS, initial={"mass.s": x0})
        return solution, solution["spring.f"]

    solution, f = run(jnp.array(0.2))
    x = damped_oscillation(np.asarray(TS), x0=0.2)[0]
    np.testing.assert_allclose(solution["mass.s"], x, rtol=0, atol=1e-4)  # a hundred times the tolerance
    np.testing.assert_array_equal(solution["spring.f"], f)
    np.testing.assert_allclose(f, 5.0 * solution["mass.s"], rtol=1e-12)


def test_stats_and_result(solution):
    assert solution.result == diffrax.RESULTS.successful
    assert solution.stats["num_steps"] == solution.stats["num_accepted_steps"] + solution.stats["num_rejected_steps"]
    assert all(isinstance(v, int) for v in solution.counts.values())
    assert solution.stats["solver"] == "Tsit5" and solution.stats["reason"].startswith("explicit")


# --- saved times -------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_without_times_every_step_is_saved(system):
    solution = simulate(system, 1.1, rtol=1e-9, atol=1e-11)
    t = np.asarray(solution.ts)
    assert t[0] == 0.0 and t[-1] == 1.1 and (np.diff(t) > 0).all()
    assert len(t) == solution.stats["num_accepted_steps"] + 1 > 5
    np.testing.assert_allclose(solution["mass.s"], damped_oscillation(t)[0], rtol=0, atol=1e-7)
    assert solution["spring.f"].shape == t.shape


def test_another_start_time(system):
    """The model does not know the time, so only the interval's length matters."""
    solution = simulate(system, 4.1, t0=3.0, ts=TS + 3.0, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(solution["mass.s"], damped_oscillation(np.asarray(TS))[0], rtol=0, atol=1e-7)


def test_rounding_in_times_is_forgiven(system):
    """0.1 + 0.1 + 0.1 is a little more than 0.3."""
    ts = np.arange(1, 4) * 0.1
    assert ts[-1] > 0.3
    solution = simulate(system, 0.3, ts=ts.tolist(), rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(solution["mass.s"], damped_oscillation(ts)[0], rtol=0, atol=1e-7)


def test_constraint_residuals():
    """Written out: x² + y² − L² and its derivative, at a point off the circle."""
    plain = pendulum()
    off = jnp.array([{"pend.x": 0.9, "pend.y": -0.7, "pend.vx": 0.36, "pend.vy": 0.45}[n] for n in plain.states])
    residual = jax.jit(lambda t, x: plain.constraint_residual(t, x))
    found = sorted(np.asarray(residual(0.0, off)))
    np.testing.assert_allclose(found, sorted([0.81 + 0.49 - 1.0, 2 * (0.9 * 0.36 - 0.7 * 0.45)]), rtol=1e-12)
    projected = jax.jit(lambda x: plain.project(0.0, x, iterations=5))(off)
    assert np.max(np.abs(residual(0.0, projected))) < 1e-14
    x, y = np.asarray(projected)[[plain.states.index("pend.x"), plain.states.index("pend.y")]]
    # The velocity is nearly tangential, so the nearest point lies in the radius' direction, up to 0.14²/2.
    np.testing.assert_allclose([x, y], np.array([0.9, -0.7]) / np.hypot(0.9, 0.7), atol=0.01)


def test_an_unconstrained_system_has_no_residuals(solution):
    assert solution.constraint_residual().shape == (3, 0)


# --- failures ----------------------------------------------------------------------------------------------------


class Blowup(Component):
    """dx/dt = x², from 1: x = 1/(1 − t), infinite at t = 1."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        x = self.variable("x", start=1.0, fixed=True)
        self.add_equations(Eq(der(x), x**2))
        self.output("half", x / 2)


@pytest.fixture(scope="module")
def blowup():
    return compiled(Blowup(EqnEnv(), "c"))


@pytest.mark.slow
def test_failure_without_throw_keeps_what_was_reached(blowup):
    ts = jnp.array([0.3, 0.6, 0.9, 1.2, 1.5])
    solution = simulate(blowup, 1.5, ts=ts, max_steps=200, throw=False)
    assert solution.result != diffrax.RESULTS.successful
    x = np.asarray(solution["c.x"])
    np.testing.assert_allclose(x[:3], 1 / (1 - np.asarray(ts[:3])), rtol=1e-4)  # a hundred times the tolerance
    assert not np.isfinite(x[3:]).any() and not np.isfinite(np.asarray(solution["c.half"])[3:]).any()
    np.testing.assert_allclose(np.asarray(solution["c.half"])[:3], x[:3] / 2, rtol=1e-12)


def test_failure_raises_in_plain_words(blowup):
    with pytest.raises(SimulationError, match=r"at t=1: max_steps=200.*'c\.x' is .* infinite near t=1,"):
        simulate(blowup, 1.5, ts=jnp.array([0.3, 0.6, 0.9, 1.2, 1.5]), max_steps=200)


@pytest.mark.slow
def test_every_step_saved_up_to_a_failure(blowup):
    solution = simulate(blowup, 1.5, max_steps=50, throw=False)
    t = np.asarray(solution.ts)
    assert np.isfinite(t).all() and 0.5 < t[-1] < 1.0 and len(solution["c.x"]) == len(t)
    np.testing.assert_allclose(solution["c.x"], 1 / (1 - t), rtol=1e-3)


@pytest.mark.slow
def test_failures_in_a_batch_are_told_apart(blowup):
    """x = x₀/(1 − x₀·t): of three members one does not reach t = 1.5."""

    @jax.jit
    @jax.vmap
    def run(x0):
        solution = simulate(
            blowup, 1.5, ts=jnp.array([0.3, 1.5]), initial={"c.x": x0}, max_steps=100, throw=False
        )  # fmt: skip
        return solution["c.x"], diffrax.is_okay(solution.result)

    start = jnp.array([0.5, 1.0, -1.0])
    x, okay = run(start)
    assert okay.tolist() == [True, False, True]
    expected = np.asarray(start)[:, None] / (1 - np.asarray(start)[:, None] * np.array([0.3, 1.5]))
    np.testing.assert_allclose(np.asarray(x)[[0, 2]], expected[[0, 2]], rtol=1e-4)  # a hundred times the tolerance
    assert float(x[1, 0]) == pytest.approx(expected[1, 0], rel=1e-4) and not np.isfinite(x[1, 1])


@pytest.mark.slow
def test_progress_is_shown(blowup, capfd):
    simulate(blowup, 0.5, ts=jnp.array([0.5]), progress=True)
    assert "100" in capfd.readouterr().err


def test_failure_inside_jit(blowup):
    def run(throw):
        solution = simulate(blowup, 1.5, ts=jnp.array([0.5, 1.5]), max_steps=50, throw=throw)
        return solution["c.x"], solution.result == diffrax.RESULTS.max_steps_reached

    x, many = jax.jit(lambda: run(None))()
    assert float(x[0]) == pytest.approx(2.0, rel=1e-4) and np.isnan(x[1]) and many
    with pytest.raises(Exception, match="max_steps=.* was reached"):
        jax.block_until_ready(jax.jit(lambda: run(True))())


@pytest.mark.slow
def test_a_constrained_systems_rows_up_to_a_failure():
    ts = jnp.linspace(0.0, 5.0, 11)
    solution = simulate(pendulum(), 5.0, ts=ts, max_steps=30, throw=False)
    x = np.asarray(solution["pend.x"])
    done = np.isfinite(x)
    assert 1 < done.sum() < 11 and not done[done.sum() :].any()
    np.testing.assert_allclose(x[done], angle_solution(-1.2, 0.0, ts[done]).x, rtol=0, atol=1e-4)  # 100 × tolerance
    residual = solution.constraint_residual()
    assert residual.shape == (11, 2)
    assert np.max(np.abs(np.asarray(residual)[done])) < 1e-13  # projected to rounding


# --- figures -----------------------------------------------------------------------------------------------------


def test_plot(solution):
    plt = pytest.importorskip("matplotlib.pyplot")
    axes = solution.plot()
    assert [ax.get_ylabel() for ax in axes] == ["mass.s / m", "mass.v / (m/s)"]  # one panel for each unit
    np.testing.assert_array_equal(axes[0].lines[0].get_ydata(), solution["mass.s"])
    assert axes[1].get_xlabel() == "Time / s"
    together = solution.plot("mass.s", "wall.flange.s")
    assert together.get_ylabel() == "Position / m"
    assert [line.get_label() for line in together.lines] == ["mass.s", "wall.flange.s"]
    _, given = plt.subplots()
    assert solution.plot("spring.f", ax=given) is given
    assert given.get_ylabel() == "spring.f / N"
    starts = jnp.array([[1.0, 0.0], [2.0, 0.0]])
    batch = eqx.filter_vmap(lambda x: solution_of(solution.system, TS, jnp.broadcast_to(x, (3, 2))))(starts)
    axes = batch.plot("mass.s")  # a bare error of Matplotlib
    for line, s in zip(axes.lines, (1.0, 2.0), strict=True):
        np.testing.assert_array_equal(line.get_xydata(), np.stack([TS, np.full(3, s)], axis=1))
    plt.close("all")


def marks(axes):
    """The labels of the events that are marked, and the times and heights of their lines."""
    return {
        c.get_label(): ([float(at[0, 0]) for at in c.get_segments()], float(c.get_segments()[0][1, 1]))
        for c in axes.collections
    }


@pytest.mark.slow
def test_events_in_figures():
    plt = pytest.importorskip("matplotlib.pyplot")
    room = hybrid_models.compiled(hybrid_models.Thermostat, "room")
    coarse = simulate(room, 5.0, ts=jnp.linspace(0.0, 5.0, 6))
    off, on, again = np.asarray(coarse.events.ts[:3])
    axes = coarse.plot("room.T")
    assert [text.get_text() for text in axes.get_legend().get_texts()] == [
        "room.T", "room: when(T > 51)", "room: when(T < 49)"
    ]  # fmt: skip
    assert marks(axes) == {"room: when(T > 51)": ([off, again], 1.0), "room: when(T < 49)": ([on], 1.0)}
    assert axes.get_ylim()[0] > 15.0  # the lines do not widen the axes
    coarse.plot("room.q", ax=axes)
    assert [text.get_text() for text in axes.get_legend().get_texts()].count("room: when(T < 49)") == 1
    bare = coarse.plot("room.T", events=False)
    assert not bare.collections and bare.get_legend() is None
    # Steps are where the events were, between saved times too.
    line = coarse.plot("room.on", events=False).lines[0]
    assert line.get_drawstyle() == "steps-post"
    np.testing.assert_array_equal(line.get_xdata(), [0, 1, 2, 3, off, 4, on, again, 5])
    np.testing.assert_array_equal(line.get_ydata(), [1, 1, 1, 1, 0, 0, 1, 0, 0])
    # Those outside of the saved times are not shown; many are ticks.
    late = simulate(room, 5.0, ts=jnp.linspace(4.5, 5.0, 6))  # as many times: the same program
    assert marks(late.plot("room.T")) == {"room: when(T > 51)": ([float(late.events.ts[2])], 1.0)}
    many = simulate(room, 30.0, ts=jnp.linspace(0.0, 30.0, 6))
    (name, (times, height)), *others = marks(many.plot("room.T")).items()
    assert name == "events" and len(times) == len(many.events) > 40 and height < 0.1 and not others
    plt.close("all")


@pytest.mark.slow
def test_the_event_that_ends_a_run_is_marked():
    plt = pytest.importorskip("matplotlib.pyplot")
    solution = simulate(hybrid_models.compiled(hybrid_models.Ball, "ball", stop=3), 3.0)
    axes = solution.plot("ball.h", "ball.n")
    assert [len(times) for times, _ in marks(axes).values()] == [3, 1]
    assert axes.lines[0].get_drawstyle() == "default" and axes.lines[1].get_ydata()[-1] == 3
    plt.close("all")


@pytest.mark.slow
def test_a_sampled_controller_is_drawn_in_steps():
    plt = pytest.importorskip("matplotlib.pyplot")
    solution = simulate(hybrid_models.compiled(hybrid_models.SampledPI, "loop"), 0.4, ts=jnp.linspace(0.0, 0.4, 9))
    axes = solution.plot("loop.x", "loop.u")
    assert [line.get_drawstyle() for line in axes.lines] == ["default", "steps-post"] and not axes.collections
    np.testing.assert_array_equal(axes.lines[1].get_ydata(), solution["loop.u"])
    plt.close("all")


def test_a_model_of_zeros_is_observed():
    class Zeros(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            x, y = self.variable("x"), self.variable("y")
            self.add_equations(Eq(x, 0), Eq(y, -x))

    system = compiled(Zeros(EqnEnv(), "c"))
    read = jax.jit(lambda x: system.observe(["c.x", "c.y"], 0.0, x))
    np.testing.assert_array_equal(read(jnp.zeros(0)), 0.0)
    np.testing.assert_array_equal(solution_of(system, [0.5, 1.0], np.zeros((2, 0)))["c.y"], [0.0, 0.0])


@pytest.mark.slow
def test_quantities_are_read_in_blocks_of_times(monkeypatch):
    """Kind: what is read costs what was not asked for. One algebraic variable of a large model was all quantities at
    all times: 0.8 GB for 8 kB. Blocks give the same numbers, the last one shorter too."""
    from jaxonomy_dae.host import rows

    def write(self, ev):
        x, y, z = self.variable("x", start=1.0, fixed=True), self.variable("y"), self.variable("z")
        self.add_equations(Eq(der(x), -x), Eq(y, x**2 + ev.t), Eq(z, y - x))

    ts = np.linspace(0.0, 1.0, 11)
    solution = simulate(compiled(component(write)), 1.0, ts=ts, rtol=1e-9, atol=1e-11)
    monkeypatch.setattr(rows, "ROOM", 4 * 4)  # times
    text = str(jax.make_jaxpr(lambda x: rows.at_times(lambda a: a + 1, x, width=4))(jnp.ones(11)))
    assert "scan" in text
    x = np.exp(-ts)
    np.testing.assert_allclose(solution["c.y"], x**2 + ts, rtol=1e-7)
    np.testing.assert_allclose(solution[["c.z", "c.y", "c.x"]], np.stack([x**2 + ts - x, x**2 + ts, x], 1), atol=1e-7)
