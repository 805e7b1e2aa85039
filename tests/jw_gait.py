"""Subject JW's overground gait trial og3: fitted model coordinates and plate loads."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import make_interp_spline

from tkamb.geometry.frames import Array
from tkamb.io.importing.model_fit import fit_model
from tkamb.io.opensim.kinematics import Kinematics
from tkamb.io.opensim.motion import CoordinateMotion
from tkamb.io.opensim.read import read_osim
from tkamb.io.recordings.filtering import differentiate_coordinates
from tkamb.io.recordings.ground_reaction import GroundReaction, load_ground_reaction
from tkamb.io.recordings.recording_tables import GroundReactionTable
from tkamb.io.recordings.tables import read_table
from tkamb.run.muscles.leg import foot_loads

JW = Path(__file__).parents[2] / "shared" / "data" / "jw"
AXES = "-x,+z,+y"
PLATES = {"right": (2, 3), "left": (1,)}
CUTOFF_HZ = 6.0
needs_jw = pytest.mark.skipif(not JW.is_dir(), reason="subject JW is absent from ../shared/data")


@dataclass(frozen=True, eq=False)
class Gait:
    """A trial: motion of the model, and side -> ground reaction.

    `loads` are body -> the same reactions as wrenches at ground's origin.
    """

    kinematics: Kinematics
    motion: CoordinateMotion
    reactions: dict[str, GroundReaction]

    @property
    def loads(self) -> dict[str, Array]:
        return foot_loads(self.kinematics.model, self.reactions)


@cache
def gait(start: float = 1.9, end: float = 4.2) -> Gait:
    path = JW / "motion" / "jw_ngait_og3.c3d"
    model = read_osim(JW / "JW.osim")
    recorded = read_table(path)
    chain, fit = fit_model(model, recorded, laboratory_axes=AXES)
    assert fit.solved.all()
    time = recorded.columns["time"]
    inside = time[(time >= start - 1e-9) & (time <= end + 1e-9)]
    q = differentiate_coordinates(time, fit.state, CUTOFF_HZ, inside)[0]
    reactions = {
        side: load_ground_reaction(
            GroundReactionTable(
                file=path, plates=plates, laboratory_axes=AXES, cutoff_Hz=CUTOFF_HZ
            ),
            inside,
            "right",
        )
        for side, plates in PLATES.items()
    }
    return Gait(chain.kinematics, natural_motion(inside, q), reactions)


def natural_motion(time: Array, q: Array) -> CoordinateMotion:
    """Return the motion of a natural quintic spline, which OpenSim fits to a coordinate file."""
    ends = [(order, np.zeros(q.shape[1])) for order in (3, 4)]
    spline = make_interp_spline(time, q, 5, bc_type=(ends, ends))
    return CoordinateMotion(time, q, spline(time, 1), spline(time, 2))
