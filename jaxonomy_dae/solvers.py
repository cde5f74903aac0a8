"""Diffrax solvers for constrained and differential-algebraic systems."""

from .solve.methods import BDF as BDF
from .solve.methods import DAETerm as DAETerm
from .solve.methods import Projected as Projected
from .solve.methods import Rodas5P as Rodas5P
from .solve.methods import StepControl as StepControl
from .solve.methods import StoredAdjoint as StoredAdjoint
from .solve.methods import Tsit5 as Tsit5
from .solve.methods import consistent_start as consistent_start
from .solve.methods import solve_dae as solve_dae
