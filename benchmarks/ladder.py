"""How compiling scales: an RC ladder, a thermal grid, a chain of masses with rigid rods, a grid of resistors with a few
capacitors (one linear block), and a cascade of filters (a chain of assignments).

For each size: building the model, compiling it, XLA's part and the first solve, the steady solve, peak memory; then the
growth exponent of the compile time, fitted over the larger sizes. Each size runs in a process of its own. The ladder's
end voltage is compared with a SciPy solution of the same network, the grid's first currents with a sparse nodal
analysis in SciPy, the cascade's first slopes with the recursion they are.

    python benchmarks/ladder.py            # n = 10 … 20,000, grid 100 × 100, chain of 300, resistors 60 × 60, cascades
    python benchmarks/ladder.py 10 100     # other sizes of the ladder
"""

import json
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

SIZES = (10, 100, 1000, 4000, 9000, 20000)
OTHERS = [
    ("array", 1000),
    ("array", 20000),
    ("array", 100000),
    ("grid", 100),
    ("chain", 300),
    ("resistors", 60),
    ("cascade", 100),
    ("cascade", 1000),
    ("cascade", 10000),
]
RTOL = 1e-6
END = 10.0


def ladder(n: int):
    """A source of 1 V, n resistors of 1 Ω in series, a capacitor of 1 F to ground behind each."""
    from jaxonomy_dae import AcausalDiagram, EqnEnv
    from jaxonomy_dae.library.electrical import Capacitor, Ground, Resistor, VoltageSource

    ev, diagram = EqnEnv(), AcausalDiagram()
    source, ground = VoltageSource(ev, "source", V=1.0), Ground(ev, "ground")
    diagram.connect(source.n, ground.p)
    before = source.p
    for k in range(n):
        r, c = Resistor(ev, f"r{k}"), Capacitor(ev, f"c{k}", initial_voltage=0.0)
        diagram.connect(before, r.p)
        diagram.connect(r.n, c.p)
        diagram.connect(c.n, ground.p)
        before = r.n
    return ev, diagram


def array(n: int):
    """The same ladder from two arrays of components."""
    from jaxonomy_dae import AcausalDiagram, EqnEnv
    from jaxonomy_dae.library.electrical import Capacitor, Ground, Resistor, VoltageSource

    ev, diagram = EqnEnv(), AcausalDiagram()
    source, ground = VoltageSource(ev, "source", V=1.0), Ground(ev, "ground")
    r = diagram.add_array(ev, "r", Resistor, n)
    c = diagram.add_array(ev, "c", Capacitor, n, initial_voltage=0.0)
    diagram.connect(source.p, r[0].p)
    diagram.connect(r[:-1].n, r[1:].p)
    diagram.connect(r.n, c.p)
    diagram.connect(c.n, ground.p)
    diagram.connect(source.n, ground.p)
    return ev, diagram


def grid(n: int):
    """n × n heat capacitors, neighbours joined by conductors, rows at different temperatures."""
    from jaxonomy_dae import AcausalDiagram, EqnEnv
    from jaxonomy_dae.library.thermal import HeatCapacitor, ThermalConductor

    ev, diagram = EqnEnv(), AcausalDiagram()
    c = [[HeatCapacitor(ev, f"c{i}_{j}", initial_temperature=300.0 + i) for j in range(n)] for i in range(n)]
    for i in range(n):
        for j in range(n):
            for name, k, m in (("down", i + 1, j), ("right", i, j + 1)):
                if k < n and m < n:
                    g = ThermalConductor(ev, f"{name}{i}_{j}")
                    diagram.connect(c[i][j].heat, g.port_a)
                    diagram.connect(g.port_b, c[k][m].heat)
    return ev, diagram


def chain(n: int):
    """n masses from a wall, every third link a rigid rod, the others springs: index 3."""
    from jaxonomy_dae import AcausalDiagram, EqnEnv
    from jaxonomy_dae.library.translational import FixedPosition, Mass, Rod, Spring

    ev, diagram = EqnEnv(), AcausalDiagram()
    before = FixedPosition(ev, "wall").flange
    for k in range(n):
        rigid = k % 3 == 2
        start = {} if rigid else {"initial_position": k + 1.0 + 0.1 * (k % 3 == 0), "initial_velocity": 0.0}
        mass = Mass(ev, f"m{k}", **start)
        link = Rod(ev, f"link{k}", length=1.0) if rigid else Spring(ev, f"link{k}", c=100.0, length=1.0)
        diagram.connect(before, link.flange_a)
        diagram.connect(link.flange_b, mass.flange)
        before = mass.flange
    return ev, diagram


