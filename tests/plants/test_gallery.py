"""The notebooks of examples/gallery run, and arrive at results that follow from physics."""

import contextlib
import json
import os
import pathlib

import jax
import numpy as np
import pytest
from kalman import held, negative_log_likelihood
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicHermiteSpline
from scipy.linalg import expm
from scipy.optimize import brentq, least_squares, minimize

GALLERY = pathlib.Path(__file__).parents[2] / "examples" / "gallery"
pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def as_in_a_notebook():
    """Figures are drawn nowhere, and types are promoted as they are by default: Optax needs it."""
    plt = pytest.importorskip("matplotlib.pyplot")
    backend, settings = plt.get_backend(), dict(plt.rcParams)
    plt.switch_backend("Agg")
    with jax.numpy_dtype_promotion("standard"):
        yield
    plt.close("all")
    plt.rcParams.update(settings)
    plt.switch_backend(backend)


def names_after(notebook):
    """Runs the cells of a notebook one after the other, in its folder; returns what they define."""
    cells = json.loads((GALLERY / f"{notebook}.ipynb").read_text())["cells"]
    names = {"__name__": notebook}
    with contextlib.chdir(GALLERY):
        for k, cell in enumerate(cells):
            if cell["cell_type"] == "code":
                exec(compile("".join(cell["source"]), f"{notebook}, cell {k}", "exec"), names)
    return names


def measured(name):
    """Skips the test where a record is missing."""
    folder = os.environ.get("JAXONOMY_DAE_DATA", "")
    if not (folder and (pathlib.Path(folder) / name).is_file()):
        pytest.skip(f"JAXONOMY_DAE_DATA names no folder with {name}; the notebook downloads it")


def test_every_notebook_is_stored_with_its_outputs():
    for path in GALLERY.glob("*.ipynb"):
        cells = [cell for cell in json.loads(path.read_text())["cells"] if cell["cell_type"] == "code"]
        assert all(cell["execution_count"] for cell in cells)
        outputs = [output for cell in cells for output in cell["outputs"]]
        assert any({"image/svg+xml", "image/png"} & {*output.get("data", {})} for output in outputs)
        assert not any(output["output_type"] == "error" or output.get("name") == "stderr" for output in outputs)
        assert path.stat().st_size < 700_000


def pack_voltage(names, resistances):
    """The voltage of the pack at the end of the discharge: charges, RC voltages and temperatures of all cells by SciPy;
    in a row, cells have one voltage, and their currents sum up."""
    soc, ocv, Q = names["SOC"], names["OCV"], 3600 * names["capacities"]
    chords = np.diff(ocv) / np.diff(soc)
    table = CubicHermiteSpline(soc, ocv, [chords[0], *chords])  # the slope at the end of a piece is that of its chord
    knots, loads = (np.asarray(part) for part in names["profile"])

    def circuit(t, y):
        z, v1, T = y.reshape(3, 2, 3)
        r = resistances * np.exp(2e4 / 8.31446261815324 * (1 / T - 1 / 298.15))
        v = ((table(z) + v1) / r).sum(axis=1) - np.interp(t, knots, loads)
        v = v / (1 / r).sum(axis=1)
        return v, (v[:, None] - table(z) - v1) / r, r

    def slopes(t, y):
        _, v1, T = y.reshape(3, 2, 3)
        _, i, r = circuit(t, y)
        heat = r * i**2 + v1**2 / 0.015 + 0.08 * (293.15 - T)
        for axis in (0, 1):  # neighbours in a row, and in the next row
            flow = 0.3 * np.diff(T, axis=axis)
            zero = np.zeros_like(np.take(T, [0], axis=axis))
            heat += np.concatenate([flow, zero], axis=axis) - np.concatenate([zero, flow], axis=axis)
        return np.stack([i / Q, (i - v1 / 0.015) / 2e3, heat / 45.0]).ravel()

    y = np.stack([np.full((2, 3), 0.95), np.zeros((2, 3)), np.full((2, 3), 298.15)]).ravel()
    for start, end in zip(knots, knots[1:], strict=False):  # the load has kinks there
        y = solve_ivp(slopes, (start, end), y, "DOP853", rtol=1e-11, atol=1e-11).y[:, -1]
    return circuit(knots[-1], y)[0].sum()


def test_battery_pack():
    names = names_after("battery_pack")
    # Charge is counted by a linear equation: only rounding and the tolerance of the run are left.
    np.testing.assert_allclose(names["by_row"], names["expected"], rtol=0, atol=1e-5)
    # Resistances move the voltage as differences of SciPy's runs say: truncated at (1e-4/0.03)^2 = 1e-5, and a run at
    # rtol 1e-6 has a gradient good to 1e-3.
    resistances = names["resistances"]
    for (row, column), found in np.ndenumerate(names["by_resistance"]):
        move = np.zeros((2, 3))
        move[row, column] = 1e-4
        slope = (pack_voltage(names, resistances + move) - pack_voltage(names, resistances - move)) / 2e-4
        np.testing.assert_allclose(found, slope, rtol=1e-3, atol=5e-4)
    # The misfit of 160 measurements with their true noise is 1, give or take sqrt(2/160) = 0.11.
    assert abs(names["misfit"] - 1) < 0.33
    # Six intervals of 95 %: four deviations either way.
    for row, true in zip(names["rows"], names["true"].ravel(), strict=True):
        assert abs(row.value - true) < 2 * (row.high - row.low)
    np.testing.assert_allclose(names["found"], names["true"], rtol=0, atol=1e-3)


