"""Types of the values in summary.json, checked before any use.

A results folder may come from someone else. A key of the tables below must have a value as tkamb
writes it; otherwise the folder is refused. Other keys may have any value.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from tkamb.errors import InputError

Kind = Any
"""Type of a value: a word of `WORDS`, a list [kind of the items], a dict key -> kind, or a tuple of
alternatives."""

WORDS = ("text", "number", "count", "null", "any", "other law")
ANY_KEY = "*"
"""Key in a dict of kinds for all other keys. A key that ends in "?" may be missing."""


@dataclass(frozen=True)
class SummaryCheckSettings:
    """Limits of the values in a summary."""

    largest_number: float = 1e15
    """1: largest absolute value. No quantity of a run is as large, and its square is finite."""
    deepest: int = 30
    """1: largest depth of nested objects and lists. tkamb writes seven."""


SUMMARY_CHECK = SummaryCheckSettings()


def optional(kinds: Mapping[str, Kind]) -> dict[str, Kind]:
    """Return kinds for keys that may be missing or null."""
    return {f"{key}?": (kind, "null") for key, kind in kinds.items()}


KNOWN = ("number", "null")
TEXTS = ["text"]
ERRORS = {"approach?": "number", "force?": KNOWN, "mean_pressure": "number"} | {
    "peak_pressure": "number",
    "area": "number",
}
COMPARED = {
    "predicted?": "text",
    "frames_compared": "count",
    "frames_failed": "count",
    "frames_without_measurement": "count",
    "frames_without_prediction": "count",
    "measured_where_not_compared_N": ([], ["number", "number"]),
}
WHERE_COMPARED = COMPARED | {
    "rmse_N": "number",
    "rmse_BW": "number",
    "bias_N": "number",
    "r_squared": KNOWN,
    "pearson_r": KNOWN,
    "peak_predicted_N": "number",
    "peak_predicted_time_s": "number",
    "peak_measured_N": "number",
    "peak_measured_time_s": "number",
}
MEASURED = {ANY_KEY: (COMPARED | {"frames_compared": 0}, WHERE_COMPARED)}
PEAK = {
    "words": "text",
    "median": KNOWN,
    **optional({"p05": "number", "p95": "number", "nominal_percentile": "number"}),
}
BAND_ENDS = ("median", "p05", "p95")
WIDE_ENDS = ("discrepancy_p05", "discrepancy_p95")
NO_BAND = {f"{end}?": "null" for end in BAND_ENDS}
NO_WIDE_BAND = {f"{end}?": "null" for end in WIDE_ENDS}
NOMINAL = {"nominal": "number"}
PEAK_BW = (
    NOMINAL | NO_BAND | NO_WIDE_BAND,
    NOMINAL | dict.fromkeys(BAND_ENDS, "number") | NO_WIDE_BAND,
    NOMINAL | dict.fromkeys((*BAND_ENDS, *WIDE_ENDS), "number"),
)
"""A peak force: without bands, with the band from the inputs, or with both bands."""
UNCERTAINTY = {
    "samples": "count",
    "not_varied": TEXTS,
    "largest_failed_share": "number",
    **optional(
        {
            "peak_force_total_BW": PEAK,
            "peaks_BW": {ANY_KEY: PEAK_BW},
            "causes_of_failure": {ANY_KEY: "any"},
            "shares_of_variance": {ANY_KEY: {ANY_KEY: KNOWN}},
            "measured_inside": {ANY_KEY: {"frames": "count", "share": KNOWN}},
        }
    ),
}
CONTACT = {"model": "text", "resolution_mm": "number"} | optional(
    {
        "material": "text",
        "released": TEXTS,
        "coupling": "text",
        "options": {ANY_KEY: "any"},
    }
)
MATERIAL = {
    "name": "text",
    "young_modulus_MPa": "number",
    "poisson_ratio": "number",
    "sources": TEXTS,
}
LAWS = (
    MATERIAL
    | {
        "law": "ramberg-osgood",
        "alpha": "number",
        "reference_stress_MPa": "number",
        "exponent": "number",
    },
    MATERIAL | {"law": "tabulated", "strain": ["number"], "stress_MPa": ["number"]},
    MATERIAL | {"law": "other law"},
)
BUNDLE = {"name": "text", "law": "text"} | optional(
    {
        "stiffness_N_per_mm": "number",
        "stiffness_N_per_strain": "number",
        "slack_length_mm": "number",
        "reference_strain": "number",
        "reference_flexion_deg": "number",
    }
)
CUTOFF = ("none", "number")
TABLES = {
    "patient": {"side": "text", "mass_kg": "number"}
    | optional({"height_mm": "number", "sex": "text"}),
    "motion": {"interpretation": "text", "cutoff_Hz": CUTOFF}
    | optional(
        {
            "motion": "text",
            "slip_share": "number",
            "markers": {"method": "text"}
            | optional({"segment": [optional({"weights": {ANY_KEY: "number"}})]}),
        }
    ),
} | optional(
    {
        "ground_reaction": {"applied": "text", "cutoff_Hz": CUTOFF},
        "ligament": [BUNDLE],
        "generic_ligaments": {"ligaments": TEXTS},
        "patella": {"motion": "text"},
        "quadriceps": {ANY_KEY: "any"},
        "muscle": [{"name": "text"}],
        "muscles": {
            "weights": "text",
            "exponent": "number",
            "least_activation": "number",
            "law": "text",
            **optional({"least_condyle_share": "number"}),
            "reserve_Nm?": ("number", {ANY_KEY: "number"}, "null"),
        },
        "contact": {
            "model": "text",
            "resolution_mm": "number",
            "friction": "number",
            **optional({"material": "text", "released": TEXTS, "coupling": "text"}),
        },
        "implant": {ANY_KEY: "any"} | optional({"insert": optional({"bearing": "text"})}),
    }
)
SUMMARY = optional(
    {
        "title": "text",
        "scene": "text",
        "scene_sha256": "text",
        "command": "text",
        "started": "text",
        "overrides": {ANY_KEY: "any"},
        "preset": {"name": "text"},
        "versions": {ANY_KEY: "text"},
        "seconds": {ANY_KEY: KNOWN},
        "side": ("left", "right"),
        "frame": "text",
        "body_mass_kg": "number",
        "height_mm": "number",
        "yield_stress_MPa": "number",
        "axis": ("flexion", "cycle", "time"),
        "lateral_axis": "text",
        "activity": "text",
        "frames": "count",
        "failed_frames": ["any"],
        "flagged_frames": "count",
        "peak_force_total_BW": "number",
        "peaks_BW": {ANY_KEY: PEAK_BW},
        "peak_pressure": {
            "MPa": "number",
            "side": "text",
            "frame": "count",
            "time_s": "number",
            **optional({"doubt": "text"}),
        },
        "discrepancy": {ANY_KEY: "any"} | optional({"words": "text"}),
        "gait": {
            "stance_s": [["number", "number"]],
            "toe_off_percent": ["number"],
            ANY_KEY: "any",
        },
        "saturated_muscles": {ANY_KEY: "count"},
        "not_modelled": TEXTS,
        "assumptions": TEXTS,
        "notes": TEXTS,
        "residuals": "text",
        "questions": TEXTS,
        "scene_tables": TABLES,
        "changed_settings": {ANY_KEY: "any"},
        "measures": {
            "frame_rate_Hz?": "number",
            "meshes": {ANY_KEY: {"triangles": "count", "edge_mm": "number"}},
            "insert_thickness_mm?": ["number", "number"],
            "tolerances?": {ANY_KEY: "number"},
        },
        "ligament_strain": {"flexion_deg": ["number"], "strain": {ANY_KEY: [KNOWN]}},
        "first_wrapping_flexion_deg": "number",
        "muscle_groups": {ANY_KEY: TEXTS},
        "reserves": {
            ANY_KEY: {
                "largest_Nm": "number",
                "percent_of_largest_moment": "number",
                "frames_above_5_percent": "count",
            }
        },
        "measured": MEASURED,
        "emg": optional(
            {"muscles": {ANY_KEY: {"channel": "text", "pearson_r": KNOWN}}, "settings": "any"}
        ),
        "contact": CONTACT,
        "material": LAWS,
        "known_error": (
            "text",
            ERRORS | {"cases": "count"} | optional({"situations": {ANY_KEY: ERRORS}}),
        ),
        "split_not_determined_frames": "count",
        "cycle_percent_s": ["number", "number"],
        "uncertainty": UNCERTAINTY,
        "identity": {ANY_KEY: ("text", ["any"])}
        | optional(
            {
                "choice of frames": ["count"],
                "content of a file": "text",
                "code of tkamb": "text",
                "version of tkamb": "text",
            }
        ),
        "inputs": {ANY_KEY: "text"},
        "files": {ANY_KEY: "text"},
        "summary_sha256": "text",
        "resumed_frames": "count",
        "unfinished_frames": "count",
    }
)


def check_summary(summary: object, path: object) -> None:
    """Raise unless the values of a summary have the types that tkamb writes.

    Args:
        summary: content of a summary.json.
        path: path of the file, for the message.

    Raises:
        InputError: a value has a wrong type, is too large or nested too deep.
    """
    _check_depth(summary, path)
    wrong = _difference(summary, SUMMARY, "")
    if wrong is not None:
        raise InputError(wrong, path, "give a folder that `tkamb run` wrote, or run it again")


def _check_depth(value: object, path: object) -> None:
    """Raise for a number that is too large or values nested too deep, under any key."""
    unchecked: list[tuple[object, int]] = [(value, 0)]
    while unchecked:
        one, depth = unchecked.pop()
        if depth > SUMMARY_CHECK.deepest:
            raise InputError(f"nests values more than {SUMMARY_CHECK.deepest} deep", path)
        if isinstance(one, Mapping):
            unchecked += [(item, depth + 1) for item in one.values()]
        elif isinstance(one, list):
            unchecked += [(item, depth + 1) for item in one]
        elif isinstance(one, int | float) and not abs(one) <= SUMMARY_CHECK.largest_number:
            raise InputError("holds a number that is not finite or beyond 1e15", path)


def _difference(value: Any, kind: Kind, where: str) -> str | None:
    """Return a message on a value that is not of a kind, else None."""
    if isinstance(kind, tuple):
        problems = [_difference(value, one, where) for one in kind]
        return None if None in problems else max(filter(None, problems), key=_depth_of_message)
    if isinstance(kind, dict):
        return _difference_of_keys(value, kind, where)
    if isinstance(kind, list):
        if not isinstance(value, list):
            return f"'{where}' is {_shown(value)}, not a list"
        kinds = kind * len(value) if len(kind) == 1 else kind
        if len(kinds) != len(value):
            return f"'{where}' has {len(value)} items, not {len(kinds)}"
        pairs = zip(value, kinds, strict=True)
        problems = [_difference(one, item, f"{where}.{k}") for k, (one, item) in enumerate(pairs)]
        return next(filter(None, problems), None)
    if kind in WORDS:
        return None if _is(value, kind) else f"'{where}' is {_shown(value)}, not a {kind}"
    return None if value == kind else f"'{where}' is {_shown(value)}, not {kind!r}"


def _difference_of_keys(value: Any, kinds: Mapping[str, Kind], where: str) -> str | None:
    if not isinstance(value, Mapping):
        return f"'{where or 'content'}' is {_shown(value)}, not an object"
    other_kind = kinds.get(ANY_KEY, "any")
    for name, kind in kinds.items():
        key = name.removesuffix("?")
        if name == ANY_KEY:
            continue
        place = f"{where}.{key}" if where else key
        if key not in value:
            if not name.endswith("?"):
                return f"'{place}' is missing"
            continue
        if (wrong := _difference(value[key], kind, place)) is not None:
            return wrong
    for key, item in value.items():
        if key not in kinds and f"{key}?" not in kinds:
            wrong = _difference(item, other_kind, f"{where}.{key}" if where else str(key))
            if wrong is not None:
                return wrong
    return None


def _depth_of_message(text: str) -> int:
    return text.count(".")


def _is(value: Any, word: str) -> bool:
    is_integer = isinstance(value, int) and not isinstance(value, bool)
    return {
        "text": isinstance(value, str),
        "number": is_integer or (isinstance(value, float) and math.isfinite(value)),
        "count": is_integer and value >= 0,
        "null": value is None,
        "other law": isinstance(value, str) and value not in ("ramberg-osgood", "tabulated"),
        "any": True,
    }[word]


def _shown(value: Any) -> str:
    """Return a short text for a value of any size."""
    if isinstance(value, Mapping | list):
        return "an object" if isinstance(value, Mapping) else "a list"
    text = "null" if value is None else repr(value)
    return text if len(text) <= 40 else f"{text[:40]}…"
