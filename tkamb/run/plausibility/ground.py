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
"""BW, the largest vertical ground reaction: one leg of two standing bears 0.5, a sprinter's 4."""

FOOT_FORWARD = (-0.085, 0.23)
"""m, of the centre of pressure from the ankle centre: from heel to toe of a shoe 0.31 m long. At
heel strike subject DM has -0.071."""


@dataclass(frozen=True)
class GroundReactionLimitSettings:
    """Which ground reactions are plausible."""

    max_lateral_distance: float = 0.075
    """m, to either side. Chosen: half the breadth of a shoe, and as much again for an oblique
    foot."""
    loaded_share: float = 0.2
    """Share of the peak force. Chosen: at less the centre of pressure is a quotient of small
    numbers."""
    min_lean: float = 0.03
    """Forward over upward force. Chosen: at less the force hardly leans and the sign of its lean
    says nothing."""
    max_outward_lean: float = 0.02
    """Sideways over upward force, outwards. In standing, walking and squatting it is inwards, by
    0.04 to 0.07 in six recordings; on the stairs of subject JW it is 0.007 outwards."""
    max_hip_distance: float = 0.6
    """Share of shank and thigh together. Sitting with an upright shank has 0.55; walking, stairs
    and squats of the models stay within 0.41."""
    min_mean_forward: float = -0.015
    """m, of the centre of pressure ahead of the ankle, in the mean over the loaded frames: 0.019 to
    0.061 in seven recordings; with the sign turned, -0.019 and less."""
    ankle_distance: float = 0.015
    """m; a standing person has the centre of pressure 0.04 ahead of the ankle. Chosen: a path as
    near as this is in another unit."""
    max_unloaded_stance: float = 0.15
    """s; longest time that a standing foot is unloaded. Chosen: 0.02 s at most in four recorded
    walks, and 0.4 s where a plate is left out."""
    unloaded_force: float = 0.05
    """BW: a foot with less force is unloaded. Chosen: above the noise of plates."""
    max_peak_ratio: float = 1.6
    """Ratio of one foot's largest to its smallest peak in a walk. Chosen: 1.1 in three
    recordings."""


GROUND_REACTION_LIMITS = GroundReactionLimitSettings()

ANKLE_ABOVE = (0.03, 0.32)
"""m, of the ankle above the plate: barefoot and flat, to tiptoe in high heels."""
WALKS, STANDS = 1.0, 0.3
"""m/s, of the ankle: it swings faster than the first (a walk's 4, a slow one's 1.5) and in stance
is slower than the second, from the foot's landing to the heel's rising."""


