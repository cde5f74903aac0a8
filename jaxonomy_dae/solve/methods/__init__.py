"""Diffrax solvers for constrained and differential-algebraic systems."""

from ..adjoint.stored_adjoint import StoredAdjoint as StoredAdjoint
from .bdf import BDF as BDF
from .dae_term import DAETerm as DAETerm
from .projected import Projected as Projected
from .rodas5p import Rodas5P as Rodas5P
from .solve import consistent_start as consistent_start
from .solve import solve_dae as solve_dae
from .step_control import StepControl as StepControl
from .tsit5 import Tsit5 as Tsit5
