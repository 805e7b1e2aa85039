"""Markers of the leg that model and recording share, and the laboratory axes they imply."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import Array, inverse, transform
from tkamb.io.importing.anatomy import Leg, find_leg
from tkamb.io.importing.links import Links
from tkamb.io.opensim.model import OpenSimModel
from tkamb.io.recordings.markers import fit_seen, marker_trajectories, matched_labels, plain_label
from tkamb.io.recordings.tables import Table
from tkamb.units import DEGREE


@dataclass(frozen=True, eq=False)
class ModelSegment:
    """The markers of a segment that the recording contains.

    Args:
        name: "shank", "thigh", "foot" or "pelvis".
        points: label in the recording -> position of the marker, m, (3,), in the link of shank or
            thigh, or in the body of foot or pelvis.
        missing: names of the model's markers that are not visible in the recording.
        joined_to: neighbouring segment: "shank" for the foot, "thigh" for the pelvis, else "".
        joint: ball joint with the neighbouring segment, in the link of that segment, m, (3,).
        centre: the same ball joint in the body of foot or pelvis, m, (3,).
    """

    name: str
    points: dict[str, Array]
    missing: tuple[str, ...]
    joined_to: str = ""
    joint: Array | None = None
    centre: Array | None = None


def model_segments(
    links: Links, recorded: Table, without: Sequence[str] = ()
) -> list[ModelSegment]:
    """Return the segments with at least three markers: shank, thigh, and possibly foot, pelvis."""
    result = seen_segments(links, recorded, without)
    for name in ("shank", "thigh"):
        segment = result[name]
        if len(segment.points) < 3:
            labels = recorded_labels(recorded)
            if prefixes := _clashing_prefixes(labels, segment.missing):
                raise InputError(
                    f"holds the markers of the {name} under several prefixes: "
                    f"{', '.join(prefixes)}",
                    recorded.path,
                    f"say which with --marker-prefix, like --marker-prefix {prefixes[0]}",
                )
            raise InputError(
                f"the model and the recording share {len(segment.points)} markers of the "
                f"{segment.name}, three are needed",
                recorded.path,
                f"the model has {', '.join(segment.missing) or 'no others'}; "
                f"the recording {', '.join(labels[:12])}, …{_equal_line(recorded)}",
            )
    return [segment for segment in result.values() if len(segment.points) >= 3]


def seen_segments(
    links: Links, recorded: Table, without: Sequence[str] = ()
) -> dict[str, ModelSegment]:
    """Return the four segments with the markers visible in any frame."""
    leg = links.leg
    joints = {"foot": (np.zeros(3), leg.ankle_centre), "pelvis": (links.hip, leg.hip_centre)}
    labels, dropped = _seen_labels(recorded, without)
    result = {}
    for name, bodies, joined_to in _bodies(leg):
        joint = centre = None
        if joined_to:
            joint, (body, own_centre) = joints[name]
            centre = transform(leg.in_body(body, bodies[0]), own_centre)
        body_markers = {m.name: m for m in leg.model.markers.values() if m.body in bodies}
        match = matched_labels(body_markers, labels)
        points = {
            match[m]: body_markers[m].location
            if joined_to
            else links.point_in_link(body_markers[m].body, body_markers[m].location)[1]
            for m in body_markers
            if m in match
        }
        left_out = matched_labels(body_markers, dropped)
        missing = tuple(m for m in body_markers if m not in match and m not in left_out)
        result[name] = ModelSegment(name, points, missing, joined_to, joint, centre)
    return result


def placed_markers(links: Links, points: Mapping[str, Mapping[str, Array]]) -> OpenSimModel:
    """Return the leg's model with its markers at given positions.

    Args:
        points: segment ("shank", "thigh", "foot" or "pelvis") -> label -> position, m, (3,), as in
            `ModelSegment`. Labels match as in `matched_labels`; all others keep the model's
            positions.
    """
    leg, placed = links.leg, dict(links.leg.model.markers)
    for name, bodies, joined_to in _bodies(leg):
        own = {m.name: m for m in placed.values() if m.body in bodies}
        given = dict(points.get(name, {}))
        for marker, label in matched_labels(own, given).items():
            place, body = given[label], own[marker].body
            if not joined_to:
                place = transform(inverse(links.body_in_link(body)[1]), place)
            placed[marker] = replace(own[marker], location=place)
    return replace(leg.model, markers=placed)


def _bodies(leg: Leg) -> tuple[tuple[str, tuple[str, ...], str], ...]:
    return (
        ("shank", leg.tibia, ""),
        ("thigh", leg.femur, ""),
        ("foot", (_with_most_markers(leg, leg.foot),), "shank"),
        ("pelvis", (leg.pelvis,), "thigh"),
    )


def _seen_labels(recorded: Table, without: Sequence[str]) -> tuple[list[str], list[str]]:
    labels = recorded_labels(recorded)
    dropped = matched_labels(without, labels)
    if unknown := [name for name in without if name not in dropped]:
        raise InputError(
            f"has no marker '{unknown[0]}' to leave out",
            recorded.path,
            f"it has {', '.join(labels[:12])}, …",
        )
    left_out = list(dropped.values())
    visible = [name for name in labels if np.isfinite(recorded.columns[f"{name}_x"]).any()]
    return [name for name in visible if name not in left_out], left_out


def segments_of(recorded: Table, segments: list[ModelSegment]) -> list[ModelSegment]:
    """Return the segments with another recording's labels, without markers that it lacks."""
    labels = recorded_labels(recorded)
    result = []
    for segment in segments:
        match = matched_labels(segment.points, labels)
        points = {match[name]: p for name, p in segment.points.items() if name in match}
        result.append(replace(segment, points=points))
    return result


