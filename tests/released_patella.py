"""[patella] of the shipped knee with three heads, two strands and two retinacula."""

from tkamb.geometry.frames import PATELLA_BODY_COORDINATES

SLACK = 58.3
"""mm: slack length of the retinacula, their length with the plane patella in extension."""


def bundle(name, proximal, distal, stiffness, slack=50.0):
    return {
        "name": name,
        "proximal": {"link": proximal[0], "point_mm": list(proximal[1:])},
        "distal": {"link": distal[0], "point_mm": list(distal[1:])},
        "law": "two-line",
        "stiffness_N_per_mm": stiffness,
        "slack_length_mm": slack,
    }


def head(name, origin, insertion, share):
    return {
        "name": name,
        "origin": {"link": "femur", "point_mm": [32.0, 205.0, origin]},
        "insertion": {"link": "patella", "point_mm": [8.0, 20.0, insertion]},
        "share": share,
    }


RELEASED = {
    "motion": "recorded",
    "released": list(PATELLA_BODY_COORDINATES),
    "head": [
        head("quadriceps_middle", 0.0, 0.0, 0.5),
        head("medial", -20.0, -12.0, 0.2),
        head("lateral", 30.0, 12.0, 0.3),
    ],
    "ligament": [
        bundle("strand_medial", ("patella", 6.0, -21.0, -8.0), ("tibia", 38.0, 392.8, -2.0), 400.0),
        bundle("strand_lateral", ("patella", 6.0, -21.0, 8.0), ("tibia", 38.0, 392.8, 8.0), 400.0),
        bundle(
            "retinaculum_medial",
            ("femur", 0.0, 0.0, -42.0),
            ("patella", 2.0, 0.0, -18.0),
            20.0,
            SLACK,
        ),
        bundle(
            "retinaculum_lateral",
            ("femur", 0.0, 0.0, 42.0),
            ("patella", 2.0, 0.0, 18.0),
            20.0,
            SLACK,
        ),
    ],
}
