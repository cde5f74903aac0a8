"""FMUs beside the systems that they were made of: runs by FMPy's CVode, derivatives, events, states that are saved."""

import contextlib
import math
import shutil
import subprocess
import threading
import zipfile
from pathlib import Path

import jax
import numpy as np
import pytest
from cell_arrays import ladder
from fmus import check_derivatives, compare, exported, opened, run
from hybrid_models import Ball, Bob, Doubling, SampledPI, Stick, Thermostat
from hybrid_models import compiled as hybrid
from problems import compiled, drag_on, mlp, pendulum

from jaxonomy_dae import Component, EqnEnv, der, terminate
from jaxonomy_dae.errors import ModelError
from jaxonomy_dae.fmi import export_fmu
from jaxonomy_dae.fmi.compilers import FLAGS, compiler_for, this_platform
from jaxonomy_dae.fmi.description import structured
from jaxonomy_dae.write import Eq

pytestmark = pytest.mark.skipif(compiler_for(this_platform()) is None, reason="no C compiler on this machine")


class Robertson(Component):
    """Three reacting species, their sum conserved; Robertson 1966."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        k1, k2, k3 = (self.parameter(n, v) for n, v in (("k1", 0.04), ("k2", 3e7), ("k3", 1e4)))
        a, b = self.variable("a", start=1.0, fixed=True), self.variable("b", start=0.0, fixed=True, nominal=1e-5)
        c = self.variable("c", start=0.0)
        self.add_equations(
            Eq(der(a), -k1 * a + k3 * b * c), Eq(der(b), k1 * a - k3 * b * c - k2 * b**2), Eq(a + b + c, 1)
        )


class House(Component):
    """Two masses that exchange heat nonlinearly, with the outside from outside; q follows from an implicit equation."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        outside, heat = self.input("outside", default=5.0), self.input("heat", default=1.0)
        C, G = self.parameter("C", 2.0, bounds=(0.1, 100.0)), self.parameter("G", 0.3)
        air, wall = self.variable("air", start=20.0, fixed=True), self.variable("wall", start=15.0, fixed=True)
        q = self.variable("q", start=1.0)
        self.add_equations(
            Eq(C * der(air), heat - q), Eq(10 * der(wall), q - G * (wall - outside)), Eq(q + 0.1 * q**3, air - wall)
        )


class Learned(Component):
    """A state that falls by a function of it."""

    def __init__(self, ev, name, function):
        super().__init__(ev, name)
        x = self.variable("x", start=1.0, fixed=True)
        (y,) = self.function("law", function, inputs=[x])
        self.add_equations(Eq(der(x), -y))


def house():
    return compiled(House(EqnEnv(), "house"))


def swing(mode="auto"):
    return pendulum(drag_on("vx", "vy", network=mlp(2, 2)), compiler={"state_selection": mode})


# --- a ball: all of it, once ---------------------------------------------------------------------------------------


def bounces(h0, e, g, t):
    """Height, speed and count of a ball that bounces, in closed form."""
    fall = math.sqrt(2 * h0 / g)
    if t < fall:
        return h0 - g * t**2 / 2, -g * t, 0
    n, begin, speed = 1, fall, e * g * fall
    while t >= begin + 2 * speed / g:
        begin, speed, n = begin + 2 * speed / g, e * speed, n + 1
    s = t - begin
    return speed * s - g * s**2 / 2, speed - g * s, n


@pytest.fixture(scope="module")
def heated(tmp_path_factory):
    """The house, with one output."""
    return exported(house(), tmp_path_factory.mktemp("house"), "house", outputs=["house.q"])


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    return exported(hybrid(Ball, "b"), tmp_path_factory.mktemp("ball"), "ball", stop_time=2.0)


def test_a_ball_bounces_as_in_closed_form(ball):
    found = run(ball, 2.0, ["b.h", "b.v", "b.n"], record_events=False)
    expected = np.array([bounces(1.0, 0.8, 9.81, t) for t in found["time"]])
    for k, name in enumerate(["b.h", "b.v", "b.n"]):
        np.testing.assert_allclose(found[name], expected[:, k], atol=1e-7)
    found = run(ball, 2.0, ["b.h", "b.n"], fmi_type="CoSimulation")
    np.testing.assert_allclose(found["b.h"], expected[:, 0], atol=1e-12)
    np.testing.assert_array_equal(found["b.n"], expected[:, 2])
    found = run(ball, 1.0, ["b.h"], start_values={"b.h0": 2.0, "b.e": 0.5})
    np.testing.assert_allclose(found["b.h"][-1], bounces(2.0, 0.5, 9.81, 1.0)[0], atol=1e-7)


