"""What something consists of: the one identity by which programs, plans, checkpoints and caches tell things apart.

Given any object, a walk over it makes a digest that two objects share only if they compute the same. A function counts
by its code, its defaults, what it closes over and what it reads from its module, each by its content again; an object
by its class and its attributes; a class of the user's by its methods; a number by its type and its digits. What stands
in the package or in a library counts by its name (`libraries.py`). So a law that was defined again is the same law, and
one whose surroundings have changed is another.

Where the walk cannot see what decides, as at a clock, a file, a generator or an environment variable, it says so: such
a program is traced at every call, and what it computes then decides (`cache.py`).
"""

import dataclasses
import dis
import enum
import functools
import hashlib
import struct
import sys
import types
import weakref
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.tree_util import PyTreeDef

from . import libraries
from .libraries import Owner, is_as_written, is_impure, owner, place

_PLAIN = frozenset({type(None), bool, int, float, complex, str, bytes, type(...), type(NotImplemented)})
# These attributes of a class follow from the rest, or tell nothing of what its methods compute.
_BESIDE = frozenset({
    "__dict__", "__weakref__", "__doc__", "__module__", "__annotations__", "__dataclass_fields__",
    "__dataclass_params__", "__match_args__", "__abstractmethods__", "_abc_impl", "__qualname__", "__firstlineno__",
    "__static_attributes__", "__parameters__", "__orig_bases__", "__annotate__", "__annotate_func__",
    "__annotations_cache__",
})  # fmt: skip


class HasContent(Protocol):
    """A part that says itself what it is, instead of being walked over."""

    def __content__(self) -> tuple[str, Sequence[Any]]:
        """A digest that equal parts share in all processes; and further parts, which the digest leaves out."""
        ...


class Hidden(NamedTuple):
    """Stands for what a part that says itself what it is cannot see of itself."""

    what: str


class Content(NamedTuple):
    """What a walk has found: a digest; and what it could not see, in words. Equal digests mean the same computation
    only where nothing was unseen."""

    digest: str
    unseen: tuple[str, ...]


def content(*parts: object) -> Content:
    """What the parts consist of, now."""
    walk = _Walk()
    for part in parts:
        walk.part(part)
    return Content(walk.hash.hexdigest(), tuple(dict.fromkeys(walk.unseen)))


