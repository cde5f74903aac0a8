"""The figures of README and tutorial, for light pages and dark ones, in `docs/images/`.

    python docs/figures.py

`pendulum-*.svg` shows the model of `examples/neural_dae_pendulum_drag.py`, trained as there; `tutorial-*.svg` what the
blocks of `docs/tutorial.md` compute, which are run one after the other.
"""

import contextlib
import io
import pathlib
import re
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
    true = study.angle_equation(study.HIGH_RELEASE, lambda v: -study.DRAG * study.speed(v) * v, study.SAMPLES)
    noise = study.NOISE * jax.random.normal(jax.random.key(1), (len(study.SAMPLES), 2))
    data = np.asarray(study.positions(true) + noise)
    fit = study.train_on_positions(data)
    systems = {"no drag": study.without_drag(fit.system), "learned": fit.system}
    runs = {name: study.follow(system, study.SAMPLES) for name, system in systems.items()}
    grid = np.linspace(0.0, float(np.hypot(true["pend.vx"], true["pend.vy"]).max()), 100)
    laws = {"grid": grid, "truth": study.DRAG * grid**2, "learned": study.law_of(systems["learned"], grid)}
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
        save(figure, f"pendulum-{kind}")


def save(figure: Any, name: str) -> None:
    IMAGES.mkdir(exist_ok=True)
    plt.rcParams["svg.hashsalt"] = name  # the same figure is the same file
    figure.savefig(IMAGES / f"{name}.svg", transparent=True, metadata={"Date": None})
    plt.close(figure)


def tutorial() -> None:
    blocks = re.findall(r"^```python\n(.*?)^```$", (ROOT / "docs" / "tutorial.md").read_text(), re.M | re.S)
    n: dict[str, Any] = {}
    with contextlib.redirect_stdout(io.StringIO()):
        for block in blocks:
            exec(block, n)
    ts = np.linspace(0.0, 1800.0, 361)
    opened = {"pi.setpoint": 333.15, "room.T": (n["opened"], n["room_T"])}
    controlled = n["simulate"](n["controlled"], 1800.0, ts=ts, inputs=opened)["block.T"] - 273.15
    trained, before = (
        n["simulate"](s, 1800.0, ts=ts, inputs=n["inputs"])["block.T"] - 273.15 for s in (n["fit"].system, n["model"])
    )
    u = np.linspace(0.0, 45.0, 91)
    band = n["fit"].band("loss.law", u)
    reached = np.asarray(n["measured"]) - 293.15
    for kind, (ink, faint, blue, orange) in INKS.items():
        figure, axes = plt.subplots(1, 3, figsize=(10, 2.9), layout="constrained")
        held, record, law = axes
        held.axhline(60.0, color=orange, lw=1, ls=":")
        held.plot(ts / 60, controlled, color=blue, lw=1.8)
        held.set(xlabel="time [min]", ylabel="temperature [°C]")
        record.plot(np.asarray(n["moments"]) / 60, np.asarray(n["measured"]) - 273.15, "o", color=orange, ms=3.4, mew=0)
        record.plot(ts / 60, before, color=faint, lw=1.2)
        record.plot(ts / 60, trained, color=blue, lw=1.6)
        record.set(xlabel="time [min]", ylabel="temperature [°C]")
        law.plot(u, n["true_law"](u), color=orange, lw=5, alpha=0.45, solid_capstyle="round")
        law.fill_between(u, band.low, band.high, color=blue, alpha=0.3, lw=0)
        law.plot(u, band.mean, color=blue, lw=1.8)
        law.plot(reached, np.zeros_like(reached), "|", color=orange, ms=7, clip_on=False)
        law.set(xlabel="difference in temperature [K]", ylabel="heat flow [W]", xlim=(0, 45), ylim=(0, None))
        dress(axes, ("Under control", "The record, and the model", "The law"), ink, faint)
        save(figure, f"tutorial-{kind}")


if __name__ == "__main__":
    pendulum()
    tutorial()
