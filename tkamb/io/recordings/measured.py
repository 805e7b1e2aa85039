"""Measured forces of an instrumented implant, and envelopes of surface EMG.

An envelope is the signal high-passed, rectified, low-passed and divided by a normalising value;
negative values are zero. Both filters are second-order Butterworth filters run forwards and
backwards, which shift no phase and halve the amplitude at the cut-off. With the sampling interval h
the low-pass multiplies each frequency f by

    1 / (1 + r⁴),  r = tan(pi f h) / tan(pi f_c h),

and the high-pass by r⁴ / (1 + r⁴). The signal is mirrored at its ends, so that the low-pass
averages there, too.

Reference: Winter, Biomechanics and Motor Control of Human Movement, 4th ed., 2009, ch. 10.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array
from tkamb.io.recordings.filtering import check_overlap
from tkamb.io.recordings.recording_tables import EmgTable, MeasuredTable
from tkamb.io.recordings.tables import Table, read_table

FORCE = {"N": 1.0, "kN": 1e3, "lbf": 4.4482216152605}
"""Newtons per unit of force; lbf: 0.45359237 kg x 9.80665 m/s²."""


# 1: widest gap to interpolate, in median time steps. One sample may be lost.
MAX_GAP = 2.5


@dataclass(frozen=True, eq=False)
class MeasuredForce:
    """Measured axial forces on the insert; compression is positive.

    Args:
        time: (n,) s, on the clock of the motion.
        force: "total", "medial" or "lateral", if known -> (n,) N, gaps NaN.
    """

    path: Path
    time: Array
    force: dict[str, Array]
    remarks: tuple[str, ...] = ()

    def at(self, time: Array) -> dict[str, Array]:
        """Return the forces (f,) N at times (f,) s, by linear interpolation.

        The forces are NaN outside the measurement, next to a gap, and between samples that are
        farther apart than `max_gap`.
        """
        step = np.diff(self.time)
        right = np.clip(np.searchsorted(self.time, time), 1, len(self.time) - 1)
        inside = (time >= self.time[0]) & (time <= self.time[-1])
        inside &= step[right - 1] <= MAX_GAP * np.median(step)
        return {
            name: np.where(inside, np.interp(time, self.time, values), np.nan)
            for name, values in self.force.items()
        }


def load_measured_force(source: MeasuredTable, time: Array) -> MeasuredForce:
    """Read the measured forces.

    Args:
        time: (f,) s, times of the motion, which must overlap with the measurement.
    """
    table = read_table(source.file, source.format)
    name = source.columns.get("time", "time")
    assert isinstance(name, str)
    clock = table.time(name) + source.offset_s
    if len(clock) < 2:
        raise InputError("holds fewer than two samples", source.file)
    force: dict[str, Array] = {
        role: _sum(table, column) * FORCE[source.unit]
        for role, column in source.columns.items()
        if role != "time"
    }
    check_overlap(source.file, clock, time, "[measured]")
    return MeasuredForce(source.file, clock, _with_third(force), table.remarks)


def _sum(table: Table, column: str | dict[str, float]) -> Array:
    factors = {column: 1.0} if isinstance(column, str) else column
    return np.sum([factor * table.column(name) for name, factor in factors.items()], axis=0)


def _with_third(force: dict[str, Array]) -> dict[str, Array]:
    """Add the third force if two are known, from total = medial + lateral."""
    if set(force) == {"medial", "lateral"}:
        return {"total": force["medial"] + force["lateral"], **force}
    for side, other in (("medial", "lateral"), ("lateral", "medial")):
        if set(force) == {"total", side}:
            return {**force, other: force["total"] - force[side]}
    return force


# Order of each Butterworth filter in one direction. Forwards and backwards together
# give the usual fourth order.
FILTER_ORDER = 2
# 1: smallest peak of an envelope, as a share of the signal's largest value. A
# smaller peak is round-off.
FLAT_SHARE = 1e-9
# 1: largest deviation of a time step from the median step, as a share of it. The
# jitter of a clock is smaller.
STEP_TOLERANCE = 0.01


@dataclass(frozen=True, eq=False)
class Envelopes:
    """Normalised envelopes of EMG, at times on the motion's clock.

    Args:
        time: (n,) s.
        values: channel -> (n,), 1 at the normalising value.
        channel_of: muscle -> channel.
        normalised_by: channel -> the normalising value, in the file's unit.
    """

    path: Path
    time: Array
    values: dict[str, Array]
    channel_of: dict[str, str]
    normalised_by: dict[str, float]
    remarks: tuple[str, ...] = ()

    def at(self, muscle: str, time: Array) -> Array:
        """Return a muscle's envelope (f,) at times (f,) s; NaN outside the recording."""
        values = self.values[self.channel_of[muscle]]
        return np.interp(time, self.time, values, left=np.nan, right=np.nan)


