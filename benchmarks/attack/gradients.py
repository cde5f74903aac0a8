"""Derivatives of trajectories: random networks, learned terms in equations, a learned force on a pendulum.

The functional is a random sum of values along the trajectory; it is differentiated by parameters, starts and weights.
References are differences of exact solutions (`linear_network.py`), extrapolated to no step, or complex steps through
SciPy's DOP853 (Squire & Trapp 1998), which lose no digits.
"""

import importlib
from collections.abc import Callable, Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.integrate
from sympy import sin

from jaxonomy_dae import AcausalDiagram, Component, EqnEnv, NeuralDAEBlock, der
from jaxonomy_dae.compile.passes.flatten import flatten
from jaxonomy_dae.library.planar import PlanarPendulum

from .case import Case, Expected, Motion, Slopes, signed

ALLOWED = 1e-6  # of the largest derivative, each multiplied by the size of what it is taken by
STEP = 2e-3  # relative; the error of extrapolated differences is of its fourth power
NETWORKS = ("circuits", "rods", "gears", "thermal")
MOST_STATES, MOST_PARTS = 4, 12  # compiling takes a few seconds then


def make(seed: int) -> Case:
    """A network of another family, a system with a learned term, or a pendulum with a learned force."""
    rng = np.random.default_rng([seed, 11])
    kind = ("network", "network", "term", "force")[int(rng.integers(4))]
    return {"network": _network, "term": _term, "force": _force}[kind](rng)


def _slopes(
    rng: np.random.Generator,
    motion: Motion,
    names: Sequence[str],
    derivatives: Callable[[Mapping[str, np.ndarray]], tuple[dict, dict, dict]],
    sizes: Mapping[str, float],
) -> Slopes:
    """The functional with random weights. `derivatives(weights)` gives its derivatives by parameters, starts and
    networks' weights; `sizes` say how large parameters and starts are."""
    weights = {n: rng.uniform(0.3, 1.0, len(motion.ts)) * rng.choice([-1.0, 1.0], len(motion.ts)) for n in names}
    weights = {n: w / max(float(np.max(np.abs(motion.values[n]))), 1e6 * motion.allowed[n]) for n, w in weights.items()}
    terms = [weights[n] * motion.values[n] for n in names]
    by_parameter, by_start, by_weight = derivatives(weights)
    size = max(
        sum(float(np.sum(np.abs(term))) for term in terms),
        *(abs(v) * sizes[n] for n, v in (*by_parameter.items(), *by_start.items())),
        *(float(np.max(np.abs(v))) for v in by_weight.values()),
    )

    def true(table: Mapping[str, float]) -> dict[str, Expected]:
        return {n: Expected(float(v), ALLOWED * size / sizes[n]) for n, v in table.items()}

    value = Expected(float(sum(map(np.sum, terms))), ALLOWED * size)
    learned = {n: [Expected(float(v), ALLOWED * size) for v in values] for n, values in by_weight.items()}
    return Slopes(weights, value, true(by_parameter), true(by_start), learned)


# --- networks --------------------------------------------------------------------------------------------------------


def _network(rng: np.random.Generator) -> Case:
    """A small network of another family, differentiated by up to four values of its parts and two starts."""
    while True:
        family = NETWORKS[int(rng.integers(len(NETWORKS)))]
        make = importlib.import_module(f".{family}", __package__).make
        seed = int(rng.integers(10**9))
        case = make(seed)
        if case.motion is None or not 1 <= (case.freedom or 0) <= MOST_STATES:
            continue
        flat = flatten(case.diagram)
        table = flat.parameters
        parts = list(dict.fromkeys(name.partition(".")[0] for name in table.names))
        if len(parts) > MOST_PARTS:
            continue
        old = dict(zip(table.names, flat.declares.values.tolist(), strict=True))
        motion = case.motion
        changed = {}  # parameter → (its part, the motions for factors 1 ± h, 1 ± h/2)
        for part in (parts[k] for k in rng.permutation(len(parts))[:6]):
            nearby = [make(seed, {part: 1 + h}) for h in (STEP, -STEP, STEP / 2, -STEP / 2)]
            # A gear in a loop, for instance, must be what it is.
            if len(changed) < 4 and all(c.motion is not None and c.freedom == case.freedom for c in nearby):
                after = flatten(nearby[0].diagram)
                new = dict(zip(after.parameters.names, after.declares.values.tolist(), strict=True))
                moved = [n for n in old if n.startswith(f"{part}.") and new[n] == old[n] * (1 + STEP)]
                changed |= {n: [c.motion.follow(case.initial, motion.ts) for c in nearby] for n in moved[:1]}
        names = list(motion.values)
        names = [names[k] for k in rng.permutation(len(names))[:3]]
        starts = [list(case.initial)[k] for k in rng.permutation(len(case.initial))[:2]]
        largest = max(map(abs, case.initial.values()))
        if changed:
            break

    def derivatives(weights):
        def along(values) -> float:
            return float(sum(np.sum(w * values[n]) for n, w in weights.items()))

        def slope(up, down, nearer_up, nearer_down) -> float:
            """d/dh at h = 0 of what h = ±STEP and ±STEP/2 give."""
            wide, narrow = (along(up) - along(down)) / (2 * STEP), (along(nearer_up) - along(nearer_down)) / STEP
            return (4 * narrow - wide) / 3

        def moved(start: str, h: float):
            return motion.follow({n: v + h * largest * (n == start) for n, v in case.initial.items()}, motion.ts)

        by_parameter = {n: slope(*near) / old[n] for n, near in changed.items()}
        steps = (STEP, -STEP, STEP / 2, -STEP / 2)
        return by_parameter, {s: slope(*(moved(s, h) for h in steps)) / largest for s in starts}, {}

    sizes = {n: abs(old[n]) for n in changed} | {s: largest for s in starts}
    slopes = _slopes(rng, motion, names, derivatives, sizes)
    note = f"{family} {seed}: {case.note}; by {', '.join(slopes.parameters)}"
    return Case(
        case.ev, case.diagram, case.initial, {}, freedom=case.freedom, motion=motion, slopes=slopes, always_moves=True,
        note=note,
    )  # fmt: skip


