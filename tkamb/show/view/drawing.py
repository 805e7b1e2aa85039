"""What is drawn of a run: pure data, in the insert frame, for every frame of the motion.

f frames; x anterior, y superior, z lateral (a left knee is mirrored back on the page). NaN
hides a thing at that frame. Arrays with a first axis of 1 do not move.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tkamb.geometry.frames import Array
from tkamb.geometry.surface import Surface

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
        name: as in the legend.
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
        title: whose knee and which contact model.
        side: "right" or "left".
        body_weight: N.
        contact: name of the contact model; empty without contact.
        labels: where in the motion each frame is, "60° of flexion".
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