def test_what_an_fmu_holds(ball, tmp_path):
    with zipfile.ZipFile(ball) as file:
        names = set(file.namelist())
        assert {"modelDescription.xml", "sources/model.c", "sources/buildDescription.xml"} <= names
        file.extractall(tmp_path)
    assert f"binaries/{this_platform()}/ball.so" in names or this_platform().endswith(("windows", "darwin"))
    assert ball.stat().st_size < 100_000
    sources = tmp_path / "sources"
    command = [*(compiler_for(this_platform()) or ()), *FLAGS, "-Wall", "-Wextra", "-Werror", "-O0"]
    done = subprocess.run([*command, "fmi3.c", "-o", "x.so", "-lm"], cwd=sources, capture_output=True, text=True)
    assert not done.returncode, done.stderr
    symbols = subprocess.run(["nm", "-D", "--defined-only", "x.so"], cwd=sources, capture_output=True, text=True)
    assert symbols.stdout and all(line.split()[-1].startswith("fmi3") for line in symbols.stdout.splitlines())
    needed = subprocess.run(["nm", "-D", "--undefined-only", "x.so"], cwd=sources, capture_output=True, text=True)
    names = {line.split()[-1].split("@")[0] for line in needed.stdout.splitlines()}
    # What the start-up files of Linux bring, memory of instances, `string.h` and `math.h`.
    own = "calloc malloc free memcpy memset memcmp strcmp strlen strncat sqrt fmod pow exp"
    assert {n for n in names if not n.startswith("_")} <= set(own.split())


def test_states_are_saved_in_the_middle_of_a_bounce(ball):
    def on(fmu):
        """One step of a run by hand: through the fall of a guard, and on."""
        model = fmu.model
        model.enterContinuousTimeMode()
        model.setTime(0.5)
        model.setContinuousStates(np.array([-1e-9, -4.4]).ctypes.data_as(model_pointer()), 2)
        entered = model.completedIntegratorStep()[0]
        model.enterEventMode()
        fmu.update()
        return entered, fmu.get("b.h", "b.v", "b.n", "events.guard[1]", "events.indicator[1]")

    with opened(ball) as fmu, opened(ball) as other:
        state = fmu.model.getFMUState()
        entered, first = on(fmu)
        assert entered and first[1] == pytest.approx(0.8 * 4.4, rel=1e-6) and first[2] == 1.0
        fmu.model.setFMUState(state)
        assert fmu.get("b.n")[0] == 0.0
        np.testing.assert_array_equal(on(fmu)[1], first)  # bit for bit
        fmu.model.setFMUState(state)
        saved = fmu.model.serializeFMUState(fmu.model.getFMUState())
        np.testing.assert_array_equal(on(other)[1], first)
        other.model.setFMUState(other.model.deserializeFMUState(saved))
        assert other.get("b.n")[0] == 0.0
        np.testing.assert_array_equal(on(other)[1], first)


def model_pointer():
    import ctypes

    return ctypes.POINTER(ctypes.c_double)


def test_other_letters_have_names_of_their_own():
    assert [structured(f"m{letter}.x") for letter in "üö"] == ["'m_u00fc.x'", "'m_u00f6.x'"]


def test_bad_values_are_refused_by_name(ball, heated):
    import fmpy

    def status(call):
        with pytest.raises(fmpy.fmi1.FMICallException if hasattr(fmpy, "fmi1") else Exception):
            call()

    with opened(ball) as fmu:
        for values in ({"b.g": math.nan}, {"b.h0": 1.0}, {"b.n": 1.0}, {"der(b.h)": 0.0}):
            status(lambda values=values: fmu.set(values))
        status(lambda: fmu.forward(["events.indicator[1]"], ["b.h"], [1.0]))
        status(lambda: fmu.forward(["der(b.h)"], ["b.n"], [1.0]))
        status(lambda: fmu.model.getFloat64([9999]))
    with opened(heated) as fmu:
        status(lambda: fmu.set({"house.C": 1000.0}))


