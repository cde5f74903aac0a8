"""How a component declares equations that change: branches and complementary pairs."""

import sympy

from ..base.aliases import Condition, Expression
from ..base.errors import ModelError
from .declarations import Value
from .equations import zero_of
from .events import Assign, EventFlag, HeldBranch, relation_in_discretes
from .relation_declarations import RelationDeclarations
from .symbols import DiscreteSymbol, RelationSymbol, der

HIGHEST = 2  # the most often that a branch may have to be differentiated: what holds positions back


class ModeDeclarations(RelationDeclarations):
    """The part of `Component` that concerns equations of which events choose one."""

    held_branches: list[HeldBranch]

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

    def complementary(
        self, gap: Value, force: Value, name: str = "active", order: int = 0, restitution: Value | None = None,
        rest_speed: Value = 0.0, clearance: Value = 1e-9, start: Value = 0,
    ) -> DiscreteSymbol:  # fmt: skip
        """Adds gap ≥ 0, force ≥ 0 and gap·force = 0: one of the two is zero, and the other is not negative.

        An ideal diode is `self.complementary(-v, i)`: it blocks while the voltage is negative and conducts without
        voltage while the current is positive. A string of length L is `self.complementary(L - s, tension, order=2)`.

        **Arguments:**

        - `gap`, `force`: expressions. With `order=0`, both of algebraic variables or of derivatives, not of states.
        - `name`: of the discrete variable that says which one is zero: 1 while the gap is, 0 while the force is. With
            `order=0` it becomes at the initial time what the equations ask for.
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
        active = self.discrete(name, start=start, unit="1")
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

    def _either(
        self, condition: Condition, then: Expression, otherwise: Expression, order: int, pushes: DiscreteSymbol | None
    ) -> RelationSymbol | None:
        """Adds an equation with two branches; for one that is differentiated, what an event assigns to let an impulse
        act: 1 takes away the lowest derivative that may jump, 1 + e gives back the part e of it. `pushes` is the mode
        of a branch whose force is never negative."""
        where = f"component '{self.name}': either"
        if isinstance(order, bool) or order not in range(HIGHEST + 1):
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