class _Walk:
    """A walk over some parts. Objects that may change, or contain themselves, are visited once; later they are
    references."""

    def __init__(self):
        self.hash = hashlib.sha256()
        self.unseen: list[str] = []
        self._seen: dict[int, tuple[int, object]] = {}  # the objects are kept, so that their ids stay taken

    def say(self, kind: str, *values: bytes | str) -> None:
        self.hash.update(f"{kind}\1{len(values)}\1".encode())
        for value in values:
            raw = value if isinstance(value, bytes) else value.encode(errors="surrogatepass")
            self.hash.update(len(raw).to_bytes(8, "little") + raw)

    def hidden(self, what: str) -> None:
        self.say("unseen", what)
        self.unseen.append(what)

    def part(self, part: Any) -> None:
        kind = type(part)
        # With the type: `repr` alone would make the text "1" and the number 1 one.
        if kind in _PLAIN:
            return self.say(kind.__name__, repr(part))
        if kind is tuple:
            self.say("tuple", str(len(part)))
            return self.parts(part)
        if kind is Hidden:
            return self.hidden(part.what)
        if isinstance(part, types.CodeType):
            return self.say("code", _code(part).digest)
        if isinstance(part, Tracer):
            return self.hidden("a traced value")
        if isinstance(part, jax.Array):
            return self.say("array", _of_array(part))
        # Others that are arrays, too, such as masked ones, have more than numbers: `_object`.
        if (kind is np.ndarray or isinstance(part, np.generic)) and not part.dtype.hasobject:
            array = np.ascontiguousarray(part)
            return self.say("numbers", kind.__name__, str(array.dtype), str(array.shape), array.tobytes())
        if isinstance(part, np.dtype):
            return self.say("dtype", part.str)
        known = self._seen.get(id(part))
        if known is not None:
            return self.say("again", str(known[0]))
        # Before the walk goes inside, so that an object that contains itself ends it.
        self._seen[id(part)] = len(self._seen), part
        try:
            self._one(part, kind)
        except RecursionError:
            self.hidden("something nested too deeply")

    def parts(self, parts: Any) -> None:
        for part in parts:
            self.part(part)

    def _one(self, part: Any, kind: type) -> None:
        if hasattr(kind, "__content__"):
            digest, more = part.__content__()
            self._name_of_class(kind)
            self.say("own content", digest)
            return self.parts(more)
        match part:
            case PyTreeDef():
                return self._tree(part)
            case types.FunctionType():
                return self._function(part)
            case type():
                return self._class(part)
            case types.MethodType():
                self.say("method")
                return self.parts((part.__func__, part.__self__))
            case types.ModuleType():
                if owner(part.__name__) is Owner.KNOWN:
                    return self.say("module", part.__name__)
                return self.hidden(f"what is read of the module {part.__name__}")
            case enum.Enum():
                self._name_of_class(kind)
                return self.say("member", str(part.name), repr(part.value))
            case functools.partial():
                self.say("partial")
                return self.parts((part.func, part.args, part.keywords))
            case set() | frozenset():
                return self._set(part, kind)
            case list() | dict() | tuple() | types.MappingProxyType():
                return self._container(part, kind)
            case np.ndarray() if kind is np.ndarray:  # of objects
                self.say("array of objects", str(part.dtype), str(part.shape))
                return self.parts(part.ravel().tolist())
        if isinstance(part, types.BuiltinFunctionType) and not isinstance(part.__self__, types.ModuleType | None):
            self.say("method", part.__name__)  # of a list, say
            return self.part(part.__self__)
        found = place(part) if callable(part) else None
        if found is not None:
            return self.say("named", found)
        if isinstance(part, types.BuiltinFunctionType) or owner(kind.__module__) is Owner.STANDARD:
            return self.hidden(f"{getattr(part, '__module__', None) or kind.__module__}.{_name(part)}")
        if kind.__module__.startswith("jaxlib") and hasattr(part, "__wrapped__"):  # what `jax.jit` returns
            self.say("jitted")
            return self.part(part.__wrapped__)
        self._object(part, kind)

    # --- containers ---------------------------------------------------------------------------------------------------

    def _container(self, part: Any, kind: type) -> None:
        items = list(part.items()) if isinstance(part, dict | types.MappingProxyType) else list(part)
        self.say("items", kind.__name__, str(len(items)))
        if kind not in (list, dict):
            self._name_of_class(kind)
            self._attributes(part, kind)
        self.parts(items)

    def _set(self, part: Any, kind: type) -> None:
        """Members have no order of their own, so that each is walked over by itself. One that leads back to the set
        would never end: only plain data, and what is known by its name, count."""
        self._name_of_class(kind)
        if kind not in (set, frozenset):
            self._attributes(part, kind)
        members = []
        for member in part:
            if not _is_plain(member):
                return self.hidden(f"a set with an object of type {type(member).__qualname__}")
            # Each member by a walk of its own: references to what was seen before depend on the order, and sets have
            # none.
            members.append(content(member).digest)
        self.say("set", *sorted(members))

    def _tree(self, tree: Any) -> None:
        """The structure of a pytree. Of one that consists of the package's records and of containers, and in which no
        function stands, equal ones have one content, which is remembered: the walk takes 0.7 ms for a pendulum."""
        known = _TREES.get(tree)
        if known is not None:
            return self.say("structure", known)
        inside = _Walk()
        is_settled = inside._node(tree)
        self.unseen += inside.unseen
        digest = inside.hash.digest()
        if is_settled and not inside.unseen:
            if len(_TREES) >= MOST_TREES:
                _TREES.clear()
            _TREES[tree] = digest
        self.say("structure", digest)

    def _node(self, tree: Any) -> bool:
        """True if equal structures have one content: in classes of others, 1 and True may mean two things."""
        inside = tree.node_data()
        if inside is None:
            self.say("leaf" if tree.num_leaves else "none")
            return True
        kind, beside = inside
        self.say("tree", str(len(tree.children())))
        self._name_of_class(kind)
        self.part(beside)
        known = kind in _BUILT_IN or owner(kind.__module__) is Owner.KNOWN
        numbers = kind in _BUILT_IN or kind.__module__.startswith(_OWN)
        settled = known and all(
            _is_settled(one, numbers) for one in (beside if type(beside) in (tuple, list) else [beside])
        )
        for child in tree.children():
            settled = self._node(child) and settled
        return settled

    # --- code ---------------------------------------------------------------------------------------------------------

    def _function(self, function: types.FunctionType) -> None:
        found = place(function)
        if found is not None:
            return self.say("named", found)
        code = _code(function.__code__)
        self.say("function", code.digest)
        self.parts((function.__defaults__, function.__kwdefaults__, {**vars(function)}))
        for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
            try:
                inside = cell.cell_contents
            except ValueError:
                self.say("an empty cell")
            else:
                self._value(inside, code, name)
        # Code of the package and of libraries may have no name, as functions inside others; what it reads has one.
        whose = owner(function.__globals__.get("__name__"))
        if whose is Owner.STANDARD:
            self.hidden(f"{function.__module__}.{function.__qualname__}()")
        # The code of the package and of libraries does not change within a process, and for other processes a digest of
        # their files counts.
        if whose is not Owner.USER:
            return
        if code.changes_globals:
            self.hidden("a global variable that the function changes")
        scope, built_in = function.__globals__, function.__builtins__
        for name in code.reads:
            if name in scope:
                self.say("global", name)
                self._value(scope[name], code, name)
            elif name in built_in:
                self.say("built-in", name)
                if is_impure(name):
                    self.hidden(f"{name}()")
            else:
                self.say("missing", name)
        for name in code.imports:
            self.say("import", name)
            module = sys.modules.get(name)
            if module is None:
                self.hidden(f"the import of {name}")
            else:
                self._module(module, code.attributes)

    def _value(self, value: Any, code: "_Code", name: str) -> None:
        """What a function reads by a name: of a module, the parts that its code names."""
        if not isinstance(value, types.ModuleType):
            return self.part(value)
        if name in code.bare and owner(value.__name__) is not Owner.KNOWN:
            return self.hidden(f"what is read of the module {value.__name__}")
        self._module(value, code.attributes)

    def _module(self, module: types.ModuleType, names: tuple[str, ...], depth: int = 0) -> None:
        whose = owner(module.__name__)
        self.say("module", module.__name__)
        found = [name for name in names if name in vars(module)]
        if whose is Owner.STANDARD or (not found and whose is Owner.USER):
            return self.hidden(f"what is read of the module {module.__name__}")
        for name in found:
            value = vars(module)[name]
            self.say("of module", name)
            if not isinstance(value, types.ModuleType):
                self.part(value)
            elif depth < len(names):
                self._module(value, names, depth + 1)

    # --- classes and objects ------------------------------------------------------------------------------------------

    def _name_of_class(self, kind: Any) -> None:
        if kind in _BUILT_IN:
            self.say("class", kind.__name__)
        else:
            self.part(kind)

    def _class(self, kind: type) -> None:
        found = place(kind)
        if found is not None and is_as_written(kind):
            return self.say("named", found)
        if owner(kind.__module__) is Owner.STANDARD:
            return self.hidden(f"{kind.__module__}.{kind.__qualname__}")
        self.say("class", kind.__qualname__)
        self.parts([base for base in kind.__bases__ if base is not object])
        meta = type(kind)
        if meta is not type:
            self._name_of_class(meta)
        for name, value in sorted(vars(kind).items()):
            if name in _BESIDE:
                continue
            self.say("attribute", name)
            self._of_class(value)

    def _of_class(self, value: Any) -> None:
        match value:
            case staticmethod() | classmethod():
                self.part(value.__func__)
            case property():
                self.parts((value.fget, value.fset))
            case functools.cached_property():
                self.part(value.func)
            case types.MemberDescriptorType() | types.GetSetDescriptorType() | types.WrapperDescriptorType():
                self.say("slot", value.__name__)
            case dataclasses.Field():
                self.parts((value.name, value.default))
            case _:
                self.part(value)

    def _object(self, part: Any, kind: type) -> None:
        if kind is object:
            return self.hidden("an object() that only its place in memory tells from others")
        self.say("object")
        self._name_of_class(kind)
        # Classes with a way of their own to be written to files say with it what they consist of. Those of the package
        # leave out what a file cannot hold.
        own_way = kind.__reduce_ex__ is not object.__reduce_ex__ or kind.__reduce__ is not object.__reduce__
        all_seen = _has_only_attributes(kind) and (not own_way or kind.__module__.startswith(_OWN))
        if not (all_seen and self._attributes(part, kind)):
            try:
                found = part.__reduce_ex__(4)
            except Exception:  # whatever classes of others raise
                return self.hidden(f"an object of type {kind.__module__}.{kind.__qualname__}")
            if isinstance(found, str):
                return self.hidden(f"{kind.__module__}.{_name(part)}")
            self.parts(found)

    def _attributes(self, part: Any, kind: type) -> bool:
        """All attributes, but for those that are computed from others when asked for. False if there cannot be any."""
        slots = {name for base in kind.__mro__ for name in _slots(base) if hasattr(part, name)}
        own = getattr(part, "__dict__", None)
        if own is None and not slots:
            return False
        given = {name: getattr(part, name) for name in slots - {"__weakref__", "__dict__"}} | dict(own or {})
        for name in sorted(given, key=str):
            if not isinstance(getattr(kind, str(name), None), functools.cached_property):
                self.say("attribute", str(name))
                self.part(given[name])
        return True


