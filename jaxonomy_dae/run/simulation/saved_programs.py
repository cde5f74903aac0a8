"""Programs that are compiled ahead of time, and run by another process without compiling."""

import json
import pickle
import re
from collections.abc import Callable
from os import PathLike
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from ...base.aliases import PyTree
from ...base.errors import ModelError
from ...base.private_names import private
from ...host.kept import calls_python, machine_and_versions
from ...host.recalled import register

MARK = b"jaxonomy_dae program 1\n"


def save_compiled(compiled: Any, path: str | PathLike[str]) -> None:
    """Writes a program that was compiled ahead of time, `jax.jit(f).lower(*arguments).compile()`, to a file.

    The file is machine code for this processor, this system and these versions of Python and JAX. `jax.export` makes
    files that other machines can compile. If JAX's persistent cache is on, the written program is run once, with zeros,
    because JAX cannot write a program again that it read from its cache (jax 0.10.2).

    **Raises:**

    - `ModelError` if the program calls Python, as with `throw=True`, if it comes from JAX's persistent cache, or if its
        arguments or results are of types that cannot be pickled.
    """
    text = compiled.as_text() or ""
    targets = sorted(set(re.findall(r'custom_call_target="([^"]+)"', text)))
    if any(calls_python(target.encode()) for target in targets):
        raise ModelError(
            "save_compiled: this program calls Python, which no other process can do for it: leave out throw=True, "
            "progress=True and prints"
        )
    content, arguments, results = private("serialize_executable")(compiled)
    told = {"made for": machine_and_versions(), "calls": targets}
    try:
        trees = pickle.dumps([jax.tree.unflatten(t, [0] * t.num_leaves) for t in (arguments, results)])
    except Exception as error:  # whatever the classes of the user's own raise
        raise ModelError(
            f"save_compiled: the arguments or results cannot be pickled ({error}): take and return arrays, in tuples, "
            "lists or dictionaries"
        ) from error
    if jax.config.jax_compilation_cache_dir:  # pyright: ignore[reportAttributeAccessIssue]
        _try(compiled, _loaded(content, arguments, results))
    Path(path).write_bytes(MARK + pickle.dumps((json.dumps(told), trees, content)))


def load_compiled(path: str | PathLike[str]) -> Callable:
    """Loads a program that `save_compiled` wrote. Call it with arguments of the same shapes and types: nothing is
    compiled or traced.

    Loading executes what is in the file: it is read by `pickle`, which runs code that a file may contain, and it holds
    machine code, which runs when the program is called. Nothing is checked before. Load only files that you wrote, or
    that come from people you trust, over a way on which nobody else could change them.

    **Raises:**

    - `ModelError` for a file of another kind, one that is not whole, and a program of another processor or other
        versions.
    """
    whole = Path(path).read_bytes()
    if not whole.startswith(MARK):
        raise ModelError(f"load_compiled: '{path}' is not a file of save_compiled")
    try:
        text, trees, content = pickle.loads(whole[len(MARK) :])
        told = json.loads(text)
    except Exception as error:  # of a file that broke off, or holds something else
        raise ModelError(f"load_compiled: '{path}' is not whole ({error}): save the program again") from error
    for what, here in machine_and_versions().items():
        if told["made for"].get(what) != here:
            there = told["made for"].get(what)
            found = f": {there}, here {here}" if len(f"{there}{here}") < 80 else ""
            raise ModelError(
                f"load_compiled: '{path}' was made for another {what}{found}. Compile and save it again here, or use "
                "jax.export"
            )
    # Kernels outside of XLA, such as those of LAPACK and KLU, are known to it only after whoever calls them was
    # imported.
    register(told["calls"])
    arguments, results = map(jax.tree.structure, pickle.loads(trees))
    return _loaded(content, arguments, results)


def _loaded(content: bytes, arguments: PyTree, results: PyTree) -> Callable:
    return private("deserialize_executable")(content, arguments, results, execution_devices=jax.devices()[:1])


def _try(compiled: Any, loaded: Callable) -> None:
    """Runs a program once. Parts that its file lacks are missed whatever the values of its arguments."""
    arguments, keywords = jax.tree.map(lambda info: jnp.zeros(info.shape, info.dtype), compiled.args_info)
    try:
        jax.block_until_ready(loaded(*arguments, **keywords))
    except jax.errors.JaxRuntimeError as error:
        raise ModelError(
            f"save_compiled: what JAX writes of this program does not run ({error}), as where it was read from JAX's "
            "persistent cache. Compile it in a process that does not set jax_compilation_cache_dir"
        ) from error
