"""The released patella on pages, from the results of `scripts/measure/patella`."""

import json
import tomllib
from pathlib import Path
from typing import Any

import numpy as np

STORED = Path(__file__).parents[1] / "data" / "patella.json"
PUBLISHED = Path(__file__).parent / "published_patella.toml"
HEADS = {
    "ratio": "force over quadriceps",
    "tilt": "lateral tilt, deg",
    "shift": "lateral shift, mm",
    "area": "contact area, mm²",
    "si": "centre of pressure, superior, mm",
    "ml": "the same, lateral, mm",
}
BESIDE = """\
The shipped knee is nobody's: implant, motion and lines are made up. The table shows trends, and
predicts no patient. Made by `scripts/measure/patella` on {date}, code {code}. The button's
contact is `foundation` at 1 mm. In parentheses: range when one assumed input is changed at a time
(shares of medial and lateral head by 0.1, slack lengths of strands or retinacula by 2 mm)."""
MEANT = """\
The retinacula have the length of extension as slack length, because their strain rises from
extension: native medial patellofemoral ligament of twelve cadaver knees, J Exp Orthop 6 (2019),
doi:10.1186/s40634-019-0195-3, abstract. The assumed ones slacken with flexion, so that they hardly
act. Near extension the ratio is a tenth above the published range; with retinacula 2 mm shorter it
is twice as large. At the end of the bend it is above the range too, as with the plane patella. The
sign of tilt and shift depends on the assumed shares of the heads. Contact area rises with the
force. The tension of the quadriceps is that of the equations with this patella."""
TIMED = """\
`scripts/measure/patella` on {date}, code {code}: the shipped knee bend, every second
frame, femorotibial contact by the foundation at 1 mm, one thread, load of the machine
{load:.1f}: compare the ratios, not the times. All settings are solved in turn on every frame.
Times are medians; "times plane" is the median of the ratios in a frame. Changes of the
button's peak pressure, area and force from the finest setting, the lattice at 1 mm: median
(the one of largest size). The plane patella has no contact of the button here. "Frames"
counts the frames with an equilibrium."""


def differences(found: dict[str, dict[str, list[float]]]) -> list[dict[str, Any]]:
    """Return median times, ratios to the first setting, and changes from the last setting.

    A time ratio is the median over the frames, except the first, of the ratios of one frame. A
    change is the median and the one of largest size over the frames in which both settings have
    a result.

    Args:
        found: for each setting the seconds, and the peak pressure, area and force of the button.
    """
    names = list(found)
    first, finest = found[names[0]], found[names[-1]]
    rows = []
    for name in names:
        row: dict[str, Any] = {"name": name}
        seconds = np.array(found[name]["seconds"])[1:]
        row["ms"] = 1e3 * float(np.median(seconds))
        row["ratio"] = float(np.median(seconds / np.array(first["seconds"])[1:]))
        for key in ("peak", "area", "force"):
            change = np.array(found[name][key]) / np.array(finest[key]) - 1.0
            kept = change[np.isfinite(change)]
            largest = kept[np.argmax(np.abs(kept))] if len(kept) else np.nan
            row[key] = [float(np.median(kept)), float(largest)] if len(kept) else None
        row["frames"] = int(np.isfinite(found[name]["force"]).sum())
        rows.append(row)
    return rows


def stored() -> dict[str, Any]:
    """Return the stored results."""
    content: dict[str, Any] = json.loads(STORED.read_text(encoding="utf-8"))
    return content


def section() -> list[str]:
    """Return the lines of docs/validation.md."""
    found = stored()
    lines = ["## The released patella", "", BESIDE.format(**found), ""]
    lines += ["| flexion, deg | " + " | ".join(HEADS.values()) + " | ratio without retinacula |"]
    lines += ["| ---: |" + " ---: |" * (len(HEADS) + 1)]
    for row in found["rows"]:
        cells = [_range(row[name]) for name in HEADS]
        lines.append(
            f"| {row['flexion']:.0f} | " + " | ".join(cells) + f" | {row['ratio'][1]:.2f} |"
        )
    lines += ["", "| quantity | published | spread | source, part read | tkamb |"]
    lines += ["| --- | --- | --- | --- | ---: |"]
    text = PUBLISHED.read_text(encoding="utf-8")
    for value in tomllib.loads(text)["row"]:
        name, *flexion = value["ours"]
        if flexion:
            nearest = min(found["rows"], key=lambda row: abs(row["flexion"] - flexion[0]))
            ours = f"{_range(nearest[name])} at {nearest['flexion']:.0f} deg"
        else:
            nominal = [row[name][0] for row in found["rows"]]
            ours = f"{_number(min(nominal))} to {_number(max(nominal))} over the bend"
        cited = f"{value['cited']}, {value['read']}" if "cited" in value else ""
        lines.append(
            f"| {value['quantity']} | {value.get('published', 'no number found')} | "
            f"{value.get('spread', '')} | {cited} | {ours} |"
        )
    return [*lines, "", MEANT]


def _range(values: list[float]) -> str:
    texts = [_number(values[k]) for k in (0, 2, 3)]
    return f"{texts[0]} ({texts[1]} to {texts[2]})"


def _number(value: float) -> str:
    return f"{round(value, 2):.3g}"


def tradeoff() -> list[str]:
    """Return the lines of the block in docs/studies.md."""
    found = stored()
    names = " | ".join(f"{key} %" for key in ("peak p", "area", "force"))
    lines = [TIMED.format(**found), ""]
    lines += [
        f"| patella | ms per frame | times plane | {names} | frames |",
        "| --- |" + " ---: |" * 6,
    ]
    for row in found["settings"]:
        cells = [
            f"{100 * row[key][0]:+.2f} ({100 * row[key][1]:+.2f})"
            if row[key] and row is not found["settings"][-1]
            else ""
            for key in ("peak", "area", "force")
        ]
        lines.append(
            f"| {row['name']} | {row['ms']:.3g} | {row['ratio']:.3g} | "
            + " | ".join(cells)
            + f" | {row['frames'] or ''} |"
        )
    return lines
