"""Figures of data, fits and what is known of them, with Matplotlib (extra `plot`)."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import ModelError, nearest
from ..optional import optional_module

if TYPE_CHECKING:
    from .band import Band
    from .data import Data
    from .estimate import Estimate
    from .identifiability import Identifiability
    from .prediction import Prediction
    from .table import Table

EACH = 4  # up to this many experiments have columns of their own
WRITTEN = 12  # up to this many names, correlations are written into their cells
LEGEND = 8  # up to this many entries, a legend is drawn


def new_axes(ax: Any, width: float = 7.0, height: float = 3.5) -> Any:
    """The axes given, or new ones."""
    plt = optional_module("matplotlib.pyplot", "plot", "plotting needs Matplotlib")
    return plt.subplots(figsize=(width, height), layout="constrained")[1] if ax is None else ax


def grid_of_axes(axes: Any, rows: int, columns: int, what: str) -> np.ndarray:
    """Axes of shape (rows, columns): those given, or new ones that share their times."""
    if axes is None:
        plt = optional_module("matplotlib.pyplot", "plot", "plotting needs Matplotlib")
        size = (min(3.2 * columns + 3.0, 14.0), 2.3 * rows + 0.9)
        return plt.subplots(rows, columns, figsize=size, sharex="col", squeeze=False, layout="constrained")[1]
    found = np.asarray(axes, object)
    if found.size != rows * columns:
        raise ModelError(f"{what} needs {rows} × {columns} axes; got {found.size}")
    return found.reshape(rows, columns)


def _label(name: str, unit: str) -> str:
    return f"{name} [{unit}]" if unit and unit != "1" else name


def _units(estimate: "Estimate") -> dict[str, str]:
    variables = estimate.system.plan.flat.variables
    return dict(zip(variables.names, variables.unit, strict=True))


def _chosen(given: str | Sequence[str] | None, known: Sequence[str], what: str) -> list[str]:
    if given is None:
        return list(known)
    chosen = [given] if isinstance(given, str) else list(given)
    for name in chosen:
        if name not in known:
            raise ModelError(f"plot: there are no {what} '{name}': " + nearest(name, known))
    return chosen


def plot_data(data: "Data", names: str | Sequence[str] | None, axes: Any) -> np.ndarray:
    """Records over time, one row of axes for each name."""
    known = list(dict.fromkeys(name for one in data.experiments for name in one.data))
    chosen = _chosen(names, known, "data of")
    axes = grid_of_axes(axes, len(chosen), 1, "a plot of data")
    for ax, name in zip(axes[:, 0], chosen, strict=True):
        for k, (label, one) in enumerate(zip(data.labels, data.experiments, strict=True)):
            if name not in one.data:
                continue
            values = one.data[name].reshape(len(one.times), -1)
            style = dict(marker=".", linestyle="none", color=f"C{k % 10}", alpha=0.5 if one.holdout else 1.0)
            lines = ax.plot(one.times, values, **style)
            lines[0].set_label(label + " (held out)" * one.holdout)
        ax.set_ylabel(name)
        ax.grid(True, alpha=0.3)
    axes[-1, 0].set_xlabel("time [s]")
    if len(data) <= LEGEND:
        axes[0, 0].legend()
    return axes[:, 0]


def plot_runs(estimate: "Estimate", names: Any, axes: Any, level: float) -> np.ndarray:
    """Samples and the fitted runs with their bands: rows of axes for names, columns for experiments."""
    s, units = estimate.objective.stacked, _units(estimate)
    chosen = _chosen(names, s.outputs, "data of")
    outputs, spread = estimate.at_samples
    factor = estimate.quantile(level)
    shown = range(min(len(s.labels), EACH))
    axes = grid_of_axes(axes, len(chosen), len(shown), "a plot of data and runs")
    for row, name in zip(axes, chosen, strict=True):
        j = s.outputs.index(name)
        for ax, k in zip(row, shown, strict=True):
            count, seen = s.counts[k], s.observed[k, :, j]
            ts, mean, half = s.times[k, :count], outputs[k, :count, j], factor * spread[k, :count, j]
            ax.plot(s.times[k][seen], s.values[k, seen, j], ".", color="0.35", markersize=4, label="measured")
            ax.plot(ts, mean, color="C0", linewidth=1.5, label="fitted" if not s.holdout[k] else "predicted")
            ax.fill_between(ts, mean - half, mean + half, color="C0", alpha=0.25, linewidth=0)
            ax.grid(True, alpha=0.3)
        row[0].set_ylabel(_label(name, units.get(name, "")))
    for ax, k in zip(axes[0], shown, strict=True):
        if len(s.labels) > 1:
            ax.set_title(s.labels[k] + " (held out)" * bool(s.holdout[k]), loc="left", fontsize="medium")
        ax.legend(fontsize="small")
    for ax in axes[-1]:
        ax.set_xlabel("time [s]")
    if len(s.labels) > EACH:
        axes[0, -1].annotate(f"and {len(s.labels) - EACH} more", (1, 1.01), xycoords="axes fraction", ha="right")
    return axes


def plot_residuals(estimate: "Estimate", axes: Any) -> np.ndarray:
    """Residuals in units of the noise over time, and their autocorrelation: rows of axes for names."""
    s = estimate.objective.stacked
    rows, scaled = estimate.objective.rows, estimate.minimum.weights.row * estimate.minimum.found.residual
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
        left.set_ylabel(f"{s.outputs[j]}\nresidual [σ]")
        right.set_ylabel("correlation")
    axes[-1, 0].set_xlabel("time [s]")
    axes[-1, 1].set_xlabel("lag [samples]")
    if len(s.labels) <= LEGEND:
        axes[0, 0].legend(fontsize="small", loc="upper right")
    return axes


def plot_history(estimate: "Estimate", ax: Any) -> Any:
    """Draws how the misfit came down, step by step; returns the axes."""
    ax = new_axes(ax)
    history = np.array(estimate.minimum.history, float)
    ax.semilogy(np.sqrt(2 * history / len(estimate.minimum.weights.row)), ".-")
    ax.set_xlabel("steps of least squares")
    ax.set_ylabel("root mean square residual [σ]")
    ax.grid(True, which="both", alpha=0.3)
    return ax


def plot_correlations(estimate: "Estimate", ax: Any) -> Any:
    """Correlations of what was estimated, weights of networks left out."""
    c = estimate.objective.coordinates
    chosen = np.flatnonzero(estimate.objective.free & ~c.is_weight)
    if not len(chosen):
        raise ModelError("there is nothing but weights of networks in this fit: their correlations say nothing")
    names = [c.names[k] for k in chosen]
    values = estimate.correlation[np.ix_(chosen, chosen)]
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


def plot_band(band: "Band", ax: Any, truth: Any, label: str) -> Any:
    """A law with its band, and where the experiments went."""
    ax = new_axes(ax)
    points = band.grid.reshape(len(band.grid), -1)
    moving = [k for k in range(points.shape[1]) if np.ptp(points[:, k]) > 0]
    if len(moving) > 1:
        raise ModelError(f"a band is drawn along one input; this grid moves {len(moving)} of them")
    column = moving[0] if moving else 0
    x = points[:, column]
    if len(band.explored):
        low, high = band.explored[min(column, len(band.explored) - 1)]
        ax.axvspan(low, high, color="C2", alpha=0.12, linewidth=0, label="explored")
    ax.fill_between(x, band.low, band.high, color="C0", alpha=0.3, linewidth=0)
    ax.plot(x, band.mean, color="C0", linewidth=1.6, label=label)
    if truth is not None:
        values = truth(band.grid) if callable(truth) else truth
        ax.plot(x, np.asarray(values, float), "--", color="C3", linewidth=1.4, label="true")
    inside = band.inside if len(band.explored) else np.ones(len(x), bool)
    if inside.any():  # a band that is wide elsewhere would leave nothing to be seen
        low, high = band.low[inside].min(), band.high[inside].max()
        room = max(high - low, np.ptp(band.mean)) * 0.4 or 1.0
        ax.set_ylim(min(low, band.mean.min()) - room, max(high, band.mean.max()) + room)
    ax.set_xlabel("input")
    ax.set_ylabel("law")
    ax.grid(True, alpha=0.3)
    ax.legend()
    return ax


def plot_table(table: "Table", ax: Any, true: Mapping[str, float] | None) -> Any:
    """Intervals relative to the values, in per cent; those that are not determined are said."""
    rows = list(table)
    ax = new_axes(ax, 7.0, 0.38 * len(rows) + 1.2)
    for k, row in enumerate(rows):
        size = abs(row.value) or 1.0
        if np.isfinite(row.high - row.low):
            ends = [100 * (end - row.value) / size for end in (row.low, row.high)]
            ax.plot(ends, [k, k], color="C0", linewidth=5, alpha=0.45, solid_capstyle="butt")
            ax.plot(0, k, "o", color="C0", markersize=4)
        else:
            ax.axhspan(k - 0.3, k + 0.3, color="C3", alpha=0.15, linewidth=0)
        if true is not None and row.name in true:
            ax.plot(100 * (float(true[row.name]) - row.value) / size, k, "x", color="C3", markersize=7)
        if row.note:
            ax.annotate(row.note, (0.995, k), xycoords=("axes fraction", "data"), ha="right", va="center", fontsize=8)
    ax.set_yticks(range(len(rows)), [f"{row.name} = {row.value:.4g}{' ' * bool(row.unit)}{row.unit}" for row in rows])
    ax.set_ylim(len(rows) - 0.5, -0.5)
    ax.set_xlabel(f"{100 * table.level:g} % interval, relative to the value [%]")
    ax.grid(True, axis="x", alpha=0.3)
    return ax


def plot_spectrum(found: "Identifiability", ax: Any) -> Any:
    """The eigenvalues of the scaled Fisher information; below one, nothing is known of a direction."""
    ax = new_axes(ax)
    floor = np.finfo(float).tiny
    ax.semilogy(np.arange(1, len(found.spectrum) + 1), np.maximum(found.spectrum, floor), "o", markersize=4)
    ax.axhspan(ax.get_ylim()[0], 1.0, color="C3", alpha=0.1, linewidth=0, label="not determined")
    ax.set_xlabel("direction")
    ax.set_ylabel("eigenvalue")
    ax.grid(True, alpha=0.3)
    ax.legend()
    return ax


def plot_prediction(found: "Prediction", names: Any, axes: Any) -> np.ndarray:
    """Predicted variables over time with their bands."""
    chosen = _chosen(names, list(found.mean), "predictions of")
    axes = grid_of_axes(axes, len(chosen), 1, "a plot of predictions")
    for ax, name in zip(axes[:, 0], chosen, strict=True):
        ax.fill_between(found.ts, found.low[name], found.high[name], color="C0", alpha=0.3, linewidth=0)
        ax.plot(found.ts, found.mean[name], color="C0", linewidth=1.5)
        ax.set_ylabel(name)
        ax.grid(True, alpha=0.3)
    axes[-1, 0].set_xlabel("time [s]")
    return axes[:, 0]
