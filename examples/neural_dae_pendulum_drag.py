"""Learning the air drag of a pendulum inside its constrained equations.

A bob hangs on a rigid link, and the model knows everything about it but the drag of the air. A small network stands in
for the missing force, and is trained through the simulation of the constrained equations.

Part A repeats the tutorial "Differentiable acausal DAEs: learning unmodeled drag inside a constrained pendulum" of
Jaxonomy and prints its published figures beside those computed here. There the correction is added to the finished
right-hand side of one state (`inject="row"`).

Part B makes the drag a force on the bob, with both components, that the link answers (`inject="equation"`), and learns
it from noisy positions along full swings.

Run it with `make demo`; figures go to `examples/output/`.
"""

import time
from pathlib import Path

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import optax
from jax.flatten_util import ravel_pytree

from jaxonomy_dae import AcausalCompiler, AcausalDiagram, EqnEnv, NeuralDAEBlock, learning, simulate
from jaxonomy_dae.library.planar import PlanarPendulum

jax.config.update("jax_enable_x64", True)
matplotlib.use("Agg")

OUTPUT = Path(__file__).parent / "output"

MASS, LENGTH, GRAVITY = 1.0, 1.0, 9.81  # kg, m, m/s²
DRAG = 0.5  # 1/m: the coefficient to be found, per mass
DURATION = 6.0  # s
HORIZONS = jnp.array([0.5, 1.0, 1.5])  # s: all that the tutorial's loss sees
TIMES = jnp.sort(jnp.concatenate([jnp.linspace(0.0, DURATION, 400), HORIZONS]))
AT_HORIZONS = np.searchsorted(TIMES, HORIZONS)
EVENLY = np.setdiff1d(np.arange(len(TIMES)), AT_HORIZONS)

# What the tutorial prints. Its pairs are headed (x, y) there; they are the states (vx, x).
TUTORIAL = {
    "states": np.array([[-1.03427, 0.02632], [-0.03996, -0.29260], [0.84903, -0.02937]]),
    "loss": {0: 4.967455e-2, 5: 5.814689e-4, 10: 8.623484e-3, 15: 1.846313e-4, 20: 3.075208e-3, 25: 2.064372e-4},
    "gradient": 5.166805e-1,
    "gradient_seconds": 7.2,
    "fit_minutes": 3.0,
    "angle": {"no drag": 0.1088, "learned": 0.0118, "ratio": 9.2},
    "energy": 1.69e-5,
    "constraint": {"no drag": 1.68e-14, "truth": 1.01e-14},
    "band": (-1.03, 0.84),
    "law": {"inside": 0.0732, "outside": 1.3510},
}


# --- the pendulum ------------------------------------------------------------------------------------------------


def pendulum(release, correction=None, theta=None, *, targets=("vx", "vy"), inject="equation", **selection):
    """Compiles the pendulum, released from rest, with or without a correction of its accelerations."""
    ev, diagram = EqnEnv(), AcausalDiagram()
    bob = PlanarPendulum(ev, name="pend", m=MASS, L=LENGTH, g_y=-GRAVITY, initial_theta=release)
    diagram.add(bob)
    if correction is not None:
        diagram.add_neural_correction_block(
            NeuralDAEBlock(correction, theta, targets=[(bob, v) for v in targets], name="drag", inject=inject)
        )
    return AcausalCompiler(ev, diagram, **selection)()


def follow(system, ts=TIMES, rtol=1e-8, atol=1e-10):
    return simulate(system, ts[-1], ts=ts, rtol=rtol, atol=atol)


def angle(solution):
    """The angle from the +x axis, without jumps."""
    return np.unwrap(np.arctan2(solution["pend.y"], solution["pend.x"]))


def speed(v):
    """|v|, with a derivative that stays finite at rest."""
    square = jnp.sum(v**2)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)


def energy(solution):
    vx, vy, y = (np.asarray(solution[f"pend.{name}"]) for name in ("vx", "vy", "y"))
    return MASS * (0.5 * (vx**2 + vy**2) + GRAVITY * y)


def tension(solution):
    """What the link pulls with: its multiplier times the length of the constraint's gradient."""
    return 2 * LENGTH * np.asarray(solution["pend.lam"])