def test_motor_with_a_controller():
    names = names_after("motor_control")
    assert names["error"] < 1e-6  # of the energy balance, for a run at rtol 1e-6
    assert names["history"][-1] < 0.01 * names["history"][0]
    w = np.asarray(names["after"]["load.w"])
    assert w[names["t"] < 1.0].max() < 1.03 * names["SETPOINT"]
    assert np.abs(names["after"]["source.v"]).max() < names["LIMIT"] + 0.5
    # At rest the motor carries the friction and the brake through the gear: k·i = (0.6·w + 3)/12 + d·12·w.
    current = (0.6 * w[-1] + 3.0) / 12 / 0.25 + 1e-3 * 12 * w[-1] / 0.25
    np.testing.assert_allclose(names["after"]["motor.inductor.i"][-1], current, rtol=1e-2)


def test_linkage():
    names = names_after("linkage")

    def point(ground, crank, coupler, rocker, phi):
        """Two circles meet, above the line between their centres."""
        x, y = crank * np.cos(phi), crank * np.sin(phi)
        span = np.hypot(ground - x, y)
        at = np.arctan2(-y, ground - x) + np.arccos((coupler**2 + span**2 - rocker**2) / (2 * coupler * span))
        ahead, aside = names["POINT"]
        return np.array([x + ahead * np.cos(at) - aside * np.sin(at), y + ahead * np.sin(at) + aside * np.cos(at)])

    lengths, phi = np.asarray(names["lengths"]), names["START"]
    np.testing.assert_allclose(names["there"], point(*lengths, phi), rtol=0, atol=1e-9)
    for k, move in enumerate(1e-5 * np.eye(4)):
        slope = (point(*(lengths + move), phi) - point(*(lengths - move), phi)) / 2e-5
        np.testing.assert_allclose(names["slopes"][:, k], slope, rtol=0, atol=1e-6)
    assert names["closed"] < 1e-9
    np.testing.assert_allclose(names["energy"], names["energy"][0], rtol=1e-5)


def ladder(parts, f):
    """Voltages at the load and at the first capacitor for 1 V at the source, by chain matrices; `parts` are C, L, C, L,
    C and the resistances of the coils."""
    C1, L2, C3, L4, C5, R2, R4 = parts
    s, one = 2j * np.pi * np.asarray(f), np.ones(len(f))

    def chain(series, shunt):
        return np.moveaxis(np.array([[one, series * one], [shunt * one, one]]), -1, 0)

    behind = chain(s * L2 + R2, 0) @ chain(0, s * C3) @ chain(s * L4 + R4, 0) @ chain(0, s * C5 + 1 / 600)
    load = 1 / (chain(600, 0) @ chain(0, s * C1) @ behind)[:, 0, 0]
    return load, load * behind[:, 0, 0]


def decibel(response):
    return 20 * np.log10(np.abs(response))


def test_circuit():
    names = names_after("circuit")
    assert names["exactness"] < 1e-13  # of a linear model: rounding

    # The fit. Its response is that of chain matrices; 73 degrees of freedom have 1 ± sqrt(2/73) = 0.17, and three of
    # these are 0.5. Values are as far from the truth as the noise allows: four deviations, by differences of matrices.
    f, sigma, found = np.asarray(names["measured_at"]), names["SIGMA"], names["found"]
    np.testing.assert_allclose(names["readings"](names["fitted"]), decibel(ladder(found, f)), rtol=0, atol=1e-9)
    assert abs(names["chi2"] - 1) < 0.5
    slopes = [
        (decibel(ladder(found * (1 + move), f)) - decibel(ladder(found * (1 - move), f))).ravel() / 2e-5
        for move in 1e-5 * np.eye(7)
    ]
    deviation = np.sqrt(np.diag(np.linalg.inv(np.array(slopes) @ np.array(slopes).T))) * sigma
    np.testing.assert_allclose(names["deviation"], 100 * deviation, rtol=1e-4)  # the differences' own error
    assert (np.abs(found / np.array([*names["true"].values()]) - 1) < 4 * deviation).all()

    # The design: the same least squares by SciPy, without derivatives of ours.
    band, textbook = np.asarray(names["band"]), np.array([*names["TEXTBOOK"].values()])
    wanted = decibel(0.5 / np.sqrt(1 + (band / 10e3) ** 10))

    def away(logarithms):
        parts = np.exp(logarithms)[[0, 1, 2, 1, 0]] * textbook
        difference = decibel(ladder([*parts, 60.0, 60.0], band)[0]) - wanted
        return difference - difference.mean()

    best = least_squares(away, np.zeros(3), xtol=1e-12, ftol=1e-12, gtol=1e-12)
    # Differences of 1e-8 have slopes good to 1e-6 or so, and the fit ends at changes of 1e-8.
    np.testing.assert_allclose(names["design"], best.x, rtol=0, atol=1e-5)
    np.testing.assert_allclose(names["after"], np.abs(best.fun).max(), rtol=1e-3)
    assert names["after"] < 0.1 * names["before"]

    # After 19 periods the slowest mode has decayed by exp(-150) at least: the run is periodic, up to its rtol of 1e-9.
    parts = [*(np.exp(best.x)[[0, 1, 2, 1, 0]] * textbook), 60.0, 60.0]
    third = 4 / (3 * np.pi) * np.abs(ladder(parts, [6e3])[0][0])
    np.testing.assert_allclose(names["harmonic"], third, rtol=1e-5)
    np.testing.assert_allclose(names["harmonic"], names["predicted"], rtol=1e-6)


