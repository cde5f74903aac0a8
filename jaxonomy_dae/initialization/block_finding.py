"""What is found out about blocks that are singular, or nearly so."""

import dataclasses

DENSE_LIMIT = 200  # unknowns up to which a block gets a singular value decomposition


@dataclasses.dataclass(frozen=True)
class BlockFinding:
    """A block that is singular, or nearly so: the variables it leaves open, the equations that depend on each other,
    and the parameters and variables that make it so, with their values.

    `undecided`: it is regular as its numbers stand, and singular within their errors, so that nobody can tell.
    """

    condition: float
    singular: bool
    size: int
    variables: tuple[str, ...]
    equations: tuple[str, ...]
    causes: tuple[tuple[str, float], ...]
    causes_are_parameters: bool
    undecided: bool = False
