"""The insert's nodes on every vertical grid line, by rules 7 to 9 of Sharma (2008).

The node nearest to an end of the intervals of a line along y inside the part (the insert) is moved
onto the surface (half-cell rule). Rules 8 and 9 are for intervals thinner than a cell.

With level layers a dish would be a staircase: wherever the number of cells in a column changes, a
wedge under the surface would belong to no cell (3.4 to 4 % of the volume of real inserts at 1 mm).
So the layers between the flat bottom and one reference layer are stretched to the top surface,
column by column, as far as the edge ratio permits:

    y_j(x, z) = j H(x, z) / J          0 <= j <= J

H is the height of the top where this is smooth, continued smoothly under a post or an eminence.
Above the reference layer and below the bottom (a peg) the layers have the spacing of the grid.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import spsolve

from tkamb.geometry.frames import Array, Index, Mask
from tkamb.geometry.height_field import Intervals, inside_intervals
from tkamb.geometry.rays import RayCaster
from tkamb.geometry.surface import Surface

# 1: longest over shortest edge of a cell before its nodes are moved onto the surface.
# Flatter hexahedra are too stiff in bending.
MAX_EDGE_RATIO = 1.4
# 1: steepest slope, rise over run, that the layers follow (45 deg). Steeper layers
# would shear the cells.
MAX_SLOPE = 1.0
# 1: largest share of columns that are too low for the layers. A few columns at the
# rim may be too low.
MAX_LOW_SHARE = 0.01


@dataclass(frozen=True, eq=False)
class Levels:
    """Node layers over the columns of the grid.

    Args:
        reference: height H, m, (nx, nz).
        layers: J, number of cells between the bottom and the reference layer.
        spacing: spacing of the layers above the reference layer and below the bottom, m.
    """

    reference: Array
    layers: int
    below: int
    spacing: float
    count: int

    def position(self, height: Array, i: Index, k: Index) -> Array:
        """Return heights (m,), m, in columns (i, k) as layer numbers, which may be fractions."""
        reference = self.reference[i, k]
        within = np.clip(height, 0.0, reference) * self.layers / reference
        outside = np.minimum(height, 0.0) + np.maximum(height - reference, 0.0)
        return self.below + within + outside / self.spacing

    def heights(self) -> Array:
        """Return the heights (nx, count, nz), m."""
        j = np.arange(self.count)[None, :, None] - self.below
        within = np.clip(j, 0, self.layers) * self.reference[:, None, :] / self.layers
        outside = np.minimum(j, 0) + np.maximum(j - self.layers, 0)
        return within + outside * self.spacing


def follow_top(top: Array, lowest: float, spacing: Array) -> Levels:
    """Return the layers that follow the top surface.

    `top` (nx, nz), m, is NaN where the column misses the part, `lowest` (m) y of its lowest point.
    """
    across = spacing[[0, 2]]
    thinnest, thickest = across.max() / MAX_EDGE_RATIO, across.min() * MAX_EDGE_RATIO
    layers = _reference_layers(top[np.isfinite(top)], thinnest, thickest, spacing[1])
    clipped = np.clip(top, layers * thinnest, layers * thickest)
    reference = _filled(_slope_limited(_smooth_part(clipped, across), across))
    excess = np.nanmax(top - reference)
    above = max(int(np.ceil(excess / spacing[1] - 1e-6)), 0) + 1
    below = max(int(np.ceil(-lowest / spacing[1] - 0.5)), 0)
    return Levels(reference, layers, below, float(spacing[1]), below + layers + above + 1)


def _reference_layers(top: Array, thinnest: float, thickest: float, spacing: float) -> int:
    """Return the number of layers that can follow the largest part of the top surface.

    They end in a step where the top is more than half a layer too low for them. The edge of a step
    has cells on one side only and is too soft. Steps are therefore allowed only on parts higher
    than the dishes, which no condyle meets.
    """
    candidates = np.arange(1, int(np.ceil(top.max() / thinnest)) + 1)
    stepped = np.array([np.mean(top < (n - 0.5) * thinnest) for n in candidates])
    candidates = candidates[stepped <= max(MAX_LOW_SHARE, stepped.min())]
    covered = [np.mean((top >= n * thinnest) & (top <= n * thickest)) for n in candidates]
    best = candidates[np.isclose(covered, np.max(covered), atol=1e-3)]
    return int(best[np.argmin(np.abs(best - np.median(top) / spacing))])


def _smooth_part(height: Array, across: Array) -> Array:
    """Return the largest smooth patch of columns, and NaN elsewhere.

    Slopes between neighbours of a patch are at most `MAX_SLOPE`.
    """
    number = np.arange(height.size).reshape(height.shape)
    links = []
    for axis in range(2):
        gentle = np.abs(np.diff(height, axis=axis)) <= MAX_SLOPE * across[axis] * (1.0 + 1e-9)
        low = np.delete(number, -1, axis=axis)[gentle]
        high = np.delete(number, 0, axis=axis)[gentle]
        links.append(np.stack([low, high]))
    a, b = np.concatenate(links, axis=1)
    graph = coo_array((np.ones(len(a), bool), (a, b)), shape=(height.size, height.size))
    label = connected_components(graph, directed=False)[1].reshape(height.shape)
    finite = np.isfinite(height)
    largest = np.bincount(label[finite]).argmax()
    return np.where(finite & (label == largest), height, np.nan)


def _slope_limited(height: Array, across: Array) -> Array:
    """Return the largest function below `height` whose slope is at most `MAX_SLOPE`."""
    result = np.where(np.isfinite(height), height, np.inf)
    while True:
        before = result.copy()
        for axis in range(2):
            rise = MAX_SLOPE * across[axis]
            along_axis = np.moveaxis(result, axis, 0)
            along_axis[1:] = np.minimum(along_axis[1:], along_axis[:-1] + rise)
            along_axis[:-1] = np.minimum(along_axis[:-1], along_axis[1:] + rise)
        if np.array_equal(before, result):
            return np.where(np.isfinite(height), result, np.nan)


def _filled(height: Array) -> Array:
    """Return the heights, with NaN replaced by a harmonic continuation."""
    unknown = np.isnan(height)
    if not unknown.any():
        return height
    number = np.arange(height.size).reshape(height.shape)
    pairs = np.concatenate(
        [
            np.stack([number[:-1].ravel(), number[1:].ravel()]),
            np.stack([number[:, :-1].ravel(), number[:, 1:].ravel()]),
        ],
        axis=1,
    )
    a, b = np.concatenate([pairs, pairs[::-1]], axis=1)
    ones = np.ones(len(a))
    weights = coo_array((ones, (a, b)), shape=(height.size, height.size)).tocsr()
    degree = np.bincount(a, minlength=height.size)
    free, fixed = np.flatnonzero(unknown), np.flatnonzero(~unknown)
    laplacian = (
        coo_array(
            (degree[free].astype(float), (np.arange(len(free)), np.arange(len(free))))
        ).tocsr()
        - (weights[free][:, free])
    )
    result = height.ravel().copy()
    result[free] = spsolve(laplacian.tocsc(), weights[free][:, fixed] @ result[fixed])
    return result.reshape(height.shape)


Nodes = tuple[Index, ...]


# Cells: distances this near to half a cell count as half a cell. Above rounding errors.
COLUMN_TIE = 1e-6
# Cells: vertices this near to the bounding box lie on its side. Above the noise of meshes.
SIDE_TOLERANCE = 0.02
# 1: a triangle with a smaller y of its normal (87 deg) belongs to a wall. No
# articular surface is that steep.
WALL_NORMAL_Y = 0.05
# Cells: distance inside a wall at which a missed vertical ray is repeated. A ray
# exactly on a rough wall may miss the part.
WALL_INSET = 0.02
# Cells: largest change of a surface's height when a node moves sideways. If it is larger, the ray
# has hit another surface. Slopes that cells follow cause smaller changes.
MAX_HEIGHT_CHANGE = 0.75


@dataclass(eq=False)
class NodeField:
    """All nodes of the structured grid, during meshing; arrays have the shape (nx, ny, nz).

    Args:
        lines: x and z coordinates of the grid lines along y, m.
        points: (nx, ny, nz, 3), m.
        member: the nodes that belong to the part.
        lower_end: the lower ends of intervals, as `upper_end` the upper ones.
        top: the upper ends of the highest intervals.
        interval: number of each node's interval; -1 if there is none.
        mended: number of lines with crossings corrected from their neighbours.
        closed_gaps: number of filled gaps, narrower than a cell.
        thin: number of intervals thinner than half a cell, with one node.
    """

    lines: tuple[Array, Array]
    spacing: Array
    points: Array
    member: Mask
    lower_end: Mask
    upper_end: Mask
    top: Mask
    interval: Index
    mended: int
    closed_gaps: int
    thin: int

    def has_top(self, nodes: tuple[Index, ...]) -> Mask:
        """Return whether the columns of nodes have a top node already."""
        return np.logical_or.reduce(self.top, axis=1)[nodes[0], nodes[2]]


@dataclass(frozen=True, eq=False)
class Ends:
    """Layers of the first and last nodes of intervals.

    `single` marks intervals of one node, `held` those whose node is not moved.
    """

    first: Index
    last: Index
    single: Mask
    held: Mask


def place_columns(surface: Surface, spacing: Array) -> NodeField:
    """Return the grid over the surface's bounding box, with nodes placed along y."""
    x, z = (_grid_line(surface, axis, spacing[axis]) for axis in (0, 2))
    intervals = inside_intervals(surface, 1, z, x)
    i, k = intervals.second, intervals.first
    top = np.full((len(x), len(z)), np.nan)
    top[i, k] = intervals.upper
    levels = follow_top(top, surface.bounds[0, 1], spacing)
    low, high = levels.position(intervals.lower, i, k), levels.position(intervals.upper, i, k)
    intervals, low, high, closed = _without_narrow_gaps(intervals, low, high)
    field = _empty_field((x, z), spacing, levels.heights())
    field.mended, field.closed_gaps = intervals.mended, closed
    _admit(field, intervals, interval_ends(low, high, levels.count))
    return field


