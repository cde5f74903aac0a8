"""Data of libraries in the user's cache directory."""

import contextlib
import hashlib
import json
import os
import re
import tempfile
from pathlib import Path

from ..host.kept import make_room

OURS = re.compile(r"[0-9a-f]{64}(\.gz)?|new-[\w-]+")  # names of files that this module wrote
ROOM = 2**28  # bytes in one folder: the 1,343 classes of the Modelica library take some 15 MB


def contents(root: Path, folder: Path) -> str:
    """A digest of the sources in a root. Times and sizes of the files tell whether it is known already."""
    files = sorted(root.rglob("*.mo")) if root.is_dir() else [root]
    status = [(str(f), s.st_size, s.st_mtime_ns) for f in files for s in [f.stat()]]
    known = folder / "contents" / hashlib.sha256(json.dumps(status).encode()).hexdigest()
    with contextlib.suppress(OSError):
        return known.read_text()
    digest = hashlib.sha256()
    for f in files:
        # Names from the root on: a library that was moved or copied is the same.
        digest.update(f"{f.relative_to(root.parent)} {f.stat().st_size}\n".encode() + f.read_bytes())
    write(known, digest.hexdigest().encode())
    return digest.hexdigest()


def write(path: Path, content: bytes) -> None:
    """Writes a file whole or not at all."""
    with contextlib.suppress(OSError):  # a full disk, no permission
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix="new-", delete=False) as new:
            new.write(content)
        os.replace(new.name, path)
        make_room(path.parent, OURS, ROOM)
