"""What a solver remembers of its last results, to start the next one nearer."""

import weakref
from collections import OrderedDict
from threading import Lock
from typing import Any

from tkamb.contact.model import ContactResult

MOST_KEPT = 4


class Memory:
    """The last few results' solver fields, found again by the result itself.

    Nothing here changes an answer beyond the tolerance: it only shortens the way.
    """

    def __init__(self) -> None:
        self._kept: OrderedDict[int, tuple[weakref.ref[ContactResult], Any]] = OrderedDict()
        self._lock = Lock()

    def keep(self, result: ContactResult, content: Any) -> None:
        """Remember the content of a result."""
        with self._lock:
            self._kept[id(result)] = (weakref.ref(result), content)
            while len(self._kept) > MOST_KEPT:
                self._kept.popitem(last=False)

    def of(self, result: ContactResult | None) -> Any:
        """Return what was kept of a result, or None."""
        with self._lock:
            reference, content = self._kept.get(id(result), (None, None))
        return content if reference is not None and reference() is result else None
