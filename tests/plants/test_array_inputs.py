"""Names of arrays for what drives and reads a model: inputs, lists of names, sweeps, linearizations, data sets."""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from sympy import Eq

from jaxonomy_dae import (
    AcausalCompiler,
    AcausalDiagram,
    Component,
    EqnEnv,
    ModelError,
    assign,
    der,
    linearize,
    simulate,
    steady_state,
    sweep,
)
from jaxonomy_dae.host.cache import PROGRAMS

TS = jnp.linspace(0.0, 2.0, 9)
T = np.asarray(TS)
TIGHT = {"rtol": 1e-9, "atol": 1e-11}
WHEN = np.linspace(0.0, 2.0, 6)


class Lag(Component):
    """T·dx/dt = u − x; `slope` is du/dt if it is `differentiated`."""

    def __init__(self, ev, name, T=1.0, default=None, differentiated=False):
        super().__init__(ev, name)
        T = self.parameter("T", T, bounds=(0.0, np.inf))
        u, x = self.input("u", default=default), self.variable("x", start=0.0, fixed=True)
        self.add_equations(Eq(T * der(x), u - x))
        if differentiated:
            copy, slope = self.variable("copy"), self.variable("slope")
            self.add_equations(Eq(copy, u), Eq(slope, der(copy)))


@functools.cache
def lags(shape, **options):
    ev, diagram = EqnEnv(), AcausalDiagram()
    diagram.add_array(ev, "lag", Lag, shape, T=1.0 + np.arange(np.prod(shape)).reshape(shape) / 7, **options)
    return AcausalCompiler(ev, diagram)()


def run(system, inputs, ts=TS, **options):
    return simulate(system, 2.0, ts=ts, inputs=inputs, **TIGHT, **options)


def samples(shape):
    return np.sin(WHEN.reshape(-1, *[1] * len(shape)) + np.arange(np.prod(shape)).reshape(shape))


def given_by(kind, shape):
    """What is given for the array, and for its entry at an index."""
    values, phases = samples(shape), np.arange(np.prod(shape)).reshape(shape) * 1.0
    if kind in ("linear", "cubic", "held"):
        return (WHEN, values, kind), lambda index: (WHEN, values[:, *index], kind)
    return {
        "interpolation": (
            diffrax.LinearInterpolation(jnp.array(WHEN), jnp.array(values)),
            lambda index: (WHEN, values[:, *index]),
        ),
        "array": (phases, lambda index: phases[index]),
        "traced": (jnp.asarray(phases), lambda index: phases[index]),
        "function": (lambda t: jnp.sin(t + phases), lambda index: lambda t: jnp.sin(t + phases[index])),
        "one function": (jnp.sin, lambda index: jnp.sin),
        "one number": (2.0, lambda index: 2.0),
        "one column": ((WHEN, values.reshape(len(WHEN), -1)[:, 0]), lambda index: (WHEN, values.reshape(6, -1)[:, 0])),
    }[kind]


