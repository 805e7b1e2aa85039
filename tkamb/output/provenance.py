"""What the report says about where a run came from: the keys of summary.json."""

from html import escape
from typing import Any

SUMMARY_KEYS: dict[str, str] = {
    "title": "heading of the report; default: the scene's name",
    "scene": "path of the scene file",
    "scene_sha256": "hash of the scene file and of what it names",
    "started": "date and time, ISO 8601",
    "command": "command line",
    "versions": "package -> version",
    "seconds": "part -> computing time",
    "contact": "model, resolution_mm, material and the model's other options; absent: no contact",
    "known_error": "largest relative errors of the contact model on the reference cases of the "
    "trade-off (approach, force, mean_pressure, peak_pressure, area; cases: how many), or "
    "'not measured'",
    "split_not_determined_frames": "in how many frames split_determined is 0",
    "side": "right or left: the subject's knee",
    "lateral_axis": "+z (default; left knees are mirrored at input) or -z, in the results' frame",
    "frame": "a sentence on frame and side",
    "body_mass_kg": "body mass; one BW is this x 9.80665 m/s²",
    "height_mm": "body height, for moments in %BW·height",
    "yield_stress_MPa": "of the insert's material",
    "axis": "the report's horizontal axis: flexion, cycle or time",
    "cycle_percent_s": "times of 0 % and of 100 % of the cycle; default: first and last frame",
    "residuals": "a sentence on where the residuals act and what they mean",
    "notes": "list of sentences: assumptions, departures, what a reader must know",
    "questions": "list of sentences: what is unlikely about the input, with the likely mistake",
    "assumptions": "list of sentences",
    "not_modelled": "list: what the scene leaves out",
    "first_wrapping_flexion_deg": "least flexion at which the quadriceps wraps the femur; or null",
    "ligament_strain": "flexion_deg: list; strain: bundle -> list, null where not recorded",
    "failed_frames": "list of {frame, time_s, status}",
    "identity": "what makes two runs the same: scene, its files, frames, version and code",
    "inputs": "path -> SHA-256 of the scene file and of the files it names",
    "files": "results.csv and contact.h5 -> SHA-256",
    "summary_sha256": "of all the rest of the summary",
}
"""What `Results.summary` may hold for the report, beyond anything else that JSON can hold."""

SHOWN = ("scene", "scene_sha256", "started", "command", "versions", "seconds", "contact", "frame")


def provenance_rows(summary: dict[str, Any]) -> str:
    """Return the table rows (HTML) that say where the run came from."""
    rows = []
    for key in SHOWN:
        if summary.get(key) not in (None, "", {}, []):
            name = key.replace("_", " ").replace("sha256", "SHA-256")
            rows.append(f"<tr><th>{escape(name)}</th><td>{_shown(summary[key])}</td></tr>")
    return "".join(rows)


def sentences(summary: dict[str, Any]) -> list[str]:
    """Return what a reader must know, one sentence each, without repeats."""
    found: list[str] = []
    for key in ("residuals", "notes", "assumptions"):
        value = summary.get(key) or []
        found.extend([value] if isinstance(value, str) else [str(item) for item in value])
    missing = summary.get("not_modelled")
    if missing:
        found.append("Not modelled: " + ", ".join(map(str, missing)) + ".")
    return list(dict.fromkeys(found))


def _shown(value: Any) -> str:
    if isinstance(value, dict):
        kept = {str(k).replace("_", " "): v for k, v in value.items() if v not in (None, {}, [])}
        return ", ".join(f"{escape(name)} {_shown(item)}" for name, item in kept.items())
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list | tuple):
        return ", ".join(_shown(item) for item in value)
    if isinstance(value, float):
        return f"{value:.4g}"
    return escape(str(value))
