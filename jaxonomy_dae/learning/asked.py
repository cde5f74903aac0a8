"""What a problem asks for, checked against its system: every refusal names what there is instead."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..base.errors import ModelError, by_name, nearest
from ..compile.diagnosis.unused_parameters import unused_parameters
from ..compile.model.tables import ZERO
from ..run.system.system import AcausalSystem
from .coordinates import Coordinate, Coordinates
from .data import Stacked
from .experiment import Unknown
from .filtering import Filter, Innovations, check_model
from .multiple_shooting import Shooting
from .priors import is_finite
from .program import SensorLaw, weights_of
from .training import Training

METHODS = ("single", "growing")


def names_to_train(
    system: AcausalSystem, observers: Mapping[str, SensorLaw], train: Sequence[str] | str | None
) -> tuple[list[str], list[str]]:
    """(parameters one by one, modules) to be trained."""
    chosen = list(system.neural) if train is None else [train] if isinstance(train, str) else list(train)
    table, parameters, modules = system.parameters.table, [], []
    for name in dict.fromkeys(chosen):
        if name in system.neural or name in observers:
            module = system.neural[name] if name in system.neural else observers[name]
            if not weights_of(module):
                raise ModelError(f"train: '{name}' has no numbers to be trained")
            modules.append(name)
        elif name in system.parameters:
            for one in table.one_by_one(name):
                table.settable(one)
                parameters.append(one)
        else:
            known = [*system.neural, *observers, *table.names]
            raise ModelError(
                f"train: '{name}' is neither a parameter, a network nor a sensor law: " + nearest(name, known)
            )
    unused = unused_parameters(system.plan.flat)
    for name in parameters:
        if table.index(name) in unused:
            raise ModelError(
                f"train: nothing in the model reads parameter '{name}', so no data can determine it: leave it out"
            )
    return list(dict.fromkeys(parameters)), modules


def check_start(system: AcausalSystem, trained: Sequence[str], name: str, is_unknown: bool) -> None:
    """Refuses a start that does not exist, or cannot be unknown; `trained` parameters are those of all experiments."""
    plan, table = system.plan, system.parameters.table
    if name in table.names:
        table.settable(name)
        if name in trained:
            raise ModelError(f"'{name}' is trained, and each experiment's own as well: leave one of them out")
        return
    if name not in plan.variable_index:
        known = [*plan.visible_variables, *table.names]
        raise ModelError(f"the start of '{name}' is not that of a variable: " + nearest(name, known))
    if is_unknown:
        quantity = int(plan.resolve([name])[0][0])
        quantities = plan.extended.quantities
        if quantity == ZERO or quantities.highest[quantities.owner[quantity]] <= quantities.order[quantity]:
            raise ModelError(
                f"'{name}' is algebraic: its start follows from the others and cannot be unknown. Starts of "
                + ", ".join(repr(s) for s in system.states[:8])
                + " can"
            )


def penalties(system: AcausalSystem, modules: Sequence[str], given: Any) -> dict[str, float | str | None]:
    """The regularization of each trained module's weights: "evidence", a precision, or None."""
    if not isinstance(given, Mapping):
        given = {name: given for name in modules if name in system.neural}
    for name, value in given.items():
        if name not in modules:
            raise ModelError(f"regularize: '{name}' is no network that is trained: " + nearest(name, modules))
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not (value is None or value == "evidence" or (number and value >= 0 and math.isfinite(value))):
            raise ModelError(f"regularize: '{name}' takes 'evidence', a precision ≥ 0 or None; got {value!r}")
    return {name: given.get(name) for name in modules}