def angle_equation(release, force, ts):
    """The same pendulum written as one angle: no constraint, and nothing in common with the compiled models.

    `force` is a force per mass, `(vx, vy)` to `(ax, ay)`. Returns variables by the names that a solution has.
    """

    def parts(state):
        theta, omega = state
        radial = jnp.array([jnp.cos(theta), jnp.sin(theta)])
        tangent = jnp.array([-radial[1], radial[0]])
        v = LENGTH * omega * tangent
        return radial, tangent, v, force(v) - jnp.array([0.0, GRAVITY])

    def field(t, state, args):
        _, tangent, _, acceleration = parts(state)
        return jnp.array([state[1], acceleration @ tangent / LENGTH])

    def observe(t, state, args):
        radial, _, v, acceleration = parts(state)
        pull = MASS * (v @ v / LENGTH + acceleration @ radial)
        x, y = LENGTH * radial
        return {"pend.x": x, "pend.y": y, "pend.vx": v[0], "pend.vy": v[1], "pend.lam": pull / (2 * LENGTH)}

    # Steps end at every time asked for, so that nothing is interpolated.
    controller = diffrax.ClipStepSizeController(diffrax.PIDController(1e-12, 1e-13), step_ts=ts)
    start, saveat = jnp.array([release, 0.0]), diffrax.SaveAt(ts=ts, fn=observe)
    return diffrax.diffeqsolve(
        diffrax.ODETerm(field),
        diffrax.Dopri8(),
        0.0,
        ts[-1],
        1e-3,
        start,
        saveat=saveat,
        stepsize_controller=controller,
    ).ys


def rms(values):
    return float(np.sqrt(np.mean(np.square(np.asarray(values)))))


def largest(values):
    return float(np.max(np.abs(np.asarray(values))))


# --- printing and drawing ----------------------------------------------------------------------------------------


def heading(text):
    print(f"\n{text}\n{'=' * len(text)}")


def table(title, columns, rows):
    """Prints a table; the cells are strings or numbers."""
    cells = [[c if isinstance(c, str) else f"{c:.4g}" for c in row] for row in rows]
    widths = [max(len(line[k]) for line in [columns, *cells]) for k in range(len(columns))]
    lines = [
        "  ".join([line[0].ljust(widths[0]), *(c.rjust(w) for c, w in zip(line[1:], widths[1:], strict=True))])
        for line in [columns, *cells]
    ]
    print(f"\n{title}\n  {lines[0]}\n  {'-' * len(lines[0])}")
    print("\n".join("  " + line for line in lines[1:]))


LOOKS = {
    "no drag": dict(color="0.55", linewidth=1.2),
    "truth": dict(color="C3", linewidth=2.2),
    "learned": dict(color="C0", linewidth=1.6, linestyle="--"),
    "closed form": dict(color="C1", linewidth=1.4, linestyle="-."),
    "samples": dict(color="k", linestyle="none", marker="o", markersize=4.5, markerfacecolor="none"),
    "tutorial": dict(color="C3", linestyle="none", marker="o", markersize=9, markerfacecolor="none"),
    "least": dict(color="0.4", linewidth=1.0, linestyle=":"),
}


def draw(ax, curves, xlabel, ylabel, title, log=False, band=None, **look):
    """Draws curves, `{label: (x, y)}`; the label's beginning, up to a comma, chooses the look."""
    if band is not None:
        ax.axvspan(*band, color="C2", alpha=0.15, label="explored")
    for label, (x, y) in curves.items():
        ax.plot(x, y, label=label, **LOOKS.get(label.split(",")[0], {}) | look)
    ax.set(xlabel=xlabel, ylabel=ylabel, yscale="log" if log else "linear")
    ax.set_title(title, loc="left")
    ax.grid(True, alpha=0.3)
    ax.legend(loc="lower right", bbox_to_anchor=(1.01, 1.0), ncols=5, frameon=False, borderaxespad=0.2,
              columnspacing=1.2, handlelength=1.8)  # fmt: skip