def interval_ends(low: Array, high: Array, count: int) -> Ends:
    """Return the end nodes of intervals [low, high] of a line.

    Heights are in layers; T = high - low is the thickness, and n the number of nodes strictly
    inside. The node nearest to each end is moved to that end, except:

        n = 0, T <= 1/2   one node, moved to the mean height
        n = 1, T <= 1/2   one node, not moved
        n = 1, T > 1/2    if the node is nearest to both ends, it is moved to the nearer end, and
                          the next node outside is moved to the other end

    A line has `count` nodes; the ends are (m,).
    """
    first = np.floor(low + 0.5 + COLUMN_TIE).astype(np.int64)
    last = np.ceil(high - 0.5 - COLUMN_TIE).astype(np.int64)
    inside = np.ceil(high - COLUMN_TIE) - np.floor(low + COLUMN_TIE) - 1
    thick = high - low > 0.5 + COLUMN_TIE
    single = ~thick & (inside <= 1)
    thin = single & (inside == 1)
    joined = thick & (first >= last)
    upwards = (np.abs(low - first) <= np.abs(high - first)) & (first < count - 1)
    last = np.where(joined, first + upwards, last)
    first = np.where(joined, last - 1, first)
    middle = np.where(thin, np.floor(low + COLUMN_TIE) + 1, np.round(0.5 * (low + high))).astype(
        np.int64
    )
    return Ends(np.where(single, middle, first), np.where(single, middle, last), single, thin)