def resistors(n: int):
    """n × n nodes, neighbours joined by resistors, 1 V at one corner, ground at the other, capacitors at 4 nodes."""
    from jaxonomy_dae import AcausalDiagram, EqnEnv
    from jaxonomy_dae.library.electrical import Capacitor, Ground, Resistor, VoltageSource

    ev, diagram = EqnEnv(), AcausalDiagram()
    source, ground = VoltageSource(ev, "source"), Ground(ev, "ground")
    pins = [[] for _ in range(n * n)]
    for k, (a, b, R) in enumerate(zip(*edges(n), strict=True)):
        r = Resistor(ev, f"r{k}", float(R))
        pins[a].append(r.p)
        pins[b].append(r.n)
    pins[0].append(source.p)
    pins[-1].append(ground.p)
    for k, node in enumerate(stored(n)):
        c = Capacitor(ev, f"c{k}", initial_voltage=0.1 * k)
        pins[node].append(c.p)
        pins[-1].append(c.n)
    pins[-1].append(source.n)
    for node in pins:
        diagram.connect(*node)
    return ev, diagram


def edges(n: int):
    """(from, to, resistance) of the grid's resistors."""
    number = np.arange(n * n).reshape(n, n)
    a = np.concatenate([number[1:].ravel(), number[:, 1:].ravel()])
    b = np.concatenate([number[:-1].ravel(), number[:, :-1].ravel()])
    return a, b, 1.0 + 0.5 * np.sin(np.arange(len(a)))


