"""The insert of a parametric design, at another thickness."""

import logging
from dataclasses import replace
from pathlib import Path

from tkamb.errors import InputError
from tkamb.io.scene.case import Case, with_insert
from tkamb.studies.designs.design import DESIGN_FILE, load_design
from tkamb.studies.designs.insert import Insert
from tkamb.studies.designs.solids import write_stl

logger = logging.getLogger("tkamb")


def parametric_insert(case: Case, folder: Path) -> Insert | None:
    """Return the design of a case's insert; None where its mesh was not made from one.

    The design is `DESIGN_FILE` beside the mesh. It must give this very mesh, byte for byte.

    Args:
        case: with [contact].
        folder: for a mesh to compare with.
    """
    table = case.scene.implant.insert
    assert table is not None
    if not (table.mesh.parent / DESIGN_FILE).is_file():
        return None
    try:
        insert = load_design(table.mesh.parent).insert
        made = write_insert(insert, insert.thickness, folder)
        if made.read_bytes() == table.mesh.read_bytes():
            return insert
        logger.warning(
            "%s: not the mesh of %s beside it: no thickness slider", table.mesh, DESIGN_FILE
        )
    except (InputError, OSError) as error:
        logger.warning("%s: %s: no thickness slider", table.mesh.parent / DESIGN_FILE, error)
    return None


def write_insert(insert: Insert, thickness_mm: float, folder: Path) -> Path:
    """Write the insert at a thickness as STL, and return the file.

    The dishes rise or sink with the thickness; the bottom, and with it the insert frame, stays.
    """
    path = folder / f"insert_{thickness_mm:g}_mm.stl"
    write_stl(path, *replace(insert, thickness=thickness_mm).mesh())
    return path


def with_thickness(case: Case, insert: Insert, thickness_mm: float, folder: Path) -> Case:
    """Return a case with its parametric insert at another thickness.

    Args:
        case: with [contact].
        insert: its design.
        thickness_mm: at the thinnest.
        folder: for the mesh, which must outlive the case.
    """
    return with_insert(case, write_insert(insert, thickness_mm, folder))
