"""Which settings are measured on which case: the default matrix, the quick and the full one.

The default leaves out what repeats something else: fine grids and the solver's variants are
measured on one case of each pair of bodies, not at every pose; `full` measures everything on
every case.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from tkamb.contact.registry import contact_names
from tkamb.studies.cases import StudyCase, case_names
from tkamb.studies.measures import Job

QUICK_CASES = ("sphere", "two condyles")
QUICK_MODELS = ("hertz", "foundation", "lattice", "lattice-linear", "fe")
ONE_OF_EACH = ("sphere", "two condyles", "conforming", "knee 60 deg", "scene 60 deg")
"""Cases on which the fine grids are measured; the others repeat their bodies at another pose."""
TRIED_ON = ("two condyles", "conforming", "knee 60 deg")
"""Cases on which the variants are measured."""


@dataclass(frozen=True)
class Settings:
    """What is measured of a contact model.

    Args:
        everywhere_mm: cell sizes on every case.
        fine_mm: further ones on one case of each pair of bodies.
        variants: options beside the default ones, at `variant_mm`.
        variant_mm: cell size of the variants.
    """

    everywhere_mm: tuple[float, ...] = (2.0,)
    fine_mm: tuple[float, ...] = (1.0,)
    variants: tuple[dict[str, Any], ...] = field(default=())
    variant_mm: float = 2.0


SETTINGS = {
    "hertz": Settings((1.0,), ()),
    "foundation": Settings((2.0, 1.0), ()),
    "foundation-linear": Settings((2.0, 1.0), ()),
    "lattice": Settings(
        (3.0, 2.0),
        (1.5, 1.0),
        (
            {"tolerance": 1e-2},
            {"tolerance": 1e-5},
        ),
    ),
    "lattice-linear": Settings(),
    "lattice-source": Settings((2.0,), ()),
    "fe": Settings((2.0,), (1.5, 1.0), ({"newton": True},)),
}
"""Of the built-in models; another package's model is measured at `Settings()`."""


def jobs(quick: bool = False, scene: Path | None = None, full: bool = False) -> list[Job]:
    """Return what is measured, case by case.

    Args:
        quick: two cases, 2 mm, the default options.
        scene: a user's scene, whose cases come last.
        full: every setting on every case.
    """
    given = None if scene is None else str(scene)
    if quick:
        return [Job(case, model, 2.0) for case in QUICK_CASES for model in QUICK_MODELS]
    return [
        Job(case, model, grid, options, given)
        for case in case_names(scene)
        for model in contact_names()
        for grid, options in _of(SETTINGS.get(model, Settings()), case, full)
    ]


def _of(settings: Settings, case: str, full: bool) -> list[tuple[float, dict[str, Any]]]:
    grids = settings.everywhere_mm
    if full or case in ONE_OF_EACH:
        grids += settings.fine_mm
    found: list[tuple[float, dict[str, Any]]] = [(grid, {}) for grid in grids]
    if full or case in TRIED_ON:
        found += [(settings.variant_mm, options) for options in settings.variants]
    return found


def expected_seconds(wanted: Sequence[Job], cases: Sequence[StudyCase]) -> list[float]:
    """Return roughly how long each job takes, for the time left: by the number of cells."""
    box = {c.name: float(np.prod(np.ptp(c.pair.insert.vertices, axis=0))) for c in cases}
    return [
        2.0 + _per_node(job) * box[job.case] / (job.resolution_mm * 1e-3) ** 3 for job in wanted
    ]


def _per_node(job: Job) -> float:
    if not job.contact.startswith(("lattice", "fe")):
        return 0.0
    return 2e-3 if "newton" in job.options else 6e-4
