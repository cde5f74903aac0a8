"""What a model may lack: changes of its predictions, each by a few unknown numbers.

A change is a sum of columns c. Of a sensor, a column is a signal that is added to an output. Of an equation, it is the
answer of all outputs to a term in the slope of a state (`linearized.py`): a law, a disturbance, or an input that acts
otherwise. What the fitted numbers of the model can take up of it, with their priors, is taken away: what is left shows
what the change would explain if all were fitted again (a score test; Rao 1948, Math. Proc. Camb. Phil. Soc. 44:50).
"""

import dataclasses
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from .leftover import Leftover
from .linearized import Linearized

if TYPE_CHECKING:
    from .estimate import Estimate

WIDEST = 40  # states, beyond which answers cost more than the fit did
PLACES = 24  # at which a step of a disturbance is tried
# An input is read at so many times between two samples.
PARTS = 16
EDGE = 4  # samples on each side of a step
# The model's own numbers take up a column of whose square less than this part is left beside them.
TAKEN = 1e-4
DAY = 86400.0  # s
# A state changes its sign if it goes beyond zero by this part of its size on both sides.
TURNS = 0.02
FORM = 4  # coefficients of a polynomial that stands for a law of another form
DAYS = 2  # in a record, from which a daily disturbance is looked for

SLOW = (
    "something slow acts that was not measured: let the equations err, method=learning.Filter(noise), or make it a "
    "parameter of each record"
)
BENT = "what it passes through saturates, has a dead zone, or is not linear"
DAILY = "what comes and goes with the day (sun, people, tariffs) is missing: give it as an input"


class Change(NamedTuple):
    """A change of predictions: what is said of it, what it speaks for, its columns in the outputs' units, and how many
    numbers it takes, its place included."""

    clause: str
    speaks: str
    columns: Float[np.ndarray, "m q"]
    numbers: int


@dataclasses.dataclass(frozen=True)
class Judge:
    """What residuals a change would explain. `residual`: predictions less data, times the roots of their weights;
    `judged`: the samples whose form is judged."""

    residual: Float[np.ndarray, " m"]
    judged: Bool[np.ndarray, " m"]
    fit: "Estimate"
    left: Leftover

    @classmethod
    def of(cls, fit: "Estimate", left: Leftover) -> "Judge":
        """The judge of a fit, as if outliers had not been fitted."""
        judged = np.zeros(len(left.scores), bool)
        for at in left.by_output.values():
            judged[at] = True
        residual = np.where(judged, left.share * left.cleaned, 0.0)
        return cls(residual, judged, fit, left)

    @property
    def whole(self) -> float:
        """The sum of squares of residuals."""
        return float(np.sum(self.residual**2))

    def explained(self, columns: Float[np.ndarray, "m q"]) -> tuple[float, Float[np.ndarray, " q"]]:
        """(the sum of squares that columns explain together, how much there is of each)."""
        weights, lever = self.fit.minimum.weights, self.left.leverage
        c = weights.informing[:, None] * self.fit.objective.colour.whitened(columns)
        c = np.where(self.judged[:, None], c, 0.0)
        size = np.linalg.norm(c, axis=0)
        c = c / np.where(size > 0, size, 1.0)
        open_part = c - lever @ (lever.T @ c)
        values, axes = np.linalg.eigh(c.T @ open_part)
        axes, values = axes[:, values > TAKEN], values[values > TAKEN]
        along = -(axes.T @ (open_part.T @ self.residual))
        return float(np.sum(along**2 / values)), axes @ (along / values) / np.where(size > 0, size, 1.0)


def laws(model: Linearized) -> Iterator[Change]:
    """Terms in the slope of a state that follow the states it depends on."""
    x = model.along.states
    for i in model.driven:
        for j in model.reads(i):
            own, name = x[..., j], model.states[j]
            size = np.max(np.abs(own)) or 1.0
            turns = np.min(own) < -TURNS * size and np.max(own) > TURNS * size
            more = (
                f"the law of '{name}' is not linear where the model's is, or has another form: it lacks a term with its"
            )
            kinds = {
                f"in proportion to '{name}'": (own, f"a term in proportion to '{name}' is missing, or a gain is wrong"),
                f"with the square of '{name}'": (own**2, f"{more} square"),
                f"with the cube of '{name}'": (own**3, f"{more} cube"),
            }  # fmt: skip
            if turns:
                drag = f"a drag that grows with the square of '{name}' is missing" if i == j else f"{more} square"
                jump = f"dry friction of '{name}' is missing" if i == j else f"the law of '{name}' jumps at zero"
                kinds[f"with the sign of '{name}'"] = np.sign(own), jump
                kinds[f"with '{name}' times its size"] = own * np.abs(own), drag
            columns = model.answers(i, np.stack([between(term) for term, _ in kinds.values()], axis=-1))
            powers = own[..., None] ** np.arange(FORM)
            yield Change(
                f"{_slope(model, i)} lacks a curve over '{name}'",
                f"the law of '{name}' is not linear where the model's is, or has another form",
                model.answers(i, between(powers)), FORM,
            )  # fmt: skip
            for k, (what, (_, speaks)) in enumerate(kinds.items()):
                yield Change(f"{_slope(model, i)} lacks a term {what}", speaks, columns[:, [k]], 1)


