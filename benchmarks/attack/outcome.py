"""What became of a model, and a table of many."""

import collections
import dataclasses
from collections.abc import Iterable

KINDS = ("right", "refused", "untrue", "crashed", "late", "wrong")
GOOD = ("right", "refused")


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What became of a model.

    - `kind`: 'right'; 'refused', by a named error that is true; 'untrue', a right model refused, or an ill-posed one
        refused for another reason; 'crashed', by an error that is not the package's; 'late'; or 'wrong'.
    - `error`: the worst error in units of what is allowed. `text`: where it was, or the error's message.
    - `seconds`: of processor time.
    - `part`: what part of a family it is counted with, if that has several.
    """

    kind: str
    error: float
    text: str
    seconds: float
    part: str = ""


HEAD = f"{'':<22}" + "".join(f"{k:>9}" for k in KINDS) + "   worst/allowed   s each   slowest"


def row(name: str, outcomes: Iterable[tuple[int, Outcome]]) -> str:
    """A line of the table, of the outcomes with their seeds."""
    pairs = list(outcomes)
    tally = collections.Counter(o.kind for _, o in pairs)
    worst = max((o.error for _, o in pairs if o.kind == "right"), default=0.0)
    slowest, longest = max(((s, o.seconds) for s, o in pairs), key=lambda pair: pair[1])
    each = sum(o.seconds for _, o in pairs) / len(pairs)
    counts = "".join(f"{tally[k]:>9}" for k in KINDS)
    return f"{name:<22}{counts}{worst:>16.1e}{each:>9.1f}   {longest:.1f} s: seed {slowest}"