def load_envelopes(source: EmgTable, motion: Array) -> Envelopes:
    """Read EMG and return its envelopes.

    Args:
        motion: (f,) s, times of the motion, which must overlap with the recording.
    """
    time, signals, remarks = _signals(source)
    step = np.diff(time)
    if len(step) < 2 or np.abs(step - np.median(step)).max() > STEP_TOLERANCE * np.median(step):
        raise InputError("has EMG that is not sampled evenly", source.file, "resample it")
    check_overlap(source.file, time + source.offset_s, motion, "[muscles.emg]")
    rate = len(step) / (time[-1] - time[0])
    values, normalised_by = {}, {}
    for channel, signal in signals.items():
        try:
            result = envelope(signal, rate, source.cutoff_Hz, source.high_pass_Hz)
        except InputError as error:
            raise InputError(
                error.what, f"{source.file}: channel '{channel}'", error.hint
            ) from None
        divisor = (
            result.max() if source.normalised_by == "recording" else source.normalised_by[channel]
        )
        normalised_by[channel] = float(divisor)
        if not result.max() > FLAT_SHARE * np.abs(signal).max():
            raise InputError(f"channel '{channel}' holds no signal", source.file, "leave it out")
        values[channel] = result / normalised_by[channel]
    muscles = {muscle: channel for channel, names in source.channels.items() for muscle in names}
    return Envelopes(source.file, time + source.offset_s, values, muscles, normalised_by, remarks)


def envelope(
    signal: Array, rate_Hz: float, cutoff_Hz: float, high_pass_Hz: float | Literal["none"]
) -> Array:
    """Return the envelope (n,) of an EMG signal, in its unit.

    The envelope of A sin(2π f t) is its mean 2A/π, for f between the two cut-offs and far from
    both.

    Args:
        signal: (n,) evenly spaced samples.
        high_pass_Hz: cut-off of the high-pass before rectifying; "none": only the mean is
            subtracted.
    """
    if not np.isfinite(signal).all():
        raise InputError("has a gap or a value that is not finite", "EMG", "fill or cut the gap")
    for cutoff in (cutoff_Hz, high_pass_Hz):
        if cutoff == "none":
            continue
        if not 0 < cutoff < 0.5 * rate_Hz:
            raise InputError(f"cut-off {cutoff:g} Hz is not below half of {rate_Hz:g} Hz", "EMG")
        if len(signal) * cutoff < rate_Hz:
            raise InputError(f"is shorter than a period of the cut-off {cutoff:g} Hz", "EMG")
    centred = signal - signal.mean()
    if high_pass_Hz != "none":
        centred -= _low_passed(centred, high_pass_Hz / rate_Hz)
    return np.maximum(_low_passed(np.abs(centred), cutoff_Hz / rate_Hz), 0.0)


def _low_passed(signal: Array, cutoff: float) -> Array:
    """Return a signal (n,) after the low-pass, from its spectrum; `cutoff` is in periods per
    sample.

    The import of scipy.signal takes 0.3 s.
    """
    mirrored = np.concatenate([signal, signal[-2:0:-1]])
    ratio = np.tan(np.pi * np.fft.rfftfreq(len(mirrored))) / np.tan(np.pi * cutoff)
    spectrum = np.fft.rfft(mirrored) / (1.0 + ratio ** (2 * FILTER_ORDER))
    return np.fft.irfft(spectrum, len(mirrored))[: len(signal)]


def _signals(source: EmgTable) -> tuple[Array, dict[str, Array], tuple[str, ...]]:
    """Return times (n,) s on the file's clock, channel -> (n,), and notices."""
    if source.file.suffix.lower() != ".c3d":
        table = read_table(source.file)
        time = table.time(source.time)
        channels = {name: table.complete_column(name) for name in source.channels}
        return time, channels, table.remarks
    from tkamb.io.recordings.c3d import read_c3d

    recording = read_c3d(source.file)
    signals = {name: recording.channel(name) for name in source.channels}
    return recording.analog_time, signals, recording.remarks