def test_what_cannot_be_exported_is_refused_by_name(tmp_path, ball):
    system = hybrid(Ball, "b")
    with pytest.raises(ModelError, match="ends in .fmu"):
        export_fmu(system, tmp_path / "ball.zip")
    with pytest.raises(ModelError, match="exists: give another name, or overwrite=True"):
        export_fmu(system, ball)
    with pytest.raises(ModelError, match="'b.w' is not a variable"):
        export_fmu(system, tmp_path / "x.fmu", outputs=["b.w"])
    with pytest.raises(ModelError, match="'b.w' is neither a parameter nor a network"):
        export_fmu(system, tmp_path / "x.fmu", parameters=["b.w"])
    with pytest.raises(ModelError, match="'b.n' is a discrete variable"):
        export_fmu(system, tmp_path / "x.fmu", parameters=["b.n"])
    with pytest.raises(ModelError, match="platforms: 'amiga' is not known"):
        export_fmu(system, tmp_path / "x.fmu", platforms="amiga")
    with pytest.raises(ModelError, match="fmi is the version of FMI, 3 or 2; got 1"):
        export_fmu(system, tmp_path / "x.fmu", fmi=1)
    with pytest.raises(ModelError, match="arrays: FMI 2 has none"):
        export_fmu(system, tmp_path / "x.fmu", fmi=2, arrays=True)
    with pytest.raises(ModelError, match="kinds: 'simulink' is not known"):
        export_fmu(system, tmp_path / "x.fmu", kinds=["simulink"])
    with pytest.raises(ModelError, match=r"kinds is a list of names; write kinds=\['co_simulation'\]"):
        export_fmu(system, tmp_path / "x.fmu", kinds="co_simulation")
    for tolerance in (0.0, math.nan, 1.0):
        with pytest.raises(ModelError, match="tolerance is a number between 0 and 1"):
            export_fmu(system, tmp_path / "x.fmu", tolerance=tolerance)
    for stop in (0.0, -1.0, math.inf, math.nan):
        with pytest.raises(ModelError, match="stop_time is a positive number of seconds"):
            export_fmu(system, tmp_path / "x.fmu", stop_time=stop)

    def gamma(u):
        return jax.scipy.special.gammainc(2.0, u)

    with pytest.raises(ModelError, match=r"no C code for the JAX primitive 'igamma' .*test_fmu.py:\d+, in .*gamma"):
        export_fmu(compiled(Learned(EqnEnv(), "c", gamma)), tmp_path / "x.fmu")

    def host(u):
        return jax.pure_callback(np.sin, jax.ShapeDtypeStruct((), float), u)

    with pytest.raises(ModelError, match="calls the host .* which C code cannot"):
        export_fmu(compiled(Learned(EqnEnv(), "c", host)), tmp_path / "x.fmu")


# --- derivatives ----------------------------------------------------------------------------------------------------


def test_derivatives_through_an_implicit_equation(heated):
    """q + 0.1·q³ = air − wall: dq/dair = 1/(1 + 0.3·q²)."""
    with opened(heated) as fmu:
        q, slope = fmu.get("house.q", "der(house.air)")
        assert q + 0.1 * q**3 == pytest.approx(5.0, rel=1e-12) and slope == pytest.approx((1.0 - q) / 2.0)
        dq = 1 / (1 + 0.3 * q**2)
        unknowns, knowns = ["house.q", "der(house.air)", "der(house.wall)"], ["house.air", "house.heat", "house.C"]
        jacobian = np.array([[dq, 0, 0], [-dq / 2, 0.5, -(1 - q) / 4], [dq / 10, 0, 0]])
        for k in range(3):
            np.testing.assert_allclose(fmu.forward(unknowns, knowns, np.eye(3)[k]), jacobian[:, k], atol=1e-13)
            np.testing.assert_allclose(fmu.reverse(unknowns, knowns, np.eye(3)[k], 3), jacobian[k], atol=1e-13)
        fmu.set({"house.heat": 3.0})  # an input, and a tunable parameter in event mode
        fmu.set({"house.C": 4.0})
        assert fmu.get("der(house.air)")[0] == pytest.approx((3.0 - q) / 4.0)


def test_dependencies_are_those_of_the_equations(heated):
    with opened(heated) as fmu:
        found = {
            unknown.variable.name: {v.name for v in unknown.dependencies}
            for unknown in (*fmu.description.outputs, *fmu.description.derivatives)
        }
    assert found == {
        "house.q": {"house.air", "house.wall"},
        "der(house.air)": {"house.air", "house.wall", "house.heat", "house.C"},
        "der(house.wall)": {"house.air", "house.wall", "house.outside", "house.G"},
    }


