"""What passes between two frames."""

import sympy

from ...modeling import Component, Eq, Planar, Value
from ...modeling.ports import Port


class TwoFrames(Component):
    """Two frames without mass between them: what enters at one leaves at the other."""

    def _two_frames(self) -> tuple[Port, Port]:
        return self.port("frame_a", Planar), self.port("frame_b", Planar)

    def _balance(self, dx: Value = 0, dy: Value = 0) -> None:
        """The forces and the torques about frame_a sum to zero, with frame_b at (dx, dy) from it in world axes."""
        a, b = self.ports["frame_a"], self.ports["frame_b"]
        lever = sympy.sympify(dx) * b.fy - sympy.sympify(dy) * b.fx
        self.add_equations(Eq(a.fx + b.fx, 0), Eq(a.fy + b.fy, 0), Eq(a.tau + b.tau + lever, 0))
