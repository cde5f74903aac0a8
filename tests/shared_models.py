"""Models that several test files compile, each in its own way."""

import dataclasses

import numpy as np
import scipy.linalg
import scipy.sparse as sp
import sympy
from problems import FreeMass, compiled, component, drag_on, mlp, oscillator, pendulum, rc_circuit
from sympy import Abs, Eq

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, Component, Electrical, EqnEnv, der
from jaxonomy_dae.library.electrical import Capacitor, Ground, Inductor, Resistor, VoltageSource


class Filter(Component):
    """der(x) = u − x, y = a·law(u) + b·x: a filter whose input reaches its output at once."""

    def __init__(self, ev, name, a, b, law):
        super().__init__(ev, name)
        a, b = self.parameter("a", a), self.parameter("b", b)
        u, y = self.variable("u"), self.variable("y")
        x = self.variable("x", start=0.1, fixed=True)
        self.add_equations(der(x) - (u - x), y - a * law(u) - b * x)


class Cascade(Component):
    """n filters in series; the first is fed 1 + sin t."""

    def __init__(self, ev, name, n, law):
        super().__init__(ev, name)
        parts = [self.add(Filter(ev, f"f{k}", gain(k), 0.2, law)) for k in range(n)]
        self.add_equations(parts[0].u - sympy.sin(ev.t) - 1)
        for before, after in zip(parts, parts[1:], strict=False):
            self.add_equations(after.u - before.y)


def gain(k):
    return float(0.9 + 0.05 * np.sin(k))


def cascade(n, law=lambda u: u):
    return compiled(Cascade(EqnEnv(), "c", n, law))


class Varistor(Component):
    """i = G·(v + a·v³): a conductance that grows with the voltage."""

    def __init__(self, ev, name, G=1.0, a=0.5):
        super().__init__(ev, name)
        G, a = self.parameter("G", G), self.parameter("a", a)
        p, n = self.port("p", Electrical), self.port("n", Electrical)
        v, i = self.variable("v"), self.variable("i")
        self.add_equations(v - (p.v - n.v), i - p.i, p.i + n.i, i - G * (v + a * v**3))


class Grid:
    """n × n nodes, neighbours joined by random conductances; a source of 1 V at one corner, 1 Ω to ground at the other,
    and capacitors at some nodes. `cubic` makes the conductances nonlinear."""

    def __init__(self, n: int, *, capacitors: int = 3, cubic: float = 0.0, law=Varistor, seed: int = 0):
        rng = np.random.default_rng(seed)
        number = np.arange(n * n).reshape(n, n)
        self.edges = np.concatenate(
            [
                np.stack([number[1:].ravel(), number[:-1].ravel()]),
                np.stack([number[:, 1:].ravel(), number[:, :-1].ravel()]),
            ],
            axis=1,
        ).T
        self.G = rng.uniform(0.5, 2.0, len(self.edges))
        self.n_nodes, self.cubic, self.law = n * n, cubic, law
        self.stored = rng.choice(np.arange(1, n * n - 1), capacitors, replace=False)
        self.v0 = rng.uniform(0.0, 1.0, capacitors)

    def system(self):
        ev = EqnEnv()
        source, ground, end = VoltageSource(ev, "source", 1.0), Ground(ev, "ground"), Resistor(ev, "end", 1.0)
        pins = [[] for _ in range(self.n_nodes)]
        parts = [source, ground, end]
        for k, ((a, b), G) in enumerate(zip(self.edges.tolist(), self.G.tolist(), strict=True)):
            part = self.law(ev, f"r{k}", G, self.cubic) if self.cubic else Resistor(ev, f"r{k}", 1 / G)
            parts.append(part)
            pins[a].append(part.p)
            pins[b].append(part.n)
        low = [ground.p, source.n, end.n]
        pins[0].append(source.p)
        pins[-1].append(end.p)
        for k, (node, v0) in enumerate(zip(self.stored.tolist(), self.v0.tolist(), strict=True)):
            part = Capacitor(ev, f"c{k}", 1.0, initial_voltage=v0)
            parts.append(part)
            pins[node].append(part.p)
            low.append(part.n)
        return compiled(*parts, connect=[low, *pins])

    def reference(self) -> np.ndarray:
        """The capacitors' currents at the start, by Newton's method on the nodes' balances with a sparse Jacobian."""
        known = np.concatenate([[0], self.stored])
        free = np.setdiff1d(np.arange(self.n_nodes), known)
        v = np.zeros(self.n_nodes)
        v[known] = [1.0, *self.v0]
        a, b = self.edges.T
        difference = sp.coo_array(
            (np.repeat([1.0, -1.0], len(a)), (np.tile(np.arange(len(a)), 2), np.concatenate([a, b]))),
            shape=(len(a), self.n_nodes),
        ).tocsc()
        drain = np.zeros(self.n_nodes)
        drain[-1] = 1.0
        for _ in range(30):
            u = difference @ v
            balance = difference.T @ (self.G * (u + self.cubic * u**3)) + drain * v
            matrix = difference.T @ sp.diags_array(self.G * (1 + 3 * self.cubic * u**2)) @ difference
            matrix = (matrix + sp.diags_array(drain)).tocsc()[:, free][free]
            v[free] -= sp.linalg.spsolve(matrix, balance[free])
        return -balance[self.stored]


