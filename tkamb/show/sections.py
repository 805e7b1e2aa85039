"""Sections of the report: conclusions, tables of the motion and of flagged frames, and wear."""

import base64
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import TYPE_CHECKING, Any

import numpy as np

from tkamb.errors import InputError
from tkamb.files import MEGABYTE, read_bytes, read_json
from tkamb.geometry.frames import Array
from tkamb.io import texts
from tkamb.run import metrics
from tkamb.run.claims import compared_forces, method_error, peaks_of, split_of
from tkamb.run.known_errors import is_large, known_error_words
from tkamb.run.metrics import body_weight, medial_share, residual_share, tension_ratio
from tkamb.show.axis import HorizontalAxis
from tkamb.show.headline import OTHER_ERRORS, PRESSURE_AND_AREA

if TYPE_CHECKING:
    from tkamb.run.results import Results


def conclusions(results: "Results") -> tuple[list[str], list[str]]:
    """Return the conclusions that a run supports, and those that it does not support."""
    summary = results.summary
    compared, error = compared_forces(summary), summary.get("known_error")
    words = texts.lines(
        "tkamb.show",
        "conclusions.txt",
        questions=summary.get("questions") or [],
        modelled=bool(np.isfinite(results["force_total_N"]).any()),
        compared=compared,
        compared_split=bool(compared.keys() & {"medial", "lateral"}),
        error=method_error(summary),
        frames=len(results),
        failed=int(metrics.failed(results).sum()),
        split=split_of(results.columns),
        known_error=error,
        large=error is not None and is_large(error, PRESSURE_AND_AREA),
        error_words="" if error is None else _known_error(error),
        foundation=(summary.get("contact") or {}).get("model", "").startswith("foundation"),
        varied=bool(summary.get("uncertainty")),
    )
    return tuple([one[2:] for one in words if one[0] == sign] for sign in "+-")  # type: ignore[return-value]


def _known_error(error: Mapping[str, Any] | str) -> str:
    return f"{known_error_words(error, PRESSURE_AND_AREA)} {OTHER_ERRORS}"


def lead(results: "Results", axis: HorizontalAxis) -> list[tuple[str, str]]:
    """Return the first lines of the report: peak forces, their error, limits of use, notes."""
    split = split_of(results.columns)
    unsupported = conclusions(results)[1]
    words = texts.lines(
        "tkamb.show",
        "lead.txt",
        peaks=peaks_of(results),
        split=split,
        weight=body_weight(results),
        error=method_error(results.summary),
        compared=compared_forces(results.summary),
        at=axis.at,
        kind=axis.kind,
        notes=results.summary.get("notes") or [],
        wrong=[one[:1].lower() + re.split(r"[:.]", one[1:])[0] for one in unsupported],
    )
    return [(head, text) for head, _, text in (line.partition(" | ") for line in words)]


Entry = tuple[str, str, Array, int]
"""Heading, unit, values (f,), number of decimals."""

NUMBER = re.compile(r"-?\d+(?:\.\d+)?")


@dataclass(frozen=True)
class TextTable:
    """A table of texts.

    Args:
        headings: heading of each column, a name or (name, unit).
        rows: cells of each row. In a table of strains, the name of the bundle comes first.
    """

    headings: Sequence[Any]
    rows: Sequence[Sequence[str]]


def motion_table(results: "Results", axis: HorizontalAxis) -> TextTable:
    """Return the table of results at the frames of `HorizontalAxis.stops`."""
    entries = [entry for entry in _entries(results, axis) if np.isfinite(entry[2]).any()]
    stops = axis.stops(13 if axis.kind == "flexion" else 11)
    return TextTable(
        [(name, unit) for name, unit, *_ in entries],
        [[_number(values[k], digits) for *_, values, digits in entries] for k in stops],
    )


def strain_table(summary: Mapping[str, Any]) -> TextTable | None:
    """Return the table of the ligaments' strains, %. A high strain suggests a wrong insertion."""
    result = summary.get("ligament_strain")
    if not result:
        return None
    return TextTable(
        [f"{angle:g}°" for angle in result["flexion_deg"]],
        [
            [name, *("–" if one is None else _number(100.0 * one, 1) for one in strain)]
            for name, strain in result["strain"].items()
        ],
    )


