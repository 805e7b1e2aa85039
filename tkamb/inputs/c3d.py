"""C3D recordings: markers, force plates and other analog channels, in SI, with gaps as NaN.

The clock is the recording's own: frame k of the file is at (first frame + k)/rate, with the
first frame as ezc3d gives it (counted from zero), so that a trial cut out of a longer one keeps
its times. A sample with a negative residual, or at exactly (0, 0, 0), was not seen: a gap.

Format: C3D user guide, https://www.c3d.org.
"""

import struct
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tkamb.errors import InputError
from tkamb.geometry.frames import Array
from tkamb.inputs.force_plates import CHANNELS, ForcePlate, force_plate
from tkamb.units import LENGTH

_BLOCK = 512
_INTEL, _KEY = 84, 0x50
_LONGEST = 65535
"""Frames that the header's 16 bits can count; longer recordings say so in TRIAL."""
_EXPORT = "export the trial again as C3D"


@dataclass(frozen=True, eq=False)
class Recording:
    """One trial, in the axes of the file.

    Args:
        path: the file.
        rate_Hz: of the markers.
        first_frame: number of the first frame, counted from zero.
        labels: (m) of the markers, as in the file.
        points: (n, m, 3) m; gaps are NaN.
        residual: (n, m) m, of the markers' reconstruction; NaN in gaps.
        analog_rate_Hz: samples per second of the channels.
        channels: name -> (k,) of those channels that belong to no plate, EMG among them.
        channel_units: name -> unit, as in the file.
        plates: the force plates, in the file's order.
    """

    path: Path
    rate_Hz: float
    first_frame: int
    labels: tuple[str, ...]
    points: Array
    residual: Array
    analog_rate_Hz: float
    channels: dict[str, Array]
    channel_units: dict[str, str]
    plates: tuple[ForcePlate, ...]

    @property
    def time(self) -> Array:
        """(n,) s, of the frames."""
        return (self.first_frame + np.arange(len(self.points))) / self.rate_Hz

    @property
    def analog_time(self) -> Array:
        """(k,) s, of the channels and plates, on the same clock."""
        ratio = round(self.analog_rate_Hz / self.rate_Hz)
        count = len(self.points) * ratio
        return (self.first_frame * ratio + np.arange(count)) / self.analog_rate_Hz


def read_c3d(path: str | Path) -> Recording:
    """Read a C3D file.

    Raises:
        InputError: no such file, not C3D or cut short, no markers, units or rates that do not
            fit, or a force plate that cannot be read; the message names it.
    """
    path = Path(path)
    try:
        changed = path.stat().st_mtime_ns
    except OSError:
        raise InputError("no such file", path, "check the path") from None
    return _read(path, changed)


@lru_cache(maxsize=2)
def _read(path: Path, changed: int) -> Recording:
    """Read the file as it was at `changed`; markers and plates of one trial are asked apart."""
    held = _check_whole(path)
    content = _parsed(path)
    parameters, header = content["parameters"], content["header"]
    points, data = header["points"], content["data"]
    labels = _labels(parameters["POINT"], path)
    rate = float(points["frame_rate"])
    if not labels or not points["size"]:
        raise InputError("holds no markers", path, _EXPORT)
    if not (np.isfinite(rate) and rate > 0):
        raise InputError(f"markers have a rate of {rate:g} Hz", path, _EXPORT)
    scale = _metres(_first(parameters["POINT"], "UNITS"), path)
    trajectories = np.moveaxis(data["points"][:3], 0, 2).transpose(1, 0, 2) * scale
    residual = np.asarray(data["meta_points"]["residuals"], float)[0].T * scale
    gap = ~np.isfinite(trajectories).all(axis=2) | (residual < 0) | (trajectories == 0).all(axis=2)
    trajectories[gap], residual[gap] = np.nan, np.nan
    analog_rate, channels, units = _channels(content, rate, held, path)
    plates = _plates(parameters, channels, units, scale, path)
    used = {name for plate in plates for name in plate.channels}
    return Recording(
        path,
        rate,
        int(points["first_frame"]),
        labels[: trajectories.shape[1]],
        trajectories,
        residual,
        analog_rate,
        {name: values for name, values in channels.items() if name not in used},
        {name: unit for name, unit in units.items() if name not in used},
        plates,
    )


def _check_whole(path: Path) -> int:
    """Raise unless the file is C3D and as long as its own header says.

    ezc3d fills what is missing with zeros, or worse.

    Returns:
        Analog samples a frame, by the header; 0 without any or in another machine's numbers.
    """
    content = path.read_bytes()
    if len(content) < _BLOCK or content[1] != _KEY:
        raise InputError("is not a C3D file", path, "give a recording in C3D")
    start = (content[0] - 1) * _BLOCK
    if start < _BLOCK or len(content) < start + 4:
        raise InputError("is cut short: its parameters are missing", path, "copy it again")
    if content[start + 3] != _INTEL:
        return 0  # another machine's numbers: ezc3d turns them
    markers, analog, first, last = struct.unpack("<4H", content[2:10])
    scale, data_block, samples = struct.unpack("<fHH", content[12:20])
    frames, size = last - first + 1, (4 * markers + analog) * (4 if scale < 0 else 2)
    there = max(len(content) - (data_block - 1) * _BLOCK, 0)
    if last < _LONGEST and there < frames * size:
        share = 100.0 * there / (frames * size)
        raise InputError(
            f"is cut short: it holds {share:.0f} % of its {frames} frames", path, "copy it again"
        )
    return int(samples) if analog else 0