class Implicit(Component):
    """Two algebraic unknowns given implicitly, one by the other, and a state that follows them."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        x, y = self.variable("x", start=0.5, fixed=True), self.variable("y", start=0.2, fixed=True)
        z, w = self.variable("z", start=0.5), self.variable("w", start=0.3)
        self.add_equations(der(x) + z, der(y) + w + 2 * y, z + 0.1 * z**3 - x, w + 0.2 * w**5 - z * y)


def network_on_a_row():
    return pendulum(
        drag_on("vx", network=mlp(1, 1), inject="row"),
        compiler={"state_selection": "dummy_derivatives", "prefer_states": ["pend.x", "pend.vx"]},
    )


# What the Jacobian and its pattern are checked with.
MODELS = {
    "circuit": rc_circuit,
    "oscillator": oscillator,
    "pendulum": pendulum,
    "pendulum, minimal": lambda: pendulum(compiler={"state_selection": "dummy_derivatives"}),
    "network": lambda: pendulum(drag_on("vx", "vy", network=mlp(2, 2))),
    "network on a row": network_on_a_row,
    "implicit": lambda: compiled(Implicit(EqnEnv(), "c")),
    "cascade": lambda: cascade(12),
    "grid": lambda: Grid(6).system(),
    "nonlinear grid": lambda: Grid(7, cubic=0.5).system(),
}


def attenuator(n, rs=1.0, rp=1.0):
    """n sections of the library's resistors between a source of 1 V and a capacitor at 0 V."""
    ev, diagram = EqnEnv(), AcausalDiagram()
    source, ground, end = VoltageSource(ev, "V", V=1.0), Ground(ev, "G"), Capacitor(ev, "C", initial_voltage=0.0)
    low, at = [source.n, ground.p, end.n], source.p
    for k in range(n):
        s, p = Resistor(ev, f"s{k}", R=rs), Resistor(ev, f"p{k}", R=rp)
        diagram.connect(at, s.p)
        diagram.connect(s.n, p.p)
        low.append(p.n)
        at = s.n
    last = Resistor(ev, "last", R=rs)
    diagram.connect(at, last.p)
    diagram.connect(last.n, end.p)
    diagram.connect(*low)
    return AcausalCompiler(ev, diagram)()


