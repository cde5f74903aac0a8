"""Training compiled systems, and any Equinox module around them."""

from .fit import Fit as Fit
from .fit import fit as fit
from .fit import fit_least_squares as fit_least_squares
