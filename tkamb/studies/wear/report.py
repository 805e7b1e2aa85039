"""Output of a wear simulation: table, summary, maps, worn insert and figure."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import trimesh

from tkamb import code_identity
from tkamb.files import replaced_together, write_rows, write_synced
from tkamb.geometry.frames import MIRROR, Array
from tkamb.geometry.surface import Surface
from tkamb.io.mesh_files import write_triangles
from tkamb.run.results_folder import remove_shards
from tkamb.studies.wear.bands import WearBands
from tkamb.studies.wear.laws import WearLaw, WearMaterial
from tkamb.studies.wear.setup import WearSetup
from tkamb.studies.wear.simulation import CycleWear, FirstCycle, WearCase, WearState
from tkamb.studies.wear.simulator import UNITS
from tkamb.units import MEGAPASCAL, MILLIMETRE

if TYPE_CHECKING:
    from matplotlib.axes import Axes


# 1: cycles of a rate.
MILLION = 1e6
STATE_NAME, SAMPLES_NAME = ".wear.npz", ".wear_samples"
"""File of the last finished block and folder of the finished samples, while a simulation is
unfinished."""
FIRST = (
    "Worn volume, mass and depth are proportional to the wear factor, which differs by a factor of "
    "two and more between laboratories."
)
"""First sentence of every wear report."""
PROPORTIONAL = ("volume_mm3", "mass_mg", "max_depth_mm")
"""Columns that are proportional to the wear factor if the change of the shape is neglected."""


# Relative change of the volume of a cycle with half as many frames. Above it the report asks for
# more frames. Below the error of a wear law.
MAX_FRAME_CHANGE = 0.02
# Relative correction of the force of a map. Above it the report asks for a finer resolution.
# Below the error of a wear law.
MAX_MAP_CORRECTION = 0.05
# Ratio to the published wear rates. The report asks about rates above the highest published rate
# times the ratio, or below the lowest over the ratio.
MAX_PUBLISHED_RATIO = 3.0


PUBLISHED_RATES = (1.6, 4.4)
"""mm³ per million cycles: lowest and highest rate of a whole knee in two tests, Dreyer et al.
(2023), doi:10.1101/2023.05.09.23289712."""


@dataclass(frozen=True, eq=False)
class WearReport:
    """A finished wear simulation.

    Args:
        state: insert at the end.
        last: wear of one cycle on the insert at the end.
        first: checks of the first cycle.
        bands: bands of the rows of the table; None: not requested.
    """

    setup: WearSetup
    case: WearCase
    material: WearMaterial
    state: WearState
    last: CycleWear
    cycles: int
    updates: int
    first: FirstCycle
    bands: WearBands | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return the content of `tkamb wear --json`. None: not modelled or not computed."""
        last = {key: _known(value) for key, value in self.state.rows[-1].items()}
        law = self.case.law
        return {
            "first": FIRST,
            **last,
            "status": self.state.end or "ok",
            "cycles_asked": self.cycles,
            "updates": self.updates,
            "blocks": len(self.state.rows) - 1,
            "volume_mm3_per_Mc": self.rate,
            "mass_mg_per_Mc": self.rate * self.case.density * 1e-3,
            **self.ranges(),
            "range_factors": list(self.material.factor_range),
            "range_source": self.material.range_source,
            "law": law.name,
            "law_parameters": vars(law),
            "geometry": law.geometry,
            "laws_side_by_side": self.side_by_side(),
            "frames_change": _known(self.first.frames_change),
            "close": self.case.motion.closing or None,
            "material": self.material.name,
            "sources": list(self.material.sources),
            "creep": None if self.case.creep is None else vars(self.case.creep),
            **({} if self._insert else {"part": self.setup.part}),
            "contact": self.setup.contact,
            "resolution_mm": self.setup.resolution_mm,
            "source": self.setup.source,
            "scene_sha256": self.setup.scene_sha256,
            "files_sha256": self.setup.files_sha256,
            "run_frames": self.setup.run_frames,
            "side": self.setup.side,
            "frames": len(self.case.motion),
            "passes_per_cycle": self.case.motion.passes,
            "seconds_per_cycle": self.case.motion.duration,
            "largest_force_correction": self.state.map_error,
            "mean_cross_shear": _known(self._mean_cross_shear()),
            **self._control(),
            "bands": None if self.bands is None else self.bands.as_dict(),
            "notes": list(self.case.motion.notes),
            "questions": self.questions(),
            "rows": [{k: _known(v) for k, v in row.items()} for row in self._rows()],
            "code": code_identity(),
        }

    @property
    def _insert(self) -> bool:
        return self.setup.part == "insert"

    def _rows(self) -> list[dict[str, float]]:
        rows = self.state.rows
        bands = [{}] * len(rows) if self.bands is None else self.bands.rows
        return [row | band for row, band in zip(rows, bands, strict=True)]

    def _control(self) -> dict[str, Any]:
        drive = self.case.motion.drive
        if drive is None:
            return {"control": "displacement", "found_in_equilibrium": []}
        springs = drive.springs
        return {
            "control": "force",
            "found_in_equilibrium": drive.names,
            "springs": None if springs is None else dict(springs.table),
            "springs_sources": [] if springs is None else list(springs.sources),
            "dwell_mm": [float(drive.zero[i] / MILLIMETRE) for i in (0, 2)],
            "last_cycle": drive.rows(self.last.poses, self.last.failed),
        }

    @property
    def rate(self) -> float:
        """Worn volume, mm³ per million cycles."""
        last = self.state.rows[-1]
        return last["volume_mm3"] * MILLION / last["cycles"] if last["cycles"] else 0.0

    def ranges(self) -> dict[str, list[float]]:
        """Return the range of each result that is proportional to the wear factor."""
        last = self.state.rows[-1]
        values = {key: last[key] for key in PROPORTIONAL}
        values["volume_mm3_per_Mc"] = self.rate
        return {
            f"{key}_range": [factor * value for factor in self.material.factor_range]
            for key, value in values.items()
        }

    def side_by_side(self) -> list[dict[str, Any]]:
        """Return the rate of each law of the material on the unworn insert, with its range."""
        result = []
        for name, law in self.material.all_laws().items():
            if name not in self.first.volumes:
                continue
            rate = self.first.volumes[name] * MILLION / MILLIMETRE**3
            result.append(
                {
                    "law": name,
                    "wear_factor_mm3_per_Nm": _single_factor(law),
                    "first_volume_mm3_per_Mc": rate,
                    "first_volume_mm3_per_Mc_range": [f * rate for f in self.material.factor_range],
                    "law_parameters": vars(law),
                    "geometry": law.geometry,
                }
            )
        return result

    def questions(self) -> list[str]:
        """Return the questions and warnings that the report prints."""
        questions = [] if not self.material.caution else [self.material.caution]
        questions += self.case.motion.questions
        if self.first.frames_change > MAX_FRAME_CHANGE:
            questions.append(
                f"half the frames per cycle change the volume by {self.first.frames_change:.1%}"
                ": increase --frames-per-cycle"
            )
        if self.state.map_error > MAX_MAP_CORRECTION:
            questions.append(
                f"pressure maps were scaled by up to {self.state.map_error:.0%} to sum to their "
                "load: use a finer resolution"
            )
        if self.state.unsettled:
            questions.append(
                f"in {self.state.unsettled} blocks the pressure moved away from the worn area, "
                "although they were halved: increase --updates"
            )
        low, high = PUBLISHED_RATES
        if (
            self._insert
            and not low / MAX_PUBLISHED_RATIO <= self.rate <= high * MAX_PUBLISHED_RATIO
        ):
            questions.append(
                f"{self.rate:.3g} mm3 per million cycles is far from the measured {low:g} (ISO) to "
                f"{high:g} (in-vivo loads) mm3 of a whole knee (Dreyer 2023): check the wear factor"
            )
        failed_rows = max(row.get("failed_rows", 0.0) for row in self.state.rows)
        if failed_rows:
            reason = next(iter(self.last.failed.values()), "in blocks before the last")
            questions.append(
                f"up to {failed_rows:.0f} of {len(self.case.motion)} rows of the profile failed, "
                f"and the cycle omits them: {reason}"
            )
        if self.last.flagged:
            flag = next(iter(self.last.flagged.values()))
            count = len(self.last.flagged)
            questions.append(f"in {count} of {len(self.case.motion)} rows {flag}")
        if self.setup.engine.bearing == "mobile":
            questions.append("the wear of the back of a mobile bearing is not modelled")
        if self.bands is not None:
            questions += self.bands.questions()
        if self.case.creep is None:
            questions.append("creep is not modelled: the material gives no [creep]")
        return questions

    def _own_factor(self, laws: list[dict[str, Any]]) -> list[str]:
        own = _single_factor(self.case.law)
        others = {law["law"]: law["wear_factor_mm3_per_Nm"] for law in laws}
        name = self.case.law.name
        if own is None or others.get(name, own) == own:
            return []
        return [
            f"wear factor of the simulation {own:.3g} mm3/(N m); the laws side by side have the "
            "factors of the material, which stand beside them"
        ]

    def lines(self) -> list[str]:
        """Return the report as lines of text."""
        result = self.as_dict()
        creep = result["creep_depth_mm"]
        text = "not modelled" if creep is None else f"{creep:.4g} mm deep"
        own = self._own_factor(result["laws_side_by_side"])
        low, high = result["volume_mm3_range"]
        slow, fast = result["volume_mm3_per_Mc_range"]
        title = f"laws on the unworn {self.setup.part}"
        others = [
            f"{law['law']} {_factor_words(law['wear_factor_mm3_per_Nm'])}"
            f"{law['first_volume_mm3_per_Mc']:.3g} "
            f"({law['first_volume_mm3_per_Mc_range'][0]:.3g} to "
            f"{law['first_volume_mm3_per_Mc_range'][1]:.3g})"
            for law in result["laws_side_by_side"]
        ]
        return [
            FIRST,
            f"{result['cycles']:.6g} cycles in {result['blocks']} blocks, {result['law']}, "
            f"{result['material']}: {result['status']}",
            *own,
            f"worn volume {result['volume_mm3']:.4g} mm3, {result['mass_mg']:.4g} mg, "
            f"{result['max_depth_mm']:.4g} mm deep at most, over {result['worn_area_mm2']:.4g} mm2",
            f"rate {self.rate:.4g} mm3 per million cycles; creep {text}",
            f"range by the wear factor alone: {low:.3g} to {high:.3g} mm3, {slow:.3g} to "
            f"{fast:.3g} mm3 per million cycles ({self.material.range_source})",
            f"geometry: {self.case.law.geometry}",
            *([f"{title}, mm3 per million cycles: {', '.join(others)}"] if others else []),
            *([] if self.bands is None else self.bands.lines()),
            *self._control_lines(),
            *(f"note: {note}" for note in result["notes"]),
        ]

    def _control_lines(self) -> list[str]:
        drive = self.case.motion.drive
        if drive is None:
            return []
        result = drive.ranges(self.last.poses, self.last.failed)
        ranges = (
            f"{name} {result[f'{name}_low_{unit}']:.3g} to "
            f"{result[f'{name}_high_{unit}']:.3g} {unit}"
            for name, unit in ((name, UNITS[name][0]) for name in drive.names)
        )
        return [f"force control: {', '.join(ranges)}; {len(self.last.failed)} rows failed"]

    def write(self, folder: Path) -> None:
        """Write wear.csv, wear.json, wear.vtp, worn_insert.stl and wear.png, all or none.

        The mesh of the button is worn_button.stl.
        """

        surface, maps = self._worn(), self._maps()
        with replaced_together(folder) as files:
            rows = self._rows()
            write_rows(files.path("wear.csv"), [rows[0], *(row.values() for row in rows)])
            write_synced(files.path("wear.json"), json.dumps(self.as_dict(), indent=2) + "\n")
            write_triangles(files.path("wear.vtp"), surface.vertices, surface.faces, maps)
            in_mm = trimesh.Trimesh(surface.vertices / MILLIMETRE, surface.faces, process=False)
            in_mm.export(files.path(f"worn_{self.setup.part}.stl"), file_type="stl")
            up = "anterior" if self._insert else "superior"
            draw_wear(surface, maps, self._rows(), files.path("wear.png"), self.setup.side, up)
            files.remove(STATE_NAME)
        remove_shards(folder, SAMPLES_NAME)

    def _worn(self) -> Surface:
        surface = self.case.articular.lowered(self.state.fall)
        if self.setup.side == "right":
            return surface
        return Surface(surface.vertices @ MIRROR, surface.faces[:, ::-1], surface.name)

    def _maps(self) -> dict[str, Array]:
        state, vertices = self.state, self.case.articular.vertices
        creep = {} if self.case.creep is None else {"creep_depth_mm": state.creep / MILLIMETRE}
        named = {
            "wear_depth_mm": state.wear / MILLIMETRE,
            **creep,
            "sliding_mm_per_cycle": self.last.history.distance / MILLIMETRE,
            "cross_shear_ratio": self.last.history.cross_shear,
            "peak_pressure_MPa": self.last.peak_pressure / MEGAPASCAL,
        }
        maps = {}
        for name, values in named.items():
            maps[name] = np.zeros(len(self.case.articular.surface.vertices))
            maps[name][vertices] = values
        return maps

    def _mean_cross_shear(self) -> float:
        weight = self.last.rate * self.last.area
        total = float(weight.sum())
        return float(weight @ self.last.history.cross_shear) / total if total else math.nan


