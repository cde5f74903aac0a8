"""Modelica libraries, whose classes are classes of components."""

import functools
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..base.errors import ModelError, nearest
from . import tree
from .balance import balance
from .boundaries import flattened
from .clocked_boundaries import Signal, signals_of, with_clock
from .front_end import FrontEnd, Unbalanced, Unclocked
from .modification import modification
from .open_class import OpenClass, opened
from .open_component import OpenComponent
from .read_base import Reader
from .shelf import Shelf
from .sources import Found, Sources
from .tree import Declaration


class Library:
    """Modelica libraries. `library["Modelica.Electrical.Analog.Semiconductors.NPN"]` is a class of components.

    ```python
    library = modelica.Library(["libraries"])  # the folder that holds the folder Modelica
    NPN = library["Modelica.Electrical.Analog.Semiconductors.NPN"]
    q = NPN(ev, "q", Bf=80.0)
    diagram.connect(q.C, resistor.p)
    ```

    **Arguments:**

    - `roots`: folders or files of Modelica sources, and files that `python -m jaxonomy_dae.modelica pack` has written.
        Sources are flattened by rumoca (extra `modelica`) when a class is asked for; files of `pack` need no front end.

    A class that was flattened is kept as data in the user's cache directory (`keep_programs` chooses another), by its
    name, its modifications, the contents of the roots and the version of rumoca.
    """

    def __init__(self, roots: str | Path | Sequence[str | Path]):
        each = [roots] if isinstance(roots, str | Path) else list(roots)
        missing = [str(root) for root in each if not Path(root).exists()]
        if missing:
            raise ModelError(f"roots: there is no '{missing[0]}'")
        self.shelf = Shelf([Path(root) for root in each])
        self.sources = [Path(root) for root in each if Path(root).suffix != ".zip"]
        self._classes: dict[tuple[str, str, str, float | None], type[OpenComponent]] = {}

    @functools.cached_property
    def front_end(self) -> FrontEnd:
        """rumoca with the sources of the library, which it reads once."""
        return FrontEnd(self.sources)

    @functools.cached_property
    def _names(self) -> Sources:
        return Sources(self.sources)

    def __getitem__(self, name: str) -> type[OpenComponent]:
        return self.component(name)

    def component(
        self, name: str, *texts: str, source: str | None = None, clock: float | None = None, **modifications: Any
    ) -> type[OpenComponent]:
        """A class of the library as a class of components; the arguments are those of `component`."""
        changes = modification(texts, modifications)
        if clock is not None and not (isinstance(clock, int | float) and 0 < clock < math.inf):
            raise ModelError(f"clock: the seconds between two ticks are a positive number; got {clock!r}")
        key = name, changes, source or "", clock
        if key not in self._classes:
            found = self.opened(name, changes, source, clock)
            _check_modified(found, {**_named_in(texts), **modifications})
            self._classes[key] = component_of(found)
        return self._classes[key]

    def opened(self, name: str, changes: str = "", source: str | None = None, clock: float | None = None) -> OpenClass:
        """What is known of a class with modifications, given as text, and with seconds between ticks of its clock."""
        told = f"{changes}; Clock({clock!r})" if clock is not None else changes
        found = self.shelf.find(name, told, source or "")
        if found is None:
            found = self._flattened(name, changes, source, clock)
            self.shelf.keep(found, name, told, source or "")
        return found

    def _flattened(self, name: str, changes: str, source: str | None, clock: float | None) -> OpenClass:
        if not self.sources and source is None:
            packed = self.shelf.names()
            if name in packed:
                raise ModelError(
                    f"'{name}' is packed without the modifications '{changes}': roots=[…] with the sources of the "
                    "library opens it with them"
                )
            if not self.shelf.packs:
                raise ModelError(f"'{name}': roots=[…] names the folder of its library, or source= holds its text")
            raise ModelError(f"there is no class '{name}' in {self.shelf}: {nearest(name, packed)}")
        if source is None:
            self._check_known(name)
        if clock is not None:
            signals = self._signals(name, source)
            try:
                closed = with_clock(self.front_end, name, changes, source, signals, float(clock))
            except Unclocked as error:
                raise ModelError(
                    f"'{name}': one clock does not say when all of its clocks tick; parameters of the class may say "
                    f"how they are related, as inferFactor=False, factor=2 do: {error}"
                ) from None
            return opened(name, closed, self._names)
        # Records are read from the sources only if the front end misses equations: it takes a search through files.
        try:
            records, counted = functools.partial(self._records, name, source), self._counted(name, source)
            closed = flattened(self.front_end, name, changes, source, records, counted)
            return opened(name, closed, self._names)
        except Unclocked:
            raise ModelError(
                f"'{name}': its surroundings decide when its clock ticks. component(…, clock=0.1) opens it with a "
                "clock that ticks every 0.1 s, which samples its inputs. Blocks of one clock that read each other at a "
                "tick are a part of a model that opens as a whole: component(name, source=text, roots=[…])"
            ) from None
        except Unbalanced as error:
            found = self._names.find(name) if source is None else None
            if not isinstance(found, Found):
                raise
            raise ModelError(f"{error}. {balance(self._names, found)}") from None
        except ModelError:
            if source is None:
                self._names.find(name)  # says where its file is not Modelica, if that is the reason
            raise

    def _signals(self, name: str, source: str | None) -> list[Signal]:
        """The inputs and outputs of a class of the roots."""
        found = self._names.find(name) if source is None else None
        if not isinstance(found, Found):
            raise ModelError(f"'{name}': clock=… is for classes of the roots; a text of source=… has its own clock")
        return list(signals_of(self._names, found))

    def _records(self, name: str, source: str | None) -> dict[str, bool]:
        """The overdetermined records of a class's connectors; true for those of conditional ones."""
        found = self._names.find(name) if source is None else None
        if not isinstance(found, Found):
            return {}
        return {
            f"{connector.name}.{record}": "conditional" in connector.prefixes
            for connector, scopes in self._names.declarations(found)
            if not connector.dimensions
            and (of := self._names.class_of(connector.type, scopes)) is not None
            and of.source.kind == "connector"
            for record in self._overdetermined(of)
        }

    def _counted(self, name: str, source: str | None) -> frozenset[str]:
        """The connectors of a class whose connections its equations count; assertions do not matter."""
        found = self._names.find(name) if source is None else None
        if not isinstance(found, Found):
            return frozenset()
        equations = [e for part in self._names.lineage(found) for e in part.source.equations]
        return frozenset(
            call.arguments[0].path
            for call in tree.each_part(tuple(e for e in equations if not isinstance(e, tree.Effect)))
            if isinstance(call, tree.Call) and call.function == "cardinality"
            if isinstance(call.arguments[0], tree.Reference)
        )

    def _overdetermined(self, connector: Found) -> Iterator[str]:
        """The records of a connector whose type has a function `equalityConstraint`: they are overdetermined."""
        for d, scopes in self._names.declarations(connector):
            of = self._names.class_of(d.type, scopes)
            if of is not None and isinstance(self._names.member(of, "equalityConstraint"), Found):
                yield d.name

    def _check_known(self, name: str) -> None:
        """Names what is near a class that no root holds, before the front end reads the whole library."""
        sources = self._names
        try:
            known = sources.find(name)
        except ModelError:  # a file that only the front end reads
            return
        if isinstance(known, Found):
            if known.source.kind in ("package", "connector", "function", "record", "type"):
                raise ModelError(f"'{name}' is a {known.source.kind}: only models and blocks are components")
            return
        package, _, last = name.rpartition(".")
        while package:
            found = sources.find(package)
            if isinstance(found, Found):
                raise ModelError(f"'{package}' has no class '{last}': {nearest(last, sources.names_in(found))}")
            package, _, last = package.rpartition(".")
        where = ", ".join(map(str, self.sources))
        raise ModelError(f"'{name}' is in none of the roots: {where}; roots=[…] names the folder that holds '{last}'")


