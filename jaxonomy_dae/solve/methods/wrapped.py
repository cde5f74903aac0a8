"""What solvers that change another one's steps have in common."""

import diffrax


class WrappedSolver(diffrax.AbstractWrappedSolver):
    """A solver around another one, of the same orders.

    Diffrax reads and replaces the properties of Runge–Kutta and of implicit solvers on the outermost solver. They are
    those of the solver inside.
    """

    @property
    def scan_kind(self):
        """The wrapped solver's kind of loop over its stages (`diffrax.AbstractRungeKutta.scan_kind`)."""
        return self.solver.scan_kind  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def root_finder(self):
        """The wrapped solver's root finder; Diffrax reads it to fill in tolerances."""
        return self.solver.root_finder  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def root_find_max_steps(self):
        """The wrapped solver's limit on the iterations of its root finder."""
        return self.solver.root_find_max_steps  # pyright: ignore[reportAttributeAccessIssue]

    def order(self, terms):
        return self.solver.order(terms)

    def strong_order(self, terms):
        return self.solver.strong_order(terms)

    def error_order(self, terms):
        return self.solver.error_order(terms)
