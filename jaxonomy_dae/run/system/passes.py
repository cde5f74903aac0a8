"""What each pass of the compiler made of a model, in user names."""

import dataclasses
from collections.abc import Callable, Iterator

import numpy as np

from ...compile.diagnosis.wording import counted
from ...compile.lowering.plan import SystemPlan
from ...compile.lowering.schedule import AnyStep
from ...compile.model.tables import ZERO, provenance_of
from ...compile.passes.added_passes import PassResult
from .sections import HTML_SHOWN, SHOWN, Sections, folded, some


@dataclasses.dataclass(frozen=True)
class Pass:
    """What one pass did: its name, what it does to every model, and how many changes it made to this one."""

    name: str
    does: str
    count: int
    _lines: Callable[[], Iterator[str]]

    @property
    def lines(self) -> list[str]:
        """All changes, one text for each."""
        return list(self._lines())

    def first(self, most: int) -> list[str]:
        """The first changes, and how many there are if these are not all."""
        shown = [line for line, _ in zip(self._lines(), range(most), strict=False)]
        return [*shown, *([f"… ({self.count} in all)"] if self.count > len(shown) else [])]

    def __repr__(self):
        return "\n".join([f"{self.name}: {self.does}", *(f"    {line}" for line in self.first(SHOWN))])


