"""Comparison of folders of results, and of the settings in which they differ."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array, Index
from tkamb.run import metrics
from tkamb.run.claims import peaks_of
from tkamb.run.columns import KINDS, SECONDS
from tkamb.run.identity import CODE, CONTACT_CODE
from tkamb.run.metrics import failed
from tkamb.run.results import Results
from tkamb.run.results_folder import read_results
from tkamb.show.axis import HorizontalAxis, horizontal_axis

if TYPE_CHECKING:
    from tkamb.run.results import Results


# deg, per cent or s: frames with a smaller distance on the axis are the same instant of one
# recording. It is above the rounding of files.
TOLERANCE = 1e-6


@dataclass(frozen=True, eq=False)
class Pairing:
    """Interpolation of another run at the f frames of the first run.

    Args:
        lower: the other run's frame before each frame of the first, (f,); -1: not comparable.
        upper: the other run's frame after each frame of the first, (f,).
        weight: weight of the upper frame, 0 to 1, (f,).
        exact: whether frames are paired at equal times, without interpolation.
    """

    lower: Index
    upper: Index
    weight: Array
    exact: bool

    def values(self, column: Array) -> Array:
        """Return a column of the other run at the first run's frames (f,); NaN: not comparable."""
        low, high = column[self.lower], column[self.upper]
        between = (1.0 - self.weight) * low + self.weight * high
        return np.where(self.lower < 0, np.nan, np.where(self.weight > 0, between, low))

    def nearest(self, frame: int) -> int | None:
        """Return the other run's frame nearest to a frame; None: not comparable."""
        if self.lower[frame] < 0:
            return None
        return int((self.upper if self.weight[frame] > 0.5 else self.lower)[frame])


def pair_frames(
    first: "Results", first_axis: HorizontalAxis, other: "Results", other_axis: HorizontalAxis
) -> Pairing | None:
    """Pair the frames of two runs.

    If every frame of the shorter run has a match at the same time and position, both have the same
    recording, and these frames are paired. Otherwise the other run is interpolated linearly within
    its range. Without monotonic axes the result is None.
    """
    same = _same_frames(first["time_s"], first_axis.values, other["time_s"], other_axis.values)
    if same is not None:
        return Pairing(same, same, np.zeros(len(same)), True)
    x, other_x = first_axis.values, other_axis.values
    signs = [np.sign(np.diff(values)) for values in (x, other_x)]
    if len(other_x) < 2 or not all((sign == signs[1][0]).all() and sign.all() for sign in signs):
        return None
    order = slice(None, None, int(signs[1][0]))
    rising = other_x[order]
    after = np.clip(np.searchsorted(rising, x, side="right"), 1, len(rising) - 1)
    weight = (x - rising[after - 1]) / (rising[after] - rising[after - 1])
    inside = (weight >= -1e-12) & (weight <= 1 + 1e-12)
    index = np.arange(len(other_x))[order]
    lower, upper = index[after - 1], index[after]
    lower, weight = np.where(weight >= 1.0, upper, lower), np.where(weight >= 1.0, 0.0, weight)
    return Pairing(np.where(inside, lower, -1), upper, np.clip(weight, 0.0, 1.0), False)


def _same_frames(
    first_time: Array, first_place: Array, other_time: Array, other_place: Array
) -> Index | None:
    """Return matching frames (f,), -1: none; None: another recording."""
    at = {float(time): k for k, time in enumerate(other_time)}
    result = np.array([at.get(float(time), -1) for time in first_time], np.int64)
    paired = result >= 0
    if paired.sum() < min(len(first_time), len(other_time)):
        return None
    near = np.abs(first_place[paired] - other_place[result[paired]]) <= TOLERANCE
    return result if near.all() else None


SETTINGS = {
    "side": "side",
    "lateral_axis": "direction of insert z",
    "body_mass_kg": "body mass, kg (so 1 BW is not the same force)",
    "height_mm": "body height, mm",
    "yield_stress_MPa": "yield stress, MPa (so areas above yield are not comparable)",
    "not_modelled": "not modelled",
    "assumptions": "assumptions",
}
"""Keys of summary.json that are reported where they differ."""
VERSIONS = "identity"
SAME = "Nothing differs: settings, input files, versions and code of the runs agree."


# Largest number of runs in a picture. More colours are hard to distinguish.
MAX_RUNS = 8


@dataclass(frozen=True, eq=False)
class Run:
    """One folder of results.

    Args:
        pairing: pairing with the frames of the first run; None: frames cannot be paired.
    """

    label: str
    folder: Path
    results: Results
    axis: HorizontalAxis
    pairing: Pairing | None


