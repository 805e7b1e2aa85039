"""The inputs of a case that vary, their standard deviations, and their errors in one sample."""

from dataclasses import dataclass

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import KNEE_COORDINATES, Array
from tkamb.io.scene.case import Case
from tkamb.io.scene.uncertainty import SKIN_MARKER_ERROR, UncertaintyTable
from tkamb.units import DEGREE, MILLIMETRE

AXES = ("ap", "si", "ml")
COP_AXES = {"ap": 0, "ml": 2}
"""Of the laboratory."""
UNITS = {"mm": MILLIMETRE, "deg": DEGREE}
PATELLAR_LIGAMENT = "patellar_ligament"
MARKED = ("shank", "thigh")
"""Segments whose markers vary."""
LINE_ENDS = ("origin", "insertion")
"""Of a line that pulls the patella."""
GROUP_ENDS = ("shank", "thigh")
"""Where the lines of a group leave shank and thigh."""
ACROSS_KNEE = ("thigh to shank", "thigh to foot")
"""Groups of muscles with lines across the knee, see `tkamb.run.muscles.leg`."""


@dataclass(frozen=True)
class VariedInput:
    """One input that varies.

    Args:
        name: name in the tornado table.
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
    inputs = tuple(one for one in _all_inputs(case) if one.deviation > 0)
    if not inputs:
        raise InputError(
            "no input varies", "[uncertainty]", "give a standard deviation above 0 to one"
        )
    return inputs


def held_inputs(case: Case) -> tuple[str, ...]:
    """Return the names of inputs that the case has and that do not vary: deviation 0."""
    constants = [one for one in _all_inputs(case) if one.deviation == 0]
    names = (
        f"{one.name.partition('.')[0]}{'_angles' * ('.about_' in one.name)}" for one in constants
    )
    return tuple(dict.fromkeys(names))


def _all_inputs(case: Case) -> list[VariedInput]:
    table = uncertainty_of(case)
    return [
        *_pose_inputs(case, table),
        *_marker_inputs(case, table),
        *_load_inputs(case, table),
        *_muscle_inputs(case, table),
        *_tissue_inputs(case, table),
    ]


def uncertainty_of(case: Case) -> UncertaintyTable:
    """Return the scene's table, or its defaults, with those of its kind of recording."""
    table = case.scene.uncertainty or UncertaintyTable()
    return table.completed(from_markers=case.scene.motion.markers is not None)


def pose_names(inputs: tuple[VariedInput, ...]) -> list[str]:
    """Return the knee coordinates among the inputs."""
    return [one.name for one in inputs if one.name in KNEE_COORDINATES]


def _pose_inputs(case: Case, table: UncertaintyTable) -> list[VariedInput]:
    contact, markers = case.scene.contact, case.scene.motion.markers
    free = (*contact.released, "si") if contact and contact.released else ()  # found with them
    stated = (case.scene.uncertainty or UncertaintyTable()).model_fields_set
    inputs = []
    for name in KNEE_COORDINATES:
        unit = "mm" if name in AXES else "deg"
        key = f"{name}_{unit}"
        # a coordinate that is taken from the markers varies with them
        with_markers = markers is not None and name in markers.coordinates and key not in stated
        if name not in free and not with_markers:
            inputs.append(VariedInput(name, getattr(table, key), unit))
    return inputs


def _marker_inputs(case: Case, table: UncertaintyTable) -> list[VariedInput]:
    """Return those of each marker on shank and thigh."""
    markers = case.scene.motion.markers
    by_segment = {"shank": SKIN_MARKER_ERROR.shank_mm, "thigh": SKIN_MARKER_ERROR.thigh_mm}
    inputs: list[VariedInput] = []
    for segment in markers.segment if markers else ():
        if segment.name in MARKED:
            given = table.markers_mm
            deviation = by_segment[segment.name] if given is None else given
            for label in segment.markers_mm:
                inputs += _places(f"marker.{label}", AXES, deviation)
    return inputs


def _load_inputs(case: Case, table: UncertaintyTable) -> list[VariedInput]:
    inputs = [VariedInput("segment_mass", table.segment_mass, "relative")]
    if case.scene.ground_reaction is not None:
        inputs.append(VariedInput("ground_reaction", table.ground_reaction, "relative"))
        if case.scene.ground_reaction.applied == "cop":
            for axis in COP_AXES:
                name = f"centre_of_pressure_{axis}"
                inputs.append(VariedInput(name, getattr(table, f"{name}_mm"), "mm"))
            if case.tibia is not None:
                inputs += _places("knee_centre", AXES, table.knee_centre_mm)
    if case.scene.contact is not None:
        inputs.append(VariedInput("friction", table.friction, "1"))
        inputs.append(VariedInput("young_modulus", table.young_modulus, "relative"))
        inputs.append(VariedInput("yield_stress", table.yield_stress, "relative"))
    return inputs