KINDS = (
    "linear", "cubic", "held", "interpolation", "array", "traced", "function", "one function", "one number",
    "one column",
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.long("two runs with inputs of every kind")
@pytest.mark.parametrize("shape", [(3,), pytest.param((5, 8), marks=pytest.mark.slow)], ids=str)
def test_an_array_of_inputs_is_its_entries(shape):
    """Forty inputs are read as an array, three as scalars; the same arithmetic, so the same to rounding."""
    ev, diagram = EqnEnv(), AcausalDiagram()
    names = {kind: kind.replace(" ", "_") for kind in KINDS}
    for name in names.values():
        diagram.add_array(ev, name, Lag, shape, T=1.0 + np.arange(np.prod(shape)).reshape(shape) / 7)
    system = AcausalCompiler(ev, diagram)()
    arrays, entries = {}, {}
    for kind, name in names.items():
        arrays[f"{name}.u"], entry = given_by(kind, shape)
        for i in np.ndindex(shape):
            entries[f"{name}[{','.join(map(str, i))}].u"] = entry(i)
    whole, single = (run(system, inputs, adjoint=diffrax.ForwardMode()) for inputs in (arrays, entries))
    for name in names.values():
        assert whole[f"{name}.x"].shape == (len(TS), *shape)
        np.testing.assert_allclose(whole[f"{name}.x"], single[f"{name}.x"], rtol=0, atol=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize("n", [3, pytest.param(40, marks=pytest.mark.slow)])
def test_the_model_differentiates_them(n):
    """du/dt of functions for all, and of defaults that are constant."""
    phases = np.arange(n) * 1.0
    ev, diagram = EqnEnv(), AcausalDiagram()
    for name, default in (("driven", None), ("left", 3.0)):
        diagram.add_array(ev, name, Lag, n, 1.0 + np.arange(n) / 7, default=default, differentiated=True)
    inputs = {"driven.u": lambda t: jnp.sin(t + phases), "left[1].u": lambda t: t}
    found = run(AcausalCompiler(ev, diagram)(), inputs, adjoint=diffrax.ForwardMode())
    np.testing.assert_allclose(found["driven.slope"], np.cos(T[:, None] + phases), rtol=0, atol=1e-14)
    np.testing.assert_array_equal(found["left.slope"], np.broadcast_to(np.arange(n) == 1, (len(T), n)))
    rest = 3.0 * -np.expm1(-T / (1 + 2 / 7))
    np.testing.assert_allclose(found["left[2].x"], rest, rtol=0, atol=1e-8)


@pytest.mark.slow
@pytest.mark.long("a reverse-mode gradient of a run, and a batch of runs")
def test_gradients_and_batches():
    """x(2) of lags that are driven by samples is linear in them: x = ∂x/∂u·u, each by its own samples alone."""
    system, values = lags(3), samples((3,))

    def last(values):
        return run(system, {"lag.u": (WHEN, values)}, TS[-1:])["lag.x"][-1]

    @jax.jit
    def slope_and_batch(values):
        return jax.jacrev(last)(values), jax.vmap(last)(jnp.stack([values, 2 * values]))

    one = np.asarray(last(values))
    slope, batch = map(np.asarray, slope_and_batch(jnp.array(values)))
    np.testing.assert_array_equal(np.abs(slope).max(1) > 0, np.eye(3, dtype=bool))
    np.testing.assert_allclose(np.einsum("ikj,kj->i", slope, values), one, rtol=0, atol=1e-8)
    np.testing.assert_allclose(batch, [one, 2 * one], rtol=0, atol=1e-8)  # linear, from rest
    before = len(PROGRAMS)
    last(values + 1.0)
    assert len(PROGRAMS) == before


class Gate(Lag):
    """A lag of what is 1 unless it is driven; `seen` turns 1 where x reaches 0.5."""

    def __init__(self, ev, name, T=1.0):
        super().__init__(ev, name, T, default=1.0)
        seen = self.discrete("seen", start=0)
        self.when(self.x > 0.5, assign(seen, 1.0))


@pytest.fixture(scope="module")
def gates():
    ev, diagram = EqnEnv(), AcausalDiagram()
    diagram.add_array(ev, "gate", Gate, 2, T=np.array([1.0, 2.0]))
    return AcausalCompiler(ev, diagram)()


@pytest.mark.slow
@pytest.mark.long("a run with events")
def test_among_several_names(gates):
    """An array's name stands for its entries in lists, and gives its shape alone."""
    solution = run(gates, {})
    each = [f"gate[{k}].x" for k in range(2)]
    np.testing.assert_array_equal(solution[["time", "gate.x"]], solution[["time", *each]])
    np.testing.assert_array_equal(solution[["gate.seen", "gate[0].x"]][:, :2], solution["gate.seen"])
    np.testing.assert_allclose(solution["gate.x"], -np.expm1(-T[:, None] / np.array([1.0, 2.0])), rtol=0, atol=1e-8)
    x = gates.initialize(initial={"gate.x": np.array([0.25, 0.5])})
    np.testing.assert_array_equal(gates.observe(["gate.x", "gate[1].u"], 0.0, x), [0.25, 0.5, 1.0])
    events = solution.events
    np.testing.assert_allclose(events.ts[:2], np.log(2) * np.array([1.0, 2.0]), atol=1e-8)
    np.testing.assert_allclose(np.diagonal(events.before["gate.x"][:2]), 0.5, atol=1e-8)
    np.testing.assert_array_equal(events.after["gate.seen"][:2], [[1.0, 0.0], [1.0, 1.0]])


@pytest.mark.slow
def test_points_and_linearizations(gates):
    u = np.array([2.0, 3.0])
    point = steady_state(gates, inputs={"gate.u": u})
    np.testing.assert_allclose(point["gate.x"], u, rtol=1e-12)
    np.testing.assert_allclose(point[["gate.x", "gate[0].u"]], [2.0, 3.0, 2.0], rtol=1e-12)
    space = linearize(gates, ["gate.u"], ["gate.x"], at=point)
    assert space.inputs == ("gate[0].u", "gate[1].u") and space.outputs == space.states == ("gate[0].x", "gate[1].x")
    np.testing.assert_allclose(space.A, np.diag([-1.0, -0.5]), rtol=1e-12)
    np.testing.assert_allclose(space.B, np.diag([1.0, 0.5]), rtol=1e-12)
    np.testing.assert_array_equal(space.u0, u)
    one = linearize(gates, {"gate.u": u}, ["gate[1].x"], states=["gate.x"])
    np.testing.assert_allclose(one.C, [[0.0, 1.0]])
    alone = linearize(gates, ["gate[1].u"], ["gate.x"], at=point)  # an entry of what was given as an array
    np.testing.assert_allclose(alone.B, [[0.0], [0.5]], rtol=1e-12)


@pytest.mark.slow
def test_sweeps(gates):
    """One value for all entries, or one for each; T = 0 is not admissible."""
    pytest.importorskip("xarray")
    T = np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 0.5]])
    options = {"t1": 2.0, "ts": TS, **TIGHT}
    each, every = sweep(gates, {"gate.T": T}, **options), sweep(gates, {"gate.T": T[:, 0]}, **options)
    exact = -np.expm1(-TS[None, :, None] / T[:, None, :])
    np.testing.assert_allclose(each["gate.x"], exact, rtol=0, atol=1e-8)
    np.testing.assert_allclose(every["gate.x"], exact[..., :1].repeat(2, -1), rtol=0, atol=1e-8)
    np.testing.assert_array_equal(sweep(gates, {"gate.T": T}, lambda s: s.parameters["gate.T"]).values, T)
    data = each.to_xarray()
    assert data["gate.T values"].dims == ("gate.T", "gate.T_0") and data["gate[1].x"].dims == ("gate.T", "time")
    with pytest.raises(ModelError, match=r"parameter 'gate\[1\].T' must lie in \[0, inf\); got -1"):
        sweep(gates, {"gate.T": np.array([[1.0, -1.0]])}, **options)
    with pytest.raises(ModelError, match=r"'gate.T' need shape \(k,\) or \(k, 2\), k ≥ 1; got \(1, 3\)"):
        sweep(gates, {"gate.T": np.ones((1, 3))}, **options)


