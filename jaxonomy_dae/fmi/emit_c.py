"""Functions of JAX in C99.

`Source` takes programs (`jax.make_jaxpr`) and writes each as a C function

    static void name(T a0, const T *a1, ..., T *o0, ..., char *w)

of its arguments and results: scalars by value, arrays by pointers to their entries row by row, and `w` with room for
`work` bytes, aligned for any number, where arrays are kept on the way. Functions allocate nothing, hold no state and
call nothing but `math.h` and `string.h`.

Operations entry by entry on arrays of one shape share a loop, so that their intermediate values are scalars. All other
arrays have a place in `w`, which is used anew once nobody reads them; short ones are local. Functions that a program
calls become functions in C, once each.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from .body import Body, words
from .c_function import CFunction, parameters
from .c_types import c_type, number
from .elementwise import HELPERS
from .linear_algebra import ROUTINES
from .straight import Constant, known, straight

ROUTINES_AND_HELPERS = HELPERS | ROUTINES
HEADER = "#include <math.h>\n#include <stdint.h>\n#include <string.h>\n"


class Source:
    """The functions of one C file, and the tables that they read."""

    def __init__(self):
        self.functions: list[str] = []
        self.helpers: set[str] = set()
        self._tables: dict[tuple[str, bytes], str] = {}
        self._table_texts: dict[str, str] = {}
        self._written: dict[Any, tuple[Any, CFunction]] = {}
        self._same: dict[str, CFunction] = {}

    def function(self, program: Any, name: str | None = None) -> CFunction:
        """Writes a program, a `ClosedJaxpr` of `jax.make_jaxpr`, as a function with this name. What it closes over
        becomes constant.

        **Raises:**

        - `ModelError` that names a primitive that cannot be written in C, and the line that needs it.
        """
        return self._write(program.jaxpr, tuple(map(known, program.consts)), name)

    def inner(self, program: Any, values: Sequence[Constant | None]) -> CFunction:
        """A program that another one calls, for these values of its first arguments; None for what is an argument in C,
        too. Its closed-over values are its first arguments. It is written once for equal values: places of gathers
        among them are tables, where pointers would leave tests and loops that compute them."""
        told = tuple(None if v is None else (v.value.dtype, v.value.shape, v.value.tobytes()) for v in values)
        key = id(program), told
        if key not in self._written:  # kept with the program, so that no other one gets its identity
            self._written[key] = program, self._write(program, values, None)
        return self._written[key][1]

    def _write(self, jaxpr: Any, values: Sequence[Constant | None], name: str | None) -> CFunction:
        program = straight(jaxpr, [None if v is None else v.value for v in values])
        body = Body(self, program, values)
        body.write()
        arguments = tuple(program.kinds[a] for a in body.arguments)
        results = tuple(map(program.kind, program.results))
        signature = ", ".join(parameters(arguments, results))
        text = f"({signature}) {{\n" + "".join(f"  {line}\n" for line in body.lines) + "}\n"
        if name is None and text in self._same:
            return self._same[text]
        written = CFunction(name or f"f{len(self.functions)}", arguments, results, body.work)
        self.functions.append(f"static void {written.name}{text}")
        if name is None:
            self._same[text] = written
        return written

    def table(self, value: np.ndarray) -> str:
        """The name of a constant array."""
        key = str(value.dtype), value.tobytes()
        if key not in self._tables:
            self._tables[key] = name = f"k{len(self._tables)}"
            entries = [number(v, value.dtype) for v in value.ravel().tolist()] or ["0"]
            lines = [", ".join(entries[k : k + 12]) for k in range(0, len(entries), 12)]
            body = ",\n  ".join(lines)
            head = f"static const {c_type(value.dtype)} {name}[{len(entries)}]"
            self._table_texts[name] = f"{head} = {{\n  {body}\n}};\n"
        return self._tables[key]

    def use(self, text: str) -> None:
        """Notes which helpers a line calls."""
        if "jx_" in text:
            self.helpers.update(name for name in ROUTINES_AND_HELPERS if f"{name}(" in text)

    @property
    def text(self) -> str:
        """The whole file: includes, helpers, tables and functions."""
        helpers = [text for name, text in ROUTINES_AND_HELPERS.items() if name in self.helpers]
        used = set(words("\n".join(self.functions)))
        tables = [text for name, text in self._table_texts.items() if name in used]
        return "\n".join([HEADER, *helpers, *tables, *self.functions])


def program_in_c(programs: dict[str, Any]) -> tuple[str, dict[str, CFunction]]:
    """Writes programs by name, each a `ClosedJaxpr`. Returns the C file and its functions by name."""
    source = Source()
    written = {name: source.function(program, name) for name, program in programs.items()}
    return source.text, written
