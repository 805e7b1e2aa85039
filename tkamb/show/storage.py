"""Results for other programs: OpenSim's .sto, .mot and .trc files, and figures as SVG, PDF, PNG."""

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure

from tkamb import __version__
from tkamb.errors import InputError
from tkamb.files import write_text
from tkamb.geometry.frames import Array
from tkamb.run.columns import KINDS
from tkamb.run.metrics import failed, flagged
from tkamb.show.axis import HorizontalAxis, horizontal_axis
from tkamb.show.headline import run_title
from tkamb.show.panels import centre_panel, panels
from tkamb.show.plots import Sheet
from tkamb.show.pressure_maps import draw_maps, draw_paths, mapped_frames, top_view
from tkamb.show.style import settings

if TYPE_CHECKING:
    from tkamb.run.results import Results


STORAGE = (".sto", ".mot")


def write_storage(path: Path, columns: Mapping[str, Array], in_degrees: bool) -> None:
    """Write a `.sto` or `.mot` table.

    Args:
        columns: name -> (n,) values. The first is "time", s.
        in_degrees: whether the header states degrees.
    """
    names = list(columns)
    lengths = {len(values) for values in columns.values()}
    if not names or names[0] != "time" or len(lengths) != 1:
        raise InputError("a storage file needs 'time' first and columns of one length", path)
    if blank := [name for name in names if not name or any(c.isspace() for c in name)]:
        raise InputError(f"column '{blank[0]}' has a blank in its name", path, "rename it")
    rows = np.stack([np.asarray(values, float) for values in columns.values()], axis=1)
    lines = [
        path.stem,
        "version=1",
        f"nRows={len(rows)}",
        f"nColumns={len(names)}",
        f"inDegrees={'yes' if in_degrees else 'no'}",
        "endheader",
        "\t".join(names),
        *("\t".join(f"{value:.10g}" for value in row) for row in rows),
    ]
    write_text(path, "\n".join(lines) + "\n")


def write_results_storage(results: "Results", path: Path) -> str:
    """Write the numbers of a run as a storage file.

    Columns keep their names, units (`_N`, `_mm`, `_deg`) and order, but `time_s` is called `time`,
    and a missing number is `nan`. `status` is 0 for "ok", 1 for a frame to be read with care, 2 for
    a failed frame.

    Returns:
        A line of text with the numbers of frames and columns.
    """
    if path.suffix.lower() not in STORAGE:
        raise InputError(f"does not end in {' or '.join(STORAGE)}", path, "rename the file")
    if os.path.lexists(path):
        raise InputError(
            "exists already", path, "give a new file: tkamb does not replace your files"
        )
    numbers = {name: v for name, v in results.columns.items() if KINDS.get(name) != "text"}
    time = numbers.pop("time_s")
    if not (np.diff(time) > 0).all():
        raise InputError("has times that do not increase; OpenSim needs this", results.directory)
    failures, doubtful = failed(results), flagged(results)
    status = np.where(failures, 2.0, np.where(doubtful, 1.0, 0.0))
    write_storage(path, {"time": time, **numbers, "status": status}, in_degrees=True)
    return (
        f"{len(status)} frames ({doubtful.sum()} to be read with care, "
        f"{failures.sum()} failed: nan), {len(numbers) + 2} columns"
    )


def write_trc(path: Path, time: Array, markers: Mapping[str, Array], rate_Hz: float) -> None:
    """Write markers as a `.trc` file in millimetres. A missing position has empty cells.

    Args:
        time: (n,) s, times of the rows.
        markers: label -> (n, 3) positions, m; NaN where missing.
        rate_Hz: sampling rate of the recording, Hz.

    Raises:
        InputError: the file cannot be written.
    """
    count, names = len(time), list(markers)
    header = ["DataRate", "CameraRate", "NumFrames", "NumMarkers", "Units"]
    header += ["OrigDataRate", "OrigDataStartFrame", "OrigNumFrames"]
    values = [f"{rate_Hz:g}", f"{rate_Hz:g}", f"{count}", f"{len(names)}", "mm"]
    values += [f"{rate_Hz:g}", "1", f"{count}"]
    axes = [f"{axis}{k}" for k in range(1, len(names) + 1) for axis in "XYZ"]
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{path.name}",
        "\t".join(header),
        "\t".join(values),
        "\t".join(["Frame#", "Time", *(f"{name}\t\t" for name in names)]),
        "\t".join(["", "", *axes]),
        "",
    ]
    positions = np.concatenate(list(markers.values()), axis=1) * 1e3
    for k, row in enumerate(positions):
        cells = ["" if np.isnan(value) else f"{value:.5f}" for value in row]
        lines.append("\t".join([str(k + 1), f"{time[k]:.6f}", *cells]))
    write_text(path, "\n".join(lines) + "\n")


PRINT_DPI = 300
"""Dots per inch of a PNG, as journals ask for lines and grey levels."""
FORMATS = ("svg", "pdf", "png")


def write_figures(results: "Results", folder: Path) -> list[str]:
    """Write every plot and map in each of `FORMATS`; return the names without suffix.

    Each file holds title, unit, the licence of the results and tkamb's version.
    """
    names = []
    for name, words, figure in _figures(results, horizontal_axis(results)):
        names.append(name)
        for kind in FORMATS:
            metadata = figure_metadata(results, words, kind)
            with settings():
                figure.savefig(folder / f"{name}.{kind}", dpi=PRINT_DPI, metadata=metadata)
    return names


def _figures(results: "Results", axis: HorizontalAxis) -> Iterator[tuple[str, str, Figure]]:
    drawn = [*panels(results), centre_panel(results)]
    if results.summary.get("muscle_groups"):
        from tkamb.show.muscles import muscle_panels

        drawn += muscle_panels(results)
    sheet = Sheet(results, axis)
    for panel in drawn:
        if panel.lines:
            yield panel.name, f"{panel.title} ({panel.unit})", sheet.draw(panel)
    view, frames = top_view(results), mapped_frames(results, axis)
    if view is not None and frames:
        yield "maps", "Pressure on the insert (MPa)", draw_maps(results, view, axis, frames)
        yield "paths", "Paths of the centres of pressure", draw_paths(results, view, axis, frames)


def figure_metadata(results: "Results", words: str, kind: str) -> dict[str, Any]:
    """Return the metadata of a figure file, under the keys of its format."""
    title = f"{run_title(results.summary)}: {words}"
    software = f"tkamb {__version__}"
    source = f"scene SHA-256 {results.summary.get('scene_sha256', 'unknown')}"
    licence = licence_of(results.summary)
    if kind == "png":
        return {"Title": title, "Software": software, "Description": source, "Copyright": licence}
    if kind == "pdf":
        return {"Title": title, "Creator": software, "Subject": source, "Keywords": licence}
    return {
        "Title": title,
        "Creator": software,
        "Description": source,
        "Rights": licence,
        "Date": None,  # so that the same run has the same file
    }


def licence_of(summary: Any) -> str:
    """Return the licence of the results, from [output] licence."""
    return str(summary.get("licence") or "not stated by the scene ([output] licence)")