def _grid_line(surface: Surface, axis: int, spacing: float) -> Array:
    """Return equally spaced coordinates, m, whose ends lie on the part's sides."""
    lower, upper = surface.bounds[:, axis]
    line = np.linspace(lower, upper, round((upper - lower) / spacing) + 1)
    values = surface.vertices[:, axis]
    line[0] = values[values <= lower + SIDE_TOLERANCE * spacing].max()
    line[-1] = values[values >= upper - SIDE_TOLERANCE * spacing].min()
    return line


def _empty_field(lines: tuple[Array, Array], spacing: Array, heights: Array) -> NodeField:
    x, z = lines
    points = np.empty((*heights.shape, 3))
    points[..., 0], points[..., 2] = x[:, None, None], z[None, None, :]
    points[..., 1] = heights
    return NodeField(
        lines=lines,
        spacing=spacing,
        points=points,
        member=np.zeros(heights.shape, bool),
        lower_end=np.zeros(heights.shape, bool),
        upper_end=np.zeros(heights.shape, bool),
        top=np.zeros(heights.shape, bool),
        interval=np.full(heights.shape, -1),
        mended=0,
        closed_gaps=0,
        thin=0,
    )


def _without_narrow_gaps(
    intervals: Intervals, low: Array, high: Array
) -> tuple[Intervals, Array, Array, int]:
    """Join neighbouring intervals whose facing ends have the same node."""
    same = (np.diff(intervals.first) == 0) & (np.diff(intervals.second) == 0)
    joined = same & (np.floor(low[1:] + 0.5 + COLUMN_TIE) <= np.ceil(high[:-1] - 0.5 - COLUMN_TIE))
    begins = np.flatnonzero(np.append(True, ~joined))
    ends = np.append(begins[1:], len(low)) - 1
    merged = Intervals(
        intervals.first[begins],
        intervals.second[begins],
        intervals.lower[begins],
        intervals.upper[ends],
        intervals.mended,
    )
    return merged, low[begins], high[ends], int(joined.sum())


