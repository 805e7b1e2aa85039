"""Activities in which instrumented knees were measured, and their published peak forces.

Each number is the mean of the subjects' peaks in one source: the resultant force of five subjects
(Kutzner et al. 2010, abstract), or the axial force (D'Lima et al. 2007, as quoted in later papers).
Single subjects and trials differ from these means.

References: Kutzner et al. (2010), J Biomech 43:2164, doi:10.1016/j.jbiomech.2010.03.046; D'Lima et
al. (2007), J Biomech 40 Suppl 1:S11, doi:10.1016/j.jbiomech.2007.03.004.
"""

from typing import Literal

Activity = Literal[
    "walking",
    "squat",
    "stair ascent",
    "stair descent",
    "standing up",
    "sitting down",
    "one-leg stance",
]

KUTZNER, DLIMA = "Kutzner 2010", "D'Lima 2007"
PEAKS_BW: dict[str, dict[str, float]] = {
    "walking": {KUTZNER: 2.61, DLIMA: 2.3},
    "squat": {KUTZNER: 2.53, DLIMA: 2.1},
    "stair ascent": {KUTZNER: 3.16, DLIMA: 3.0},
    "stair descent": {KUTZNER: 3.46},
    "standing up": {KUTZNER: 2.46, DLIMA: 2.5},
    "sitting down": {KUTZNER: 2.25},
    "one-leg stance": {KUTZNER: 2.59},
}
"""Activity -> source -> mean peak force in body weights."""


def peaks_words(activity: str) -> str:
    """Return sentences on the published mean peak forces of an activity."""
    parts = [f"{force:.2f} BW ({source})" for source, force in PEAKS_BW[activity].items()]
    plural = "peaks" if len(parts) > 1 else "peak"
    return (
        f"Grey: mean {plural} of instrumented knees in {activity}, {', '.join(parts)}. "
        "Subjects differ from each other more than these means do. A peak near a mean does not "
        "validate a result."
    )
