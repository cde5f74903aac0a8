"""Problems that the tests share, and what is known of them.

References are closed forms, published numbers, or SciPy's solution of a simpler equation. Nothing here was computed by
jaxonomy_dae; the models are written with it, the expectations are not.
"""

import os
import pathlib
import re
import subprocess
import sys
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.special
from jax.flatten_util import ravel_pytree
from sympy import Eq

from jaxonomy_dae import (
    AcausalCompiler,
    AcausalDiagram,
    AcausalSystem,
    Component,
    EqnEnv,
    NeuralDAEBlock,
    Translational,
    der,
)
from jaxonomy_dae.library.electrical import Capacitor, Ground, Resistor, VoltageSource
from jaxonomy_dae.library.planar import PlanarPendulum
from jaxonomy_dae.library.translational import Damper, FixedPosition, Mass, Spring

ROOT = pathlib.Path(__file__).parents[1]
GRAVITY = 9.81  # m/s²
RELEASE = -1.2  # rad from the +x axis: the tutorial's
HORIZONS = (0.5, 1.0, 1.5)  # s: the tutorial's
DRAG = 0.5  # 1/m, drag per mass

# --- the reference tutorial: its printed figures, and checks of them with hand-written Diffrax ------------------

# (vx, x) at the three horizons, m = L = 1, correction −0.5·vx·|vx| on vx alone. `ROW` is what the tutorial computes
# (its five printed digits agree); `EQUATION` is the true force. From a hand-written Diffrax model, checked there
# against the angle equation.
ROW = np.array([[-1.03426742, 0.02631901], [-0.03995892, -0.29260138], [0.84902642, -0.02937084]])
EQUATION = np.array([[-1.03717795, 0.02531855], [-0.03860455, -0.29388159], [0.85380528, -0.02867716]])

# The tutorial's own printout.
INITIAL_LOSS = 4.967455e-2
INITIAL_GRADIENT_NORM = 5.166805e-1
TRAINING = {5: 5.814689e-4, 10: 8.623484e-3, 15: 1.846313e-4, 20: 3.075208e-3, 25: 2.064372e-4}


def tutorial_network() -> tuple[Callable, Any]:
    """The tutorial's 1 → 6 → 1 tanh network, drawn and ravelled as it does: a function and 19 weights."""
    key1, key2 = jax.random.split(jax.random.PRNGKey(0))
    flat, unravel = ravel_pytree(
        {
            "W1": 0.5 * jax.random.normal(key1, (6, 1)),
            "b1": jnp.zeros(6),
            "W2": 0.1 * jax.random.normal(key2, (1, 6)),
            "b2": jnp.zeros(1),
        }
    )

    def network(t, u, theta):
        p = unravel(theta)
        return p["W2"] @ jnp.tanh(p["W1"] @ u + p["b1"]) + p["b2"]

    return network, flat


def quadratic(u):
    """−c·u·|u|, elementwise: the drag per mass that the tutorial's network is to find."""
    return -DRAG * u * jnp.abs(u)


# --- pendulums ---------------------------------------------------------------------------------------------------


def pendulum(*blocks: Any, name: str = "pend", compiler: dict[str, Any] | None = None, **parameters) -> AcausalSystem:
    """A compiled `PlanarPendulum` released at the tutorial's angle, with learned corrections.

    `blocks` are functions from the component to a `NeuralDAEBlock`.
    """
    bob = PlanarPendulum(EqnEnv(), name, **({"initial_theta": RELEASE} | parameters))
    return compiled(bob, blocks=[block(bob) for block in blocks], **(compiler or {}))


def drag_on(*targets: str, network: Callable = quadratic, name: str = "drag", **options) -> Callable:
    """A correction of a component's variables, for `pendulum` and `oscillator`."""
    return lambda component: NeuralDAEBlock(network, targets=[(component, t) for t in targets], name=name, **options)


def mlp(inputs: int, outputs: int, *, width: int = 4, seed: int = 0) -> eqx.nn.MLP:
    """A small tanh network."""
    return eqx.nn.MLP(inputs, outputs, width, 1, jnp.tanh, key=jax.random.key(seed))


class AngleSolution(NamedTuple):
    """Position (m), velocity (m/s) and the multiplier of m·dv/dt = −2λr + m(g + N) (N/m) at each time."""

    x: np.ndarray
    y: np.ndarray
    vx: np.ndarray
    vy: np.ndarray
    lam: np.ndarray


