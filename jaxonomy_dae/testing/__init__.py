"""Checks for tests of models, losses and laws: each raises an `AssertionError` that says what failed and where, or
returns a certificate of what was checked."""

from .certificate import Certificate as Certificate
from .constraints import assert_constraints as assert_constraints
from .energy import assert_energy_balance as assert_energy_balance
from .gradient import assert_gradient as assert_gradient
from .passive import assert_passive as assert_passive
