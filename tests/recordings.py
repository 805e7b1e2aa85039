"""C3D files made for tests: markers, plates of any type, channels."""

from pathlib import Path

import ezc3d
import numpy as np

AMTI_CORNERS = np.array([[0.6, 0.4, 0.0], [0.0, 0.4, 0.0], [0.0, 0.0, 0.0], [0.6, 0.0, 0.0]])
"""Corners of a plate with axes x and y parallel to the file's, m."""


def write_c3d(
    path: Path,
    markers: dict[str, np.ndarray],
    *,
    rate: float = 100.0,
    first_frame: int = 0,
    ratio: int = 10,
    analog: dict[str, np.ndarray] | None = None,
    units: list[str] | None = None,
    plates: list[dict] | None = None,
    point_unit: str = "mm",
) -> Path:
    """Write markers (n, 3), m, analog channels (n * ratio) and plates with lengths in m."""
    scale = {"mm": 1e3, "m": 1.0}.get(point_unit, 1.0)
    count = len(next(iter(markers.values())))
    c = ezc3d.c3d()
    c["header"]["points"]["first_frame"] = first_frame
    c["parameters"]["POINT"]["RATE"]["value"] = [rate]
    c["parameters"]["POINT"]["UNITS"]["value"] = [point_unit]
    c["parameters"]["POINT"]["LABELS"]["value"] = list(markers)
    points = np.ones((4, len(markers), count))
    points[:3] = np.moveaxis(np.array(list(markers.values())), 2, 0) * scale
    c["data"]["points"] = points
    analog = analog or {}
    if analog:
        c["parameters"]["ANALOG"]["RATE"]["value"] = [rate * ratio]
        c["parameters"]["ANALOG"]["LABELS"]["value"] = list(analog)
        c["parameters"]["ANALOG"]["UNITS"]["value"] = units or [""] * len(analog)
        c["data"]["analogs"] = np.array(list(analog.values()))[None]
    if plates:
        _add_plates(c, plates, scale)
    c.write(str(path))
    return path


def _add_plates(c: ezc3d.c3d, plates: list[dict], scale: float) -> None:
    c.add_parameter("FORCE_PLATFORM", "USED", [float(len(plates))])
    c.add_parameter("FORCE_PLATFORM", "TYPE", [float(p["type"]) for p in plates])
    corners = np.stack([p.get("corners", AMTI_CORNERS).T * scale for p in plates], axis=2)
    c.add_parameter("FORCE_PLATFORM", "CORNERS", corners)
    origins = np.stack([np.array(p.get("origin", np.zeros(3))) * scale for p in plates], axis=1)
    c.add_parameter("FORCE_PLATFORM", "ORIGIN", origins)
    channels = np.stack([np.array(p["channels"], float) for p in plates], axis=1)
    c.add_parameter("FORCE_PLATFORM", "CHANNEL", channels)
    for key in ("USED", "TYPE", "CHANNEL"):  # `add_parameter` makes all numbers floating-point
        c["parameters"]["FORCE_PLATFORM"][key]["type"] = ezc3d.ezc3d.INT
    if any("matrix" in p for p in plates):
        matrices = np.stack([p.get("matrix", np.eye(6)) for p in plates], axis=2)
        c.add_parameter("FORCE_PLATFORM", "CAL_MATRIX", matrices)


def standing_markers(count: int = 20) -> dict[str, np.ndarray]:
    """Return markers (n, 3), m, that sway a little."""
    sway = 0.01 * np.sin(np.linspace(0.0, 6.0, count))
    places = {"JW:RHeel": (0.3, 0.2, 0.05), "JW:RToe": (0.5, 0.2, 0.04), "JW:Sacral": (0.3, 0.3, 1)}
    return {
        name: np.array(place) + np.outer(sway, [1.0, 0.3, 0.0]) for name, place in places.items()
    }