def save(figure, name):
    OUTPUT.mkdir(exist_ok=True)
    figure.savefig(OUTPUT / f"{name}.png", dpi=130)
    plt.close(figure)
    print(f"  figure: {(OUTPUT / name).relative_to(OUTPUT.parents[1])}.png")


# --- part A: the tutorial ----------------------------------------------------------------------------------------

RELEASE = -1.2  # rad
LEARNING_RATE, UPDATES = 0.02, 25
KEPT = 15  # the tutorial goes on with the weights after this update

# Below the pivot (vx, x) is a good pair of states; the tutorial's row injection needs vx to be one.
ROW = dict(targets=["vx"], inject="row", state_selection="dummy_derivatives", prefer_states=["pend.vx", "pend.x"])


def horizontal_drag(t, u, c):
    return -c * u * jnp.abs(u)


def tutorial_network():
    """The tutorial's 1 → 6 → 1 tanh network: its function, and its initial weights as one flat vector."""
    key1, key2 = jax.random.split(jax.random.PRNGKey(0))
    weights = {
        "W1": 0.5 * jax.random.normal(key1, (6, 1)),
        "b1": jnp.zeros(6),
        "W2": 0.1 * jax.random.normal(key2, (1, 6)),
        "b2": jnp.zeros(1),
    }
    theta, unravel = ravel_pytree(weights)

    def network(t, u, theta):
        w = unravel(theta)
        return w["W2"] @ jnp.tanh(w["W1"] @ u + w["b1"]) + w["b2"]

    return network, theta


def states(solution):
    return jnp.stack([solution["pend.vx"], solution["pend.x"]], axis=1)


def tutorial_loss(system, data):
    return jnp.sum((states(follow(system, HORIZONS, rtol=1e-7, atol=1e-9)) - data) ** 2)


@eqx.filter_jit
@eqx.filter_value_and_grad
def loss_and_gradient(trainable, frozen, data):
    return tutorial_loss(eqx.combine(trainable, frozen), data)


def train_by_hand(system, data, updates):
    """Adam in a loop of one's own: a compiled system is a pytree like any other.

    Returns the systems after each update, the first one before any, and their losses. (`learning.minimize` has the
    loop, with bounds and a bar; here the gradient is compiled already.)
    """
    trainable, frozen = system.partition("drag")
    optimizer = optax.adam(LEARNING_RATE)
    state = optimizer.init(trainable)
    iterates, history = [], []
    for _ in range(updates + 1):
        loss, gradient = loss_and_gradient(trainable, frozen, data)
        iterates.append(eqx.combine(trainable, frozen))
        history.append(float(loss))
        changes, state = optimizer.update(gradient, state)
        trainable = eqx.apply_updates(trainable, changes)
    return iterates, history


def seconds(function, *arguments):
    """The result of a call, and how long it took."""
    start = time.perf_counter()
    result = jax.block_until_ready(function(*arguments))
    return result, time.perf_counter() - start


def part_a():
    heading("Part A: the tutorial, correction on the finished row of vx")
    truth = follow(pendulum(RELEASE, horizontal_drag, jnp.array([DRAG]), **ROW))
    data = states(truth)[AT_HORIZONS]
    table(
        "The truth at the three times of the loss",
        ["T / s", "vx, tutorial", "vx, here", "x, tutorial", "x, here"],
        [
            [f"{t:.1f}", f"{theirs[0]:+.5f}", f"{ours[0]:+.8f}", f"{theirs[1]:+.5f}", f"{ours[1]:+.8f}"]
            for t, theirs, ours in zip(HORIZONS, TUTORIAL["states"], np.asarray(data), strict=True)
        ],
    )
    print("  (headed (x, y) in the tutorial; as a position they would lie off the circle)")

    network, theta = tutorial_network()
    model = pendulum(RELEASE, network, theta, **ROW)
    trainable, frozen = model.partition("drag")
    (loss, gradient), first = seconds(loss_and_gradient, trainable, frozen, data)
    steady = min(seconds(loss_and_gradient, trainable, frozen, data)[1] for _ in range(20))
    (iterates, history), fit_time = seconds(train_by_hand, model, data, UPDATES)
    norm = float(jnp.linalg.norm(gradient.neural["drag"]))
    report_training(loss, norm, history)
    table(
        f"Time ({theta.shape[0]} weights)",
        ["", "tutorial, its machine", "here"],
        [
            ["loss and gradient, first call (compiles)", "", f"{first:.1f} s"],
            ["loss and gradient", f"{TUTORIAL['gradient_seconds']} s", f"{1e3 * steady:.2f} ms"],
            [f"{UPDATES} updates, compilation included", f"{TUTORIAL['fit_minutes']} min", f"{first + fit_time:.1f} s"],
        ],
    )
    validate_tutorial(truth, model, iterates, history)
    return truth


