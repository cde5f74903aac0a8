"""Pages of the component library, made from the code when the documentation is built (a hook of MkDocs).

Each domain of `jaxonomy_dae.library` gets a page with its components: what they are, ports, parameters, variables,
equations and events. A component is made once, with its default arguments, and asked for what it declares.
"""

import importlib
import inspect
import math
import pkgutil
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import jax
import sympy
from library_latex import displayed
from sympy.printing.str import StrPrinter

import jaxonomy_dae.library
from jaxonomy_dae import Component, Domain, EqnEnv
from jaxonomy_dae.write.arrays import ComponentArray, PortArray
from jaxonomy_dae.write.events import Assign, EventFlag, Reinit, Sampled, Terminate
from jaxonomy_dae.write.interval import Interval
from jaxonomy_dae.write.symbols import ParameterSymbol, RelationSymbol

# Of components that need more than an environment and a name.
BATTERY = {"soc": [0.0, 0.5, 1.0], "ocv": [3.0, 3.7, 4.2]}
ARGUMENTS: dict[str, dict[str, Any]] = {
    "Cell": BATTERY,
    "HeatedCell": BATTERY,
    "HeatedPack": BATTERY | {"series": 3, "parallel": 2},
    "Pack": BATTERY | {"series": 3, "parallel": 2},
    "DiscreteTransferFunction": {"numerator": [1.0], "denominator": [1.0, -0.5]},
    "Noise": {"key": jax.random.key(0)},
    "StateSpace": {"A": [[-1.0]], "B": [[1.0]], "C": [[1.0]]},
    "Table1D": {"x": [0.0, 1.0], "values": [0.0, 1.0]},
    "Table2D": {"x": [0.0, 1.0], "y": [0.0, 1.0], "values": [[0.0, 1.0], [1.0, 2.0]]},
    "TransferFunction": {"numerator": [1.0], "denominator": [1.0, 1.0]},
}
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
SHARED = {"one_axis", "waveforms"}  # modules of classes that domains share; a component needs a domain
TITLE = "Library"
WIDTH = 80  # letters in a line of code at 1280 px


# --- what there is -----------------------------------------------------------------------------------------------


def classes_of(domain: str) -> list[type[Component]]:
    """The components of a domain, in the order in which its code has them."""
    module = importlib.import_module(f"{jaxonomy_dae.library.__name__}.{domain}")
    is_package = hasattr(module, "__path__")
    found = {
        (value.__module__, value.__name__): value
        for name, value in vars(module).items()
        if inspect.isclass(value)
        and issubclass(value, Component)
        and not name.startswith("_")
        and (value.__module__.startswith(f"{module.__name__}.") if is_package else value.__module__ == module.__name__)
    }
    modules = dict.fromkeys(name for name, _ in found)
    # A module's names stand in the order in which they were made. Reading its source for each class took seconds.
    return [found[name, made] for name in modules for made in vars(sys.modules[name]) if (name, made) in found]


def domains() -> list[str]:
    """The domains that have components, signals last."""
    names = [m.name for m in pkgutil.iter_modules(jaxonomy_dae.library.__path__) if m.name not in SHARED]
    return sorted((n for n in names if classes_of(n)), key=lambda n: (n == "signal", n))


def components_of(domain: str) -> list[Component]:
    """A component of each class of a domain."""
    return [make(cls) for cls in classes_of(domain)]


def make(cls: type[Component]) -> Component:
    return cls(EqnEnv(), cls.__name__.lower(), **ARGUMENTS.get(cls.__name__, {}))


@contextmanager
def as_written() -> Iterator[tuple[list[Any], list[Any]]]:
    """The equations and events that components are given meanwhile, each with its component."""
    equations: list[Any] = []
    events: list[Any] = []
    add_equations, event, either = Component.add_equations, Component._event, Component._either

    def noted_equations(self: Component, *given: Any) -> None:
        equations.extend((self, equation) for equation in given)
        add_equations(self, *given)

    def noted_event(
        self: Component, condition: Any, actions: Any, on: Any, flags: EventFlag, *rest: Any, **more: Any
    ) -> None:
        if EventFlag.LISTED in flags:
            events.append((self, condition, actions, on))
        event(self, condition, actions, on, flags, *rest, **more)

    def noted_either(self: Component, condition: Any, then: Any, otherwise: Any, order: int, pushes: Any) -> Any:
        so_far = len(equations)
        impulse = either(self, condition, then, otherwise, order, pushes)
        equations[so_far:] = [(self, sympy.Piecewise((then, condition), (otherwise, True)))]
        return impulse

    Component.add_equations, Component._event, Component._either = noted_equations, noted_event, noted_either
    try:
        yield equations, events
    finally:
        Component.add_equations, Component._event, Component._either = add_equations, event, either