def _named_in(texts: Sequence[str]) -> dict[str, None]:
    """The components that texts modify; redeclared classes are none."""
    modifiers = Reader(f"({', '.join(texts)})").modifiers()
    return {name: None for name, value in modifiers.items() if not isinstance(value, Declaration)}


def _check_modified(of: OpenClass, modifications: Mapping[str, Any], outer: str = "") -> None:
    """Refuses modifications of what the class does not have: rumoca passes over them."""
    names = [d.name for d in of.flat.model.declarations]
    for name, value in modifications.items():
        full = outer + name
        if isinstance(value, Mapping):
            _check_modified(of, value, f"{full}.")
        elif not any(re.match(rf"{re.escape(full)}($|[.\[])", re.sub(r"\[[^]]*\]\.", ".", n)) for n in names):
            raise ModelError(f"'{of.name}' has no '{full}' to modify: {nearest(full, names)}")


def component_of(of: OpenClass) -> type[OpenComponent]:
    """The class of components of an opened class."""
    last = of.name.rpartition(".")[2]
    return type(last, (OpenComponent,), {"opened": of, "__doc__": _described(of), "__module__": __name__})


def _described(of: OpenClass) -> str:
    lines = [of.description or of.name, "", f"The Modelica class `{of.name}`."]
    for title, names in (
        ("Ports", [p.name for p in of.ports]),
        ("Inputs", of.inputs),
        ("Outputs", of.outputs),
        ("Required parameters", of.required),
        ("Parameters", [n for n in of.tunable if n not in of.required]),
    ):
        if names:
            lines += ["", f"{title}: {', '.join(f'`{n}`' for n in names)}."]
    return "\n".join(lines)


