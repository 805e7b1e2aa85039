"""What a press found, for the screen and as JSON."""

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from tkamb.contact.pair import ContactPair
from tkamb.contact.result import CondyleContact, ContactResult, ContactStatus
from tkamb.geometry.adjustment import Adjustment
from tkamb.known_errors import KnownError, as_json, known_error_words
from tkamb.units import DEGREE, MEGAPASCAL, MILLIMETRE

Side = Literal["right", "left"]

_CONDYLE = (
    "{force_N:8.1f} N {area_mm2:7.1f} mm2  mean {mean_pressure_MPa:5.2f}  "
    "peak {peak_pressure_MPa:5.2f} MPa  centre ({:.1f}, {:.1f}, {:.1f}) mm"
)
_ERRORS_TOLD = ("peak_pressure", "mean_pressure", "area", "approach")


@dataclass(frozen=True, eq=False)
class PressReport:
    """What a press found, and what it took.

    Args:
        contact: name of the contact model.
        resolution_mm: spacing of its map points.
        nodes: of the model (lattice, mesh), or map points where it has none.
        load: N.
        result: the contact, in the insert frame (mirrored for a left knee).
        adjustment: what was done to the pose before contact, if anything.
        pair: the two bodies.
        side: of the knee.
        prepare_seconds: for the geometry.
        solve_seconds: for the press.
        peak_rss_MB: largest resident memory of the process so far.
        known_error: of the contact model at this resolution; None if it was not measured.
    """

    contact: str
    resolution_mm: float
    nodes: int
    load: float
    result: ContactResult
    adjustment: Adjustment | None
    pair: ContactPair
    side: Side
    prepare_seconds: float
    solve_seconds: float
    peak_rss_MB: float
    known_error: KnownError | None = None

    @property
    def carried(self) -> bool:
        """Whether the load was reached."""
        return self.result.status is ContactStatus.OK

    def lines(self) -> list[str]:
        """Return the report as lines of text."""
        found = self.as_dict()
        lines = [
            f"{self.contact} at {self.resolution_mm:g} mm, {self.nodes} nodes: {found['status']}",
            f"load {self.load:g} N, reaction {_text(found['reaction_N'])} N, "
            f"approach {_text(found['approach_mm'])} mm",
        ]
        for name in ("medial", "lateral"):
            if found[name] is not None:
                lines.append(
                    f"{name:8s}" + _CONDYLE.format(*found[name].pop("cop_mm"), **found[name])
                )
        if self.adjustment is not None:
            done = self.adjustment
            restored = ", recorded rotation restored" if done.restored else ""
            lines.append(
                f"adjusted {done.translation / MILLIMETRE:.3f} mm along y, "
                f"{done.coronal_angle / DEGREE:.3f} deg coronal{restored}"
            )
        lines.append(known_error_words(found["known_error"], _ERRORS_TOLD))
        lines += [f"note: {flag}" for flag in self.result.flags]
        took = f"prepared in {self.prepare_seconds:.3g} s, solved in {self.solve_seconds:.3g} s"
        return [*lines, f"{took}, {self.result.iterations} iterations"]

    def as_dict(self) -> dict[str, Any]:
        """Return what `tkamb press --json` prints; None stands for what is unknown.

        Vectors are in the insert frame, z to the subject's right on either side.
        """
        result = self.result
        return {
            "contact": self.contact,
            "resolution_mm": self.resolution_mm,
            "nodes": self.nodes,
            "load_N": self.load,
            "reaction_N": _known(-result.wrench_on_insert[1]),
            "approach_mm": _known(result.approach / MILLIMETRE),
            "medial": _condyle(result.medial, self.side),
            "lateral": _condyle(result.lateral, self.side),
            "prepare_seconds": self.prepare_seconds,
            "solve_seconds": self.solve_seconds,
            "peak_rss_MB": self.peak_rss_MB,
            "iterations": result.iterations,
            "residual": _known(result.residual),
            "status": result.status.value,
            "flags": list(result.flags),
            "known_error": as_json(self.known_error),
        }


def _condyle(carried: CondyleContact | None, side: Side) -> dict[str, Any] | None:
    if carried is None:
        return None
    to_right = np.array([1.0, 1.0, -1.0 if side == "left" else 1.0])
    return {
        "force_N": carried.force,
        "area_mm2": carried.area / MILLIMETRE**2,
        "mean_pressure_MPa": carried.mean_pressure / MEGAPASCAL,
        "peak_pressure_MPa": carried.peak_pressure / MEGAPASCAL,
        "cop_mm": (carried.centre_of_pressure * to_right / MILLIMETRE).tolist(),
    }


def _text(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.6g}"


def _known(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
