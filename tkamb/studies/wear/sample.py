"""One sample of a wear simulation: the case with errors in its inputs.

Varied inputs: the wear factor, the constants of creep, the insert's modulus, and the place of the
whole cycle (the constant part of each pose error; noise per frame averages out over millions of
cycles). Loads do not vary.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import KNEE_COORDINATES, Array, knee_coordinates, knee_pose
from tkamb.io.scene.uncertainty import UncertaintyTable
from tkamb.studies.uncertainty.inputs import Draw, VariedInput
from tkamb.studies.wear.creep import LogarithmicCreep
from tkamb.studies.wear.engine import ContactEngine
from tkamb.studies.wear.laws import WearLaw
from tkamb.studies.wear.motion import CycleMotion
from tkamb.studies.wear.simulation import WearCase, simulate_wear
from tkamb.studies.wear.sliding import SlidingHistory

BANDED = ("volume_mm3", "mass_mg", "max_depth_mm", "creep_depth_mm", "creep_volume_mm3")
"""Columns of wear.csv that have a band."""
POSES = {"ap": "mm", "ml": "mm", "adduction": "deg", "axial_rotation": "deg", "flexion": "deg"}
"""Knee coordinates that a pressed motion prescribes."""

Rows = Mapping[str, Array]


@dataclass(frozen=True)
class Scaled(WearLaw):
    """Another law times a factor.

    Args:
        law: of wear.
        factor: on every depth.
    """

    name: ClassVar[str] = "scaled"
    assumes: ClassVar[str] = "another law times a factor"

    law: WearLaw
    factor: float

    def depth(self, history: SlidingHistory) -> Array:
        """Return the depth of the other law times the factor, (n,) m."""
        return self.factor * self.law.depth(history)


def varied_wear_inputs(
    table: UncertaintyTable, motion: CycleMotion, creep: LogarithmicCreep | None, profile: bool
) -> tuple[VariedInput, ...]:
    """Return the inputs of a wear simulation that vary.

    Args:
        table: the scene's [uncertainty].
        motion: what its drive finds has no error of its own.
        creep: None: not modelled.
        profile: the motion is a simulator's. Its place varies only by what the table states: the
            defaults are those of a recorded pose.

    Raises:
        InputError: none varies.
    """
    result = () if motion.drive is None else motion.drive.names
    if not profile:
        table = table.completed(from_markers=False)
    inputs = [
        VariedInput(name, getattr(table, f"{name}_{unit}"), unit)
        for name, unit in POSES.items()
        if name not in result and getattr(table, f"{name}_{unit}") is not None
    ]
    inputs.append(VariedInput("young_modulus", table.young_modulus, "relative"))
    inputs.append(VariedInput("wear_factor", table.wear_factor, "relative"))
    if creep is not None:
        inputs.append(VariedInput("creep", table.creep, "relative"))
    varied = tuple(one for one in inputs if one.deviation > 0)
    if not varied:
        raise InputError("nothing of a wear simulation varies", "[uncertainty]", "--samples 0")
    return varied


def moved_case(case: WearCase, draw: Draw) -> WearCase:
    """Return a case with its inputs moved as a sample has them."""
    place = [draw.error(name) if name in POSES else 0.0 for name in KNEE_COORDINATES]
    offset = math.sqrt(draw.constant_share) * np.array(place)
    motion, drive, engine, creep = case.motion, case.motion.drive, case.engine, case.creep
    if offset.any():
        poses = knee_pose(knee_coordinates(motion.poses) + offset)
        if drive is not None:
            drive = replace(drive, coordinates=drive.coordinates + offset)
        path = motion.path
        if path is not None:
            path = path._replace(poses=knee_pose(knee_coordinates(path.poses) + offset))
        motion = replace(motion, poses=poses, path=path, drive=drive)
    if (stiffer := draw.factor("young_modulus")) != 1.0:
        assert isinstance(engine, ContactEngine)
        material = engine.material
        material = replace(material, young_modulus=material.young_modulus * stiffer)
        engine = replace(engine, material=material)
    if creep is not None:
        creep = creep.times(draw.factor("creep"))
    law = Scaled(case.law, draw.factor("wear_factor"))
    return replace(case, engine=engine, motion=motion, law=law, creep=creep)


class WearSampler:
    """Computes samples of one wear simulation.

    Args:
        simulation: the case as it stands, cycles, and updates of the geometry.
        inputs: that vary.
        constant_share: of a pose error's variance.
    """

    def __init__(
        self,
        simulation: tuple[WearCase, int, int],
        inputs: tuple[VariedInput, ...],
        constant_share: float,
    ) -> None:
        self._simulation, self._inputs, self._share = simulation, inputs, constant_share

    def __call__(self, number: int, normal: Array) -> Rows:
        """Return the columns of a sample's table; none where it has no contact.

        Args:
            number: of the sample; it changes nothing.
            normal: (d,) errors of the inputs in standard deviations.
        """
        case, cycles, updates = self._simulation
        draw = Draw(self._inputs, normal, np.zeros((1, 0)), self._share)
        try:
            state, _ = simulate_wear(moved_case(case, draw), cycles, updates)
        except InputError:  # the displaced femur lies beside the insert
            return {}
        return {key: np.array([row[key] for row in state.rows]) for key in ("cycles", *BANDED)}
