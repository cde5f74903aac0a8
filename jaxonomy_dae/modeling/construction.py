"""What happens around a component's `__init__`: symbols among its arguments are marked as its parent's, it is closed
when construction ends, and common slips are explained."""

from typing import Any

from ..errors import ModelError
from .symbols import seen_from_child


class Construction(type):
    """Closes a component when its construction ends: from then on its symbols are seen from the outside."""

    def __call__(cls, *args, **kwargs):
        try:
            outside: tuple[Any, ...] = tuple(map(seen_from_child, args))
            component = super().__call__(*outside, **{k: seen_from_child(v) for k, v in kwargs.items()})
        except TypeError as error:
            hint = _hint(str(error))
            if hint is None:
                raise
            raise ModelError(f"{cls.__name__}: {hint} ({error})") from error
        if "_sealed" not in component.__dict__:
            raise ModelError(f"{cls.__name__}: its __init__ must begin with super().__init__(ev, name)")
        component._sealed = True
        return component


def _hint(error: str) -> str | None:
    """What was probably meant where symbols were treated as numbers."""
    if "cannot determine truth value of Relational" in error:
        return (
            "variables and parameters have no value yet when equations are written, so Python cannot compare them with "
            "if, and, or, min or max. Write Piecewise((a, x > 0), (b, True)), Max or Min from SymPy"
        )
    if "Cannot convert expression to float" in error or "no callable" in error or "as an abstract array" in error:
        return (
            "a function of numbers was called with a symbol. In equations, use SymPy's functions (sympy.sin, "
            "sympy.sqrt, …), not those of math, numpy or jax.numpy"
        )
    return None
