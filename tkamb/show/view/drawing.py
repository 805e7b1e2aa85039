"""Data of a drawing in the insert frame, for every frame of the motion.

There are f frames. x is anterior, y superior, z lateral, also of a left knee, which the page
mirrors. A position of NaN hides an object in that frame. Arrays with a first axis of 1 are static.

The colour scales are viridis and scales of ColorBrewer (Brewer 2002). They are stored as bytes in
an asset, because importing matplotlib takes 0.1 s.
"""

import json
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tkamb.geometry.frames import Array
from tkamb.geometry.surface import Surface
from tkamb.show.pages import asset
from tkamb.show.style import SKY

METAL, INSERT, BONE, BUTTON = "#8d99a8", "#e4dfd0", "#f0e8d2", "#dcd8cc"
FLOOR = "#b9c4c9"
TENDON, WRAPPED = "#8c3b2e", "#f0c419"
SLACK = "#9a9a9a"
RECORDED = SKY

Colours = NDArray[np.uint8]


def rgb(colour: str) -> Colours:
    """Return red, green and blue (3,), 0 to 255, of a colour "#rrggbb"."""
    return np.frombuffer(bytes.fromhex(colour.removeprefix("#")), np.uint8)


def pressure_scale() -> Colours:
    """Return the colours (256, 3) from zero to the largest pressure of all frames."""
    return _scales()["pressure"]


def strain_scale() -> Colours:
    """Return the colours (256, 3) from zero strain to the limit."""
    return _scales()["strain"]


def activation_scale() -> Colours:
    """Return the colours (256, 3) from zero activation to the limit."""
    return _scales()["activation"]


def wear_scale() -> Colours:
    """Return the colours (256, 3) from zero to the largest wear depth."""
    return _scales()["wear"]


def wear_colours(depth: ArrayLike, limit: float) -> Colours:
    """Return the colours (..., 3) of wear depths. Depths <= 0 have the insert's colour."""
    return _on_scale(depth, limit, wear_scale(), INSERT)


def strain_colours(strain: ArrayLike, limit: float) -> Colours:
    """Return the colours (..., 3) of ligament strains. Slack ligaments (strain <= 0) are grey."""
    return _on_scale(strain, limit, strain_scale())


def activation_colours(activation: ArrayLike, limit: float) -> Colours:
    """Return the colours (..., 3) of activations. Values <= 0 are grey."""
    return _on_scale(activation, limit, activation_scale())


def _on_scale(values: ArrayLike, limit: float, scale: Colours, none: str = SLACK) -> Colours:
    values = np.asarray(values, float)
    share = values / limit if np.isfinite(limit) and limit else values
    level = (255.0 * np.clip(np.nan_to_num(share), 0.0, 1.0)).astype(int)
    return np.where((values > 0)[..., None], scale[level], rgb(none)).astype(np.uint8)


@lru_cache(maxsize=1)
def _scales() -> dict[str, Colours]:
    stored = json.loads(asset("tkamb.show.view", "scales.json"))
    return {
        name: np.frombuffer(bytes.fromhex(text), np.uint8).reshape(256, 3)
        for name, text in stored.items()
    }


LAYERS = (
    "femoral component",
    "insert",
    "worn insert",
    "patella",
    "bones",
    "floor",
    "ligaments",
    "extensor lines",
    "muscles",
    "forces",
    "pressure map",
    "contact points",
    "load paths",
    "recorded pose",
    "lattice",
)
"""Layers that a user can switch on and off, in the order of the page."""

HIDDEN_AT_FIRST = ("worn insert", "recorded pose", "lattice")


@dataclass(frozen=True, eq=False)
class Solid:
    """A rigid surface that moves.

    Args:
        surface: surface in the solid's own frame.
        colour: colour "#rrggbb".
        opacity: opacity, 0 to 1.
        poses: pose in the insert frame, shape (f, 4, 4) or (1, 4, 4).
        wear: wear depth at each vertex, mm, shape (n,), which determines its colour; None: the
            solid has one colour.
    """

    name: str
    layer: str
    surface: Surface
    colour: str
    opacity: float
    poses: Array
    wear: Array | None = None


