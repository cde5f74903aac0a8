"""What is found for a plan is kept as long as an equal plan is, and no longer: memory of a large model goes with it."""

import functools
import weakref
from collections.abc import Callable, Hashable
from typing import Any, Concatenate, ParamSpec, TypeVar

from .plan import SystemPlan

ROOM = 64  # answers kept for one plan; each is one question of a user's, such as the names given in `initial`

_NONE: Any = object()

_P = ParamSpec("_P")
_T = TypeVar("_T")


def remembered(function: Callable[Concatenate[SystemPlan, _P], _T]) -> Callable[Concatenate[SystemPlan, _P], _T]:
    """The function, which is called once for each plan and other arguments. It must read nothing else."""
    known: weakref.WeakKeyDictionary[SystemPlan, dict[Hashable, Any]] = weakref.WeakKeyDictionary()

    @functools.wraps(function)
    def call(plan: SystemPlan, *args: _P.args, **kwargs: _P.kwargs) -> _T:
        answers = known.setdefault(plan, {})
        key = args, tuple(sorted(kwargs.items()))
        found = answers.get(key, _NONE)
        if found is _NONE:
            found = function(plan, *args, **kwargs)
            while len(answers) >= ROOM:
                answers.pop(next(iter(answers)), None)
            answers[key] = found  # another thread may drop it at once
        return found

    return call