def checked_method(system: AcausalSystem, given: object) -> str | Shooting | Filter | Innovations:
    """The method, if it is one and goes with the model."""
    if isinstance(given, Filter | Innovations):
        check_model(given, system)
        return given
    if given not in METHODS and not isinstance(given, Shooting):
        raise ModelError(
            "method is 'single', 'growing' or Shooting(nodes=30), Filter(noise={'room.T': 'estimate'}) or "
            f"Innovations(); got {given!r}"
        )
    plan = system.plan
    if isinstance(given, Shooting):
        plan.refuse_delays("the nodes of multiple shooting hold no past: use method='growing'")
    if isinstance(given, Shooting) and system.discretes:
        raise ModelError(
            f"method: '{system.discretes[0]}' is a discrete variable, which the nodes of multiple shooting do "
            "not carry from segment to segment: use method='growing'"
        )
    if isinstance(given, Shooting) and plan.events is not None and (plan.events.state >= 0).any():
        raise ModelError(
            f"method: events of this model write states ({plan.events.names[0]}), and a node of multiple shooting does "
            "not tell on which side of an event it lies: use method='growing'"
        )
    if isinstance(given, Shooting) and plan.held is not None:
        raise ModelError(
            "method: constraints of this model come and go with its modes, so that the nodes of multiple shooting "
            "have no fixed number of degrees of freedom: use method='growing'"
        )
    return given


def started(system: AcausalSystem, start: AcausalSystem) -> AcausalSystem:
    """The system at whose values a search begins, if it is one of the same model."""
    merged = start.merged()
    if merged.plan != system.plan:
        raise ModelError("start is a system of another model: give one of the same, or values by names")
    return merged


def as_asked(c: Coordinates, freeze: Any, start: Any, bounds: Mapping[str, Any] | None) -> Coordinates:
    """Coordinates with the values where a search begins, what is held and narrower bounds; arguments as of
    `Problem.fit`."""
    values: dict[str, Any] = {}
    if isinstance(start, Training):
        known = start.objective.coordinates
        if known.names != c.names:
            raise ModelError("start is a training of other unknowns or experiments: train this problem, or give names")
        c = dataclasses.replace(c, start=known.natural(start.objective.full(start.z)))
    elif start is not None and not isinstance(start, AcausalSystem):
        values = by_name("start", start, "'motor.R': 1.2")
    names = [freeze] if isinstance(freeze, str) else freeze
    held = dict(names) if isinstance(names, Mapping) else dict.fromkeys(names)
    return (
        c.bounded(by_name("bounds", bounds, "'motor.R': (0.1, 10)"))
        .changed(values, fixed=False)
        .changed(held, fixed=True)
    )


def dead_times(delay: Mapping[str, Any], stacked: Stacked, method: Any) -> tuple[Coordinate, ...]:
    """The coordinates of dead times: between zero and the length of the shortest record that is fitted."""
    if method not in METHODS:
        raise ModelError(f"delay= goes with runs, not with method={type(method).__name__}: use method='single'")
    lasting = np.array([stacked.times[k, count - 1] for k, count in enumerate(stacked.counts)]) - stacked.t0
    chosen = ~stacked.holdout if (~stacked.holdout).any() else stacked.holdout
    shortest = int(np.argmin(np.where(chosen, lasting, np.inf)))
    most = float(lasting[shortest])
    rows = []
    for name, given in delay.items():
        if name not in stacked.inputs and name not in stacked.outputs:
            known = [*stacked.inputs, *stacked.outputs]
            raise ModelError(
                f"delay: '{name}' is neither an input of the experiments nor measured: " + nearest(name, known)
            )
        guess = given.guess if isinstance(given, Unknown) else given
        if not is_finite(guess) or guess < 0:
            raise ModelError(f"delay of '{name}' is a time ≥ 0 in seconds, or Unknown(guess); got {given!r}")
        if guess >= most:
            raise ModelError(
                f"delay of '{name}' is {guess:g} s, and {stacked.labels[shortest]} lasts {most:g} s, so nothing of it "
                "would be seen: give less, or a longer record"
            )
        is_unknown, spread = isinstance(given, Unknown), getattr(given, "spread", None)
        size = spread or guess or most / max(stacked.counts[shortest], 1)
        rows.append(
            Coordinate(
                f"delay of {name}", "s", f"delay of {name}", False, False, size, float(guess), low=0.0, high=most,
                spread=math.inf if spread is None else spread / size, fixed=not is_unknown, centre=guess / size,
            )
        )  # fmt: skip
    return tuple(rows)
