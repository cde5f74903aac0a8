"""Linear state spaces with names."""

from html import escape
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float
from numpy.typing import ArrayLike

from ..base.errors import ModelError
from ..base.optional import optional_module
from ..compile.diagnosis.wording import counted
from ..host.staging import is_traced
from .response import FrequencyResponse

SHOWN = 6  # rows and columns of matrices that are printed


class StateSpace(eqx.Module):
    """d(x − x0)/dt = dx0 + A·(x − x0) + B·(u − u0), y − y0 = C·(x − x0) + D·(u − u0).

    - `A`, `B`, `C`, `D`: shapes `(n, n)`, `(n, m)`, `(p, n)`, `(p, m)`.
    - `states`, `inputs`, `outputs`: the names of the entries of x, u and y.
    - `x0`, `u0`, `y0`: the point of linearization; `dx0`, the derivatives there, vanishes at an equilibrium.

    A and B have the units of the variables per second; C and D have the units of the variables.

    With a period `dt` (second), the model is a discrete-time one. The left side is then the change of x from one tick
    to the next, x(k + 1) − x0 = dx0 + A·(x(k) − x0) + B·(u(k) − u0), with inputs that are constant in between.
    """

    A: Float[Array, "n n"]
    B: Float[Array, "n m"]
    C: Float[Array, "p n"]
    D: Float[Array, "p m"]
    x0: Float[Array, " n"]
    u0: Float[Array, " m"]
    y0: Float[Array, " p"]
    dx0: Float[Array, " n"]
    states: tuple[str, ...] = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)
    outputs: tuple[str, ...] = eqx.field(static=True)
    dt: Float[Array, ""] | None = None

    def poles(self) -> Complex[Array, " n"]:
        """The eigenvalues of A, the slowest decay first: in 1/s, or for a discrete-time model as factors from tick to
        tick. They are differentiable where they are distinct."""
        if not self.states:
            return jnp.zeros((0,), _complex(self.A))
        found = jnp.linalg.eigvals(self.A)
        slowness = found.real if self.dt is None else jnp.abs(found)
        return found[jnp.lexsort((found.imag, -found.real, -slowness))]

    def frequency_response(self, omega: ArrayLike) -> FrequencyResponse:
        """The response to sinusoids, C·(jω − A)⁻¹·B + D. A discrete-time model has exp(jω·dt) in place of jω, and
        responds from samples of inputs to samples of outputs.

        **Arguments:**

        - `omega`: angular frequencies (rad/s), shape `(k,)`.

        **Returns:**

        A `FrequencyResponse`, `response["output", "input"]` of shape `(k,)`. At a frequency where A has a pole, as at
        ω = 0 with an integrator or with the angle of a free shaft among the states, all pairs are infinite or
        not-a-number, also those that do not see the pole: take a small frequency instead.

        **Raises:**

        - `ModelError` for frequencies that are no row of real numbers.
        """
        given = jnp.asarray(omega)
        if jnp.iscomplexobj(given) or given.ndim > 1:
            raise ModelError(
                f"omega is a row of real angular frequencies (rad/s); got {given.dtype} of shape {given.shape}"
            )
        omega = jnp.atleast_1d(given.astype(self.A.dtype))
        a, b, c, d = (m.astype(_complex(m)) for m in (self.A, self.B, self.C, self.D))
        eye = jnp.eye(len(self.states), dtype=a.dtype)

        def at(w):
            angle = w if self.dt is None else w * self.dt
            turn = jax.lax.complex(jnp.zeros_like(angle), angle)
            turn = turn if self.dt is None else jnp.exp(turn)
            return c @ jnp.linalg.solve(turn * eye - a, b) + d

        return FrequencyResponse(omega, jax.vmap(at)(omega), self.inputs, self.outputs)

    def to_control(self) -> Any:
        """This system as a `control.StateSpace` of python-control (extra `control`), names included; its signals are
        the deviations from `x0`, `u0` and `y0`. Dots in names become underscores, since python-control joins names by
        dots.

        **Raises:**

        - `ImportError` that names the extra; `ModelError` without inputs or outputs, which python-control needs.
        """
        control = optional_module("control", "control", "to_control needs python-control")
        if not self.inputs or not self.outputs:
            missing = "inputs" if not self.inputs else "outputs"
            raise ModelError(f"python-control needs inputs and outputs: name {missing} in linearize(...)")
        matrices = [np.asarray(m) for m in (self.A, self.B, self.C, self.D)]
        names = {
            kind: [name.replace(".", "_") for name in given]
            for kind, given in (("states", self.states), ("inputs", self.inputs), ("outputs", self.outputs))
        }
        dt = 0 if self.dt is None else float(self.dt)
        return control.StateSpace(*matrices, dt, **names)

    def __repr__(self):
        lines = [self._head()]
        if np.ndim(self.A) != 2 or is_traced(self.A):
            return lines[0]
        for letter, matrix, rows, columns in self._tables():
            lines.append(f"{letter}: {_names(rows)} by {_names(columns)}")
            lines += ["    " + "  ".join(f"{v:>11}" for v in row) for row in _entries(matrix)]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        """The four matrices as tables that fold."""
        out = [f"<p><code>{self._head()}</code></p>"]
        if np.ndim(self.A) != 2 or is_traced(self.A):
            return out[0]
        for letter, matrix, rows, columns in self._tables():
            head = "".join(f"<th>{escape(n)}</th>" for n in ("", *columns[:SHOWN]))
            body = "".join(
                f"<tr><th>{escape(name)}</th>{''.join(f'<td>{v}</td>' for v in row)}</tr>"
                for name, row in zip(rows, _entries(matrix), strict=False)
            )
            out.append(f"<details open><summary>{letter}</summary><table><tr>{head}</tr>{body}</table></details>")
        return "".join(out)

    def _head(self) -> str:
        kinds = (("state", self.states), ("input", self.inputs), ("output", self.outputs))
        counts = [counted(len(names), kind) for kind, names in kinds]
        if self.dt is not None:
            counts.append("from tick to tick")
        return f"StateSpace({', '.join(counts)})"

    def _tables(self) -> list[tuple[str, object, tuple[str, ...], tuple[str, ...]]]:
        tables = [
            ("A", self.A, self.states, self.states),
            ("B", self.B, self.states, self.inputs),
            ("C", self.C, self.outputs, self.states),
            ("D", self.D, self.outputs, self.inputs),
        ]
        return [table for table in tables if table[1].size]


def _complex(matrix: Any) -> Any:
    """The complex type of the same precision."""
    return np.result_type(matrix.dtype, np.complex64)


def _names(names: tuple[str, ...]) -> str:
    return ", ".join(names[:SHOWN]) + (f", … ({len(names)})" if len(names) > SHOWN else "")


def _entries(matrix: Any) -> list[list[str]]:
    """The first rows and columns, as text; an ellipsis stands for the others."""
    rows = [[f"{v:.5g}" for v in row[:SHOWN]] + ["…"] * (len(row) > SHOWN) for row in np.asarray(matrix)[:SHOWN]]
    return rows + [["…"]] * (len(matrix) > SHOWN)
