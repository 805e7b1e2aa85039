"""The lattice that a contact model takes: of the same volume as its mesh, or refused.

A grid that follows a surface in cells can lose what is thinner than a cell, and a whole part where
something goes wrong. No number of a contact shows that, so the two volumes are compared every time.
"""

import logging
from dataclasses import dataclass, replace

from tkamb.contact.lattice.meshing.grid import Lattice, make_grid, tell_repairs
from tkamb.contact.lattice.meshing.pieces import missing_part, volume_error
from tkamb.errors import InputError
from tkamb.geometry.surface import Surface
from tkamb.units import MILLIMETRE

_log = logging.getLogger("tkamb")


@dataclass(frozen=True)
class VolumeSettings:
    """How the volume of a lattice is held to that of its mesh."""

    tolerance: float = 0.02
    """Largest difference, as a share of the mesh's volume. Chosen: stiffness and pressure of an
    insert of 8 mm change by about as much."""
    sizes: tuple[float, ...] = (1.0, 0.95, 0.9, 0.85, 0.8)
    """Cell sizes that are tried in turn, as shares of the wanted one. Chosen: the last makes twice
    as many cells."""
    beyond_refinement: float = 0.1
    """1: larger differences count as a missing part, which smaller cells do not bring back; they
    are not tried. Chosen: a coarse grid loses less."""


VOLUME = VolumeSettings()


def whole_lattice(insert: Surface, target_size: float) -> Lattice:
    """Return the lattice of a closed insert, of the same volume as the mesh within 2 %.

    Where cells of the wanted size lose more, somewhat smaller ones are taken, with a notice: how
    much of thin rims is lost varies with the size. What is told on the logger "tkamb": mended
    rays, smaller cells, and a post (cam-post contact is not modelled).

    Args:
        insert: closed surface in the insert frame (flat bottom in y = 0 facing -y).
        target_size: wanted edge of a cell, m.

    Raises:
        InputError: as `build_grid`, or no such size keeps the volume: the largest missing part is
            named.
    """
    first: tuple[Lattice, float] | None = None
    for share in VOLUME.sizes:
        lattice = make_grid(insert, share * target_size)
        error = volume_error(lattice.nodes, lattice.cells, insert)
        first = first or (lattice, error)
        if abs(error) <= VOLUME.tolerance:
            if share < 1.0:
                words = _smaller_cells(target_size, share, first[1])
                _log.warning("%s: %s", insert.name, words)
                lattice = replace(lattice, size_notices=(words,))
            tell_repairs(lattice, insert)
            return lattice
        if abs(first[1]) > VOLUME.beyond_refinement:
            break
    assert first is not None
    raise _volume_refusal(*first, insert, target_size)


def _smaller_cells(target_size: float, share: float, error: float) -> str:
    """Return the notice that smaller cells than wanted were taken, and why."""
    size = target_size / MILLIMETRE
    return (
        f"cells of {share * size:.3g} mm instead of {size:.3g} mm, which change the volume of the "
        f"part by {100 * error:+.1f} %"
    )


def _volume_refusal(
    lattice: Lattice, error: float, insert: Surface, target_size: float
) -> InputError:
    """Return the refusal of a lattice whose volume is not the mesh's."""
    part = missing_part(lattice.nodes, lattice.cells, lattice.spacing, insert)
    lacks = f"; it lacks {part}" if error < 0 and part is not None else ""
    return InputError(
        f"the lattice of {target_size / MILLIMETRE:.3g} mm cells has {100 * abs(error):.1f} % "
        f"{'less' if error < 0 else 'more'} volume than the mesh, more than the "
        f"{100 * VOLUME.tolerance:g} % that are allowed{lacks}",
        insert.name,
        "take smaller cells; a part that stands on nothing, or is thinner than a cell, cannot be "
        "kept",
    )