def angle_solution(
    theta0: float,
    omega0: float,
    ts: Sequence[float] | np.ndarray,
    *,
    g: float = GRAVITY,
    L: float = 1.0,
    m: float = 1.0,
    force: Callable[[float, float], tuple[float, float]] | None = None,
) -> AngleSolution:
    """The pendulum as one angle, L·θ'' = −g·cos θ + N·e_θ, by SciPy's DOP853 at rtol 1e-13, restarted at every time.

    `force(vx, vy)` is a force per mass (Nx, Ny). The tension follows from the radial balance, drag included.
    """

    def acting(theta, omega):
        return (0.0, 0.0) if force is None else force(-L * np.sin(theta) * omega, L * np.cos(theta) * omega)

    def field(t, state):
        theta, omega = state
        nx, ny = acting(theta, omega)
        return omega, ((ny - g) * np.cos(theta) - nx * np.sin(theta)) / L

    time, state, states = 0.0, np.array([theta0, omega0], float), []
    for t in np.asarray(ts, float):
        if t > time:
            solved = scipy.integrate.solve_ivp(field, (time, t), state, method="DOP853", rtol=1e-13, atol=1e-14)
            time, state = t, solved.y[:, -1]
        states.append(state)
    theta, omega = np.array(states).T
    x, y = L * np.cos(theta), L * np.sin(theta)
    vx, vy = -y * omega, x * omega
    nx, ny = np.array([acting(*s) for s in states]).T
    return AngleSolution(x, y, vx, vy, m * (vx**2 + vy**2 - g * y + x * nx + y * ny) / (2 * L**2))


def elliptic_angle(theta0: float, ts: np.ndarray, g: float = GRAVITY, L: float = 1.0) -> np.ndarray:
    """The closed form for a release from rest without drag, by Jacobi's elliptic functions (angle in rad)."""
    k = np.sin((theta0 + np.pi / 2) / 2)
    _, cn, dn, _ = scipy.special.ellipj(np.sqrt(g / L) * np.asarray(ts), k * k)
    return 2 * np.arcsin(k * cn / dn) - np.pi / 2


# Cash's pendulum, g = L = m = 1, released at (1, 0) with velocity (0, 1); (x, y, x', y', λ) at t = 1, where
# λ = 2·lam. From J. Cash's driver pendul3.f (github fons/JavaOdeInt). 18 digits are printed, 9 of them are right:
# a 30-digit Taylor series confirmed that.
CASH = np.array([0.867348640604551746, 0.497701050476373918, -0.0337480180329866458, 0.0588130114660715686,
                 -0.493103151528274442])  # fmt: skip

# Released from the horizontal, this gravity makes the period exactly 2: g = 4·K(1/2)²
# (github modelon-community/Assimulo, examples/mech_system_pendulum.py).
PERIOD_TWO_GRAVITY = 4 * scipy.special.ellipk(0.5) ** 2


# --- circuits ----------------------------------------------------------------------------------------------------


def compiled(
    *components: Component, connect: Sequence[Sequence[Any]] = (), blocks: Sequence[NeuralDAEBlock] = (), **options
) -> AcausalSystem:
    """Components, connections and learned corrections, compiled."""
    diagram = AcausalDiagram()
    diagram.add(*components)
    for ends in connect:
        diagram.connect(*ends)
    for block in blocks:
        diagram.add_neural_correction_block(block)
    return AcausalCompiler(components[0].ev, diagram, **options)()


EV = EqnEnv()  # of components that are made where they are written


