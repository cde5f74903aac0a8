"""Responses to sinusoids, read by the names of output and input."""

from typing import Any

import equinox as eqx
from jaxtyping import Array, Complex, Float

from ..base.errors import ModelError, nearest
from ..base.optional import Axes
from ..compile.diagnosis.wording import counted


class FrequencyResponse(eqx.Module):
    """The response of outputs to sinusoidal inputs: `response["load.w", "source.u"]` is complex, shape `(k,)`.

    - `omega`: angular frequencies (rad/s), shape `(k,)`.
    - `values`: shape `(k, outputs, inputs)`: the magnitude is the ratio of amplitudes, the angle the phase.
    - `inputs`, `outputs`: names.
    """

    omega: Float[Array, " k"]
    values: Complex[Array, "k p m"]
    inputs: tuple[str, ...] = eqx.field(static=True)
    outputs: tuple[str, ...] = eqx.field(static=True)

    def __getitem__(self, pair: object) -> Complex[Array, " k"]:
        """The response of one output to one input.

        **Raises:**

        - `ModelError` for what is not a pair of names, and an unknown name.
        """
        if not (isinstance(pair, tuple) and len(pair) == 2):
            raise ModelError(f"read a response by two names, response['output', 'input']; got {pair!r}")
        places = []
        for name, known, kind in zip(pair, (self.outputs, self.inputs), ("output", "input"), strict=True):
            if name not in known:
                raise ModelError(f"'{name}' is not an {kind} of this response: " + nearest(str(name), known))
            places.append(known.index(name))
        return self.values[..., places[0], places[1]]

    def bode(self, *pairs: tuple[str, str], axes: Any = None) -> Any:
        """Draws magnitudes (dB) and phases (degrees, unwrapped) over ω.

        **Arguments:**

        - `pairs`: `(output, input)` each; default: all.
        - `axes`: two Matplotlib axes to draw into, for magnitude and phase; new ones by default.

        **Returns:**

        The two axes.
        """
        # When it is called: `plotting` stands above this room.
        from ..plotting import bode

        return bode(self, *pairs, axes=axes)

    def nyquist(self, *pairs: tuple[str, str], ax: Axes | None = None) -> Axes:
        """Draws responses in the complex plane, with the point −1. Responses at −ω are dashed.

        **Arguments:**

        - `pairs`: `(output, input)` each; default: all.
        - `ax`: Matplotlib axes to draw into; new ones by default.

        **Returns:**

        The axes.
        """
        from ..plotting import nyquist

        return nyquist(self, *pairs, ax=ax)

    def __repr__(self):
        pairs = f"{counted(len(self.outputs), 'output')} to {counted(len(self.inputs), 'input')}"
        return f"FrequencyResponse({pairs} at {self.omega.shape[-1]} frequencies)"
