"""Calls with a keyword that does not exist: the error names the nearest one, or what another tool's option is here."""

import functools
import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ParamSpec, TypeVar

from .kinds import ModelError
from .wrong_values import nearest

P = ParamSpec("P")
R = TypeVar("R")
Class = TypeVar("Class", bound=type)
NOWHERE: Mapping[str, str] = {}


def explained_keywords(elsewhere: Mapping[str, str] = NOWHERE) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """A decorator that refuses unknown keywords with a `ModelError` that says what to write.

    **Arguments:**

    - `elsewhere`: what keywords of other tools are here, such as `{"t_eval": "ts"}`.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        known = keywords_of(function)
        # A mistake of this package, which shows when the module is imported.
        if any(p.kind is inspect.Parameter.VAR_KEYWORD for p in inspect.signature(function).parameters.values()):
            raise TypeError(f"{function.__qualname__} hands any keyword on")

        @functools.wraps(function)
        def call(*args: P.args, **kwargs: P.kwargs) -> R:
            for name in kwargs:
                if name not in known:
                    is_method = function.__name__ == "__init__"
                    where = type(args[0]).__name__ if is_method else function.__qualname__
                    raise ModelError(wrong_keyword(where, name, known, elsewhere))
            return function(*args, **kwargs)

        return call

    return decorate


def explained(cls: Class) -> Class:
    """A class whose construction refuses unknown keywords as `explained_keywords` does."""
    cls.__init__ = explained_keywords()(cls.__init__)
    return cls


def keywords_of(function: Callable[..., Any]) -> list[str]:
    """The names that a function can be given arguments by, except for private ones."""
    kinds = (inspect.Parameter.KEYWORD_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    named = [n for n, p in inspect.signature(function).parameters.items() if p.kind in kinds]
    return [n for n in named if n not in ("self", "cls") and not n.startswith("_")]


def wrong_keyword(where: str, name: str, known: list[str], elsewhere: Mapping[str, str] = NOWHERE) -> str:
    """The text of an error about a keyword that a call does not have."""
    if name in elsewhere:
        here = f"write {elsewhere[name]}"
    else:
        here = nearest(name, known) if known else "it takes none by name."
    return f"{where}: there is no argument '{name}': {here}"


def check_handed_on(
    where: str, given: Mapping[str, Any], to: Callable[..., Any], own: Sequence[str] = (), but: Sequence[str] = ()
):
    """Refuses keywords that a function `where` would hand on to another that does not have them. Its `own`
    arguments are among the hints; those that it gives itself, `but`, are not."""
    known = [name for name in dict.fromkeys([*own, *keywords_of(to)]) if name not in but]
    for name in given:
        if name not in known:
            raise ModelError(wrong_keyword(where, name, known))
