"""Parts of large constants, read once before a loop instead of at every stage of every step."""

from collections.abc import Collection, Iterable
from typing import Any, NamedTuple

from jax import Array

from ...base.private_names import MissingName, private

# Entries of an array from which its parts are read before the loop. Of fewer, padding costs little (a step of 100 cells
# takes as long), while a function that is given the parts is one more in the program.
LARGE = 1024
READS = frozenset({"slice", "gather", "dynamic_slice", "squeeze"})
PER_ARGUMENT = ("in_shardings", "in_layouts", "donated_invars")  # parameters of a call with an entry for each argument


class Split(NamedTuple):
    """A program that is given the parts of its large constants: the parts, the equations that read them, the rest."""

    parts: list[Any]
    reading: list[Any]
    kept: list[Any]


def parts_of_constants(jaxpr: Any, consts: list[Array]) -> tuple[Any, list[Array]]:
    """The program with the parts that it reads of large constants as constants of their own, and all its constants.
    What functions read that it calls are such parts, too.

    Backwards, every step adds to the cotangents of constants. A part that is read inside is padded to the length of the
    whole for this, once for each stage: for the gradient of a ladder of 4,000 cells by its parameters that took longer
    than all else of a step. The derivative of reading is now taken once, outside.
    """
    try:
        for name in ("Literal", "ClosedJaxpr"):
            private(name)
    except MissingName:
        return jaxpr, consts
    value: dict[Any, Any] = dict(zip(jaxpr.constvars, consts, strict=True))
    found: dict[Any, Array] = {}

    def read(split: Split, given: dict[Any, Any]) -> None:
        reader = jaxpr.replace(constvars=[], invars=list(given), outvars=split.parts, eqns=split.reading)
        found.update(zip(split.parts, private("eval_jaxpr")(reader, [], *given.values()), strict=True))

    split = _split(jaxpr, value)
    read(split, value)
    calls: dict[Any, Any] = {}  # of each function that is called: the constants it reads, and its call given the parts
    kept = []
    for equation in split.kept:
        inner = equation.params.get("jaxpr")
        if equation.primitive.name in ("jit", "pjit") and not inner.consts:
            pairs = zip(inner.jaxpr.invars, equation.invars, strict=True)
            large = {i: o for i, o in pairs if _is_variable(o) and o in value and o.aval.size > LARGE}
            if inner not in calls:
                of_call = _split(inner.jaxpr, large)
                read(of_call, {i: value[o] for i, o in large.items()})
                calls[inner] = large, of_call.parts, _given_parts(inner, of_call)
            same, parts, program = calls[inner]
            if parts and same == large:
                equation = _call(equation, program, parts)
        kept.append(equation)
    # An equation that led to a part only is not needed any more, and would keep its constant in every step's
    # cotangents.
    kept = _live(kept, jaxpr.outvars)
    used = _variables([*(v for e in kept for v in e.invars), *jaxpr.outvars])
    both = {v: c for v, c in (value | found).items() if v in used}
    return jaxpr.replace(constvars=list(both), eqns=kept), list(both.values())


def _split(jaxpr: Any, constants: Collection[Any]) -> Split:
    constant, before, parts = set(constants), [], {}
    for equation in jaxpr.eqns:
        read = [v for v in equation.invars if _is_variable(v)]
        # What follows from constants alone is constant, too: a part of a reshaped array is read before the loop as
        # well.
        if equation.effects or not constant.issuperset(read):
            continue
        constant.update(equation.outvars)
        before.append(equation)
        if equation.primitive.name in READS and read[0].aval.size > LARGE:
            parts.update(dict.fromkeys(equation.outvars))
    kept = [e for e in jaxpr.eqns if not parts.keys() >= set(e.outvars)]
    return Split(list(parts), _live(before, parts), _live(kept, jaxpr.outvars))


def _given_parts(inner: Any, split: Split) -> Any:
    """The function that is given the parts after those of its arguments that it still reads."""
    used = _variables([*(v for e in split.kept for v in e.invars), *inner.jaxpr.outvars])
    own = [v for v in inner.jaxpr.invars if v in used]
    return private("ClosedJaxpr")(inner.jaxpr.replace(invars=[*own, *split.parts], eqns=split.kept), ())


def _call(equation: Any, program: Any, parts: list[Any]) -> Any:
    inner, own = equation.params["jaxpr"].jaxpr, set(program.jaxpr.invars)
    places = [k for k, v in enumerate(inner.invars) if v in own]
    invars = [*(equation.invars[k] for k in places), *parts]
    params = equation.params | {"jaxpr": program}
    for name in PER_ARGUMENT:
        given = equation.params[name]
        params[name] = (*(given[k] for k in places), *(given[:1] * len(parts)))
    return equation.replace(invars=invars, params=params)


def _live(equations: Iterable[Any], wanted: Iterable[Any]) -> list[Any]:
    """The equations on which what is wanted depends, and those with effects."""
    needed, out = _variables(wanted), []
    for equation in reversed(list(equations)):
        if equation.effects or needed.intersection(equation.outvars):
            out.append(equation)
            needed |= _variables(equation.invars)
    return out[::-1]


def _variables(atoms: Iterable[Any]) -> set[Any]:
    return {v for v in atoms if _is_variable(v)}


def _is_variable(atom: Any) -> bool:
    return not isinstance(atom, private("Literal"))
