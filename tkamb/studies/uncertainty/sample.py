"""One sample of a scene: the varied case through body and contact, its results as one array.

Meshes, their search trees and the prepared contact are those of the scene as given. The only
varying input that changes them is the insert's modulus, for which the contact is prepared again.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from tkamb.errors import TkambError
from tkamb.geometry.frames import Array
from tkamb.io.scene import Scene
from tkamb.io.scene.case import Case, load_case
from tkamb.knee.frame_contact import FrameContact
from tkamb.run.contact_side import ContactSide
from tkamb.run.mechanics import Mechanics
from tkamb.run.read_scene import SharedState, contact_side, mechanics_of
from tkamb.run.status import failures_of, frame_status
from tkamb.run.tabulate import frame_row
from tkamb.studies.uncertainty.correlation import correlation_root
from tkamb.studies.uncertainty.inputs import (
    Draw,
    VariedInput,
    pose_names,
    uncertainty_of,
    varied_inputs,
)
from tkamb.studies.uncertainty.sampling import Point, noise_of_point
from tkamb.studies.uncertainty.varied_case import thinnable, thinned, varied_case, varied_muscles


@dataclass(frozen=True, eq=False)
class Sample:
    """Results of one sample.

    Args:
        values: (names, frames) in the order asked for; NaN where a frame failed or has no number.
        problems: (frames,) text, why the frame failed; empty where it did not.
        errors: (frames, d) the inputs' errors in their standard deviations.
    """

    values: Array
    problems: np.ndarray
    errors: Array

    @property
    def failed(self) -> np.ndarray:
        """Whether each frame failed (frames,)."""
        return self.problems != ""


class Sampler:
    """Computes samples of one scene.

    Args:
        scene: the scene.
        frames: of the motion.
        names: columns of results.csv that are wanted.

    Attributes:
        names: as given.
        case: as given.
        inputs: that vary.

    Raises:
        TkambError: whatever is wrong with the scene.
    """

    def __init__(self, scene: Scene, frames: range, names: Sequence[str]) -> None:
        whole = load_case(scene)
        self._time = whole.motion.time
        self._chosen, self.names = frames, list(names)
        self.case, self._frames = (
            (thinned(whole, frames), range(len(frames))) if thinnable(whole) else (whole, frames)
        )
        self.inputs: tuple[VariedInput, ...] = varied_inputs(self.case)
        self._root = correlation_root(
            uncertainty_of(self.case).correlation, [one.name for one in self.inputs]
        )
        self._split = self.case.split
        self._mechanics = mechanics_of(self.case)
        contact = self.case.scene.contact
        self._side = contact_side(self.case, self._mechanics) if contact else None

    def draw(self, point: Point) -> Draw:
        """Return what the sample at a point makes of the inputs."""
        table = uncertainty_of(self.case)
        count = len(pose_names(self.inputs))  # they come first
        # on the whole recording's clock: the same whichever frames are asked for
        per_frame = noise_of_point(point, range(count), self._time, table.correlation_s, table.seed)
        if len(self.case.motion.time) < len(self._time):
            per_frame = per_frame[list(self._chosen)]
        if point.noise_of is None:  # one input at a time: correlated inputs stay
            return Draw(self.inputs, point.normal, per_frame, 1.0)
        noise = per_frame @ self._root[:count, :count].T
        return Draw(self.inputs, self._root @ point.normal, noise, table.constant_share)

    def __call__(self, number: int, point: Point) -> Sample:
        """Return the sample at a point; a frame begins its search at the one before.

        Args:
            number: of the sample; workers need it, but it does not change the sample.
            point: where it lies.
        """
        draw = self.draw(point)
        errors = draw.standardised()[list(self._frames)]
        values = np.full((len(self.names), len(self._frames)), np.nan)
        try:
            case = self._varied(draw)
            contact = self._mechanics.knee.contact
            if contact is not None:
                table = case.scene.contact
                assert table is not None
                contact = contact.changed(table.friction, draw.factor("young_modulus"))
            mechanics, side = mechanics_of(case, self._shared(draw), contact=contact), None
            if self._side is not None:
                side = contact_side(case, mechanics, sensitivity=False, post=self._side.post)
        except TkambError as error:  # the varied inputs cannot be used: no frame has a number
            return Sample(values, np.full(len(self._frames), str(error)), errors)
        problems: list[str] = []
        before: list[FrameContact] = []
        for column, k in enumerate(self._frames):
            row, problem = _frame(case, mechanics, side, k, before)
            problems.append(problem)
            if not problem:
                values[:, column] = [row.get(name, np.nan) for name in self.names]
        return Sample(values, np.array(problems), errors)

    def _shared(self, draw: Draw) -> SharedState:
        nominal = self._mechanics
        muscles, contact = varied_muscles(nominal.muscles, draw), nominal.knee.contact
        pair = None if contact is None else contact.pair
        return SharedState(pair, muscles, nominal.extensor, self._frames)

    def _varied(self, draw: Draw) -> Case:
        case = varied_case(self.case, draw)
        case.__dict__["split"] = self._split  # of the same femoral component: found once
        return case


class BandWorker:
    """Computes samples; it is prepared before the columns with a band are known.

    Args:
        scene: the scene.
        frames: of the motion.
    """

    def __init__(self, scene: Scene, frames: range) -> None:
        self._scene, self._frames = scene, frames
        self._sampler: Sampler | None = None
        with suppress(TkambError):  # the run of the scene as given reports the error
            self._sampler = Sampler(scene, frames, ())

    def __call__(self, number: int, job: tuple[Point, list[str]]) -> Sample:
        """Return the sample at a point, with the columns of these names."""
        point, names = job
        sampler = self._sampler or Sampler(self._scene, self._frames, names)
        sampler.names = names
        return sampler(number, point)


def _frame(
    case: Case,
    mechanics: Mechanics,
    side: ContactSide | None,
    k: int,
    before: list[FrameContact],
) -> tuple[dict[str, Any], str]:
    """Return frame k's row of results.csv and why it failed; its contact joins those before it."""
    contact = None
    if side is None:
        body = mechanics.frame(k)
    else:
        body, contact = side.frame(k, before)
        before.append(contact)
        del before[:-2]
    row = frame_row(case, k, body, contact, {}, frame_status(case, k, body, contact))
    return row, "; ".join(failures_of(body, contact))