@pytest.mark.slow
def test_data_sets_have_the_dimensions_of_arrays():
    pytest.importorskip("xarray")
    data = run(lags((2, 3)), {"lag.u": 1.0}, adjoint=diffrax.ForwardMode()).to_xarray(
        "lag.x", "lag[0,1].x", "lag[1,2].u"
    )
    assert data["lag.x"].dims == ("time", "lag_0", "lag_1") and data["lag[0,1].x"].dims == ("time",)
    np.testing.assert_array_equal(data["lag.x"][:, 0, 1], data["lag[0,1].x"])


NAN = np.array([0.0, np.nan, 1.0])


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"lag.u": np.ones(4)}, r"inputs: 'lag.u' is an array of shape \(3,\): give a number or an array of that"),
        ({"lag.u": [1.0, 2.0, 3.0]}, r"a list may be samples: give values as a NumPy array"),
        ({"lag.u": NAN}, r"input 'lag.u' must be finite; its entry \[1\] is nan"),
        ({"lag.u": np.array(["a", "b", "c"])}, r"'lag.u' must be real numbers; got <U1"),
        ({"lag.u": (WHEN, np.ones((6, 2)))}, r"values must be real numbers of shape \(n, 3\); .* of shape \(6, 2\)"),
        ({"lag.u": (WHEN, np.ones((5, 3)))}, r"needs a value for every time; got 6 times and 5 values"),
        ({"lag.u": (WHEN, np.ones((6, 1)) * NAN)}, r"input 'lag.u': values\[0, 1\] is nan; leave the sample out"),
        ({"lag.u": lambda t: jnp.ones(2) * t}, r"must return one number or an array of shape \(3,\) for a time"),
        ({"lag.u": 1.0, "lag[2].u": 2.0}, r"inputs: 'lag\[2\].u' is given twice, by its own name and as part of an"),
        ({"lag[0].u": 1.0, "lag[2].u": 2.0}, r"input 'lag\[1\].u' was not given, and has no default"),
        ({"lag.x": 1.0}, r"'lag.x' is not an input of this system"),
        ({"lag.u": (WHEN / 2, np.ones((6, 3)))}, r"samples of input 'lag.u' reach from 0 to 1, the run from 0 to 2"),
    ],
    ids=lambda v: v if isinstance(v, str) else "",
)  # fmt: skip
def test_bad_input(given, message):
    with pytest.raises(ModelError, match=message):
        run(lags(3), given)


@pytest.mark.slow
def test_the_entry_that_is_not_finite_is_named():
    bad = lambda t: jnp.where((t > 1.0) & (jnp.arange(3) == 2), jnp.nan, 1.0)  # noqa: E731
    with pytest.raises(Exception, match=r"input 'lag\[2\].u' is nan at t=1"):
        run(lags(3), {"lag.u": bad})
