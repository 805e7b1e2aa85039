"""A virtual pressure film: the reading of a sensor with finite cells in a pressure field.

Each cell reports the pressure at its centre, as a matrix sensor reports one number for the sensel.
Force, area and mean pressure then are sums over cells; their errors depend on where the grid lies
(Fregly and Sawyer, J Biomech 36:609 (2003)).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from matplotlib.tri import LinearTriInterpolator, Triangulation

from tkamb.contact.pair import PreparedContact
from tkamb.contact.result import ContactResult
from tkamb.geometry.frames import Array

Field = Callable[[Array, Array], Array]
"""Function of x (n,) and z (n,), m: pressure (n,), Pa; 0 without contact."""


@dataclass(frozen=True)
class FilmReading:
    """Reading of the film.

    Args:
        force: sum of pressures times the area of a cell, N.
        area: area of the cells with a pressure, m².
        peak_pressure: largest pressure of a cell, Pa.
        cells: number of cells with a pressure.
        perimeter_cells: number of these cells with a neighbour without pressure.
    """

    force: float
    area: float
    peak_pressure: float
    cells: int
    perimeter_cells: int

    @property
    def mean_pressure(self) -> float:
        """Force over area, Pa; NaN without a pressure."""
        return self.force / self.area if self.cells else float("nan")

    @property
    def perimeter_share(self) -> float:
        """Perimeter cells over cells (area ratio of Fregly and Sawyer); NaN without a pressure."""
        return self.perimeter_cells / self.cells if self.cells else float("nan")


@dataclass(frozen=True)
class PressureFilm:
    """A square grid of sensels in the x-z plane.

    Args:
        cell: m, edge of a sensel.
        offset: distance of a cell's corner from the origin along x and z, in cells.
        threshold: smallest pressure that a cell reads, Pa.
    """

    cell: float
    offset: tuple[float, float] = (0.0, 0.0)
    threshold: float = 0.0

    def read(self, field: Field, low: Array, high: Array) -> FilmReading:
        """Read a field within a rectangle.

        Args:
            field: function of the pressure at points.
            low: (2,) m, smallest x and z of the field.
            high: (2,) m, largest x and z of the field.
        """
        x, z = (
            self.cell * (np.arange(np.floor(a / self.cell) - 2, np.ceil(b / self.cell) + 3) + o)
            for a, b, o in zip(low, high, np.asarray(self.offset) + 0.5, strict=True)
        )
        gx, gz = np.meshgrid(x, z, indexing="ij")
        pressure = field(gx.ravel(), gz.ravel()).reshape(gx.shape)
        read = pressure > self.threshold
        inner = read[1:-1, 1:-1] & read[:-2, 1:-1] & read[2:, 1:-1] & read[1:-1, :-2]
        inner &= read[1:-1, 2:]
        square = self.cell**2
        return FilmReading(
            force=float(pressure[read].sum()) * square,
            area=int(read.sum()) * square,
            peak_pressure=float(pressure.max(initial=0.0)),
            cells=int(read.sum()),
            perimeter_cells=int(read.sum() - inner.sum()),
        )


def hertz_field(semi_axes: tuple[float, float], peak: float) -> Field:
    """Return p = p0 sqrt(1 - x²/a² - z²/b²), a Hertz ellipse about the origin.

    Args:
        semi_axes: semi-axes a and b, m.
        peak: peak pressure p0, Pa.
    """
    a, b = semi_axes
    return lambda x, z: peak * np.sqrt(np.maximum(1.0 - (x / a) ** 2 - (z / b) ** 2, 0.0))


def film_of(result: ContactResult, state: PreparedContact) -> tuple[Field, Array, Array]:
    """Return a result's pressure as a field, and the corners (2,), (2,) m of its rectangle."""
    x, _, z = result.points.T
    between = LinearTriInterpolator(Triangulation(x, z, state.triangles), result.pressure)
    loaded = result.points[result.pressure > 0.0][:, [0, 2]]
    margin = 2e-3
    low, high = loaded.min(axis=0) - margin, loaded.max(axis=0) + margin
    return lambda at, to: np.asarray(between(at, to).filled(0.0)), low, high


def worst_errors(semi_axes: tuple[float, float], cell: float, places: int = 12) -> dict[str, float]:
    """Return the largest relative errors on a Hertz ellipse over the grid's places.

    Args:
        semi_axes: m.
        cell: m, edge of a sensel.
        places: number of positions of the grid along each axis, within one cell.

    Returns:
        force, peak, mean and area, each as |read - exact| / exact.
    """
    a, b = semi_axes
    exact_area, exact_force = np.pi * a * b, 2.0 / 3.0 * np.pi * a * b
    field, reach = hertz_field(semi_axes, 1.0), np.array([a, b])
    shifts = np.arange(places) / places
    worst = dict.fromkeys(("force", "peak", "mean", "area"), 0.0)
    for offset in ((i, j) for i in shifts for j in shifts):
        read = PressureFilm(cell, offset).read(field, -reach, reach)
        errors = {
            "force": read.force / exact_force - 1.0,
            "peak": read.peak_pressure - 1.0,
            "mean": read.mean_pressure / (2.0 / 3.0) - 1.0,
            "area": read.area / exact_area - 1.0,
        }
        worst = {name: max(worst[name], abs(error)) for name, error in errors.items()}
    return worst