class ReferenceHouse:
    """The house as a linear system x' = a·x + b·u of the temperatures of three layers, air and floor, by hand."""

    def __init__(self, thickness, window, C_air, C_floor, aperture):
        A = 150.0
        r1, r2, r3 = 0.11 / 0.8 / A, thickness / 0.035 / A, 0.1 / 0.5 / A
        wall = np.array([2 / r1, 2 / (r1 + r2), 2 / (r2 + r3), 1 / (r3 / 2 + 1 / (8 * A))])
        c = np.array([0.11 * 1800 * 900 * A, thickness * 30 * 1400 * A, 0.1 * 1200 * 900 * A, C_air, C_floor])
        between = [(0, 1, wall[1]), (1, 2, wall[2]), (2, 3, wall[3]), (3, 4, 7.0 * 80.0)]
        a = np.zeros((5, 5))
        for i, j, conductance in between:
            a[i, [i, j]] += [-conductance, conductance]
            a[j, [j, i]] += [-conductance, conductance]
        a[0, 0] -= wall[0]
        a[3, 3] -= window
        outside, sun, heat = np.array([[wall[0], 0, 0, window, 0]]), np.array([[0, 0, 0, 0, aperture]]), np.eye(5)[[3]]
        self.capacities = c
        self.a, self.outside, self.sun, self.heat = (m.T / c[:, None] for m in (a, outside, sun, heat))

    def unheated(self, weather, radiation, plan, dt, start):
        """Temperatures of the air after each interval `dt`, exactly: `weather` at its ends, the others held in it."""
        b = np.hstack([self.outside, np.zeros((5, 1)), self.sun, self.heat])
        step, x, air = propagator(self.a, b, dt), np.linalg.solve(self.a, -b @ start), []
        for k in range(len(plan)):
            x = (step @ [*x, weather[k], (weather[k + 1] - weather[k]) / dt, radiation[k], plan[k]])[:5]
            air.append(x[3])
        return np.array(air)

    def heated(self, weather, radiation, setpoint, dt, start, k=1500.0, Ti=3 * 3600.0):
        """Temperatures of the air at all times, and the energy in J that came from the heater and was not stored. The
        heat is k·(setpoint − air + x) with Ti·x' = setpoint − air. States: temperatures, x, energy of the heater."""
        a, b = np.zeros((7, 7)), np.zeros((7, 5))  # by weather, its slope, radiation, setpoint, its slope
        a[:5, :5] = self.a
        power, by_setpoint = np.array([0, 0, 0, -k, 0, k, 0]), k
        a[:5] += self.heat * power
        b[:5, [0, 2, 3]] = np.hstack([self.outside, self.sun, self.heat * by_setpoint])
        a[5, 3], b[5, 3] = -1 / Ti, 1 / Ti
        a[6], b[6, 3] = power, by_setpoint
        x = np.append(np.linalg.solve(a[:6, :6], -b[:6] @ [start[0], 0, start[1], setpoint[0], 0]), 0.0)
        step, air, first = propagator(a, b, dt), [x[3]], x[:5]
        for n in range(len(setpoint) - 1):
            u = [weather[n], (weather[n + 1] - weather[n]) / dt, radiation[n]]
            x = (step @ [*x, *u, setpoint[n], (setpoint[n + 1] - setpoint[n]) / dt])[:7]
            air.append(x[3])
        return np.array(air), x[6] - self.capacities @ (x[:5] - first)


def propagator(a, b, dt):
    """exp of x' = a·x + b·u over `dt`; u[1] is the slope of u[0], and u[4], where there is one, that of u[3]."""
    n, m = b.shape
    whole = np.zeros((n + m, n + m))
    whole[:n, :n], whole[:n, n:], whole[n, n + 1] = a, b, 1.0
    if m == 5:
        whole[n + 3, n + 4] = 1.0
    return expm(whole * dt)