class Levers(Component):
    """Two rigid couplings of three carriages, written in units `u` of length and with equations multiplied by `k`."""

    def __init__(self, ev, name, k=1.0, u=1.0, order=(0, 1)):
        super().__init__(ev, name)
        x = [self.variable(f"x{i}", start=s * u, nominal=u) for i, s in enumerate((0.3, 0.6, 1.5))]
        v = [self.variable(f"v{i}", nominal=u) for i in range(3)]
        f = [self.variable(f"f{i}", nominal=u) for i in range(2)]
        self.add_equations(*(der(a) - b for a, b in zip(x, v, strict=True)))
        self.add_equations(der(v[0]) + x[0] - 2 * f[0], der(v[1]) + f[0] - 5 * f[1], der(v[2]) + f[1])
        a, b = self.parameter("a", 2.0), self.parameter("b", 2.5)
        constraints = [k * (a * x[0] - x[1]), k * (2 * b * x[1] - 2 * x[2])]
        self.add_equations(*(constraints[i] for i in order))


def levers(mode, **options):
    ev = EqnEnv()
    diagram = AcausalDiagram()
    diagram.add(Levers(ev, "c", **options))
    return AcausalCompiler(ev, diagram, state_selection=mode)()


def ladder(names=None, stages=3):
    """A filter of stages with an inductor, a resistor and two parallel capacitors each."""
    plain = ["source", "ground", *(f"{kind}{k}" for k in range(stages) for kind in ("l", "r", "c", "d"))]
    name = dict(zip(plain, names or plain, strict=True))
    ev = EqnEnv()
    source, ground = VoltageSource(ev, name["source"], 2.0), Ground(ev, name["ground"])
    parts, connect, above = [source, ground], [(source.n, ground.p)], source.p
    for k in range(stages):
        coil = Inductor(ev, name[f"l{k}"], 0.1 + k)
        r, c, d = Resistor(ev, name[f"r{k}"], 1.0 + k), Capacitor(ev, name[f"c{k}"], 0.5), Capacitor(ev, name[f"d{k}"])
        parts += [coil, r, c, d]
        connect += [(above, coil.p), (coil.n, r.p), (r.n, c.p, d.p), (c.n, d.n, ground.p)]
        above = r.n
    return compiled(*parts, connect=connect)


class LearnedResistor(Component):
    """Between two pins: v = network(i), or i = network(v)."""

    def __init__(self, ev, name, network, gives):
        super().__init__(ev, name)
        p, n = self.port("p", Electrical), self.port("n", Electrical)
        v, i = self.variable("v"), self.variable("i")
        self.add_equations(Eq(v, p.v - n.v), Eq(i, p.i), Eq(p.i + n.i, 0))
        (law,) = self.learned("law", network, inputs=[i if gives == "v" else v])
        self.add_equations(Eq(v if gives == "v" else i, law))


def discharge(network, gives, v0=1.0, C=0.5):
    ev = EqnEnv()
    c, r, g = Capacitor(ev, "c", C, initial_voltage=v0), LearnedResistor(ev, "r", network, gives), Ground(ev, "g")
    return compiled(c, r, g, connect=[(c.p, r.p), (c.n, r.n, g.p)])