def report_training(loss, norm, history):
    # The tutorial prints at step k the loss before the k-th update.
    ours = {k: history[max(k - 1, 0)] for k in TUTORIAL["loss"]}
    rows = [["gradient, initial", TUTORIAL["gradient"], norm], ["loss, initial", TUTORIAL["loss"][0], float(loss)]]
    rows += [[f"loss, step {k}", TUTORIAL["loss"][k], ours[k]] for k in ours if k]
    table(
        "Training with 25 updates of Adam",
        ["", "tutorial", "here", "relative difference"],
        [[name, f"{a:.6e}", f"{b:.6e}", f"{abs(b / a - 1):.1e}"] for name, a, b in rows],
    )
    figure, ax = plt.subplots(figsize=(8, 4), layout="constrained")
    curves = {
        "here": (np.arange(len(history)), history),
        "tutorial, as printed": ([max(k - 1, 0) for k in TUTORIAL["loss"]], list(TUTORIAL["loss"].values())),
        f"least, {min(history):.2e}": ([0, UPDATES], [min(history)] * 2),
    }
    draw(ax, curves, "updates", r"$\Sigma\,|(v_x, x)-\mathrm{truth}|^2$", "Loss", log=True)
    save(figure, "a1_training")


def validate_tutorial(truth, model, iterates, history):
    # A network of zeros is no drag at all.
    ideal = eqx.tree_at(lambda s: s.neural["drag"], model, jnp.zeros_like(model.neural["drag"]))
    best_step = int(np.argmin(history))
    kept, best = iterates[KEPT], iterates[best_step]
    runs = {"no drag": follow(ideal), "truth": truth, "kept": follow(kept), "best": follow(best)}
    errors = {name: rms((angle(run) - angle(truth))[EVENLY]) for name, run in runs.items()}

    printed = TUTORIAL["angle"]

    def row(name, label, *theirs):
        return [label, *(theirs or ("", "")), f"{errors[name]:.4f}", f"{errors['no drag'] / errors[name]:.1f}"]

    table(
        f"Angle against the truth over {DURATION:g} s: root mean square [rad], and how much better than without drag",
        ["", "tutorial", "better by", "here", "better by"],
        [
            row("no drag", "no drag", printed["no drag"], ""),
            row("kept", f"weights after update {KEPT}", printed["learned"], printed["ratio"]),
            row("best", f"weights of the least loss, update {best_step}"),
        ],
    )
    print(
        f"  The tutorial pairs its best loss, printed at step {KEPT}, with the weights after that update. The loss\n"
        f"  sees three instants only: a smaller one need not mean a better course over {DURATION:g} s."
    )
    draw_tutorial(runs)
    report_law(runs, model, {f"after update {KEPT}": kept, f"after update {best_step}": best})


