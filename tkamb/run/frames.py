"""Computes the frames of a case, one by one: a row of the results from both sides of each."""

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

from tkamb.geometry.frames import Array
from tkamb.io.scene import Scene
from tkamb.io.scene.case import Case, load_case
from tkamb.run.plausibility.plausibility import Plausibility
from tkamb.run.read_scene import contact_side, mechanics_of
from tkamb.run.shards import Row
from tkamb.run.status import frame_status
from tkamb.run.tabulate import frame_row
from tkamb.run.workers import WorkerPool

if TYPE_CHECKING:
    from tkamb.knee.frame_contact import FrameContact
    from tkamb.knee.slip import CondyleSlip
    from tkamb.run.contact_side import ContactSide


@dataclass(frozen=True)
class FrameLoopSettings:
    """How frames are shared and which contacts are kept as guesses."""

    kept_contacts: int = 20
    """How many contacts are kept as guesses for the next. Chosen: older ones are farther away than
    a new search begins."""
    frames_per_chunk: int = 10
    """Frames that a worker computes in a row; the first of them has no guess from the one before.
    Chosen: the same for any number of workers, so that their number changes no answer."""


FRAME_LOOP = FrameLoopSettings()


Finished = tuple[int, Row, dict[str, Array] | None]
"""Number, row and the contact's arrays (`tkamb.run.recall`; None if it failed or is not there)."""


class FrameSolver:
    """Computes the frames of a case.

    Args:
        case: the scene with its files read.
        frames: those that are asked for; None: any may be.
        slips: those of another solver of this case; they are then not computed again.

    Attributes:
        mechanics: the body side.
        slips: side -> rolling and slipping of the recorded motion.
        before: contacts of the last frames, guesses for the next.

    Raises:
        InputError: whatever is wrong with the input.
    """

    def __init__(
        self, case: Case, frames: range | None = None, slips: "dict[str, CondyleSlip] | None" = None
    ) -> None:
        self._case = case
        self.mechanics = mechanics_of(case)
        self.plausibility = Plausibility(case, self.mechanics)
        last = max(frames or range(len(case.motion.time)))
        if slips is None:  # of the recorded motion: released coordinates make another one
            released = case.scene.contact and case.scene.contact.released
            slips = {} if released else self.mechanics.slips(last)
        self.slips = slips
        self.before: list[FrameContact] = []

    def solve(self, k: int) -> Finished:
        """Return frame k."""
        contact = arrays = None
        if self.side is None:
            body = self.mechanics.frame(k)
        else:
            from tkamb.run.recall import contact_arrays

            body, contact = self.side.frame(k, self.before)
            self._keep(contact)
            arrays = contact_arrays(contact, body.geometry)
        doubts = self.plausibility.flags(k, body)
        status = frame_status(self._case, k, body, contact, doubts)
        return k, frame_row(self._case, k, body, contact, self.slips, status), arrays

    def _keep(self, contact: "FrameContact") -> None:
        """Keep a contact; only the last that was found keeps its warm start, which is large."""
        if contact.result is not None:
            self.before = [replace(each, start=None) for each in self.before]
        self.before.append(contact)
        del self.before[: -FRAME_LOOP.kept_contacts]

    @cached_property
    def side(self) -> "ContactSide | None":
        """The contact side, prepared when it is first asked for; None without [contact]."""
        if self._case.scene.contact is None:
            return None
        return contact_side(self._case, self.mechanics)


Chunk = tuple[list[int], "dict[str, CondyleSlip]"]
"""Successive frames, and the slips of the recorded motion (`FrameSolver`)."""


@contextmanager
def _said_already() -> Iterator[None]:
    """Print no warnings: the process that hands out the work has printed them already."""
    log = logging.getLogger("tkamb")
    usual = log.level
    log.setLevel(logging.ERROR)
    try:
        yield
    finally:
        log.setLevel(usual)


class ChunkSolver:
    """The work of a worker process: reads the scene once, and computes chunk after chunk.

    Its contact side waits for the first chunk: by then the process that hands out the work has
    prepared its own, and has put what takes long into the cache.
    """

    @_said_already()
    def __init__(self, scene: Scene) -> None:
        self._solver = FrameSolver(load_case(scene), slips={})

    @_said_already()
    def __call__(self, number: int, chunk: Chunk) -> list[Finished]:
        """Return the frames of a chunk."""
        frames, self._solver.slips = chunk
        self._solver.before.clear()
        return [self._solver.solve(k) for k in frames]


def finished_in_order(
    team: WorkerPool, slips: "dict[str, CondyleSlip]", indices: range, remaining: Sequence[int]
) -> Iterator[Finished]:
    """Yield frames over worker processes, in order.

    Args:
        team: of workers whose task is a `ChunkSolver`.
        slips: of the recorded motion, see `FrameSolver`.
        indices: all frames of the run, which make its chunks.
        remaining: frames that are not computed yet.

    Raises:
        ComputationError: a worker was killed.
    """
    chunks: dict[int, Chunk] = {}
    for k in remaining:
        chunks.setdefault(indices.index(k) // FRAME_LOOP.frames_per_chunk, ([], slips))[0].append(k)
    early: dict[int, list[Finished]] = {}
    turn = iter(chunks)
    expected: Any = next(turn, None)
    for number, frames in team.answers(list(chunks.items())):
        early[number] = frames
        while expected in early:
            yield from early.pop(expected)
            expected = next(turn, None)