def test_house():
    names = names_after("house")
    celsius, radiation = names["celsius"], names["radiation"]
    assert len(celsius) == 241 and celsius.min() == -12.8 and celsius.max() == 8.9  # the file's
    weather, sun = celsius + 273.15, radiation[1:]

    # The fit against exact solutions: a run at rtol 1e-6 errs by 3e-4 K a step.
    def indoors(values):
        plan = np.repeat(names["plan"][1], 3)[:168]
        return ReferenceHouse(*values).unheated(weather, sun, plan, 3600.0, [weather[0], 0.0, 0.0, 4e3])

    true = np.array([*names["TRUE"].values()])
    found = np.array([names["standing"].parameters[name] for name in names["TRUE"]])
    for values in (found, true):
        system = names["unheated"].with_parameters(dict(zip(names["TRUE"], values, strict=True)))
        np.testing.assert_allclose(names["indoors"](system), indoors(values), rtol=0, atol=3e-3)
    assert abs(names["chi2"] - 1) < 3 * np.sqrt(2 / 163)
    slopes = np.array([
        (indoors(found * (1 + move)) - indoors(found * (1 - move))) / 2e-5 / names["SIGMA"] for move in 1e-5 * np.eye(5)
    ])  # fmt: skip
    assert (np.abs(found / true - 1) < 4 * np.sqrt(np.diag(np.linalg.inv(slopes @ slopes.T)))).all()

    # Heat is conserved: what came in went out or is stored; each term is an integral by trapezoids of 15 minutes.
    balance = names["balance"]
    came, went = (sum(balance[name] for name in side) for side in (("heater", "sun"), ("wall", "windows", "stored")))
    assert abs(came - went) < 1e-3 * came
    assert np.abs(names["run"].energy_balance_error()).max() < 1e-5
    assert names["lowest"] > 0

    # Costs and the best choice, by the exact solution and a search without derivatives.
    dt, quarters = 900.0, np.arange(961) / 4
    outside, held = np.interp(quarters, np.arange(241), weather), np.repeat(sun, 4)
    rest, schedule, awake = [weather.mean(), radiation.mean()], names["schedule"], names["awake"]

    def costs(thickness, night):
        setpoint = night + (293.65 - night) * schedule
        air, energy = ReferenceHouse(thickness, *found[1:]).heated(outside, held, setpoint, dt, rest)
        cold = np.sum(np.maximum(293.15 - air, 0.0)[awake] ** 2) / 4
        return np.array([0.1 * 15 * energy / 3.6e6, 6.0 * 150 * thickness, 0.2 * 15 * cold])

    best = names["best"].x
    for d, shift in ([found[0], 0.0], best):
        np.testing.assert_allclose(names["costs"](d, 290.15 + shift), costs(d, 290.15 + shift), rtol=1e-3)
    search = minimize(
        lambda x: costs(x[0] / 10, 290.15 + x[1]).sum(), [10 * found[0], 0.0], method="Nelder-Mead",
        options={"xatol": 1e-5, "fatol": 1e-7},
    )  # fmt: skip
    # Heat and insulation balance at 900 for a metre, and second derivatives are 8e3 and 13: gradients good to 1e-3, as
    # those of runs at rtol 1e-6 are, place the optimum to 0.1 mm.
    np.testing.assert_allclose(best[0], search.x[0] / 10, rtol=0, atol=5e-4)
    np.testing.assert_allclose(best[1], search.x[1], rtol=0, atol=1e-2)


def test_through_the_bounce():
    names = names_after("bounce")
    np.testing.assert_allclose(names["hit"], names["exact_hit"], rtol=0, atol=1e-9)  # parabolas: rounding, amplified
    # The runs have rtol 1e-10, the difference a step of 1e-5.
    np.testing.assert_allclose(names["slope"], names["difference"], rtol=1e-4)
    # 184 heights with their true noise: 1, give or take sqrt(2/184) = 0.1.
    fit = names["fit"]
    assert abs(fit.chi2 / fit.freedom - 1) < 3 * np.sqrt(2 / fit.freedom)
    speeds = names["seen"]
    law = jax.vmap(names["learned"].neural["ball.law"])(speeds[:, None])[:, 0]
    np.testing.assert_allclose(law, names["truth"](speeds), rtol=0, atol=0.03)  # the noise over falls of 0.2 m
    assert np.abs(names["hit"] - names["wanted"]).max() < 0.1


