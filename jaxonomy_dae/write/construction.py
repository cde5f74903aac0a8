"""What happens around a component's `__init__`: symbols among its arguments are marked as its parent's, it is closed
when construction ends, and common slips are explained."""

import re

from sympy import SympifyError

from ..base.errors import ModelError, keywords_of, wrong_keyword
from .symbols import SHADOWED, seen_from_child


class Construction(type):
    """Closes a component when its construction ends: from then on its symbols are seen from the outside."""

    def __call__(cls, *args, **kwargs):
        try:
            outside: tuple[object, ...] = tuple(map(seen_from_child, args))
            component = super().__call__(*outside, **{k: seen_from_child(v) for k, v in kwargs.items()})
            if "_sealed" in component.__dict__:
                component._with_events()
        except (TypeError, SympifyError) as error:
            wrong = _wrong_keyword(error, cls)
            if wrong is not None:
                raise ModelError(wrong) from error
            hint = _hint(error, cls.__name__)
            if hint is None:
                raise
            first = str(error).split("\n")[0]
            detail = "" if " at 0x" in first else f" ({first})"  # objects without a name say nothing
            raise ModelError(f"{cls.__name__}: {hint}{detail}") from error
        if "_sealed" not in component.__dict__:
            raise ModelError(f"{cls.__name__}: {_HOW_TO_BEGIN}")
        component._sealed = True
        return component


_HOW_TO_BEGIN = "its __init__ must begin with super().__init__(ev, name)"


def _wrong_keyword(raised: Exception, cls: type) -> str | None:
    """Names the arguments of a class of components, or of a method of it, that was given another one; None for other
    errors."""
    found = re.search(r"^(\w+)\.(\w+)\(\) got an unexpected keyword argument '(\w+)'", str(raised))
    owner = next((c for c in cls.__mro__ if found is not None and c.__name__ == found[1]), None)
    method = None if found is None else getattr(owner, found[2], None)
    if found is None or method is None:
        return None
    where = found[2] if found[2] != "__init__" else cls.__name__
    known = [name for name in keywords_of(method) if where != cls.__name__ or name not in ("ev", "name")]
    return wrong_keyword(where, found[3], known, _ELSEWHERE)


_ELSEWHERE = {
    "initial": "start=",
    "initial_value": "start=",
    "guess": "start=",
    "units": "unit=",
    "min": "bounds=(low, high)",
    "max": "bounds=(low, high)",
}


def _hint(raised: Exception, name: str) -> str | None:
    """The probable mistake behind an error that does not name it, raised while the component `name` was built; None if
    it is not recognised."""
    # Python and SymPy raise these as TypeErrors: their texts are all that tells one from another.
    error = str(raised)
    if isinstance(raised, SympifyError):
        return f"what stands in an equation is made of symbols and numbers. {SHADOWED}"
    if "Component.__init__() missing" in error:
        return _HOW_TO_BEGIN
    if f"{name}.__init__() missing" in error and "'name'" in error:
        return f'the environment comes first, then the name: {name}(ev, "name", …)'
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
    if "Cannot convert symbols to int" in error or "Cannot round symbolic expression" in error:
        return "int() and round() are for numbers. In equations, write floor(x) or floor(x + 1/2) from SymPy"
    if "operand" in error and "'tuple'" in error:
        return (
            "vector(), learned() and function() return a tuple of symbols, also if there is only one: write "
            "`y, = self.learned(...)`, or use its entries y[0], y[1], …"
        )
    if "operand" in error and "'str'" in error:
        return "a string stands where a number or symbol is meant: leave the quotes out"
    return None
