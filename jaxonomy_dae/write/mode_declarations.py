"""How a component declares equations that change: branches and complementary pairs."""

from collections.abc import Mapping

import numpy as np
import sympy

from ..base.aliases import Condition, Expression
from ..base.errors import ModelError
from .declarations import Parameter, Value, Variable
from .discrete_declarations import DiscreteDeclarations
from .equations import zero_of
from .events import NO_FLAG, Assign, EventFlag, HeldBranch, Terminate, relation_in_discretes
from .symbols import DiscreteSymbol, RelationSymbol, TimeSymbol, VariableSymbol, der

# Modes of `sliding` at an instant, beside 1, −1 and 0: the solution begins somewhere, may be on the surface and reads
# the field above it or below it, or leaves it to above if the field below does not lead away, too.
_ON_IT, _ABOVE_IS_TRIED, _BELOW_IS_TRIED, _LEAVES_ABOVE = 3, -2, 2, 4
HIGHEST = 2  # the most often that a branch may have to be differentiated: what holds positions back


class ModeDeclarations(DiscreteDeclarations):
    """The part of `Component` that concerns equations of which events choose one."""

    held_branches: list[HeldBranch]
    parameters: dict[str, Parameter]
    variables: dict[str, Variable]
    ports: Mapping[str, object]
    children: Mapping[str, object]

    def either(self, mode: sympy.Basic, then: Value, otherwise: Value, order: int = 0) -> None:
        """Adds an equation with two branches: `then` is zero while the mode holds, `otherwise` is zero while it does
        not. An ideal switch is `self.either(Eq(closed, 1), v, i)`.

        If `then` holds back states (a switch that joins two capacitors, a string that is taut), the index of the model
        changes with the mode, and `order` says how: equations see `then` differentiated so many times, and the state
        is kept where `then` and its derivatives below are zero. When the mode begins, states that it holds back jump
        to where the highest of these is zero, by the impulse of `otherwise` that does it: charge, momentum and the like
        are conserved, over all branches that begin at once. Lower ones must be zero already.

        **Arguments:**

        - `mode`: a relation in discrete variables, or one of them, which is true if it is not zero.
        - `then`, `otherwise`: expressions that are zero, or SymPy `Eq`s.
        - `order`: how many times `then` must be differentiated to determine what `otherwise` does. 0: both determine
            an algebraic variable, or a derivative. 1: `then` is in voltages of capacitors, or in speeds (a dog clutch,
            with its torque in `otherwise`). 2: it is in positions (a string, with its tension in `otherwise`).

        **Raises:**

        - `ModelError` for a mode that is not discrete, a branch that is neither, and an order that is none of these.
        """
        self._either(relation_in_discretes(mode, f"component '{self.name}': either"), then, otherwise, order, None)

    def sliding(self, surface: Value, above: Value, below: Value, name: str | None = None) -> DiscreteSymbol:
        """Adds an equation that jumps at a surface, and along which a solution may slide: `above` is zero where
        surface > 0, `below` is zero where surface < 0. Where both lead back to the surface, the solution stays on it
        with the mixture a·above + (1 − a)·below = 0, 0 ≤ a ≤ 1, that keeps it there (Filippov 1988, *Differential
        equations with discontinuous righthand sides*, section 4), and leaves it where a reaches 0 or 1.

        ```python
        self.sliding(x, u - 1, u + 1)                    # u = sign(x), in der(x) = 0.5·sin(t) − u
        self.sliding(v, f - mu * n, f + mu * n)          # dry friction
        self.sliding(s, a - 1, a)                        # of two fields: der(x) = a·f + (1 − a)·g, …
        ```

        **Arguments:**

        - `surface`: an expression in states whose first derivative depends on what `above` and `below` determine.
        - `above`, `below`: expressions that are zero, or SymPy `Eq`s; linear in what they determine.
        - `name`: of the discrete variable that says where the solution is. None: `side`, and `side2`, `side3`, … for
            further ones of this component.

        A solution that crosses the surface, as both fields lead to one side, crosses at once. One that begins on it
        slides, or goes where both fields lead. If they lead away to both sides, there or later on the way, the run ends
        and says so: it has more than one solution.

        **Returns:**

        The discrete variable: 1 above, −1 below, 0 on the surface.

        **Raises:**

        - `ModelError` for what is not an expression.
        """
        where = f"component '{self.name}': sliding:"
        surface, above, below = (_expression(zero_of(e), where) for e in (surface, above, below))
        side = self.discrete(self._free_name("side") if name is None else name, start=_ON_IT, unit="1")
        tried = tuple((above, sympy.Eq(side, mode)) for mode in (_ON_IT, 1, _ABOVE_IS_TRIED))
        branch = sympy.Piecewise(*tried, (below, True))
        self._either(sympy.Eq(side, 0), surface, branch, 1, None)
        rate, jump = der(surface), below - above
        # `part` is the a of a·above + (1 − a)·below = 0 in what holds the solution on the surface.
        part = below / jump
        # Where the fields become equal and change places without leaving the mixture, both lead away from there on.
        changes = any(
            isinstance(s, VariableSymbol | DiscreteSymbol | TimeSymbol) for s in sympy.sympify(jump).free_symbols
        )
        drawn = self._hidden_discrete(0.0) if changes else None

        def moves(condition: Condition, mode: int, to: Value, flags: EventFlag = NO_FLAG, *others: Assign) -> None:
            """Declares an event that takes one mode to another."""
            on: Condition = sympy.Eq(side, mode)
            self._event(condition, (Assign(side, sympy.sympify(to)), *others), on, flags)

        first = sympy.Piecewise((1, surface > 0), (-1, surface < 0), (_ABOVE_IS_TRIED, True))
        moves(sympy.Eq(side, _ON_IT), _ON_IT, first, EventFlag.AT_START)
        # Who arrives reads the field of the other side, and slides if that leads back.
        moves(surface <= 0, 1, _BELOW_IS_TRIED, EventFlag.LISTED)
        moves(surface >= 0, -1, _ABOVE_IS_TRIED, EventFlag.LISTED)
        moves(rate < 0, _ABOVE_IS_TRIED, _BELOW_IS_TRIED)
        moves(rate >= 0, _ABOVE_IS_TRIED, _LEAVES_ABOVE)
        moves(rate > 0, _BELOW_IS_TRIED, 0, NO_FLAG, *([] if drawn is None else [Assign(drawn, sympy.sign(jump))]))
        moves(rate <= 0, _BELOW_IS_TRIED, -1)
        moves(rate >= 0, _LEAVES_ABOVE, 1)
        both = f"on the surface {surface} = 0 of component '{self.name}', both fields lead away: begin beside it"
        leaves: Condition = sympy.Eq(side, _LEAVES_ABOVE)
        self._event(rate < 0, (Terminate(both),), leaves, EventFlag.LISTED)
        if drawn is not None:
            turned = f"along the surface {surface} = 0 of component '{self.name}', both fields lead away from here on"
            gone = Terminate(f"{turned}: the solution may stay, or leave to either side")
            self._event(drawn * jump < 0, (gone,), sympy.Eq(side, 0), EventFlag.LISTED)
        moves(part >= 1, 0, 1, EventFlag.LISTED)
        moves(part <= 0, 0, -1, EventFlag.LISTED)
        return side

    def complementary(
        self, gap: Value, force: Value, name: str | None = None, order: int = 0, restitution: Value | None = None,
        rest_speed: Value = 0.0, clearance: Value = 1e-9, start: Value = 0,
    ) -> DiscreteSymbol:  # fmt: skip
        """Adds gap ≥ 0, force ≥ 0 and gap·force = 0: one of the two is zero, and the other is not negative.

        An ideal diode is `self.complementary(-v, i)`: it blocks while the voltage is negative and conducts without
        voltage while the current is positive. A string of length L is `self.complementary(L - s, tension, order=2)`.

        **Arguments:**

        - `gap`, `force`: expressions. With `order=0`, both of algebraic variables or of derivatives, not of states.
        - `name`: of the discrete variable that says which one is zero: 1 while the gap is, 0 while the force is. With
            `order=0` it becomes at the initial time what the equations ask for. None: `active`, and `active2`,
            `active3`, … for further ones of this component.
        - `order`: how many times the gap must be differentiated to determine the force, as in `either`: 2 if it is
            between positions. When such a gap closes, the speed at which it closes is taken away by an impulse.
        - `restitution`: with `order=2`, what part of that speed is given back: while restitution times the speed is
            above `rest_speed`, the gap opens again at once. None, and what is slower, stays closed.
        - `rest_speed` ≥ 0: in units of the gap per second. With 0, bounces go on for ever, and accumulate.
        - `clearance` > 0: in units of the gap, what counts as none after the force has let go.
        - `start`: with `order` 1 or 2, whether the gap is closed at the initial time, 1, where it and its derivatives
            must be zero, or not, 0.

        **Returns:**

        The discrete variable.

        **Raises:**

        - `ModelError` for a restitution without `order=2`, and what is not an expression.
        """
        gap, force = (_expression(e, f"component '{self.name}': complementary:") for e in (gap, force))
        if restitution is not None and order != HIGHEST:
            raise ModelError(
                f"component '{self.name}': complementary: a restitution is for gaps between positions, order=2; got "
                f"order={order}"
            )
        active = self.discrete(self._free_name("active") if name is None else name, start=start, unit="1")
        closed: Condition = sympy.Eq(active, 1)
        open_: Condition = sympy.Eq(active, 0)
        impulse = self._either(closed, gap, force, order, active)
        chooses = EventFlag.LISTED | EventFlag.AT_START | EventFlag.REVOCABLE
        if impulse is None:
            self._event(force <= 0, (Assign(active, sympy.Integer(0)),), closed, chooses)
            self._event(gap <= 0, (Assign(active, sympy.Integer(1)),), open_, chooses)
            return active
        # A part that was just released is within rounding of the gap, and would be caught again. Until it has lifted by
        # the clearance, it must go as far beyond zero to be caught.
        lifted = self._hidden_discrete(0.0)
        yes, no = sympy.Integer(1), sympy.Integer(0)
        depth = sympy.Piecewise((0, sympy.Eq(lifted, 1)), (clearance, True))
        struck: tuple[Assign, ...] = (Assign(active, yes), Assign(lifted, no))
        if restitution is not None:
            back = sympy.sympify(restitution)
            bounces = -back * der(gap) > rest_speed
            struck = (
                Assign(impulse, sympy.Piecewise((1 + back, bounces), (0, True))),
                Assign(active, sympy.Piecewise((0, bounces), (1, True))),
                Assign(lifted, sympy.Piecewise((1, bounces), (0, True))),
            )
        shown = f"{gap <= 0}, on={open_}"
        self._event(gap + depth <= 0, struck, open_, chooses | EventFlag.STRIKE, shown)
        self._event(force <= 0, (Assign(active, no), Assign(lifted, no)), closed, chooses)
        low: Condition = sympy.Ne(lifted, 1)
        self._event(gap >= clearance, (Assign(lifted, yes),), sympy.And(open_, low), EventFlag.AT_START)
        return active

    def _free_name(self, name: str) -> str:
        """The name, with a number behind it if the component has declared it."""
        taken = {*self.parameters, *self.variables, *self.ports, *self.children}
        return next(n for n in (name, *(f"{name}{k}" for k in range(2, len(taken) + 3))) if n not in taken)

    def _either(
        self, condition: Condition, then: Expression, otherwise: Expression, order: int, pushes: DiscreteSymbol | None
    ) -> RelationSymbol | None:
        """Adds an equation with two branches; for one that is differentiated, what an event assigns to let an impulse
        act: 1 takes away the lowest derivative that may jump, 1 + e gives back the part e of it. `pushes` is the mode
        of a branch whose force is never negative."""
        where = f"component '{self.name}': either"
        if isinstance(order, bool) or not isinstance(order, int | np.integer) or order not in range(HIGHEST + 1):
            raise ModelError(f"{where}: order says how many times a branch is differentiated, 0, 1 or 2; got {order!r}")
        then, otherwise = (_expression(zero_of(b), f"{where}: the branch") for b in (then, otherwise))
        if not order:
            self.add_equations(sympy.Piecewise((then, condition), (otherwise, True)))
            return None
        levels = [then]
        for _ in range(order):
            levels.append(der(levels[-1]))
        impulse, rate = self._hidden_discrete(0.0), self._hidden_discrete(0.0)
        *zero, top = levels
        number = len(self.held_branches)
        asked: Condition = sympy.Ne(impulse, 0)
        acts = sympy.Or(condition, asked)
        self.add_equations(sympy.Piecewise((top + rate, acts), (otherwise, True)))
        self.held_branches.append(
            HeldBranch(
                f"{then} = 0 while {condition}",
                tuple(self._hidden(f":held[{number},{k}]", level) for k, level in enumerate(zero)),
                self._hidden(f":held[{number}]", sympy.Piecewise((1, condition), (0, True))),
                impulse,
                rate,
                None if pushes is None else self._hidden(f":held[{number},force]", otherwise),
                pushes,
            )
        )
        return impulse


def _expression(value: Expression, where: str) -> Expression:
    found = sympy.sympify(value)
    if not isinstance(found, sympy.Expr):
        raise ModelError(f"{where} {value} is not an expression")
    return found
