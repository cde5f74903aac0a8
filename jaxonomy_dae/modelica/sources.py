"""Classes of Modelica libraries, found by name as the Modelica Language Specification 3.6, chapter 5, says."""

import dataclasses
import functools
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TypeAlias

from ..base.errors import ModelError
from .read_base import read_base
from .tree import Class, Declaration, Modifiers


@dataclasses.dataclass(frozen=True, eq=False)
class Found:
    """A class as it was reached.

    - `path`: its full name, by the package through which it was inherited.
    - `scopes`: where names that it uses are looked up after itself, innermost first.
    - `changes`, `prefixes`: the modifiers and prefixes of the short definitions through which it was reached.
    """

    source: Class
    path: str
    scopes: tuple["Found", ...]
    changes: tuple[tuple[Modifiers, tuple["Found", ...]], ...] = ()
    prefixes: frozenset[str] = frozenset()

    @property
    def inside(self) -> tuple["Found", ...]:
        """Where names that stand in it are looked up."""
        return (self, *self.scopes)

    @functools.cached_property
    def key(self) -> tuple:
        """Equal for classes that were reached alike."""
        return id(self.source), self.path, tuple(id(modifiers) for modifiers, _ in self.changes)


@dataclasses.dataclass(frozen=True, eq=False)
class Constant:
    """A constant of a package, with where the names in its value are looked up."""

    declaration: Declaration
    scopes: tuple[Found, ...]


Member: TypeAlias = Found | Constant


def read_source(file: Path) -> Class:
    """The class of a file.

    **Raises:**

    - `ModelError` for what is not Modelica, with file, line and column.
    """
    try:
        found = read_base(file.read_text(encoding="utf-8-sig"))
    except ModelError as error:
        raise ModelError(f"{file}: {str(error).removeprefix('Base Modelica, ')}") from None
    return found._replace(folder=file.parent) if file.name == "package.mo" else found


def first_broken(roots: Sequence[Path]) -> str | None:
    """What is wrong with the first file of some roots that is not Modelica."""
    for root in roots:
        for file in sorted(root.rglob("*.mo")) if root.is_dir() else [root]:
            try:
                read_source(file)
            except ModelError as error:
                return str(error)
    return None