def component(write: Callable[[Component, EqnEnv], Any], name: str = "c") -> Component:
    """A component whose class body is the function `write(self, ev)`."""

    class Written(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            write(self, ev)

    return Written(EV, name)


def rc_ladder(n: int) -> AcausalSystem:
    """A source, n resistors in a row, and a capacitor to ground after each."""
    ev, diagram = EqnEnv(), AcausalDiagram()
    source, ground = VoltageSource(ev, "source"), Ground(ev, "ground")
    diagram.connect(source.n, ground.p)
    before = source.p
    for k in range(n):
        r, c = Resistor(ev, f"r{k}"), Capacitor(ev, f"c{k}", initial_voltage=0.0)
        diagram.connect(before, r.p).connect(r.n, c.p).connect(c.n, ground.p)
        before = r.n
    return AcausalCompiler(ev, diagram)()


class FreeMass(Component):
    """The library's `Mass`, except that its mass may be any number."""

    def __init__(self, ev: EqnEnv, name: str, M: float = 1.0, initial_position=None, initial_velocity=None):
        super().__init__(ev, name)
        m = self.parameter("M", M, unit="kg")
        s0 = self.parameter("initial_position", initial_position or 0.0)
        v0 = self.parameter("initial_velocity", initial_velocity or 0.0)
        flange = self.port("flange", Translational)
        s = self.variable("s", start=s0, fixed=initial_position is not None)
        v = self.variable("v", start=v0, fixed=initial_velocity is not None)
        self.add_equations(Eq(s, flange.s), Eq(der(s), v), Eq(m * der(v), flange.f))


def rc_circuit(R: float = 2.0, C: float = 0.5, V: float = 3.0, v0: float = 0.0) -> AcausalSystem:
    """A capacitor charged through a resistor."""
    ev = EqnEnv()
    source, r = VoltageSource(ev, "source", V), Resistor(ev, "r", R)
    c, ground = Capacitor(ev, "c", C, initial_voltage=v0), Ground(ev, "ground")
    return compiled(
        source, r, c, ground, connect=[(source.p, r.p), (r.n, c.p), (c.n, source.n, ground.p)]
    )  # fmt: skip


def rc_voltage(t, R=2.0, C=0.5, V=3.0, v0=0.0):
    """The closed form of `rc_circuit`: the capacitor's voltage."""
    return V + (v0 - V) * np.exp(-np.asarray(t) / (R * C))


# --- oscillators -------------------------------------------------------------------------------------------------


def oscillator(
    *blocks: Callable, M=2.0, D=0.6, K=5.0, x0=0.7, v0=-0.4, kind=Mass, compiler: dict[str, Any] | None = None
) -> AcausalSystem:
    """A mass between a spring and a damper, both fixed to a wall; `blocks` correct the mass."""
    ev = EqnEnv()
    mass = kind(ev, "mass", M, initial_position=x0, initial_velocity=v0)
    spring, damper, wall = Spring(ev, "spring", K), Damper(ev, "damper", D), FixedPosition(ev, "wall")
    return compiled(
        wall, spring, damper, mass,
        connect=[(wall.flange, spring.flange_a, damper.flange_a), (mass.flange, spring.flange_b, damper.flange_b)],
        blocks=[block(mass) for block in blocks],
        **(compiler or {}),
    )  # fmt: skip


def damped_oscillation(t, M=2.0, D=0.6, K=5.0, x0=0.7, v0=-0.4):
    """(x, v) of M·x'' + D·x' + K·x = 0, underdamped."""
    a = D / (2 * M)
    w = np.sqrt(K / M - a * a)
    c, s, e = np.cos(w * t), np.sin(w * t), np.exp(-a * t)
    b = (v0 + a * x0) / w
    return e * (x0 * c + b * s), e * ((-a * x0 + w * b) * c + (-a * b - w * x0) * s)


# --- other processes ---------------------------------------------------------------------------------------------


def environment(**changed: str) -> dict[str, str]:
    """The environment for a new Python that finds the package and this module, without JAX's settings and without what
    `threadpoolctl` set in this process."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "KMP_"))}
    folders = [ROOT, *(ROOT / "tests" / room for room in ("", "kernels", "compiler", "plants"))]
    return kept | {"PYTHONPATH": os.pathsep.join(map(str, folders))} | changed


def run(program: str) -> str:
    """Runs a program in a new Python, without this process's settings; returns what it printed."""
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", program], env=environment(), capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


# --- parameters of tests -----------------------------------------------------------------------------------------


def slow(cases: Iterable[Any], *these: Any) -> list[Any]:
    """Parameters of a test, these of them marked slow."""
    return [pytest.param(case, marks=pytest.mark.slow) if case in these else case for case in cases]


# --- texts -------------------------------------------------------------------------------------------------------


def without_lines(error: object) -> str:
    """The text of an error, with the lines of code that it names left out."""
    return re.sub(r" {1,2}\([\w.]+\.py:\d+\)", "", str(error))
