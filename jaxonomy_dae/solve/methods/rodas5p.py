"""Rodas5P, a stiffly accurate Rosenbrock method for stiff and differential-algebraic equations."""

from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from jaxtyping import Array, Float

from ...base.aliases import Numeric, PyTree, State, Time
from ..linear.choice import check_linear_solver, choose
from .dae_term import FlatProblem
from .field_size import is_large
from .index_one import consistent_point, consistent_slope

# Steinebach (2023), "Construction of Rosenbrock–Wanner method Rodas5P and numerical benchmarks within the Julia
# Differential Equations package", BIT Numerical Mathematics 63:27, in the form without products by the Jacobian
# (Hairer & Wanner 1996, Solving Ordinary Differential Equations II, IV.7, eq. 7.25).
GAMMA = 0.21193756319429014
A = np.zeros((8, 8))
A[1, :1] = 3.0
A[2, :2] = 2.849394379747939, 0.45842242204463923
A[3, :3] = -6.954028509809101, 2.489845061869568, -10.358996098473584
A[4, :4] = 2.8029986275628964, 0.5072464736228206, -0.3988312541770524, -0.04721187230404641
A[5, :5] = (
    -7.502846399306121, 2.561846144803919, -11.627539656261098, -0.18268767659942256, 0.030198172008377946,
)  # fmt: skip
A[6], A[7] = A[5], A[5]
A[6, 5] = A[7, 5] = A[7, 6] = 1.0
C = np.zeros((8, 8))
C[1, :1] = -14.155112264123755
C[2, :2] = -17.97296035885952, -2.859693295451294
C[3, :3] = 147.12150275711716, -1.41221402718213, 71.68940251302358
C[4, :4] = 165.43517024871676, -0.4592823456491126, 42.90938336958603, -5.961986721573306
C[5, :5] = 24.854864614690072, -3.0009227002832186, 47.4931110020768, 5.5814197821558125, -0.6610691825249471
C[6, :6] = (
    30.91273214028599, -3.1208243349937974, 77.79954646070892, 34.28646028294783, -19.097331116725623,
    -28.087943162872662,
)  # fmt: skip
C[7, :7] = (
    37.80277123390563, -3.2571969029072276, 112.26918849496327, 66.9347231244047, -40.06618937091002,
    -54.66780262877968, -9.48861652309627,
)  # fmt: skip
NODES = np.array([0.0, 0.6358126895828704, 0.4095798393397535, 0.9769306725060716, 0.4288403609558664, 1.0, 1.0, 1.0])
D = np.array([GAMMA, -0.42387512638858027, -0.3384627126235924, 1.8046452872882734, 2.325825639765069, 0.0, 0.0, 0.0])
H = np.array(
    [
        [25.948786856663858, -2.5579724845846235, 10.433815404888879, -2.3679251022685204,
         0.524948541321073, 1.1241088310450404, 0.4272876194431874, -0.17202221070155493],
        [-9.91568850695171, -0.9689944594115154, 3.0438037242978453, -24.495224566215796,
         20.176138334709044, 15.98066361424651, -6.789040303419874, -6.710236069923372],
        [11.419903575922262, 2.8879645146136994, 72.92137995996029, 80.12511834622643,
         -52.072871366152654, -59.78993625266729, -0.15582684282751913, 4.883087185713722],
    ]
)  # fmt: skip


DEFECT_AT = 0.4  # the part of a step at which dense output is compared with the equations


class Stage(NamedTuple):
    """A stage solves (M/(γh) − J) k = F(t + node·h, y + Σ a·k) + M Σ c·k / h + d·h·∂F/∂t, k the stages before it."""

    a: Any
    c: Numeric
    d: Numeric
    node: Numeric
    moves: bool = True  # whether d is not zero


