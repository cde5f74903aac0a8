"""Differential-algebraic equations as a Diffrax term."""

import functools
from collections.abc import Callable

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree

from ...base.aliases import Args, PyTree, State, Terms, Time
from ...base.errors import ModelError
from ...base.private_names import unwrapped
from ..linear.mass import Mass
from ..linear.sparse import SparsePattern


class DAETerm(diffrax.AbstractTerm):
    """A differential-algebraic equation, for `BDF` and `Rodas5P`.

    - `DAETerm(f, g)`: dx/dt = f(t, x, z, args), 0 = g(t, x, z, args). The solution is the pair `(x, z)`; f returns the
        structure of x, and g as many values as z has.
    - `DAETerm(F, mass=M)`: M dy/dt = F(t, y, args) with a constant matrix M, shape (n, n), or its diagonal, shape (n,);
        M may be singular. F returns the structure of y.

    Both must have index 1: ∂g/∂z regular. `jaxonomy_dae.AcausalCompiler` reduces higher indices.

    **Arguments:**

    - `mass`: the matrix M; a NumPy array, not traced.
    - `pattern`: a `SparsePattern` of the entries of ∂F/∂y (or of ∂(f, g)/∂(x, z)) that may differ from zero, for large
        sparse systems; the Jacobian is then found by colouring and factorised sparsely.

    **Raises:**

    - `ModelError` for a mass of the wrong shape, and (when traced) functions that return the wrong shapes.
    """

    field: Callable[..., State]
    constraint: Callable[..., State] | None = None
    mass: Mass | None = eqx.field(static=True, default=None)
    pattern: SparsePattern | None = eqx.field(static=True, default=None)

    def __init__(self, field, constraint=None, *, mass: PyTree = None, pattern: SparsePattern | None = None):
        if not callable(field) or (constraint is not None and not callable(constraint)):
            raise ModelError("a DAETerm is made of functions: DAETerm(f, g), or DAETerm(F, mass=M)")
        if constraint is not None and mass is not None:
            raise ModelError("give a DAETerm either g, or the mass matrix: DAETerm(f, g) or DAETerm(F, mass=M)")
        if constraint is None and mass is None:
            raise ModelError(
                "a DAETerm needs g(t, x, z, args), or the mass matrix: DAETerm(f, g) or DAETerm(F, mass=M). For "
                "dy/dt = F alone use diffrax.ODETerm(F)"
            )
        self.field, self.constraint, self.pattern = field, constraint, pattern
        self.mass = mass if mass is None or isinstance(mass, Mass) else Mass(mass)

    def vf(self, t, y, args):
        """F(t, y), or (f, g), in the structure of y."""
        return ravel_pytree(y)[1](self.right(t, y, args))

    def contr(self, t0, t1, **kwargs):
        return t1 - t0

    def prod(self, vf, control):
        raise ModelError(
            "this is a differential-algebraic equation: a solver for ordinary differential equations cannot step it. "
            "Use jaxonomy_dae.solvers.BDF() or jaxonomy_dae.solvers.Rodas5P()"
        )

    def right(self, t: Time, y: State, args: Args) -> State:
        """F(t, y), flat, shape (n,)."""
        if self.constraint is None:
            out = self.field(t, y, args)
            _check_like("F", out, y)
            return ravel_pytree(out)[0]
        x, z = y
        f, g = self.field(t, x, z, args), self.constraint(t, x, z, args)
        _check_like("f", f, x)
        found, expected = ravel_pytree(g)[0], ravel_pytree(z)[0]
        if found.shape != expected.shape:
            raise ModelError(
                f"g must return as many values as z has: {expected.shape[0]}; it returned {found.shape[0]}. Every "
                "algebraic unknown needs one equation"
            )
        return jnp.concatenate([ravel_pytree(f)[0], found])

    def mass_of(self, y: State) -> Mass:
        """The mass matrix M for a solution in the structure of y."""
        if self.mass is None:
            if not (isinstance(y, tuple) and len(y) == 2):
                raise ModelError(f"the solution of DAETerm(f, g) is a pair (x, z); got {jax.tree.structure(y)}")
            return _split_mass(*(ravel_pytree(part)[0].shape[0] for part in y))
        n = ravel_pytree(y)[0].shape[0]
        if self.mass.array.shape[0] != n:
            raise ModelError(
                f"mass has shape {self.mass.array.shape}, but y has {n} values: it must be ({n}, {n}) or ({n},)"
            )
        return self.mass


# Masses are compared by content and hashed once, so that one object serves all solves of a size.
@functools.lru_cache(maxsize=64)
def _split_mass(n: int, m: int) -> Mass:
    return Mass(np.concatenate([np.ones(n), np.zeros(m)]))


@functools.lru_cache(maxsize=64)
def _identity_mass(n: int) -> Mass:
    return Mass(np.ones(n))


def _check_like(name: str, found: PyTree, expected: PyTree):
    def shapes(tree):
        return [np.shape(leaf) for leaf in jax.tree.leaves(tree)]

    same = jax.tree.structure(found) == jax.tree.structure(expected)
    if not same or shapes(found) != shapes(expected):
        raise ModelError(
            f"{name} must return what it is the derivative of: expected shapes {shapes(expected)}, found "
            f"{shapes(found)}"
        )


class FlatProblem:
    """A term as solvers use it: M dy/dt = F(t, y) for a flat y, in the direction of integration."""

    def __init__(self, terms: Terms, y: State, args: Args):
        # Diffrax integrates forwards and wraps the term for a run backwards. Its wrapper knows nothing of mass and
        # constraint.
        self.term, self.direction = unwrapped(terms)
        self.args = args
        self.terms = terms
        self.flat, self.unravel = ravel_pytree(y)
        self.like = y
        if isinstance(self.term, DAETerm):
            self.mass = self.term.mass_of(y)
            self.pattern = self.term.pattern
        else:
            self.mass = _identity_mass(self.flat.shape[0])
            self.pattern = None

    def frozen(self) -> "FlatProblem":
        """A copy in which all arrays are constant under differentiation."""
        parts = self.terms, self.like, self.args
        return FlatProblem(*jax.tree.map(lambda v: jax.lax.stop_gradient(v) if eqx.is_array(v) else v, parts))

    def right(self, t: Time, flat: Array) -> State:
        """F, shape (n,)."""
        y = self.unravel(flat)
        sign = jnp.asarray(self.direction, flat.dtype)
        if isinstance(self.term, DAETerm):
            return sign * self.term.right(t * self.direction, y, self.args)
        out = self.term.vf(t * self.direction, y, self.args)
        _check_like("the vector field", out, y)
        return sign * ravel_pytree(out)[0]