@pytest.mark.slow
def test_the_same_model_gives_the_same_bytes(tmp_path):
    paths = [export_fmu(house(), tmp_path / f"{k}/house.fmu") for k in range(2) if not (tmp_path / f"{k}").mkdir()]
    assert paths[0].read_bytes() == paths[1].read_bytes()
    other = export_fmu(house().with_parameters({"house.C": 3.0}), tmp_path / "house.fmu")
    assert other.read_bytes() != paths[0].read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["auto", "dummy_derivatives"])
def test_a_pendulum_with_a_network(tmp_path, mode):
    system = swing(mode)
    path = exported(system, tmp_path, stop_time=2.0)
    check_derivatives(system, path, ["pend.lam"])
    t1 = 2.0 if mode == "auto" else 0.5
    compare(system, path, t1, ["pend.x", "pend.vy", "pend.lam"], 1e-6)
    compare(system, path, t1, ["pend.x", "pend.vy", "pend.lam"], 1e-6, fmi_type="CoSimulation")


@pytest.mark.slow
def test_other_starts_are_found_in_c(tmp_path):
    """The release angle of a pendulum, which moves x and y on the circle."""
    path = exported(swing(), tmp_path, outputs=["pend.lam"])
    with opened(path, {"pend.initial_theta": 0.3, "pend.L": 2.0}) as fmu:
        np.testing.assert_allclose(fmu.get("pend.x", "pend.y"), [2 * math.cos(0.3), 2 * math.sin(0.3)], atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind, names, t1",
    [
        (Ball, ["c.h"], 3.0), (Thermostat, ["c.T", "c.on"], 20.05), (SampledPI, ["c.x"], 2.05),
        (Stick, ["c.x", "c.v"], 3.0), (Bob, ["c.x", "c.y"], 2.0),
        (Doubling, ["c.x", "c.y", "c.d"], 3.55), (Robertson, ["c.a", "c.b", "c.c"], 40.0),
        (House, ["c.air", "c.wall", "c.q"], 30.0),
    ],
)  # fmt: skip
def test_runs_are_those_of_simulate(tmp_path, kind, names, t1):
    system = hybrid(kind, "c")
    path = exported(system, tmp_path)
    compare(system, path, t1, names, 1e-6)
    compare(system, path, t1, names, 1e-6, fmi_type="CoSimulation")
    check_derivatives(system, path, [n for n in names if n not in system.discretes and n not in system.states])


@pytest.mark.slow
@pytest.mark.parametrize(
    "make, names, t1",
    [
        (swing, ["pend.x", "pend.vy", "pend.lam"], 2.0), (lambda: hybrid(Ball, "c"), ["c.h", "c.n"], 3.0),
        (lambda: hybrid(SampledPI, "c"), ["c.x"], 2.05), (lambda: hybrid(House, "c"), ["c.air", "c.q"], 30.0),
    ],
    ids=["pendulum", "ball", "loop", "house"],
)  # fmt: skip
def test_runs_in_version_2(tmp_path, make, names, t1):
    """Constraints and a network's weights, events, a clock as time events, an implicit equation with inputs."""
    system = make()
    path = exported(system, tmp_path, fmi=2)
    compare(system, path, t1, names, 1e-6)
    compare(system, path, t1, names, 1e-6, fmi_type="CoSimulation")
    check_derivatives(system, path, [n for n in names if n not in system.discretes and n not in system.states])
    with zipfile.ZipFile(path) as file:
        file.extractall(tmp_path / "fmu")
    command = [*(compiler_for(this_platform()) or ()), *FLAGS, "-Wall", "-Wextra", "-Werror", "-O0"]
    done = subprocess.run(
        [*command, "fmi2.c", "-o", "x.so", "-lm"], cwd=tmp_path / "fmu/sources", capture_output=True, text=True
    )
    assert not done.returncode, done.stderr


