"""Reads the expressions of Modelica: a list of tokens, and operators by precedence climbing."""

import re
from typing import NoReturn

from ..base.errors import ModelError
from . import tree

# White space and comments belong to the token behind them: one match for each token, as a text may have a megabyte.
_TOKEN = re.compile(
    r"""(?:\s+|//[^\n]*|/\*.*?\*/)*
    (?: (?P<string>"(?:[^"\\]|\\.)*") | (?P<quoted>'(?:[^'\\]|\\.)*') | (?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)
      | (?P<word>[A-Za-z_]\w*) | (?P<sign>:=|<=|>=|==|<>|\.[+*/^-]|[-+*/^<>=(){}\[\],;:.]) | (?P<stop>\Z) )""",
    re.X | re.S,
)
_LEVEL = {  # binary operators, and how strongly they bind
    "or": 1, "and": 2, "<": 4, "<=": 4, ">": 4, ">=": 4, "==": 4, "<>": 4,
    "+": 5, "-": 5, ".+": 5, ".-": 5, "*": 6, "/": 6, ".*": 6, "./": 6, "^": 7, ".^": 7,
}  # fmt: skip
_NOT, _SUM, _POWER = 3, 5, 7
FUNCTION = "function"  # marks an argument that is a function of which some arguments are given
INSIDE = "[\\'"  # a quoted name with names in its subscripts
_QUOTED = r"'(?:[^'\\]|\\.)*'"
_PART = re.compile(rf"([^\[\]]+)(?:\[((?:{_QUOTED}|\[(?:{_QUOTED}|[^\[\]'])*\]|[^\[\]'])*)\])?\.?")


_ESCAPED = {"n": "\n", "t": "\t", "r": "\r", "a": "\a", "b": "\b", "f": "\f", "v": "\v"}


def unescaped(string: str) -> str:
    """The text between the quotation marks of a string, with its escapes carried out (section 2.4.3)."""
    return re.sub(r"\\(.)", lambda found: _ESCAPED.get(found[1], found[1]), string[1:-1], flags=re.S)


def written(name: str) -> tree.Reference:
    """A quoted name with subscripts inside, such as 'x[\\'i\\'].y', as the reference x[i].y."""
    parts: list[str] = []
    subscripts: list[tuple[tree.Expression, ...]] = []
    for part, inside in _PART.findall(re.sub(r"\\(.)", r"\1", name)):
        parts.append(part)
        subscripts.append(ExpressionReader(f"[{inside}]")._subscripts() if inside else ())
    return tree.Reference(tuple(parts), tuple(subscripts))


# The names of the arguments of operators that are read by their places.
_ARGUMENTS = {
    "smooth": ("p", "expr"), "homotopy": ("actual", "simplified"), "delay": ("expr", "delayTime", "delayMax"),
    "semiLinear": ("x", "positiveSlope", "negativeSlope"), "max": ("x", "y"), "min": ("x", "y"),
    "sample": ("start", "interval"),
}  # fmt: skip


def _call(
    function: str, arguments: tuple[tree.Expression, ...], named: tuple[tuple[str, tree.Expression], ...]
) -> tree.Call:
    """A call; named arguments of operators in their places."""
    given = dict(named)
    # Only if no place between them stays empty.
    order = _ARGUMENTS.get(function, ())[len(arguments) :]
    if not given or not given.keys() <= set(order) or list(order[: len(given)]) != [n for n in order if n in given]:
        return tree.Call(function, arguments, named)
    return tree.Call(function, (*arguments, *(given[n] for n in order if n in given)), ())


