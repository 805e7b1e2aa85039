"""The shank in the laboratory: its markers, and joint centres from its neighbours' markers."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array, inverse, transform
from tkamb.io.importing.links import Links
from tkamb.io.importing.markers import ModelSegment
from tkamb.io.importing.toml_text import toml_markers, toml_mm, toml_text
from tkamb.units import MILLIMETRE


@dataclass(frozen=True, eq=False)
class ShankMarkers:
    """Markers by which the tibia link stands in the laboratory.

    Args:
        path: of the recording.
        axes: the file's that point forward, up and right.
        points: label -> (3,) m in the tibia link.
        centres: joint centre that completes them -> its [[tibia.joint_centre]], line by line.
        said: lines on them.
    """

    path: Path
    axes: str
    points: dict[str, Array]
    centres: dict[str, list[str]]
    said: tuple[str, ...]

    def lines(self, path: str) -> list[str]:
        """Return the scene's [tibia]; `path` is the recording's, as TOML."""
        lines = ["[tibia]", 'kind = "markers"', f"file = {path}"]
        lines += [f'laboratory_axes = "{self.axes}"', f"markers_mm = {toml_markers(self.points)}"]
        for centre in self.centres.values():
            lines += ["", *centre]
        return lines


def shank_markers(
    links: Links,
    segments: Mapping[str, ModelSegment],
    femur: Array,
    recording: Path,
    axes: str,
) -> ShankMarkers:
    """Return the points that place the shank: its markers and, if fewer than three, joint centres.

    The ankle's centre is carried by three or more markers of the foot, the knee's by those of
    the thigh. Where the knee's centre lies in the shank is the mean over the poses given.

    Args:
        links: of the leg.
        segments: name -> the markers that were seen.
        femur: (n, 4, 4) m, the femur's body in the tibia link.
        recording: the file.
        axes: the file's that point forward, up and right.

    Raises:
        InputError: fewer than three points.
    """
    points = segments["shank"].points
    centres: dict[str, list[str]] = {}
    text: list[str] = []
    if len(points) < 3:
        centres, text = _carried(links, segments, femur)
    if len(points) + len(centres) < 3:
        raise InputError(
            f"shows {len(points)} markers of the shank and joint centres for {len(centres)} more; "
            "three are needed",
            recording,
            "three markers of the foot carry the ankle's centre, three of the thigh the knee's",
        )
    return ShankMarkers(recording, axes, points, centres, tuple(text))


def _carried(
    links: Links, segments: Mapping[str, ModelSegment], femur: Array
) -> tuple[dict[str, list[str]], list[str]]:
    """Return the joint centres that foot and thigh carry, and lines on them."""
    foot, thigh, leg = segments["foot"], segments["thigh"], links.leg
    centres: dict[str, list[str]] = {}
    text = []
    if len(foot.points) >= 3 and foot.centre is not None:
        centres["ankle_centre"] = _centre_lines(
            "ankle_centre", foot.points, foot.centre, np.zeros(3)
        )
        text.append(f"shank: its ankle centre is carried by the foot's {len(foot.points)} markers")
    if len(thigh.points) >= 3:
        own = {name: transform(links.femur, point) for name, point in thigh.points.items()}
        centre = transform(inverse(leg.neutral[leg.femur[0]]), leg.knee_centre)
        places = transform(femur, centre)
        mean = places.mean(axis=0)
        apart = np.sqrt(((places - mean) ** 2).sum(axis=1).mean()) / MILLIMETRE
        centres["knee_centre"] = _centre_lines("knee_centre", own, centre, mean)
        text.append(
            f"shank: its knee centre is carried by the thigh's {len(own)} markers, at the mean of "
            f"{len(places)} recorded poses ({apart:.1f} mm rms about it)"
        )
    return centres, text


def _centre_lines(
    name: str, markers: Mapping[str, Array], centre: Array, tibia: Array
) -> list[str]:
    """Return a [[tibia.joint_centre]]; markers and centre (3,) m are in the neighbour's frame."""
    return [
        "[[tibia.joint_centre]]",
        f"name = {toml_text(name)}",
        f"markers_mm = {toml_markers(markers)}",
        f"centre_mm = {toml_mm(centre)}",
        f"tibia_mm = {toml_mm(tibia)}",
    ]