@pytest.mark.slow
def test_what_version_2_does_with_states_and_the_end_of_a_run(tmp_path):
    """A state of the FMU is taken up bit for bit; an event that ends the run ends it for Co-Simulation, too."""
    with opened(exported(hybrid(Ball, "b"), tmp_path, fmi=2)) as fmu:
        state = fmu.model.getFMUstate()
        saved = fmu.model.serializeFMUstate(state)

        def on():
            fmu.model.enterContinuousTimeMode()
            fmu.model.setTime(0.5)
            fmu.model.setContinuousStates(np.array([-1e-9, -4.4]).ctypes.data_as(model_pointer()), 2)
            assert fmu.model.completedIntegratorStep()[0]
            fmu.model.enterEventMode()
            fmu.update()
            return fmu.get("b.h", "b.v", "b.n", "events.guard[1]")

        first = on()
        assert first[2] == 1.0
        fmu.model.setFMUstate(fmu.model.deSerializeFMUstate(saved))
        assert fmu.get("b.n")[0] == 0.0
        np.testing.assert_array_equal(on(), first)

    class Ending(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            x = self.variable("x", start=0.0, fixed=True)
            self.add_equations(Eq(der(x), 1.0))
            self.when(x >= 0.7, terminate("x is large"))

    path = exported(compiled(Ending(EqnEnv(), "c")), tmp_path, "ending", fmi=2)
    for kind in "ModelExchange", "CoSimulation":
        found = run(path, 2.0, ["c.x"], fmi_type=kind)
        assert found["c.x"][-1] == pytest.approx(0.7, abs=1e-6)


@pytest.mark.slow
def test_instances_in_threads_do_not_see_each_other(ball):
    """Each of 100 balls is dropped from a height of its own, and bounces 100 times at one place."""

    def bounced(fmu, k):
        speeds = []
        for j in range(100):
            fmu.model.enterContinuousTimeMode()
            fmu.model.setTime(0.01 * (j + 1))
            fmu.model.setContinuousStates(np.array([-1e-12, -1.0 - k]).ctypes.data_as(model_pointer()), 2)
            fmu.model.completedIntegratorStep()
            fmu.model.enterEventMode()
            fmu.update()
            speeds.append(fmu.get("b.v")[0])
        return np.array(speeds)

    found: dict[int, np.ndarray] = {}
    with contextlib.ExitStack() as stack:
        instances = [stack.enter_context(opened(ball, {"b.h0": 1.0 + k / 100, "b.e": 0.5})) for k in range(100)]
        threads = [threading.Thread(target=lambda k=k: found.update({k: bounced(instances[k], k)})) for k in range(100)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert [fmu.get("b.n")[0] for fmu in instances] == [100.0] * 100
    for k in range(100):
        np.testing.assert_allclose(found[k], 0.5 * (1.0 + k), rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("kind, least", [(Ball, 1000), (Thermostat, 50), (SampledPI, 200), (Stick, 3), (House, 0)])
def test_sanitizers_find_nothing(tmp_path, kind, least):
    """20,000 steps of Euler's method with events, derivatives and states that are saved, under the address and the
    undefined-behaviour sanitizer, leaks included."""
    with zipfile.ZipFile(exported(hybrid(kind, "c"), tmp_path)) as file:
        file.extractall(tmp_path)
    driver = Path(__file__).parent.parent / "fmu_driver.c"
    command = [*(compiler_for(this_platform()) or ()), "-std=c99", "-O1", "-ffp-contract=off", "-Isources"]
    sanitize = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    built = subprocess.run(
        [*command, *sanitize, str(driver), "-o", "drive", "-lm"], cwd=tmp_path, capture_output=True, text=True
    )
    if "cannot find -lasan" in built.stderr:
        pytest.skip("the compiler has no sanitizers")
    assert not built.returncode, built.stderr
    done = subprocess.run(["./drive", "20000", "1e-3"], cwd=tmp_path, capture_output=True, text=True)
    assert not done.returncode, done.stdout + done.stderr
    assert int(done.stdout.split()[-1]) >= least


@pytest.mark.slow
def test_importers_are_told_to_begin_anew_where_a_mode_changes(tmp_path):
    """A thermostat switches off: its temperature goes on, with another slope."""
    with opened(exported(hybrid(Thermostat, "c"), tmp_path)) as fmu:
        assert fmu.get("c.on")[0] == 1.0
        fmu.model.enterContinuousTimeMode()
        fmu.model.setContinuousStates(np.array([52.0]).ctypes.data_as(model_pointer()), 1)
        fmu.model.completedIntegratorStep()
        fmu.model.enterEventMode()
        told = fmu.model.updateDiscreteStates()[3]
        assert told and fmu.get("c.T")[0] == 52.0 and fmu.get("c.on")[0] == 0.0


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("valgrind") is None, reason="Valgrind is not installed")
def test_valgrind_finds_nothing_in_many_events(ball, tmp_path):
    """A ball that bounces 10,000 times at one place: no byte that is read or left behind wrongly, and as much memory as
    100 times."""
    with zipfile.ZipFile(ball) as file:
        file.extractall(tmp_path)
    driver = Path(__file__).parent.parent / "fmu_bounces.c"
    command = [*(compiler_for(this_platform()) or ()), "-std=c99", "-O1", "-g", "-ffp-contract=off", "-Isources"]
    subprocess.run([*command, str(driver), "-o", "bounce", "-lm"], cwd=tmp_path, check=True)
    taken = []
    for n in ("100", "10000"):
        check = ["valgrind", "--leak-check=full", "--show-leak-kinds=all", "--error-exitcode=9", "./bounce", n]
        done = subprocess.run(check, cwd=tmp_path, capture_output=True, text=True)
        assert not done.returncode and done.stdout.split()[-1] == n, done.stdout + done.stderr
        assert "no leaks are possible" in done.stderr
        taken.append(done.stderr.split("total heap usage: ")[1].split(" allocs")[0])
    assert taken[0] == taken[1]


@pytest.mark.slow
def test_arrays_of_components_are_arrays(tmp_path):
    """Runs and derivatives are those of scalars; what an entry depends on, the array does."""
    system = ladder(4, in_array=True)
    scalars, path = exported(system, tmp_path, "scalars"), exported(system, tmp_path, "arrays", arrays=True)
    names = [f"cell[{k}].c.v" for k in range(4)]
    for kind in "ModelExchange", "CoSimulation":
        expected, found = run(scalars, 1.0, names, fmi_type=kind), run(path, 1.0, ["cell.c.v"], fmi_type=kind)
        assert found["cell.c.v"].shape[1:] == (4,)
        for k, name in enumerate(names):
            np.testing.assert_allclose(found["cell.c.v"][:, k], expected[name], rtol=1e-12, atol=1e-12)
    rng = np.random.default_rng(0)
    with opened(scalars) as one, opened(path) as other:
        slopes, along = [f"der({name})" for name in names], rng.normal(size=8)
        knowns = [*names, *(f"cell[{k}].c.C" for k in range(4))]
        forward = other.model.getDirectionalDerivative(
            other.references(["der(cell.c.v)"]), other.references(["cell.c.v", "cell.c.C"]), list(along), 4
        )
        np.testing.assert_allclose(forward, one.forward(slopes, knowns, along), rtol=1e-12, atol=1e-12)
        reverse = other.reverse(["der(cell.c.v)"], ["cell.c.v", "cell.c.C"], along[:4], 8)
        np.testing.assert_allclose(reverse, one.reverse(slopes, knowns, along[:4], 8), rtol=1e-12, atol=1e-12)
        derivatives = {u.variable.name: {v.name for v in u.dependencies} for u in other.description.derivatives}
        assert {"cell.c.v", "cell.r.R", "cell.c.C"} <= derivatives["der(cell.c.v)"]


@pytest.mark.slow
def test_a_large_array_stays_loops(tmp_path):
    """The C code of 2,000 cells is hardly longer than that of 1,000, and every cell depends on its neighbours alone."""
    sizes = []
    for n in (1000, 2000):
        # FMPy takes a minute to check so many names; those of small models are of the same kinds.
        path = export_fmu(ladder(n, in_array=True), tmp_path / f"cells{n}.fmu", outputs=["cell[0].r.i"])
        with zipfile.ZipFile(path) as file:
            sizes.append(file.read("sources/model.c").decode().count(";"))
    assert sizes[1] < 1.01 * sizes[0]
    assert path.stat().st_size < 500_000
    rng = np.random.default_rng(0)
    with opened(path) as fmu:
        derivatives = {u.variable.name: {v.name for v in u.dependencies} for u in fmu.description.derivatives}
        for k in (1, 777, 1998):
            own = {f"cell[{j}].c.v" for j in (k - 1, k, k + 1)}
            own |= {f"cell[{k}].r.R", f"cell[{k + 1}].r.R", f"cell[{k}].c.C"}
            assert derivatives[f"der(cell[{k}].c.v)"] == own
        x = rng.normal(size=2000)
        fmu.model.enterContinuousTimeMode()
        fmu.model.setContinuousStates(x.ctypes.data_as(model_pointer()), 2000)
        slopes = fmu.get(*(f"der(cell[{k}].c.v)" for k in range(2000)))
    before, after = np.concatenate([[1.0], x[:-1]]), np.append(x[1:], x[-1])
    np.testing.assert_allclose(slopes, before - x + after - x, atol=1e-12)
