"""The figures of the first page and of the benchmarks, for light pages and dark ones, in `docs/images/`.

    python docs/figures.py              # both
    python docs/figures.py benchmarks   # from the tables of docs/benchmarks.md

`pendulum-*.svg` shows the model of `examples/neural_dae_pendulum_drag.py`, trained as there, in a row and, for narrow
screens, in two rows.
"""

import pathlib
import re
import sys
from typing import Any

import jax
import matplotlib.pyplot as plt
import numpy as np

ROOT = pathlib.Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "examples"))

IMAGES = ROOT / "docs" / "images"
INKS = {"light": ("#1f2328", "#59636e", "#0969da", "#d1600a"), "dark": ("#f0f6fc", "#9198a1", "#58a6ff", "#f0883e")}
SHOWN = 150  # samples, of the first 4.5 s
STROBE = range(0, 30, 3)


def panels(axes: Any, true: Any, data: Any, runs: dict[str, Any], laws: dict[str, Any], inks: tuple[str, ...]) -> None:
    ink, faint, learned, truth = inks
    model, samples, law, pull = axes
    t = np.asarray(study.SAMPLES)[:SHOWN]

    x, y = np.asarray(true["pend.x"]), np.asarray(true["pend.y"])
    for k in STROBE:
        shade = 0.12 + 0.4 * k / STROBE[-1]
        model.plot([0, x[k]], [0, y[k]], color=ink, lw=1, alpha=shade)
        model.plot(x[k], y[k], "o", color=learned, ms=9, mew=0, alpha=shade)
    at = STROBE[-1] + 3
    model.plot([0, x[at]], [0, y[at]], color=ink, lw=2)
    model.plot(x[at], y[at], "o", color=learned, ms=15)
    model.plot(0, 0, "o", color=ink, ms=5)
    v = np.array([np.asarray(true["pend.vx"])[at], np.asarray(true["pend.vy"])[at]])
    tip = np.array([x[at], y[at]]) - 0.55 * v / np.hypot(*v)
    model.annotate("", tip, (x[at], y[at]), arrowprops={"arrowstyle": "-|>", "color": truth, "lw": 2})
    model.text(tip[0] - 0.12, tip[1] - 0.08, "drag = network(v)", color=truth, ha="center", va="top", fontsize=10)
    model.text(-0.02, 0.14, "x² + y² = L²", color=ink, ha="right", fontsize=10)
    model.set(aspect="equal", xlim=(-0.95, 1.25), ylim=(-1.45, 0.7))
    model.axis("off")

    def angle(run):
        return np.unwrap(np.degrees(study.angle(run))[:SHOWN], period=360) + 90

    measured = np.unwrap(np.degrees(np.arctan2(data[:, 1], data[:, 0]))[:SHOWN], period=360) + 90
    samples.plot(t, angle(runs["no drag"]), color=faint, lw=1.2)
    samples.plot(t, angle(runs["learned"]), color=learned, lw=1.8)
    samples.plot(t[::4], np.asarray(measured)[::4], "o", color=truth, ms=3.6, mew=0)
    samples.set(xlabel="Time / s", ylabel="Angle / °")

    grid = laws["grid"]
    law.plot(grid, laws["truth"], color=truth, lw=5, alpha=0.45, solid_capstyle="round")
    law.plot(grid, laws["learned"], color=learned, lw=1.8)
    law.set(xlabel="Speed / (m/s)", ylabel="Drag / N", xlim=(0, None), ylim=(0, None))

    pull.plot(t, np.asarray(study.tension(true))[:SHOWN], color=truth, lw=5, alpha=0.45, solid_capstyle="round")
    pull.plot(t, np.asarray(study.tension(runs["no drag"]))[:SHOWN], color=faint, lw=1.2)
    pull.plot(t, np.asarray(study.tension(runs["learned"]))[:SHOWN], color=learned, lw=1.8)
    pull.set(xlabel="Time / s", ylabel="Pull of the rod / N")

    titles = ("Physics, with a gap", "Trained on positions", "The law it learned", "A force never measured")
    dress(axes, titles, ink, faint)


