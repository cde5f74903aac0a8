"""Programs that are kept for the next process, in a folder of the user's cache.

A file holds an executable that XLA made for one processor. Its name is a digest of the program as StableHLO, the
compiler's options, the versions of JAX and its library, the platform, and the processor's features, so that no other
processor loads it. Another file says, as data, which executable a call needs (`cache.py`, `written.py`), so that the
call need not be traced to find it. Where the user has chosen a folder for JAX's own compilation cache, that one serves
instead.

Executables are native code. So the folder must belong to the user, nobody else may write into it, and no link leads to
a file in it. Only files that this module wrote, which it knows by their names, are counted, read and deleted.
"""

import contextlib
import functools
import hashlib
import os
import platform as machine
import re
import stat
import sys
import tempfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeAlias

import jax

from ..base.private_names import MissingName, private
from .compilations import Compilation, noted
from .platform import platform

VARIABLE = "JAXONOMY_DAE_CACHE"  # names the folder; empty: programs are not kept
ROOM = 2**30  # bytes in the folder, beyond which the least recently used files go
AFTER = 0.8  # of the room, what is left then: so that not every new file makes a search
CALLBACK = re.compile(rb"python_(cpu|gpu|tpu)?_?callback")  # in programs that call Python, as no other process can
OURS = re.compile(r"[0-9a-f]{64}\.program|new-[\w-]+\.program")  # names of files that this module wrote
_CHOSEN: list[Path | None] = []
Options: TypeAlias = dict[str, bool | int]  # of the compiler


def keep_programs(folder: str | os.PathLike[str] | None) -> None:
    """Sets the folder that keeps programs compiled outside of jit for the next process; None: no folder.

    The default is the folder in the environment variable `JAXONOMY_DAE_CACHE` (empty: no folder), or else
    `jaxonomy_dae` in the user's cache directory. The package's files in a folder, whose names end with `.program`, grow
    to 1 GiB; then the least recently used ones are deleted. You may delete them at any time. They are executable code:
    a folder that belongs to somebody else, or into which others may write, is not used, and `compilations()` says so.
    While JAX's own cache is on (`jax_compilation_cache_dir`), it is used instead.
    """
    # An empty name is that of the folder a process happens to be in: it means none, as in the variable.
    _CHOSEN[:] = [Path(folder).expanduser() if folder else None]


def folder() -> Path | None:
    """The folder in which programs are kept; None if they are not."""
    config: Any = jax.config
    if config.jax_compilation_cache_dir and config.jax_enable_compilation_cache:
        return None  # JAX keeps them; and XLA cannot write once more what it has read from there
    if _CHOSEN:
        return _CHOSEN[0]
    if not config.jax_enable_compilation_cache:
        return None
    named = os.environ.get(VARIABLE)
    if named is not None:
        return Path(named).expanduser() if named else None
    caches = _user_cache()
    return None if caches is None else caches / "jaxonomy_dae" / "programs"


def folder_of(kind: str) -> Path | None:
    """The folder that keeps data of a kind for the next process, beside that of programs; None if nothing is kept."""
    if _CHOSEN:
        return None if _CHOSEN[0] is None else _CHOSEN[0] / kind
    named = os.environ.get(VARIABLE)
    if named is not None:
        return Path(named).expanduser() / kind if named else None
    caches = _user_cache()
    return None if caches is None else caches / "jaxonomy_dae" / kind


def _user_cache() -> Path | None:
    """The user's directory of caches; None for a user without a home, as in containers."""
    try:
        if sys.platform == "win32":
            return Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
        if sys.platform == "darwin":
            return Path.home() / "Library" / "Caches"
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    except RuntimeError:
        return None


_REFUSED: set[str] = set()  # folders of which a record was made


def _usable(where: Path) -> bool:
    """True if the folder is there, belongs to this user, and nobody else may write into it. Says once why not."""
    try:
        status = os.lstat(where)
    except OSError:
        return False
    why = ""
    if not stat.S_ISDIR(status.st_mode):
        why = "it is not a folder, but a link or a file"
    elif hasattr(os, "getuid") and status.st_uid != os.getuid():
        why = "it belongs to another user"
    elif hasattr(os, "getuid") and status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        why = "others may write into it"
    if why and str(where) not in _REFUSED:
        _REFUSED.add(str(where))
        noted(Compilation("kept programs", "refused", f"the folder {where} is not used: {why}", 0.0, 0.0, 0.0))
    return not why


def calls_python(program: bytes) -> bool:
    """True if a program, given as StableHLO, calls Python."""
    return CALLBACK.search(program) is not None


