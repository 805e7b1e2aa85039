"""Questions about the implant: whether the femoral component looks forward."""

from collections.abc import Iterator

from tkamb.plausibility.question import Question
from tkamb.scene.case import Case

TOP = 0.15
"""Of the component's height: the anterior flange ends there, above the posterior condyles."""
FORWARD = 0.35
"""Of its length, from behind: eleven components have their top at 0.92 to 0.97, one without a
flange at 0.5, one back to front below 0.1."""


def implant_questions(case: Case) -> Iterator[Question]:
    """Whether the femoral component's flange lies in front."""
    if case.femoral is None:
        return
    low, high = case.femoral.bounds
    vertices = case.femoral.vertices
    top = vertices[:, 1] > high[1] - TOP * (high[1] - low[1])
    place = float((vertices[top, 0].mean() - low[0]) / (high[0] - low[0]))
    if place < FORWARD:
        yield Question(
            "the top of the femoral component lies behind, where the posterior condyles end: is it "
            "back to front? see [implant.femoral] axes",
            "femoral component may be back to front",
        )
