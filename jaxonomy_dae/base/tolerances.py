"""What counts as zero, as equal, as solved and as singular: the thresholds by which results are judged.

Methods have constants of their own, such as the first damping of a descent, and these stand beside them: they decide
how long a search takes. The numbers here decide what is called right, and so what is refused. Some are in units of the
spacing of floating-point numbers near one (2⁻⁵² in double, 2⁻²³ in single precision), so that they hold in both; the
others are relative. None has a unit of physics.
"""

import jax.numpy as jnp
from jax.typing import DTypeLike

EPS = 2.0**-52  # the spacing of double precision near one, a bound of the rounding of one operation

# --- numbers as they are given ------------------------------------------------------------------------------------

# In units of EPS. Numbers that are given come out of computations (a start L·sin(φ), a parameter 0.1 + 0.2, a root that
# Newton's method found with the kernels of some BLAS): they differ by some roundings from what is meant, and of sixteen
# digits fourteen count. tests/compiler/test_verdicts.py moves starts by 4 roundings; the rest is for how mechanisms
# pass them on.
KNOWN_ROUNDINGS = 64.0
KNOWN = KNOWN_ROUNDINGS * EPS
# Relative: numbers that somebody wrote twice, as a start at each end of a connection, with nine digits or more.
MEANT_EQUAL = 1e-9
TINY = 1e-300  # takes the place of zero in denominators, far below any square of a model's number

# --- sums of which rounding may be left ---------------------------------------------------------------------------

# In units of EPS times the terms: what the sum of a handful of terms, each of them rounded, may be off by.
NOISE = 8.0
# Of the terms: a combination of equations with weights that were computed cancels to this. Weights come out of an
# elimination, and may have lost some digits. Set by hand.
CANCELLED = 1e-11
# Entries of a null vector that are left out, relative to its largest: to the first, if columns cancel without them,
# else to the second, which are the singular value decomposition's own roundings.
NO_WEIGHT = (1e-8, 1e-13)
# Of the largest: less than this in a null vector, or of what is passed on along a graph, has no part in it. Set by
# hand, between the roundings of an ill-conditioned null vector and the least entry of one that is meant.
NO_PART = 1e-6
# Of the largest: what has less has no part that is worth a word, in an error that names those that depend on each
# other; and terms that leave more of themselves than this do not cancel. A branch that is another one leaves a part of
# order one.
SLIGHT = 1e-3
# Relative: pivots that differ by less are equal, so that neither rounding nor the order of summation chooses states.
ALIKE = 1e-6

# --- equations that hold ------------------------------------------------------------------------------------------

CLOSE = 1e3  # in units of EPS times an equation's terms: where a search may end, short of asking for the last digit
# In units of EPS and of the typical size of a quantity: what cannot be told from zero. A double root at zero is
# approached by half the way in each step, 46 of 60 to here.
ZERO_WITHIN = 1e2
DIGIT = 0.1  # relative: what is uncertain by more is not known to its first digit
# Singular values, relative, of equations whose derivatives vanish in the first order: roots of second order are found
# to half of the digits.
HALF_OF_THE_DIGITS = 1e-7
# Relative change of a constraint along what its linearization leaves free, below which it changes in the third order
# alone. Points are found to HALF_OF_THE_DIGITS, which second derivatives amplify. Set by hand.
UNCHANGED = 1e-5


def spacing(dtype: DTypeLike) -> float:
    """The spacing of numbers of a dtype near one."""
    return float(jnp.finfo(dtype).eps)


def solved(dtype: DTypeLike) -> float:
    """The largest residual of an equation that holds, relative to its terms: 4e-10 in double, 7e-5 in single
    precision. Set by hand, above what cancellation inside of terms leaves where a search can do no better."""
    return spacing(dtype) ** 0.6


def close(dtype: DTypeLike) -> float:
    """The residual at which a search ends, relative to the terms."""
    return min(CLOSE * spacing(dtype), 0.1 * solved(dtype))


def ridge(dtype: DTypeLike) -> float:
    """The weight of rows that hold the directions which a matrix leaves open, beside rows of size one. It is far below
    the rounding of what only such directions feel. A solution in directions of the size σ is off by up to (ridge/σ)² of
    itself."""
    return spacing(dtype) ** 0.75


# --- solutions of linear equations --------------------------------------------------------------------------------

TOLERATED = 2.0**20  # residual of an equation in units of EPS times its terms: 2e-10 in double precision
# The same in the norm of the equilibrated matrix, and for what is left of the terms of a Schur complement: 6e-14, what
# elimination with pivoting may leave.
TOLERATED_NORM = 2.0**8
UNDETERMINED = 2.0**-4  # of the largest unknown: what changes so by rounding is not known to its first digit
ILL_CONDITIONED = 1e12  # the condition number from which on a solution has four digits or fewer, which is said
# Pivots and singular values, relative to the largest, of matrices of which no bounds of errors are known (the
# Jacobian of constraints that a user's point gives): far above rounding, far below what a mechanism's shape makes.
RANK = 1e-10

# --- events -------------------------------------------------------------------------------------------------------

RESOLUTION = 32.0  # spacings of floating-point numbers at the largest time of a run: times that are one instant
# Of the largest value that a guard has had, in spacings of floating-point numbers: the half-width of the band about
# zero. Rounding errors of a guard in the states, and of the states themselves, add up to some hundreds of them in the
# models of the tests. With a tenth, test_hybrid_runs.py::test_nothing_falls_through_a_floor fails; ten times it passes.
BAND = 4096.0
# Part of a step: a guard that would reach zero so soon after its end counts as having reached it. A step that is
# retried up to a crossing has other errors than the step in which the crossing was located, so that it ends a little
# off. Set by hand: test_hybrid_runs.py and test_event_map.py pass with ten times it and a tenth.
WINDOW = 1e-6
# Largest relative change of a state by the projection onto the constraints after an event. If the projection moves it
# more, the event asked for what the constraints do not admit, and the projection would decide what was meant
# (test_event_attacks.py::test_a_reset_that_hidden_constraints_do_not_admit).
CONSISTENT = 1e-4
# Part of the speed (or charge) that an impulse takes away that may be left of it: more shows that no impulse enforces
# the constraint, as where another one contradicts it.
LEFT = 1e-6
PULL = 1e-9  # of the largest impulse: contacts that pull by less do so by rounding alone, and are not released
# 1/s, relative to the size of a state: a slope that is slower counts as zero in analyses, for it would take 1e17 years
# to move the state by its size. Parts that friction holds creep so, by its compliance (`library/friction.py`;
# test_analysis_of_events.py::test_friction_that_sticks).
AT_REST = 1e-25
