"""Binaries for an FMU, made of the C sources that it holds."""

import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

from ..base.errors import ModelError
from .compilers import FOLDERS_OF_FMI_2, TARGETS, compiler_for, shared_library, this_platform
from .export import zipped


def add_binaries(path: Path, platforms: Sequence[str] = ()) -> list[str]:
    """Compiles the sources of an FMU and puts the binaries into it; what else is in it stays.

    **Arguments:**

    - `path`: an FMU whose build needs one C file, its neighbours, and no settings, as `export_fmu` writes it.
    - `platforms`: as `"x86_64-windows"`; none: this machine's.

    **Returns:**

    The names of the binaries inside the FMU.

    **Raises:**

    - `ModelError` for a file that is no FMU, has no such sources, or does not compile, and without a compiler.
    - `MissingPackage` for a binary of another machine's platform, without Zig.
    """
    if not path.is_file():
        raise ModelError(f"there is no file '{path}'")
    if not zipfile.is_zipfile(path):
        raise ModelError(f"'{path}' is not an FMU: an FMU is a zip file")
    try:
        with zipfile.ZipFile(path) as file:
            contents = {name: file.read(name) for name in file.namelist() if not name.endswith("/")}
    except (zipfile.BadZipFile, zlib.error) as error:
        raise ModelError(f"'{path}' is damaged: {error}") from None
    version, identifier, source = _build(path, contents)
    try:
        files = {n.removeprefix("sources/"): t.decode() for n, t in contents.items() if _beside_source(n)}
    except UnicodeDecodeError:
        raise ModelError(f"'{path}': a file of its sources is not text in UTF-8") from None
    added = {}
    for platform in dict.fromkeys(platforms or [this_platform()]):
        command = compiler_for(platform)
        if command is None:
            raise ModelError(f"there is no C compiler for {platform} on this machine: install one, or the extra fmi")
        ending = TARGETS.get(platform, ("", ".so"))[1]
        folder = platform if version == 3 else FOLDERS_OF_FMI_2.get(platform, platform)
        added[f"binaries/{folder}/{identifier}{ending}"] = shared_library(command, platform, files, source)
    path.write_bytes(zipped(contents | added))
    return list(added)


def _beside_source(name: str) -> bool:
    return name.startswith("sources/") and name.count("/") == 1 and name.endswith((".c", ".h"))


def _build(path: Path, contents: dict[str, bytes]) -> tuple[int, str, str]:
    """The version of FMI, the identifier of the model, and the C file to compile."""
    root = _xml(path, contents, "modelDescription.xml")
    if root is not None and root.get("fmiVersion", "").startswith("2."):
        version, configurations = 2, [e for e in root if e.find("SourceFiles") is not None][:1]
        sources = [e.get("name", "") for one in configurations for e in one.iter("File")]
        return version, *_checked(path, contents, configurations, sources, 0)
    root = _xml(path, contents, "sources/buildDescription.xml")
    if root is None:
        raise ModelError(f"'{path}' has no sources/buildDescription.xml: export it with its sources")
    configurations = root.findall("BuildConfiguration")
    settings = [e.tag for e in root.iter() if e.tag in ("PreprocessorDefinition", "IncludeDirectory")]
    sources = [e.get("name", "") for e in root.iter("SourceFile")]
    return 3, *_checked(path, contents, configurations, sources, len(settings))


def _xml(path: Path, contents: dict[str, bytes], name: str) -> ElementTree.Element | None:
    """A file's XML, if there is one."""
    try:
        return ElementTree.fromstring(contents[name]) if name in contents else None
    except ElementTree.ParseError as error:
        raise ModelError(f"'{path}': {name} is not XML: {error}") from None


def _checked(
    path: Path, contents: dict[str, bytes], configurations: Sequence[ElementTree.Element], sources: Sequence[str],
    settings: int,
) -> tuple[str, str]:  # fmt: skip
    """The identifier and the file of a build."""
    if len(configurations) != 1 or len(sources) != 1 or settings:
        raise ModelError(
            f"'{path}': its build has {len(configurations)} configurations, {len(sources)} source files and "
            f"{settings} settings; only one configuration with one file and no settings is compiled here"
        )
    identifier, source = configurations[0].get("modelIdentifier", ""), sources[0]
    if not (identifier.isascii() and identifier.isidentifier()):
        raise ModelError(f"'{path}': modelIdentifier '{identifier}' is not a name of C")
    if not _beside_source(f"sources/{source}") or f"sources/{source}" not in contents:
        raise ModelError(f"'{path}': the source file '{source}' is not in its folder sources")
    return identifier, source
