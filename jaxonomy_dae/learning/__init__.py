"""Training compiled systems, and any Equinox module around them."""

from .band import Band as Band
from .data import Data as Data
from .estimate import Estimate as Estimate
from .experiment import Experiment as Experiment
from .experiment import Unknown as Unknown
from .fit import Fit as Fit
from .fit import fit as fit
from .fit import fit_least_squares as fit_least_squares
from .identifiability import Identifiability as Identifiability
from .multiple_shooting import Shooting as Shooting
from .prediction import Prediction as Prediction
from .problem import Problem as Problem
from .table import Table as Table
from .training import GradientSteps as GradientSteps
from .training import Training as Training
from .training import Update as Update
from .whiteness import Whiteness as Whiteness
