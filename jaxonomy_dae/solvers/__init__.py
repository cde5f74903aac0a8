"""Diffrax solvers for constrained and differential-algebraic systems."""

from .projected import Projected as Projected
