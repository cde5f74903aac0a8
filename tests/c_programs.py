"""Functions of JAX, written in C, compiled with all warnings as errors, and called."""

import ctypes
import shutil
import subprocess
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxonomy_dae.fmi.c_types import c_type
from jaxonomy_dae.fmi.emit_c import CFunction, program_in_c

COMPILER = shutil.which("cc")
FLAGS = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off", "-shared", "-fPIC"]


def entry(function: CFunction) -> str:
    """A function that the library exports: scalars come by pointers, too."""
    given = [f"const {c_type(k.dtype)} *a{n}" for n, k in enumerate(function.arguments)]
    given += [f"{c_type(k.dtype)} *o{n}" for n, k in enumerate(function.results)]
    passed = [f"a{n}" if k.shape else f"*a{n}" for n, k in enumerate(function.arguments)]
    passed += [f"o{n}" for n in range(len(function.results))]
    head = f"void call_{function.name}({', '.join(given)}, char *w)"
    return f"{head};\n{head} {{ {function.name}({', '.join(passed)}, w); }}\n"


def in_c(
    functions: Mapping[str, tuple[Callable, tuple]], folder: Path, compiler: str | None = None, level: str = "-O0"
) -> dict[str, Callable[..., list[np.ndarray]]]:
    """The functions, each given with arguments, in one library: by name, functions of arguments that return arrays."""
    programs = {name: jax.make_jaxpr(function)(*given) for name, (function, given) in functions.items()}
    text, written = program_in_c(programs)
    source, library = folder / "program.c", folder / "program.so"
    source.write_text(text + "\n" + "\n".join(map(entry, written.values())))
    command = [compiler or COMPILER or "cc", *FLAGS, level, str(source), "-o", str(library), "-lm"]
    found = subprocess.run(command, capture_output=True, text=True)
    assert not found.returncode, found.stderr
    loaded = ctypes.CDLL(str(library))

    def called(function: CFunction) -> Callable[..., list[np.ndarray]]:
        def call(*given: Any) -> list[np.ndarray]:
            arrays = [np.array(x, order="C") for x in jax.tree.leaves(given)]
            assert [(a.shape, a.dtype) for a in arrays] == [(k.shape, k.dtype) for k in function.arguments]
            results = [np.zeros(k.shape, k.dtype) for k in function.results]
            room = np.zeros(function.work + 16, np.uint8)
            work = ctypes.c_void_p(-(-room.ctypes.data // 16) * 16)
            pointers = [ctypes.c_void_p(a.ctypes.data) for a in (*arrays, *results)]
            getattr(loaded, f"call_{function.name}")(*pointers, work)
            return results

        return call

    return {name: called(function) for name, function in written.items()}


def agree(found: list[np.ndarray], expected: Any, rtol: float, what: str = "") -> None:
    """Asserts that arrays are those of JAX: integers and not-a-number exactly, numbers to `rtol`."""
    wanted = jax.tree.leaves(expected)
    assert len(found) == len(wanted)
    for ours, theirs in zip(found, map(np.asarray, wanted), strict=True):
        assert (ours.shape, ours.dtype) == (theirs.shape, theirs.dtype), what
        tolerance = rtol if theirs.dtype.kind == "f" else 0.0
        np.testing.assert_allclose(ours, theirs, rtol=tolerance, atol=0.0, err_msg=what)
        if theirs.dtype.kind == "f":  # -0.0 is not +0.0
            np.testing.assert_array_equal(np.signbit(ours[ours == 0]), np.signbit(theirs[ours == 0]), err_msg=what)
