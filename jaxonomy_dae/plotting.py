"""Figures of solutions, structures and frequency responses, with Matplotlib (extra `plot`)."""

from typing import Any, Protocol, runtime_checkable

import numpy as np
from jax import Array

from .base.errors import ModelError
from .base.optional import QUANTITIES, Axes, axis_label, legend_beside, new_axes, optional_module, pyplot
from .run.simulation.labelled import ByName
from .run.system.system import AcausalSystem

SEPARATE = 12  # entries of an array that get a colour each
NAMED = 40  # up to this many unknowns, rows and columns are labelled
LINES = 40  # up to this many events are marked by lines as high as the axes, more by ticks at the bottom
DASHES = [(0, (5, 3)), (0, (1, 2)), (0, (5, 2, 1, 2)), (0, (9, 3))]  # of events with different names, if few
TICK = 0.04  # of the height of the axes
ROUNDING = 1e-6  # of the time that is drawn


# `analysis.response` draws by this module: a protocol in place of its class keeps imports one way.
@runtime_checkable
class Response(Protocol):
    """A `FrequencyResponse`, as its figures read it: by pairs (output, input)."""

    @property
    def omega(self) -> Array:
        """Angular frequencies (rad/s), shape (k,)."""
        ...

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs."""
        ...

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs."""
        ...

    def __getitem__(self, pair: Any) -> Any:
        """The complex response of one output to one input, shape (k,)."""
        ...


def plot_solution(solution: ByName, *names: str, ax: Axes | None = None, events: bool = True) -> Any:
    """Draws variables over time, discrete ones as steps: one panel for each unit, one below the other. Of a batch, each
    member has a line.

    **Arguments:**

    - `names`: of variables; default: the differential states. An array of more than 12 is drawn in one colour.
    - `ax`: Matplotlib axes to draw everything into; a new figure by default.
    - `events`: whether the events in `solution.events` are marked by thin vertical lines, more than 40 by ticks. The
        legend names them, if there are few.

    **Returns:** the Matplotlib axes; an array of them if there are several panels.
    """
    # A solution that saved some variables only has not all states.
    names = names or tuple(n for n in solution.system.states if n in solution)
    if not names:
        raise ModelError("nothing to plot: the system has no states; name some variables")
    flat = solution.system.plan.flat
    unit_of = dict(zip(flat.variables.names, flat.variables.unit, strict=True))
    unit_of |= dict(zip(flat.parameters.names, flat.parameters.units, strict=True))
    lines = [one for name in names for one in _lines(solution, name)]
    units = [unit_of.get(_entries(solution, name)[0]) or "" for name in lines]
    # In the order of the names, which the reader chose.
    panels = list(dict.fromkeys(units))
    if ax is not None or len(panels) == 1:
        axes = new_axes(ax)
        _panel(solution, lines, units, axes, events)
        return axes
    size = (7.0, 2.1 * len(panels) + 0.6)
    _, axes = pyplot().subplots(len(panels), 1, sharex=True, figsize=size, layout="constrained")
    for panel, unit in zip(axes, panels, strict=True):
        chosen = [name for name, its in zip(lines, units, strict=True) if its == unit]
        _panel(solution, chosen, [unit] * len(chosen), panel, events)
        panel.label_outer()
    return axes