def stored(n: int) -> list[int]:
    """The nodes with capacitors."""
    return [k * n + k for k in (n // 5, 2 * n // 5, 3 * n // 5, 4 * n // 5)]


def currents(n: int) -> np.ndarray:
    """The capacitors' first currents, by nodal analysis."""
    import scipy.sparse as sp

    a, b, R = edges(n)
    k = np.arange(len(a))
    difference = sp.coo_array(
        (np.repeat([1.0, -1.0], len(a)), (np.tile(k, 2), np.concatenate([a, b]))), shape=(len(a), n * n)
    ).tocsc()
    matrix = (difference.T @ sp.diags_array(1 / R) @ difference).tocsc()
    known = np.array([0, *stored(n), n * n - 1])
    free = np.setdiff1d(np.arange(n * n), known)
    v = np.zeros(n * n)
    v[known] = [1.0, 0.0, 0.1, 0.2, 0.3, 0.0]
    start = time.perf_counter()
    v[free] = -sp.linalg.spsolve(matrix[:, free][free], matrix[:, known][free] @ v[known])
    print(f"SciPy's solve of the nodes' voltages: {1e3 * (time.perf_counter() - start):.1f} ms", file=sys.stderr)
    return -(matrix @ v)[stored(n)]


def cascade(n: int):
    """n filters in series, der(x) = u − x, whose input u reaches their output y = a·u + b·x at once."""
    from jaxonomy_dae import AcausalDiagram, Component, EqnEnv, der

    class Filter(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            a, b = self.parameter("a", 0.9), self.parameter("b", 0.2)
            u, y, x = self.variable("u"), self.variable("y"), self.variable("x", start=0.1, fixed=True)
            self.add_equations(der(x) - (u - x), y - a * u - b * x)

    class Cascade(Component):
        def __init__(self, ev, name):
            super().__init__(ev, name)
            parts = [self.add(Filter(ev, f"f{k}")) for k in range(n)]
            self.add_equations(parts[0].u - 1)
            for before, after in zip(parts, parts[1:], strict=False):
                self.add_equations(after.u - before.y)

    ev, diagram = EqnEnv(), AcausalDiagram()
    diagram.add(Cascade(ev, "cascade"))
    return ev, diagram


def recursion(n: int) -> np.ndarray:
    """The cascade's first slopes."""
    u, out = 1.0, []
    for _ in range(n):
        out.append(u - 0.1)
        u = 0.9 * u + 0.2 * 0.1
    return np.array(out)


MODELS = {"ladder": ladder, "array": array, "grid": grid, "chain": chain, "resistors": resistors, "cascade": cascade}


def reference(n: int) -> np.ndarray:
    """The voltages of the first, the middle and the last capacitor at the end, by SciPy's Radau with a sparse Jacobian.
    Until then a voltage spreads over some ten cells, so that a long ladder needs no longer reference."""
    import scipy.integrate
    import scipy.sparse as sp

    n = min(n, 20_000)
    main = np.full(n, -2.0)
    main[-1] = -1.0
    a = sp.diags_array([np.ones(n - 1), main, np.ones(n - 1)], offsets=[-1, 0, 1], format="csc")
    b = np.zeros(n)
    b[0] = 1.0
    found = scipy.integrate.solve_ivp(
        lambda t, v: a @ v + b, (0.0, END), np.zeros(n), method="Radau", jac=a, rtol=1e-8, atol=1e-11
    )
    return found.y[[0, n // 2, n - 1], -1]


def measure(kind: str, n: int) -> dict:
    start = time.perf_counter()
    import jax

    jax.config.update("jax_enable_x64", True)
    import jax.numpy as jnp

    from jaxonomy_dae import AcausalCompiler, simulate

    out = {"kind": kind, "n": n, "import": time.perf_counter() - start}

    def lap(name: str, function):
        begin = time.perf_counter()
        value = function()
        out[name] = time.perf_counter() - begin
        return value

    begun = time.process_time()
    ev, diagram = lap("build", lambda: MODELS[kind](n))
    system = lap("compile", AcausalCompiler(ev, diagram))
    end = END if kind in ("ladder", "array") else 1.0

    def solve():
        solution = simulate(system, t1=end, ts=jnp.array([end]), rtol=RTOL)
        solution.states.block_until_ready()
        return solution

    solution = lap("first", solve)
    out["cpu"] = time.process_time() - begun
    out["steady"] = min((lap("steady", solve), out["steady"])[1] for _ in range(3))
    out["equations"] = system.report.n_equations
    out["index"] = system.report.index
    out["steps"] = solution.stats["num_steps"]
    out["memory"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    if kind in ("ladder", "array"):
        nodes = [0, n // 2, n - 1]
        names = [f"c{k}.v" if kind == "ladder" else f"c[{k}].v" for k in nodes]
        voltages = np.array([solution[name][0] for name in names])
        out["error"] = float(np.max(np.abs(voltages - reference(n))))
    if kind == "resistors":
        found = system.observe([f"c{k}.i" for k in range(4)], 0.0, system.initialize())
        out["error"] = float(np.max(np.abs(found - currents(n))))
    if kind == "cascade":
        found = np.sort(system.vector_field(0.0, system.initialize()))
        out["error"] = float(np.max(np.abs(found - np.sort(recursion(n)))))
    return out


def main(sizes):
    head = f"{'model':>15s}{'equations':>11s}{'index':>6s}{'build':>8s}{'compile':>9s}{'XLA+first':>11s}{'total':>8s}"
    print(head + f"{'steady':>11s}{'steps':>7s}{'memory':>10s}{'error':>10s}")
    rows = []
    for kind, n in [("ladder", n) for n in sizes] + OTHERS:
        command = [sys.executable, str(Path(__file__)), "--one", kind, str(n)]
        row = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()[-1])
        total = row["build"] + row["compile"] + row["first"]
        error = f"{row['error']:10.1e}" if "error" in row else ""
        name = f"{kind} {n}"
        print(
            f"{name:>15s}{row['equations']:11d}{row['index']:6d}{row['build']:7.2f}s{row['compile']:8.2f}s"
            f"{row['first']:10.2f}s{total:7.2f}s{1e3 * row['steady']:9.2f}ms{row['steps']:7d}"
            f"{row['memory']:8.0f}MB{error}",
            flush=True,
        )
        rows.append(row)
    large = [r for r in rows if r["kind"] == "ladder" and r["n"] >= 1000]
    if len(large) > 1:
        slope = np.polyfit(np.log([r["n"] for r in large]), np.log([r["build"] + r["compile"] for r in large]), 1)[0]
        print(f"growth exponent of building and compiling, n ≥ 1000: {slope:.2f}")


if __name__ == "__main__":
    if "--one" in sys.argv:
        place = sys.argv.index("--one")
        print(json.dumps(measure(sys.argv[place + 1], int(sys.argv[place + 2]))))
    else:
        main([int(a) for a in sys.argv[1:]] or SIZES)