def _admit(field: NodeField, intervals: Intervals, ends: Ends) -> None:
    i, k = intervals.second, intervals.first
    count = ends.last - ends.first + 1
    owner = np.repeat(np.arange(len(count)), count)
    rank = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    nodes = i[owner], ends.first[owner] + rank, k[owner]
    field.member[nodes] = True
    field.interval[nodes] = owner
    mean = 0.5 * (intervals.lower + intervals.upper)
    free = ~ends.held
    lower = np.where(ends.single, mean, intervals.lower)
    upper = np.where(ends.single, mean, intervals.upper)
    field.points[i[free], ends.first[free], k[free], 1] = lower[free]
    field.points[i[free], ends.last[free], k[free], 1] = upper[free]
    field.lower_end[i, ends.first, k] = True
    field.upper_end[i, ends.last, k] = True
    same = (np.diff(intervals.first) == 0) & (np.diff(intervals.second) == 0)
    highest = np.append(~same, True) & ~ends.single
    field.top[i[highest], ends.last[highest], k[highest]] = True
    field.thin = int(ends.single.sum())


def refired_inwards(
    field: NodeField, nodes: Nodes, target: Array, inward: Array, rays: RayCaster
) -> Array:
    """Return the heights (n,), m, of nodes that are moved onto walls.

    A vertical ray on a rough wall may miss the part. The target (n, 3), m, is then moved inside by
    `wall_inset` along `inward` (n, 2), x and z, in place, and the ray repeated.
    """
    height = refired(field, nodes, target, rays)
    missed = np.flatnonzero(~np.isfinite(height))
    if missed.size:
        step = inward[missed] / np.linalg.norm(inward[missed], axis=1, keepdims=True)
        target[missed[:, None], [0, 2]] += WALL_INSET * field.spacing[[0, 2]] * step
        again = tuple(index[missed] for index in nodes)
        height[missed] = refired(field, again, target[missed], rays)
    return height


def refired(field: NodeField, nodes: Nodes, target: Array, rays: RayCaster) -> Array:
    """Return the heights (n,), m, of nodes after a move sideways to `target` (n, 3).

    Ends of intervals stay on the surface, and other nodes keep their height. The result is NaN
    where the height of the surface changes by more than `MAX_HEIGHT_CHANGE`.
    """
    height = field.points[..., 1][nodes]
    for end, facing in ((field.upper_end[nodes], 1.0), (field.lower_end[nodes], -1.0)):
        rows = np.flatnonzero(end)
        base = target[rows].copy()
        base[:, 1] = rays.surface.bounds[0, 1] - field.spacing[1]
        ray, t, face = rays.all(base, (0.0, 1.0, 0.0))
        matches = rays.surface.face_normals[face, 1] * facing > WALL_NORMAL_Y
        ray, y = ray[matches], base[ray[matches], 1] + t[matches]
        change = np.abs(y - height[rows[ray]])
        # Of each ray, the hit with the smallest change of height is used.
        order = np.lexsort((change, ray))
        with_hit, nearest = np.unique(ray[order], return_index=True)
        value = np.full(len(rows), np.nan)
        close = change[order][nearest] <= MAX_HEIGHT_CHANGE * field.spacing[1]
        value[with_hit[close]] = y[order][nearest][close]
        height[rows] = value
    return height
