"""Cells and packs of batteries against closed forms and SciPy's solution of equations derived by hand."""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.interpolate
from component_references import checks, measured
from problems import compiled
from reference_systems import ReferenceSystem, check_solution, system_of
from trajectories import balanced, trajectory

import jaxonomy_dae.library.electrical as el
import jaxonomy_dae.library.thermal as th
from jaxonomy_dae import EqnEnv, simulate
from jaxonomy_dae.library.battery import Cell, HeatedCell, HeatedPack, Pack

SOC = np.array([0.0, 0.1, 0.25, 0.5, 0.8, 1.0])
OCV = np.array([3.0, 3.45, 3.58, 3.7, 3.97, 4.19])
TIGHT = dict(rtol=1e-9, atol=1e-11)
GAS = 8.31446261815324


def curve(values=OCV):
    """The cubic table: Hermite's splines with the slopes of the chords behind."""
    slopes = np.diff(values) / np.diff(SOC)
    return scipy.interpolate.CubicHermiteSpline(SOC, values, np.append(slopes[:1], slopes))


CURRENTS = {"full": -3.0, "empty": 2.5, "bare": 0.5}
TS = np.linspace(0.0, 1500.0, 11)
PAIRS = dict(R=[0.015, 0.02], C=[2e3, 3e4])


@functools.cache
def cells():
    """Two cells with two RC pairs, one of which is charged with losses, and one without; and their inputs."""
    ev = EqnEnv()
    parts = {
        "full": Cell(ev, "full", SOC, OCV, 2.0, 0.03, **PAIRS, initial_soc=0.95),
        "empty": Cell(ev, "empty", SOC, OCV, 2.0, 0.03, **PAIRS, eta=0.98, initial_soc=0.1,
                      initial_voltage=[0.01, 0.02], kind="cubic"),
        "bare": Cell(ev, "bare", SOC, OCV, 1.5, 0.05, initial_soc=0.5),
    }  # fmt: skip
    ground = el.Ground(ev, "ground")
    loads = {name: el.SignalCurrent(ev, f"load_{name}") for name in parts}
    joined = [(parts[name].p, load.p) for name, load in loads.items()]
    joined += [(parts[name].n, load.n, ground.p) for name, load in loads.items()]
    system = compiled(ground, *parts.values(), *loads.values(), connect=joined)
    return system, {f"load_{n}.u": -i for n, i in CURRENTS.items()}


@checks(
    {Cell: ("line of the charge, exponentials of the pairs", "full.v", "empty.v", "bare.v", "full.soc", "empty.soc")},
    origin="rtol 1e-9 for each of fewer than 200 steps",
)
def test_cells_at_constant_current():
    """soc is linear in time, and an RC pair answers R·i·(1 − exp(−t/(R·C))); one cell is charged with losses."""
    system, inputs = cells()
    names = [f"{name}.{v}" for name in CURRENTS for v in ("soc", "v")]
    solution = trajectory(system, TS, names, inputs)
    for name, i in CURRENTS.items():
        hours, eta, soc0 = {"full": (2.0, 1.0, 0.95), "empty": (2.0, 0.98, 0.1), "bare": (1.5, 1.0, 0.5)}[name]
        soc = soc0 + (eta if i > 0 else 1.0) * i * TS / (3600 * hours)
        ocv = curve()(soc) if name == "empty" else np.interp(soc, SOC, OCV)
        v = ocv + (0.05 if name == "bare" else 0.03) * i
        for r, c, v0 in [] if name == "bare" else zip(*PAIRS.values(), (0.01, 0.02), strict=True):
            start = v0 if name == "empty" else 0.0
            v = v + r * i + (start - r * i) * np.exp(-TS / (r * c))
        # rtol 1e-9 for each of fewer than 200 steps.
        measured(f"{name}.soc", solution[f"{name}.soc"], soc, 2e-7)
        measured(f"{name}.v", solution[f"{name}.v"], v, 2e-7 * 4.2)


