"""Which inputs of a case vary, by how much, and the case with its inputs moved.

All of it happens on what was read, in SI and as a right knee's: no file is read again.
"""

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from tkamb.body.ligaments import Ligament
from tkamb.body.load import LinkPoint
from tkamb.body.muscles import Muscle
from tkamb.errors import InputError
from tkamb.geometry.frames import KNEE_COORDINATES, Array
from tkamb.scene.case import Case
from tkamb.scene.uncertainty import UncertaintyTable
from tkamb.units import DEGREE, MILLIMETRE

AXES = ("ap", "si", "ml")
COP_AXES = {"ap": 0, "ml": 2}
"""Of the laboratory."""


@dataclass(frozen=True)
class VariedInput:
    """One input that varies.

    Args:
        name: as in the tornado table.
        deviation: its standard deviation, in `unit`.
        unit: "mm", "deg", "relative", or "1".
    """

    name: str
    deviation: float
    unit: str


def varied_inputs(case: Case) -> tuple[VariedInput, ...]:
    """Return the inputs that vary: those with a deviation that the case has.

    Pose coordinates come first, in the order of `KNEE_COORDINATES`.

    Raises:
        InputError: none is left.
    """
    table = uncertainty_of(case)
    found = [*_pose_inputs(case, table), *_load_inputs(case, table), *_tissue_inputs(case, table)]
    inputs = tuple(one for one in found if one.deviation > 0)
    if not inputs:
        raise InputError(
            "no input varies", "[uncertainty]", "give a standard deviation above 0 to one"
        )
    return inputs


def held_inputs(case: Case) -> tuple[str, ...]:
    """Return the names of inputs that the case has and that do not vary: deviation 0."""
    table = uncertainty_of(case)
    found = [*_pose_inputs(case, table), *_load_inputs(case, table), *_tissue_inputs(case, table)]
    names = (one.name.partition(".")[0] for one in found if one.deviation == 0)
    return tuple(dict.fromkeys(names))


def uncertainty_of(case: Case) -> UncertaintyTable:
    """Return the scene's table, or its defaults."""
    return case.scene.uncertainty or UncertaintyTable()


def pose_names(inputs: tuple[VariedInput, ...]) -> list[str]:
    """Return the knee coordinates among the inputs."""
    return [one.name for one in inputs if one.name in KNEE_COORDINATES]


def _pose_inputs(case: Case, table: UncertaintyTable) -> list[VariedInput]:
    contact = case.scene.contact
    free = contact.released if contact else ()
    found = []
    for name in KNEE_COORDINATES:
        unit = "mm" if name in AXES else "deg"
        if name not in free:
            found.append(VariedInput(name, getattr(table, f"{name}_{unit}"), unit))
    return found


def _load_inputs(case: Case, table: UncertaintyTable) -> list[VariedInput]:
    found = [VariedInput("segment_mass", table.segment_mass, "relative")]
    if case.scene.ground_reaction is not None:
        found.append(VariedInput("ground_reaction", table.ground_reaction, "relative"))
        if case.scene.ground_reaction.applied == "cop":
            for axis in COP_AXES:
                name = f"centre_of_pressure_{axis}"
                found.append(VariedInput(name, getattr(table, f"{name}_mm"), "mm"))
    if case.scene.contact is not None:
        found.append(VariedInput("friction", table.friction, "1"))
        found.append(VariedInput("young_modulus", table.young_modulus, "relative"))
    return found


def _tissue_inputs(case: Case, table: UncertaintyTable) -> list[VariedInput]:
    found = []
    for bundle in case.ligaments:
        stiffness = f"ligament_stiffness.{bundle.name}"
        found.append(VariedInput(stiffness, table.ligament_stiffness, "relative"))
        strain = f"ligament_strain.{bundle.name}"
        found.append(VariedInput(strain, table.ligament_strain, "1"))
    found += _places("insert_placement", AXES, table.insert_placement_mm)
    if case.ligaments or case.muscles:
        found += _places("femoral_placement", AXES, table.femoral_placement_mm)
    if case.patellar_ligament is not None:
        found += _places("tuberosity", AXES, table.tuberosity_mm)
    patella = case.scene.patella
    if patella is not None and patella.motion == "recorded":
        found += _places("dome", ("ap", "si"), table.dome_mm)
    return found


def _places(name: str, axes: tuple[str, ...], deviation: float) -> list[VariedInput]:
    return [VariedInput(f"{name}.{axis}", deviation, "mm") for axis in axes]