@dataclass(frozen=True)
class Difference:
    """Difference of one column: a run minus the first run.

    Args:
        percent: largest difference, % of the largest absolute value of the first run; NaN if that
            value is zero.
        at_frame: frame of the first run with the largest difference.
        at: position of this frame on the axis, deg, % or s.
    """

    run: str
    column: str
    max_abs: float
    percent: float
    at_frame: int
    at: float
    rms: float
    mean: float
    frames: int


@dataclass(frozen=True, eq=False)
class Comparison:
    """Comparison of runs with the first of them.

    Args:
    kind: horizontal axis: "flexion", "cycle" or "time".
    notes: sentences on different settings and on columns that cannot be compared.
    differences: one per column of each run after the first.
    """

    runs: tuple[Run, ...]
    kind: str
    notes: tuple[str, ...]
    differences: tuple[Difference, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return the content that `tkamb compare --json` prints."""
        return {
            "axis": self.kind,
            "runs": [
                {
                    "label": run.label,
                    "folder": str(run.folder),
                    "scene": run.results.summary.get("scene"),
                    "scene_sha256": run.results.summary.get("scene_sha256"),
                    "contact": run.results.summary.get("contact"),
                    "frames": len(run.results),
                    "failed_frames": int(failed(run.results).sum()),
                    "peaks_BW": peaks_of(run.results),
                    "peak_pressure": metrics.peak_pressure(run.results),
                    "paired": _pairing_word(run.pairing),
                }
                for run in self.runs
            ],
            "notes": list(self.notes),
            "differences": [
                asdict(one) | {"percent": one.percent if np.isfinite(one.percent) else None}
                for one in self.differences
            ],
        }


def compare_folders(folders: Sequence[str | Path], axis: str | None = None) -> Comparison:
    """Read folders of results and compare each with the first.

    Args:
        axis: "flexion", "cycle" or "time"; default: the axis of all the runs.
    """
    if not 2 <= len(folders) <= MAX_RUNS:
        what = f"needs two to {MAX_RUNS} folders of results, not {len(folders)}"
        raise InputError(what, "compare", "name each folder that `tkamb run` wrote")
    paths = [Path(folder) for folder in folders]
    loaded = [read_results(path) for path in paths]
    for path, results in zip(paths, loaded, strict=True):
        if not len(results):
            raise InputError("holds no frame", path, "run it again: tkamb run")
    kind = axis or _common_axis(paths, loaded)
    axes = [horizontal_axis(results, kind) for results in loaded]
    runs = tuple(
        Run(label, path, results, x, pair_frames(loaded[0], axes[0], results, x))
        for label, path, results, x in zip(_labels(paths), paths, loaded, axes, strict=True)
    )
    result = [one for run in runs[1:] for one in differences(runs[0], run)]
    return Comparison(runs, kind, tuple(_notes(runs)), tuple(result))


def _common_axis(paths: Sequence[Path], loaded: Sequence[Results]) -> str:
    kinds = [str(results.summary.get("axis") or "flexion") for results in loaded]
    for path, kind in zip(paths, kinds, strict=True):
        if kind != kinds[0]:
            what = f"is drawn over {kind}, {paths[0]} over {kinds[0]}"
            raise InputError(what, path, "choose one with --axis flexion, cycle or time")
    return kinds[0]


def _labels(paths: Sequence[Path]) -> list[str]:
    parts = [path.resolve().parts for path in paths]
    for count in range(1, max(map(len, parts)) + 1):
        labels = ["/".join(part[-count:]) for part in parts]
        if len(set(labels)) == len(labels):
            return labels
    return [f"{path} ({k})" for k, path in enumerate(paths, 1)]  # the same folder twice


def differences(first: Run, run: Run) -> list[Difference]:
    """Return the differences of all common columns, without frames that failed in one run."""
    if run.pairing is None:
        return []
    result = []
    for column, values in first.results.columns.items():
        if KINDS.get(column, "number") != "number":
            continue
        if column == "time_s" or column.endswith(SECONDS):
            continue
        if column not in run.results.columns:
            continue
        off = run.pairing.values(run.results[column]) - values
        if not np.isfinite(off).any():
            continue
        worst = int(np.nanargmax(np.abs(off)))
        largest = float(np.nanmax(np.abs(values)))
        result.append(
            Difference(
                run.label,
                column,
                float(abs(off[worst])),
                100.0 * float(abs(off[worst])) / largest if largest > 0 else float("nan"),
                worst,
                float(first.axis.values[worst]),
                float(np.sqrt(np.nanmean(off**2))),
                float(np.nanmean(off)),
                int(np.isfinite(off).sum()),
            )
        )
    return result


def _notes(runs: Sequence[Run]) -> list[str]:
    notes = []
    for key, words in SETTINGS.items():
        notes += _unlike(runs, words, [run.results.summary.get(key) for run in runs])
    tables = [run.results.summary.get("contact") or {} for run in runs]
    for key in sorted({key for table in tables for key in table}):
        notes += _unlike(runs, f"contact, {key}", [_whole(table.get(key)) for table in tables])
    notes += _unlike_tables(runs)
    notes += _unlike_inputs(runs)
    versions = [run.results.summary.get("versions") or {} for run in runs]
    for name in sorted({name for one in versions for name in one}):
        notes += _unlike(runs, f"the version of {name}", [one.get(name) for one in versions])
    for code in (CODE, CONTACT_CODE):
        codes = [(run.results.summary.get(VERSIONS) or {}).get(code) for run in runs]
        notes += _unlike(runs, code, codes)
    for run in runs:
        notes += _frames_note(runs[0], run)
    return notes


def _unlike_tables(runs: Sequence[Run]) -> list[str]:
    """Return a sentence for each differing key, without [contact], which has its own."""
    tables = [_flat(run.results.summary.get("scene_tables") or {}) for run in runs]
    names = dict.fromkeys(name for table in tables for name in table)
    return [
        note
        for name in names
        if not name.startswith("contact.") and name.partition(".")[0] != "base"
        for note in _unlike(runs, f"the setting {name}", [table.get(name) for table in tables])
    ]


def _flat(value: Any, name: str = "") -> dict[str, Any]:
    """Return dotted key -> value of nested tables. Entries of lists of tables have numbers."""
    if isinstance(value, list) and any(isinstance(one, dict) for one in value):
        value = {str(one.get("name", k)): one for k, one in enumerate(value)}
    if not isinstance(value, dict):
        return {name: value if not isinstance(value, list) else str(value)}
    prefix = f"{name}." if name else ""
    return {k: v for key, one in value.items() for k, v in _flat(one, f"{prefix}{key}").items()}


def _unlike_inputs(runs: Sequence[Run]) -> list[str]:
    """Return a sentence for each input file whose content differs.

    A file that only some runs read is in a setting.
    """
    inputs = [run.results.summary.get("inputs") or {} for run in runs]
    return [
        note
        for name in dict.fromkeys(name for one in inputs for name in one)
        if all(name in one for one in inputs)
        for note in _unlike(runs, f"the input file {name}", [one[name] for one in inputs])
    ]


def _unlike(runs: Sequence[Run], words: str, values: Sequence[Any]) -> list[str]:
    """Return one sentence if the values differ."""
    if all(value == values[0] for value in values):
        return []
    if all(isinstance(value, list) for value in values):
        shared = set(values[0]).intersection(*values)
        values = [[item for item in value if item not in shared] for value in values]
    listed = "; ".join(f"{run.label}: {_shown(v)}" for run, v in zip(runs, values, strict=True))
    return [f"The runs differ in {words}. {listed}."]


def _whole(value: Any) -> Any:
    return (", ".join(sorted(value)) or "nothing") if isinstance(value, list) else value


def _shown(value: Any) -> str:
    if isinstance(value, list | tuple):
        return ", ".join(map(str, value)) or "nothing"
    text = (
        "not given" if value is None else f"{value:g}" if isinstance(value, float) else str(value)
    )
    return text[:12] + "…" if len(text) == 64 else text


def _frames_note(first: Run, run: Run) -> list[str]:
    failures, count = int(failed(run.results).sum()), len(run.results)
    notes = (
        [f"{run.label}: {failures} of {count} frames failed and are not compared."]
        if failures
        else []
    )
    if run is first:
        return notes
    if run.pairing is None:
        return [
            *notes,
            f"{run.label}: not compared with {first.label}, because it has other frames and its "
            f"{run.axis.kind} does not rise or fall throughout. Try --axis time or cycle.",
        ]
    without = int((run.pairing.lower < 0).sum())
    if without:
        notes.append(f"{run.label}: {without} frames of {first.label} have no matching frame here.")
    if not run.pairing.exact:
        notes.append(
            f"{run.label}: its frames differ from the frames of {first.label}. Its values are "
            "interpolated between neighbouring frames."
        )
    return notes


def _pairing_word(pairing: Pairing | None) -> str:
    return "not" if pairing is None else "frame by frame" if pairing.exact else "interpolated"