# --- texts -------------------------------------------------------------------------------------------------------


class Printer(StrPrinter):
    """Expressions as one writes them in plain text: v = R·i², √(x), −a."""

    def _print_Mul(self, expr: Any) -> str:
        number, rest = expr.as_coeff_Mul()
        if number < 0:
            return f"−{self._inside(-expr, (-expr).is_Add)}"
        if number == sympy.Float(1):
            return self._print(rest)
        above, below = sympy.fraction(expr, exact=True)
        if below is not sympy.S.One:
            return f"{self._inside(above, above.is_Add)}/{self._inside(below, below.is_Mul or below.is_Add)}"
        factors = sorted(sympy.Mul.make_args(expr), key=_rank)
        turned = [f.is_Add and all(map(_is_negative, f.args)) for f in factors]
        text = "·".join(self._inside(-f if turn else f, f.is_Add) for f, turn in zip(factors, turned, strict=True))
        return ("−" if sum(turned) % 2 else "") + text

    def _print_Add(self, expr: Any, order: Any = None) -> str:
        terms = sorted(self._as_ordered_terms(expr, order=order), key=lambda t: (_is_negative(t), not t.is_number))
        text = ""
        for term in terms:
            negative = _is_negative(term)
            inside = self._print(-term if negative else term)
            sign = (" − " if negative else " + ") if text else ("−" if negative else "")
            text += sign + (f"({inside})" if negative and (-term).is_Add else inside)
        return text

    def _print_Pow(self, expr: Any, rational: bool = False) -> str:
        base, exponent = expr.base, expr.exp
        if exponent.is_Rational and exponent < 0:
            below = base**-exponent
            return f"1/{self._inside(below, below.is_Mul or below.is_Add)}"
        if exponent == sympy.Rational(1, 2):
            return f"√{self._inside(base, not base.is_Integer)}"
        text = self._inside(base, not base.is_Atom and not base.is_Function)
        if exponent.is_Integer:
            return text + str(exponent).translate(SUPERSCRIPTS)
        return f"{text}^{self._inside(exponent, not exponent.is_Symbol)}"

    def _inside(self, expr: Any, parenthesised: bool) -> str:
        return f"({self._print(expr)})" if parenthesised else self._print(expr)

    def _print_Float(self, expr: Any) -> str:
        return f"{float(expr):g}".replace("-", "−")

    def _print_Integer(self, expr: Any) -> str:
        return str(expr).replace("-", "−")

    def _print_TimeSymbol(self, expr: Any) -> str:
        return "t"

    _print_EnvironmentTime = _print_TimeSymbol

    def _print_Pi(self, expr: Any) -> str:
        return "π"

    def _print_Abs(self, expr: Any) -> str:
        return f"|{self._print(expr.args[0])}|"

    def _print_Relational(self, expr: Any) -> str:
        signs = {"==": "=", "!=": "≠", "<=": "≤", ">=": "≥"}
        return f"{self._print(expr.lhs)} {signs.get(expr.rel_op, expr.rel_op)} {self._print(expr.rhs)}"

    def _print_And(self, expr: Any) -> str:
        return " and ".join(sorted(self._print(a) for a in expr.args))

    def _print_Or(self, expr: Any) -> str:
        live = [a for a in expr.args if isinstance(a, sympy.And) and a.atoms(RelationSymbol)]
        if live:  # a relation whose changes are events
            return self._print(sympy.And(*(a for a in live[0].args if not a.atoms(RelationSymbol))))
        return " or ".join(sorted(self._print(a) for a in expr.args))

    def _print_Piecewise(self, expr: Any) -> str:
        parts = []
        for value, condition in expr.args:
            when = "otherwise" if condition == sympy.true else f"if {self._print(condition)}"
            parts.append(f"{self._print(value)} {when}")
        return f"({', '.join(parts)})"


