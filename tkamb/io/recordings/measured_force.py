"""Axial knee forces that an instrumented implant measured, on the recording's clock."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array
from tkamb.io.recordings.recordings import ForceMeasurement
from tkamb.io.recordings.samples import check_overlap
from tkamb.io.recordings.tables import Table, read_table

FORCE = {"N": 1.0, "kN": 1e3, "lbf": 4.4482216152605}
"""Newton per unit of force; lbf: 0.45359237 kg x 9.80665 m/s²."""


@dataclass(frozen=True)
class ForceSampleSettings:
    """Interpolation between the samples of a measured force."""

    max_gap: float = 2.5
    """Multiple of the median step: a wider gap is not interpolated. Chosen: one lost sample is."""


FORCE_SAMPLES = ForceSampleSettings()


@dataclass(frozen=True, eq=False)
class MeasuredForce:
    """Axial forces on the insert, compression positive.

    Args:
        path: the file.
        time: (n,) s, on the clock of the motion.
        force: total, medial, lateral, as far as known -> (n,) N; gaps are NaN.
    """

    path: Path
    time: Array
    force: dict[str, Array]

    def at(self, time: Array) -> dict[str, Array]:
        """Return the forces (f,) N at some times, linear between neighbouring samples.

        NaN outside the measurement, beside a gap, and between samples that are too far apart.

        Args:
            time: (f,) s.
        """
        step = np.diff(self.time)
        right = np.clip(np.searchsorted(self.time, time), 1, len(self.time) - 1)
        inside = (time >= self.time[0]) & (time <= self.time[-1])
        inside &= step[right - 1] <= FORCE_SAMPLES.max_gap * np.median(step)
        return {
            name: np.where(inside, np.interp(time, self.time, values), np.nan)
            for name, values in self.force.items()
        }


def load_measured_force(source: ForceMeasurement, time: Array) -> MeasuredForce:
    """Read what was measured.

    Args:
        source: file, columns, unit, clock.
        time: (f,) s, of the motion; the two must overlap.

    Raises:
        InputError: no such file or column, or nothing measured during the motion.
    """
    table = read_table(source.file, source.format)
    name = source.columns.get("time", "time")
    assert isinstance(name, str)
    clock = table.time(name) + source.offset
    if len(clock) < 2:
        raise InputError("holds fewer than two samples", source.file)
    force = {
        role: _sum(table, column) * FORCE[source.unit]
        for role, column in source.columns.items()
        if role != "time"
    }
    check_overlap(source.file, clock, time, "[measured]")
    return MeasuredForce(source.file, clock, _with_third(force))


def _sum(table: Table, column: str | dict[str, float]) -> Array:
    factors = {column: 1.0} if isinstance(column, str) else column
    return np.sum([factor * table.column(name) for name, factor in factors.items()], axis=0)


def _with_third(force: dict[str, Array]) -> dict[str, Array]:
    """Return total, medial and lateral where two of them are known: total = medial + lateral."""
    if set(force) == {"medial", "lateral"}:
        return {"total": force["medial"] + force["lateral"], **force}
    for side, other in (("medial", "lateral"), ("lateral", "medial")):
        if set(force) == {"total", side}:
            return {**force, other: force["total"] - force[side]}
    return force