@pytest.mark.slow
def test_energy_of_cells():
    system, inputs = cells()
    # The tables have kinks at 0.8 and 0.5 of one cell's charge, and at 0.25 of another's.
    solution = balanced(system, TS[-1], inputs, edges=[360.0, 1080.0, 3600.0 * 2.0 * 0.15 / (0.98 * 2.5)])
    lost = (
        0.03 * 2.5**2
        + 0.02 * 2.5 * solution["empty.ocv"]
        + sum(solution[f"empty.v{k}"] ** 2 / r for k, r in ((1, 0.015), (2, 0.02)))
    )
    np.testing.assert_allclose(solution.dissipation("empty"), lost, rtol=1e-12)


# --- a cell with heat ----------------------------------------------------------------------------------------------

HEATED = {"cell.Q": 2.2, "cell.R0": 0.04, "cell.R1": 0.02, "cell.C1": 1.5e3, "cell.Ea": 2.5e4, "cell.dUdT": 3e-4,
          "cell.gas_constant": GAS, "cell.T_ref": 298.15, "cell.initial_soc": 0.9, "cell.initial_voltage1": -0.01,
          "cell.eta": 0.97, "body.C": 45.0,
          "body.initial_temperature": 285.0, "skin.h": 5.0, "skin.A": 0.004, "air.T": 280.0, "load.R": 0.9,
          **{f"cell.ocv{k}": float(v) for k, v in enumerate(OCV, 1)}}  # fmt: skip
END = 1500.0


@functools.cache
def heated():
    """A cold cell warms itself in front of a resistor, and air cools it."""
    ev = EqnEnv()
    cell = HeatedCell(
        ev, "cell", SOC, OCV, 2.2, 0.04, [0.02], [1.5e3], 0.97, 0.9, [-0.01], "cubic", Ea=2.5e4, dUdT=3e-4
    )
    body, skin = th.HeatCapacitor(ev, "body", 45.0, 285.0), th.Convection(ev, "skin", 5.0, 0.004)
    air, load, ground = th.FixedTemperature(ev, "air", 280.0), el.Resistor(ev, "load", 0.9), el.Ground(ev, "ground")
    return compiled(
        cell, body, skin, air, load, ground,
        connect=[
            (cell.p, load.p), (cell.n, load.n, ground.p), (cell.heat, body.heat, skin.port_a), (skin.port_b, air.heat),
        ],
    )  # fmt: skip


def heated_reference(values, ts):
    """(soc, pair's voltage, temperature) and the current, by DOP853 at rtol 1e-12."""
    p = dict(zip(HEATED, values, strict=True))
    table = curve(np.array([p[f"cell.ocv{k}"] for k in range(1, 7)]))

    def current(soc, v1, T):
        r = p["cell.R0"] * np.exp(p["cell.Ea"] / p["cell.gas_constant"] * (1 / T - 1 / p["cell.T_ref"]))
        ocv = table(soc) + p["cell.dUdT"] * (T - p["cell.T_ref"])
        return -(ocv + v1) / (p["load.R"] + r), r

    def slopes(t, state):
        soc, v1, T = state
        i, r = current(*state)  # it discharges: eta does not matter
        heat = r * i**2 + v1**2 / p["cell.R1"] + p["cell.dUdT"] * T * i
        cooling = p["skin.h"] * p["skin.A"] * (T - p["air.T"])
        return [i / (3600 * p["cell.Q"]), (i - v1 / p["cell.R1"]) / p["cell.C1"], (heat - cooling) / p["body.C"]]

    start = [p["cell.initial_soc"], p["cell.initial_voltage1"], p["body.initial_temperature"]]
    y = scipy.integrate.solve_ivp(slopes, (0.0, ts[-1]), start, "DOP853", ts, rtol=1e-12, atol=1e-13).y
    return y, current(*y)[0]


