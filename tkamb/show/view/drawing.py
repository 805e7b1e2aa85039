"""What is drawn of a run: pure data, in the insert frame, for every frame of the motion.

f frames; x anterior, y superior, z lateral (a left knee is mirrored back on the page). NaN
hides a thing at that frame. Arrays with a first axis of 1 do not move.

The colour scales are viridis and those of ColorBrewer (Brewer 2002), stored as bytes in an asset:
importing matplotlib would take a tenth of a second.
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
    """Return (3,) 0 to 255 of "#rrggbb"."""
    return np.frombuffer(bytes.fromhex(colour.removeprefix("#")), np.uint8)


def pressure_scale() -> Colours:
    """Return the 256 colours (256, 3) from no pressure to the largest of all frames."""
    return _scales()["pressure"]


def strain_scale() -> Colours:
    """Return the 256 colours (256, 3) from no strain to the limit."""
    return _scales()["strain"]


def activation_scale() -> Colours:
    """Return the 256 colours (256, 3) from no activation to the limit."""
    return _scales()["activation"]


def wear_scale() -> Colours:
    """Return the 256 colours (256, 3) from no wear to the deepest."""
    return _scales()["wear"]


def wear_colours(depth: ArrayLike, limit: float) -> Colours:
    """Return colours (..., 3) of depths of wear; none (<= 0) is the insert's colour."""
    return _on_scale(depth, limit, wear_scale(), INSERT)


def strain_colours(strain: ArrayLike, limit: float) -> Colours:
    """Return colours (..., 3) of ligament strains; slack (strain <= 0) is grey."""
    return _on_scale(strain, limit, strain_scale())


def activation_colours(activation: ArrayLike, limit: float) -> Colours:
    """Return colours (..., 3) of activations; none (<= 0) is grey."""
    return _on_scale(activation, limit, activation_scale())


def _on_scale(values: ArrayLike, limit: float, scale: Colours, none: str = SLACK) -> Colours:
    values = np.asarray(values, float)
    share = values / limit if np.isfinite(limit) and limit else values
    level = (255.0 * np.clip(np.nan_to_num(share), 0.0, 1.0)).astype(int)
    return np.where((values > 0)[..., None], scale[level], rgb(none)).astype(np.uint8)


@lru_cache(maxsize=1)
def _scales() -> dict[str, Colours]:
    """Return the scales (256, 3) by name."""
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
"""What can be switched on and off, in the order of the page."""

HIDDEN_AT_FIRST = ("worn insert", "recorded pose", "lattice")


@dataclass(frozen=True, eq=False)
class Solid:
    """A rigid surface that moves.

    Args:
        name: unique within the drawing.
        layer: one of LAYERS.
        surface: in its own frame.
        colour: "#rrggbb".
        opacity: 0 to 1.
        poses: (f, 4, 4) or (1, 4, 4) pose in the insert frame.
        wear: (n,) mm, worn off each vertex, which colours it; None: one colour.
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
        name: unique within the drawing.
        layer: one of LAYERS.
        points: (f, m, 3) or (1, m, 3) m; a repeated point ends the tube.
        colours: (f, m, 3) or (1, m, 3), 0 to 255.
        radius: m.
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
        name: name in the legend.
        colour: "#rrggbb".
        points: (f, 3) m, where it acts.
        forces: (f, 3) N.
        ends_there: whether the arrow ends at the point (it presses) or starts there (it pulls).
        meaning: on what it acts, for the legend.
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
        name: unique within the drawing.
        layer: one of LAYERS.
        colour: "#rrggbb".
        points: (f, 3) m.
        radius: m.
    """

    name: str
    layer: str
    colour: str
    points: Array
    radius: float


@dataclass(frozen=True, eq=False)
class PressureMap:
    """Pressure over the insert.

    Args:
        points: (n, 3) m.
        triangles: (k, 3) indices.
        pressure: (f, n) MPa, NaN where the frame failed.
        gap: (f, n) m, positive when apart; says where between the points the contact ends.
    """

    points: Array
    triangles: NDArray[np.int64]
    pressure: Array
    gap: Array

    @property
    def peak(self) -> float:
        """MPa, over all frames."""
        return float(np.nanmax(self.pressure, initial=0.0))


@dataclass(frozen=True)
class Reading:
    """One line of the numbers of a frame.

    Args:
        name: what it is.
        values: one text per frame, with its unit.
    """

    name: str
    values: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Drawing:
    """Everything that is drawn of one run.

    Args:
        title: name of the run and its contact model.
        side: "right" or "left".
        body_weight: N.
        contact: name of the contact model; empty without contact.
        labels: place of each frame in the motion, for example "60° of flexion".
        times: (f,) s.
        statuses: per frame, "ok" or plain words.
        readings: the numbers of every frame.
        solids: surfaces.
        strands: ligaments, tendons, paths.
        arrows: forces.
        markers: contact points and centres of pressure.
        map: pressure; None without contact.
        strain_limit: upper end of the ligaments' colour scale; 0 without ligaments.
        activation_limit: upper end of the muscles' colour scale; 0 without muscles.
        lattice: (s, 2, 3) m, lines of the contact model's grid; empty unless asked for.
        notes: what a viewer must know, plain sentences.
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

    def __len__(self) -> int:
        return len(self.labels)

    @property
    def deepest_wear(self) -> float:
        """Largest depth, mm; 0 without wear."""
        return max((float(s.wear.max()) for s in self.solids if s.wear is not None), default=0.0)
