"""Which models are drawn, and how one of them is judged."""

import dataclasses
import importlib
import itertools
from collections.abc import Iterator, Sequence

from .outcome import Outcome

NETWORKS = ("resistors", "circuits", "rods", "gears", "thermal", "pipes", "mechanisms", "descriptors")
SWITCHING = ("relations", "converters", "drives", "shafts")  # families with variants of their parameters
OWN = (
    "singular",
    "rings",
    "switches",
    "blocks",
    "pairs",
    "idle",
    "invariance",
)  # they say themselves what is right, by `judged(seed)`
FAMILIES = (*NETWORKS, "events", "beside", "flat", *SWITCHING, "gradients", *OWN)
UNITS = ("equations", "parameters", "units", "all")  # what is rescaled: `benchmarks/rescaling.py`
PUBLISHED = "published"  # problems that are their own references, in other units

STRIDE = 1_000_000  # between the models of one seed and the next
MOVING = 4  # every so many-th model of a family is integrated as well


@dataclasses.dataclass(frozen=True)
class Draw:
    """The model of a family with a seed, in other `units` unless that is empty; integrated as well if `moving`; with so
    many `variants`."""

    family: str
    seed: int
    units: str = ""
    moving: bool = False
    variants: int = 0

    @property
    def row(self) -> str:
        """The line of the table that counts it."""
        return f"{self.family}, rescaled" if self.units else self.family

    def row_of(self, number: int, outcome: Outcome) -> str:
        """The line of the table that counts the outcome of this number."""
        if outcome.part:
            return f"{self.row} {outcome.part}"
        return f"{self.row}, variants" if number and self.variants else self.row

    @property
    def command(self) -> str:
        """What shows it again."""
        units = f" --units {self.units}" if self.units else ""
        more = " --moving 1" if self.moving else ""
        more += f" --variants {self.variants}" if self.variants else ""
        return f"python -m benchmarks.attack --family {self.family}{units} --seed {self.seed} --count 1{more}"

    def judged(self) -> tuple[str, list[Outcome]]:
        """What model it is, and what became of it and of its variants. What goes wrong while it is drawn counts as
        well."""
        from . import rescaled  # these import JAX, which the process that only counts does without
        from .judge import judge, timed

        module = importlib.import_module(f".{self.family}", __package__)
        if self.family in OWN:
            return timed(lambda: module.judged(self.seed))
        make = module.make
        try:
            if self.units:
                make = rescaled.family(make, self.units)
            case = make(self.seed, variants=self.variants) if self.variants else make(self.seed)
        except Exception as error:
            return "", [Outcome("crashed", float("inf"), f"when drawn: {type(error).__name__}: {error}", 0.0)]
        return case.note, judge(case, self.moving)


def draws(families: Sequence[str], seed: int) -> Iterator[Draw]:
    """One model of each family after the other, as it is and rescaled, without end."""
    for r in itertools.count():
        number = seed * STRIDE + r
        for k, family in enumerate(families):
            if family != PUBLISHED:
                yield Draw(family, number, moving=family in NETWORKS and (r + k) % MOVING == 0)
            if family in NETWORKS or family == PUBLISHED:
                yield Draw(family, number, UNITS[(r + k) % len(UNITS)])