def draw_tutorial(runs):
    shown = {"no drag": runs["no drag"], "truth": runs["truth"], "learned": runs["kept"]}
    figure, ax = plt.subplots(figsize=(9, 4), layout="constrained")
    for t in HORIZONS:
        ax.axvline(
            float(t), color="k", linestyle=":", linewidth=1, label="seen by the loss" if t == HORIZONS[0] else None
        )
    draw(ax, {k: (TIMES, angle(run)) for k, run in shown.items()}, "Time / s", "Angle from the +x axis / rad", "Swing")
    save(figure, "a2_angle")

    off_circle = {
        k: np.asarray(run["pend.x"]) ** 2 + np.asarray(run["pend.y"]) ** 2 - LENGTH**2 for k, run in shown.items()
    }
    ideal, damped = energy(shown["no drag"]), energy(shown["truth"])
    table(
        "Invariants over 6 s",
        ["", "tutorial", "here"],
        [
            ["no drag: relative change of energy", TUTORIAL["energy"], largest(ideal - ideal[0]) / abs(ideal[0])],
            ["Truth: largest rise of energy between samples / J", "", max(float(np.max(np.diff(damped))), 0.0)],
            ["No drag: |x² + y² − L²| / m²", TUTORIAL["constraint"]["no drag"], largest(off_circle["no drag"])],
            ["Truth: |x² + y² − L²| / m²", TUTORIAL["constraint"]["truth"], largest(off_circle["truth"])],
        ],
    )
    print("  The tutorial's energy rests on differences of x and y; here the velocities are read by their names.")
    figure, (left, right) = plt.subplots(1, 2, figsize=(13, 4), layout="constrained")
    draw(left, {k: (TIMES, energy(run)) for k, run in shown.items()}, "Time / s", "Energy / J", "Mechanical energy")
    printed = max(TUTORIAL["constraint"].values())
    right.axhline(printed, color="k", linestyle=":", linewidth=1, label="tutorial, largest")
    distances = {k: (TIMES, np.where(v == 0, np.nan, np.abs(v))) for k, v in off_circle.items()}
    draw(right, distances, "Time / s", "$|x^2+y^2-L^2|$ [m$^2$], where not 0", "Constraint", True,
         linestyle="none", marker=".", markersize=4)  # fmt: skip
    right.set_ylim(1e-17, 1e-13)
    save(figure, "a3_energy_and_constraint")


def report_law(runs, model, learned):
    network, _ = tutorial_network()
    grid = np.linspace(-2.5, 2.5, 200)
    true = -DRAG * grid * np.abs(grid)
    low, high = np.percentile(np.asarray(runs["truth"]["pend.vx"])[EVENLY], [1, 99])
    inside = (grid >= low) & (grid <= high)

    def law(system):
        return np.asarray(jax.vmap(lambda v: network(0.0, v[None], system.neural["drag"])[0])(jnp.asarray(grid)))

    laws = {name: law(system) for name, system in learned.items()}
    rows = [
        ["Velocities explored / (m/s)", "[{:+.2f}, {:+.2f}]".format(*TUTORIAL["band"]), f"[{low:+.2f}, {high:+.2f}]"]
    ]
    for k, (name, values) in enumerate(laws.items()):
        for where, mask in (("inside", inside), ("outside", ~inside)):
            printed = f"{TUTORIAL['law'][where]:.4f}" if k == 0 else ""
            rows.append([f"error {where}, {name} [m/s²]", printed, f"{rms((values - true)[mask]):.4f}"])
    table("The learned law, root mean square error", ["", "tutorial", "here"], rows)

    figure, ax = plt.subplots(figsize=(8, 5), layout="constrained")
    curves = {"truth": (grid, true), f"learned, after update {KEPT}": (grid, laws[f"after update {KEPT}"])}
    draw(ax, curves, "Velocity $v_x$ / (m/s)", "Correction / (m/s²)", "Law", band=(low, high))
    save(figure, "a4_law")


# --- between: the same law as a force ----------------------------------------------------------------------------


def row_and_equation(row):
    heading("Between: a row is not a force")
    system = pendulum(RELEASE, horizontal_drag, jnp.array([DRAG]), targets=["vx"])
    runs = {
        'inject="row"': row,
        'inject="equation"': follow(system),
        "one angle": angle_equation(RELEASE, lambda v: jnp.array([horizontal_drag(0.0, v[0], DRAG), 0.0]), TIMES),
    }
    pairs = [np.asarray(states(run))[AT_HORIZONS] for run in runs.values()]
    table(
        "(vx, x) with the same drag on vx: added to the row, to the equation, and in a model with one angle",
        ["T / s", *runs],
        [[f"{t:.1f}", *(f"{vx:+.6f}, {x:+.6f}" for vx, x in at_t)] for t, *at_t in zip(HORIZONS, *pairs, strict=True)],
    )
    one_angle = runs.pop("one angle")
    table(
        f"Largest deviation from the model with one angle over {DURATION:g} s",
        ["", "$x$ / m", "Link's pull / N"],
        [
            [name, largest(run["pend.x"] - one_angle["pend.x"]), largest(tension(run) - tension(one_angle))]
            for name, run in runs.items()
        ],
    )
    print(
        "  What is added to the finished row escapes the constraint; what is added to the equation, the link answers."
    )


