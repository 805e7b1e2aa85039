"""A question: what of a declared case is possible but unlikely, with the likely mistake.

What is impossible is refused where it is read. What is only unlikely is run, but nobody shall read
"ok" beside it: a question stands in the summary, on the report and in the status of every frame
that it concerns. The limits say where they come from. They are wide: they separate mistakes,
which err by factors and signs, from rare patients.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Question:
    """What is unlikely about a case.

    Args:
        text: a plain sentence that ends with the likely mistake as a question.
        flag: a few words for the status of the frames; empty where each frame's own forces say.
        frames: (f,) which frames it concerns; None: all.
    """

    text: str
    flag: str
    frames: NDArray[np.bool_] | None = None

    def concerns(self, k: int) -> bool:
        """Say whether it concerns frame k."""
        return self.frames is None or bool(self.frames[k])


def some(names: Sequence[str], most: int = 3) -> str:
    """Return the first few names, and how many more there are."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
