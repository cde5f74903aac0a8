"""What is taken from JAX, Equinox, Diffrax and Optimistix beyond their public interfaces: all of it passes through this
file, and nothing of it is reached when the package is imported.

`TRIED` lists the versions on which the tests were run. Others may lack a name. `StoredAdjoint` then gives way to
`diffrax.RecursiveCheckpointAdjoint`, with one warning; what only keeps checks out of programs, or makes them smaller or
faster, is left out. Only functions of time as inputs have no fallback: their programs are compared, and `private`
raises `MissingName` where one is given.

These things are relied on that have no name of their own, or one that is public:

- the fields of the state of Diffrax' loop, and the arguments of this loop and of `AbstractAdjoint.loop`: `SHAPES`;
- the wrapper that Diffrax puts around a term to turn time around: `unwrapped` and `rewrapped`;
- that Diffrax fills the controller's tolerances into the root finder of a solver, be it wrapped: `FROM_CONTROLLER`;
- that Diffrax lengthens a step to the end of the interval from 100 floating-point numbers before it: `clip_floor`;
- the classes `JVPTracer` and `LinearizeTracer` of JAX by name, what tracers wrap, and the attribute `is_vjp` of the
  trace of the latter: `host/staging.py`;
- the attribute `_cached` of what `equinox.filter_jit` returns, the `jax.jit` inside: `clear_jitted`;
- the attribute `_consts` of a function that `jax.jit` has traced, the values that it closes over: `constants`;
- that XLA for CPUs does not take a call apart that is marked `inlineable="false"`: `solve/linear/once.py`.
"""

import dataclasses
import functools
import importlib
import importlib.metadata
import inspect
import warnings
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax

from .aliases import Terms
from .errors import JaxonomyDaeError

TRIED = {
    "diffrax": ("0.7.2",),
    "equinox": ("0.13.6", "0.13.8"),
    "jax": ("0.9.1", "0.10.2"),
    "lineax": ("0.1.0", "0.1.1"),
    "optimistix": ("0.1.0",),
}
NAMES = {
    "serialize_executable": "jax.experimental.serialize_executable.serialize",
    "deserialize_executable": "jax.experimental.serialize_executable.deserialize_and_load",
    "Zero": "jax.interpreters.ad.Zero",
    "clip_to_end": "diffrax._integrate._clip_to_end",
    "loop": "diffrax._integrate.loop",
    "SaveState": "diffrax._integrate.SaveState",
    "State": "diffrax._integrate.State",
    "while_loop": "equinox.internal.while_loop",
    "prevbefore": "equinox.internal.prevbefore",
    "unvmap_any": "equinox.internal.unvmap_any",
    "unvmap_max": "equinox.internal.unvmap_max",
    "eval_jaxpr": "jax.core.eval_jaxpr",
    "ClosedJaxpr": "jax.extend.core.ClosedJaxpr",
    "Jaxpr": "jax.extend.core.Jaxpr",
    "Literal": "jax.extend.core.Literal",
    "jaxpr_as_fun": "jax.extend.core.jaxpr_as_fun",
    "set_xla_metadata": "jax.experimental.xla_metadata.set_xla_metadata",
}
_ADJOINT_LOOP = frozenset(
    "args terms solver stepsize_controller event saveat t0 t1 dt0 max_steps throw init_state passed_solver_state "
    "passed_controller_state progress_meter".split()
)
_SAVED = frozenset("ts ys save_index saveat_ts_index".split())
# The fields that a class must have, and the arguments that a function takes, no others.
SHAPES = {
    "State": frozenset(
        "y tprev tnext made_jump solver_state controller_state progress_meter_state result num_steps "
        "num_accepted_steps save_state".split()
    ),
    "SaveState": _SAVED,
    "loop": frozenset(
        "solver stepsize_controller event saveat t0 t1 dt0 max_steps terms args init_state inner_while_loop "
        "outer_while_loop progress_meter".split()
    ),
}
FOR_STORED_ADJOINT = (
    "clip_to_end", "loop", "SaveState", "State", "while_loop", "prevbefore", "unvmap_any", "unvmap_max", "eval_jaxpr",
)  # fmt: skip
FOR_LATE_TIMES = ("SaveState", "State")