@checks(
    {HeatedCell: ("SciPy's DOP853 of the cell's equations", "cell.soc", "cell.v1", "body.T", "cell.i")},
    origin="rtol 1e-9 for each of fewer than 200 steps",
)
def test_a_cell_that_heats_itself():
    ts = np.linspace(0.0, END, 13)
    (soc, v1, T), i = heated_reference(HEATED.values(), ts)
    assert T.max() - T.min() > 10.0  # the resistance changes
    expected = {"cell.soc": soc, "cell.v1": v1, "body.T": T, "cell.i": i}
    found = trajectory(heated(), ts, list(expected))
    for name, true in expected.items():
        measured(name, found[name], true, 2e-7 * np.abs(true).max())


@pytest.mark.slow
def test_energy_of_a_cell_that_heats_itself():
    ts = np.linspace(0.0, END, 13)
    solution = simulate(heated(), END, ts=ts, **TIGHT)
    (soc, v1, T), i = heated_reference(HEATED.values(), ts)
    for name, true in {"cell.soc": soc, "cell.v1": v1, "body.T": T, "cell.i": i}.items():
        np.testing.assert_allclose(solution[name], true, rtol=0, atol=2e-7 * np.abs(true).max(), err_msg=name)
    balanced(heated(), END)
    lost = 0.9 * np.asarray(solution["load.i"]) ** 2
    np.testing.assert_allclose(solution.dissipation(), lost, rtol=1e-12)  # the cell's heat leaves at its port


@pytest.mark.slow
def test_gradients_of_a_cell_that_heats_itself():
    """By every parameter, against differences of the reference."""
    system, values = heated(), jnp.array(list(HEATED.values()))
    assert set(HEATED) == set(system.parameters.names)

    def end(v):
        changed = system.with_parameters(dict(zip(HEATED, v, strict=True)))
        solution = simulate(changed, END, ts=jnp.array([END]), solver=diffrax.Tsit5(), **TIGHT)
        return jnp.stack([solution["body.T"][0], solution["cell.v"][0]])

    # Diffrax's Tsit5, whose gradient compiles in half the time of the default's.
    scaled = np.asarray(jax.jit(jax.jacrev(end))(values)) * np.asarray(values)  # sizes of parameters differ
    scale = np.abs(scaled).max(axis=1, keepdims=True)

    def reference(v):
        (_, _, T), i = heated_reference(v, np.array([0.0, END]))
        return np.array([T[-1], -i[-1] * v[list(HEATED).index("load.R")]])

    at = np.array(list(HEATED.values()))
    differences = []
    for k, value in enumerate(at):
        step = 1e-4 * max(abs(value), 1e-3)
        move = np.eye(len(at))[k] * step
        differences.append((reference(at + move) - reference(at - move)) / (2 * step) * value)
    # The square of the relative step, 1e-8, times third derivatives of at most a few hundred (Ea/(R_gas·T) = 10 cubed).
    np.testing.assert_allclose(scaled / scale, np.array(differences).T / scale, rtol=0, atol=1e-5)


# --- packs ---------------------------------------------------------------------------------------------------------


def scatter(shape):
    """Values of cells that differ: capacity, series resistance, state of charge."""
    rng = np.random.default_rng(1)
    return {
        "Q": 2.5 * (1 + 0.03 * rng.standard_normal(shape)),
        "R0": 0.03 * (1 + 0.2 * rng.random(shape)),
        "initial_soc": 0.6 + 0.02 * rng.standard_normal(shape),
    }


SHARED = dict(R=[0.015, 0.02], C=[2e3, 2e4], eta=0.99)
THERMAL = dict(Ea=2e4, dUdT=1e-4, C_heat=48.0, G_neighbour=0.6, G_coolant=0.15, initial_temperature=295.0)


def drawn(t, parallel, xp):
    """The current that a load takes: more, less, and in the end some comes back."""
    return parallel * (1.5 + 3.0 * xp.sin(2 * np.pi * t / 900.0))