def component(
    name: str,
    *texts: str,
    roots: str | Path | Sequence[str | Path] = (),
    source: str | None = None,
    clock: float | None = None,
    **modifications: Any,
) -> type[OpenComponent]:
    """A Modelica class as a class of components, with ports, signals and parameters.

    ```python
    NPN = modelica.component(
        "Modelica.Electrical.Analog.Semiconductors.NPN",
        roots=["libraries"],
        useHeatPort=True,
    )
    q = NPN(ev, "q", Bf=80.0)
    diagram.connect(q.C, resistor.p)
    diagram.connect(q.heatPort, sink.port)
    ```

    Connectors are ports: `Electrical`, `Rotational`, `Translational`, `Thermal` and `Hydraulic` where the quantities
    are those of this package, and ports of a domain of their own otherwise. Of a connector of connectors, each
    innermost one is a port: `r.plug_p[0]` is an `Electrical` port. Inputs and outputs are signals; Boolean inputs are
    true above 1/2.

    **Arguments:**

    - `name`: the full name of a model or block, in the roots or in `source`.
    - `texts`: modifications as Modelica text, such as `"redeclare package Medium = Water"`.
    - `roots`: as those of `Library`.
    - `source`: Modelica text, such as a part of a system that is connected inside and has plain connectors outside.
    - `clock` > 0: seconds between the ticks of the clock of a class whose surroundings decide it (chapter 16 of the
        Modelica Language Specification). Inputs are sampled at the ticks, as they are before anything happens there,
        and outputs are held in between.
    - `modifications`: values of parameters by name. They may decide the structure (conditional connectors, sizes,
        enumerations, given by the text of their name). Values of Real parameters may be given later, too.

    **Raises:**

    - `ModelError` for a class that is not found, is partial or not balanced, for constructs that are not read, and for
        connectors with stream variables or in overdetermined graphs.
    - `MissingPackage` if rumoca is needed and not installed.
    """
    return _library(tuple(map(str, [roots] if isinstance(roots, str | Path) else roots))).component(
        name, *texts, source=source, clock=clock, **modifications
    )


@functools.lru_cache(maxsize=1)  # a session of rumoca with the Modelica library takes 1.3 GB
def _library(roots: tuple[str, ...]) -> Library:
    return Library(roots)
