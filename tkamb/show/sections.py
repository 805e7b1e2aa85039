"""Sections of the report in words, and its Methods paragraph.

It states models, equations, numbers, parts that are not modelled, software and references, mainly
by `scene_tables` in summary.json; `assets/methods.txt` has the words.
"""

import base64
import re
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import TYPE_CHECKING, Any

import numpy as np

from tkamb.errors import InputError
from tkamb.files import MEGABYTE, read_bytes, read_json
from tkamb.geometry.frames import Array
from tkamb.io import texts
from tkamb.knee.ligament_laws import LIGAMENT_LAWS
from tkamb.run import metrics
from tkamb.run.claims import compared_forces, method_error, peaks_of, split_of
from tkamb.run.columns import WITHOUT_MUSCLES
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
    """Return the ligaments' strains, %; a high one suggests a wrong insertion."""
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

    Reasons that differ only in a number become one, with its range.
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
    """Return one text with ranges for texts of other numbers."""
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

    It is empty if wear.json belongs to the button, another scene, other files or other frames. The
    frames are not compared if the wear is of the whole motion or a simulator's cycle.
    """
    folder = results.directory
    if folder is None or not (folder / WEAR_NAME).is_file():
        return None
    result = read_json(folder / WEAR_NAME, MAX_BYTES, what="wear.json")
    if not isinstance(result, dict) or not result.get("files_sha256") or result.get("part"):
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


# Largest number of characters in a line. Terminals show it without breaks.
LINE_WIDTH = 92


REFERENCES = {
    "Abdel-Rahman 1998": "Abdel-Rahman EM, Hefzy MS (1998). Three-dimensional dynamic behaviour of "
    "the human knee joint under impact loading. Med Eng Phys 20:276.",
    "Bei 2004": "Bei Y, Fregly BJ (2004). Multibody dynamic simulation of knee contact mechanics. "
    "Med Eng Phys 26:777. doi:10.1016/j.medengphy.2004.07.004",
    "Blankevoort and Huiskes 1991": "Blankevoort L, Huiskes R (1991). Ligament-bone interaction in "
    "a three-dimensional model of the knee. J Biomech Eng 113:263. doi:10.1115/1.2894883",
    "Blankevoort 1991": "Blankevoort L et al. (1991). Articular contact in a three-dimensional "
    "model of the knee. J Biomech 24:1019. doi:10.1016/0021-9290(91)90019-J",
    "Carpentier 2019": "Carpentier J et al. (2019). The Pinocchio C++ library. Proc IEEE/SICE SII, "
    "614. doi:10.1109/SII.2019.8700380",
    "de Leva 1996": "de Leva P (1996). Adjustments to Zatsiorsky-Seluyanov's segment inertia "
    "parameters. J Biomech 29:1223. doi:10.1016/0021-9290(95)00178-6",
    "Grood 1983": "Grood ES, Suntay WJ (1983). A joint coordinate system for the clinical "
    "description of three-dimensional motions. J Biomech Eng 105:136. doi:10.1115/1.3138397",
    "Halloran 2005": "Halloran JP, Petrella AJ, Rullkoetter PJ (2005). Explicit finite element "
    "modeling of total knee replacement mechanics. J Biomech 38:323. "
    "doi:10.1016/j.jbiomech.2004.02.046",
    "Hughes 1980": "Hughes TJR (1980). Generalization of selective integration procedures to "
    "anisotropic and nonlinear media. Int J Numer Meth Eng 15:1413. doi:10.1002/nme.1620150914",
    "Johnson 1985": "Johnson KL (1985). Contact Mechanics. Cambridge University Press. "
    "doi:10.1017/CBO9781139171731",
    "Lu 1999": "Lu TW, O'Connor JJ (1999). Bone position estimation from skin marker "
    "co-ordinates. J Biomech 32:129. doi:10.1016/S0021-9290(98)00158-4",
    "Sharma 2008": "Sharma A (2008). Development of a computational model to predict the in vivo "
    "contact mechanics of modern total knee arthroplasty. Ph.D. dissertation, The University of "
    "Tennessee, Knoxville.",
    "Shin 2007": "Shin CS, Chaudhari AM, Andriacchi TP (2007). The influence of deceleration "
    "forces on ACL strain during single-leg landing. J Biomech 40:1145.",
    "Woltring 1986": "Woltring HJ (1986). A Fortran package for generalized, cross-validatory "
    "spline smoothing and differentiation. Adv Eng Softw 8:104. "
    "doi:10.1016/0141-1195(86)90098-7",
}

CONTACT_WORDS = {
    "hertz": "Hertz's theory (Johnson 1985): on each condyle an elliptical patch between surfaces "
    "of constant curvature, a rigid femoral component on a linear elastic half-space",
    "foundation": "an elastic foundation of independent columns under a rigid femoral component "
    "(Blankevoort 1991, Bei 2004), p = sigma(-(M/E) ln(1 - d/h)) with d the penetration along the "
    "insert's normal, h the local thickness, M = E(1 - nu)/((1 + nu)(1 - 2 nu)) and sigma the "
    "uniaxial curve of the material",
    "foundation-linear": "an elastic foundation of independent linear columns under a rigid "
    "femoral component (Blankevoort 1991), p = M d/h with d the penetration along the insert's "
    "normal, h the local thickness and M = E(1 - nu)/((1 + nu)(1 - 2 nu))",
    "lattice": "a lattice of springs between each node and its 26 neighbours (Sharma 2008), "
    "calibrated cell by cell to E and nu, with one secant shear modulus a cell from its "
    "equivalent strain and an elastic bulk modulus; the femoral component is rigid and "
    "frictionless, the strain small",
    "lattice-linear": "a lattice of springs between each node and its 26 neighbours (Sharma 2008), "
    "calibrated cell by cell to E and nu, linear elastic; the femoral component is rigid and "
    "frictionless, the strain small",
    "lattice-source": "the spring lattice of Sharma (2008): one stiffness for all springs, "
    "k = E C, displacement driven",
    "fe": "finite elements, hexahedra with B-bar (Hughes 1980), with J2 deformation theory; the "
    "femoral component is rigid and frictionless, the strain small",
}

ROTATION_ORDERS = {
    "coordinates": "the six coordinates of Grood and Suntay (1983)",
    "pose": "three-dimensional poses of the femoral component in the insert, turned into the "
    "coordinates of Grood and Suntay (1983)",
    "markers": "skin markers",
}


@dataclass(frozen=True)
class Methods:
    """A Methods paragraph.

    Args:
        references: cited publications, sorted.
    """

    sentences: tuple[str, ...]
    references: tuple[str, ...]

    def text(self) -> str:
        """Return the paragraph and its references as plain text."""
        paragraph = textwrap.fill(" ".join(self.sentences), LINE_WIDTH)
        cited = [
            textwrap.fill(line, LINE_WIDTH, subsequent_indent="  ") for line in self.references
        ]
        return "\n".join([paragraph, "", "References", *cited])


def methods(summary: Mapping[str, Any]) -> Methods:
    """Return the Methods paragraph of a run.

    Raises:
        InputError: the summary has no `scene_tables`. A version before 0.2.0 wrote it.
    """
    tables = summary.get("scene_tables")
    if not isinstance(tables, Mapping):
        raise InputError(
            "does not say what was modelled (no 'scene_tables')",
            "summary.json",
            "run the scene again with this version",
        )
    sentences = texts.lines(
        "tkamb.show",
        "methods.txt",
        strict=False,  # tables and keys of a scene are optional
        tables=tables,
        summary=summary,
        versions=summary.get("versions", {}),
        measures=summary.get("measures") or {},
        contact_words=CONTACT_WORDS,
        rotations=ROTATION_ORDERS,
        laws=_laws(tables),
        generic=_generic_bundles(tables),
        material=_material_words(tables, summary),
        weights=_weights(tables["motion"].get("markers") or {}),
        meshes=MESH_NAMES,
        error=method_error(summary),
        compared=compared_forces(summary),
        # the template has sentences on the muscles that the scene lacks
        notes=[one for one in summary.get("notes") or () if not one.startswith(WITHOUT_MUSCLES)],
    )
    text = " ".join(sentences)
    cited = [full for key, full in REFERENCES.items() if _is_cited(key, text)]
    return Methods(tuple(sentences), tuple(sorted(cited)))


def _is_cited(key: str, text: str) -> bool:
    author, year = key.rsplit(" ", 1)
    return (
        f"{author} {year}" in text
        or f"{author} ({year})" in text
        or (key == "Grood 1983" and "Grood and Suntay (1983)" in text)
    )


def _weights(markers: Mapping[str, Any]) -> str:
    values = {w for one in markers.get("segment", ()) for w in (one.get("weights") or {}).values()}
    return "equal" if values <= {1.0} else "as in the scene file"


def _laws(tables: Mapping[str, Any]) -> dict[str, tuple[str, str]]:
    """Return name -> words and source of the ligaments' laws. Generic bundles are "two-line"."""
    names = {one["law"] for one in tables.get("ligament") or ()} | {"two-line"}
    laws = {name: LIGAMENT_LAWS.find(name) for name in LIGAMENT_LAWS.names() if name in names}
    return {name: (law.words, law.source) for name, law in laws.items()}


def _generic_bundles(tables: Mapping[str, Any]) -> dict[str, Any]:
    chosen = (tables.get("generic_ligaments") or {}).get("ligaments") or ()
    if not chosen:
        return {}
    from tkamb.knee.ligaments import BUNDLES

    return {name: one for name, one in BUNDLES.items() if name.split("_")[0] in chosen}


MESH_NAMES = {"femoral": "femoral component", "insert": "insert", "patella": "patellar button"}


def _material_words(tables: Mapping[str, Any], summary: Mapping[str, Any]) -> str:
    if summary.get("material"):
        from tkamb.io.given_material import material_in_words  # imports scipy

        return f"The insert was of {material_in_words(summary['material'])}."
    name = (tables.get("contact") or {}).get("material")
    if name == "polyethylene":
        return (
            "The insert was polyethylene: E = 561.5 MPa, nu = 0.45, Ramberg–Osgood with "
            "alpha = 0.0389, sigma0 = 8.4194 MPa, n = 4.5485 (Halloran 2005, as fitted by "
            "Sharma 2008)."
        )
    return f"The insert was '{name}'."