class Moved(Component):
    """A mass whose position is an input: the force follows from differentiating the input twice."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        m = self.parameter("m", 2.0)
        u = self.input("u")
        x, v, f = self.variable("x"), self.variable("v"), self.variable("f")
        self.add_equations(Eq(x, u), Eq(der(x), v), Eq(m * der(v), f))


class Squares(Component):
    """der of expressions: der(x²) = −2x², der(x·y) = 0, der(p·z + t) = 0."""

    def __init__(self, ev, name):
        super().__init__(ev, name)
        p = self.parameter("p", 4.0)
        x = self.variable("x", start=2, fixed=True)
        y = self.variable("y", start=3, fixed=True)
        z = self.variable("z", start=1, fixed=True)
        self.add_equations(Eq(der(x**2), -2 * x**2), Eq(der(x * y), 0), Eq(der(p * z + ev.t), 0))


T = sympy.Symbol("t")


@dataclasses.dataclass(frozen=True)
class Pencil:
    """A DAE in Weierstrass form and the matrices that mix it; all entries are small integers."""

    j: tuple  # rows of J
    blocks: tuple  # sizes of the nilpotent blocks
    g: tuple  # (a, b) of a·sin t + b·t, one for each z
    left: tuple  # P
    right: tuple  # Q
    rows: tuple  # the order in which equations are written
    columns: tuple  # the order in which variables are declared

    @property
    def n(self):
        return len(self.left)

    @property
    def dynamic(self):
        return len(self.j)

    @property
    def nilpotent(self):
        size = sum(self.blocks)
        out = np.zeros((size, size), int)
        start = 0
        for k in self.blocks:
            for i in range(start, start + k - 1):
                out[i, i + 1] = 1
            start += k
        return out

    def forcing(self):
        """g as SymPy expressions in T."""
        return [a * sympy.sin(T) + b * T for a, b in self.g]

    def solution(self, times, x0):
        """y and y' at the times, each of shape (times, n)."""
        z, dz = [], []
        terms, power, g = [0] * len(self.g), np.eye(len(self.g), dtype=int), self.forcing()
        for _ in range(max(self.blocks, default=0)):
            terms = [
                t - sum(int(p) * e for p, e in zip(row, g, strict=True)) for t, row in zip(terms, power, strict=True)
            ]
            g = [sympy.diff(e, T) for e in g]
            power = power @ self.nilpotent
        for t in times:
            z.append([float(sympy.sympify(e).subs(T, t)) for e in terms])
            dz.append([float(sympy.diff(e, T).subs(T, t)) for e in terms])
        j = np.array(self.j, float).reshape(self.dynamic, self.dynamic)
        x = np.array([scipy.linalg.expm(j * t) @ x0 for t in times]).reshape(len(times), self.dynamic)
        q = np.array(self.right, float)
        dx = (j @ x.T).T
        return np.hstack([x, np.array(z).reshape(len(times), -1)]) @ q.T, np.hstack(
            [dx, np.array(dz).reshape(len(times), -1)]
        ) @ q.T