def _is_negative(term: Any) -> bool:
    return bool(term.as_coeff_Mul()[0] < 0)


def _rank(factor: Any) -> tuple[int, str]:
    """Numbers first, then parameters, sums, variables and functions."""
    base = factor.base if factor.is_Pow else factor
    if base.is_number:
        return (0 if base.is_Number else 1), str(factor)
    if base.is_Symbol:
        return (2 if isinstance(base, ParameterSymbol) else 4), str(factor)
    return (3 if base.is_Add else 5), str(factor)


def text_of(expression: Any) -> str:
    return Printer().doprint(sympy.sympify(expression))


def event_text(condition: Any, actions: Iterable[Any], on: Any) -> str:
    if isinstance(condition, Sampled):
        offset = f", from {text_of(condition.offset)} on" if condition.offset else ""
        text = f"every {text_of(condition.period)} seconds{offset}"
    else:
        # What is not shown says only that a gap has opened.
        shown = condition.xreplace({s: sympy.Integer(1) for s in condition.free_symbols if _is_hidden(s)})
        text = f"when {text_of(shown)}" + (f", while {text_of(on)}" if on is not None else "")
    told = (a for a in actions if isinstance(a, Terminate) or not _is_hidden(a.target))
    return f"{text}: {', '.join(map(_action_text, told))}"


def _is_hidden(symbol: Any) -> bool:
    return isinstance(symbol, RelationSymbol)


def _action_text(action: Any) -> str:
    if isinstance(action, Terminate):
        return f"the run ends, “{action.message}”"
    assert isinstance(action, Assign | Reinit)
    return f"{action.target} becomes {text_of(action.value)}"


def bounds_text(interval: Interval) -> str:
    low, high = interval.low, interval.high
    if low == -math.inf and high == math.inf:
        return ""
    above = f"> {low:g}" if interval.open_low else f"≥ {low:g}"
    below = f"< {high:g}" if interval.open_high else f"≤ {high:g}"
    return above if high == math.inf else below if low == -math.inf else f"{above}, {below}"


