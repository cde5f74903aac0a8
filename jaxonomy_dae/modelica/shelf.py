"""Opened classes that are kept as data: in files of `pack`, and in the user's cache directory."""

import contextlib
import gzip
import hashlib
import json
import os
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..base.errors import ModelError
from ..host.kept import folder_of
from .kept_files import contents, write
from .open_class import OpenClass
from .read_rumoca import VERSION
from .stored import FORMAT, read, written

_ENDING = ".json"


class Shelf:
    """The classes of some roots that need no front end."""

    def __init__(self, roots: Sequence[Path]):
        self.packs = [root for root in roots if root.suffix == ".zip"]
        self.sources = [root for root in roots if root.suffix != ".zip"]

    def __str__(self) -> str:
        return ", ".join(map(str, self.packs))

    def names(self) -> list[str]:
        """The classes in the files of `pack`."""
        found = []
        for file in self.packs:
            with _archive(file) as archive:
                found += [n.removesuffix(_ENDING) for n in archive.namelist() if n.endswith(_ENDING)]
        return found

    def find(self, name: str, changes: str, source: str) -> OpenClass | None:
        """The class, if a file holds it."""
        if not changes and not source:
            for file in self.packs:
                with _archive(file) as archive:
                    if name + _ENDING in archive.namelist():
                        return read(json.loads(archive.read(name + _ENDING)))
        path = self._path(name, changes, source)
        if path is None:
            return None
        with contextlib.suppress(
            OSError, EOFError, ValueError, zlib.error, ModelError
        ):  # none, or not whole: flattened anew
            found = read(json.loads(gzip.decompress(path.read_bytes())))
            os.utime(path)
            return found
        return None

    def keep(self, found: OpenClass, name: str, changes: str, source: str) -> None:
        """Keeps a class for the next process, if there is a folder for it."""
        path = self._path(name, changes, source)
        if path is not None:
            write(path, gzip.compress(json.dumps(written(found)).encode(), 6))

    def _path(self, name: str, changes: str, source: str) -> Path | None:
        folder = folder_of("modelica")
        if folder is None:
            return None
        told = [FORMAT, VERSION, name, changes, source, *(contents(root, folder) for root in self.sources)]
        return folder / f"{hashlib.sha256(json.dumps(told).encode()).hexdigest()}.gz"


def pack(file: Path, classes: Sequence[OpenClass], notes: dict[str, Any]) -> None:
    """Writes classes into one file that `Library` reads; `notes` say what they are."""
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        archive.comment = json.dumps({"format": FORMAT, "rumoca": VERSION, **notes}).encode()
        for each in sorted(classes, key=lambda c: c.name):
            entry = zipfile.ZipInfo(each.name + _ENDING)  # without the time, so that equal classes make equal files
            entry.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(entry, json.dumps(written(each), separators=(",", ":")))


def _archive(file: Path) -> zipfile.ZipFile:
    try:
        return zipfile.ZipFile(file)
    except (OSError, zipfile.BadZipFile) as error:
        raise ModelError(f"'{file}' is not a file of packed classes: {error}") from None