def _known(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


LABELS = {
    "wear_depth_mm": "wear depth, mm",
    "creep_depth_mm": "creep depth, mm",
    "sliding_mm_per_cycle": "sliding in contact, mm a cycle",
    "cross_shear_ratio": "cross-shear ratio",
    "peak_pressure_MPa": "peak pressure, MPa",
}


def draw_wear(
    surface: Surface,
    maps: dict[str, Array],
    rows: Sequence[Mapping[str, float]],
    path: Path,
    side: str,
    up: str = "anterior",
) -> None:
    """Draw the maps of the insert in a superior view, anterior at the top and right on the right.

    Those of the button are seen from the femur, superior at the top.

    The last panel shows the worn volume over the cycles, with its band if the rows have one.

    Args:
        surface: insert in the insert frame.
        maps: name -> values at the vertices.
        side: "right" or "left" knee.
        up: direction of x: "anterior", or "superior" for the button.
    """
    from matplotlib.figure import Figure

    facing = surface.face_normals[:, 1] > 0
    x, z = surface.vertices[:, 0] / MILLIMETRE, surface.vertices[:, 2] / MILLIMETRE
    columns = (len(maps) + 2) // 2
    ends = ("medial", "lateral") if side == "right" else ("lateral", "medial")
    figure = Figure(figsize=(5.5 * columns, 8), layout="constrained")
    subject = "knee from above" if up == "anterior" else "patellar button from the femur"
    figure.suptitle(f"{side} {subject}")
    panels = figure.subplots(2, columns).ravel()
    for axes, (name, values) in zip(panels, maps.items(), strict=False):
        top = float(np.max(values)) or 1.0
        image = axes.tripcolor(
            z, x, surface.faces[facing], values, shading="gouraud", vmin=0, vmax=top
        )
        axes.set(
            aspect="equal",
            title=LABELS[name],
            xlabel=f"{' ← z, mm → '.join(ends)} (right)",
            ylabel=f"x ({up}), mm",
        )
        figure.colorbar(image, ax=axes, shrink=0.7)
    draw_volume(panels[len(maps)], rows)
    for axes in panels[len(maps) + 1 :]:
        axes.axis("off")
    figure.savefig(path, dpi=110, format="png")


def draw_volume(axes: "Axes", rows: Sequence[Mapping[str, float]]) -> None:
    """Draw the worn volume over the cycles, the 5 to 95 % band (shaded) and the median (dotted)."""
    cycles = np.array([row["cycles"] for row in rows]) / 1e6
    axes.plot(cycles, [row["volume_mm3"] for row in rows], "k.-", label="nominal")
    if "volume_mm3_p05" in rows[-1]:
        low, middle, high = ([row[f"volume_mm3_p{p}"] for row in rows] for p in ("05", "50", "95"))
        axes.fill_between(cycles, low, high, color="0.8", label="5 to 95 % of the samples")
        axes.plot(cycles, middle, "k:", label="median of the samples")
        axes.legend()
    axes.set(title="worn volume, mm³", xlabel="million cycles", xlim=(0, None), ylim=(0, None))


def _single_factor(law: WearLaw) -> float | None:
    """Return the wear factor of a law, mm³/(N m); None if it has none or a table of them."""
    factor = getattr(law, "wear_factor_mm3_per_Nm", None)
    return factor if isinstance(factor, float) else None


def _factor_words(factor: float | None) -> str:
    return "" if factor is None else f"with k = {factor:.3g}: "