# --- learned terms ---------------------------------------------------------------------------------------------------


def _mlp(rng: np.random.Generator, inputs: int, outputs: int) -> eqx.nn.MLP:
    width = int(rng.integers(2, 4))
    return eqx.nn.MLP(inputs, outputs, width, 1, jnp.tanh, key=jax.random.key(int(rng.integers(2**31))))


def _weights(network: eqx.nn.MLP) -> np.ndarray:
    return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(eqx.filter(network, eqx.is_array))])


def _evaluated(flat: np.ndarray, u: np.ndarray, outputs: int) -> np.ndarray:
    """The network in NumPy, from its weights W1, b1, W2, b2 one after the other; complex as well."""
    width = (len(flat) - outputs) // (len(u) + 1 + outputs)
    first, bias, second, last = np.split(flat, np.cumsum([width * len(u), width, outputs * width]))
    return second.reshape(outputs, width) @ np.tanh(first.reshape(width, len(u)) @ u + bias) + last


def _by_complex_steps(solve: Callable[[np.ndarray], Mapping[str, np.ndarray]], p: np.ndarray, weights) -> np.ndarray:
    """The functional's derivatives by all of p."""
    out = []
    for k in range(len(p)):
        values = solve(p + 1e-30j * (np.arange(len(p)) == k))
        out.append(sum(np.sum(w * values[n]) for n, w in weights.items()).imag / 1e-30)
    return np.array(out)


def _solved(field, y0: np.ndarray, ts: np.ndarray) -> np.ndarray:
    end = float(ts[-1])
    return scipy.integrate.solve_ivp(
        field, (0.0, end), y0, method="DOP853", rtol=1e-11, atol=1e-12, t_eval=ts, max_step=end / 20
    ).y


class WithTerm(Component):
    """x' = −a·x + k·y + sin(w·t)·e₁, y + c·y³ = N(x): the learned term stands in an algebraic equation."""

    def __init__(self, ev: EqnEnv, name: str, decay: list[float], gain: float, c: float, w: float, starts, network):
        super().__init__(ev, name)
        a = [self.parameter(f"a{k}", v) for k, v in enumerate(decay)]
        gain, c, w = self.parameter("k", gain), self.parameter("c", c), self.parameter("w", w)
        x = [self.variable(f"x{k}", start=self.parameter(f"s{k}", v), fixed=True) for k, v in enumerate(starts)]
        y = self.variable("y")
        (law,) = self.learned("law", network, inputs=x)
        self.add_equations(y + c * y**3 - law)
        for k in range(len(x)):
            push = sin(w * ev.t) if k == 0 else x[k - 1]
            self.add_equations(der(x[k]) + a[k] * x[k] - gain * y - push)