@dataclass(frozen=True, eq=False)
class Draw:
    """What one sample makes of the inputs.

    Args:
        inputs: those that vary.
        normal: (d,) standard normal, one per input.
        noise: (f, p) standard normal per frame of the motion, of the pose inputs in their order.
        constant_share: of a pose error's variance.
    """

    inputs: tuple[VariedInput, ...]
    normal: Array
    noise: Array
    constant_share: float

    def standardised(self) -> Array:
        """Return (f, d): each input's error at each frame in its standard deviations."""
        found = np.tile(self.normal, (len(self.noise), 1))
        poses = [i for i, one in enumerate(self.inputs) if one.name in KNEE_COORDINATES]
        share = self.constant_share
        found[:, poses] *= np.sqrt(share)
        found[:, poses] += np.sqrt(1.0 - share) * self.noise
        return found

    def error(self, name: str) -> float:
        """Return an input's error in SI, or 0 if it does not vary; not for poses."""
        for one, value in zip(self.inputs, self.normal, strict=True):
            if one.name == name:
                return float(value) * one.deviation * (MILLIMETRE if one.unit == "mm" else 1.0)
        return 0.0

    def factor(self, name: str) -> float:
        """Return a positive factor of mean 1 with the input's relative standard deviation."""
        for one, value in zip(self.inputs, self.normal, strict=True):
            if one.name == name:
                spread = np.log1p(one.deviation**2)
                return float(np.exp(np.sqrt(spread) * value - 0.5 * spread))
        return 1.0

    def place(self, name: str) -> Array:
        """Return the error (3,) m of a place: ap, si, ml."""
        return np.array([self.error(f"{name}.{axis}") for axis in AXES])


def varied_case(case: Case, draw: Draw) -> Case:
    """Return the case with its inputs moved; rates and accelerations stay as recorded.

    The insert's modulus is not in a case: `tkamb.uncertainty.sample` varies it.
    """
    changes: dict[str, Any] = {"motion": _motion(case, draw)}
    if case.scene.contact is not None:
        friction = max(0.0, case.scene.contact.friction + draw.error("friction"))
        contact = case.scene.contact.model_copy(update={"friction": friction})
        changes["scene"] = case.scene.model_copy(update={"contact": contact})
    if case.ground is not None:
        shift = np.zeros(3)
        for name, axis in COP_AXES.items():
            shift[axis] = draw.error(f"centre_of_pressure_{name}")
        factor, ground = draw.factor("ground_reaction"), case.ground
        changes["ground"] = replace(
            ground,
            force=ground.force * factor,
            moment=ground.moment * factor,
            point=ground.point + shift,
        )
    changes["chain"] = case.chain.changed(
        draw.factor("segment_mass"), draw.place("insert_placement")
    )
    changes["ligaments"] = tuple(_ligament(case, one, draw) for one in case.ligaments)
    changes["muscles"] = tuple(_muscle(case, one, draw) for one in case.muscles)
    if case.patellar_ligament is not None:
        end = case.patellar_ligament.distal
        moved = LinkPoint(end.link, end.position + draw.place("tuberosity"))
        changes["patellar_ligament"] = replace(case.patellar_ligament, distal=moved)
    return replace(case, **changes)


def _motion(case: Case, draw: Draw) -> Any:
    motion, errors = case.motion, draw.standardised()
    coordinates = motion.coordinates.copy()
    for i, one in enumerate(draw.inputs):
        if one.name in KNEE_COORDINATES:
            scale = one.deviation * (MILLIMETRE if one.unit == "mm" else DEGREE)
            coordinates[:, KNEE_COORDINATES.index(one.name)] += scale * errors[:, i]
    patella = motion.patella
    if patella is not None:
        patella = patella + np.array([draw.error("dome.ap"), draw.error("dome.si"), 0.0])
    return replace(motion, coordinates=coordinates, patella=patella)


def _ligament(case: Case, bundle: Ligament, draw: Draw) -> Ligament:
    strain = draw.error(f"ligament_strain.{bundle.name}")
    return replace(
        bundle,
        proximal=_on_femur(case, bundle.proximal, draw),
        distal=_on_femur(case, bundle.distal, draw),
        stiffness=bundle.stiffness * draw.factor(f"ligament_stiffness.{bundle.name}"),
        slack_length=bundle.slack_length / (1.0 + strain),  # one of the two is NaN and stays so
        reference_strain=bundle.reference_strain + strain,
    )


def _muscle(case: Case, muscle: Muscle, draw: Draw) -> Muscle:
    return replace(muscle, points=tuple(_on_femur(case, point, draw) for point in muscle.points))


def _on_femur(case: Case, end: LinkPoint, draw: Draw) -> LinkPoint:
    """Return a point moved with the femur, if it is on it."""
    shift = draw.place("femoral_placement")
    if not shift.any() or case.chain.carrier(end.link) != "femur":
        return end
    turned = case.chain.link_in(end.link, "femur")[:3, :3].T @ shift
    return LinkPoint(end.link, end.position + turned)


def thinnable(case: Case) -> bool:
    """Say whether a frame needs no other frame of the motion.

    A solved patella is differentiated in time, and a reference strain looks for its pose.
    """
    solved = case.scene.patella is not None and case.scene.patella.motion == "solved"
    return not solved and all(np.isfinite(one.slack_length) for one in case.ligaments)


def thinned(case: Case, frames: range) -> Case:
    """Return the case with these frames of its motion alone."""
    count, chosen = len(case.motion.time), list(frames)

    def at_frames(recording: Any) -> Any:
        if recording is None:
            return None
        found = {one.name: getattr(recording, one.name) for one in fields(recording)}
        series = {
            name: value[chosen]
            for name, value in found.items()
            if isinstance(value, np.ndarray) and len(value) == count
        }
        return replace(recording, **series)

    return replace(
        case,
        motion=at_frames(case.motion),
        tibia=at_frames(case.tibia),
        ground=at_frames(case.ground),
    )