@functools.lru_cache(maxsize=4096)
def _has_only_attributes(kind: type) -> bool:
    """True if instances hold nothing but attributes. Beside them, one of a subclass of float holds its number, and one
    of a class written in C whatever it likes: their memory is larger than their slots need."""
    while kind is not object:
        base = kind.__base__
        if base is None or not kind.__flags__ & _MADE_AT_RUN_TIME:
            return False
        slots = [name for name in _slots(kind) if name not in ("__dict__", "__weakref__")]
        extra = [kind.__dictoffset__ > base.__dictoffset__ >= 0, kind.__weakrefoffset__ > base.__weakrefoffset__ >= 0]
        if kind.__basicsize__ - base.__basicsize__ > _WORD * (len(slots) + sum(extra)):
            return False
        kind = base
    return True


_MADE_AT_RUN_TIME = 1 << 9  # Py_TPFLAGS_HEAPTYPE of `object.h`: what a class statement makes has it
_WORD = struct.calcsize("P")

_BUILT_IN = frozenset({type(None), tuple, list, dict, set, frozenset, bool, int, float, complex, str, bytes})


def _is_plain(member: object) -> bool:
    """True for numbers, texts, members of enumerations, what has a name in a library, and tuples of such."""
    if isinstance(member, tuple | frozenset):
        return type(member) in (tuple, frozenset) and all(map(_is_plain, member))
    return type(member) in _PLAIN or isinstance(member, enum.Enum) or (callable(member) and place(member) is not None)


