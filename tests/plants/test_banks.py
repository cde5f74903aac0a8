"""Arrays of circuits that switch: each as if it were alone, in one program for any number of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from diode_bridges import RON, bridge_by_brute_force

import jaxonomy_dae.library.electrical as el
from jaxonomy_dae import AcausalCompiler, AcausalDiagram, EqnEnv, simulate

KNEE, GOFF = 0.6, 1e-6


def bank(n: int):
    """n bridges at one source, each behind 1 Ω, with its own capacitor and load."""
    ev, diagram = EqnEnv(), AcausalDiagram()
    source, ground = el.SineVoltage(ev, "src", 10.0, 1.0), el.Ground(ev, "g")
    series = diagram.add_array(ev, "rs", el.Resistor, n, 1.0)
    d = [diagram.add_array(ev, f"d{k}", el.IdealDiode, n, Ron=RON, Goff=GOFF, Vknee=KNEE) for k in range(4)]
    tank = diagram.add_array(ev, "c", el.Capacitor, n, capacitances(n), initial_voltage=1.0)
    load = diagram.add_array(ev, "r", el.Resistor, n, loads(n))
    diagram.connect(source.n, ground.p)
    diagram.connect(source.p, series.p)
    diagram.connect(series.n, d[0].p, d[2].n)
    diagram.connect(source.n, d[1].p)
    diagram.connect(source.n, d[3].n)
    diagram.connect(d[0].n, d[1].n, tank.p, load.p)
    diagram.connect(d[2].p, d[3].p, tank.n, load.n)
    return AcausalCompiler(ev, diagram)()


def capacitances(n):
    return np.linspace(0.04, 0.06, n)


def loads(n):
    return np.linspace(15.0, 30.0, n)


@pytest.mark.slow
def test_each_bridge_of_a_bank_is_as_if_alone():
    """Against the one mode of sixteen that fits, integrated by SciPy in steps of 0.01 s, which cross kinks of the right
    side with errors below 1e-7."""
    n, ts = 3, np.linspace(0.0, 0.5, 11)
    solution = simulate(bank(n), 0.5, ts=jnp.asarray(ts), rtol=1e-10, atol=1e-10)

    for k, C, R in zip(range(n), capacitances(n), loads(n), strict=True):

        def charging(t, v, C=C, R=R):
            current = bridge_by_brute_force(10 * np.sin(2 * np.pi * t), v[0], goff=GOFF, knee=KNEE)[1]
            return (current - v / R) / C

        reference = scipy.integrate.solve_ivp(
            charging, (0.0, 0.5), [1.0], "RK45", t_eval=ts, rtol=1e-9, atol=1e-9, max_step=0.01
        )
        np.testing.assert_allclose(solution[f"c[{k}].v"], reference.y[0], atol=1e-7)


@pytest.mark.slow
def test_the_program_does_not_grow_with_the_bank():
    def operations(jaxpr) -> int:
        inner = [p for e in jaxpr.eqns for v in e.params.values() for p in jax.tree.leaves(v, is_leaf=is_jaxpr)]
        return len(jaxpr.eqns) + sum(operations(getattr(p, "jaxpr", p)) for p in inner if is_jaxpr(p))

    def is_jaxpr(value) -> bool:
        return hasattr(value, "eqns") or hasattr(getattr(value, "jaxpr", None), "eqns")

    def of(n: int) -> int:
        system = bank(n)

        def end(v):
            changed = system.with_parameters({"src.amplitude": v})
            return simulate(changed, 0.1, ts=np.array([0.1]), max_events=100, save_events=False).states

        return operations(jax.make_jaxpr(end)(jnp.array(10.0)).jaxpr)

    few = of(10)
    assert few > 1000  # or it is not counted
    assert of(100) <= few  # up to 32 states are read one by one
