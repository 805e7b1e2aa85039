"""Skin markers by their labels, and rigid fits of bodies to them.

`R.Thigh.Superior`, `RThighSuperior` and `JW:RThighSuperior` are labels of the same marker.
"""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from tkamb.errors import InputError
from tkamb.geometry.frames import Array, pose, transform
from tkamb.io.recordings.recording_tables import TibiaTable
from tkamb.io.recordings.tables import Table
from tkamb.units import MILLIMETRE

# m: largest median residual. Soft tissue causes less; a larger residual is due to a
# wrong marker or unit.
MAX_MEDIAN_RESIDUAL = 0.05


def plain_label(label: str) -> str:
    """Return a label in lower case, without the subject's prefix, blanks and . _ -"""
    name = label.rpartition(":")[2]
    return "".join(c for c in name if c not in "._- ").lower()


def matched_labels(names: Iterable[str], labels: Iterable[str]) -> dict[str, str]:
    """Return name -> label in the recording, for each name with a match.

    A name matches an equal label, or else the only label with the same `plain_label`. There is no
    match if several labels have the same `plain_label` (two subjects).
    """
    labels = list(labels)
    plain: dict[str, list[str]] = {}
    for label in labels:
        plain.setdefault(plain_label(label), []).append(label)
    result = {}
    for name in names:
        candidates = [name] if name in labels else plain.get(plain_label(name), [])
        if len(candidates) == 1:
            result[name] = candidates[0]
    return result


def marker_trajectories(table: Table, names: list[str], metres_per_unit: float) -> Array:
    """Return the markers (n, m, 3), m, in the file's axes; gaps are NaN.

    Labels are matched as in `matched_labels`.
    """
    labels = [column[:-2] for column in table.columns if column.endswith("_x")]
    matched = matched_labels(names, labels)
    for name in names:
        if name not in matched:
            table.column(f"{name}_x")
    columns = [[table.column(f"{matched[name]}_{axis}") for axis in "xyz"] for name in names]
    return np.moveaxis(np.array(columns), 2, 0) * metres_per_unit


def shank_points(source: TibiaTable, recorded: Table) -> tuple[Array, Array]:
    """Return the shank's markers and joint centres, as measured and in the tibia link's frame.

    A joint centre is found by a rigid fit of the neighbouring segment's markers.

    Returns:
        Points (n, m, 3), m, in the file's axes, gaps NaN; reference points (m, 3), m.
    """
    scale = recorded.unit_scale(source.length_unit, "length_unit")
    points = [marker_trajectories(recorded, [name], scale) for name in source.markers_mm]
    reference = list(source.markers_mm.values())
    for joint in source.joint_centre:
        measured = marker_trajectories(recorded, list(joint.markers_mm), scale)
        neighbour = np.array(list(joint.markers_mm.values())) * MILLIMETRE
        poses, residual = fit_rigid(measured, neighbour, joint.name)
        check_fit(residual, f"the markers of joint centre '{joint.name}'", recorded)
        points.append(transform(poses, np.array(joint.centre_mm) * MILLIMETRE)[:, None])
        reference.append(joint.tibia_mm)
    return np.concatenate(points, axis=1), np.array(reference) * MILLIMETRE


def check_fit(residual: Array, what: str, recorded: Table) -> None:
    """Raise an InputError if the median of the residuals (n,), m, is too large."""
    finite = residual[np.isfinite(residual)]
    if len(finite) and np.median(finite) > MAX_MEDIAN_RESIDUAL:
        raise InputError(
            f"{what} have a residual of {np.median(finite) / MILLIMETRE:.0f} mm",
            recorded.path,
            "check names and positions in [tibia], and length_unit",
        )


def fit_rigid(points: Array, reference: Array, name: str = "the tibia") -> tuple[Array, Array]:
    """Return the poses that bring the reference markers closest to the measured ones.

    Least squares over rotations (Kabsch): with H = sum (r - r_mean)(p - p_mean)^T = U S V^T
    the rotation is V diag(1, 1, det(V U^T)) U^T.

    Args:
        points: (n, m, 3) m, measured; frames with a gap give NaN.
        reference: (m, 3) m, the same markers in the body's frame.

    Returns:
        pose_body_in_world (n, 4, 4) and the root mean square distance (n,), m, between
        measured and fitted markers.

    Reference: Kabsch, Acta Cryst A32:922 (1976), doi:10.1107/S0567739476001873.
    """
    if not _spans(reference):
        raise InputError(
            f"markers of {name} fix no orientation: fewer than three, or all on one line",
            "[tibia]",
            "name three or more that span a triangle, or add a [[tibia.joint_centre]]",
        )
    complete = np.isfinite(points.reshape(len(points), -1)).all(axis=1)
    result, residual = np.full((len(points), 4, 4), np.nan), np.full(len(points), np.nan)
    if complete.any():
        result[complete], residual[complete] = _fit(points[complete], reference)
    return result, residual