_TREES: dict[Any, bytes] = {}
MOST_TREES = 256  # structures whose digests are remembered
_OWN = f"{libraries.PACKAGE}."


def _is_settled(part: Any, numbers: bool) -> bool:
    """True for a static part that cannot change, reads nothing that can, and has one content with all that equals it;
    numbers do so in the package's own records, whose fields have one type."""
    kind = type(part)
    if kind in (tuple, frozenset):
        return all(_is_settled(one, numbers) for one in part)
    if kind in _PLAIN:
        return numbers or kind in (str, bytes, type(None))
    if kind.__module__.startswith("equinox.") and not getattr(
        part, "__dict__", None
    ):  # what stands for a missing field
        return True
    return hasattr(kind, "__content__") and kind.__module__.startswith(_OWN) and not part.__content__()[1]


def _name(part: Any) -> str:
    return str(getattr(part, "__qualname__", None) or type(part).__qualname__)


def _slots(base: type) -> tuple[str, ...]:
    own = vars(base).get("__slots__", ())
    return (own,) if isinstance(own, str) else tuple(own)


class _Code(NamedTuple):
    """What a code object tells without its surroundings.

    - `reads`: names of global variables; `bare`: those that are used other than for an attribute.
    - `attributes`: names of attributes; `imports`: modules that are imported inside.
    """

    digest: bytes
    reads: tuple[str, ...]
    bare: frozenset[str]
    attributes: tuple[str, ...]
    imports: tuple[str, ...]
    changes_globals: bool
    code: types.CodeType  # kept, so that its id stays taken