def table(head: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> list[str]:
    """A Markdown table, without the columns that are empty; nothing if there are no rows."""
    rows = list(rows)
    kept = [k for k in range(len(head)) if any(row[k] for row in rows)]
    lines = [[head[k] for k in kept], ["---"] * len(kept), *([row[k] for k in kept] for row in rows)]
    return ["| " + " | ".join(line) + " |" for line in lines] + [""] if rows else []


def code(text: str) -> str:
    return f"`{text}`" if text else ""


# --- pages -------------------------------------------------------------------------------------------------------


def component_section(cls: type[Component]) -> list[str]:
    with as_written() as (equations, events):
        component = make(cls)
    signature = inspect.signature(cls.__init__)
    given = [p for p in signature.parameters.values() if p.name not in ("self", "ev", "name")]
    arguments = [
        p.name + ("" if p.default is p.empty else f"={p.default!r}") for p in given if p.kind is not p.VAR_KEYWORD
    ]
    lines = [f"## {cls.__name__}", "", "```python", *call_text(cls.__name__, ["ev", "name", *arguments]), "```", ""]
    lines += [inspect.getdoc(cls) or "", ""]
    lines += [_ports_text(component), ""]
    lines += table(
        ("Parameter", "Default", "Unit", "Bounds"),
        (
            (code(p.name), _value_text(p.value), p.unit, bounds_text(p.bounds))
            for p in component.parameters.values()
            if not p.is_discrete
        ),
    )
    shown = [v for v in component.variables.values() if v.kind not in ("port", "start", "event")]
    discrete = [p for p in component.parameters.values() if p.is_discrete]
    lines += table(
        ("Variable", "Kind", "Unit", "Start"),
        [
            *((code(v.name), _kind_text(v.kind), v.unit, _start_text(v)) for v in shown),
            *((code(p.name), "discrete", p.unit, _value_text(p.value)) for p in discrete),
        ],
    )
    own = [equation for owner, equation in equations if owner is component]
    if own:
        lines += displayed(own)
    happens = [event_text(*event) for owner, *event in events if owner is component]
    if happens:
        lines += ["Events:", "", "```text", *happens, "```", ""]
    if component.children:
        lines += ["Parts:", ""]
        lines += table(("Part", "Component"), ((code(c.name), _part_text(c)) for c in component.children.values()))
        joined = [" — ".join(_end_text(component, end) for end in c.ends) for c in component.connections]
        lines += ["```text", *joined, "```", ""] if joined else []
    return lines


def call_text(name: str, arguments: list[str]) -> list[str]:
    """A call in lines of at most `WIDTH` letters."""
    lines, whole = [""], f"{name}({', '.join(arguments)})"
    if len(whole) <= WIDTH:
        return [whole]
    for argument in arguments:
        if len(f"{lines[-1]} {argument},") + 4 > WIDTH:
            lines.append("")
        lines[-1] = f"{lines[-1]} {argument},".strip()
    return [f"{name}(", *(f"    {line}" for line in lines), ")"]


def _ports_text(component: Component) -> str:
    """Ports: `p`, `n` (Electrical: `v` [V], `i` [A])."""
    by_domain: dict[Domain, list[str]] = {}
    for port in component.ports.values():
        by_domain.setdefault(port.domain, []).append(code(port.name))
    groups = []
    for domain, names in by_domain.items():
        quantities = ", ".join(f"{code(name)} [{unit}]" for name, unit in (*domain.across, *domain.through))
        groups.append(f"{', '.join(names)} ({domain.name}: {quantities})")
    label = "Port" if len(component.ports) == 1 else "Ports"
    return f"{label}: {'; '.join(groups)}." if groups else ""


def _kind_text(kind: str) -> str:
    return {"learned": "function", "variable": ""}.get(kind, kind)


def _value_text(value: Any) -> str:
    return code(text_of(value))


def _start_text(variable: Any) -> str:
    if variable.default is not None:
        return f"`{variable.default:g}` unless given"
    if variable.start is None:
        return ""
    return f"{code(text_of(variable.start))}{'' if variable.fixed else ' (a guess)'}"


def _part_text(part: Any) -> str:
    """A component's class; of an array, its shape too."""
    if isinstance(part, ComponentArray):
        return f"{type(part.prototype).__name__}, {' × '.join(map(str, part.shape))}"
    return type(part).__name__


def _end_text(component: Component, port: Any) -> str:
    if isinstance(port, PortArray):
        return port.described
    return port.name if port.component is component else f"{port.component.name}.{port.name}"


def page(domain: str) -> str:
    """The page of a domain, in Markdown."""
    module = importlib.import_module(f"{jaxonomy_dae.library.__name__}.{domain}")
    head, _, rest = (inspect.getdoc(module) or "").partition("\n")
    lines = [f"# {domain.capitalize()}", "", f"`{module.__name__}`: {head}", rest, ""]
    for cls in classes_of(domain):
        lines += component_section(cls)
    return "\n".join(lines)


def overview() -> str:
    """The first page: all components of all domains, with the first sentence of what they are."""
    lines = [
        "# Components",
        "",
        "The components of `jaxonomy_dae.library`, by domain. These pages are made from the code, so equations,",
        "defaults and units are those that are compiled. Every component takes the environment and a name first.",
        "Values of parameters may be numbers or, inside a component, expressions in its parameters. Signals without a",
        "unit take that of what they are connected to. The [glossary](../glossary.md#names-in-the-library) has names.",
        "",
        "[Components and their references](../components.md) says what each one was compared with.",
        "",
    ]
    for domain in domains():
        lines += [f"## [{domain.capitalize()}]({domain}.md)", ""]
        names = (f"[{cls.__name__}]({domain}.md#{cls.__name__.lower()})" for cls in classes_of(domain))
        lines += [", ".join(names), ""]
    return "\n".join(lines)


# --- hooks of MkDocs ---------------------------------------------------------------------------------------------


def on_config(config: Any) -> Any:
    pages = ["library/index.md", *({d.capitalize(): f"library/{d}.md"} for d in domains())]
    config.nav = [{TITLE: pages} if TITLE in entry else entry for entry in config.nav]
    return config


def on_files(files: Any, config: Any) -> Any:
    from mkdocs.structure.files import File

    for name, content in [("index", overview()), *((d, page(d)) for d in domains())]:
        files.append(File.generated(config, f"library/{name}.md", content=content))
    return files