def pack_system(shape, kind=HeatedPack):
    ev = EqnEnv()
    thermal = THERMAL if kind is HeatedPack else {}
    pack = kind(ev, "pack", *shape, SOC, OCV, **scatter(shape), **SHARED, **thermal, kind="cubic")
    load, ground = el.SignalCurrent(ev, "load"), el.Ground(ev, "ground")
    parts, joined = [pack, load, ground], [(pack.p, load.p), (pack.n, load.n, ground.p)]
    if thermal:
        parts.append(th.FixedTemperature(ev, "coolant", 290.0))
        joined.append((pack.coolant, parts[-1].heat))
    return compiled(*parts, connect=joined)


def pack_reference(shape, ts, heated=True):
    """States of charge, temperatures, voltage of the pack, by DOP853 at rtol 1e-11.

    In a row all cells have one voltage V: their currents are (V − e)/r with e = ocv + v_1 + v_2, and sum to the pack's.
    """
    given, table, n = scatter(shape), curve(), int(np.prod(shape))
    R, C = np.array(SHARED["R"])[:, None, None], np.array(SHARED["C"])[:, None, None]

    def currents(t, soc, v, T):
        r = given["R0"] * (np.exp(2e4 / GAS * (1 / T - 1 / 298.15)) if heated else 1.0)
        ocv = table(soc) + (1e-4 * (T - 298.15) if heated else 0.0)
        e = ocv + v.sum(axis=0)
        voltage = (-drawn(t, shape[1], np) + (e / r).sum(axis=1)) / (1 / r).sum(axis=1)
        return (voltage[:, None] - e) / r, r, ocv, voltage.sum()

    def unpacked(y):
        soc, v1, v2, T = y.reshape(4, *shape)
        return soc, np.stack([v1, v2]), T

    def slopes(t, y):
        soc, v, T = unpacked(y)
        i, r, ocv, _ = currents(t, soc, v, T)
        reacting = np.where(i > 0, 0.99 * i, i)
        heat = r * i**2 + (v**2 / R).sum(axis=0) + ocv * (i - reacting) + 1e-4 * T * reacting
        flow = heat - 0.15 * (T - 290.0)
        for axis in (0, 1):
            between = 0.6 * np.diff(T, axis=axis)
            wide = [(1, 1) if a == axis else (0, 0) for a in (0, 1)]
            flow = flow + np.diff(np.pad(between, wide), axis=axis)
        dT = flow / 48.0 if heated else np.zeros(shape)
        return np.concatenate([x.ravel() for x in (reacting / (3600 * given["Q"]), *((i - v / R) / C), dT)])

    start = np.concatenate([given["initial_soc"].ravel(), np.zeros(2 * n), np.full(n, 295.0)])
    y = scipy.integrate.solve_ivp(slopes, (0.0, ts[-1]), start, "DOP853", ts, rtol=1e-11, atol=1e-12).y
    states = [unpacked(column) for column in y.T]
    voltage = np.array([currents(t, *state)[3] for t, state in zip(ts, states, strict=True)])
    return np.array([s[0] for s in states]), np.array([s[2] for s in states]), voltage


TS_PACK = np.linspace(0.0, 900.0, 7)


def load_of(shape):
    return {"load.u": lambda t: drawn(t, shape[1], jnp)}


def assert_pack(system, shape, solution):
    ts, rtol = TS_PACK, 1e-9
    is_heated = "pack.body[0,0].T" in system.variables
    soc, T, voltage = pack_reference(shape, ts, is_heated)
    # The tolerance for each of fewer than 200 steps; where currents change their sign, eta makes a kink.
    measured("pack.cell.soc", solution["pack.cell.soc"], soc, 200 * rtol)
    if is_heated:
        measured("pack.body.T", solution["pack.body.T"], T, 200 * rtol * 300)
    measured("pack.p.v", solution["pack.p.v"], voltage, 200 * rtol * np.abs(voltage).min())