def written(pencil: Pencil, name="dae", variables=None) -> Component:
    """The component with the mixed equations; variable k is called variables[k]."""
    names = variables or [f"y{k}" for k in range(pencil.n)]
    d = pencil.dynamic
    unmixed_e = scipy.linalg.block_diag(np.eye(d, dtype=int), pencil.nilpotent).reshape(pencil.n, pencil.n)
    unmixed_a = scipy.linalg.block_diag(np.array(pencil.j, int).reshape(d, d), np.eye(pencil.n - d, dtype=int))
    back = sympy.Matrix(pencil.right).inv()
    e = sympy.Matrix(pencil.left) * sympy.Matrix(unmixed_e.astype(int)) * back
    a = sympy.Matrix(pencil.left) * sympy.Matrix(unmixed_a.reshape(pencil.n, pencil.n).astype(int)) * back
    f = sympy.Matrix(pencil.left) * sympy.Matrix([0] * d + pencil.forcing())

    class Mixed(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            for k in pencil.columns:
                self.variable(names[k])
            y = [self[n] for n in names]
            for i in pencil.rows:
                left = sum(e[i, k] * der(y[k]) for k in range(pencil.n))
                right = sum(a[i, k] * y[k] for k in range(pencil.n)) + f[i].subs(T, ev.t)
                self.add_equations(Eq(left, right))

    return Mixed(EqnEnv(), name)


# Index 2, two modes, mixed by products of unit triangular matrices.
MIXED = Pencil(
    ((0, 1), (-1, -1)), (2,), ((1, 1), (1, -1)),
    ((1, 1, -1, 1), (1, 2, 0, 0), (-1, 0, 3, -1), (1, 0, -1, 4)),
    ((1, 2, 0, 0), (1, 1, -1, 1), (1, 0, -1, 4), (-1, 0, 3, -1)),
    (0, 1, 2, 3), (0, 1, 2, 3),
)  # fmt: skip


def triangle(unit, nominal, y=2.0):
    """y = 2x by way of z, beside a pressure of 1e7: x = u, y = 3u contradict each other whatever u."""

    def write(self, _):
        size = {"nominal": unit} if nominal else {}
        p = self.variable("p", start=1e7, fixed=True)
        x = self.variable("x", start=unit, fixed=True, **size)
        y_ = self.variable("y", start=y * unit, fixed=True, **size)
        z = self.variable("z", **size)
        self.add_equations(Eq(der(p), -p), Eq(x + y_, z), Eq(der(x), -x), Eq(z, self.parameter("k", 3.0) * x))

    return compiled(component(write))


def cubic_of(k, nominal=False):
    """k·(z³ − x) = 0."""

    def write(self, _):
        x = self.variable("x", start=0.5, fixed=True)
        z = self.variable("z", start=0.8, **({"nominal": 1.0} if nominal else {}))
        self.add_equations(Eq(der(x), -x), Eq(k * (z**3 - x), 0))

    return write


def scaled_cubic(k, nominal):
    return compiled(component(cubic_of(k, nominal)))


def charge_of(c0):
    """A nonlinear capacitor, q = C0·(1 + v²)·v, with q = 2·C0: v = 1."""

    def write(self, _):
        q, v = self.variable("q", start=2 * c0, fixed=True), self.variable("v", start=0.3)
        self.add_equations(Eq(c0 * (1 + v**2) * v, q), Eq(der(q), -v * c0 / 1e-6))

    return write


def charge(c0):
    return compiled(component(charge_of(c0)))


def orifices_of(pascal, flow):
    """Two orifices in series from 200 bar to 1 bar: the pressure between is the mean."""

    def write(self, _):
        a = (0.7e-5 * flow) ** 2 / pascal * 2 / 850.0
        p = self.variable("p", start=2e7 * pascal, fixed=True)
        q, pm = self.variable("q"), self.variable("pm", start=1.2e7 * pascal)
        self.add_equations(
            Eq(q * Abs(q), a * (p - pm)),
            Eq(q * Abs(q), a * (pm - 1e5 * pascal)),
            Eq(der(p), -q * 1.4e12 * pascal / flow),
        )

    return write


def orifices(pascal, flow):
    return compiled(component(orifices_of(pascal, flow)))


class Twice(Component):
    """x' + y' = 1 twice; or x + y = 1 and x + y = 2 beside their motion."""

    def __init__(self, ev, constraint=None):
        super().__init__(ev, "c")
        x, y = self.variable("x"), self.variable("y")
        if constraint is None:
            self.add_equations(der(x) + der(y) - 1, 2 * der(x) + 2 * der(y) - 2)
        else:
            self.add_equations(x + y - constraint, 0.1 * x + 0.1 * y - 0.2 * constraint)


# What is compared with itself in other units.
WITH_NETWORKS = {name: MODELS[name] for name in ("network", "network on a row")} | {
    "learned resistor": lambda: discharge(mlp(1, 1), "i"),
}
WITHOUT_NETWORKS = {name: build for name, build in MODELS.items() if name not in WITH_NETWORKS} | {
    # Its numbers are in every equation: in other units no two nodes are alike, and a program of forty kinds of nodes
    # takes XLA minutes and gigabytes.
    "nonlinear grid": lambda: Grid(4, cubic=0.5).system(),
    "free mass": lambda: oscillator(kind=FreeMass),
    "contradiction": lambda: triangle(1.0, False, y=3.0),
    "triangle": lambda: triangle(1.0, True),
    "cubic": lambda: scaled_cubic(1.0, True),
    "charge": lambda: charge(1.0),
    "orifices": lambda: orifices(1.0, 1.0),
    "attenuator": lambda: attenuator(12, 100.0, 1.0),
    "levers": lambda: levers("dummy_derivatives"),
    "levers, projected": lambda: levers("projection"),
    "ladder": lambda: ladder(stages=4),
    "squares": lambda: compiled(Squares(EqnEnv(), "c")),
    "prescribed motion": lambda: compiled(Moved(EqnEnv(), "c")),
    "dependent equations": lambda: compiled(Twice(EqnEnv())),
    "contradicting constraints": lambda: compiled(Twice(EqnEnv(), constraint=1.0)),
}