def _panel(solution: ByName, names: list[str], units: list[str], ax: Axes, events: bool) -> None:
    """Draws some variables into one pair of axes."""
    time = np.asarray(solution.ts)
    common = units[0] if len(set(units)) == 1 else None
    for name, unit in zip(names, units, strict=True):
        label = name if common is not None else axis_label(name, unit)
        values = np.asarray(solution[name])
        style = "steps-post" if _entries(solution, name)[0] in solution.system.discretes else "default"
        if values.ndim == 1:
            points = (time, values) if style == "default" else _steps(solution, name)
            ax.plot(*points, label=label, linewidth=1.6, drawstyle=style)
            continue
        # One colour and one entry of the legend for an array, and for a batch, whose members have times of their own: a
        # thousand cells have no names worth reading.
        times = time.reshape(-1, time.shape[-1])
        curves = values.reshape(*times.shape, -1)
        line = ax.plot(times[0], curves[0, :, 0], label=label, linewidth=0.8, drawstyle=style)[0]
        for k, (own, rest) in enumerate(zip(times, curves, strict=True)):
            rest = rest[:, 1:] if k == 0 else rest
            ax.plot(own, rest, color=line.get_color(), linewidth=0.8, alpha=0.5, drawstyle=style)
    marked = _mark_events(solution, ax) if events else False
    ax.set_xlabel("Time / s")
    if len(names) == 1:
        ax.set_ylabel(axis_label(names[0], units[0]))
    elif common and common != "1":
        ax.set_ylabel(axis_label(QUANTITIES.get(common, "Value"), common))
    ax.grid(True, alpha=0.3)
    if len(names) > 1 or marked:
        legend_beside(ax)


def _entries(solution: ByName, name: str) -> list[str]:
    """The names of the entries of an array, or the one name of a variable."""
    entries = solution.system.plan.entries(name)
    return [name] if entries is None else entries[0]


def _lines(solution: ByName, name: str) -> list[str]:
    """The names under which a variable, or an array of variables, is drawn."""
    entries = _entries(solution, name)
    return [name] if len(entries) > SEPARATE else entries