def dress(axes: Any, titles: tuple[str, ...], ink: str, faint: str) -> None:
    for ax, title in zip(axes, titles, strict=True):
        ax.set_title(title, color=ink, fontsize=12.5, fontweight="bold", pad=10)
        ax.patch.set_alpha(0)
        ax.tick_params(colors=faint, labelsize=9)
        ax.xaxis.label.set_color(faint)
        ax.yaxis.label.set_color(faint)
        ax.spines[["top", "right"]].set_visible(False)
        ax.spines[["bottom", "left"]].set_color(faint)


def pendulum() -> None:
    global study
    import neural_dae_pendulum_drag as study

    true = study.angle_equation(study.HIGH_RELEASE, lambda v: -study.DRAG * study.speed(v) * v, study.SAMPLES)
    noise = study.NOISE * jax.random.normal(jax.random.key(1), (len(study.SAMPLES), 2))
    data = np.asarray(study.positions(true) + noise)
    fit = study.train_on_positions(data)
    systems = {"no drag": study.without_drag(fit.system), "learned": fit.system}
    runs = {name: study.follow(system, study.SAMPLES) for name, system in systems.items()}
    grid = np.linspace(0.0, float(np.hypot(true["pend.vx"], true["pend.vy"]).max()), 100)
    laws = {"grid": grid, "truth": study.DRAG * grid**2, "learned": study.law_of(systems["learned"], grid)}
    for kind, inks in INKS.items():
        for name, shape, size in (("pendulum", (1, 4), (13, 3.3)), ("pendulum-narrow", (2, 2), (5.6, 5.6))):
            ratios = [1, 1.15, 1, 1.15][: shape[1]]
            figure, axes = plt.subplots(*shape, figsize=size, width_ratios=ratios, layout="constrained")
            panels(axes.ravel(), true, data, runs, laws, inks)
            legend = {
                "truth": {"color": inks[3], "lw": 5, "alpha": 0.45},
                "measured, with noise of 1 mm": {"color": inks[3], "ls": "", "marker": "o", "ms": 4},
                "with the learned network": {"color": inks[2], "lw": 1.8},
                "without drag": {"color": inks[1], "lw": 1.2},
            }
            handles = [plt.Line2D([], [], label=label, **look) for label, look in legend.items()]
            figure.legend(
                handles=handles,
                loc="outside lower center",
                ncols=shape[1],
                frameon=False,
                labelcolor=inks[0],
                fontsize=10,
            )
            save(figure, f"{name}-{kind}")


def save(figure: Any, name: str) -> None:
    IMAGES.mkdir(exist_ok=True)
    plt.rcParams["svg.hashsalt"] = name  # the same figure is the same file
    figure.savefig(IMAGES / f"{name}.svg", transparent=True, metadata={"Date": None})
    plt.close(figure)


# --- benchmarks --------------------------------------------------------------------------------------------------


def rows(heading: str) -> list[list[str]]:
    """The lines of the tables below a heading of docs/benchmarks.md, split where two spaces or more are."""
    text = (ROOT / "docs" / "benchmarks.md").read_text()
    section = text[text.index(f"## {heading}") :].partition("\n## ")[0]
    lines = "\n".join(re.findall(r"^```text\n(.*?)^```$", section, re.M | re.S)).splitlines()
    return [re.split(r"\s{2,}", line.strip()) for line in lines if line.strip()]


def work_precision(axes: Any, inks: tuple[str, ...]) -> None:
    table = [row for row in rows("Solvers for DAEs") if len(row) > 8 and row[1] in ("bdf", "rodas5p", "idas")]
    colours = {"rodas5p": inks[2], "bdf": inks[3], "idas": inks[1]}
    for ax, problem in zip(axes, ("robertson", "chemakzo", "transamp"), strict=True):
        for solver, colour in colours.items():
            chosen = [row for row in table if row[0] == problem and row[1] == solver]
            ax.semilogy([float(r[4]) for r in chosen], [float(r[-1]) for r in chosen], "o-", color=colour, label=solver)
        ax.set(title=problem, xlabel="Digits")
    axes[0].set_ylabel("Time / ms")


