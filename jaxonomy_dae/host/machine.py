"""What compiled programs take of a machine: memory mappings and memory.

XLA maps each kernel of a program by itself, code and data apart: a gradient with its 400 kernels takes some 1,300
mappings. Linux allows a process 65,530 (`vm.max_map_count`); where LLVM gets no more, the process dies.
"""

import ctypes
import os
from pathlib import Path
from typing import NamedTuple

MAPS, ALLOWED = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")
STATUS, MEMORY = Path("/proc/self/statm"), Path("/proc/meminfo")
GROUP = Path("/sys/fs/cgroup")  # the limits of a container


class Use(NamedTuple):
    """An amount in use and the amount allowed."""

    used: int
    allowed: int

    @property
    def share(self) -> float:
        return self.used / self.allowed


def mappings() -> Use | None:
    """The memory mappings of this process; None where nothing is known of them, and nothing limits them."""
    try:
        return Use(MAPS.read_bytes().count(b"\n"), int(ALLOWED.read_text()))
    except (OSError, ValueError):
        return None


def memory() -> Use | None:
    """The memory that this process holds, of all that it could have (bytes); None where the system does not say."""
    try:
        resident = int(STATUS.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
        # MemAvailable counts what the system can take back from its caches; MemFree does not.
        fields = dict(line.split(":", 1) for line in MEMORY.read_text().splitlines())
        available = int(fields["MemAvailable"].split()[0]) * 1024
    except (OSError, ValueError, KeyError, IndexError):
        return None
    try:  # the word "max" where a container has no limit
        left = int((GROUP / "memory.max").read_text()) - int((GROUP / "memory.current").read_text())
    except (OSError, ValueError):
        left = available
    return Use(resident, resident + max(min(available, left), 0))


def return_memory() -> None:
    """Hands freed memory back to the system, which glibc keeps otherwise: of the 460 MB that compiling gradients of a
    model with two states left behind, all."""
    try:
        ctypes.CDLL(None).malloc_trim(0)
    except (OSError, AttributeError, TypeError):  # another C library
        pass
