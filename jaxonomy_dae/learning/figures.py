"""Figures of fits."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..base.errors import ModelError
from ..base.optional import Axes, axis_label, legend_beside, new_axes
from .axes import LEGEND, AxesGiven, chosen_names, grid_of_axes
from .descent import Minimum
from .objective import Objective

SIDE_BY_SIDE = 4  # columns of experiments; more begin new rows
MOST = 24  # experiments that are drawn: more are too small to read
WRITTEN = 12  # up to this many names, correlations are written into their cells


def plot_runs(
    objective: Objective,
    outputs: Float[np.ndarray, "e n k"],
    half: Float[np.ndarray, "e n k"],
    names: str | Sequence[str] | None,
    axes: AxesGiven,
) -> np.ndarray:  # fmt: skip
    """Samples and the fitted runs with bands that go `half` to each side: rows of axes for names, columns for
    experiments; after four experiments, the rows begin anew."""
    s, variables = objective.stacked, objective.system.plan.flat.variables
    units = dict(zip(variables.names, variables.unit, strict=True))
    chosen = chosen_names(names, s.outputs, "data of")
    shown = min(len(s.labels), MOST)
    columns = min(shown, SIDE_BY_SIDE)
    groups = -(-shown // columns)
    grid = grid_of_axes(axes, len(chosen) * groups, columns, "a plot of data and runs", "all" if groups > 1 else "col")
    for place in np.ndindex(groups, len(chosen), columns):
        group, row, column = place
        k, name = group * columns + column, chosen[row]
        ax = grid.item(group * len(chosen) + row, column)
        if k >= shown:
            ax.set_visible(False)
            continue
        j, count = s.outputs.index(name), s.counts[k]
        seen = s.observed[k, :, j]
        ts, mean, off = s.times[k, :count], outputs[k, :count, j], half[k, :count, j]
        ax.plot(s.times[k][seen], s.values[k, seen, j], ".", color="0.5", markersize=4, label="measured")
        ax.plot(ts, mean, color="C0", linewidth=1.5, label="fitted" if not s.holdout[k] else "predicted")
        ax.fill_between(ts, mean - off, mean + off, color="C0", alpha=0.25, linewidth=0)
        ax.grid(True, alpha=0.3)
        if column == 0:
            ax.set_ylabel(axis_label(name, units.get(name)))
        if row == 0 and len(s.labels) > 1:
            ax.set_title(s.labels[k] + " (held out)" * bool(s.holdout[k]), loc="left", fontsize="medium")
    for ax in grid[-1]:
        ax.set_xlabel("Time / s")
    legend_beside(grid[0, columns - 1])
    if len(s.labels) > shown:
        grid[0, -1].annotate(f"and {len(s.labels) - shown} more", (1, 1.01), xycoords="axes fraction", ha="right")
    return grid


def plot_residuals(objective: Objective, minimum: Minimum, axes: AxesGiven) -> np.ndarray:
    """Residuals in units of the noise over time, and their autocorrelation: rows of axes for names."""
    s = objective.stacked
    rows, scaled = objective.rows, minimum.weights.scale * minimum.found.residual
    present = [j for j in range(len(s.outputs)) if (rows[2] == j).any()]
    axes = grid_of_axes(axes, len(present), 2, "a plot of residuals")
    for k, row in enumerate(axes):  # times on the left, lags on the right
        for ax in row:
            ax.grid(True, alpha=0.3)
        row[0].axhspan(-2, 2, color="C2", alpha=0.12, linewidth=0, label="±2 σ" if k == 0 else None)
    for (left, right), j in zip(axes, present, strict=True):
        longest = 1
        for e in np.unique(rows[0]):
            chosen = (rows[0] == e) & (rows[2] == j)
            if not chosen.any():
                continue
            r = scaled[chosen]
            label = s.labels[e] if len(s.labels) > 1 else None
            left.plot(s.times[rows[0], rows[1]][chosen], r, ".", markersize=3.5, color=f"C{e % 10}", label=label)
            lags = min(30, len(r) - 1)
            if lags < 1 or not np.any(r):
                continue
            moved = np.array([r[: len(r) - n] @ r[n:] for n in range(1, lags + 1)]) / (r @ r)
            right.plot(np.arange(1, lags + 1), moved, ".-", markersize=4, linewidth=0.8, color=f"C{e % 10}")
            longest = max(longest, len(r))
        right.axhspan(-1.96 / np.sqrt(longest), 1.96 / np.sqrt(longest), color="C2", alpha=0.12, linewidth=0)
        left.set_ylabel(f"{s.outputs[j]}\nResidual / σ")
        right.set_ylabel("Correlation")
    axes[-1, 0].set_xlabel("Time / s")
    axes[-1, 1].set_xlabel("Lag / samples")
    if len(s.labels) <= LEGEND:
        legend_beside(axes[0, 1], of=axes[0, 0])
    return axes


def plot_history(minimum: Minimum, ax: Axes | None) -> Axes:
    """Draws how the misfit came down, step by step, or of a likelihood of which noise levels are a part, −ln L for each
    sample; returns the axes."""
    ax = new_axes(ax)
    each = np.array(minimum.history, float) / minimum.weights.samples
    if minimum.found.variance is None:
        ax.semilogy(np.sqrt(2 * each), ".-")
        ax.set_ylabel("RMS residual / σ")
    else:  # of any sign
        ax.plot(each, ".-")
        ax.set_ylabel("Cost / sample")
    ax.set_xlabel("Steps")
    ax.grid(True, which="both", alpha=0.3)
    return ax


def plot_correlations(objective: Objective, correlation: Float[np.ndarray, "p p"], ax: Axes | None) -> Axes:
    """Correlations of what was estimated, weights of networks left out."""
    c = objective.coordinates
    chosen = np.flatnonzero(objective.free & ~c.is_weight)
    if not len(chosen):
        raise ModelError("there is nothing but weights of networks in this fit: their correlations say nothing")
    names = [c.names[k] for k in chosen]
    values = correlation[np.ix_(chosen, chosen)]
    side = float(np.clip(0.45 * len(names) + 2.5, 4.0, 9.0))
    ax = new_axes(ax, side + 0.8, side)
    image = ax.imshow(values, vmin=-1, vmax=1, cmap="RdBu_r")
    ax.set_xticks(range(len(names)), names, rotation=90)
    ax.set_yticks(range(len(names)), names)
    if len(names) <= WRITTEN:
        for i, j in np.ndindex(values.shape):
            light = abs(values[i, j]) > 0.6
            ax.text(j, i, f"{values[i, j]:.2f}", ha="center", va="center", color="w" if light else "k", fontsize=8)
    ax.figure.colorbar(image, ax=ax, label="correlation", shrink=0.8)
    return ax