_CODES: dict[int, _Code] = {}
MOST = 20_000  # code objects that are remembered, 1 kB each
_GLOBAL = frozenset({"LOAD_GLOBAL", "LOAD_NAME", "LOAD_FROM_DICT_OR_GLOBALS"})
_NAMED = _GLOBAL | {"LOAD_DEREF", "LOAD_CLASSDEREF", "LOAD_FROM_DICT_OR_DEREF"}
_ATTRIBUTE = frozenset({"LOAD_ATTR", "LOAD_METHOD", "IMPORT_FROM"})
_CHANGING = frozenset({"STORE_GLOBAL", "DELETE_GLOBAL"})
_SILENT = frozenset({"CACHE", "PUSH_NULL", "EXTENDED_ARG", "NOP", "PRECALL", "RESUME"})


def _code(code: types.CodeType) -> _Code:
    known = _CODES.get(id(code))
    if known is None:
        if len(_CODES) > MOST:
            _CODES.clear()
        known = _CODES[id(code)] = _read(code)
    return known


def _read(code: types.CodeType) -> _Code:
    found = hashlib.sha256(code.co_code)
    about = (
        code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars, code.co_argcount, code.co_kwonlyargcount,
        code.co_posonlyargcount, code.co_flags,
    )  # fmt: skip
    found.update(repr(about).encode() + getattr(code, "co_exceptiontable", b""))
    reads: dict[str, None] = {}
    bare: set[str] = set()
    attributes: dict[str, None] = {}
    imports: dict[str, None] = {}
    changes = False
    instructions = [one for one in dis.get_instructions(code) if one.opname not in _SILENT]
    for one, after in zip(instructions, [*instructions[1:], None], strict=True):
        name = str(one.argval)
        if one.opname in _NAMED:
            if one.opname in _GLOBAL:
                reads[name] = None
            if after is None or after.opname not in ("LOAD_ATTR", "LOAD_METHOD"):
                bare.add(name)
        elif one.opname in _ATTRIBUTE:
            attributes[name] = None
        elif one.opname == "IMPORT_NAME":
            imports[name] = None
        elif one.opname in _CHANGING:
            changes = True
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            inside = _code(constant)
            found.update(inside.digest)
            reads |= dict.fromkeys(inside.reads)
            bare |= inside.bare
            attributes |= dict.fromkeys(inside.attributes)
            imports |= dict.fromkeys(inside.imports)
            changes = changes or inside.changes_globals
        else:
            found.update(_of_constant(constant))
    return _Code(
        found.digest(), tuple(reads), frozenset(bare), tuple(attributes), tuple(imports), changes, code
    )  # fmt: skip


def _of_constant(constant: Any) -> bytes:
    if isinstance(constant, frozenset):
        return f"frozenset {sorted((type(c).__name__, repr(c)) for c in constant)}".encode()
    if isinstance(constant, tuple):
        return b"(" + b",".join(map(_of_constant, constant)) + b")"
    return f"{type(constant).__name__} {constant!r}".encode()


_ARRAYS: dict[int, tuple["weakref.ref[jax.Array]", bytes]] = {}


def _of_array(array: jax.Array) -> bytes:
    """The digest of an array of JAX, which cannot change, and is looked at once."""
    known = _ARRAYS.get(id(array))
    if known is not None and known[0]() is array:
        return known[1]
    values: Any = array
    if jnp.issubdtype(array.dtype, jax.dtypes.prng_key):
        values = jax.random.key_data(array)
    numbers = np.ascontiguousarray(np.asarray(values))
    head = f"{array.dtype} {array.shape} {getattr(array, 'weak_type', False)}".encode()
    digest = hashlib.sha256(head + numbers.tobytes()).digest()
    key = id(array)
    _ARRAYS[key] = weakref.ref(array, lambda _: _ARRAYS.pop(key, None)), digest
    return digest
