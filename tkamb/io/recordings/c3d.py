"""C3D recordings: markers, force plates and other analog channels, in SI, with gaps as NaN.

Frame k of the file is at the time (first frame + k)/rate. The first frame is counted from zero, so
that a trial cut out of a longer one keeps its times. A marker with a negative residual, or at
exactly (0, 0, 0), is missing in that frame: a gap.

An error in markers, channels or one plate is raised only when that part is used.

Format: C3D user guide, https://www.c3d.org.
"""

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np

from tkamb.errors import InputError, names_near
from tkamb.files import TABLE_BYTES, read_bytes
from tkamb.geometry.frames import Array
from tkamb.io.recordings.c3d_file import EXPORT, C3dFile, Parameters, parse_c3d
from tkamb.io.recordings.force_plates import CHANNELS, ForcePlate, PlateRecord, force_plate
from tkamb.io.recordings.laboratory import GivenUnits, metres

# Largest measured value in any unit. A larger value is damaged and becomes a gap.
MAX_VALUE = 1e12


PLATE_PARAMETERS = ("USED", "TYPE", "CORNERS", "ORIGIN", "CHANNEL", "ZERO", "CAL_MATRIX", "UNITS")
"""Parameters of the group FORCE_PLATFORM that are understood."""
COP_POLYNOMIAL = "FPCOPPOLY"
"""Kistler's polynomial for the centre of pressure, in axes whose sense the file does not state."""


@dataclass(frozen=True, eq=False)
class Recording:
    """One trial, in the axes of the file.

    Args:
        rate_Hz: frames per second of the markers.
        first_frame: number of the first frame, counted from zero.
        labels: (m) names of the markers as in the file; `marker 7` for a marker without one.
        points: (n, m, 3) m, marker positions, gaps NaN; in the file's unit if `length_unit` is
            None.
        residual: (n, m) m, residual of the markers' reconstruction; NaN in gaps.
        length_unit: "m"; None if the file's word for the unit is unknown.
        channels: name -> (k,) samples of each channel that belongs to no plate, like EMG.
        channel_units: name -> unit, as in the file.
        plates: the readable force plates, in the file's order.
        faults: name of an unreadable part ("markers", "channels", "plate 2") -> its error.
    """

    path: Path
    rate_Hz: float
    first_frame: int
    labels: tuple[str, ...]
    points: Array
    residual: Array
    length_unit: str | None
    analog_rate_Hz: float
    channels: dict[str, Array]
    channel_units: dict[str, str]
    plates: tuple[ForcePlate, ...]
    faults: dict[str, InputError] = field(default_factory=dict)
    equal_channels: tuple[str, ...] = ()
    notices: tuple[str, ...] = ()
    length_word: str = ""

    @property
    def time(self) -> Array:
        """Times (n,) s of the frames."""
        return (self.first_frame + np.arange(len(self.points))) / self.rate_Hz

    @property
    def analog_time(self) -> Array:
        """Times (k,) s of the samples of channels and plates, on the clock of the frames."""
        ratio = round(self.analog_rate_Hz / self.rate_Hz)
        count = len(self.points) * ratio
        return (self.first_frame * ratio + np.arange(count)) / self.analog_rate_Hz

    @property
    def unread_plates(self) -> dict[int, InputError]:
        """Number of each plate that could not be read -> its error."""
        return {int(k[6:]): error for k, error in self.faults.items() if k.startswith("plate ")}

    @property
    def all_notices(self) -> tuple[str, ...]:
        """Remarks on the file and its plates, and on parts that could not be read."""
        plate_notices = [notice for plate in self.plates for notice in plate.notices]
        parts: dict[str, list[str]] = {}  # message of an error -> the parts that it concerns
        for part, error in self.faults.items():
            parts.setdefault(error.what, []).append(part)
        unread = [f"not used: {', '.join(names)}: {what}" for what, names in parts.items()]
        return (*self.notices, *plate_notices, *unread)

    @property
    def remarks(self) -> tuple[str, ...]:
        """All notices, each with the name of the file."""
        return tuple(f"{self.path.name}: {notice}" for notice in self.all_notices)

    def plate(self, number: int) -> ForcePlate:
        """Return a plate by its number.

        Raises:
            InputError: there is no plate of that number, or it cannot be read.
        """
        for plate in self.plates:
            if plate.number == number:
                return plate
        if number in self.unread_plates:
            raise self.unread_plates[number]
        numbers = ", ".join(str(plate.number) for plate in self.plates) or "none"
        raise InputError(
            f"has no force plate {number}",
            self.path,
            f"choose [ground_reaction] plates from: {numbers}",
        )

    def channel(self, name: str) -> Array:
        """Return the samples (k,) of a channel that belongs to no plate."""
        if "channels" in self.faults:
            raise self.faults["channels"]
        if name in self.equal_channels:
            raise InputError(f"has two channels '{name}'", self.path, "rename one")
        if name not in self.channels:
            hint = names_near(name, self.channels, "its channels")
            raise InputError(f"has no channel '{name}'", self.path, hint)
        return self.channels[name]

    def check_markers(self) -> None:
        """Raise an InputError if there are no markers."""
        if "markers" in self.faults:
            raise self.faults["markers"]