def fit_seen(points: Array, reference: Array, weights: Array, name: str) -> tuple[Array, Array]:
    """Return the weighted rigid fit of the visible markers, which may have gaps.

    A frame is NaN unless three of them span a triangle.

    Args:
        points: (n, m, 3) m, gaps NaN.
        reference: (m, 3) m.
        weights: (m,) weights of the squared distances.

    Returns:
        pose_body_in_world (n, 4, 4), and root mean square distance (n,) m of visible markers.
    """
    visible = np.isfinite(points).all(axis=2)
    if not _spans(reference[weights > 0]):
        raise InputError(
            f"markers of {name} fix no orientation: fewer than three, or all on one line",
            "[motion.markers]",
            "name three or more that span a triangle",
        )
    w = np.where(visible, weights, 0.0)
    patterns, of_frame = np.unique(w > 0, axis=0, return_inverse=True)
    usable = np.array([_spans(reference[row]) for row in patterns])[of_frame.ravel()]
    total = np.where(usable, w.sum(axis=1), 1.0)[:, None]
    filled = np.nan_to_num(points)
    mean = np.einsum("nm,nmi->ni", w, filled) / total
    centre = w @ reference / total
    h = np.einsum("nm,nmi,nmj->nij", w, reference - centre[:, None], filled - mean[:, None])
    rotation = _nearest_rotation(h)
    poses = pose(rotation, mean - np.einsum("nij,nj->ni", rotation, centre))
    fitted = transform(poses, np.broadcast_to(reference, points.shape))
    square = np.where(visible, np.sum((fitted - filled) ** 2, axis=2), 0.0)
    rms = np.sqrt(square.sum(axis=1) / np.maximum(visible.sum(axis=1), 1))
    poses[~usable], rms[~usable] = np.nan, np.nan
    return poses, rms


def _spans(reference: Array) -> bool:
    centred = reference - reference.mean(axis=0) if len(reference) else reference
    return len(reference) >= 3 and bool(np.linalg.svd(centred, compute_uv=False)[1] >= 1e-3)


def _nearest_rotation(h: Array) -> Array:
    """Return the rotations (n, 3, 3) of Kabsch's covariances (n, 3, 3); see `fit_rigid`."""
    u, _, vt = np.linalg.svd(h)
    v, ut = np.swapaxes(vt, 1, 2), np.swapaxes(u, 1, 2)
    signs = np.ones((len(h), 3))
    signs[:, 2] = np.sign(np.linalg.det(v @ ut))
    return np.asarray((v * signs[:, None, :]) @ ut)


def _fit(points: Array, reference: Array) -> tuple[Array, Array]:
    means, centre = points.mean(axis=1), reference.mean(axis=0)
    h = np.einsum("mi,nmj->nij", reference - centre, points - means[:, None])
    rotation = _nearest_rotation(h)
    poses = pose(rotation, means - rotation @ centre)
    fitted = transform(poses, np.broadcast_to(reference, points.shape))
    residual = np.sqrt(np.mean(np.sum((fitted - points) ** 2, axis=2), axis=1))
    return poses, np.asarray(residual)


def complete_run(
    points: Array, names: list[str], time: Array, start: float, end: float, table: Table
) -> slice:
    """Return the longest range of frames around [start, end] in which no marker is missing.

    Args:
        points: (n, m, 3), gaps NaN.
        time: (n,) s.
        start: start of the interval, s, which lasts to `end`.
    """
    first = int(np.searchsorted(time, start + 1e-9, side="right")) - 1
    last = int(np.searchsorted(time, end - 1e-9, side="left"))
    if first < 0 or last >= len(time):
        raise InputError(
            f"covers {time[0]:.4f} to {time[-1]:.4f} s, but {start:.4f} to {end:.4f} s is needed",
            table.path,
            "choose an interval inside the recording",
        )
    missing: NDArray[np.bool_] = np.asarray(np.isnan(points).any(axis=2))
    gaps: NDArray[np.bool_] = np.asarray(missing.any(axis=1))
    if gaps[first : last + 1].any():
        frame = first + int(np.argmax(gaps[first : last + 1]))
        raise InputError(
            f"shank marker '{names[int(np.argmax(missing[frame]))]}' is missing at "
            f"{time[frame]:.4f} s",
            table.path,
            "leave that marker out, or choose another interval",
        )
    before = np.flatnonzero(gaps[:first])
    after = np.flatnonzero(gaps[last:])
    return slice(
        int(before[-1]) + 1 if len(before) else 0, last + int(after[0]) if len(after) else None
    )