def _stages() -> tuple[Stage, ...]:
    """The stages after the first, and the defect of the dense output, which has the form of a stage."""
    last = np.append(A[7, :7], 1.0)  # y1 = y + Σ last·k
    u = DEFECT_AT
    value = u * last + u * (1 - u) * (H[0] + u * (H[1] + u * H[2]))
    rate = last + (1 - 2 * u) * H[0] + (2 * u - 3 * u**2) * H[1] + (3 * u**2 - 4 * u**3) * H[2]
    stages = [Stage(A[i], C[i], float(D[i]), float(NODES[i]), bool(D[i])) for i in range(1, 8)]
    return (*stages, Stage(value, -rate, 0.0, u, False))


STAGES = _stages()


class Rodas5PInterpolation(diffrax.AbstractLocalInterpolation):
    """The method's own dense output, of order 4 (Steinebach 2023, eq. 11)."""

    t0: Time
    t1: Time
    y0: State
    y1: State
    k: Any

    def evaluate(self, t0: Time, t1: Time = None, left: bool = True) -> State:
        """The solution at t0, or its increment from t0 to t1."""
        if t1 is not None:
            return jax.tree.map(jnp.subtract, self.evaluate(t1), self.evaluate(t0))
        h = self.t1 - self.t0
        s = jnp.where(h == 0, 0.0, (t0 - self.t0) / jnp.where(h == 0, 1.0, h))

        def one(y0, y1, k):
            u = s.astype(y0.dtype)
            return (1 - u) * y0 + u * (y1 + (1 - u) * (k[0] + u * (k[1] + u * k[2])))

        return jax.tree.map(one, self.y0, self.y1, self.k)


class Rodas5P(diffrax.AbstractAdaptiveSolver):
    """Rosenbrock method of order 5(4) for M dy/dt = F(t, y), index 1, and for stiff ordinary equations.

    Eight stages, stiffly accurate, L-stable, with one Jacobian and one factorization a step and no iteration. The
    result is an explicit formula, so gradients are exact. Use it for small stiff systems and for batches. Steinebach
    (2023), BIT Numerical Mathematics 63:27.

    **Arguments:**

    - `linear_solver`: any Lineax solver, such as `lineax.GMRES(rtol, atol)`, or one of `jaxonomy_dae.linear`; None
        chooses by size. It receives a `SparseLinearOperator` where the term has a pattern.

    - `dense_errors`: whether the error test includes the dense output of differentiated unknowns inside a step, by its
        defect: one more evaluation. Without it, very stiff unknowns are accurate at the ends of steps, but steps may be
        so long that the polynomial between them is not. `simulate` and `solve_dae` set it if there are times to save,
        and solve for algebraic unknowns again at these times.

    - `looped`: whether to loop over the stages; None decides by the size of F.

    Takes a `DAETerm` or a `diffrax.ODETerm`. Explicit time dependence is differentiated: F must be differentiable in t
    between the jumps that the step-size controller knows of.
    """

    linear_solver: lx.AbstractLinearSolver | None = None
    dense_errors: bool = eqx.field(static=True, default=False)
    looped: bool | None = eqx.field(static=True, default=None)

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar = Rodas5PInterpolation

    def __check_init__(self):
        if self.linear_solver is not None:
            check_linear_solver(self.linear_solver)

    def order(self, terms):
        return 5

    def error_order(self, terms):
        return 5

    def init(self, terms, t0, t1, y0, args):
        return None

    def func(self, terms, t0, y0, args):
        """dy/dt of the solution through a consistent point."""
        problem = FlatProblem(terms, y0, args)
        return problem.unravel(consistent_slope(problem, self.linear_solver, t0, problem.flat))

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        """One step with its error estimate and dense output; see `diffrax.AbstractSolver.step`."""
        problem = FlatProblem(terms, y0, args)
        mass, y = problem.mass, problem.flat
        dtype = y.dtype
        linear = choose(self.linear_solver, y.shape[0], problem.pattern, problem.mass)
        if made_jump is not False:  # algebraic unknowns jump too
            y = jax.lax.cond(made_jump, lambda: consistent_point(problem, self.linear_solver, t0, y)[0], lambda: y)
        h_time = jnp.asarray(t1 - t0)
        h = h_time.astype(dtype)
        # A step of length zero occurs where a batch waits for its slowest member.
        inverse = 1 / jnp.where(h == 0, jnp.asarray(1, dtype), h)
        # The Jacobian is differentiated, too. The result of a Rosenbrock method depends on it, other than that of a
        # Newton iteration.
        right, jacobian = linear.jacobian(lambda v: problem.right(t0, v), y)
        slope = jax.jvp(lambda t: problem.right(t, y), (t0,), (jnp.ones_like(t0),))[1]
        # Infinite at the beginning of √t: without it the step is of lower order there, and its error estimate says so.
        slope = jnp.where(jnp.isfinite(slope), slope, 0.0)
        matrix = linear.combine(mass, inverse / GAMMA, jacobian)
        factor = linear.factor(matrix)

        def stage(row: Stage, stages: PyTree) -> PyTree:
            right = problem.right(t0 + row.node * h_time, y + _combine(row.a, stages))
            b = right + mass.times(inverse * _combine(row.c, stages))
            return linear.solve(factor, matrix, b + (row.d * h) * slope if row.moves else b)

        first = linear.solve(factor, matrix, right + (float(D[0]) * h) * slope)
        rows = STAGES if self.dense_errors else STAGES[:-1]
        looped = is_large(problem.right, t0, y) if self.looped is None else self.looped
        stages = _in_a_loop(stage, rows, first, h_time.dtype) if looped else _written_out(stage, rows, first)
        y1 = y + _combine(A[7], stages) + stages[7]
        k = jnp.stack([_combine(row, stages) for row in H])
        # The method is stiffly accurate: the result of order 4 that is embedded differs from y1 by the last stage.
        error = stages[7]
        if self.dense_errors:
            # Algebraic unknowns are solved for again at saved times, so their dense output need not be good.
            within = mass.differential_part(jax.lax.stop_gradient(stages[8]))
            error = jnp.maximum(jnp.abs(error), jnp.abs(within))
        dense = dict(y0=problem.unravel(y), y1=problem.unravel(y1), k=jax.vmap(problem.unravel)(k))
        return problem.unravel(y1), problem.unravel(error), dense, None, diffrax.RESULTS.successful


