"""Eleven published DAE problems with reference values: as models, and as index-1 equations for solvers.

`PROBLEMS[name]` is a `Problem`. Constants, starts, published references and their sources are in tests/data/testset;
the physics is here, written from its own equations with its original index.
"""

import functools
from dataclasses import replace

from .chemistry import chemakzo, robertson
from .circuits import msl_cauer, transamp
from .drive_train import msl_rotational_first
from .heat import sundials_heat2d
from .index_one import IndexOne as IndexOne
from .mechanisms import andrews, sundials_slcrank
from .pendulums import caraxis, pendulum_cash, pendulum_period2
from .problem import Problem as Problem
from .problem import Table as Table

PROBLEMS: dict[str, Problem] = {
    problem.name: replace(problem, index_one=functools.cache(problem.index_one))
    for problem in (
        robertson(),
        chemakzo(),
        transamp(),
        sundials_heat2d(),
        sundials_slcrank(),
        msl_cauer(),
        msl_rotational_first(),
        caraxis(),
        andrews(),
        pendulum_cash(),
        pendulum_period2(),
    )
}