def test_next_experiment():
    names = names_after("next_experiment")
    times, sigma, unknown = names["times"], names["SIGMA"], names["UNKNOWN"]

    def run(values, volts, at):
        """Speed and current by SciPy, J·w' = k·i − d·w − c·tanh(w/0.2), R = 1, the voltage held from each time on."""
        J, k, d, c = values
        w, found, ends = 0.0, [], [*at[1:], times[-1]] if at[-1] < times[-1] else at[1:]
        for start, end, u in zip(at, ends, volts, strict=False):
            inside = np.minimum(times[(times > start + 1e-9) & (times <= end + 1e-9)], end)
            field = lambda t, y, u=u: (k * (u - k * y) - d * y - c * np.tanh(y / 0.2)) / J  # noqa: E731
            points = np.unique([*inside, end])
            part = solve_ivp(field, (start, end), [w], "LSODA", points, rtol=1e-10, atol=1e-12).y[0]
            found += [(y, u - k * y) for y in part[: len(inside)]]
            w = part[-1]
        return np.array(found)

    def slopes(values, volts, at, measured):
        """By the logarithms of the values, in units of the noise; differences are truncated at 1e-8."""
        columns = [j for j, name in enumerate(("drive.w", "drive.i")) if name in measured]
        size = np.array([sigma[n] for n in ("drive.w", "drive.i")])
        moved = [run(values * np.exp(s * e), volts, at) / size for e in np.eye(4) for s in (1e-4, -1e-4)]
        return np.stack([(a - b)[:, columns].ravel() / 2e-4 for a, b in zip(moved[::2], moved[1::2], strict=True)], 1)

    # What each candidate would tell, at the values of the first fit, which SciPy's runs confirm.
    guess = np.array([names["fit"].values[n] for n in unknown])
    first = slopes(guess, [12.0], [0.0], ["drive.w"])
    known = first.T @ first + np.eye(4)

    def gain(known, j):
        return 0.5 * (np.linalg.slogdet(known + j.T @ j)[1] - np.linalg.slogdet(known)[1])

    for k, (u, measured) in enumerate(names["options"].values()):
        j = slopes(guess, u[1][:-1], list(u[0][:-1]), measured)
        np.testing.assert_allclose(names["advice"].gain[k], gain(known, j), rtol=0, atol=0.02)
    assert names["advice"].best == int(np.argmax(names["advice"].gain))

    # The second fit: as far from the truth as its intervals allow, which are those of SciPy's slopes.
    true = np.array([*names["TRUE"].values()])
    found = np.array([names["again"].values[n] for n in unknown])
    u, measured = names["u"], names["names"]
    j = np.concatenate([slopes(found, [12.0], [0.0], ["drive.w"]), slopes(found, u[1][:-1], list(u[0][:-1]), measured)])
    deviation = np.sqrt(np.diag(np.linalg.inv(j.T @ j)))
    np.testing.assert_allclose([names["kept"][n] for n in unknown], deviation, rtol=1e-2)
    assert (np.abs(np.log(found / true)) < 4 * deviation).all()

    # The design is no worse than the best of a grid, and better than its start.
    assert names["found"].gain > names["gains"].max() - 2e-3
    assert names["found"].gain > names["found"].history[0] + 0.05


def test_clogged_filter():
    names = names_after("clogged_filter")
    rho, g, ambient = 998.2, 9.80665, 101325.0

    def flow(level, V):
        """Filter and valve in a row: the drop over the valve for which both let the same through."""
        head, share = rho * g * level, 0.2 + 0.75 * np.exp(-V / 0.35)

        def through_valve(dp):
            return 3e-4 * 0.6 * np.sqrt(2 * rho) * dp / (dp**2 + 100.0**2) ** 0.25

        def apart(dp):
            m = through_valve(dp)
            return m * np.sqrt(m**2 + 1e-6) - 2 * rho * (0.6 * 4e-4 * share) ** 2 * (head - dp)

        dp = brentq(apart, 0.0, head, xtol=1e-10, rtol=1e-14)
        return through_valve(dp), ambient + dp

    ts, (switches, pumped, _) = names["ts"], names["inputs"]["pump.m_flow"]
    y, levels = np.array([1.0, 0.0]), []
    for start, end, pump in zip(switches, switches[1:], pumped, strict=False):

        def field(t, y, pump=pump):
            m = flow(*y)[0]
            return (pump - m) / (rho * 0.25), m / rho

        inside = ts[(ts > start + 1e-9) & (ts <= end + 1e-9)]
        states = solve_ivp(field, (start, end), y, "LSODA", inside, rtol=1e-10, atol=1e-12).y
        levels += states.T.tolist()
        y = states[:, -1]  # every interval ends with a reading
    levels = np.array(levels)
    np.testing.assert_allclose(names["true"]["tank.level"], levels[:, 0], rtol=0, atol=1e-6)
    pressures = [flow(*state)[1] for state in levels[::30]]
    np.testing.assert_allclose(names["true"]["filter.port_b.p"][::30], pressures, rtol=1e-6)
    # The misfit is that of noise, the opening within 0.3 %, and the law the one that made the record.
    fit = names["fit"]
    assert abs(fit.chi2 / fit.freedom - 1) < 3 * np.sqrt(2 / 300) and names["error"] < 3e-3
    found = names["found"].chosen
    assert found.terms == ("1", "exp(-V/0.35)")
    assert (np.abs(np.asarray(found.law.coefficients) - [0.2, 0.75]) < 4 * found.spread).all()


