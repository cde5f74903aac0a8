"""How compiling scales: an RC ladder, a thermal grid, and a chain of masses with rigid rods.

For each size: building the model, compiling it, XLA's part and the first solve, the steady solve, peak memory; then the
growth exponent of the compile time, fitted over the larger sizes. Each size runs in a process of its own. The ladder's
end voltage is compared with a SciPy solution of the same network.

    python benchmarks/ladder.py            # n = 10 … 20,000, grid 100 × 100, chain of 300
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
RTOL = 1e-6
END = 10.0


def ladder(n: int):
    """A source of 1 V, n resistors of 1 Ω in series, a capacitor of 1 F to ground behind each."""
    from jaxonomy_dae import AcausalDiagram, EqnEnv
    from jaxonomy_dae.library.electrical import Capacitor, Ground, Resistor, VoltageSource

    ev, diagram = EqnEnv(), AcausalDiagram()
    source, ground = VoltageSource(ev, "source", v=1.0), Ground(ev, "ground")
    diagram.connect(source.n, ground.p)
    before = source.p
    for k in range(n):
        r, c = Resistor(ev, f"r{k}"), Capacitor(ev, f"c{k}", initial_voltage=0.0)
        diagram.connect(before, r.p)
        diagram.connect(r.n, c.p)
        diagram.connect(c.n, ground.p)
        before = r.n
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
        link = Rod(ev, f"link{k}", length=1.0) if rigid else Spring(ev, f"link{k}", K=100.0, length=1.0)
        diagram.connect(before, link.flange_a)
        diagram.connect(link.flange_b, mass.flange)
        before = mass.flange
    return ev, diagram


def reference(n: int) -> np.ndarray:
    """The ladder's capacitor voltages at the end, by SciPy's Radau with a sparse Jacobian."""
    import scipy.integrate
    import scipy.sparse as sp

    main = np.full(n, -2.0)
    main[-1] = -1.0
    a = sp.diags_array([np.ones(n - 1), main, np.ones(n - 1)], offsets=[-1, 0, 1], format="csc")
    b = np.zeros(n)
    b[0] = 1.0
    found = scipy.integrate.solve_ivp(
        lambda t, v: a @ v + b, (0.0, END), np.zeros(n), method="Radau", jac=a, rtol=1e-8, atol=1e-11
    )
    return found.y[:, -1]


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

    ev, diagram = lap("build", lambda: {"ladder": ladder, "grid": grid, "chain": chain}[kind](n))
    system = lap("compile", AcausalCompiler(ev, diagram))
    end = END if kind == "ladder" else 1.0

    def solve():
        solution = simulate(system, t1=end, ts=jnp.array([end]), rtol=RTOL)
        solution.states.block_until_ready()
        return solution

    solution = lap("first", solve)
    out["steady"] = min((lap("steady", solve), out["steady"])[1] for _ in range(3))
    out["equations"] = system.report.n_equations
    out["index"] = system.report.index
    out["steps"] = solution.stats["num_steps"]
    out["memory"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    if kind == "ladder":
        voltages = np.array([solution[f"c{k}.v"][0] for k in {0, n // 2, n - 1}])
        out["error"] = float(np.max(np.abs(voltages - reference(n)[list({0, n // 2, n - 1})])))
    return out


def main(sizes):
    head = f"{'model':>14s}{'equations':>11s}{'index':>6s}{'build':>8s}{'compile':>9s}{'XLA+first':>11s}{'total':>8s}"
    print(head + f"{'steady':>11s}{'steps':>7s}{'memory':>10s}{'error':>10s}")
    rows = []
    for kind, n in [("ladder", n) for n in sizes] + [("grid", 100), ("chain", 300)]:
        command = [sys.executable, str(Path(__file__)), "--one", kind, str(n)]
        row = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()[-1])
        total = row["build"] + row["compile"] + row["first"]
        error = f"{row['error']:10.1e}" if "error" in row else ""
        name = f"{kind} {n}"
        print(
            f"{name:>14s}{row['equations']:11d}{row['index']:6d}{row['build']:7.2f}s{row['compile']:8.2f}s"
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
