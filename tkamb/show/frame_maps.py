"""Pressure maps of all frames as one grey picture, for the report's slider.

A byte is `RIM_BYTE` at the edge of contact, larger in contact (255 for the largest pressure of the
run) and smaller outside. The page interpolates linearly between bytes and colours the contact.
"""

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import Normalize, to_hex
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tkamb.geometry.frames import SIDES, Array
from tkamb.run.metrics import map_rows
from tkamb.show.levels import pressure_levels, touched_part
from tkamb.show.pressure_maps import TopView, place_maps, pressure_bar
from tkamb.show.style import PRESSURE_MAP, new_figure, png_address, settings
from tkamb.units import MEGAPASCAL

if TYPE_CHECKING:
    from tkamb.run.results import Results


# Byte at the edge of contact; larger bytes are pressure. It leaves bytes for the
# gaps outside contact, from which the page finds the edge between grid points.
RIM_BYTE = 64
# Largest number of maps in the page. A longer run shows the map of the nearest frame at each
# position of the slider. It limits the size of the page.
MOST_FRAMES = 250
# Grid step of the slider's maps divided by the grid step of the report's still maps.
# The data are a quarter of the size.
COARSENING = 2


def draw_insert(view: TopView, largest: float) -> Figure:
    """Return the bare insert with a colour bar up to `largest`, MPa, over which the page draws the
    pressure.
    """
    with settings():
        figure = new_figure(5.4, 3.7)
        (axes,), beside = place_maps(figure, 1, 1, 4.0)
        view.draw_insert(axes)
        view.draw_labels(axes)
        pressure_bar(figure, Normalize(0.0, largest), cax=beside)
    return figure


def largest_pressure(results: "Results") -> float:
    """Return the upper end of the colour scale, MPa: the largest pressure, or 1 if it is zero."""
    assert results.maps is not None
    return float(np.nanmax(results.maps.peaks_Pa)) / MEGAPASCAL or 1.0


def frame_maps(results: "Results", view: TopView) -> dict[str, Any]:
    """Return the data with which the page draws the pressure of any frame, for JSON.

    Returns:
        picture: data address of a PNG that holds one tile per map.
        across: number of tiles side by side.
        rows, columns: size of a tile in bytes.
        tile: index of the tile that each frame shows.
        shown: for each frame, the frame in which the pressure of its tile was computed.
        edges: left, right, bottom and top of a tile, mm on the page.
        span: left, right, bottom and top of the drawn insert, mm on the page.
        rim: `RIM_BYTE`.
        largest: upper end of the colour scale, MPa.
        colours: the colour scale, 256 hexadecimal colours in one string.
        centres: side -> centre of pressure of each frame, mm on the page; None: no contact.
    """
    assert results.maps is not None
    rows = map_rows(results)
    frames = np.array(sorted(rows))
    chosen = frames[np.unique(np.linspace(0, len(frames) - 1, MOST_FRAMES).round().astype(int))]
    largest = largest_pressure(results) * MEGAPASCAL
    tiles, edges = _tiles(results, view, [rows[k] for k in chosen], largest)
    across = int(np.ceil(np.sqrt(len(chosen))))
    nearest = [int(np.argmin(np.abs(chosen - k))) for k in range(len(results))]
    bottom, top = view.up_limits
    first, right = view.across_limits
    return {
        "picture": _png(tiles, across),
        "across": across,
        "rows": tiles.shape[1],
        "columns": tiles.shape[2],
        "tile": nearest,
        "shown": [int(chosen[n]) for n in nearest],
        "edges": edges,
        "span": [first, right, bottom, top],
        "rim": RIM_BYTE,
        "largest": largest / MEGAPASCAL,
        "colours": "".join(to_hex(one)[1:] for one in colormaps[PRESSURE_MAP](np.arange(256))),
        "centres": {side: _centres(results, view, side) for side in SIDES},
    }


def _tiles(
    results: "Results", view: TopView, rows: list[int], largest: float
) -> tuple[NDArray[np.uint8], list[float]]:
    """Return tiles (frames, rows, columns), cropped to all contacts, and their left, right, bottom
    and top edge, mm.
    """
    maps = results.maps
    assert maps is not None
    pressure, gap = (maps.rows(name, rows) for name in ("pressure_Pa", "gap_m"))
    levels = pressure_levels(pressure, gap, view.triangles, largest)
    result = view.grid.sample(levels, COARSENING)
    down, over = touched_part(result.max(axis=0) > 0)
    steps = np.clip(np.round(RIM_BYTE + (255 - RIM_BYTE) * result[:, down, over]), 0, 255)
    up, across = (
        view.grid.up[::COARSENING][down],
        view.grid.across[::COARSENING][over],
    )
    edges = [round(float(edge), 3) for edge in (across[0], across[-1], up[-1], up[0])]
    return steps.astype(np.uint8), edges


def _png(tiles: NDArray[np.uint8], across: int) -> str:
    """Return all tiles side by side as a PNG data address."""
    count, rows, columns = tiles.shape
    down = -(-count // across)
    whole = np.zeros((down * across, rows, columns), np.uint8)
    whole[:count] = tiles
    sheet = whole.reshape(down, across, rows, columns).swapaxes(1, 2)
    return png_address(sheet.reshape(down * rows, across * columns))


def _centres(results: "Results", view: TopView, side: str) -> list[list[float] | None]:
    places: tuple[Array, Array] = view.page_coordinates(
        results[f"{side}_cop_ap_mm"], results[f"{side}_cop_ml_mm"]
    )
    return [
        [round(float(x), 2), round(float(y), 2)] if np.isfinite(x + y) else None
        for x, y in zip(*places, strict=True)
    ]
