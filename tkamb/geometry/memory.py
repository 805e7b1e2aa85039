"""Memory that a process uses, and memory that is still available to it."""

import ctypes
import gc
import math
import os
import resource
import sys
from contextlib import suppress
from pathlib import Path

GROUP = Path("/sys/fs/cgroup")
STATISTICS = Path("/proc/meminfo")
OWN = Path("/proc/self/statm")


def peak_rss(process: int | None = None) -> float:
    """Return the largest resident memory of a process so far, MB (1e6 bytes).

    /proc is read where it exists, because `getrusage` includes the parent's memory. NaN for another
    process without an entry there. Default: this process.
    """
    with suppress(OSError):
        status = Path(f"/proc/{process or os.getpid()}/status").read_text()
        for line in status.splitlines():
            if line.startswith("VmHWM"):
                return float(line.split()[1]) * 1024 / 1e6
    if process is not None:
        return math.nan
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6


def available_memory() -> float:
    """Return the number of bytes that this process may still allocate.

    It is the smallest of the machine's available memory without swapping (if unknown, its memory),
    the rest of the control group's limit (cgroup 2 or 1), and that of the limit of address space;
    inf without any.
    """
    return min(_machine(), _group(), _address_space())


def _machine() -> float:
    """Return bytes, including caches that can be dropped."""
    try:
        for line in STATISTICS.read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return 1024.0 * float(line.split()[1])
    except OSError:
        pass  # not Linux
    try:
        return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (ValueError, OSError):
        return float("inf")


def _group() -> float:
    """Return the rest of the control group's limit, bytes, or inf."""
    pairs = (
        ("memory.max", "memory.current"),
        ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes"),
    )
    for limit, used in pairs:
        try:
            most, used_text = ((GROUP / name).read_text().strip() for name in (limit, used))
            return float("inf") if most == "max" else float(most) - float(used_text)
        except (OSError, ValueError):
            continue
    return float("inf")


def _address_space() -> float:
    """Return the rest of `ulimit -v`, bytes, or inf."""
    soft, _ = resource.getrlimit(resource.RLIMIT_AS)
    if soft == resource.RLIM_INFINITY:
        return float("inf")
    try:
        pages = int(OWN.read_text().split()[0])
    except (OSError, ValueError):
        return float(soft)
    return float(soft - pages * os.sysconf("SC_PAGE_SIZE"))


def give_back() -> None:
    """Collect reference cycles, and return freed memory to the system (with glibc).

    A knee with its meshes has reference cycles, which Python collects by number, not by size.
    Eighteen knees in turn used 0.73 GB, but 0.38 GB with a collection after each. glibc keeps freed
    memory between used blocks.
    """
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