def flag_rows(results: "Results", axis: HorizontalAxis) -> list[tuple[str, str, str, str]]:
    """Return a row per status other than "ok": reason, number of frames, frames and places."""
    return [
        (reason, str(len(frames)), _stretches(frames), _positions(frames, axis))
        for reason, frames in reasons(results.status).items()
    ]


def reasons(statuses: Sequence[str]) -> dict[str, list[int]]:
    """Return reason in plain words -> frames with this reason, failures first.

    Reasons that differ only in a number become one reason with the range of the number.
    """
    result: dict[str, list[tuple[int, str]]] = {}
    for frame, status in enumerate(statuses):
        failure = status.startswith("failed")
        for position, word in enumerate(status.removeprefix("failed:").split(";")):
            words = word.strip().replace("_", " ")
            if words and words != "ok":
                words = f"failed: {words}" if failure and position == 0 else words
                result.setdefault(NUMBER.sub("#", words), []).append((frame, words))
    rows = {
        _with_ranges([words for _, words in one]): [k for k, _ in one] for one in result.values()
    }
    return dict(sorted(rows.items(), key=lambda item: not item[0].startswith("failed")))


def _with_ranges(variants: Sequence[str]) -> str:
    """Return one text with ranges for texts that differ only in their numbers."""
    columns = zip(*(NUMBER.findall(words) for words in variants), strict=True)
    ranges = []
    for numbers in columns:
        low, high = min(numbers, key=float), max(numbers, key=float)
        ranges.append(low if low == high else f"{low}–{high}")
    parts = NUMBER.split(variants[0])
    return "".join(a + b for a, b in zip_longest(parts, ranges, fillvalue=""))


def _runs(frames: Sequence[int]) -> list[tuple[int, int]]:
    runs: list[tuple[int, int]] = []
    for frame in frames:
        if runs and runs[-1][1] == frame - 1:
            runs[-1] = (runs[-1][0], frame)
        else:
            runs.append((frame, frame))
    return runs


def _stretches(frames: Sequence[int]) -> str:
    return _listed([str(a) if a == b else f"{a}–{b}" for a, b in _runs(frames)])


def _positions(frames: Sequence[int], axis: HorizontalAxis) -> str:
    return _listed(
        [axis.at(a) if a == b else f"{axis.at(a)} to {axis.at(b)}" for a, b in _runs(frames)]
    )


def _listed(stretches: list[str]) -> str:
    more = len(stretches) - STRETCHES_SHOWN
    return ", ".join(stretches[:STRETCHES_SHOWN]) + (f" and {more} more" if more > 0 else "")


def _entries(results: "Results", axis: HorizontalAxis) -> list[Entry]:
    weight = body_weight(results)
    entries: list[Entry] = [("flexion", "deg", results["flexion_deg"], 1)]
    if axis.kind != "flexion":
        unit = "%" if axis.kind == "cycle" else "s"
        digits = 0 if axis.kind == "cycle" else 2
        entries.insert(0, (axis.kind, unit, axis.values, digits))
    entries.append(("resultant force", "BW", results["force_total_BW"], 2))
    split = split_of(results.columns)
    short = {"deformation": "deform.", "equilibrium": "equil."}.get(split.estimate, "")
    for side in ("medial", "lateral"):
        unit = f"N, {short}" if short else "N"
        entries.append((side, unit, results[split.column(side)], 0))
    entries.append(("medial share", "deform.", medial_share(results, "deformation"), 2))
    entries.append(("medial share", "equil.", medial_share(results, "equilibrium"), 2))
    for name, column, digits in (
        ("area", "area_mm2", 0),
        ("peak", "peak_pressure_MPa", 1),
    ):
        unit = "mm²" if name == "area" else "MPa"
        for side in ("medial", "lateral"):
            entries.append((f"{side} {name}", unit, results[f"{side}_{column}"], digits))
    entries.append(("quadriceps", "BW", results["quadriceps_N"] / weight, 2))
    entries.append(("PL/Q", "–", tension_ratio(results, "patellar_ligament_N"), 2))
    entries.append(("PF/Q", "–", tension_ratio(results, "patellofemoral_N"), 2))
    entries.append(("residual", "% of SI", 100 * residual_share(results), 1))
    return entries


