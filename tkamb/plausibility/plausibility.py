"""All questions of a case, and what they say about a frame."""

from typing import TYPE_CHECKING

import numpy as np

from tkamb.plausibility.ground import (
    direction_questions,
    foot_questions,
    load_questions,
    posture_questions,
)
from tkamb.plausibility.implant import implant_questions
from tkamb.plausibility.movement import motion_questions, sample_questions
from tkamb.plausibility.question import Question, some
from tkamb.plausibility.segments import segment_questions

if TYPE_CHECKING:
    from tkamb.equilibrium.mechanics import FrameLoads, Mechanics

FORCE_BW = 8.0
"""BW: instrumented knees measured 5 to 6 at most, in stumbling (Bergmann et al. 2014)."""


class Plausibility:
    """The questions of a case.

    Args:
        mechanics: its body side, prepared.

    Attributes:
        questions: all of them.
    """

    def __init__(self, mechanics: "Mechanics") -> None:
        self._mechanics = mechanics
        case = mechanics.case
        found = [
            *segment_questions(case),
            *motion_questions(case),
            *sample_questions(case),
            *load_questions(case),
            *foot_questions(case),
            *direction_questions(case),
            *posture_questions(case),
            *implant_questions(case),
        ]
        if case.ligaments or case.muscles:
            found += _line_questions(mechanics)
        self.questions: tuple[Question, ...] = tuple(found)

    def flags(self, k: int, body: "FrameLoads") -> list[str]:
        """Return the words for the status of frame k."""
        words = [
            question.flag for question in self.questions if question.flag and question.concerns(k)
        ]
        if self._mechanics.ligaments:
            from tkamb.plausibility.lines import STRAIN, torn_bundles

            if torn := torn_bundles(self._mechanics.ligaments, body.geometry.tensions):
                words.append(f"ligament strain above {100 * STRAIN:.0f} %: {some(torn)}")
        force = float(np.linalg.norm(body.loads.contact_force)) / self._mechanics.case.body_weight
        if force > FORCE_BW:
            words.append(
                f"contact force of {force:.1f} BW, more than any knee was measured to bear"
            )
        return words


def _line_questions(mechanics: "Mechanics") -> list[Question]:
    from tkamb.plausibility import lines

    case = mechanics.case
    found = [*lines.attachment_questions(case), *lines.stiffness_questions(case)]
    poses = mechanics.recorded_poses()
    found += lines.extensor_questions(case, poses)
    if not (case.scene.contact and case.scene.contact.released):
        strains = {b.name: b.strain(b.length(poses)) for b in mechanics.ligaments}
        found += lines.strain_questions(mechanics.ligaments, strains, case.motion.time)
    return found