def _equal_line(recorded: Table) -> str:
    names = list(dict.fromkeys(column[:-2] for column in recorded.equal))
    listed = ", ".join(names)
    return f"; labels that occur twice are ignored ({listed}): rename one of each" if names else ""


def _clashing_prefixes(labels: list[str], needed: Sequence[str]) -> list[str]:
    """Return the prefixes of needed markers whose plain label has several."""
    plain = {plain_label(name) for name in needed}
    result: dict[str, list[str]] = {}
    for label in labels:
        if plain_label(label) in plain:
            result.setdefault(plain_label(label), []).append(label.rpartition(":")[0])
    clashing = [prefix for prefixes in result.values() if len(prefixes) > 1 for prefix in prefixes]
    return list(dict.fromkeys(clashing))


def with_prefix(recorded: Table, prefix: str) -> Table:
    """Return the table with only the markers that have a prefix, like "JW" in "JW:RHeel"."""
    wished_prefix = prefix.rstrip(":")
    labels = recorded_labels(recorded)
    prefixes = list(dict.fromkeys(label.rpartition(":")[0] for label in labels))
    if wished_prefix not in prefixes:
        listed = ", ".join(name or "none" for name in prefixes[:8])
        raise InputError(
            f"has no marker with the prefix '{prefix}'", recorded.path, f"its prefixes: {listed}"
        )
    other = {label for label in labels if label.rpartition(":")[0] != wished_prefix}
    columns = {k: v for k, v in recorded.columns.items() if k[:-2] not in other}
    return replace(recorded, columns=columns)


def recorded_labels(recorded: Table) -> list[str]:
    """Return the labels of a table of markers."""
    return [column[:-2] for column in recorded.columns if column.endswith("_x")]


def _with_most_markers(leg: Leg, bodies: tuple[str, ...]) -> str:
    counts = {b: sum(m.body == b for m in leg.model.markers.values()) for b in bodies}
    return max(counts, key=lambda b: counts[b])


@dataclass(frozen=True)
class Facing:
    """Anatomical directions of a recording's axes.

    Args:
        axes: axes of the file that point forward, up and right, like "-x,+z,+y".
        up_deg: angle between the file's upward axis and the segments' mean one, deg; NaN if the
            user stated the axes, like `forward_deg`, in the horizontal plane.
    """

    axes: str
    up_deg: float
    forward_deg: float


def facing(segments: list[ModelSegment], recorded: Table) -> Facing:
    """Return the directions of the recording's axes by thigh, shank and pelvis.

    In each segment y points up and x forward. The mean over frames and segments decides the nearest
    axes of the file.
    """
    upright = [s for s in segments if s.name in ("shank", "thigh", "pelvis")]
    turns = []
    for segment in upright:
        points = marker_trajectories(recorded, list(segment.points), 1.0)
        reference = np.array(list(segment.points.values()))
        scale = recorded.unit_scale(None, "length_unit")
        poses, _ = fit_seen(points * scale, reference, np.ones(len(reference)), segment.name)
        finite = np.isfinite(poses[:, 0, 3])
        if finite.any():
            turns.append(poses[finite][:, :3, :3].mean(axis=0))
    mean = np.mean(turns, axis=0) if turns else np.zeros((3, 3))
    up, up_angle = _nearest_axis(mean[:, 1])
    level = mean[:, 0] * (np.abs(up) < 0.5)
    forward, forward_angle = _nearest_axis(level)
    if up_angle > 40.0 or np.linalg.norm(level) < 0.3 or forward_angle > 50.0:
        raise InputError(
            "the subject does not stand upright and face one way on average",
            recorded.path,
            "give --laboratory-axes, the file's axes that point forward, up and right",
        )
    right = np.cross(forward, up)
    names = ",".join(_axis_name(axis) for axis in (forward, up, right))
    return Facing(names, up_angle, forward_angle)


def _nearest_axis(vector: Array) -> tuple[Array, float]:
    k = int(np.argmax(np.abs(vector)))
    axis = np.zeros(3)
    axis[k] = np.sign(vector[k])
    cosine = abs(vector[k]) / max(float(np.linalg.norm(vector)), 1e-12)
    return axis, float(np.arccos(np.clip(cosine, -1.0, 1.0)) / DEGREE)


def _axis_name(axis: Array) -> str:
    k = int(np.argmax(np.abs(axis)))
    return f"{'+' if axis[k] > 0 else '-'}{'xyz'[k]}"


def feet(leg: Leg, recorded: Table, other: str) -> dict[str, list[str]]:
    """Return side -> labels of the foot's markers, [] for a foot that the model lacks."""
    labels = recorded_labels(recorded)
    result = {leg.side: _foot_labels(leg, labels)}
    try:
        result[other] = _foot_labels(find_leg(leg.model, other), labels)
    except InputError:
        result[other] = []  # a model of one leg
    return result


def _foot_labels(leg: Leg, labels: list[str]) -> list[str]:
    names = [m.name for m in leg.model.markers.values() if m.body in leg.foot]
    return list(matched_labels(names, labels).values())