def _number(value: float, digits: int) -> str:
    if np.isnan(value):
        return "–"
    text = f"{value:.{digits}f}"
    return text.removeprefix("-") if float(text) == 0 else text.replace("-", "−")


STRETCHES_SHOWN = 60
"""1: stretches of frames that a table lists. Not studied."""
WEAR_NAME, PICTURE_NAME, WORN_NAME = "wear.json", "wear.png", "wear.vtp"


# Bytes: largest size of a file. The file of 10,000 updates has 10 MB.
MAX_BYTES = 64 * MEGABYTE


WEAR_ROWS = (
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
"""Label and key of each number."""
FIRST_RATE = "first_volume_mm3_per_Mc"
OTHER_WEAR = (
    "The wear.json of this folder is not shown: it belongs to another scene, other frames or other "
    "meshes, or does not name them."
)


def wear_section(results: "Results") -> dict[str, Any] | None:
    """Return the content of the section on wear; None: the folder has no wear.json.

    If wear.json belongs to another scene or other frames, the section states only this.
    """
    result, folder = wear_of_run(results), results.directory
    if result is None or folder is None:
        return None
    if not result:
        return {"other": OTHER_WEAR}
    picture = base64.b64encode(read_bytes(folder / PICTURE_NAME, MAX_BYTES)).decode("ascii")
    try:
        return _wear_content(result, picture)
    except (KeyError, TypeError, ValueError, AttributeError):
        hint = "run tkamb wear again, or remove it"
        raise InputError("is not as tkamb wear writes it", folder / WEAR_NAME, hint) from None


def _wear_content(wear: dict[str, Any], picture: str) -> dict[str, Any]:
    bands = wear["bands"] or {}
    return {
        "other": None,
        "first": wear["first"],
        "cycles": f"{wear['cycles']:,.0f}",
        "banded": bool(bands),
        "rows": [
            (name, _significant(wear[key]), _wear_range(wear, key), _wear_band(bands, key))
            for name, key in WEAR_ROWS
        ],
        "geometry": wear.get("geometry"),
        "laws": [
            (
                one["law"],
                _significant(one[FIRST_RATE]),
                _wear_range(one, FIRST_RATE),
                one["geometry"],
            )
            for one in wear.get("laws_side_by_side", ())
        ],
        "legend": _wear_legend(wear, bands),
        "picture": f"data:image/png;base64,{picture}",
        "alt": "maps of wear, sliding, cross-shear and pressure, and the worn volume over cycles",
        "notes": [*wear["questions"], *wear["notes"]],
    }


def wear_of_run(results: "Results") -> dict[str, Any] | None:
    """Return the content of wear.json in a run's folder; None: the folder has no such file.

    The result is empty if wear.json belongs to another scene, other files or other frames. If the
    wear was computed from the whole motion or from a simulator's cycle, the frames of the run are
    not compared.
    """
    folder = results.directory
    if folder is None or not (folder / WEAR_NAME).is_file():
        return None
    result = read_json(folder / WEAR_NAME, MAX_BYTES, what="wear.json")
    if not isinstance(result, dict) or not result.get("files_sha256"):
        return {}
    summary, scenes = results.summary, result.get("scene_sha256")
    identity = summary.get("identity") or {}
    files = identity.get("content of a file")
    same = isinstance(scenes, list) and summary.get("scene_sha256") in scenes
    if result.get("run_frames", ()) not in (None, identity.get("choice of frames")):
        return {}
    return result if same and files == result["files_sha256"] else {}


def _wear_legend(wear: dict[str, Any], bands: dict[str, Any]) -> str:
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


def _wear_range(wear: dict[str, Any], key: str) -> str:
    """Return in words the range of a number over the range of the wear factor."""
    limits = wear.get(f"{key}_range")
    return "–" if limits is None else f"{_significant(limits[0])} to {_significant(limits[1])}"


def _wear_band(bands: dict[str, Any], key: str) -> str:
    low, high = bands.get(f"{key}_p05"), bands.get(f"{key}_p95")
    return "–" if low is None or high is None else f"{_significant(low)} to {_significant(high)}"


def _significant(value: float | None) -> str:
    return "not modelled" if value is None else f"{value:.4g}"
