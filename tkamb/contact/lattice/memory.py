"""What a solver remembers of its last results, to start the next one nearer."""

import weakref
from collections import OrderedDict
from dataclasses import dataclass
from threading import Lock

from tkamb.contact.lattice.region import Region
from tkamb.contact.result import ContactResult
from tkamb.geometry.frames import Array

MOST_KEPT = 4


@dataclass(frozen=True, eq=False)
class Remembered:
    """Where a solution ended.

    Args:
        lost: (n, 3) h, N, or None for a linear material.
        moved: (c, 3) m, displacement of the contact nodes that were candidates, else 0.
        depth: m, how far the femoral component went below the lowest contact node.
        region: outside of which `lost` is zero, or None.
    """

    lost: Array | None
    moved: Array
    depth: float
    region: Region | None


class Memory:
    """The last few results' solver fields, found again by the result itself.

    Nothing here changes an answer beyond the tolerance: it only shortens the way.
    """

    def __init__(self) -> None:
        self._kept: OrderedDict[int, tuple[weakref.ref[ContactResult], Remembered]] = OrderedDict()
        self._lock = Lock()

    def keep(self, result: ContactResult, content: Remembered) -> None:
        """Remember the content of a result."""
        with self._lock:
            self._kept[id(result)] = (weakref.ref(result), content)
            while len(self._kept) > MOST_KEPT:
                self._kept.popitem(last=False)

    def of(self, result: ContactResult | None) -> Remembered | None:
        """Return what was kept of a result, or None."""
        with self._lock:
            found = self._kept.get(id(result))
        return found[1] if found is not None and found[0]() is result else None
