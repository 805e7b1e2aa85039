"""OpenSim models for the tests: two small models of tkamb, and published models."""

from functools import cache
from pathlib import Path

import pytest

from tkamb.io.opensim.kinematics import Kinematics
from tkamb.io.opensim.model import OpenSimModel
from tkamb.io.opensim.read import read_osim

HERE = Path(__file__).parent / "data"
DATA = Path(__file__).parents[2] / "shared" / "data"
OWN = {name: HERE / f"{name}.osim" for name in ("old_layout", "new_layout")}
PUBLISHED = {
    "DM": DATA / "dm" / "DM.osim",
    "JW": DATA / "jw" / "JW.osim",
    "gait2392": DATA / "opensim" / "gait2392.osim",
    "Rajagopal2016": DATA / "opensim" / "Rajagopal2016.osim",
}


@cache
def kinematics(name: str) -> Kinematics:
    """Return a model's kinematics. Skip the test if the model's file is absent."""
    path = (OWN | PUBLISHED)[name]
    if not path.is_file():
        pytest.skip(f"{name}'s file is absent from ../shared/data")
    return Kinematics(read_osim(path))


def model(name: str) -> OpenSimModel:
    """Return a model. Skip the test if the model's file is absent."""
    return kinematics(name).model