# --- part B: a force, learned along full swings ------------------------------------------------------------------

HIGH_RELEASE = np.pi / 6  # rad, above the pivot: the bob falls through y = 0 and swings through x = 0
SAMPLES = jnp.linspace(0.0, DURATION, 201)[1:]
NOISE = 1e-3  # m


class Drag(eqx.Module):
    """A force per mass against the velocity, −k(|v|) v, with k > 0 from a 1 → 8 → 8 → 1 tanh network.

    Still air knows no direction but the velocity's: one function of the speed says it all, and each swing teaches it
    for both components. It leaves no force along the link, which positions could not reveal, for the tension would
    cancel it. And k > 0 whatever the weights: no guess on the way can feed energy in and blow the simulation up.
    (`learning.IsotropicPassive` is such a law too; this one shows that any Equinox module will do.)
    """

    network: eqx.nn.MLP

    def __init__(self, key):
        self.network = eqx.nn.MLP("scalar", "scalar", 8, 2, jnp.tanh, key=key)

    def rate(self, s):
        return jax.nn.softplus(self.network(s))

    def __call__(self, v):
        return -self.rate(speed(v)) * v


def positions(solution):
    return jnp.stack([solution["pend.x"], solution["pend.y"]], axis=1)


def speed_of(solution):
    return jnp.hypot(solution["pend.vx"], solution["pend.vy"])


def part_b():
    heading("Part B: drag as a force, learned from noisy positions along full swings")
    true = angle_equation(HIGH_RELEASE, lambda v: -DRAG * speed(v) * v, SAMPLES)
    data = positions(true) + NOISE * jax.random.normal(jax.random.key(1), (len(SAMPLES), 2))
    print(
        f"\n  Data: {len(SAMPLES)} samples of (x, y) over {DURATION:g} s with noise of {1e3 * NOISE:g} mm, from the "
        "model with one angle."
    )
    fit = train_on_positions(data)
    band = band_of(fit)
    start = time.perf_counter()
    found = fit.discover("drag", learning.powers(4))
    print(
        f"\n  A closed form in the network's place, refitted to the samples, in {time.perf_counter() - start:.1f} s:\n"
    )
    print("\n".join("    " + line for line in str(found).splitlines()))
    compare({"no drag": without_drag(fit.system), "learned": fit.system, "closed form": found.system}, band, true, data)


def train_on_positions(data):
    """The fit of the network to positions, shape (samples, 2).

    With k > 0 even the first guess is a damped swing, near enough for a fit over the whole time at once; a model that
    can go astray over several swings would be fitted to a short window first (`horizons=`).
    """
    model = pendulum(HIGH_RELEASE, Drag(jax.random.key(0)))
    data = np.asarray(data)
    record = learning.Experiment(SAMPLES, {"pend.x": data[:, 0], "pend.y": data[:, 1]}, sigma=NOISE)
    start = time.perf_counter()
    fit = learning.Problem(model, record, train="drag").fit(adam=40)
    print(
        f"\n  States chosen by the compiler: {', '.join(model.states)}.\n"
        f"  {len(fit.point)} weights, of which the data determine {fit.effective['drag']:.1f}; 40 gradient steps, then "
        f"{len(fit.minimum.history) - 1} of least squares,\n"
        f"  in {time.perf_counter() - start:.1f} s, compilation included. {fit}"
    )
    return fit


def without_drag(system):
    """The same model with a drag that vanishes: the last bias is far below zero."""
    return eqx.tree_at(lambda s: s.neural["drag"].network.layers[-1].bias, system, jnp.array([-1e3]))


def band_of(fit):
    """The learned deceleration over the speed, with its 95 % band and what the bob explored."""
    return fit.band("drag", np.linspace(0.0, 5.5, 200), lambda law, s: law.rate(s) * s, along=speed_of)


