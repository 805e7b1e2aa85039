"""Muscles of a synthetic knee: one extensor and two flexors."""

import numpy as np

from plane_leg import muscle
from tkamb.run.muscles.knee_trial import KneeTrial
from tkamb.run.muscles.sharing import FrameProblems, Sharing

STRENGTHS = (6000.0, 1800.0, 1200.0)
"""N: strengths of quadriceps, hamstring and gastrocnemius."""
SHANK = np.array([[-0.02, 0.32, -0.02], [-0.06, 0.02, 0.01]])
THIGH = np.array([[-0.05, 0.36, 0.03], [-0.03, 0.01, -0.02]])
"""m: ends of the flexors, tibia and femur link. The lines are behind the knee."""


def two_flexors(
    frames, strengths=STRENGTHS, reserve=10.0, least=0.05, weights="equal", least_share=0.0
):
    """Return a trial of three muscles and one coordinate."""
    names = ("quadriceps", "hamstring", "gastrocnemius")
    ends = [("femur_r", [0.0, 0.0, 0.0]), ("tibia_r", [0.0, 0.0, 0.0])]
    muscles = [muscle(n, *ends, force=f) for n, f in zip(names, strengths, strict=True)]
    sharing = Sharing(reserve=reserve, lowest=least, weights=weights, least_share=least_share)
    strength = np.tile(strengths, (frames, 1))
    moment, arms = np.zeros((frames, 1)), np.zeros((frames, 3, 1))
    problems = FrameProblems(muscles, ("knee",), sharing, moment, arms, strength, 0.0 * strength)
    shank, thigh = (np.tile(ends, (frames, 1, 1)) for ends in (SHANK, THIGH))
    extensor = np.array([True, False, False])
    return KneeTrial(problems, 0, extensor, np.array([1, 2]), shank, thigh)