def load_questions(case: Case) -> Iterator[Question]:
    """Whether there is a ground reaction, and its largest vertical force in body weights."""
    if case.ground is None:
        if case.tibia is not None or case.muscles:
            yield Question(
                "no ground reaction is given, so that the knee bears no more than the shank's "
                "weight: does the foot hang in the air, or is [ground_reaction] left out?",
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
    """Whether a walking foot is measured wherever it stands, and alike in every step."""
    ground, tibia, time = case.ground, case.tibia, case.motion.time
    if ground is None or tibia is None:
        return
    speed = np.linalg.norm(tibia.velocity[:, :3], axis=1)
    if speed.max() < WALKS:
        return
    upward = ground.force[:, 1]
    bears = upward > GROUND_REACTION_LIMITS.unloaded_force * case.body_weight
    still = [
        (first, last)
        for first, last in uninterrupted_runs(~bears & (speed < STANDS))
        if time[last] - time[first] > GROUND_REACTION_LIMITS.max_unloaded_stance
    ]
    if still:
        frames = np.zeros(len(time), bool)
        for first, last in still:
            frames[first : last + 1] = True
        first, last = still[0]
        yield Question(
            f"the ankle stands from {time[first]:.4g} to {time[last]:.4g} s while the ground bears "
            "nothing: did the foot stand beside the plates, or is one of them left out?",
            "foot stands on nothing that was measured",
            frames,
        )
    ends = (0, len(time) - 1)
    peaks = [
        first + int(upward[first : last + 1].argmax()) for first, last in uninterrupted_runs(bears)
    ]
    peaks = [k for k in peaks if k not in ends]  # not cut off on its way up or down
    if len(peaks) > 1:
        low, high = min(peaks, key=upward.__getitem__), max(peaks, key=upward.__getitem__)
        if upward[high] > GROUND_REACTION_LIMITS.max_peak_ratio * upward[low]:
            yield Question(
                f"one step loads the foot with {upward[low]:.0f} N at {time[low]:.4g} s, another "
                f"with {upward[high]:.0f} N at {time[high]:.4g} s: does one plate have another "
                "gain, or bear only part of the foot?",
                "steps of one foot loaded unlike each other",
            )


def direction_questions(case: Case) -> Iterator[Question]:
    """Whether the horizontal force points where it does in a leg that bears the body.

    The ground reaction passes near the body's centre of mass, which is near the hip: it leans
    forward or back as the line from the centre of pressure to the hip does, and it
    points to the other leg, not away from it.
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
            "the ground reaction leans forward where the leg leans back: is the sign of its "
            "forward column turned, or are the columns left-handed?",
            "ground reaction leans against the leg",
        )


def _sideways_question(case: Case) -> Iterator[Question]:
    """Whether the force points to the other leg: that needs no centre of pressure."""
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
            "its upward force: is the sign of its sideways column turned, or are the columns "
            "left-handed?",
            "ground reaction points away from the other leg",
        )


def posture_questions(case: Case) -> Iterator[Question]:
    """Whether the hip of a leg that bears the body is anywhere above the foot."""
    ground, tibia, loaded = case.ground, case.tibia, _well_loaded(case)
    if ground is None or tibia is None or not loaded.any():
        return
    chain = case.chain
    length = float(
        np.linalg.norm(chain.insert_in_tibia[:3, 3])
        + np.linalg.norm(chain.link_in("hip", "femur")[:3, 3])
    )
    ahead = np.einsum("fi,fi->f", _to_hip(case), _forward(case))
    off = loaded & (np.abs(ahead) > GROUND_REACTION_LIMITS.max_hip_distance * length)
    if off.any():
        k = int(np.argmax(np.where(off, np.abs(ahead), 0.0)))
        side = "ahead of" if ahead[k] > 0 else "behind"
        yield Question(
            f"the hip is {abs(ahead[k]) / MILLIMETRE:.0f} mm {side} the centre of pressure of a "
            "leg that bears the body: is the sign of [tibia]'s lean, or of the flexion, turned?",
            "hip far from above the foot",
            off,
        )


def _well_loaded(case: Case) -> Mask:
    """Return in which frames (f,) the foot bears well; none without a centre of pressure."""
    ground, table = case.ground, case.scene.ground_reaction
    if ground is None or case.tibia is None or table is None or table.applied != "cop":
        return np.zeros(len(case.motion.time), bool)
    upward = ground.force[:, 1]
    return np.asarray(ground.loaded & (upward > GROUND_REACTION_LIMITS.loaded_share * upward.max()))


def _to_hip(case: Case) -> Array:
    """Return the way (f, 3), m, from the centre of pressure to the hip, laboratory axes."""
    assert case.ground is not None and case.tibia is not None
    femur = case.tibia.pose @ case.chain.insert_in_tibia @ knee_pose(case.motion.coordinates)
    hip = transform(femur, case.chain.link_in("hip", "femur")[:3, 3][None])[:, 0]
    return np.asarray(hip - case.ground.point)


def _forward(case: Case) -> Array:
    """Return the level direction (f, 3) to which the shank's front points."""
    assert case.tibia is not None
    forward = case.tibia.pose[:, :3, 0] * [1.0, 0.0, 1.0]
    return np.asarray(forward / np.maximum(np.linalg.norm(forward, axis=1), 1e-9)[:, None])


def foot_questions(case: Case) -> Iterator[Question]:
    """Whether the centre of pressure lies under the foot that the shank stands on."""
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
            f"the centre of pressure lies {-mean / MILLIMETRE:.0f} mm behind the ankle in the "
            "mean, where no foot is (a foot reaches forward): is its sign or axis another one, or "
            "the ankle's place?",
            "centre of pressure behind the ankle",
        )
    aside = away[:, 2] * forward[:, 0] - away[:, 0] * forward[:, 2]
    sides = ("to the right of", "to the left of")
    if case.scene.patient.side == "left":  # read as a right foot's, mirrored
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
        off = loaded & ((place < low) | (place > high))
        if off.any():
            k = int(np.argmax(np.where(off, np.maximum(low - place, place - high), -np.inf)))
            yield Question(
                f"the centre of pressure lies {abs(place[k]) / MILLIMETRE:.0f} mm "
                f"{word if place[k] >= 0 else opposite} the ankle at "
                f"{case.motion.time[k]:.4g} s, where no foot is ({low / MILLIMETRE:.0f} to "
                f"{high / MILLIMETRE:.0f} mm {word} it): is its sign, unit or axis another one, or "
                "the ankle's?",
                "centre of pressure not under the foot",
            )