class MissingName(JaxonomyDaeError, RuntimeError):
    """A library no longer has a private name that this package uses."""


def private(name: str) -> Any:
    """The object of a name in `NAMES`.

    **Raises:**

    - `MissingName`, which says the library's version.
    """
    path = NAMES[name]
    module, _, attribute = path.rpartition(".")
    try:
        return getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise MissingName(f"{_versions(path)} has no {path}") from error


@functools.lru_cache(maxsize=64)  # asked at each run outside of jit
def _names_in(found: Any) -> frozenset[str]:
    """The names of a dataclass's fields, or of a function's arguments."""
    if dataclasses.is_dataclass(found):
        return frozenset(field.name for field in dataclasses.fields(found))
    return frozenset(inspect.signature(found).parameters)


def missing(names: tuple[str, ...]) -> str | None:
    """The first of the names that the installed versions lack or define otherwise, in words; None if all fit. The
    argument names of `AbstractAdjoint.loop` are checked, too."""
    for name in names:
        path = NAMES[name]
        try:
            found = private(name)
        except MissingName as error:
            return str(error)
        wanted = SHAPES.get(name)
        if wanted is None:
            continue
        # A further field does no harm. A further argument would be missing in calls.
        lacking = wanted - _names_in(found) if dataclasses.is_dataclass(found) else wanted ^ _names_in(found)
        if lacking:
            return f"{_versions(path)} has another {path}: {', '.join(sorted(lacking))}"
    given = _names_in(diffrax.AbstractAdjoint.loop) - {"self"}
    if given != _ADJOINT_LOOP:
        other = ", ".join(sorted(given ^ _ADJOINT_LOOP))
        return f"{_versions('diffrax')} calls AbstractAdjoint.loop with other arguments: {other}"
    return None


def has_stored_adjoint() -> bool:
    """True if the private names that `StoredAdjoint` needs exist; warns once if not."""
    lacking = missing(FOR_STORED_ADJOINT)
    if lacking is not None:
        _warn_once(
            f"{lacking}. Gradients are those of diffrax.RecursiveCheckpointAdjoint instead of StoredAdjoint: the same "
            "to rounding, but slower"
        )
    return lacking is None


def clear_jitted(function: Callable) -> None:
    """Frees the programs of a function of `equinox.filter_jit`, its derivatives by JAX included."""
    cached = getattr(function, "_cached", None)
    if cached is not None:
        return cached.clear_cache()
    _warn_once(f"{_versions('equinox')} has no _cached: all of JAX's programs are dropped where one would be enough")
    jax.clear_caches()


def constants(traced: Any) -> Any:
    """The values that a function traced by `jax.jit` closes over, and that its program would need as arguments."""
    return getattr(traced, "_consts", ())


@functools.cache
def _warn_once(text: str) -> None:
    warnings.warn(text, RuntimeWarning, stacklevel=4)


def _versions(path: str) -> str:
    library = path.partition(".")[0]
    return f"{library} {importlib.metadata.version(library)} (tried: {', '.join(TRIED[library])})"


def unwrapped(terms: Terms) -> tuple[Any, Any]:
    """(term, direction of time) of what Diffrax hands to a solver or a controller, or of a term by itself."""
    return (terms.term, terms.direction) if hasattr(terms, "direction") else (terms, 1)


def rewrapped(terms: Terms, term: Any) -> Any:
    """Wraps `term` in the same direction of time as `terms`."""
    return type(terms)(term, terms.direction) if hasattr(terms, "direction") else term


class _Open(eqx.Module):
    rtol: Any
    atol: Any
    norm: Any


# What a root finder holds in place of tolerances that Diffrax is to fill in, by the public way to make one.
FROM_CONTROLLER: Any = diffrax.with_stepsize_controller_tols(_Open)().rtol  # pyright: ignore


def clip_floor(t1: Any) -> Any:
    """The end of a step beyond which Diffrax lengthens it to t1."""
    for _ in range(100):
        t1 = private("prevbefore")(t1)
    return t1