@dataclass(frozen=True, eq=False)
class Strand:
    """A ligament, tendon or path: a tube along points.

    Args:
        points: points of the centre line, m, shape (f, m, 3) or (1, m, 3). A point may be
            repeated: where the colour changes, and at the end of a path with fewer points.

        colours: colours at the points, 0 to 255, shape (f, m, 3) or (1, m, 3).
        radius: radius of the tube, m.
    """

    name: str
    layer: str
    points: Array
    colours: NDArray[np.uint8]
    radius: float


@dataclass(frozen=True, eq=False)
class Arrow:
    """A force.

    Args:
        colour: colour "#rrggbb".
        points: points of application, m, shape (f, 3).
        forces: forces, N, shape (f, 3).
        ends_there: whether the arrow ends at its point (compression) or starts at it (tension).
        meaning: text of the legend on the body that the force acts on.
    """

    name: str
    colour: str
    points: Array
    forces: Array
    ends_there: bool
    meaning: str


@dataclass(frozen=True, eq=False)
class Marker:
    """A small ball.

    Args:
        colour: colour "#rrggbb".
        points: centre of the ball, m, shape (f, 3).
        radius: radius of the ball, m.
    """

    name: str
    layer: str
    colour: str
    points: Array
    radius: float


@dataclass(frozen=True, eq=False)
class PressureMap:
    """Pressure over the insert or the patellar button.

    Args:
        points: points of the map, m, shape (n, 3).
        triangles: indices of the points, shape (k, 3).
        pressure: pressure, MPa, shape (f, n); NaN in a failed frame.
        gap: gap, m, shape (f, n), positive when apart. It locates the edge of the contact between
            the points.
        poses: pose of the points in the insert frame, shape (f, 4, 4); None: they are in it.
    """

    points: Array
    triangles: NDArray[np.int64]
    pressure: Array
    gap: Array
    poses: Array | None = None

    @property
    def peak(self) -> float:
        """Return the largest pressure of all frames, MPa."""
        return float(np.nanmax(self.pressure, initial=0.0))


@dataclass(frozen=True)
class Reading:
    """One line of the numbers of a frame.

    Args:
        values: value with its unit as text, one per frame.
    """

    name: str
    values: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Drawing:
    """All objects of the drawing of one run.

    Args:
        side: "right" or "left".
        body_weight: body weight, N.
        contact: name of the contact model; empty without contact.
        labels: place of each frame in the motion, for example "60° of flexion".
        times: times of the frames, s, shape (f,).
        statuses: status of each frame: "ok" or a sentence.
        readings: displayed numbers of every frame.
        markers: contact points and centres of pressure.
        map: pressure map; None without contact.
        button_map: pressure map of the patellar button; None: its contact is not modelled.
        strain_limit: upper end of the ligaments' colour scale; 0 without ligaments.
        activation_limit: upper end of the muscles' colour scale; 0 without muscles.
        lattice: edges of the lattice's cells, m, shape (s, 2, 3); empty unless requested.
    """

    title: str
    side: str
    body_weight: float
    contact: str
    labels: tuple[str, ...]
    times: Array
    statuses: tuple[str, ...]
    readings: tuple[Reading, ...]
    solids: tuple[Solid, ...]
    strands: tuple[Strand, ...]
    arrows: tuple[Arrow, ...]
    markers: tuple[Marker, ...]
    map: PressureMap | None
    strain_limit: float
    activation_limit: float = 0.0
    lattice: Array = field(default_factory=lambda: np.empty((0, 2, 3)))
    notes: tuple[str, ...] = ()
    button_map: PressureMap | None = None

    def __len__(self) -> int:
        return len(self.labels)

    @property
    def deepest_wear(self) -> float:
        """Return the largest wear depth, mm; 0 without wear."""
        return max((float(s.wear.max()) for s in self.solids if s.wear is not None), default=0.0)
