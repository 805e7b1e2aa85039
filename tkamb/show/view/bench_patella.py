"""The released patella of `tkamb live`: its equilibrium under a tension of the quadriceps.

The femur has the pose of the pressed knee. The patella does not change this pose, because the bench
prescribes the load of the contact. If the user moves a component on its bone, the button presses on
the moved component, and the patella's joint, the origins of the heads and the ends of the ligaments
stay with the bones. The outline that the heads wrap and the plane between the button's facets move
with the component.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from tkamb.errors import ComputationError, InputError
from tkamb.geometry.frames import KNEE_COORDINATES, Array, inverse, knee_coordinates, transform
from tkamb.io.scene.case import Case
from tkamb.knee.canonical import KneePose
from tkamb.knee.found_patella import FoundPatella
from tkamb.knee.knee import Knee
from tkamb.knee.ligaments import Ligament
from tkamb.knee.patella_equilibrium import find_at
from tkamb.knee.wrapping import TautPath
from tkamb.run.read_scene import recording_of
from tkamb.run.tabulate import button_row, patella_row
from tkamb.show.view.bench import BenchRequest
from tkamb.show.view.drawing import PressureMap, Solid, Strand
from tkamb.show.view.lines import released_strands
from tkamb.show.view.solids import patella_solids
from tkamb.units import MEGAPASCAL

FLEXION = KNEE_COORDINATES.index("flexion")
HIDDEN = np.full((4, 4), np.nan)


@dataclass(frozen=True, eq=False)
class ShownPatella:
    """The patella in one state of the bench, insert frame of the bench.

    Args:
        numbers: column of results.csv -> value; NaN without an equilibrium.
        words: flags, or why there is no equilibrium.
        pose: pose_patella_in_insert, shape (4, 4); NaN without an equilibrium.
        strands: heads of the quadriceps and ligaments at the patella, one frame.
        map: pressure of the button, one frame, in the button frame.
        button: pose_button_in_insert, shape (4, 4); NaN without an equilibrium.
    """

    numbers: dict[str, float]
    words: tuple[str, ...]
    pose: Array
    strands: tuple[Strand, ...]
    map: PressureMap
    button: Array


class BenchPatella:
    """The released patella of a knee on the bench. The last equilibrium is the initial guess.

    Args:
        knee: a knee with a released patella.
        q: recorded configurations, shape (f, nq). The patella of the one with the nearest flexion
            is the first guess, if the model has a patella.
        placement: pose of the knee's insert frame in that of the bench, shape (4, 4).
    """

    def __init__(self, knee: Knee, q: Array, placement: Array) -> None:
        assert knee.patella is not None and knee.button_contact is not None
        self.knee, self.method, self._placement = knee, knee.patella, placement
        self._state = knee.button_contact.contact.state
        self._data = knee._kinematic_data()
        self._recorded = [
            one
            for one in (knee._kinematics(self._data, each) for each in q)
            if one.patella is None or np.isfinite(one.patella).all()
        ]
        if not self._recorded:
            raise InputError(
                "has no pose of the patella", "live: q", "give one in which it is found"
            )

    @cached_property
    def hidden(self) -> ShownPatella:
        """The patella without an equilibrium."""
        return self._shown(None, self.method.carried, {})

    def forget(self) -> None:
        """Forget the last equilibrium."""
        self._data.patella_coordinates = None

    def solids(self) -> tuple[Solid, ...]:
        """Return patella and button in the patella's frame."""
        return patella_solids(self.knee, np.eye(4)[None])

    def tubes(self) -> tuple[Strand, ...]:
        """Return the strands of `hidden` with room for any path.

        A path of a head has at most the corners of the outline, and each end twice.
        """
        rows = np.zeros(4 if self.method.outline is None else len(self.method.outline) + 4, int)
        return (
            tuple(
                replace(one, points=one.points[:, rows], colours=one.colours[:, rows])
                for one in self.hidden.strands[: len(self.method.heads)]
            )
            + self.hidden.strands[len(self.method.heads) :]
        )

    def at(self, request: BenchRequest, pose: Array) -> ShownPatella:
        """Return the patella at pose_femoral_in_insert (4, 4) under the tension of a request."""
        try:
            return self._in_equilibrium(request, inverse(self._placement) @ pose)
        except ComputationError as error:
            return replace(self.hidden, words=(f"patella: {error.what}",))

    def _in_equilibrium(self, request: BenchRequest, pose: Array) -> ShownPatella:
        """Return the patella at a pose (4, 4) in the knee's insert frame.

        Raises:
            ComputationError: there is no equilibrium, or the patella is slack.
        """
        if not request.quadriceps_N:
            raise ComputationError("slack, because the quadriceps does not pull")
        flexion = knee_coordinates(pose)[FLEXION]
        nearest = min(self._recorded, key=lambda one: abs(one.coordinates[FLEXION] - flexion))
        body, patella = find_at(
            self.knee,
            KneePose(pose, nearest.patella),
            self.method.head_tensions(request.quadriceps_N),
            self.method.released,
            self._data,
            request.bones(self.knee.chain.insert_in_tibia @ inverse(self._placement)),
        )
        if patella.press is None:
            raise ComputationError(patella.problem.removeprefix("patella: "))
        if not any(patella.tensions[one.name] for one in body.lines if "tibia" in one.links):
            raise ComputationError("no ligament to the tibia is taut")
        return self._shown(patella, body.lines, body.head_paths(patella.balance.coordinates))

    def _shown(
        self,
        patella: FoundPatella | None,
        bundles: Sequence[Ligament],
        paths: Mapping[str, TautPath],
    ) -> ShownPatella:
        heads = [head.name for head in self.method.heads]
        strands = released_strands(heads, bundles, [paths], [patella])
        press = None if patella is None else patella.press
        count = len(self._state.points)
        pressure, gap, pose, button = np.zeros(count), np.ones(count), HIDDEN, HIDDEN
        words: tuple[str, ...] = ()
        if patella is not None and press is not None and press.contact is not None:
            pressure, gap = press.contact.pressure / MEGAPASCAL, press.contact.gap
            pose = self._placement @ patella.poses["patella"]
            button, words = self._placement @ press.pose, (*patella.flags, *press.flags)
        return ShownPatella(
            button_row(press) | patella_row(bundles, patella),
            words,
            pose,
            tuple(replace(one, points=transform(self._placement, one.points)) for one in strands),
            PressureMap(self._state.points, self._state.triangles, pressure[None], gap[None]),
            button,
        )


def patella_of(case: Case) -> BenchPatella | None:
    """Return the released patella of a case; None: there is none."""
    if case.scene.patella is None or not case.scene.patella.released:
        return None
    case = replace(case, scene=case.scene.model_copy(update={"muscles": None}))
    recording = recording_of(case, near=True)
    return BenchPatella(recording.knee, recording.motion.q, np.eye(4))