def compile_times(ax: Any, inks: tuple[str, ...]) -> None:
    found: dict[str, list[tuple[float, float]]] = {"ladder": [], "array": []}
    for row in rows("How compiling scales"):
        kind = row[0].split()[0]
        if kind in found and row[1].isdigit():
            found[kind].append((float(row[1]), float(row[6].rstrip("s"))))
    published = {
        "ModelingToolkit.jl, published": [(12e3, 52.5), (48e3, 1148)],
        "the same, loops rerolled": [(12e3, 3.9), (48e3, 34), (240e3, 1198)],
        "Dymola, published": [(12e3, 6.8), (48e3, 24), (108e3, 57)],
        "OpenModelica, published": [(12e3, 67), (48e3, 393)],
    }
    for (label, points), colour in zip(
        (("single components", found["ladder"]), ("arrays", found["array"])), inks[2:], strict=False
    ):
        ax.loglog(*zip(*points, strict=True), "o-", color=colour, label=label)
    for (label, points), mark in zip(published.items(), "sD^v", strict=True):
        ax.loglog(*zip(*points, strict=True), mark, ls=":", color=inks[1], label=label, ms=5)
    ax.set(xlabel="Equations", ylabel="Build, compile, solve / s")


def gradient_cost(ax: Any, inks: tuple[str, ...]) -> None:
    table = [row for row in rows("Compile times of medium models") if len(row) >= 9]
    table = [row for row in table if re.fullmatch(r"[\d.]+", row[-1])]
    names = [row[0] for row in table]
    value = [float(r[-7]) + float(r[-6]) for r in table]
    gradient = [float(r[-4]) + float(r[-3]) for r in table]
    at = np.arange(len(names))
    ax.barh(at - 0.2, value, 0.4, color=inks[2], label="value")
    ax.barh(at + 0.2, gradient, 0.4, color=inks[3], label="value and gradient")
    ax.set_yticks(at, names)
    ax.invert_yaxis()
    ax.set(xlabel="Tracing and XLA / s")


def batches(ax: Any, inks: tuple[str, ...]) -> None:
    table = [row for row in rows("The pendulum") if len(row) == 4 and row[2].endswith(" ms")]
    batch = [row for row in table if float(row[-2].split()[0]) > 20]
    at = np.arange(len(batch))
    ours = ["ours" in row[0] for row in batch]
    colours = [inks[2] if mine else inks[1] for mine in ours]
    ax.barh(at, [float(r[-2].split()[0]) for r in batch], color=colours)
    ax.set_yticks(at, [row[0] for row in batch])
    ax.invert_yaxis()
    ax.set(xlabel="Time / ms")


def benchmarks() -> None:
    shapes = {1: (1, 3, 3.1), 2: (1, 1, 3.6), 3: (1, 1, 5.2), 4: (1, 1, 2.8)}
    draws = {1: work_precision, 2: compile_times, 3: gradient_cost, 4: batches}
    for kind, inks in INKS.items():
        for number, draw in draws.items():
            *shape, height = shapes[number]
            figure, axes = plt.subplots(*shape, figsize=(6.6, height), layout="constrained", sharey=number == 1)
            draw(axes, inks)
            each = np.ravel(axes)
            for ax in each:
                dress([ax], [ax.get_title()], inks[0], inks[1])
            if number < 4:
                each[-1].legend(loc="center left", bbox_to_anchor=(1, 0.5), frameon=False, labelcolor=inks[0])
            save(figure, f"pages/verification-{number}-{kind}")


if __name__ == "__main__":
    if "benchmarks" not in sys.argv:
        pendulum()
    benchmarks()