def test_battery_pulses():
    """The record is measured: what can be checked is that the model is solved as written, and what the note says."""
    measured("battery/multipulse_hppc.xlsx")
    names = names_after("battery_pulses")

    def voltage(values, one, E):
        """Exactly, for a current that is linear between its samples."""
        times, i = one.inputs["cell.i"]
        R0, R1, C1, R2, C2, C3 = (values[f"cell.{n}"] for n in ("R0", "R1", "C1", "R2", "C2", "C3"))
        v = np.zeros((2, len(times)))
        q = np.concatenate([[0.0], np.cumsum(np.diff(times) * (i[1:] + i[:-1]) / 2)])
        for row, (R, tau) in enumerate(((R1, R1 * C1), (R2, R2 * C2))):
            for k, h in enumerate(np.diff(times)):
                a, b = R * i[k], R * (i[k + 1] - i[k]) / h  # v → a + b·s − b·tau
                v[row, k + 1] = a + b * h - b * tau + (v[row, k] - a + b * tau) * np.exp(-h / tau)
        return (E - R0 * i - v.sum(axis=0) - q / C3)[1:]

    fit = names["fit"]
    for k, one in enumerate((names["small"], names["large"])):
        exact = voltage(fit.values, one, fit.starts["cell.E"][k])
        # A run at rtol 1e-6 errs by 1e-6 of 60 mV a step, and of such by no more than some 1e-6 V.
        np.testing.assert_allclose(fit.at_samples[0][k, : len(one.times), 0], exact, rtol=0, atol=2e-5)
        error = np.sqrt(np.nanmean((exact - one.data["cell.v"]) ** 2))
        np.testing.assert_allclose(fit.rms[("3 A", "6 A")[k]]["cell.v"], error, rtol=0.05)
    assert fit.rms["3 A"]["cell.v"] < 1e-4 and fit.rms["6 A"]["cell.v"] > 10 * fit.rms["3 A"]["cell.v"]
    for pulse in ("3 A", "6 A"):
        assert names["learned"].rms[pulse]["cell.v"] < 0.6 * names["linear"].rms[pulse]["cell.v"]
    assert fit.whiteness["3 A"]["cell.v"].probability < 1e-6
    slope = np.diff(names["band"].mean)
    assert (slope > 0).all()


def test_sticking_friction():
    names = names_after("sticking_friction")
    times, k = names["times"], 50.0

    def level(v):
        return 3.0 + 2.0 * np.exp(-((v / 0.1) ** 2)) + 1.5 * abs(v)

    def positions(V):
        """The block sticks until the spring pulls with 5.5 N, and slides until its speed is zero again."""
        t, s, found = 0.0, 0.0, []
        while len(found) < len(times):
            breaks = (5.5 / k + s) / V
            found += [s] * int(np.sum((times > t + 1e-12) & (times <= breaks)))
            if breaks >= times[-1]:
                break

            def stops(t, y, breaks=breaks):
                return y[1] if t > breaks + 1e-6 else 1.0

            stops.terminal, stops.direction = True, -1
            inside = times[times > breaks]
            slide = solve_ivp(
                lambda t, y: [y[1], k * (V * t - y[0]) - level(y[1])], (breaks, times[-1] + 1), [s, 0.0], "LSODA",
                inside, events=stops, rtol=1e-10, atol=1e-13,
            )  # fmt: skip
            found += slide.y[0].tolist()
            if not len(slide.t_events[0]):
                break
            t, s = slide.t_events[0][0], slide.y_events[0][0][0]
        return np.array(found[: len(times)])

    for speed, run in names["runs"].items():
        np.testing.assert_allclose(run["block.s"], positions(speed), rtol=0, atol=1e-6)
    fit = names["fit"]
    assert abs(fit.chi2 / fit.freedom - 1) < 4 * np.sqrt(2 / fit.freedom) and names["error"] < 0.01
    row = fit.table()["block.more"]
    assert abs(row.value - names["MORE"]) < 2 * (row.high - row.low)


def test_slider_crank():
    names = names_after("slider_crank")
    r, rod, J, m, g = 0.05, 0.15, 6e-3, 1.0, 9.81

    def mu(v):
        return -np.tanh(v / 0.05) * (0.10 + 0.08 * np.exp(-((v / 0.25) ** 2)) + 0.05 * abs(v))

    def turn(phi, w, press):
        """The crank's acceleration and (S, N, f); x = r·cos φ + √(l² − r²·sin² φ)."""
        s, c = np.sin(phi), np.cos(phi)
        root = np.sqrt(rod**2 - (r * s) ** 2)
        slope = -r * s - r**2 * s * c / root
        bend = -r * c - r**2 * (c**2 - s**2) / root - r**4 * (s * c) ** 2 / root**3
        along, across, friction = root / rod, -r * s / rod, mu(slope * w)
        lever = r * (c * across - s * along)
        # J·a = lever·S; m·(slope·a + bend·w²) = f − along·S; N = m·g + press + across·S; f = μ·N
        a, S = np.linalg.solve(
            [[J, -lever], [m * slope, along - friction * across]], [0.0, friction * (m * g + press) - m * bend * w**2]
        )
        N = m * g + press + across * S
        return a, (S, N, friction * N)

    for name, (end, press) in names["ENDS"].items():
        run = names["runs"][name]
        field = lambda t, y, press=press: (y[1], turn(*y, press)[0])  # noqa: E731
        y = solve_ivp(field, (0, end), [0.5, 20.0], "DOP853", np.asarray(run.ts), rtol=1e-12, atol=1e-12).y
        np.testing.assert_allclose(run["crank.phi"], y[0], rtol=0, atol=1e-7)  # 600 steps at rtol 1e-10 of 30 rad
        forces = np.array([turn(*state, press)[1] for state in y.T])
        for k, force in enumerate(("crank.S", "crank.N", "crank.f")):
            np.testing.assert_allclose(run[force], forces[:, k], rtol=0, atol=1e-5)
    fit = names["fit"]
    assert abs(fit.chi2 / fit.freedom - 1) < 3 * np.sqrt(2 / fit.freedom)
    assert abs(fit.holdout_score**2 - 1) < 4 * np.sqrt(2 / 160)
    assert names["error"] < 0.06 and all(share > 0.85 for share in names["covered"].values())
    # What the law cannot do, whatever its weights.
    speeds = np.linspace(-2.0, 2.0, 101)[:, None]
    assert (np.asarray(jax.vmap(fit.system.neural["crank.mu"])(speeds)) * speeds <= 0).all()


