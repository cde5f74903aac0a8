"""Programs that are kept for the next process, in a folder of the user's cache.

A file holds an executable that XLA made for one processor. Its name is a digest of the program as StableHLO, the
compiler's options, the versions of JAX and its library, the platform, and the processor's features, so that no other
processor loads it. Another file says which executable a call needs (`lasting.py`), so that the call need not be traced
to find it. Where the user has chosen a folder for JAX's own compilation cache, that one serves instead.
"""

import contextlib
import functools
import hashlib
import os
import platform as machine
import struct
import sys
import tempfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeAlias

import jax

from ..base.private_names import MissingName, private

VARIABLE = "JAXONOMY_DAE_CACHE"  # names the folder; empty: programs are not kept
ROOM = 2**30  # bytes in the folder, beyond which the least recently used files go
AFTER = 0.8  # of the room, what is left then: so that not every new file makes a search
CALLBACK = b"python_cpu_callback"  # in programs that call Python, which no other process can run
_CHOSEN: list[Path | None] = []
Options: TypeAlias = dict[str, bool | int]  # of the compiler


def keep_programs(folder: str | os.PathLike[str] | None) -> None:
    """Sets the folder that keeps programs compiled outside of jit for the next process; None: no folder.

    The default is the folder in the environment variable `JAXONOMY_DAE_CACHE` (empty: no folder), or else
    `jaxonomy_dae` in the user's cache directory. A folder grows to 1 GiB; then the least recently used files are
    deleted. You may delete it at any time. The files are executable code: use a folder in which only you may write.
    While JAX's own cache is on (`jax_compilation_cache_dir`), it is used instead.
    """
    _CHOSEN[:] = [None if folder is None else Path(folder).expanduser()]


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
    return _user_cache() / "jaxonomy_dae" / "programs"


def folder_of(kind: str) -> Path | None:
    """The folder that keeps data of a kind for the next process, beside that of programs; None if nothing is kept."""
    if _CHOSEN:
        return None if _CHOSEN[0] is None else _CHOSEN[0] / kind
    named = os.environ.get(VARIABLE)
    if named is not None:
        return Path(named).expanduser() / kind if named else None
    return _user_cache() / "jaxonomy_dae" / kind


def _user_cache() -> Path:
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")


@functools.cache
def _machine() -> str:
    """What the machine code of this process may rely on."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
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


def machine_and_versions() -> dict[str, str]:
    """What an executable of this process is made for, by what that is."""
    jaxlib = sys.modules.get("jaxlib")
    return {
        "version of JAX": jax.__version__,
        "version of jaxlib": getattr(jaxlib, "__version__", ""),
        "version of Python": ".".join(map(str, sys.version_info[:3])),
        "backend": jax.default_backend(),
        "processor": _machine(),
    }


def _path(key: str, options: Options) -> Path | None:
    where = folder()
    return None if where is None else where / hashlib.sha256(f"{key} {sorted(options.items())}".encode()).hexdigest()


def save(key: str | None, options: Options, run: Any, cost: float) -> None:
    """Keeps an executable, and the processor seconds that it cost, if there is a folder for it. Nothing that goes wrong
    here matters."""
    path = None if key is None else _path(key, options)
    if path is not None:
        with contextlib.suppress(Exception):  # an executable that cannot be serialized
            content, _, _ = private("serialize_executable")(run)
            _write(path, struct.pack("<d", cost) + zlib.compress(content, 1))


def load(key: str | None, options: Options, outputs: int, arrays: Sequence[Any]) -> tuple[Any, float] | None:
    """The executable that an earlier process has kept, and what it cost; None if there is none, or it is not whole.
    It takes a list of such arrays, and returns a list of so many."""
    path = None if key is None else _path(key, options)
    content = None if path is None else _read(path)
    if path is None or content is None:
        return None
    try:
        devices = sorted({d for a in arrays for d in a.sharding.device_set}, key=lambda d: d.id) or jax.devices()[:1]
        trees = jax.tree.structure(((list(arrays),), {})), jax.tree.structure([0] * outputs)
        found = private("deserialize_executable")(zlib.decompress(content[8:]), *trees, execution_devices=devices)
    except MissingName:
        return None
    except Exception:  # written by something else
        _delete(path)
        return None
    return found, struct.unpack("<d", content[:8])[0]


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
    with contextlib.suppress(OSError):  # a full disk, no permission
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix="new-", delete=False) as file:
            file.write(hashlib.sha256(content).digest() + content)
        os.replace(file.name, path)
        _make_room(path.parent)


def _read(path: Path) -> bytes | None:
    """The content of a file; a file that is not whole is deleted."""
    try:
        whole = path.read_bytes()
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


def _make_room(where: Path) -> None:
    """Deletes the files that were used least recently, if all together take more than the room."""
    files = []
    for entry in os.scandir(where):
        with contextlib.suppress(OSError):
            status = entry.stat()
            files.append((status.st_mtime, status.st_size, entry.path))
    taken = sum(size for _, size, _ in files)
    if taken <= ROOM:
        return
    for _, size, path in sorted(files):
        with contextlib.suppress(OSError):
            os.unlink(path)
        taken -= size
        if taken <= AFTER * ROOM:
            return
