"""The delayed quantities of all components, as one table."""

import numpy as np

from ..model.delays import NO_DELAYS, DelayTable
from .collect_events import in_parameters
from .number_model import Instances, ModelNumbers


def delay_table(model: ModelNumbers) -> DelayTable:
    """The delayed quantities, in the order of declaration."""
    found = sorted(
        (
            (k, n, row, i)
            for i in model.instances
            for n in range(len(i.component.delays))
            for row, k in enumerate(i.number.tolist())
        ),
        key=lambda entry: entry[:2],
    )
    if not found:
        return NO_DELAYS
    place = {int(p): k for k, p in enumerate(model.discrete)}

    def parameter(i: Instances, path: str, row: int) -> int:
        return int(model.parameter(i, path)[row])

    text, source, instant, read, longest, constant = [], [], [], [], [], []
    for k, n, row, i in found:
        delay = i.component.delays[n]
        text.append(f"{model.paths[k]}.{delay.name}")
        source.append(model.variable(i, delay.source)[row])
        instant.append(model.variable(i, delay.instant)[row])
        names = (delay.begins, delay.base, delay.value, delay.rate, delay.bend)
        read.append([place[parameter(i, name, row)] for name in names])
        longest.append(in_parameters(model, parameter, i, row, delay.longest))
        constant.append(delay.is_constant)
    source, instant, read = (np.array(column, np.int64) for column in (source, instant, read))
    return DelayTable(tuple(text), source, instant, read, tuple(longest), tuple(constant))