def _parsed(path: Path) -> Any:
    import ezc3d

    try:
        return ezc3d.c3d(str(path))
    except Exception as error:  # the reader raises what its bindings make of C++ exceptions
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"cannot be read as C3D ({reason})", path, _EXPORT) from None


def _first(group: Any, key: str) -> Any:
    value = group[key]["value"] if key in group else []
    return value[0] if len(value) else None


def _labels(group: Any, path: Path) -> tuple[str, ...]:
    """Return LABELS, LABELS2, … in one: each holds 255 at most."""
    names: list[str] = []
    for key in sorted((k for k in group if k.startswith("LABELS")), key=lambda k: (len(k), k)):
        names += [str(name).strip() for name in group[key]["value"]]
    repeated = sorted({name for name in names if name and names.count(name) > 1})
    if repeated:
        raise InputError(f"has two channels or markers '{repeated[0]}'", path, "rename one")
    return tuple(names)


def _metres(unit: str | None, path: Path) -> float:
    if unit not in LENGTH:
        stated = f"the unit '{unit}'" if unit else "no unit"
        raise InputError(f"states {stated} for its markers (POINT:UNITS)", path, "m, cm or mm")
    return LENGTH[unit]


def _channels(
    content: Any, rate: float, held: int, path: Path
) -> tuple[float, dict[str, Array], dict[str, str]]:
    """Return rate (Hz), samples and units of the analog channels, by name.

    `held` is how many samples a frame the header counts; 0 if it says nothing.
    """
    group, values = content["parameters"].get("ANALOG", {}), content["data"]["analogs"][0]
    stated = _first(group, "RATE")
    if held and stated:
        _check_rates(float(stated), rate, held, path)
    if not values.shape[0] or not values.shape[1]:
        return rate, {}, {}
    analog_rate = float(stated or content["header"]["analogs"]["frame_rate"])
    names = [name or f"channel {k}" for k, name in enumerate(_labels(group, path), 1)]
    names += [f"channel {k}" for k in range(len(names) + 1, values.shape[0] + 1)]
    stated = [str(unit).strip() for unit in group["UNITS"]["value"]] if "UNITS" in group else []
    units = [*stated, *[""] * len(names)]
    columns = dict(zip(names, np.asarray(values, float), strict=False))
    return analog_rate, columns, dict(zip(names, units, strict=False))


def _check_rates(analog_rate: float, rate: float, held: int, path: Path) -> None:
    """Raise unless the rates that a file states are those of what it holds.

    ezc3d goes by the rates: where they are wrong it takes samples for markers.
    """
    ratio = analog_rate / rate
    if ratio < 1 or abs(ratio - round(ratio)) > 1e-6:
        raise InputError(
            f"analog rate {analog_rate:g} Hz is no multiple of the markers' {rate:g} Hz",
            path,
            _EXPORT,
        )
    if round(ratio) != held:
        raise InputError(
            f"states an analog rate of {analog_rate:g} Hz, but holds {held} samples a frame of "
            f"{rate:g} Hz",
            path,
            _EXPORT,
        )


def _plates(
    parameters: Any,
    channels: dict[str, Array],
    units: dict[str, str],
    scale: float,
    path: Path,
) -> tuple[ForcePlate, ...]:
    group: Any = parameters.get("FORCE_PLATFORM", {})
    count = int(_first(group, "USED") or 0)
    plates = []
    names = list(channels)
    for k in range(count):
        where = f"{path}: force plate {k + 1}"
        try:
            kind = int(group["TYPE"]["value"][k])
            corners = np.asarray(group["CORNERS"]["value"], float)[:, :, k].T * scale
            origin = np.asarray(group["ORIGIN"]["value"], float)[:, k] * scale
            wanted = np.asarray(group["CHANNEL"]["value"], int)[: CHANNELS.get(kind, 6), k]
        except (KeyError, IndexError, ValueError):
            raise InputError("is not described in full", where, _EXPORT) from None
        if len(wanted) and (wanted.min() < 1 or wanted.max() > len(names)):
            raise InputError(f"asks for channel {wanted.max()} of {len(names)}", where, _EXPORT)
        own = tuple(names[channel - 1] for channel in wanted)
        matrix = _calibration(group, k)
        signals = np.array([channels[name] for name in own])
        plates.append(
            force_plate(
                k + 1, kind, corners, origin, own, signals, [units[n] for n in own], matrix, where
            )
        )
    return tuple(plates)


def _calibration(group: Any, k: int) -> NDArray[np.float64] | None:
    """Return the calibration matrix (6, 6) of plate k, columns by channel; None without one."""
    matrices = np.asarray(group["CAL_MATRIX"]["value"], float) if "CAL_MATRIX" in group else None
    if matrices is None or matrices.ndim != 3 or matrices.shape[2] <= k:
        return None
    return matrices[:, :, k]
