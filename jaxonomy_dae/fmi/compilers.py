"""Compilers of C, and the shared libraries that they make for a platform."""

import importlib.util
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from ..base.errors import MissingPackage, ModelError

# Platforms as the standard names them, with their targets for Zig and the endings of shared libraries.
TARGETS = {
    "x86_64-linux": ("x86_64-linux-gnu.2.17", ".so"),
    "aarch64-linux": ("aarch64-linux-gnu.2.17", ".so"),
    "x86_64-windows": ("x86_64-windows-gnu", ".dll"),
    "x86_64-darwin": ("x86_64-macos", ".dylib"),
    "aarch64-darwin": ("aarch64-macos", ".dylib"),
    "wasm32-wasi": ("wasm32-wasi", ".wasm"),
}
# Folders of binaries in FMI 2.0, which knows fewer platforms.
FOLDERS_OF_FMI_2 = {"x86_64-linux": "linux64", "x86_64-windows": "win64", "x86_64-darwin": "darwin64"}
# Never -ffast-math: it removes tests for not-a-number and moves events. Without contraction to multiply-add, all
# platforms compute the same numbers.
FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-fvisibility=hidden", "-fPIC", "-shared")


def this_platform() -> str:
    """The platform of this machine, as the standard names it."""
    machine = {"AMD64": "x86_64", "arm64": "aarch64"}.get(platform.machine(), platform.machine())
    system = {"Linux": "linux", "Windows": "windows", "Darwin": "darwin"}.get(platform.system(), "unknown")
    return f"{machine}-{system}"


def compiler_for(target: str) -> list[str] | None:
    """The command of a compiler for a platform; None if there is none for this machine's own.

    **Raises:**

    - `ModelError` for a platform that is not known.
    - `MissingPackage` for another machine's, without Zig.
    """
    has_zig = importlib.util.find_spec("ziglang") is not None
    if target == this_platform():
        own = next((found for name in ("cc", "gcc", "clang") if (found := shutil.which(name))), None)
        if own is not None:
            return [own]
    elif target not in TARGETS:
        raise ModelError(f"platforms: '{target}' is not known; there are {', '.join(TARGETS)}")
    elif not has_zig:
        raise MissingPackage(
            f"a binary for {target} needs the compiler of the package ziglang: pip install ziglang, or leave it out of "
            "platforms: the sources are in the FMU"
        )
    if not has_zig or target not in TARGETS:
        return None
    return [sys.executable, "-m", "ziglang", "cc", "-target", TARGETS[target][0]]


def shared_library(
    command: Sequence[str], target: str, files: Mapping[str, str], source: str, flags: Sequence[str] = FLAGS
) -> bytes:
    """Compiles a C file, with others that it includes, to a shared library.

    **Raises:**

    - `ModelError` with what the compiler says.
    """
    ending = TARGETS.get(target, ("", ".so"))[1]
    with tempfile.TemporaryDirectory() as folder:
        for name, text in files.items():
            Path(folder, name).write_text(text)
        more = ["-lm"] if ending != ".dll" else []
        if ending == ".so":  # no identity made of paths, which would differ from run to run, and no names of functions
            more += ["-Wl,--build-id=none", "-s"]
        if ending == ".wasm":  # a library whose functions the host calls, and that is loaded where it is put
            flags = [f for f in flags if f not in ("-fPIC", "-shared")]
            more += ["-mexec-model=reactor", "-rdynamic", "-s"]
        # Names without a folder: paths would get into the library.
        arguments = [*command, *flags, source, "-o", f"model{ending}", *more]
        done = subprocess.run(arguments, cwd=folder, capture_output=True, text=True)
        if done.returncode:
            raise ModelError(f"the compiler {command[0]} failed:\n{done.stderr[-2000:]}")
        return Path(folder, f"model{ending}").read_bytes()