@functools.cache
def small():
    return pack_system((2, 2))


ROWS = "SciPy's DOP853 of all cells, with the currents of a row in closed form"


@pytest.mark.slow
@checks(
    {HeatedPack: (ROWS, "pack.cell.soc", "pack.body.T", "pack.p.v")},
    origin="rtol 1e-9 for each of fewer than 200 steps",
)
def test_a_heated_pack():
    solution = simulate(small(), 900.0, ts=TS_PACK, inputs=load_of((2, 2)), **TIGHT)
    assert_pack(small(), (2, 2), solution)
    balanced(small(), 900.0, load_of((2, 2)))


@pytest.mark.slow
@checks({Pack: (ROWS, "pack.cell.soc", "pack.p.v")}, origin="rtol 1e-9 for each of fewer than 200 steps")
def test_a_pack_without_heat():
    shape = (3, 2)
    system = pack_system(shape, Pack)
    cells = [f"pack.cell[{i},{j}].soc" for i in range(3) for j in range(2)]
    found = trajectory(system, TS_PACK, [*cells, "pack.p.v"], load_of(shape))
    soc = np.stack([found[name] for name in cells], axis=1).reshape(-1, *shape)
    assert_pack(system, shape, {"pack.cell.soc": soc, "pack.p.v": found["pack.p.v"]})


def compare_modes(system, parallel, rtol, end):
    """The gradient of the pack's voltage by every parameter: reverse against forward mode."""
    names = [n for k, n in enumerate(system.parameters.names) if k not in system.parameters.table.expressions]
    values = np.array([float(system.parameters[n]) for n in names])

    def voltage(v, adjoint=None):
        changed = system.with_parameters(dict(zip(names, v, strict=True)))
        inputs = {"load.u": lambda t: drawn(t, parallel, jnp)}
        solution = simulate(
            changed, end, ts=jnp.array([end]), inputs=inputs, adjoint=adjoint, rtol=rtol, atol=1e-2 * rtol,
            solver=diffrax.Tsit5(),
        )  # fmt: skip
        return solution["pack.p.v"][0]

    @jax.jit
    def along(values, directions):
        one = lambda d: jax.jvp(lambda v: voltage(v, diffrax.ForwardMode()), (values,), (d,))[1]  # noqa: E731
        return jax.lax.map(one, directions, batch_size=64)

    reverse = np.asarray(jax.jit(jax.grad(voltage))(values))
    each = np.where(values == 0, 1.0, values)  # in units of a parameter's value
    forward = along(values, np.diag(each))
    np.testing.assert_allclose(reverse * each, forward, rtol=0, atol=1e-8 * np.abs(forward).max())
    return dict(zip(names, reverse, strict=True))


@pytest.mark.slow
def test_gradients_of_a_pack():
    found = compare_modes(small(), 2, 1e-7, 300.0)
    assert {"pack.Ea", "pack.C_heat", "pack.cell[1,0].Q", "pack.ocv3"} <= set(found)


def pack_of_384():
    """A battery pack, 96 rows of 4 cells, with their temperatures and a coolant, under a load that changes its sign."""
    shape, ts = (96, 4), np.linspace(0.0, 900.0, 7)

    def expected(p):
        soc, T, voltage = pack_reference(shape, ts)
        return {"pack.cell.soc": soc, "pack.body.T": T, "pack.p.v": voltage}

    # The tolerance for each of fewer than 200 steps; where currents change their sign, eta makes a kink.
    return ReferenceSystem(
        lambda: pack_system(shape), expected, ts, "pack.p.v", {"load.u": lambda t: drawn(t, 4, jnp)},
        tolerance=200 * 1e-8, balance=1e-6, rtol=1e-8,
    )  # fmt: skip


@pytest.mark.slow
def test_a_pack_of_384_cells():
    _, system = system_of(pack_of_384)
    assert len(system.states) == 4 * 384
    check_solution(pack_of_384, energy=False)