class ExpressionReader:
    """A text as tokens, the place among them, and the rules of expressions."""

    def __init__(self, text: str):
        self.text = text
        self.kinds: list[str] = []
        self.words: list[str] = []
        self.places: list[int] = []
        at, match = 0, _TOKEN.match
        while True:
            found = match(text, at)
            if found is None:
                self._fail_at(len(re.compile(r"(?:\s+|//[^\n]*)*").match(text, at).group()) + at, "unknown character")  # type: ignore[union-attr]
            kind = found.lastgroup or "stop"
            self.kinds.append(kind)
            self.words.append(found.group(kind))
            self.places.append(found.start(kind))
            if kind == "stop":
                break
            at = found.end()
        self.i = 0
        # A quoted name or a string may look like a keyword; keywords are asked for in this list.
        self.keys = [w if k in ("word", "sign") else "" for k, w in zip(self.kinds, self.words, strict=True)]
        self.lines = _Lines(text)

    # --- tokens ------------------------------------------------------------------------------------------------------

    def _fail_at(self, place: int, what: str) -> NoReturn:
        line = self.text.count("\n", 0, place) + 1
        column = place - self.text.rfind("\n", 0, place)
        shown = self.text[place : place + 40].split("\n")[0]
        raise ModelError(f"Base Modelica, line {line}, column {column}: {what}, at {shown!r}")

    def _fail(self, what: str) -> NoReturn:
        self._fail_at(self.places[self.i], what)

    def at(self, *words: str) -> bool:
        return self.keys[self.i] in words

    def take(self, *words: str) -> str:
        """Goes past one of these words, and returns it; the empty text if something else follows."""
        key = self.keys[self.i]
        if key in words:
            self.i += 1
            return key
        return ""

    def past(self, words: frozenset[str]) -> frozenset[str]:
        """Goes past all of these words that follow, and returns them."""
        first = self.i
        while self.keys[self.i] in words:
            self.i += 1
        return frozenset(self.keys[first : self.i])

    def need(self, word: str) -> None:
        if self.keys[self.i] != word:
            self._fail(f"expected '{word}'")
        self.i += 1

    def name(self) -> str:
        kind, word = self.kinds[self.i], self.words[self.i]
        if kind == "quoted":
            word = word[1:-1]
        elif kind != "word":
            self._fail("expected a name")
        self.i += 1
        return word

    def path(self) -> str:
        """Names joined by dots; a dot before them stands for the outermost package."""
        self.take(".")
        out = self.name()
        while self.take("."):
            out += "." + self.name()
        return out

    def line(self) -> int:
        return self.lines.of(self.places[self.i])

    # --- expressions -------------------------------------------------------------------------------------------------

    def expression(self) -> tree.Expression:
        if self.take("if"):
            branches = [self._branch()]
            while self.take("elseif"):
                branches.append(self._branch())
            self.need("else")
            return tree.Choice(tuple(branches), self.expression())
        first = self.operation(1)
        if not self.take(":"):
            return first
        second = self.operation(1)
        if self.take(":"):
            return tree.Range(first, second, self.operation(1))
        return tree.Range(first, tree.Number(1), second)

    def _branch(self) -> tuple[tree.Expression, tree.Expression]:
        condition = self.expression()
        self.need("then")
        return condition, self.expression()

    def operation(self, level: int) -> tree.Expression:
        """An operation whose operators bind at least as strongly as `level`."""
        if level <= _NOT and self.take("not"):
            left: tree.Expression = tree.Unary("not", self.operation(_NOT + 1))
        elif level <= _SUM + 1 and (sign := self.take("-", "+", ".-", ".+")):
            left = self.operation(_SUM + 1)  # a sign binds as weakly as a sum: -a * b is -(a * b)
            if "-" in sign:
                left = tree.Number(-left.value) if isinstance(left, tree.Number) else tree.Unary("-", left)
        else:
            left = self.primary()
        while True:
            sign = self.keys[self.i]
            strength = _LEVEL.get(sign, 0)
            if strength < level:
                return left
            self.i += 1
            left = tree.Binary(sign, left, self.primary() if strength == _POWER else self.operation(strength + 1))

    def primary(self) -> tree.Expression:
        self.take(".")  # of a name from the outermost package, such as `.Modelica.Constants.pi`
        kind, word = self.kinds[self.i], self.words[self.i]
        if kind == "number":
            self.i += 1
            return tree.Number(int(word) if word.isdigit() else float(word))
        if kind == "string":
            self.i += 1
            return tree.Text(unescaped(word))
        if kind == "sign":
            if self.take("("):
                return self._in_parentheses()
            if self.take("{"):
                return tree.Array(self._arguments("}")[0])
            if self.take("["):
                rows = [[self.expression()]]
                while sign := self.take(",", ";"):
                    if sign == ",":
                        rows[-1].append(self.expression())
                    else:
                        rows.append([self.expression()])
                self.need("]")
                return tree.Matrix(tuple(map(tuple, rows)))
            if self.take("-"):  # as in 2^-1, and a * -b^2, which is a * -(b^2)
                return tree.Unary("-", self.operation(_POWER))
            self._fail("expected an expression")
        if kind == "word":
            if word in ("true", "false"):
                self.i += 1
                return tree.Truth(word == "true")
            if word == "end":
                self.i += 1
                return tree.End()
        return self._reference()

    def _in_parentheses(self) -> tree.Expression:
        entries: list[tree.Expression | None] = []
        while not self.take(")"):
            entries.append(None if self.at(",") else self.expression())
            if not self.at(")"):
                self.need(",")
                if self.at(")"):
                    entries.append(None)
        if len(entries) == 1 and entries[0] is not None:
            return self._parts_of(entries[0])
        return tree.Several(tuple(entries))

    def _reference(self) -> tree.Expression:
        parts: list[str] = []
        subscripts: list[tuple[tree.Expression, ...]] = []
        while not parts or self.take("."):
            name = self.name()
            if INSIDE in name:
                within = written(name)
                parts.extend(within.parts)
                subscripts.extend(within.subscripts)
                if self.at("["):
                    subscripts[-1] += self._subscripts()
            else:
                parts.append(name)
                subscripts.append(self._subscripts())
        if self.take("("):
            arguments, named = self._arguments(")")
            return self._parts_of(_call(".".join(parts), arguments, named))
        return tree.Reference(tuple(parts), tuple(subscripts))

    def _parts_of(self, whole: tree.Expression) -> tree.Expression:
        while self.at("[", "."):
            whole = tree.Part(whole, self.name(), ()) if self.take(".") else tree.Part(whole, None, self._subscripts())
        return whole

    def _subscripts(self) -> tuple[tree.Expression, ...]:
        if not self.take("["):
            return ()
        out: list[tree.Expression] = []
        while not self.take("]"):
            if self.at(":") and self.keys[self.i + 1] in (",", "]"):
                self.i += 1
                out.append(tree.Whole())
            else:
                out.append(self.expression())
            if not self.at("]"):
                self.need(",")
        return tuple(out)

    def _arguments(self, end: str) -> tuple[tuple[tree.Expression, ...], tuple[tuple[str, tree.Expression], ...]]:
        arguments: list[tree.Expression] = []
        named: list[tuple[str, tree.Expression]] = []
        while not self.take(end):
            if self.kinds[self.i] in ("word", "quoted") and self.keys[self.i + 1] == "=":
                name = self.name()
                self.i += 1
                named.append((name, self._argument()))
            else:
                arguments.append(self._argument())
            if not self.at(end):
                self.need(",")
        return tuple(arguments), tuple(named)

    def _argument(self) -> tree.Expression:
        if self.take("function"):
            return tree.Call(FUNCTION, (self.expression(),), ())
        value = self.expression()
        return tree.Comprehension(value, self._iterators()) if self.take("for") else value

    def _iterators(self) -> tuple[tuple[str, tree.Expression | None], ...]:
        out = []
        while True:
            out.append((self.name(), self.expression() if self.take("in") else None))
            if not self.take(","):
                return tuple(out)


class _Lines:
    """Numbers of lines, for places that are asked for in rising order."""

    def __init__(self, text: str):
        self.text, self.place, self.number = text, 0, 1

    def of(self, place: int) -> int:
        self.number += self.text.count("\n", self.place, place)
        self.place = place
        return self.number