def _muscle_inputs(case: Case, table: UncertaintyTable) -> list[VariedInput]:
    """Return strengths by group, and attachments by line or group."""
    inputs: list[VariedInput] = []
    groups: tuple[str, ...] = ()
    if case.scene.muscles is not None:
        groups = ("",)
        if table.muscle_strength > 0 or table.muscle_attachment_mm > 0:
            from tkamb.run.muscles.shared_muscles import groups_of

            groups = groups_of(case)
        inputs = [
            VariedInput(f"muscle_strength.{group}", table.muscle_strength, "relative")
            for group in groups
        ]
    ends = [(one.name, end) for one in case.muscles for end in LINE_ENDS]
    ends += [(group, end) for group in groups if group in ACROSS_KNEE for end in GROUP_ENDS]
    inputs += [
        VariedInput(f"tendon_band.{name}", table.tendon_band_mm, "mm")
        for name in _wrapped_tendons(case)
    ]
    for name, end in ends:
        place = f"muscle_attachment.{name}.{end}"
        inputs += _places(place, AXES, table.muscle_attachment_mm)
    return inputs


def _wrapped_tendons(case: Case) -> list[str]:
    """Return the names of the tendons that wrap a part by sections of a band."""
    names = [one.name for one in case.muscles if one.wrap and one.wrap.band > 0]
    ligament = case.patellar_ligament
    if ligament is not None and ligament.wrap and ligament.wrap.band > 0:
        names.append(PATELLAR_LIGAMENT)
    return names


def _tissue_inputs(case: Case, table: UncertaintyTable) -> list[VariedInput]:
    inputs = []
    for bundle in case.ligaments:
        stiffness = f"ligament_stiffness.{bundle.name}"
        inputs.append(VariedInput(stiffness, table.ligament_stiffness, "relative"))
        strain = f"ligament_strain.{bundle.name}"
        inputs.append(VariedInput(strain, table.ligament_strain, "1"))
    inputs += _places("insert_placement", AXES, table.insert_placement_mm)
    inputs += [
        VariedInput(f"insert_placement.about_{axis}", table.insert_placement_deg, "deg")
        for axis in AXES
    ]
    if case.ligaments or case.muscles:
        inputs += _places("femoral_placement", AXES, table.femoral_placement_mm)
    if case.patellar_ligament is not None:
        inputs += _places("tuberosity", AXES, table.tuberosity_mm)
    patella = case.scene.patella
    if patella is not None and patella.motion == "recorded":
        inputs += _places("dome", ("ap", "si"), table.dome_mm)
    return inputs


def _places(name: str, axes: tuple[str, ...], deviation: float) -> list[VariedInput]:
    return [VariedInput(f"{name}.{axis}", deviation, "mm") for axis in axes]


@dataclass(frozen=True, eq=False)
class Draw:
    """The errors of the inputs in one sample.

    Args:
        inputs: those that vary.
        normal: (d,) standard normal, one per input.
        noise: (f, p) standard normal per frame of the motion, of the pose inputs in their order.
        constant_share: share of a pose error's variance that is the same in all frames.
    """

    inputs: tuple[VariedInput, ...]
    normal: Array
    noise: Array
    constant_share: float

    def standardised(self) -> Array:
        """Return (f, d): each input's error at each frame in its standard deviations."""
        values = np.tile(self.normal, (len(self.noise), 1))
        poses = [i for i, one in enumerate(self.inputs) if one.name in KNEE_COORDINATES]
        share = self.constant_share
        values[:, poses] *= np.sqrt(share)
        values[:, poses] += np.sqrt(1.0 - share) * self.noise
        return values

    def error(self, name: str) -> float:
        """Return an input's error in SI, or 0 if it does not vary; not for poses."""
        for one, value in zip(self.inputs, self.normal, strict=True):
            if one.name == name:
                return float(value) * one.deviation * UNITS.get(one.unit, 1.0)
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

    def turn(self, name: str) -> Array:
        """Return the error of a direction as a rotation vector (3,) rad: about ap, si, ml."""
        return np.array([self.error(f"{name}.about_{axis}") for axis in AXES])
