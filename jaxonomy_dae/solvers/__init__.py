"""Diffrax solvers for constrained and differential-algebraic systems."""

from .projected import Projected as Projected
from .tsit5 import Tsit5 as Tsit5
