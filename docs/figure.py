"""The figure at the head of the README: the pendulum whose drag is learned, in one row of pictures.

    python docs/figure.py

trains the model of `examples/neural_dae_pendulum_drag.py` and writes `docs/images/pendulum-light.svg` and
`pendulum-dark.svg`, for pages of either kind.
"""

import pathlib
import sys
from typing import Any

import jax
import matplotlib.pyplot as plt
import numpy as np

ROOT = pathlib.Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "examples"))

import neural_dae_pendulum_drag as study  # noqa: E402

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
    samples.set(xlabel="time [s]", ylabel="angle [°]")

    grid = laws["grid"]
    law.plot(grid, laws["truth"], color=truth, lw=5, alpha=0.45, solid_capstyle="round")
    law.plot(grid, laws["learned"], color=learned, lw=1.8)
    law.set(xlabel="speed [m/s]", ylabel="drag [N]", xlim=(0, None), ylim=(0, None))

    pull.plot(t, np.asarray(study.tension(true))[:SHOWN], color=truth, lw=5, alpha=0.45, solid_capstyle="round")
    pull.plot(t, np.asarray(study.tension(runs["no drag"]))[:SHOWN], color=faint, lw=1.2)
    pull.plot(t, np.asarray(study.tension(runs["learned"]))[:SHOWN], color=learned, lw=1.8)
    pull.set(xlabel="time [s]", ylabel="pull of the rod [N]")

    titles = ("Physics, with a gap", "Trained on positions", "The law comes out,", "and a force never measured")
    for ax, title in zip(axes, titles, strict=True):
        ax.set_title(title, color=ink, fontsize=12.5, fontweight="bold", pad=10)
        ax.patch.set_alpha(0)
        ax.tick_params(colors=faint, labelsize=9)
        ax.xaxis.label.set_color(faint)
        ax.yaxis.label.set_color(faint)
        ax.spines[["top", "right"]].set_visible(False)
        ax.spines[["bottom", "left"]].set_color(faint)


def main() -> None:
    true = study.angle_equation(study.HIGH_RELEASE, lambda v: -study.DRAG * study.speed(v) * v, study.SAMPLES)
    noise = study.NOISE * jax.random.normal(jax.random.key(1), (len(study.SAMPLES), 2))
    data = np.asarray(study.positions(true) + noise)
    systems = study.train_on_positions(data)
    runs = {name: study.follow(systems[name], study.SAMPLES) for name in ("no drag", "learned")}
    grid = np.linspace(0.0, float(np.hypot(true["pend.vx"], true["pend.vy"]).max()), 100)
    laws = {"grid": grid, "truth": study.DRAG * grid**2, "learned": study.law_of(systems["learned"], grid)}
    IMAGES.mkdir(exist_ok=True)
    plt.rcParams["svg.hashsalt"] = "pendulum"  # the same figure is the same file
    for kind, inks in INKS.items():
        figure, axes = plt.subplots(1, 4, figsize=(13, 3.3), width_ratios=[1, 1.15, 1, 1.15], layout="constrained")
        panels(axes, true, data, runs, laws, inks)
        legend = {
            "truth": {"color": inks[3], "lw": 5, "alpha": 0.45},
            "measured, with noise of 1 mm": {"color": inks[3], "ls": "", "marker": "o", "ms": 4},
            "with the learned network": {"color": inks[2], "lw": 1.8},
            "without drag": {"color": inks[1], "lw": 1.2},
        }
        handles = [plt.Line2D([], [], label=label, **look) for label, look in legend.items()]
        figure.legend(
            handles=handles, loc="outside lower center", ncols=4, frameon=False, labelcolor=inks[0], fontsize=10
        )
        figure.savefig(IMAGES / f"pendulum-{kind}.svg", transparent=True, metadata={"Date": None})
        plt.close(figure)


if __name__ == "__main__":
    main()
