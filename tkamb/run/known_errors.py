"""Known errors of the contact models, and their limits for mobile bearings.

An error is relative to a converged reference: the largest over the measured cases, widened for the
number of pairs of bodies, but no bound for other cases. The cases are those of the trade-off study
and half of the pairs of `scripts/measure/error_cases.py`. The other half tests the share of new
errors below the stored ones (docs/known_errors.md). `scripts/make/tradeoff_table` writes
`run/known_errors.json`. An error is stated only within the range of its pairs; outside, and for
other settings, it is "not measured".
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tkamb.geometry.frames import SIDES, inverse, transform
from tkamb.units import MILLIMETRE

if TYPE_CHECKING:
    from tkamb.contact.result import ContactResult

STORED = Path(__file__).with_name("known_errors.json")


# 1: relative error above which a known error is coloured. Not studied.
NOTABLE_SHARE = 0.10
# Smallest number of pairs of bodies behind a stated error. Measured: in subsets of three, the
# largest error had to be doubled to cover 95 % of the others.
LEAST_PAIRS = 4
# 1: largest sag of the facets over the approach. Measured: a ball of facets of 10 by 5 deg has
# 0.42; its approach was 29 % too small, and its peak pressure that of a fine mesh.
MOST_SAG = 0.45
# m: distance from the loaded points within which facets count. Half the width of the
# widest facets of 10 deg.
FACET_REACH = 2.0 * MILLIMETRE


NOT_MEASURED = "not measured"
SAME_ANSWER = ("cache",)
"""Options that change the computing time of a result only."""


@dataclass(frozen=True)
class KnownError:
    """Largest relative errors of one setting.

    Args:
        force: error of a condyle's force, relative to the load; None: no case has two condyles.
        situations: place of the contact ("interior", "flank", "edge") -> quantity -> largest error
            at that place. Contacts with a flag that is not about the edge are excluded.
        covered: share of the errors on held-out pairs below the stored errors; None: no pair was
            held out.
        range: quantity -> smallest and largest value on these pairs: "thickness_over_radius",
            thickness of the insert over the radius of the circle with the contact's area, and
            "poisson_ratio". All inserts stand on the whole of their bottoms; the foundations and
            `hertz` flag others.
    """

    approach: float
    force: float | None
    mean_pressure: float
    peak_pressure: float
    area: float
    cases: int
    situations: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    covered: float | None = None
    pairs: int = 0
    range: Mapping[str, Sequence[float]] = field(default_factory=dict)


@dataclass(frozen=True)
class ContactSituation:
    """What decides whether an error measured on other pairs applies to a contact.

    Args:
        thickness_over_radius: of each loaded condyle, thickness of the insert over the radius of
            the circle with the contact's area.
        poisson_ratio: of the insert.
        sag: 1, sag of the facets of both meshes over the approach.
    """

    flags: tuple[str, ...]
    thickness_over_radius: tuple[float, ...]
    poisson_ratio: float
    sag: float = 0.0

    @classmethod
    def of(cls, result: "ContactResult") -> "ContactSituation":
        """Return the situation of a contact."""
        pair, loaded = result.pair, [c for c in (result.medial, result.lateral) if c is not None]
        points = result.points[result.pressure > 0.0]
        sag = 0.0
        if len(points):
            # Facets of several millimetres have few edges within a contact.
            on_femur = transform(inverse(result.pose), points)
            sag += pair.femoral.facet_sag(on_femur, FACET_REACH)
            sag += pair.insert.facet_sag(points, FACET_REACH)
        return cls(
            result.flags,
            tuple(condyle.thickness_over_radius for condyle in loaded),
            pair.material.poisson_ratio,
            _share(sag, result.approach),
        )

    @classmethod
    def of_run(
        cls,
        columns: Mapping[str, Any],
        status: Sequence[str],
        poisson_ratio: float,
        facet_sag: float = 0.0,
    ) -> "ContactSituation":
        """Return the situation of the frame of largest peak pressure.

        Args:
            facet_sag: m, sag of the facets of both meshes.
        """
        peaks = np.nan_to_num([columns[f"{side}_peak_pressure_MPa"] for side in SIDES])
        k = int(np.argmax(peaks.max(axis=0)))
        ratios = [
            float(columns[f"{side}_thickness_mm"][k])
            / np.sqrt(columns[f"{side}_area_mm2"][k] / np.pi)
            for side in SIDES
            if columns[f"{side}_area_mm2"][k] > 0
        ]
        approach = float(columns["approach_mm"][k]) * MILLIMETRE
        return cls((status[k],), tuple(ratios), poisson_ratio, _share(facet_sag, approach))


def _share(sag: float, approach: float) -> float:
    return sag / approach if approach > 0 else 0.0


def setting_label(model: str, options: Mapping[str, Any]) -> str:
    """Return a setting's label in the trade-off study: the model's name and options."""
    text = ",".join(f"{key}={value}" for key, value in options.items() if key not in SAME_ANSWER)
    return f"{model}[{text}]" if text else model


@cache
def known_errors() -> dict[tuple[str, float, str], KnownError]:
    """Return (label, resolution in mm, name of the material) -> known error."""
    rows = json.loads(STORED.read_text(encoding="utf-8"))
    return {
        (row.pop("contact"), float(row.pop("resolution_mm")), row.pop("material")): KnownError(
            **row
        )
        for row in rows
    }


def stated_error(
    model: str,
    resolution_mm: float,
    material: str,
    options: Mapping[str, Any] | None,
    contact: ContactSituation,
) -> "KnownError | str":
    """Return the known error of a setting for a contact, or "not measured" with the reason.

    The facets' sag is added to the error of the approach, which counts from the first touch of the
    meshes.

    Args:
        resolution_mm: spacing of the map points, mm.
        material: name of the insert's material.
    """
    error = known_error(model, resolution_mm, material, options)
    if error is None:
        return NOT_MEASURED
    reason = _outside(error, contact)
    if reason:
        return f"{NOT_MEASURED}: {reason}"
    return replace(error, approach=error.approach + contact.sag)


def _outside(error: KnownError, contact: ContactSituation) -> str:
    """Return why an error does not apply to a contact, or ""."""
    # only where contact is modelled
    from tkamb.contact.flags import unmeasured_flags

    if error.pairs < LEAST_PAIRS:
        return f"only {error.pairs} pairs of bodies were measured"
    if not error.range:
        return "the range of the measured pairs is not known"
    # A status holds several flags.
    if flags := unmeasured_flags(flag for status in contact.flags for flag in status.split("; ")):
        return flags[0].split(": ")[0]
    if contact.sag > MOST_SAG:
        return (
            f"the sag of the facets is {contact.sag:.2g} of the approach, at most "
            f"{MOST_SAG:g} was measured"
        )
    values = {"thickness_over_radius": contact.thickness_over_radius}
    values["poisson_ratio"] = (contact.poisson_ratio,)
    for name, (low, high) in error.range.items():
        for value in values[name]:
            if not _within(low, value, high):
                return f"the {_RANGES[name]} is {value:.3g}, measured were {low:.3g} to {high:.3g}"
    return ""


def _within(low: float, value: float, high: float) -> bool:
    """Return whether a value lies in a range, or equals an end in the three digits shown."""
    return value == value and float(f"{low:.3g}") <= float(f"{value:.3g}") <= float(f"{high:.3g}")


_RANGES = {
    "thickness_over_radius": "thickness of the insert over the radius of contact",
    "poisson_ratio": "Poisson's ratio",
}


def known_error(
    model: str, resolution_mm: float, material: str, options: Mapping[str, Any] | None = None
) -> KnownError | None:
    """Return the known error of a setting; None: not measured.

    Args:
        model: name of the contact model. Plug-ins were not measured.
        resolution_mm: spacing of the map points, mm. Only the spacings of the study were measured.
        material: material of the insert. Polyethylene and polyethylene-linear were measured.
    """
    label = setting_label(model, options or {})
    return known_errors().get((label, float(resolution_mm), material))


def left_out(model: str, bearing: str) -> tuple[str, ...]:
    """Return sentences on what a contact model lacks of a bearing."""
    from tkamb.contact.registry import contact_class  # only where contact is modelled

    if bearing == "fixed" or contact_class(model).mobile_bearing:
        return ()
    return (f"The bearing is mobile, but {model} computes it as a fixed one.",)


def as_json(error: KnownError | str | None) -> dict[str, Any] | str:
    """Return `known_error` of summary.json and `tkamb press --json`."""
    if isinstance(error, str):
        return error
    return NOT_MEASURED if error is None else asdict(error)


def known_error_words(error: Mapping[str, Any] | str, names: Iterable[str]) -> str:
    """Return full sentences on the known errors of some quantities."""
    if isinstance(error, str):
        return f"The error of this setting of the contact model is {error}."
    names = list(names)
    widened = f", widened for {error['pairs']} pairs of bodies," if error.get("pairs") else ""
    words = (
        f"In {error['cases']} reference cases the error of the contact model{widened} was at most "
        f"{_listed(error, names)}."
    )
    stated = [name for name in names if name in ("peak_pressure", "area")]
    places = [
        f"{_PLACES[place]} {_listed(errors, stated)}"
        for place, errors in (error.get("situations") or {}).items()
    ]
    if stated and places:
        words += f" By the place of the contact it was at most: {'; '.join(places)}."
    return words


def short_error_words(error: Mapping[str, Any] | str, names: Iterable[str]) -> str:
    """Return one sentence that refers to the report's conclusions."""
    if isinstance(error, str):
        return known_error_words(error, names)
    return (
        "In reference cases the error of the contact model alone was at most "
        f"{_listed(error, names)}: see the report's conclusions."
    )


def _listed(errors: Mapping[str, Any], names: Iterable[str]) -> str:
    parts = [f"{100 * errors[name]:.2g} % of the {name.replace('_', ' ')}" for name in names]
    return " and ".join([", ".join(parts[:-1]), parts[-1]] if len(parts) > 1 else parts)


_PLACES = {"interior": "in the interior", "flank": "on a flank", "edge": "at an edge"}


def is_large(error: Mapping[str, Any] | str, names: Iterable[str]) -> bool:
    """Return whether the known error of any of the quantities exceeds `notable_share`.

    Contact at an edge has a flag of its own. Where situations were measured, only interior and
    flanks count.
    """
    if isinstance(error, str):
        return False
    situations = error.get("situations") or {}
    smooth = [errors for place, errors in situations.items() if place != "edge"]
    return any(errors[name] > NOTABLE_SHARE for name in names for errors in smooth or [error])
