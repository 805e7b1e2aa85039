"""Questions about the ground reaction: its size, and whether it acts under the foot."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from tkamb.geometry.frames import Array, Mask, knee_pose, transform
from tkamb.io.recordings.gait_cycle import uninterrupted_runs
from tkamb.io.scene.case import Case
from tkamb.run.plausibility import Question
from tkamb.units import MILLIMETRE

PEAK_LOAD = (0.4, 4.0)
"""BW: limits of the peak vertical ground reaction. It is 0.5 in standing on two legs and 4 in
sprinting."""

FOOT_FORWARD = (-0.085, 0.23)
"""m: limits of the centre of pressure ahead of the ankle, from heel to toe of a shoe 0.31 m long.
Subject DM has -0.071 at heel strike."""


@dataclass(frozen=True)
class GroundReactionLimitSettings:
    """Limits of plausible ground reactions."""

    max_lateral_distance: float = 0.075
    """m: largest distance of the centre of pressure from the ankle to either side.
    Half the breadth of a shoe, doubled to allow for an oblique foot."""
    loaded_share: float = 0.2
    """1: share of the peak force above which a frame is checked. The centre of
    pressure is a quotient of small numbers at smaller forces."""
    min_lean: float = 0.03
    """1: least standard deviation of the ratio of forward to upward force that is compared with
    the leg's inclination. The signs of smaller inclinations are uncertain."""
    max_outward_lean: float = 0.02
    """1: largest outward over upward force. Six recordings of standing, walking and squatting have
    0.04 to 0.07 inwards. Subject JW on stairs has 0.007 outwards."""
    max_hip_distance: float = 0.6
    """1: largest horizontal distance from the centre of pressure to the hip, as a share of the
    length of shank and thigh. Sitting with a vertical shank has 0.55; walking, stairs and squats of
    the models have at most 0.41."""
    min_mean_forward: float = -0.015
    """m: least mean distance of the centre of pressure ahead of the ankle. Seven recordings have
    0.019 to 0.061, and -0.019 or less with the opposite sign."""
    ankle_distance: float = 0.015
    """m: horizontal distance from the ankle. A centre of pressure that stays within it is likely
    in another unit. In standing it is 0.04 m ahead of the
    ankle."""
    max_unloaded_stance: float = 0.15
    """s: longest time without force on a standing foot. Four recorded walks have at most 0.02 s.
    A missing force plate causes 0.4 s."""
    unloaded_force: float = 0.05
    """BW: force below which a foot is unloaded. The noise of force plates is
    smaller."""
    max_peak_ratio: float = 1.6
    """1: largest ratio of the peak forces of one foot in a walk. Three recordings
    have 1.1."""


GROUND_REACTION_LIMITS = GroundReactionLimitSettings()

ANKLE_ABOVE = (0.03, 0.32)
"""m: limits of the ankle's height above the plate, from a flat bare foot to tiptoe in high heels.
"""
WALKS, STANDS = 1.0, 0.3
"""m/s: limits of the ankle's speed. The ankle exceeds WALKS in swing (4 in walking, 1.5 in slow
walking). It is slower than STANDS in stance, until the heel rises."""


def load_questions(case: Case) -> Iterator[Question]:
    """Ask about a missing ground reaction, or an unlikely peak of its vertical force."""
    if case.ground is None:
        if case.tibia is not None or case.muscles:
            yield Question(
                "no ground reaction is given, so that the knee bears no more than the shank's "
                "weight: is the foot off the ground, or is [ground_reaction] missing?",
                "",
            )
        return
    peak = float(case.ground.force[:, 1].max())
    share = peak / case.body_weight
    if not PEAK_LOAD[0] <= share <= PEAK_LOAD[1]:
        likely = "in body weights, " if peak < 10.0 else ""
        yield Question(
            f"the ground reaction peaks at {peak:.3g} N ({share:.2g} BW): is it {likely}in another "
            "unit than N, or mass_kg in pounds?",
            "ground reaction unlike the body's weight",
        )


