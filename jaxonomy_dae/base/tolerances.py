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
# Two numbers that differ by less than this part of themselves are meant to be equal: somebody wrote one number twice,
# as a start at each end of a connection, with nine digits or more.
MEANT_EQUAL = 1e-9
TINY = 1e-300  # takes the place of zero in denominators, far below any square of a model's number

# --- sums of which rounding may be left ---------------------------------------------------------------------------

# A sum of a handful of terms, each of them rounded, may be off by so many units of EPS times the terms.
NOISE = 8.0
# A combination of equations has cancelled if no more than this part of its terms is left. Its weights come out of an
# elimination, and may have lost some digits. The value is set by hand.
CANCELLED = 1e-11
# Small entries of a null vector are left out: those below the first part of its largest entry if the columns cancel
# without them, and else those below the second part, the rounding of the singular value decomposition itself.
NO_WEIGHT = (1e-8, 1e-13)
# What has less than this part of the largest entry, in a null vector or in what is passed on along a graph, has no part
# in it. The value is set by hand, between the roundings of an ill-conditioned null vector and the least entry of one
# that is meant.
NO_PART = 1e-6
# An error that names what depends on each other leaves out what has less than this part of the largest. And terms do
# not cancel if more than this part of them is left: another branch of a function leaves a part of order one.
SLIGHT = 1e-3
# Pivots that differ by less than this part are equal, so that neither rounding nor the order of summation chooses
# states.
ALIKE = 1e-6

# --- equations that hold ------------------------------------------------------------------------------------------

CLOSE = 1e3  # in units of EPS times an equation's terms: where a search may end, short of asking for the last digit
# What is less than so many units of EPS times the typical size of a quantity cannot be told from zero. A double root at
# zero is approached by half the way in each step, and 46 of 60 steps lead to here.
ZERO_WITHIN = 1e2
DIGIT = 0.1  # relative: what is uncertain by more is not known to its first digit
# Roots of second order are found to half of the digits. So where derivatives vanish in the first order, the singular
# values of equations come out as large as this part of the largest.
HALF_OF_THE_DIGITS = 1e-7
# A constraint that changes by less than this part, along what its linearization leaves free, changes in the third order
# alone. Points are found to HALF_OF_THE_DIGITS, and second derivatives amplify that. The value is set by hand.
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
# The residual in the norm of the equilibrated matrix, and the part of its terms below which a Schur complement is
# rounding: 6e-14, which elimination with pivoting may leave.
TOLERATED_NORM = 2.0**8
UNDETERMINED = 2.0**-4  # of the largest unknown: what changes so by rounding is not known to its first digit
ILL_CONDITIONED = 1e12  # the condition number from which on a solution has four digits or fewer, which is said
# Pivots and singular values below this part of the largest count as zero where no bounds of a matrix's errors are
# known, as of the Jacobian of constraints at a user's point. This is far above rounding, and far below what a
# mechanism's shape makes.
RANK = 1e-10

# --- events -------------------------------------------------------------------------------------------------------

RESOLUTION = 32.0  # spacings of floating-point numbers at the largest time of a run: times that are one instant
# A guard counts as zero within a band of this half-width, in spacings of floating-point numbers at the largest value
# that it has had. Rounding errors of a guard in the states, and of the states themselves, add up to some hundreds of
# spacings in the models of the tests. With a tenth, test_hybrid_runs.py::test_nothing_falls_through_a_floor fails; ten
# times it passes.
BAND = 4096.0
# A guard that would reach zero within this part of a step after its end counts as having reached it. A step that is
# retried up to a crossing has other errors than the step in which the crossing was located, so that it ends a little
# off. The value is set by hand: test_hybrid_runs.py and test_event_map.py pass with ten times it and a tenth.
WINDOW = 1e-6
# The projection onto the constraints after an event may change a state by this part at most. If it moves it more, the
# event asked for what the constraints do not admit, and the projection would decide what was meant
# (test_event_attacks.py::test_a_reset_that_hidden_constraints_do_not_admit).
CONSISTENT = 1e-4
# Of a speed (or charge) that an impulse takes away, this part may be left. More shows that no impulse enforces the
# constraint, as where another one contradicts it.
LEFT = 1e-6
PULL = 1e-9  # of the largest impulse: contacts that pull by less do so by rounding alone, and are not released
# A slope of less than this part of a state's size per second counts as zero in analyses, because it would take 1e17
# years to move the state by its size. Parts that friction holds creep like this, by its compliance
# (`library/friction.py`; test_analysis_of_events.py::test_friction_that_sticks).
AT_REST = 1e-25