def read_c3d(path: str | Path, units: GivenUnits | None = None) -> Recording:
    """Read a C3D file.

    Args:
        units: the user's units; None: those of the file.
    """
    path = Path(path)
    try:
        changed = path.stat().st_mtime_ns
    except (OSError, ValueError):
        raise InputError("no such file", path, "check the path") from None
    return _read(path, changed, units or GivenUnits())


@lru_cache(maxsize=2)
def _read(path: Path, changed: int, units: GivenUnits) -> Recording:
    with np.errstate(all="ignore"):  # damaged numbers overflow; they become gaps
        file = parse_c3d(read_bytes(path, TABLE_BYTES), path)
        return _Reader(path, file, units).recording()


@dataclass(frozen=True, eq=False)
class _Reader:
    path: Path
    file: C3dFile
    units: GivenUnits
    faults: dict[str, InputError] = field(default_factory=dict)

    @property
    def _parameters(self) -> Parameters:
        return self.file.parameters

    def recording(self) -> Recording:
        rate = self._rate()
        labels, equal = self._labels()
        scale = self._metres_per_unit()
        points, residual = self.file.points, self.file.residual
        damaged = ~(np.abs(points) < MAX_VALUE).all(axis=2)
        points[damaged], residual[damaged] = np.nan, np.nan
        analog_rate, names, signals, units = self._analog(rate)
        plates = self._plates(names, signals, units, scale)
        used = {name for plate in plates for name in plate.channels}
        counts = Counter(names)
        free = [k for k, name in enumerate(names) if name not in used and counts[name] == 1]
        notices = [*self.file.notices, *self._unused_parameters()]
        notices += [f"has two markers '{name}'; neither is used" for name in equal]
        return Recording(
            self.path,
            rate,
            self.file.first_frame,
            labels,
            points * (scale or 1.0),
            residual * (scale or 1.0),
            "m" if scale else None,
            analog_rate,
            {names[k]: signals[k] for k in free},
            {names[k]: units[k] for k in free},
            plates,
            self.faults,
            tuple(sorted(name for name, count in counts.items() if count > 1)),
            tuple(notices),
            (self._parameters.texts("POINT:UNITS") or [""])[0],
        )

    def _rate(self) -> float:
        stated = self._parameters.number("POINT:RATE")
        rates = [stated, self.file.header.rate_Hz]
        for rate in rates:
            if rate is not None and math.isfinite(rate) and 1e-3 < rate < 1e6:
                return rate
        raise InputError(f"markers have a rate of {rates[0] or 0:g} Hz", self.path, EXPORT)

    def _labels(self) -> tuple[tuple[str, ...], list[str]]:
        count = self.file.points.shape[1]
        stated = self._parameters.texts("POINT:LABELS")[:count]
        stated += [""] * (count - len(stated))
        labels = tuple(name or f"marker {k}" for k, name in enumerate(stated, 1))
        if not count:
            self.faults["markers"] = InputError("holds no markers", self.path, EXPORT)
        return labels, sorted(name for name, n in Counter(labels).items() if n > 1)

    def _metres_per_unit(self) -> float | None:
        """Return None if the file's word for its unit is unknown."""
        words = self._parameters.texts("POINT:UNITS")
        word = words[0] if words else ""
        scale, unit = metres(word), self.units.length
        if unit is None:
            return scale
        if scale is not None and scale != metres(unit):
            raise InputError(
                f"is in {word} by its own header, but length_unit says {unit}",
                self.path,
                "correct length_unit",
            )
        return metres(unit)

    def _analog(self, rate: float) -> tuple[float, list[str], Array, list[str]]:
        """Return rate (Hz), names, samples (c, k) and units of the channels."""
        header, parameters = self.file.header, self._parameters
        samples = header.samples or 1
        count = self.file.raw_analog.shape[1]
        if not count:
            return rate, [], np.empty((0, 0)), []
        stated = parameters.number("ANALOG:RATE")
        try:
            _check_rates(stated, rate, samples, self.path)
            scale = parameters.series("ANALOG:SCALE")[:count]
            offset = parameters.series("ANALOG:OFFSET")[:count]
            general = parameters.number("ANALOG:GEN_SCALE")
            names, units = (parameters.texts(f"ANALOG:{key}") for key in ("LABELS", "UNITS"))
            unsigned = [text.upper() for text in parameters.texts("ANALOG:FORMAT")[:1]]
            if len(scale) < count or not np.isfinite(scale).all():
                raise InputError(
                    f"has scales for {len(scale)} of its {count} channels", self.path, EXPORT
                )
        except InputError as error:
            self.faults["channels"] = error
            return rate * samples, [], np.empty((0, 0)), []
        if unsigned == ["UNSIGNED"]:
            offset = np.where(offset < 0, offset + 65536.0, offset)
        offset = np.concatenate([offset, np.zeros(count - len(offset))])
        factor = scale * (1.0 if general is None else general)
        signals = ((self.file.raw_analog - offset) * factor).T
        signals[~(np.abs(signals) < MAX_VALUE)] = np.nan
        names = [name or f"channel {k}" for k, name in enumerate(names[:count], 1)]
        names += [f"channel {k}" for k in range(len(names) + 1, count + 1)]
        return rate * samples, names, signals, [*units[:count], *[""] * (count - len(units))]

    def _plates(
        self, names: list[str], signals: Array, units: list[str], scale: float | None
    ) -> tuple[ForcePlate, ...]:
        try:
            used = self._parameters.integers("FORCE_PLATFORM:USED")
        except InputError as error:
            self.faults["plate 1"] = error
            return ()
        plates = []
        for number in range(1, min(used[0] if used else 0, 255) + 1):
            try:
                record = self._record(number, names, signals, units, scale)
                plates.append(force_plate(record))
            except InputError as error:
                self.faults[f"plate {number}"] = error
        return tuple(plates)

    def _unused_parameters(self) -> Iterator[str]:
        """Yield a remark on each plate parameter with numbers that are not understood."""
        group = "FORCE_PLATFORM:"
        names = {*self._parameters.values, *self._parameters.damaged}
        for name in sorted(name for name in names if name.startswith(group)):
            values = self._parameters.values.get(name)
            key = name.removeprefix(group)
            is_text = isinstance(values, list)
            if is_text or key.rstrip("0123456789") in PLATE_PARAMETERS:
                continue
            if key == COP_POLYNOMIAL:
                if values is not None and np.any(values):
                    yield (
                        f"{name} is not applied: it corrects the centre of pressure of Kistler "
                        "plates, mostly near their edges"
                    )
                continue
            yield f"{name} is not understood, and not used"

    def _record(
        self, number: int, names: list[str], signals: Array, units: list[str], scale: float | None
    ) -> PlateRecord:
        where, k = f"{self.path}: force plate {number}", number - 1
        if "channels" in self.faults:
            raise self.faults["channels"]
        if scale is None:
            words = self._parameters.texts("POINT:UNITS")
            raise no_length_unit(words[0] if words else "", self.path)
        kinds = self._parameters.integers("FORCE_PLATFORM:TYPE")
        corners, origin, channel = (
            self._per_plate(key, rows)
            for key, rows in (("CORNERS", (3, 4)), ("ORIGIN", (3,)), ("CHANNEL", None))
        )
        counts = (
            len(kinds),
            *(0 if v is None else v.shape[-1] for v in (corners, origin, channel)),
        )
        if min(counts) < number:
            raise InputError("is not described in full", where, EXPORT)
        assert corners is not None and origin is not None and channel is not None
        used = channel[: CHANNELS.get(kinds[k], 6), k]
        if not np.isfinite(used).all() or len(set(used)) < len(used):
            raise InputError("names one channel twice", where, EXPORT)
        if len(used) and (used.min() < 1 or used.max() > len(names)):
            raise InputError(
                f"names channel {used.max():g}, but there are {len(names)}", where, EXPORT
            )
        rows = [int(channel_number) - 1 for channel_number in used]
        force = self._parameters.texts("FORCE_PLATFORM:UNITS")
        return PlateRecord(
            number,
            kinds[k],
            corners[:, :, k].T * scale,
            origin[:, k] * scale,
            tuple(names[row] for row in rows),
            signals[rows],
            tuple(units[row] for row in rows),
            self._calibration(kinds[k], k),
            (force[0] if force else "") or "N",
            scale,
            self._zero(),
            self.units,
            where,
        )

    def _per_plate(self, key: str, rows: tuple[int, ...] | None) -> Array | None:
        """Return the numbers in the shape `rows` per plate, which is the last index. The file may
        lack it for one plate.

        None: the parameter is missing or of another size.
        """
        value = self._parameters.numbers(f"FORCE_PLATFORM:{key}")
        if value is None or not value.size:
            return None
        shape = rows or (value.shape[0],) if value.ndim else (1,)
        if value.size % math.prod(shape):
            return None
        return value.reshape((*shape, -1), order="F")

    def _calibration(self, kind: int, k: int) -> Array | None:
        """Return the calibration matrix (6, c) of plate k, or None."""
        value = self._parameters.numbers("FORCE_PLATFORM:CAL_MATRIX")
        if kind not in (4, 5) or value is None or value.ndim < 2:
            return None
        value = value.reshape((*value.shape[:2], -1), order="F")
        if value.shape[2] <= k or not np.isfinite(value[:, :, k]).all():
            return None
        matrix, channels = value[:, :, k], CHANNELS[kind]
        if matrix.shape[0] != 6:
            matrix = matrix.T
        matrix = matrix[:6, :channels]
        return matrix if matrix.any() else None

    def _zero(self) -> slice | None:
        """Return the samples that FORCE_PLATFORM:ZERO states as unloaded, or None.

        Its two frame numbers are those of a longer recording, of which this one is a part, if both
        lie within this one. Otherwise they count from its first frame.
        """
        frames = self._parameters.integers("FORCE_PLATFORM:ZERO")
        if len(frames) != 2 or frames[1] < 1 or frames[1] < frames[0]:
            return None
        first, last = max(frames[0], 1) - 1, frames[1]
        count, start = len(self.file.points), self.file.first_frame
        if start <= first and last <= start + count:
            first, last = first - start, last - start
        if last > count:
            return None
        ratio = self.file.header.samples or 1
        return slice(first * ratio, last * ratio)


def no_length_unit(word: str, path: Path) -> InputError:
    """Return the error for an unknown unit of length."""
    stated = f"the unit '{word}'" if word else "no unit"
    return InputError(
        f"states {stated} for its markers (POINT:UNITS)",
        path,
        "state it with --length-unit or length_unit: m, cm or mm",
    )


def _check_rates(analog_rate: float | None, rate: float, samples: int, path: Path) -> None:
    if analog_rate is None or analog_rate == 0:
        return  # the number of samples per frame gives the rate
    ratio = analog_rate / rate
    if not ratio >= 1 or abs(ratio - round(ratio)) > 1e-4:
        raise InputError(
            f"analog rate {analog_rate:g} Hz is no multiple of the markers' {rate:g} Hz",
            path,
            EXPORT,
        )
    if round(ratio) != samples:
        raise InputError(
            f"states an analog rate of {analog_rate:g} Hz, but holds {samples} samples a frame of "
            f"{rate:g} Hz",
            path,
            EXPORT,
        )