def step_questions(case: Case) -> Iterator[Question]:
    """Ask about stance without measured force, or steps with very different peak forces."""
    ground, tibia, time = case.ground, case.tibia, case.motion.time
    if ground is None or tibia is None:
        return
    speed = np.linalg.norm(tibia.velocity[:, :3], axis=1)
    if speed.max() < WALKS:
        return
    upward = ground.force[:, 1]
    bears = upward > GROUND_REACTION_LIMITS.unloaded_force * case.body_weight
    unloaded = [
        (first, last)
        for first, last in uninterrupted_runs(~bears & (speed < STANDS))
        if time[last] - time[first] > GROUND_REACTION_LIMITS.max_unloaded_stance
    ]
    if unloaded:
        frames = np.zeros(len(time), bool)
        for first, last in unloaded:
            frames[first : last + 1] = True
        first, last = unloaded[0]
        yield Question(
            f"the ankle stands from {time[first]:.4g} to {time[last]:.4g} s without a measured "
            "force: did the foot stand beside the plates, or is a plate missing in the scene?",
            "foot stands without a measured force",
            frames,
        )
    ends = (0, len(time) - 1)
    peaks = [
        first + int(upward[first : last + 1].argmax()) for first, last in uninterrupted_runs(bears)
    ]
    peaks = [k for k in peaks if k not in ends]  # exclude steps cut off by the recording
    if len(peaks) > 1:
        low, high = min(peaks, key=upward.__getitem__), max(peaks, key=upward.__getitem__)
        if upward[high] > GROUND_REACTION_LIMITS.max_peak_ratio * upward[low]:
            yield Question(
                f"one step loads the foot with {upward[low]:.0f} N at {time[low]:.4g} s, another "
                f"with {upward[high]:.0f} N at {time[high]:.4g} s: does one plate have a wrong "
                "gain, or did it bear only part of the foot?",
                "steps of one foot with different loads",
            )


def direction_questions(case: Case) -> Iterator[Question]:
    """Ask about an unlikely direction of the horizontal force.

    The ground reaction passes near the body's centre of mass, and so near the hip. It is therefore
    inclined forward or backward like the line from the centre of pressure to the hip, and inward.
    """
    ground, loaded = case.ground, _well_loaded(case)
    yield from _sideways_question(case)
    if ground is None or loaded.sum() < 5:
        return
    leg = _to_hip(case)[loaded]
    force, forward = ground.force[loaded], _forward(case)[loaded]
    slopes = [np.einsum("fi,fi->f", line, forward) / line[:, 1] for line in (force, leg)]
    if (
        min(np.std(slope) for slope in slopes) > GROUND_REACTION_LIMITS.min_lean
        and np.corrcoef(slopes)[0, 1] < -0.5
    ):
        yield Question(
            "the ground reaction is inclined forward when the leg is inclined backward: is the "
            "sign of its forward column wrong, or are the columns left-handed?",
            "ground reaction inclined against the leg",
        )


def _sideways_question(case: Case) -> Iterator[Question]:
    """This question needs no centre of pressure."""
    ground = case.ground
    if ground is None or case.tibia is None:
        return
    upward = ground.force[:, 1]
    loaded = ground.loaded & (upward > GROUND_REACTION_LIMITS.loaded_share * upward.max())
    if loaded.sum() < 5:
        return
    force, forward = ground.force[loaded], _forward(case)[loaded]
    aside = float((force[:, 2] * forward[:, 0] - force[:, 0] * forward[:, 2]).sum())
    if aside > GROUND_REACTION_LIMITS.max_outward_lean * force[:, 1].sum():
        yield Question(
            f"the ground pushes the leg outwards with {100 * aside / force[:, 1].sum():.0f} % of "
            "its upward force: is the sign of its sideways column wrong, or are the columns "
            "left-handed?",
            "ground reaction points away from the other leg",
        )


def posture_questions(case: Case) -> Iterator[Question]:
    """Ask about a hip that is far ahead of or behind a loaded foot."""
    ground, tibia, loaded = case.ground, case.tibia, _well_loaded(case)
    if ground is None or tibia is None or not loaded.any():
        return
    chain = case.chain
    length = float(
        np.linalg.norm(chain.insert_in_tibia[:3, 3])
        + np.linalg.norm(chain.link_in("hip", "femur")[:3, 3])
    )
    ahead = np.einsum("fi,fi->f", _to_hip(case), _forward(case))
    frames = loaded & (np.abs(ahead) > GROUND_REACTION_LIMITS.max_hip_distance * length)
    if frames.any():
        k = int(np.argmax(np.where(frames, np.abs(ahead), 0.0)))
        side = "ahead of" if ahead[k] > 0 else "behind"
        yield Question(
            f"the hip is {abs(ahead[k]) / MILLIMETRE:.0f} mm {side} the centre of pressure of a "
            "loaded foot: is the sign of [tibia]'s lean, or of the flexion, wrong?",
            "hip not above the foot",
            frames,
        )