def _steps(solution: ByName, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Returns (times, values) of a discrete variable: at the saved times, and after events between them as far as these
    were kept."""
    time, values = np.asarray(solution.ts), np.asarray(solution[name])
    log = solution.event_log
    if log is None or not log.after.shape[-2]:
        return time, values
    happened, chosen = np.asarray(log.ts), _seen(solution)
    written = np.asarray(solution.events.after[name])[chosen]
    every = np.concatenate([happened[chosen], time])  # what was saved at an event is what comes after it
    order = np.argsort(every, kind="stable")
    return every[order], np.concatenate([written, values])[order]


def _seen(solution: ByName) -> np.ndarray:
    """True for the noted events that lie within the saved times, shape (events,)."""
    ts, time = np.asarray(solution.events.ts), np.asarray(solution.ts)
    # Rows that a run did not reach are infinite.
    time = time[np.isfinite(time)]
    if not time.size:
        return np.zeros(len(ts), bool)
    slack = ROUNDING * (time.max() - time.min())  # a run that ends with an event is saved there
    return (ts >= time.min() - slack) & (ts <= time.max() + slack)


def _mark_events(solution: ByName, ax: Axes) -> bool:
    """Marks the events within the saved times; returns True if there are any."""
    log = solution.event_log
    if log is None or solution.ts.ndim > 1:  # of a batch, each member has events of its own
        return False
    chosen = _seen(solution)
    ts = np.asarray(log.ts)[chosen]
    names = [solution.events.all_names[int(k)] for k in np.asarray(log.which)[chosen]]
    groups = {name: ts[[one == name for one in names]] for name in dict.fromkeys(names)}
    if len(groups) > 1 and (len(ts) > LINES or len(groups) > len(DASHES)):
        # More names than dashes that can be told apart: one kind of mark for all.
        groups = {"events": ts}
    collections = optional_module("matplotlib.collections", "plot", "plotting needs Matplotlib")
    labelled = ax.get_legend_handles_labels()[1]
    height = 1.0 if len(ts) <= LINES else TICK
    for (name, at), dash in zip(groups.items(), DASHES, strict=False):
        marks = collections.LineCollection(
            # One collection, not a line for each: thousands of bounces draw at once.
            [[(t, 0.0), (t, height)] for t in at], transform=ax.get_xaxis_transform(), zorder=1, colors="0.45",
            linewidths=0.8, linestyles=[dash if height == 1.0 else "solid"],
            label="_" * (name in labelled) + name,  # a legend leaves out what begins with "_"
        )  # fmt: skip
        # Marks do not stretch the axes: their height is that of the axes.
        ax.add_collection(marks, autolim=False)
    return bool(groups)


def phase(solution: ByName, x: str, y: str, ax: Axes | None = None) -> Axes:
    """Draws one variable over another, with a dot at the start; returns the axes. Of a batch, each member has a line.

    **Arguments:**

    - `x`, `y`: names of variables, of no arrays.
    - `ax`: Matplotlib axes to draw into, so that several solutions make one portrait; new ones by default.
    """
    columns = []
    for name in (x, y):
        values = np.asarray(solution[name], float)
        if values.ndim != np.ndim(solution.ts):
            raise ModelError(
                f"a phase portrait takes single variables; '{name}' is an array of {_entries(solution, name)[:3]}"
            )
        columns.append(values.reshape(-1, values.shape[-1]))
    ax = new_axes(ax, 4.6, 4.4)
    flat = solution.system.plan.flat
    units = dict(zip(flat.variables.names, flat.variables.unit, strict=True))
    for across, up in zip(*columns, strict=True):
        (line,) = ax.plot(across, up, linewidth=1.4)
        ax.plot(across[:1], up[:1], "o", color=line.get_color(), markersize=5)
    for name, put in ((x, ax.set_xlabel), (y, ax.set_ylabel)):
        put(axis_label(name, units.get(name)))
    ax.grid(True, alpha=0.3)
    return ax


def structure(system: AcausalSystem, ax: Axes | None = None) -> Axes:
    """Draws the incidence matrix in block lower triangular order, and returns the axes.

    Rows are equations, columns the unknowns they are solved for; a dot says that the equation contains the unknown.
    Simultaneous blocks are framed, their tearing variables red.
    """
    plan = system.plan
    blocks, extended = plan.blocks, plan.extended
    n = len(blocks.unknowns)
    if not n:
        raise ModelError("nothing to draw: the system has no equations to solve")
    wanted = np.zeros(extended.quantities.n, bool)
    wanted[blocks.unknowns] = True
    pointer, quantity = extended.incidence(wanted)
    row_of = np.full(extended.n_equations, -1)
    row_of[blocks.equations] = np.arange(n)
    column_of = np.full(extended.quantities.n, -1)
    column_of[blocks.unknowns] = np.arange(n)
    row = row_of[np.repeat(np.arange(extended.n_equations), np.diff(pointer))]
    column = column_of[quantity][row >= 0]
    row = row[row >= 0]
    torn = [column_of[quantities] for step in plan.steps for quantities in step.torn]
    is_torn = np.isin(column, np.concatenate(torn)) if torn else np.zeros(len(column), bool)
    side = float(np.clip(0.22 * n + 2.0, 3.5, 9.0))
    ax = new_axes(ax, side, side)
    # In points², as `scatter` has it: dots fill about the same part of a cell at any size.
    dot = float(np.clip(2000.0 / n**2, 0.5, 40.0))
    ax.scatter(column[~is_torn], row[~is_torn], s=dot, color="C0", linewidths=0)
    ax.scatter(column[is_torn], row[is_torn], s=dot, color="C3", linewidths=0)
    for k in range(len(blocks)):
        first, last = int(blocks.pointer[k]), int(blocks.pointer[k + 1])
        if last - first > 1:
            corner, side = (first - 0.5, first - 0.5), last - first
            ax.add_patch(pyplot().Rectangle(corner, side, side, fill=False, color="0.4", linewidth=0.8))
    ax.set_xlim(-0.5, n - 0.5)
    # The first equation is at the top, as matrices are written.
    ax.set_ylim(n - 0.5, -0.5)
    ax.set_aspect("equal")
    if n <= NAMED:
        ax.set_xticks(range(n), [plan.quantity_name[q] for q in blocks.unknowns], rotation=90, fontsize=7)
        ax.set_yticks(range(n), [_equation_label(plan, int(e)) for e in blocks.equations], fontsize=7)
        ax.grid(True, alpha=0.2)
    else:
        ax.set_xlabel(f"{n} unknowns")
        ax.set_ylabel(f"{n} equations")
    return ax


def bode(response: Response, *pairs: tuple[str, str], axes: Any = None) -> Any:
    """Draws magnitudes (dB) and phases (degrees, unwrapped) over the angular frequency; returns the two axes.

    **Arguments:**

    - `response`: as `frequency_response` returns it.
    - `pairs`: `(output, input)` each; default: all.
    - `axes`: two Matplotlib axes to draw into, for magnitude and phase; new ones by default.
    """
    pairs = _pairs_of(response, pairs)
    if axes is None:
        _, axes = pyplot().subplots(2, 1, sharex=True, figsize=(7.0, 5.0), layout="constrained")
    elif np.shape(axes) != (2,):
        raise ModelError(f"a Bode plot needs two axes, for magnitude and phase; got shape {np.shape(axes)}")
    upper, lower = axes
    # Phases are unwrapped from neighbour to neighbour, so frequencies must ascend.
    order = np.argsort(np.asarray(response.omega))
    omega = np.asarray(response.omega)[order]
    for pair in pairs:
        values = np.asarray(response[pair])[order]
        with np.errstate(divide="ignore"):  # −∞ dB, a gap in the line
            upper.semilogx(omega, 20.0 * np.log10(np.abs(values)), label=_arrow(pair), linewidth=1.6)
        phase = np.angle(values)
        known = np.isfinite(phase)  # not at a pole on the axis, over which phases are unwrapped all the same
        phase[known] = np.unwrap(phase[known])
        lower.semilogx(omega, np.degrees(phase), label=_arrow(pair), linewidth=1.6)
    upper.set_ylabel("Magnitude / dB")
    lower.set_ylabel("Phase / °")
    lower.set_xlabel("Angular frequency / (rad/s)")
    for ax in (upper, lower):
        ax.grid(True, which="both", alpha=0.3)
    legend_beside(upper)
    return axes


def nyquist(response: Response, *pairs: tuple[str, str], ax: Axes | None = None) -> Axes:
    """Draws responses in the complex plane, those of negative frequencies dashed, with the point −1; returns the axes.

    **Arguments:**

    - `response`: as `frequency_response` returns it.
    - `pairs`: `(output, input)` each; default: all.
    - `ax`: Matplotlib axes to draw into; new ones by default.
    """
    pairs = _pairs_of(response, pairs)
    ax = new_axes(ax, 5.0, 5.0)
    order = np.argsort(np.asarray(response.omega))
    for pair in pairs:
        values = np.asarray(response[pair])[order]
        real, imaginary = np.real(values), np.imag(values)
        (line,) = ax.plot(real, imaginary, label=_arrow(pair), linewidth=1.6)
        ax.plot(real, -imaginary, "--", color=line.get_color(), linewidth=1.0)
    ax.plot([-1.0], [0.0], "+", color="C3", markersize=9)
    ax.set_xlabel("Real part")
    ax.set_ylabel("Imaginary part")
    ax.set_aspect("equal", adjustable="datalim")
    ax.grid(True, alpha=0.3)
    legend_beside(ax)
    return ax


def _pairs_of(response: Response, pairs: tuple[tuple[str, str], ...]) -> tuple[tuple[str, str], ...]:
    """The pairs (output, input) to draw: those given, else all. A batch of responses is refused."""
    if np.ndim(response.omega) != 1:
        raise ModelError(f"one response is drawn at a time; this is a batch, omega has shape {response.omega.shape}")
    return pairs or tuple((out, to) for to in response.inputs for out in response.outputs)


def _arrow(pair: tuple[str, str]) -> str:
    return f"{pair[1]} → {pair[0]}"


def _equation_label(plan: Any, equation: int) -> str:
    from .compile.model.tables import provenance_of

    text = str(provenance_of(plan.model.groups, int(plan.extended.base[equation]))).replace("0 = ", "")
    text = text if len(text) <= 40 else text[:39] + "…"
    return text + "\u2032" * int(plan.extended.level[equation])
