"""A mark on expressions whose relations are no events."""

import sympy
from sympy.printing.str import StrPrinter

from .node import Node, make, number


class Smooth(sympy.Function):
    """A SymPy function that equals its argument; it marks the argument as smooth."""

    nargs = 1

    @classmethod
    def eval(cls, argument):
        # A number has no relation that could become an event, and SymPy compares no marked one, as Max does.
        return argument if argument.is_number else None

    def fdiff(self, argindex=1):
        return sympy.Integer(1)

    def _eval_is_extended_real(self):
        return self.args[0].is_extended_real

    def _sympystr(self, printer: StrPrinter) -> str:
        return f"smooth({printer._print(self.args[0])})"

    def _printed_inside(self, printer: StrPrinter) -> str:
        return printer._print(self.args[0])

    _pythoncode = _numpycode = _mpmathcode = _printed_inside  # for sympy.lambdify


def marked(u: Node) -> Node:
    """The node with a mark of smoothness."""
    return u if number(u) is not None or u.operation in ("leaf", "smooth") else make("smooth", (u,))
