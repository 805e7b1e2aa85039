"""Writing of OpenSim files: `.sto` and `.mot` tables, `.trc` markers."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tkamb.errors import InputError
from tkamb.files import write_text
from tkamb.geometry.frames import Array
from tkamb.run.columns import KINDS
from tkamb.run.metrics import failed, flagged

if TYPE_CHECKING:
    from tkamb.run.results import Results

STORAGE = (".sto", ".mot")


def write_storage(path: Path, columns: Mapping[str, Array], in_degrees: bool) -> None:
    """Write a `.sto` or `.mot` table.

    Args:
        columns: name -> (n,) values. The first is "time", s.
        in_degrees: whether the header states degrees.

    Raises:
        InputError: "time" is not first, lengths differ, a name has a blank, or the file cannot be
            written.
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

    Columns keep their names, units (`_N`, `_mm`, `_deg`) and order; `time_s` is called `time`.
    A missing number is `nan`. The column `status` has numbers instead of words: 0 is "ok", 1 a
    frame to be read with care, 2 a failed frame.

    Returns:
        A line of text with the numbers of frames and columns.

    Raises:
        InputError: the suffix is another one, the file exists, times do not increase, or the file
            cannot be written.
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
