"""Parts of large constants, read once before a loop instead of at every stage of every step."""

from typing import Any

from jax import Array

from ..private_names import MissingName, private

# Entries of an array from which its parts are read before the loop. Fewer are read one by one, together
# (`lowering.gather.FEW`), and would make as many constants.
LARGE = 256
READS = frozenset({"slice", "gather", "dynamic_slice", "squeeze"})


def parts_of_constants(jaxpr: Any, consts: list[Array]) -> tuple[Any, list[Array]]:
    """The program with the parts that it reads of large constants as constants of their own, and all its constants.

    Backwards, every step adds to the cotangents of constants. A part that is read inside is padded to the length of the
    whole for this, once for each stage: for the gradient of a ladder of 4,000 cells by its parameters that took longer
    than all else of a step. The derivative of reading is now taken once, outside.
    """
    try:
        literal = private("Literal")
    except MissingName:
        return jaxpr, consts

    constant, before, after, parts = set(jaxpr.constvars), [], [], {}
    for equation in jaxpr.eqns:
        read = [v for v in equation.invars if not isinstance(v, literal)]
        if equation.effects or not constant.issuperset(read):
            after.append(equation)
            continue
        constant.update(equation.outvars)
        before.append(equation)
        if equation.primitive.name in READS and read[0].aval.size > LARGE:
            parts.update(dict.fromkeys(equation.outvars))
    if not parts:
        return jaxpr, consts

    needed, reading = set(parts), []
    for equation in reversed(before):
        if needed.intersection(equation.outvars):
            reading.append(equation)
            needed.update(v for v in equation.invars if not isinstance(v, literal))
    kept = [e for e in jaxpr.eqns if not parts.keys() >= set(e.outvars)]
    reader = jaxpr.replace(invars=[], outvars=list(parts), eqns=reading[::-1])
    values = private("eval_jaxpr")(reader, consts)
    used = {v for e in kept for v in e.invars if not isinstance(v, literal)}
    used.update(v for v in jaxpr.outvars if not isinstance(v, literal))
    whole = [(v, c) for v, c in zip(jaxpr.constvars, consts, strict=True) if v in used]
    of_parts = [(v, c) for v, c in zip(parts, values, strict=True) if v in used]
    both = whole + of_parts
    return jaxpr.replace(constvars=[v for v, _ in both], eqns=kept), [c for _, c in both]
