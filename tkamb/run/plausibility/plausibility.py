"""All questions of a case, and their flags for the status of a frame."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tkamb.errors import InputError
from tkamb.io.scene.case import Case
from tkamb.run.plausibility import Question, lines, some
from tkamb.run.plausibility.ground import (
    direction_questions,
    foot_questions,
    load_questions,
    posture_questions,
    step_questions,
)
from tkamb.run.plausibility.movement import (
    drift_questions,
    marker_questions,
    motion_questions,
    sample_questions,
    sign_questions,
)
from tkamb.run.plausibility.segments import implant_questions, segment_questions

if TYPE_CHECKING:
    from tkamb.knee.frame import Frame
    from tkamb.run.recording import Recording

ANSWERS = "[output] answers"


@dataclass(frozen=True)
class ForceLimitSettings:
    """Limits of plausible contact forces."""

    max_force_BW: float = 8.0
    """BW: largest contact force. Instrumented knees measured at most 5 to 6, in stumbling (Bergmann
    et al. 2014)."""


FORCE_LIMITS = ForceLimitSettings()


class Plausibility:
    """The questions of a case.

    Attributes:
        questions: questions without an answer in the scene.
    """

    def __init__(self, case: Case, recording: "Recording") -> None:
        self._case = case
        stretch = 1.0 + lines.LINE_LIMITS.max_strain
        self._tear = {
            bundle.name: float(bundle.force(stretch * bundle.slack_length))
            for bundle in recording.ligaments
        }
        """Bundle -> tension at the largest plausible strain, N."""
        result = [
            *segment_questions(case),
            *motion_questions(case),
            *marker_questions(case),
            *sample_questions(case),
            *drift_questions(case),
            *load_questions(case),
            *foot_questions(case),
            *direction_questions(case),
            *posture_questions(case),
            *step_questions(case),
            *implant_questions(case),
            *sign_questions(case),
        ]
        if case.ligaments or case.muscles:
            result += _line_questions(case, recording)
        self.questions, self.answered = _answered(result, case.scene.output.answers)

    def flags(self, k: int, frame: "Frame") -> list[str]:
        """Return the flags for the status of frame k."""
        words = [
            question.flag for question in self.questions if question.flag and question.concerns(k)
        ]
        tensions = frame.geometry.tensions
        if torn := [name for name, most in self._tear.items() if tensions.get(name, 0.0) > most]:
            words.append(
                f"ligament strain above {100 * lines.LINE_LIMITS.max_strain:.0f} %: {some(torn)}"
            )
        force = float(np.linalg.norm(frame.loads.contact_force)) / self._case.body_weight
        if force > FORCE_LIMITS.max_force_BW:
            words.append(f"contact force of {force:.1f} BW, above all forces measured in knees")
        return words


def _answered(
    questions: Sequence[Question], answers: Mapping[str, str]
) -> tuple[tuple[Question, ...], tuple[str, ...]]:
    unanswered, text = list(questions), []
    for words, answer in answers.items():
        matching = [
            question for question in unanswered if words and words.lower() in question.text.lower()
        ]
        if not matching:
            texts = "; ".join(question.text for question in unanswered) or "there are none"
            hint = f"remove the answer, or quote words of a question: {texts}"
            raise InputError(f"no question holds '{words}'", ANSWERS, hint)
        if not answer.strip():
            raise InputError(f"'{words}' has no answer", ANSWERS, "say why the input is right")
        text += [f"Answered: {question.text} {answer}" for question in matching]
        unanswered = [question for question in unanswered if question not in matching]
    return tuple(unanswered), tuple(text)


def _line_questions(case: Case, recording: "Recording") -> list[Question]:
    from tkamb.run.read_scene import link_poses

    result = [*lines.attachment_questions(case), *lines.stiffness_questions(case)]
    poses = link_poses(case, recording.poses, recording.extensor)
    result += [*lines.extensor_questions(case, poses), *lines.side_questions(case)]
    patella = recording.knee.patella
    bundles = (*recording.ligaments, *(patella.lines if patella else ()))
    if not (case.scene.contact and case.scene.contact.released):
        strains = {b.name: b.strain(b.length(poses)) for b in bundles}
        result += lines.strain_questions(bundles, strains, case.motion.time)
    return result
