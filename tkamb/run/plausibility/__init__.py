"""Plausibility of a case: a question for each possible but unlikely input.

An impossible input is refused when it is read. A case with an unlikely one is computed, and a
question names the likely mistake in summary, report and the status of the frames. The limits are
wide, since mistakes such as wrong signs and units exceed them by far.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Question:
    """A question about unlikely input of a case.

    Args:
        text: sentence with the unlikely input and the likely mistake as a question.
        flag: short text for the status of the frames; empty: no flag.
        frames: mask of the frames concerned, (f,); None: all frames.
    """

    text: str
    flag: str
    frames: NDArray[np.bool_] | None = None

    def concerns(self, k: int) -> bool:
        """Return whether the question concerns frame k."""
        return self.frames is None or bool(self.frames[k])


def some(names: Sequence[str], most: int = 3) -> str:
    """Return the first `most` names and the number of the remaining names, as text."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