def test_positioning():
    """Between ticks and stops the slide's acceleration is constant: runs are parabolas, piece by piece."""
    names = names_after("positioning")
    period, end, times = names["PERIOD"], names["END"], np.asarray(names["times"])

    def by_hand(wish, target, m=1.0, level=2.0, breakaway=3.0):
        """Positions at all times."""
        s, v, mode, found = 0.0, 0.0, 0, []
        for k in range(round(end / period)):
            u, t, left = float(wish(np.array([target - s, v]))[0]), k * period, period
            inside = times[(times >= t - 1e-9) & (times < t + period - 1e-9)] - t
            if mode == 0 and abs(u) >= breakaway:
                mode = int(np.sign(u))
            done = 0.0
            while True:
                a = (u - mode * level) / m if mode else 0.0
                stops = mode != 0 and v * a < 0 and -v / a < left
                length = -v / a if stops else left
                now = inside[(inside >= done - 1e-9) & (inside < done + length - (0 if stops else 1e-9))] - done
                found += (s + v * now + a * now**2 / 2).tolist()
                s, v, done, left = s + v * length + a * length**2 / 2, v + a * length, done + length, left - length
                if not stops:
                    break
                v, mode = 0.0, int(np.sign(u)) if abs(u) >= breakaway else 0
        return np.array([*found, s])

    changed = {"slide.m": 1.2, "slide.level": 2.4, "slide.breakaway": 3.6}
    for system in (names["plain"], names["trained"]):
        wish = jax.jit(lambda given, law=system.neural["slide.wish"]: law(given))
        for d in (0.08, 0.18):
            run = np.asarray(names["follow"](system, d))
            np.testing.assert_allclose(run[:, 0], by_hand(wish, d), rtol=0, atol=1e-8)  # parabolas: rounding, amplified
            run = np.asarray(names["follow"](system.with_parameters(changed), d))
            np.testing.assert_allclose(run[:, 0], by_hand(wish, d, 1.2, 2.4, 3.6), rtol=0, atol=1e-8)
    assert names["training"].best_loss < 0.05 * names["training"].history[0]
    assert np.abs(names["off"]).max() < 3.0 < 20.0 < np.abs(names["short"]).min()
    assert all(after < 0.3 * before for before, after in names["worst"].values())


def test_overflowing_tanks():
    """The runs are those of SciPy, and the note's words hold."""
    measured("tanks/estimation.csv")
    names = names_after("overflowing_tanks")
    times, pump, rim = names["times"], names["pump"], 10.0

    def levels(fit, factor):
        v = {k.removeprefix("tanks."): value for k, value in fit.values.items()}
        y, found = np.array([fit.starts["tanks.h1"][0], fit.starts["tanks.h2"][0]]), []

        def slope(t, h, u):
            root, over = np.sqrt(np.maximum(h, 1e-4)), 0.5 * np.maximum(h - rim, 0)
            q1 = v["a1"] * root[0] + v["b1"] * h[0]
            q2 = (v["a2"] * root[1] + v["b2"] * h[1]) * factor(h[1])
            return np.array([v["p"] * u - q1 - over[0], v["r"] * (q1 + v["s"] * over[0]) - q2 - over[1]])

        for k, u in enumerate(pump[:-1]):  # Runge and Kutta's steps of 0.2 s: kinks cost their square, and h⁴
            for _ in range(20):
                h, dt = y, (times[k + 1] - times[k]) / 20
                k1 = slope(0, h, u)
                k2 = slope(0, h + dt / 2 * k1, u)
                k3 = slope(0, h + dt / 2 * k2, u)
                k4 = slope(0, h + dt * k3, u)
                y = h + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            found.append(y[1])
        return np.array(found)

    net = names["learned"].system.neural["tanks.law"].net
    (w1, b1), (w2, b2) = ((np.asarray(layer.weight), np.asarray(layer.bias)) for layer in net.layers)

    def factor(h):
        return 1 + float((w2 @ np.tanh(w1[:, 0] * (h / 5 - 1) + b1) + b2)[0])

    # 1,023 intervals at rtol 1e-6, some 1e-5 V each, most of which is forgotten within minutes.
    np.testing.assert_allclose(names["run"], levels(names["plain"], lambda h: 1.0), rtol=0, atol=2e-3)
    np.testing.assert_allclose(names["better"], levels(names["learned"], factor), rtol=0, atol=2e-3)
    assert names["told"].correlation > 0.9
    assert names["error"] > 0.5 and names["corrected"] < 0.3