def _well_loaded(case: Case) -> Mask:
    """Return (f,) whether a foot is well loaded; False without centre of pressure."""
    ground, table = case.ground, case.scene.ground_reaction
    if ground is None or case.tibia is None or table is None or table.applied != "cop":
        return np.zeros(len(case.motion.time), bool)
    upward = ground.force[:, 1]
    return np.asarray(ground.loaded & (upward > GROUND_REACTION_LIMITS.loaded_share * upward.max()))


def _to_hip(case: Case) -> Array:
    """Return (f, 3), m, laboratory axes, from the centre of pressure to the hip."""
    assert case.ground is not None and case.tibia is not None
    femur = case.tibia.pose @ case.chain.insert_in_tibia @ knee_pose(case.motion.coordinates)
    hip = transform(femur, case.chain.link_in("hip", "femur")[:3, 3][None])[:, 0]
    return np.asarray(hip - case.ground.point)


def _forward(case: Case) -> Array:
    """Return the shank's horizontal anterior direction (f, 3), laboratory axes."""
    assert case.tibia is not None
    forward = case.tibia.pose[:, :3, 0] * [1.0, 0.0, 1.0]
    return np.asarray(forward / np.maximum(np.linalg.norm(forward, axis=1), 1e-9)[:, None])


def foot_questions(case: Case) -> Iterator[Question]:
    """Ask about a centre of pressure that is not under the foot."""
    ground, tibia, loaded = case.ground, case.tibia, _well_loaded(case)
    if ground is None or tibia is None or not loaded.any():
        return
    away, forward = ground.point - tibia.pose[:, :3, 3], _forward(case)
    nearest = float(np.linalg.norm(away[loaded][:, [0, 2]], axis=1).max())
    if nearest < GROUND_REACTION_LIMITS.ankle_distance:
        yield Question(
            f"the centre of pressure stays within {nearest / MILLIMETRE:.2g} mm of the ankle, "
            "seen from above: is it in centimetres or metres?",
            "centre of pressure stays under the ankle",
        )
    ahead = np.einsum("fi,fi->f", away, forward)
    if (mean := float(ahead[loaded].mean())) < GROUND_REACTION_LIMITS.min_mean_forward:
        yield Question(
            f"the mean centre of pressure lies {-mean / MILLIMETRE:.0f} mm behind the ankle, not "
            "under the foot: is its sign or axis, or the position of the ankle, wrong?",
            "centre of pressure behind the ankle",
        )
    aside = away[:, 2] * forward[:, 0] - away[:, 0] * forward[:, 2]
    sides = ("to the right of", "to the left of")
    if case.scene.patient.side == "left":  # the case is mirrored to a right leg
        sides = sides[::-1]
    places = (
        ("ahead of", "behind", ahead, FOOT_FORWARD),
        (
            *sides,
            aside,
            (
                -GROUND_REACTION_LIMITS.max_lateral_distance,
                GROUND_REACTION_LIMITS.max_lateral_distance,
            ),
        ),
        ("below", "above", -away[:, 1], ANKLE_ABOVE),
    )
    for word, opposite, place, (low, high) in places:
        frames = loaded & ((place < low) | (place > high))
        if frames.any():
            k = int(np.argmax(np.where(frames, np.maximum(low - place, place - high), -np.inf)))
            yield Question(
                f"the centre of pressure lies {abs(place[k]) / MILLIMETRE:.0f} mm "
                f"{word if place[k] >= 0 else opposite} the ankle at "
                f"{case.motion.time[k]:.4g} s, not under the foot ({low / MILLIMETRE:.0f} to "
                f"{high / MILLIMETRE:.0f} mm {word} it): is its sign, unit or axis, or that of "
                "the ankle, wrong?",
                "centre of pressure not under the foot",
            )