def _term(rng: np.random.Generator) -> Case:
    """One to three states beside an unknown that a network gives."""
    n = int(rng.integers(1, 4))
    network = _mlp(rng, n, 1)
    decay, starts = rng.uniform(0.3, 2.0, n), rng.uniform(-1, 1, n)
    gain, c, w = signed(rng, float(rng.uniform(0.3, 1.5))), float(rng.uniform(0.2, 1.0)), float(rng.uniform(0.5, 4.0))
    ts = np.linspace(0.0, float(rng.uniform(1, 4)), 5)[1:]
    p = np.concatenate([decay, [gain, c, w], starts, _weights(network)])

    def solve(p: np.ndarray) -> dict[str, np.ndarray]:
        a, (k, c, w), x0, flat = np.split(p, [n, n + 3, 2 * n + 3])
        size = np.sqrt(3 * c)

        def y(x):
            return 2 / size * np.sinh(np.arcsinh(1.5 * size * _evaluated(flat, x, 1)[0]) / 3)

        def field(t, x):
            return -a * x + k * y(x) + np.array([np.sin(w * t), *x[:-1]])

        xs = _solved(field, x0, ts)
        return {"c.y": np.array([y(x) for x in xs.T])} | {f"c.x{i}": row for i, row in enumerate(xs)}

    ev = EqnEnv()
    part = WithTerm(ev, "c", decay.tolist(), gain, c, w, starts.tolist(), network)
    names = [*(f"c.a{k}" for k in range(n)), "c.k", "c.c", "c.w", *(f"c.s{k}" for k in range(n))]
    diagram, note = AcausalDiagram().add(part), f"a learned term of {n} states"
    return _learned_case(rng, ev, diagram, solve, p, names, "c.law", ts, note)


def _force(rng: np.random.Generator) -> Case:
    """A pendulum in Cartesian coordinates (index 3) with a learned force per mass, against its angle's equation."""
    network = _mlp(rng, 2, 2)
    values = {
        "m": float(rng.uniform(0.5, 2)),
        "L": float(rng.uniform(0.5, 2)),
        "g_y": -9.81,
        "initial_theta": float(rng.uniform(-2.5, 0.5)),
        "initial_omega": float(rng.uniform(-1, 1)),
    }
    ts = np.linspace(0.0, float(rng.uniform(0.5, 1.5)), 5)[1:]
    p = np.concatenate([list(values.values()), _weights(network)])

    def solve(p: np.ndarray) -> dict[str, np.ndarray]:
        (m, length, gravity, theta0, omega0), flat = p[:5], p[5:]

        def acting(theta, omega):
            velocity = length * omega * np.array([-np.sin(theta), np.cos(theta)])
            return velocity, _evaluated(flat, velocity, 2)

        def field(t, state):
            theta, omega = state
            _, (nx, ny) = acting(theta, omega)
            return np.array([omega, ((ny + gravity) * np.cos(theta) - nx * np.sin(theta)) / length])

        theta, omega = _solved(field, np.array([theta0, omega0]), ts)
        pairs = [acting(*state) for state in zip(theta, omega, strict=True)]
        (vx, vy), (nx, ny) = np.array([v for v, _ in pairs]).T, np.array([f for _, f in pairs]).T
        x, y = length * np.cos(theta), length * np.sin(theta)
        lam = m * (vx**2 + vy**2 + gravity * y + x * nx + y * ny) / (2 * length**2)
        return {"pend.x": x, "pend.y": y, "pend.vx": vx, "pend.vy": vy, "pend.lam": lam}

    ev, diagram = EqnEnv(), AcausalDiagram()
    bob = PlanarPendulum(ev, "pend", **values)
    diagram.add(bob)
    diagram.add_neural_correction_block(NeuralDAEBlock(network, targets=[(bob, "vx"), (bob, "vy")], name="drag"))
    names = [f"pend.{n}" for n in values]
    return _learned_case(rng, ev, diagram, solve, p, names, "drag", ts, "a learned force on a pendulum")


def _learned_case(rng, ev, diagram, solve, p: np.ndarray, names: list[str], network: str, ts, note: str) -> Case:
    """The case of a system whose solution by `solve(p)` depends on parameters, named, and a network's weights."""
    values = solve(p)
    allowed = {n: ALLOWED * max(float(np.max(np.abs(v))), 0.1) for n, v in values.items()}
    motion = Motion(ts, values, allowed, 1e-9, 1e-11)
    chosen = [list(values)[k] for k in rng.permutation(len(values))[:3]]

    def derivatives(weights):
        all_of_them = _by_complex_steps(solve, p, weights)
        return dict(zip(names, all_of_them[: len(names)], strict=True)), {}, {network: all_of_them[len(names) :]}

    sizes = {n: max(abs(float(v)), 0.1) for n, v in zip(names, p, strict=False)}
    slopes = _slopes(rng, motion, chosen, derivatives, sizes)
    return Case(ev, diagram, {}, {}, motion=motion, slopes=slopes, always_moves=True, note=note)