def test_measured_house():
    """Runs and likelihood are those of matrix exponentials and of a Kalman filter in NumPy."""
    measured("house/train.csv")
    names = names_after("measured_house")
    hours, inside, kept = names["hours"], names["inside"], names["KEPT"]
    inputs = np.stack([names["outside"], names["power"]])
    slopes = np.diff(inputs, axis=1, append=inputs[:, -1:]).T

    def matrix(v):
        """Of air, walls, radiators, and the two inputs, whose slopes are held from hour to hour."""
        Ci, Ce, Ch, Rie, Rea, Ria, Rih = (v[name] for name in names["PARAMETERS"])
        a = np.zeros((5, 5))
        a[0, :4] = np.array([-1 / Rie - 1 / Ria - 1 / Rih, 1 / Rie, 1 / Rih, 1 / Ria]) / Ci
        a[1, :4] = np.array([1 / Rie, -1 / Rie - 1 / Rea, 0, 1 / Rea]) / Ce
        a[2] = np.array([1 / Rih, 0, -1 / Rih, 0, 1]) / Ch
        return a

    def by_slopes(u):
        return np.array([0, 0, 0, *u])

    runs, fit = names["runs"], names["fit"]
    a = matrix(runs.values)
    x, found = np.array([*(runs.starts[f"house.{k}"][0] for k in ("Ti", "Te", "Th")), *inputs[:, 0]]), []
    for u in slopes[:-1]:
        x = expm(a) @ x + held(a, by_slopes(u), 1.0)
        found.append(x[0])
    np.testing.assert_allclose(names["run"].mean["house.Ti"], found, rtol=0, atol=1e-3)  # 671 hours at rtol 1e-6

    v = fit.values
    noise = np.diag([v["noise of house.Ti"] ** 2, v["noise of house.Te"] ** 2, 0, 0, 0])
    x, p = np.array([*np.full(3, inside[0]), *inputs[:, 0]]), np.diag([0.04, 9, 9, 0, 0])
    readings = np.where(hours[1:] < kept, inside[1:], np.nan)[:, None]
    cost = negative_log_likelihood(
        matrix(v), by_slopes, noise, np.eye(5)[:1], lambda u: np.zeros(1), np.full(1, names["STEP"] / np.sqrt(12)),
        x, p, hours[1:], slopes, readings,
    )  # fmt: skip
    count = np.isfinite(readings).sum()
    np.testing.assert_allclose(fit.log_likelihood, -cost - 0.5 * count * np.log(2 * np.pi), rtol=1e-5)

    assert names["error"](names["forecast"]) < 0.4 < names["error"](names["run"])
    assert fit.log_likelihood > runs.log_likelihood + 100
    assert "house.Rie" in names["apart"] and names["rms"]["on"] > 1.5 * names["rms"]["off"]
    assert abs(fit.whiteness["house"]["house.Ti"].correlation) < 0.5 < runs.whiteness["house"]["house.Ti"].correlation


def test_modelica():
    """The slope of the rectifier's mean voltage against differences; heat and slip of the clutch against SciPy's
    integration of each of its phases."""
    names = names_after("modelica")
    assert abs(names["slope"] / names["difference"] - 1) < 1e-4
    assert abs(names["fit"].values["clutch.mu"] - 0.27) < 0.002  # five standard deviations

    def closed(mu):
        def field(t, s):
            torque = mu * 0.1 * min(300.0 * t, 300.0)
            return [(2 * t - torque) / 0.2, torque / 0.5, torque * (s[0] - s[1])]

        def met(t, s):
            return s[0] - s[1]

        met.terminal, met.direction = True, -1
        first = solve_ivp(field, (0.0, 8.0), [60.0, 0.0, 0.0], events=met, rtol=1e-10, atol=1e-10, max_step=0.1)
        slips = mu * 30.0 * 0.7 / (0.5 * 2.0)  # sticking = sliding
        heat, slip = first.y[2, -1], first.y[0, -1] - first.y[1, -1]
        begins = max(first.t[-1], slips)
        if first.t[-1] < 8.0 and begins < 8.0:
            last = solve_ivp(field, (begins, 8.0), [0.0, 0.0, 0.0], rtol=1e-10, atol=1e-10, max_step=0.1).y[:, -1]
            heat, slip = heat + last[2], last[0] - last[1]
        return heat, slip

    for k in (0, 139, 141, 143, 293, 333, 700, 999):
        heat, slip = closed(float(names["coefficients"][k]))
        np.testing.assert_allclose(names["heat"][k], heat, rtol=1e-4)
        np.testing.assert_allclose(names["slip"][k], slip, rtol=1e-4, atol=1e-6)


def test_out_and_back():
    pytest.importorskip("fmpy", reason="FMPy is not installed (extra fmi)")
    names = names_after("out_and_back")
    assert names["difference"] < 1e-6 and names["of_cvode"] < 1e-6
    # A gradient is that of differences; their error is that of rounding over the step, beside a sum of thousands.
    assert names["misfit_along"] == pytest.approx(names["along"], rel=1e-6)
    # What is left of the residuals is the noise of two components, whose variance is known to 1/sqrt(300).
    assert names["tuned"].fun == pytest.approx(2 * 0.02**2, rel=0.3)
    fast = names["speeds"] > 0.5
    found = np.array(names["strength"](names["law_of"](names["tuned"].x)))
    np.testing.assert_allclose(found[fast], 1.2 * names["speeds"][fast] ** 2, rtol=0.03, atol=0.02)
    np.testing.assert_allclose(*names["values"], rtol=1e-7)
    np.testing.assert_allclose(*names["gradients"], rtol=1e-6)
