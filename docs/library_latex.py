"""Equations of the library's components as LaTeX, for the pages of the library."""

import re
from typing import Any

import sympy
from sympy.printing.latex import LatexPrinter

from jaxonomy_dae.write.symbols import RelationSymbol, VariableSymbol

GREEK = {
    "alpha", "beta", "gamma", "delta", "epsilon", "eta", "theta", "kappa", "lambda", "mu", "nu", "xi", "pi", "rho",
    "sigma", "tau", "phi", "chi", "psi", "omega",
}  # fmt: skip
ACCENTS = {1: r"\dot", 2: r"\ddot"}  # of the first derivatives by time


def name_text(path: str) -> str:
    """A name as it is written: v_p for `p.v`, φ_rel for `phi_rel`, R_0 for `R0`, upright for words."""
    *owners, own = path.split(".")
    base, _, rest = own.partition("_")
    digits = re.fullmatch(r"([A-Za-z]+?)(\d+)", base)
    if digits:
        base, rest = digits[1], f"{digits[2]}_{rest}".strip("_")
    if base in GREEK:
        written = rf"\{base}"
    elif len(base) == 1:
        written = base
    else:  # a word, whole
        written, rest = rf"\mathrm{{{own.replace('_', chr(92) + '_')}}}", ""
    below = [rest.replace("_", r"\_")] * bool(rest) + [owner.replace("_", r"\_") for owner in owners]
    return written + (rf"_{{\mathrm{{{','.join(below)}}}}}" if below else "")


class Printer(LatexPrinter):
    """SymPy's LaTeX with names and relations as the library's pages show them."""

    def __init__(self):
        super().__init__({"mul_symbol": r" \, ", "fold_short_frac": False, "symbol_names": {}})

    def _as_ordered_terms(self, expr: Any, order: Any = None) -> list[Any]:
        return sorted(super()._as_ordered_terms(expr, order), key=lambda term: bool(term.as_coeff_Mul()[0] < 0))

    def _print_Symbol(self, expr: Any, style: str = "plain") -> str:
        if isinstance(expr, VariableSymbol) and expr.order:
            inside = name_text(expr.path)
            if expr.order in ACCENTS:
                head, mark, below = inside.partition("_{")
                return f"{ACCENTS[expr.order]}{{{head}}}{mark}{below}"
            return rf"{inside}^{{({expr.order})}}"
        return name_text(getattr(expr, "path", str(expr)))

    _print_VariableSymbol = _print_ParameterSymbol = _print_DiscreteSymbol = _print_Symbol

    def _print_PreviousSymbol(self, expr: Any) -> str:
        return rf"\operatorname{{pre}}({name_text(expr.path)})"

    def _print_TimeSymbol(self, expr: Any) -> str:
        return "t"

    _print_EnvironmentTime = _print_TimeSymbol

    def _print_Smooth(self, expr: Any) -> str:
        return self._print(expr.args[0])

    def _print_Float(self, expr: Any) -> str:
        return f"{float(expr):g}"

    def _print_Or(self, expr: Any) -> str:
        live = [a for a in expr.args if isinstance(a, sympy.And) and a.atoms(RelationSymbol)]
        if live:  # a relation whose changes are events
            return self._print(sympy.And(*(a for a in live[0].args if not a.atoms(RelationSymbol))))
        return super()._print_Or(expr)


def equation(given: Any) -> str:
    """An equation, or an expression that is zero."""
    left, right = (given.lhs, given.rhs) if isinstance(given, sympy.Eq) else (sympy.Integer(0), given)
    printer = Printer()
    return f"{printer.doprint(left)} &= {printer.doprint(right)}"


def displayed(equations: list[Any]) -> list[str]:
    """The lines of Markdown that show equations below each other."""
    return [r"\[", r"\begin{aligned}", " \\\\\n".join(map(equation, equations)), r"\end{aligned}", r"\]", ""]