class Sources:
    """Libraries in folders; `Modelica` of `roots=["lib"]` is `lib/Modelica/package.mo` or `lib/Modelica.mo`, and a root
    may be the folder `lib/Modelica` itself, or a file."""

    def __init__(self, roots: Sequence[str | Path]):
        self.roots = [Path(root) for root in roots]
        self.outermost: dict[str, Found | None] = {}
        self.busy: set[tuple[int, str]] = set()
        self.holders: dict[str, list[Found]] = {}
        self.looked_up: dict[tuple, tuple[Member, list[str]] | None] = {}
        self.declared: dict[tuple, list[tuple[Declaration, tuple[Found, ...]]]] = {}
        self.absent: set[tuple[int, str]] = set()

    def find(self, name: str) -> Member | None:
        """What a full name stands for; None if no root holds it."""
        first, *rest = name.split(".")
        if first not in self.outermost:
            self.outermost[first] = self._file_of(first)
        return self._inner(self.outermost[first], rest)

    def names_in(self, of: Found) -> list[str]:
        """The names of the classes in a package, without inherited ones."""
        folder = of.source.folder
        files = sorted(folder.iterdir()) if folder is not None else []
        inside = [f.stem for f in files if f.suffix == ".mo" and f.stem != "package"]
        return [*of.source.classes, *inside, *(f.name for f in files if (f / "package.mo").exists())]

    def lookup(self, name: str, scopes: Sequence[Found]) -> tuple[Member, list[str]] | None:
        """(What the longest beginning of a name that is a class or constant stands for, the parts behind it)."""
        key = name, *(s.key for s in scopes)
        if key in self.looked_up:
            return self.looked_up[key]
        # Within another search, classes that are being searched are passed over: its answer may lack something, and is
        # not kept.
        complete = not self.busy
        found = self._lookup(name, scopes)
        if complete:
            self.looked_up[key] = found
        return found

    def _lookup(self, name: str, scopes: Sequence[Found]) -> tuple[Member, list[str]] | None:
        first, *rest = name.split(".")
        for scope in scopes:
            # What is declared or inherited hides what is imported (section 5.3.1).
            found = self.member(scope, first) or self._imported(scope, first)
            if found is not None:
                break
        else:
            found = self.find(first)
        if found is None:
            return None
        while rest and isinstance(found, Found):
            inner = self.member(found, rest[0])
            if inner is None:
                return (found, rest) if found.source.literals else None
            found, rest = inner, rest[1:]
        return found, rest

    def class_of(self, name: str, scopes: Sequence[Found]) -> Found | None:
        found = self.lookup(name, scopes)
        return found[0] if found and isinstance(found[0], Found) and not found[1] else None

    def member(self, of: Found, name: str) -> Member | None:
        """A class or constant of a package, inherited ones among them."""
        key = id(of.source), name
        if key in self.busy:  # a base that is looked up in what it is a base of
            return None
        self.busy.add(key)
        try:
            return self._own(of, name) or self._inherited(of, name)
        finally:
            self.busy.discard(key)

    def _own(self, of: Found, name: str) -> Member | None:
        source = of.source
        if name not in source.classes and source.folder is not None and (id(source), name) not in self.absent:
            for file in (source.folder / f"{name}.mo", source.folder / name / "package.mo"):
                if file.exists():
                    source.classes[name] = read_source(file)
            if name not in source.classes:
                self.absent.add((id(source), name))
        if name in source.classes:
            return self._followed(Found(source.classes[name], f"{of.path}.{name}", of.inside))
        for d in source.declarations:
            if d.name == name:
                return Constant(d, of.inside)
        return None

    def _followed(self, found: Found) -> Found:
        """What a short definition stands for; enumerations and types stand for themselves."""
        alias = found.source.alias
        if alias is None or found.source.kind == "type":
            return found
        target = self.class_of(alias.type, found.scopes)
        if target is None:
            return found
        changes = ((alias.modifiers, found.scopes), *target.changes)
        return dataclasses.replace(target, changes=changes, prefixes=target.prefixes | alias.prefixes)

    def _inherited(self, of: Found, name: str) -> Member | None:
        for base, modifiers in of.source.bases:
            target = self.base_of(of, base)
            found = self._changed(of, target, name, [(modifiers, of.inside)]) if target else None
            if found is not None:
                return found
        return self._changed(of, None, name, of.changes)

    def _changed(self, of: Found, base: Found | None, name: str, changes: Sequence) -> Member | None:
        """A member of a base, as modifiers change it."""
        found = self._within(of, base, name) if base else None
        for modifiers, scopes in changes:
            change = modifiers.get(name)
            if isinstance(change, Declaration):
                return self.class_of(change.type, scopes) or found
            if isinstance(found, Constant) and change is not None:
                d = found.declaration
                if isinstance(change, dict):
                    return Constant(d._replace(modifiers={**d.modifiers, **change}), scopes)
                return Constant(d._replace(value=change), scopes)
        return found

    def _within(self, of: Found, base: Found, name: str) -> Member | None:
        """A member of a base: it finds names in the package that inherits it first."""
        found = self.member(base, name)
        if isinstance(found, Constant):
            return Constant(found.declaration, (of, *found.scopes, *of.scopes))
        if found is None or found.path != f"{base.path}.{name}":
            return found
        return Found(found.source, f"{of.path}.{name}", (of, *found.scopes, *of.scopes), found.changes)

    def declarations(self, found: Found) -> list[tuple[Declaration, tuple[Found, ...]]]:
        """The declarations of a class and its bases, as short definitions change them, each with its scopes."""
        key = found.key, *(s.key for s in found.scopes)
        if key not in self.declared:
            self.declared[key] = self._declarations(found)
        return self.declared[key]

    def _declarations(self, found: Found) -> list[tuple[Declaration, tuple[Found, ...]]]:
        out: dict[str, tuple[Declaration, tuple[Found, ...]]] = {}

        def change(modifiers: Modifiers, scopes: tuple[Found, ...]) -> None:
            for name, value in modifiers.items():
                if name in out and value is not None and not isinstance(value, Declaration | dict):
                    out[name] = out[name][0]._replace(value=value), scopes

        for part in self.lineage(found):
            out |= {d.name: (d, part.inside) for d in part.source.declarations}
            for _, modifiers in part.source.bases:  # which are in now
                change(modifiers, part.inside)
        for modifiers, scopes in reversed(found.changes):
            change(modifiers, scopes)
        return list(out.values())

    def lineage(self, found: Found) -> list[Found]:
        """What a class continues or extends, the first base first, and the class itself."""
        out: list[Found] = []
        if found.source.continues:
            inherited = self.inherited_class(found)
            out += self.lineage(inherited) if inherited else []
        for base, _ in found.source.bases:
            target = self.base_of(found, base)
            out += self.lineage(target) if target else []
        return [*out, found]

    def base_of(self, of: Found, name: str) -> Found | None:
        """A base of a class, whose name is looked up among its imports and around it, not in what it inherits."""
        first, *rest = name.split(".")
        if any(local == first for local, _ in of.source.imports):
            found = self._inner(self._imported(of, first), rest)
            return found if isinstance(found, Found) else None
        return self.class_of(name, of.scopes)

    def inherited_class(self, found: Found) -> Found | None:
        """What `redeclare function extends f` continues: f as the bases of its package have it."""
        name, reached = found.source.name, found.scopes[0]
        holder = next((s for s in found.scopes if s.source.classes.get(name) is found.source), reached)
        for base, _ in holder.source.bases:
            target = self.base_of(holder, base)
            inner = self._within(reached, target, name) if target else None
            if isinstance(inner, Found):
                return inner
        return None

    def _imported(self, scope: Found, name: str) -> Member | None:
        # A qualified import comes before what a whole package brings (section 5.3.1).
        qualified = next((full for local, full in scope.source.imports if local == name), None)
        if qualified is not None:
            return self.find(qualified)
        for local, full in scope.source.imports:
            if local == "*":
                package = self.find(full)
                found = self.member(package, name) if isinstance(package, Found) else None
                if found is not None:
                    return found
        return None

    def _inner(self, found: Member | None, names: Sequence[str]) -> Member | None:
        for name in names:
            if not isinstance(found, Found):
                return None
            found = self.member(found, name)
        return found

    # --- files -------------------------------------------------------------------------------------------------------

    def _file_of(self, name: str) -> Found | None:
        for root in self.roots:
            places = [root / name / "package.mo", root / f"{name}.mo"]
            # Folders of libraries may carry a version, as "Modelica 4.1.0" does.
            places += [root / "package.mo"] if root.name.split(" ")[0] == name else []
            places += [root] if root.stem == name and root.suffix == ".mo" else []
            for file in places:
                if file.exists():
                    return Found(read_source(file), name, ())
        return None

    def packages_with(self, name: str) -> list[Found]:
        """All packages that define a function of this name themselves."""
        if name not in self.holders:
            self.holders[name] = list(self._packages_with(name))
        return self.holders[name]

    def _packages_with(self, name: str) -> Iterator[Found]:
        sought = re.compile(rf"\bfunction\s+(extends\s+)?{re.escape(name)}\b")
        for root, file in self._files:
            if sought.search(file.read_text(encoding="utf-8", errors="replace")):
                parts = file.relative_to(root).with_suffix("").parts
                found = self.find(".".join(p for p in parts if p != "package"))
                if isinstance(found, Found):
                    yield from _packages_with(self, found, name)

    @functools.cached_property
    def _files(self) -> list[tuple[Path, Path]]:
        """Pairs (folder that holds the outermost package, file)."""
        tops = [(r.parent if (r / "package.mo").exists() else r, r) for r in self.roots]
        return [(top, file) for top, root in tops for file in sorted(root.rglob("*.mo"))]


def _packages_with(library: Sources, found: Found, name: str) -> Iterator[Found]:
    if name in found.source.classes:
        yield found
    for inner in list(found.source.classes):
        member = library.member(found, inner)
        if isinstance(member, Found) and member.source.kind == "package" and member.path == f"{found.path}.{inner}":
            yield from _packages_with(library, member, name)
