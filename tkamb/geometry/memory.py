"""Memory that a process uses, and that it may still use by the machine and its limits."""

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
    """Return the largest resident memory of a process so far, MB (1e6 bytes); default: this one.

    Asked of /proc where there is one: `getrusage` counts what the parent held when it started
    the process, which is not the process's own. NaN for another process that is not known.
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
    """Return the bytes that this process may still take.

    The least of: what the machine has left without swapping, what the limit of its control
    group leaves (cgroup 2 or 1), and what its own limit of address space leaves. Where none of
    them is known, all of the machine's memory, or inf.
    """
    return min(_machine(), _group(), _address_space())


def _machine() -> float:
    """Return what the machine has left, what it can drop from its caches counted."""
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
    """Return what the control group's limit leaves; inf without one."""
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
    """Return what the limit of address space (`ulimit -v`) leaves; inf without one."""
    soft, _ = resource.getrlimit(resource.RLIMIT_AS)
    if soft == resource.RLIM_INFINITY:
        return float("inf")
    try:
        pages = int(OWN.read_text().split()[0])
    except (OSError, ValueError):
        return float(soft)
    return float(soft - pages * os.sysconf("SC_PAGE_SIZE"))


def give_back() -> None:
    """Free what only refers to itself, and return freed memory to the system where that is known.

    A knee with its meshes has reference cycles. Python collects them by the number of objects, not
    by their size: eighteen knees one after another held 0.73 GB, but at most 0.38 GB when collected
    after each. In addition, glibc does not return freed memory that lies between used blocks.
    """
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
