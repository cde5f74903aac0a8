"""What all components of one model share."""

from .real_number import real_number
from .symbols import ENVIRONMENT_TIME, TimeSymbol


class EqnEnv:
    """The environment of a model's equations.

    **Arguments:**

    - `constants`: named numbers that every component can read, such as `gravity=9.81`, as `ev.constants["gravity"]`.
        They are plain numbers. Use a parameter for a value that is trained or varied.

    `ev.t` is the symbol of time, for use in any equation.

    **Raises:**

    - `ModelError` for a constant that is not a finite real number.
    """

    t: TimeSymbol
    constants: dict[str, float]

    def __init__(self, **constants: float):
        self.t = ENVIRONMENT_TIME
        self.constants = {k: real_number(v, f"the constant '{k}' of EqnEnv") for k, v in constants.items()}

    def __repr__(self):
        inside = ", ".join(f"{k}={v}" for k, v in self.constants.items())
        return f"EqnEnv({inside})"