@functools.cache
def _machine() -> str:
    """What the machine code of this process may rely on."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        # Each core has these lines. How many cores there are must not count.
        told = [line for line in lines if line.startswith(("model name", "flags", "Features", "CPU part"))]
        processor = "\n".join(sorted(set(told)))
    except OSError:
        processor = f"{machine.processor()} of {machine.node()}"
    return f"{machine.system()} {machine.machine()} {processor}"


def key(program: str) -> str | None:
    """A digest of a program, told by another digest, and all that its machine code depends on; None if programs are not
    kept."""
    if folder() is None:
        return None
    told = machine_and_versions() | {"flags": os.environ.get("XLA_FLAGS", "")}
    return hashlib.sha256(f"{program} {sorted(told.items())}".encode()).hexdigest()


def _versions_of_backends() -> str:
    """The versions of the backends, with those of the driver and the plug-in of a GPU."""
    return "; ".join(sorted({f"{d.platform} {d.client.platform_version}" for d in jax.devices(platform())}))


def machine_and_versions() -> dict[str, str]:
    """What an executable of this process is made for: versions, backend and processor, by name."""
    jaxlib = sys.modules.get("jaxlib")
    return {
        "version of JAX": jax.__version__,
        "version of jaxlib": getattr(jaxlib, "__version__", ""),
        "version of Python": ".".join(map(str, sys.version_info[:3])),
        "backend": f"{platform()} {_versions_of_backends()}",
        "processor": _machine(),
    }


def _path(key: str, options: Options) -> Path | None:
    where = folder()
    name = hashlib.sha256(f"{key} {sorted(options.items())}".encode()).hexdigest()
    return None if where is None else where / f"{name}.program"


def save(key: str | None, options: Options, run: Any) -> None:
    """Keeps an executable, if there is a folder for it. Nothing that goes wrong here matters."""
    path = None if key is None else _path(key, options)
    if path is not None:
        with contextlib.suppress(Exception):  # an executable that cannot be serialized
            content, _, _ = private("serialize_executable")(run)
            _write(path, zlib.compress(content, 1))


def load(key: str | None, options: Options, outputs: int, arrays: Sequence[Any]) -> Any:
    """The executable that an earlier process has kept; None if there is none, or it is not whole. It takes a list of
    such arrays, and returns a list of so many."""
    path = None if key is None else _path(key, options)
    content = None if path is None else _read(path)
    if path is None or content is None:
        return None
    try:
        devices = sorted({d for a in arrays for d in a.sharding.device_set}, key=lambda d: d.id) or jax.devices()[:1]
        trees = jax.tree.structure(((list(arrays),), {})), jax.tree.structure([0] * outputs)
        return private("deserialize_executable")(zlib.decompress(content), *trees, execution_devices=devices)
    except MissingName:
        return None
    except Exception:  # written by another version
        _delete(path)
        return None


def save_record(key: str, content: bytes | None) -> None:
    """Keeps what is known of a program beside its executable."""
    path = _path(key, {})
    if path is not None and content is not None:
        _write(path, content)


def load_record(key: str | None) -> bytes | None:
    """What an earlier process has kept of a program; None if there is none, or it is not whole."""
    path = None if key is None else _path(key, {})
    return None if path is None else _read(path)


def _write(path: Path, content: bytes) -> None:
    """Writes a file as a whole, or not at all: other processes may write at the same time, and disks may be full."""
    draft = None
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not _usable(path.parent):
            return
        # A rename is atomic within one folder: a reader sees the whole file or none.
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix="new-", suffix=".program", delete=False) as file:
            draft = file.name
            # The digest shows a file that was cut off, or has changed on its disk.
            file.write(hashlib.sha256(content).digest() + content)
        os.replace(draft, path)
        draft = None
        make_room(path.parent, OURS, ROOM)
    except OSError:  # a full disk, no permission
        pass
    finally:
        if draft is not None:
            _delete(Path(draft))


def _read(path: Path) -> bytes | None:
    """The content of a file; a file that is not whole is deleted."""
    if not _usable(path.parent):
        return None
    try:
        # By the open file rather than by its path: between a check of the path and its opening, the file could be
        # exchanged.
        opened = os.open(path, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0))
        with open(opened, "rb") as file:
            if hasattr(os, "getuid") and os.fstat(opened).st_uid != os.getuid():
                return None
            whole = file.read()
        # The date of use, by which files are deleted: many systems do not keep one of reading.
        os.utime(path)
    except OSError:
        return None
    if hashlib.sha256(whole[32:]).digest() == whole[:32]:
        return whole[32:]
    _delete(path)
    return None


def _delete(path: Path) -> None:
    with contextlib.suppress(OSError):
        path.unlink()


def make_room(where: Path, ours: re.Pattern[str], room: int) -> None:
    """Deletes the package's files, whose names are `ours`, that were used least recently, if all together take more
    than the room."""
    files = []
    for entry in os.scandir(where):
        if ours.fullmatch(entry.name):
            with contextlib.suppress(OSError):
                status = entry.stat(follow_symlinks=False)
                files.append((status.st_mtime, status.st_size, entry.path))
    taken = sum(size for _, size, _ in files)
    if taken <= room:
        return
    # By date: the least recently used first.
    for _, size, path in sorted(files):
        with contextlib.suppress(OSError):
            os.unlink(path)
        taken -= size
        if taken <= AFTER * room:
            return