def _written_out(
    stage: Callable[[Stage, PyTree], PyTree], rows: Sequence[Stage], first: Float[Array, " n"]
) -> list[PyTree]:
    stages = [first]
    for row in rows:
        stages.append(stage(row, stages))
    return stages


def _in_a_loop(
    stage: Callable[[Stage, PyTree], PyTree], rows: Sequence[Stage], first: Float[Array, " n"], time_dtype: PyTree
) -> Any:
    """The stages computed in a loop, shape (max(8, 1 + rows), n): the field is compiled once."""

    def body(stages, given):
        place, *row = given
        return stages.at[place].set(stage(Stage(*row), stages[:8])), None

    kinds = dict(a=first.dtype, c=first.dtype, d=first.dtype, node=time_dtype)
    tables = (jnp.asarray([getattr(row, name) for row in rows], kind) for name, kind in kinds.items())
    given = np.arange(1, len(rows) + 1), *tables
    empty = jnp.zeros((max(len(rows) + 1, 8), len(first)), first.dtype)
    return jax.lax.scan(body, empty.at[0].set(first), given)[0]


def _combine(coefficients: Numeric, stages: PyTree) -> Float[Array, " n"]:
    """Σ coefficient·stage over a list or an array of stages."""
    if not isinstance(stages, list):
        return jnp.tensordot(jnp.asarray(coefficients, stages.dtype), stages[:8], 1)
    total: Numeric = None
    for c, stage in zip(coefficients, stages, strict=False):
        if c:
            total = float(c) * stage if total is None else total + float(c) * stage
    return total