def readings(model: Linearized, fit: "Estimate") -> Iterator[Change]:
    """Outputs that are not linear in a state where the model's are, or have another form."""
    experiment, row, output = model.rows
    at = model.along.states[experiment, row + 1]
    for j in np.unique(output):
        shown = fit.objective.stacked.outputs[j]
        for k, name in enumerate(model.states):
            speaks = f"'{shown}' is another function of '{name}' than in the model"
            powers = at[:, [k]] ** np.arange(FORM) * (output == j)[:, None]
            yield Change(f"'{shown}' lacks a curve over '{name}'", speaks, powers, FORM)


def disturbances(model: Linearized) -> Iterator[Change]:
    """Terms in the slope of a state that follow time alone."""
    t = model.times - model.times[:, :1]
    whole = np.max(t) or 1.0
    for i in model.driven:
        where = f"{_slope(model, i)} lacks"
        terms = [np.ones_like(t), t / whole]
        (constant, drift) = model.answers(i, np.stack([between(term) for term in terms], axis=-1)).T
        yield Change(f"{where} a constant", "a constant input, or a bias of one, is missing", constant[:, None], 1)
        yield Change(f"{where} a drift", SLOW, np.stack([constant, drift], axis=1), 2)
        if whole >= DAYS * DAY:
            waves = [f(2 * np.pi * k * model.times / DAY) for k in (1, 2) for f in (np.sin, np.cos)]
            columns = model.answers(i, np.stack([between(wave) for wave in waves], axis=-1))
            yield Change(f"{where} a term with a period of 86400 s (a day)", DAILY, columns, 4)
        yield from _switches(model, i, where, constant)


def _switches(model: Linearized, i: int, where: str, constant: np.ndarray) -> Iterator[Change]:
    """Constants, and terms in proportion to a state, that begin within a record."""
    own = model.along.states[..., i]
    always = model.answers(i, between(own)[..., None])[:, 0]
    for e in np.unique(model.rows[0]):
        count = int(np.max(model.rows[1][model.rows[0] == e])) + 1
        places = np.unique(np.linspace(EDGE, count - EDGE, PLACES).astype(int)) if count > 2 * EDGE else []
        if not len(places):
            continue
        from_then = np.zeros((*model.times[:, 1:].shape, len(places)))
        for k, place in enumerate(places):
            from_then[e, place:, k] = 1.0
        pushes = model.answers(i, from_then), model.answers(i, between(own)[..., None] * from_then)
        for k, place in enumerate(places):
            at = f"from t = {model.times[e, place]:.4g} on"
            speaks = f"something was switched, or broke, near t = {model.times[e, place]:.4g}: look what happened"
            yield Change(f"{where} a constant {at}", speaks, np.stack([constant, pushes[0][:, k]], axis=1), 3)
            yield Change(
                f"{where} a term in proportion to '{model.states[i]}' {at}", speaks,
                np.stack([always, pushes[1][:, k]], axis=1), 3,
            )  # fmt: skip


def inputs(model: Linearized, fit: "Estimate") -> Iterator[Change]:
    """Inputs that act otherwise: by another gain, late, not in proportion."""
    s = fit.objective.stacked
    starts, ends = model.times[:, :-1], model.times[:, 1:]
    parts = (np.arange(PARTS) + 0.5) / PARTS
    inside = starts[..., None] + parts * (ends - starts)[..., None]
    late = float(np.median(np.diff(model.times, axis=1)[model.times[:, 1:] > model.times[:, :-1]])) / 4
    b = (model.along.by_input[:, 1:] + model.along.by_input[:, :-1]) / 2
    for p, name in enumerate(model.inputs):
        delay = fit.values.get(f"delay of {name}", 0.0)

        def read(at: np.ndarray, name=name, delay=delay) -> np.ndarray:
            return np.stack([s.input_at(name, k, times - delay) for k, times in enumerate(at)])

        u, before = read(inside), read(inside - late)
        low, high = np.quantile(u, [0.25, 0.75])
        terms = {
            "acts by another gain": (u, "its gain differs from the model's"),
            "is late": (before - u, "it passes through something that delays it, or its times are shifted"),
            "has an offset": (np.ones_like(u), "it has a bias"),
            "does not act in proportion": (u**2, BENT),
            "saturates": (np.maximum(u - high, 0.0), BENT),
            "has a dead zone": (np.minimum(u - low, 0.0), BENT),
        }
        means = np.stack([w.mean(axis=-1) for w, _ in terms.values()], axis=-1)
        columns = model.moved(np.einsum("enfg,eng,enq->enfq", model.along.gathered, b[..., p], means))
        for k, (what, (_, why)) in enumerate(terms.items()):
            yield Change(
                f"the input '{name}' {what}", f"the input '{name}' acts otherwise than the model says: {why}",
                columns[:, [k]], 2 if why == BENT else 1,
            )  # fmt: skip


def between(at: Any) -> Float[np.ndarray, "e n *q"]:
    """Means from each time to the next."""
    return (at[:, 1:] + at[:, :-1]) / 2


def _slope(model: Linearized, i: int) -> str:
    return f"der({model.states[i]})"
