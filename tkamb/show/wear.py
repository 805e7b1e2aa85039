"""The report's section on wear, from the files of `tkamb wear` in the folder of a run."""

import base64
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from tkamb.errors import InputError
from tkamb.files import MEGABYTE, read_bytes, read_json

if TYPE_CHECKING:
    from tkamb.run.results import Results

WEAR_NAME, PICTURE_NAME, WORN_NAME = "wear.json", "wear.png", "wear.vtp"


@dataclass(frozen=True)
class WearPageSettings:
    """The wear page."""

    max_bytes: float = 64 * MEGABYTE
    """Bytes of a file of results. Chosen: those of 10,000 updates have 10 MB."""


WEAR_PAGE = WearPageSettings()

ROWS = (
    ("worn volume, mm³", "volume_mm3"),
    ("worn mass, mg", "mass_mg"),
    ("largest depth, mm", "max_depth_mm"),
    ("mean depth where worn, mm", "mean_depth_mm"),
    ("worn area, mm²", "worn_area_mm2"),
    ("medial share of the volume", "medial_share"),
    ("volume per million cycles, mm³", "volume_mm3_per_Mc"),
    ("mass per million cycles, mg", "mass_mg_per_Mc"),
    ("creep depth, mm", "creep_depth_mm"),
    ("creep volume, mm³", "creep_volume_mm3"),
)
"""Label of a number, and its key."""
FIRST_RATE = "first_volume_mm3_per_Mc"
OTHER = (
    "The wear.json in this folder belongs to another scene, other frames or other meshes, or does "
    "not state them; it is not shown."
)


def wear_section(results: "Results") -> dict[str, Any] | None:
    """Return what the section shows; None where the folder holds no wear.

    Wear of another scene or of other frames than the run's is not shown, and that is said.

    Raises:
        InputError: wear.json or its picture cannot be read.
    """
    result, folder = wear_of_run(results), results.directory
    if result is None or folder is None:
        return None
    if not result:
        return {"other": OTHER}
    picture = base64.b64encode(read_bytes(folder / PICTURE_NAME, WEAR_PAGE.max_bytes)).decode(
        "ascii"
    )
    try:
        return _shown(result, picture)
    except (KeyError, TypeError, ValueError, AttributeError):
        hint = "run tkamb wear again, or remove it"
        raise InputError("is not as tkamb wear writes it", folder / WEAR_NAME, hint) from None


def _shown(wear: dict[str, Any], picture: str) -> dict[str, Any]:
    """Return the section of wear.json and its picture in base 64."""
    bands = wear["bands"] or {}
    return {
        "other": None,
        "first": wear["first"],
        "cycles": f"{wear['cycles']:,.0f}",
        "banded": bool(bands),
        "rows": [
            (name, _number(wear[key]), _range(wear, key), _band(bands, key)) for name, key in ROWS
        ],
        "geometry": wear.get("geometry"),
        "laws": [
            (one["law"], _number(one[FIRST_RATE]), _range(one, FIRST_RATE), one["geometry"])
            for one in wear.get("laws_side_by_side", ())
        ],
        "legend": _legend(wear, bands),
        "picture": f"data:image/png;base64,{picture}",
        "alt": "maps of wear, sliding, cross-shear and pressure, and the worn volume over cycles",
        "notes": [*wear["questions"], *wear["notes"]],
    }


def wear_of_run(results: "Results") -> dict[str, Any] | None:
    """Return wear.json beside a run; empty where scene, files or frames are others, None without.

    Wear of a scene's whole motion, or of a simulator's, holds beside any frames of a run.

    Raises:
        InputError: it cannot be read.
    """
    folder = results.directory
    if folder is None or not (folder / WEAR_NAME).is_file():
        return None
    result = read_json(folder / WEAR_NAME, WEAR_PAGE.max_bytes, what="wear.json")
    if not isinstance(result, dict) or not result.get("files_sha256"):
        return {}
    summary, scenes = results.summary, result.get("scene_sha256")
    identity = summary.get("identity") or {}
    files = identity.get("content of a file")
    same = isinstance(scenes, list) and summary.get("scene_sha256") in scenes
    if result.get("run_frames", ()) not in (None, identity.get("choice of frames")):
        return {}
    return result if same and files == result["files_sha256"] else {}


def _legend(wear: dict[str, Any], bands: dict[str, Any]) -> str:
    """Return in words the simulation, and its varied inputs."""
    words = (
        f"Law {wear['law']}, material {wear['material']}, {wear['control']} control, contact "
        f"{wear['contact']} at {wear['resolution_mm']:g} mm, {wear['blocks']} blocks of cycles; "
        f"status: {wear['status']}. Motion: {wear['source']}."
    )
    if "range_source" in wear:
        words += f" Range: by the wear factor alone, {wear['range_source']}."
    if not bands:
        return f"{words} No band: no input was varied."
    deviations = ", ".join(f"{name} {one:g}" for name, one in bands["standard_deviations"].items())
    return (
        f"{words} 5 to 95 % of {bands['samples']} samples; standard deviations: {deviations}. "
        f"Not in the band: {bands['not_varied']}."
    )


def _range(wear: dict[str, Any], key: str) -> str:
    """Return the range that the wear factor alone gives a number."""
    limits = wear.get(f"{key}_range")
    return "–" if limits is None else f"{_number(limits[0])} to {_number(limits[1])}"


def _band(bands: dict[str, Any], key: str) -> str:
    low, high = bands.get(f"{key}_p05"), bands.get(f"{key}_p95")
    return "–" if low is None or high is None else f"{_number(low)} to {_number(high)}"


def _number(value: float | None) -> str:
    return "not modelled" if value is None else f"{value:.4g}"
