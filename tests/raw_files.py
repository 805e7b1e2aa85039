"""Readers of a scene's files and a filter, with numpy and scipy only, independent of tkamb.

Files are tables (.csv, .sto), markers (.trc) and binary STL. The filter is a second implementation
of the quintic smoothing spline of `tkamb.io.recordings.filtering`.
"""

from pathlib import Path

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline
from scipy.spatial.transform import Rotation


def read_table(path):
    """Return name -> column (n,) of a .csv or .sto file."""
    lines = Path(path).read_text(encoding="utf-8").splitlines()
    if Path(path).suffix == ".sto":
        lines = lines[[line.strip() for line in lines].index("endheader") + 1 :]
    names = lines[0].replace(",", " ").split()
    rows = [line.replace(",", " ").split() for line in lines[1:] if line.strip()]
    return dict(zip(names, np.array(rows, float).T, strict=True))


def read_markers(path, names, start, end):
    """Return times (n,) and marker -> (n, 3), in the file's unit, between two times."""
    lines = Path(path).read_text(encoding="utf-8").splitlines()
    labels = [label for label in lines[3].split("\t")[2:] if label.strip()]
    rows = [line.split("\t") for line in lines[5:] if line.strip()]
    rows = [row for row in rows if start <= float(row[1]) <= end]
    column = {name: 2 + 3 * labels.index(name) for name in names}
    places = {n: np.array([row[c : c + 3] for row in rows], float) for n, c in column.items()}
    return np.array([row[1] for row in rows], float), places


def read_stl(path):
    """Return the corners (k, 3, 3) of a binary STL."""
    data = Path(path).read_bytes()[84:]
    kind = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    return np.frombuffer(data, kind)["corners"].astype(float)


def volume_centroid(corners):
    """Return the centroid (3,) of the volume in a closed mesh."""
    volumes = np.linalg.det(corners)
    return volumes @ corners.mean(axis=1) * 0.75 / volumes.sum()


def pose(rotation, position):
    """Return the 4x4 pose."""
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = rotation, position
    return result


def rotation(sequence, degrees):
    """Return the rotation matrix of Euler angles in degrees."""
    return Rotation.from_euler(sequence, degrees, degrees=True).as_matrix()


def axes_matrix(text):
    """Return R with v_anatomical = R v_file, for file axes like "-x,+y,-z"."""
    rows = [np.eye(3)["xyz".index(a[1])] * (-1 if a[0] == "-" else 1) for a in text.split(",")]
    return np.array(rows)


# Curves


def interpolated(time, values):
    """Return the quintic spline through the samples."""
    return make_interp_spline(time, values, 5)


def smoothed(time, values, cutoff):
    """Return s that minimises sum w (x - s)^2 + (2 pi cutoff)^-6 int s'''^2 dt."""
    values = np.asarray(values, float)
    spans = int(np.ceil((time[-1] - time[0]) * cutoff * 16))
    step = (time[-1] - time[0]) / spans
    knots = time[0] + step * np.arange(-5, spans + 6)
    design = BSpline.design_matrix(np.clip(time, knots[5], knots[-6]), knots, 5).toarray()
    nodes, weights = np.polynomial.legendre.leggauss(3)
    points = (knots[5:-6, None] + step * (nodes + 1) / 2).ravel()
    third = BSpline(knots, np.eye(spans + 5), 5).derivative(3)(points)
    penalty = third.T @ (np.tile(weights * step / 2, spans)[:, None] * third)
    scaled = np.gradient(time)[:, None] * design
    normal = design.T @ scaled + (2 * np.pi * cutoff) ** -6.0 * penalty
    return BSpline(knots, np.linalg.solve(normal, scaled.T @ values), 5)


def smoothed_cycle(time, values, cutoff):
    """Return the smoothing spline of three equal cycles; the middle one equals a closed cycle's."""
    cycle = np.array(values, float)
    cycle[0] = cycle[-1] = 0.5 * (cycle[0] + cycle[-1])
    period = time[-1] - time[0]
    times = np.concatenate([time[:-1] - period, time[:-1], time + period])
    return smoothed(times, np.concatenate([cycle[:-1], cycle[:-1], cycle]), cutoff)


def fit(reference_mm, measured):
    """Return the pose that moves reference points (m, 3) mm nearest to measured points (m, 3) m."""
    reference, measured = np.array(list(reference_mm)) / 1e3, np.array(measured)
    centre, mean = reference.mean(axis=0), measured.mean(axis=0)
    turn, _ = Rotation.align_vectors(measured - mean, reference - centre)
    return pose(turn.as_matrix(), mean - turn.apply(centre))