class Passes(Sections):
    """The passes of a compilation, in order; `print(passes)` shows them, `passes["order_blocks"].lines` has all lines
    of one.

    - `flatten`: the equations that components and connections give.
    - the passes that the compiler was given.
    - `eliminate_aliases`: each variable that is replaced by another one, its derivative, or zero.
    - `reduce_index`: each equation that is differentiated, and how often.
    - `select_states`: the states, and what became of the other candidates.
    - `order_blocks`: which equations determine which unknowns, in the order of their evaluation.
    - `schedule`: how these blocks are solved, alike ones together.
    """

    def __init__(self, plan: SystemPlan, given: tuple[PassResult, ...] = ()):
        self._plan = plan
        self._given = given

    def __iter__(self) -> Iterator[Pass]:
        plan = self._plan
        flat, extended = plan.flat, plan.extended
        yield Pass(
            "flatten",
            f"the equations of {counted(len(flat.components), 'component')} and of their connections",
            # The plan's flat model is what the user's passes have left: flattening is shown as it was before them.
            self._given[0].before.n_equations if self._given else flat.n_equations,
            self._flattened,
        )
        for each in self._given:
            yield Pass(each.name, each.does, len(each.lines), lambda lines=each.lines: iter(lines))
        yield Pass(
            "eliminate_aliases",
            "what an equation says to equal another variable, its derivative or zero is replaced by it",
            len(self._aliases),
            self._replaced,
        )
        counts = np.bincount(extended.base, minlength=1) - 1
        yield Pass(
            "reduce_index",
            "equations are differentiated until the highest derivatives can be matched with them (Pantelides 1988)",
            int((counts > 0).sum()),
            lambda: (
                f"{counts[e]}× {provenance_of(plan.model.groups, e)}" for e in map(int, np.flatnonzero(counts > 0))
            ),
        )
        parts = self._selected()
        yield Pass(
            "select_states", f"candidates become states, {selection_rule(plan.mode)}", len(parts), parts.__iter__
        )
        yield Pass(
            "order_blocks",
            "each equation determines an unknown, or several equations several at once (Duff & Reid 1978)",
            len(plan.blocks),
            self._ordered,
        )
        steps = self._scheduled()
        yield Pass(
            "schedule",
            "blocks of one shape and level are evaluated together; simultaneous ones are torn or solved whole",
            len(steps),
            steps.__iter__,
        )

    def __getitem__(self, name: str) -> Pass:
        found = {each.name: each for each in self}
        if name not in found:
            raise KeyError(f"there is no pass '{name}': {', '.join(found)}")
        return found[name]

    def _contents(self):
        sections: list[tuple[str, list[str]]] = []
        for number, each in enumerate(self, start=1):
            title = f"{number}. {each.name}: {each.does} ({each.count})"
            sections.append((title, each.first(HTML_SHOWN) if each.count else ["nothing to do"]))
        return [], sections

    def _flattened(self) -> Iterator[str]:
        flat = self._given[0].before if self._given else self._plan.flat
        for group in flat.groups:
            yield from map(str, group.provenance)

    @property
    def _aliases(self) -> np.ndarray:
        """The variables that are replaced, but for those that the compiler made."""
        alias, table = self._plan.model.alias, self._plan.flat.variables
        own = (alias.root == np.arange(len(table))) & (alias.order == 0)
        return np.flatnonzero(~own & ~table.is_internal)

    def _replaced(self) -> Iterator[str]:
        alias, names = self._plan.model.alias, self._plan.flat.variables.names
        for v in self._aliases.tolist():
            root, order, factor = int(alias.root[v]), int(alias.order[v]), float(alias.factor[v])
            if root == ZERO:
                yield f"{names[v]} = 0"
                continue
            times = {1.0: "", -1.0: "−"}.get(factor, f"{factor:.6g}·")
            yield f"{names[v]} = {times}{'der(' * order}{names[root]}{')' * order}"

    def _selected(self) -> list[str]:
        plan = self._plan
        parts = (
            ("states", plan.states),
            ("dummy derivatives, which equations determine", plan.selection.dummies),
            ("known without any state", plan.selection.settled),
        )
        named = [(what, [plan.quantity_name[q] for q in chosen.tolist()]) for what, chosen in parts]
        lines = [f"{what}: {some(folded(names))}" for what, names in named if names]
        constraints = [plan.describe(int(e)) for e in plan.selection.constraints[:HTML_SHOWN]]
        return lines + [f"projected onto: {text}" for text in constraints]

    def _ordered(self) -> Iterator[str]:
        plan, blocks = self._plan, self._plan.blocks
        for b in range(len(blocks)):
            inside = slice(int(blocks.pointer[b]), int(blocks.pointer[b + 1]))
            unknowns = [plan.quantity_name[q] for q in blocks.unknowns[inside].tolist()]
            equations = [plan.describe(e) for e in blocks.equations[inside][:SHOWN].tolist()]
            together = " together" if len(unknowns) > 1 else ""
            yield f"{some(unknowns)}{together} ← {some([f'({text})' for text in equations])}"

    def _scheduled(self) -> list[str]:
        single = sum(step.n for step in self._plan.steps if not step.simultaneous)
        kinds = {True: "linear", False: "nonlinear, its tearing variables refined by Newton's method"}
        head = [f"{counted(single, 'equation')} solved for one unknown each, in closed form"] if single else []
        return head + [
            f"{times}{counted(len(names), 'unknown')} ({some(names)}): {kinds[step.linear]}; {how}"
            for step, times, names, how in simultaneous_blocks(self._plan)
        ]


def simultaneous_blocks(plan: SystemPlan) -> Iterator[tuple[AnyStep, str, list[str], str]]:
    """The blocks that take more than one division, alike ones once: (the step, how many in words, the names of the
    unknowns, how the block is solved)."""
    for step in plan.steps:
        for count, unknown, torn in step.listed() if step.simultaneous else ():
            names, torn_names = ([plan.quantity_name[q] for q in which.tolist()] for which in (unknown, torn))
            how = "solved whole, sparse" if step.whole else f"torn at {some(torn_names)}"
            yield step, f"{count} × " if count > 1 else "", names, how


def selection_rule(mode: str) -> str:
    """What decides which candidates are states, in words."""
    return {
        "dummy_derivatives": "a minimal set by dummy derivatives (Mattsson & Söderlind 1993)",
        "projection": "all of them, with projection onto the hidden constraints",
    }.get(mode, "by dummy derivatives where constraints have a constant Jacobian, with projection elsewhere")
