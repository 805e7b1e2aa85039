"""The varied inputs of a case, their standard deviations, and their errors in one sample."""

from dataclasses import dataclass

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import KNEE_COORDINATES, Array
from tkamb.io.scene.case import Case
from tkamb.io.scene.uncertainty import SKIN_MARKER_ERROR, UncertaintyTable
from tkamb.units import DEGREE, MILLIMETRE

AXES = ("ap", "si", "ml")
COP_AXES = {"ap": 0, "ml": 2}
"""Direction -> axis of the laboratory frame."""
UNITS = {"mm": MILLIMETRE, "deg": DEGREE}
PATELLAR_LIGAMENT = "patellar_ligament"
MARKED = ("shank", "thigh")
"""Segments with varied marker positions."""
LINE_ENDS = ("origin", "insertion")
"""Ends of the line of a muscle that pulls the patella."""
GROUP_ENDS = ("shank", "thigh")
"""Segments to which the lines of a muscle group are attached."""
ACROSS_KNEE = ("thigh to shank", "thigh to foot")
"""Muscle groups with lines across the knee, see `tkamb.run.muscles.leg`."""


@dataclass(frozen=True)
class VariedInput:
    """One input that varies.

    Args:
        deviation: standard deviation of the input, in `unit`.
        unit: unit of the deviation: "mm", "deg", "relative", or "1" for a number without unit.
    """

    name: str
    deviation: float
    unit: str


def varied_inputs(case: Case) -> tuple[VariedInput, ...]:
    """Return the inputs of a case that have a standard deviation above 0.

    Pose coordinates come first, in the order of `KNEE_COORDINATES`.

    Raises:
        InputError: every standard deviation is 0.
    """
    inputs = tuple(varied for varied in _all_inputs(case) if varied.deviation > 0)
    if not inputs:
        raise InputError(
            "no input varies", "[uncertainty]", "give an input a standard deviation above 0"
        )
    return inputs


def held_inputs(case: Case) -> tuple[str, ...]:
    """Return the names of the inputs with standard deviation 0, as "dome" for "dome.ap"."""
    constants = [constant.name for constant in _all_inputs(case) if constant.deviation == 0]
    names = (f"{name.partition('.')[0]}{'_angles' * ('.about_' in name)}" for name in constants)
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
    """Return the table [uncertainty] of the scene, completed with the default deviations."""
    table = case.scene.uncertainty or UncertaintyTable()
    return table.completed(from_markers=case.scene.motion.markers is not None)


def pose_names(inputs: tuple[VariedInput, ...]) -> list[str]:
    """Return the names of the inputs that are knee coordinates."""
    return [varied.name for varied in inputs if varied.name in KNEE_COORDINATES]


def _pose_inputs(case: Case, table: UncertaintyTable) -> list[VariedInput]:
    contact, markers = case.scene.contact, case.scene.motion.markers
    # the equilibrium finds the superior-inferior position together with the released coordinates
    solved = (*contact.released, "si") if contact and contact.released else ()
    stated = (case.scene.uncertainty or UncertaintyTable()).model_fields_set
    inputs = []
    for name in KNEE_COORDINATES:
        unit = "mm" if name in AXES else "deg"
        key = f"{name}_{unit}"
        # the errors of the markers already vary a coordinate that is computed from them
        with_markers = markers is not None and name in markers.coordinates and key not in stated
        if name not in solved and not with_markers:
            inputs.append(VariedInput(name, getattr(table, key), unit))
    return inputs


def _marker_inputs(case: Case, table: UncertaintyTable) -> list[VariedInput]:
    markers = case.scene.motion.markers
    by_segment = {"shank": SKIN_MARKER_ERROR.shank_mm, "thigh": SKIN_MARKER_ERROR.thigh_mm}
    inputs: list[VariedInput] = []
    for segment in markers.segment if markers else ():
        if segment.name in MARKED:
            stated = table.markers_mm
            deviation = by_segment[segment.name] if stated is None else stated
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
                tilt = table.frontal_alignment_deg
                inputs.append(VariedInput("frontal_alignment", tilt, "deg"))
    if case.scene.contact is not None:
        inputs.append(VariedInput("friction", table.friction, "1"))
        inputs.append(VariedInput("young_modulus", table.young_modulus, "relative"))
        inputs.append(VariedInput("yield_stress", table.yield_stress, "relative"))
    return inputs


def _muscle_inputs(case: Case, table: UncertaintyTable) -> list[VariedInput]:
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
    ends = [(muscle.name, end) for muscle in case.muscles for end in LINE_ENDS]
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
    names = [muscle.name for muscle in case.muscles if muscle.wrap and muscle.wrap.band > 0]
    ligament = case.patellar_ligament
    if ligament is not None and ligament.wrap and ligament.wrap.band > 0:
        names.append(PATELLAR_LIGAMENT)
    return names


def _tissue_inputs(case: Case, table: UncertaintyTable) -> list[VariedInput]:
    inputs = []
    for bundle in (*case.ligaments, *case.patella_ligaments):
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
        normal: standard normal value of each input, shape (d,).
        noise: standard normal value of each of the p pose inputs at each frame, shape (f, p).
        constant_share: share of the variance of a pose error that is constant over the frames.
    """

    inputs: tuple[VariedInput, ...]
    normal: Array
    noise: Array
    constant_share: float

    def standardised(self) -> Array:
        """Return the errors of the inputs at each frame, in standard deviations, shape (f, d)."""
        values = np.tile(self.normal, (len(self.noise), 1))
        poses = [i for i, varied in enumerate(self.inputs) if varied.name in KNEE_COORDINATES]
        share = self.constant_share
        values[:, poses] *= np.sqrt(share)
        values[:, poses] += np.sqrt(1.0 - share) * self.noise
        return values

    def error(self, name: str) -> float:
        """Return the error of an input in SI units; 0 if it does not vary. Not for poses."""
        for varied, value in zip(self.inputs, self.normal, strict=True):
            if varied.name == name:
                return float(value) * varied.deviation * UNITS.get(varied.unit, 1.0)
        return 0.0

    def factor(self, name: str) -> float:
        """Return a log-normal factor of mean 1 with the relative deviation of the input."""
        for varied, value in zip(self.inputs, self.normal, strict=True):
            if varied.name == name:
                log_variance = np.log1p(varied.deviation**2)
                return float(np.exp(np.sqrt(log_variance) * value - 0.5 * log_variance))
        return 1.0

    def place(self, name: str) -> Array:
        """Return the error of a position, m, shape (3,): ap, si, ml."""
        return np.array([self.error(f"{name}.{axis}") for axis in AXES])

    def turn(self, name: str) -> Array:
        """Return the error of an orientation as a rotation vector, rad, shape (3,): ap, si, ml."""
        return np.array([self.error(f"{name}.about_{axis}") for axis in AXES])