def law_of(system, grid):
    """The deceleration at each speed."""
    v = jnp.stack([jnp.asarray(grid), jnp.zeros(len(grid))], axis=1)
    return -np.asarray(jax.vmap(system.neural["drag"])(v))[:, 0]


def compare(systems, band, true, data):
    runs = {name: follow(system, SAMPLES) for name, system in systems.items()}
    low, high = np.percentile(np.hypot(np.asarray(true["pend.vx"]), np.asarray(true["pend.vy"])), [1, 99])
    grid = band.grid
    laws = {name: law_of(system, grid) for name, system in systems.items()}
    inside, law = (grid >= low) & (grid <= high), DRAG * grid**2
    errors = {name: rms(angle(run) - angle(true)) for name, run in runs.items()}
    table(
        f"Against the truth over {DURATION:g} s; law between {low:.2f} and {high:.2f} m/s",
        ["", "Angle, rms / rad", "better by", "Law, rms / %", "Link's pull, max / N", "misfit / noise"],
        [
            [
                name,
                errors[name],
                f"{errors['no drag'] / errors[name]:,.0f}",
                f"{100 * rms((laws[name] - law)[inside]) / rms(law[inside]):.2f}",
                largest(tension(run) - tension(true)),
                f"{rms(positions(run) - data) / NOISE:.3f}",
            ]
            for name, run in runs.items()
        ],
    )
    covered = ((band.low <= law) & (law <= band.high))[inside].mean()
    print(
        f"  The band of the network has the true law at {100 * covered:.0f} % of these speeds. Neither velocities nor "
        "forces were measured;\n  at a misfit of 1 the data have nothing more to tell."
    )
    draw_swings(runs, true, data)
    draw_law(band, laws, law)


def draw_swings(runs, true, data):
    shown = {"no drag": runs["no drag"], "truth": true, "learned": runs["learned"]}
    figure, axes = plt.subplots(3, 1, figsize=(9, 9), sharex=True, layout="constrained")
    measured = np.unwrap(np.arctan2(data[:, 1], data[:, 0]))
    angles = {"samples, every fourth": (SAMPLES[::4], measured[::4])}
    angles |= {k: (SAMPLES, angle(run)) for k, run in shown.items()}
    pulls = {k: (SAMPLES, tension(run)) for k, run in shown.items()}
    distances = {
        k: (SAMPLES, np.linalg.norm(np.asarray(positions(runs[k]) - positions(true)), axis=1))
        for k in ("no drag", "learned", "closed form")
    }
    draw(axes[0], angles, None, "Angle / rad", "Swing")
    draw(axes[1], pulls, None, "Pull / N", "The link's pull, never measured")
    axes[2].axhline(NOISE, color="k", linestyle=":", linewidth=1, label="noise of the samples")
    draw(axes[2], distances, "Time / s", "Distance / m", "Distance from the true position", log=True)
    save(figure, "b1_swings")


def draw_law(band, laws, law):
    figure, (left, right) = plt.subplots(1, 2, figsize=(12, 4.2), layout="constrained")
    half, explored = band.high - band.mean, tuple(band.explored[0])
    shown = {"truth": law, "learned": laws["learned"], "closed form": laws["closed form"]}
    errors = {k: (band.grid, np.abs(v - law)) for k, v in shown.items() if k != "truth"}
    left.fill_between(band.grid, band.low, band.high, color="C0", alpha=0.25, linewidth=0)
    draw(left, {k: (band.grid, v) for k, v in shown.items()}, "Speed / (m/s)", "Deceleration / (m/s²)", "Law of drag",
         band=explored)  # fmt: skip
    left.set_ylim(-0.5, 1.1 * law.max())
    right.fill_between(band.grid, 1e-6, half, color="C0", alpha=0.2, linewidth=0, label="95 % band")
    draw(right, errors, "Speed / (m/s)", "Error / (m/s²)", "Its error", log=True, band=explored)
    right.set_ylim(1e-5, 10)
    save(figure, "b2_law")


def main():
    start = time.perf_counter()
    truth = part_a()
    row_and_equation(truth)
    part_b()
    print(f"\n{time.perf_counter() - start:.0f} s in all")


if __name__ == "__main__":
    main()
