"""Sentences about equations that determine the same thing twice.

Given equations of the flattened model that depend on each other, finds the fewest of them that do, the components that
wrote these, and what their ports share.
"""

import functools
from collections.abc import Sequence

import numpy as np

from ...base.tolerances import NO_PART, RANK
from ...graph.judgement.rank import DECOMPOSED_UPTO
from ..model.entries import Entries
from ..model.tables import ZERO, AliasTable, FlatModel, equation_offsets, provenance_of
from .wording import DomainWords, listed, words


class Explainer:
    """Sentences about equations of the flattened model."""

    def __init__(self, flat: FlatModel, entries: Entries, determined_by: np.ndarray):
        self.flat = flat
        self.entries = entries
        self.determined_by = determined_by

    @functools.cached_property
    def start(self) -> np.ndarray:
        """Where the entries of each equation begin."""
        return np.searchsorted(self.entries.row, np.arange(self.entries.n_rows + 1))

    @functools.cached_property
    def number(self) -> dict[str, int]:
        """The components' numbers by name."""
        return {name: k for k, name in enumerate(self.flat.components)}

    def behind(self, rows: list[int]) -> tuple[np.ndarray, np.ndarray]:
        """Returns (the equations `rows` with those that determine their known variables, all variables in them),
        reduced to the smallest set of equations that depend on each other."""
        seen, todo, variables = set(rows), list(rows), set()
        while todo:
            row = todo.pop()
            for v in self.entries.variable[self.start[row] : self.start[row + 1]].tolist():
                variables.add(v)
                by = int(self.determined_by[v])
                if by >= 0 and by not in seen:
                    seen.add(by)
                    todo.append(by)
        return self._smallest(np.array(sorted(seen), np.int64), np.array(sorted(variables), np.int64))

    def _smallest(self, rows: np.ndarray, variables: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Reduces equations that depend on each other to the smallest such set: the support of the left null vector.
        Entries that are not numbers are drawn at random."""
        if not 1 < len(rows) <= DECOMPOSED_UPTO:
            return rows, variables
        matrix = np.zeros((len(rows), len(variables)))
        # Coefficients that follow values count as any numbers, which cancel by no chance. The seed is fixed, so that
        # the message is the same each time.
        random = np.random.default_rng(0)
        for i, row in enumerate(rows.tolist()):
            inside = slice(self.start[row], self.start[row + 1])
            here = self.entries.coefficient[inside]
            drawn = np.where(np.isnan(here), random.uniform(0.5, 2.0, len(here)), here)
            np.add.at(matrix[i], np.searchsorted(variables, self.entries.variable[inside]), drawn)
        u, singular, _ = np.linalg.svd(matrix, full_matrices=True)
        rank = int((singular > RANK).sum())
        # With several null vectors, the one that the decomposition returns mixes unrelated equations.
        if rank != len(rows) - 1:
            return rows, variables
        rows = rows[np.abs(u[:, -1]) > NO_PART]
        kept = [self.entries.variable[self.start[r] : self.start[r + 1]] for r in rows.tolist()]
        return rows, np.unique(np.concatenate(kept)) if kept else variables[:0]

    def kind(self, rows: np.ndarray, variables: np.ndarray) -> str:
        """'across' or 'through', if these equations determine quantities of that kind at ports of one domain; else
        'mixed'."""
        table = self.flat.variables
        at_ports = variables[table.port[variables] >= 0]
        domains = {self.flat.ports.domains[p] for p in table.port[at_ports].tolist()}
        kinds = set(table.is_across[at_ports].tolist())
        if len(domains) != 1 or len(kinds) != 1:
            return "mixed"
        if len(at_ports) < 2 and not self.flat.ports.is_loose[table.port[at_ports]].any():
            return "mixed"
        names = self.components(rows)
        if not names or (True in kinds and len(names) == 1 and len(self._ports_of(names[0], at_ports)) < 2):
            return "mixed"
        return "across" if True in kinds else "through"

    def _ports_of(self, component: str, variables: np.ndarray) -> list[str]:
        """The ports of a component that these variables belong to."""
        ports = np.unique(self.flat.variables.port[variables])
        return [self.flat.ports.names[p] for p in ports if self.flat.ports.owner[p] == self.number[component]]

    def components(self, rows) -> list[str]:
        """The components that wrote these equations, in the order of the model."""
        found = {provenance_of(self.flat.groups, int(r)).component for r in rows}
        return [c for c in self.flat.components if c in found]  # connections and networks are none

    def quantity(self, variables) -> str:
        """The name that the first port variable among these has at its port."""
        table = self.flat.variables
        return table.names[variables[table.port[variables] >= 0][0]].rsplit(".", 1)[1]

    def where(self, rows, variables) -> tuple[tuple[str, ...], tuple[int, ...]]:
        """The components that wrote these equations, and the ports of these variables."""
        ports = np.unique(self.flat.variables.port[variables])
        return tuple(self.components(rows)), tuple(ports[ports >= 0].tolist())

    def once_too_often(self, rows, variables, kind: str, quantities: Sequence[str]) -> str:
        """The sentence that several components determine one quantity, in the port's words."""
        table = self.flat.variables
        at_ports = variables[table.port[variables] >= 0]
        names = self.components(rows)
        word = words(self.flat.ports.domains[table.port[at_ports[0]]], quantities, quantities[0])
        if kind == "through":
            return self._flows(rows, np.unique(table.port[at_ports]), word)
        if len(names) == 1:
            own = listed(self._ports_of(names[0], at_ports))
            return (
                f"the ports {own} of '{names[0]}' are connected with each other, but '{names[0]}' fixes the "
                f"{word.between} between them. Remove the connection, or put {word.bridge} into it."
            )
        if all(self.flat.ports.count(self.number[n]) == 1 for n in names):
            every = "both fix" if len(names) == 2 else "each fix"
            return (
                f"{listed(names)} {every} the {word.across} of one node. Keep one of them, or put {word.bridge} "
                "between them."
            )
        return (
            f"{listed(names)} form a loop, and each of them fixes a {word.between}: one too many. Remove one of them, "
            f"or put {word.bridge} into the loop."
        )

    def _flows(self, rows, at_ports, word: DomainWords) -> str:
        """The sentence that a flow is fixed twice: by sources in series, at a node, or by a source and a loose port."""
        alone = [r for r in rows.tolist() if self.start[r + 1] - self.start[r] == 1]
        names = self.components(alone) or self.components(rows)
        loose = [self.flat.ports.names[p] for p in at_ports.tolist() if self.flat.ports.is_loose[p]]
        if loose:
            return (
                f"nothing is connected to {listed(loose)}, so no {word.through} flows there, but {listed(names)} "
                f"{'fixes' if len(names) == 1 else 'fix'} it. Connect {listed(loose)}."
            )
        if len(names) == 1:
            return (
                f"'{names[0]}' fixes a {word.through} that has no way back. Connect {word.bridge} in parallel with it."
            )
        series = "are in series and both fix the" if len(names) == 2 else "meet, and each of them fixes its"
        return (
            f"{listed(names)} {series} {word.through}: one too many. Remove one of them, or connect {word.bridge} in "
            "parallel with one of them."
        )

    def sources(self, rows, groups, alias: AliasTable) -> str:
        """The sentence that the flows between two parts of the model are all fixed; "" if none is."""
        flat = self.flat
        known = set()
        roots: dict[int, int] = {}
        for v in np.flatnonzero((self.determined_by >= 0) & (alias.order == 0)).tolist():
            roots.setdefault(int(alias.root[v]), v)
        offsets = equation_offsets(groups)
        for row in rows.tolist():
            g = int(np.searchsorted(offsets, row, side="right") - 1)
            for v in groups[g].variable[row - int(offsets[g])].tolist():
                if v != ZERO and v in roots:
                    known.add(int(self.determined_by[roots[v]]))
        behind, variables = self.behind(sorted(known))
        names = self.components(behind)
        if not names:
            return ""
        at_ports = [int(flat.variables.port[v]) for v in variables if flat.variables.port[v] >= 0]
        word = words(flat.ports.domains[at_ports[0]] if at_ports else "")
        fix = "fixes" if len(names) == 1 else "fix"
        return (
            f"{listed(names)} {fix} every {word.through} between two parts of the model: one too many. Remove one of "
            f"them, or connect {word.bridge} in parallel with one of them."
        )
