"""Lines and arrows of a drawing: ligaments, tendons, muscles, centres of pressure and forces.

The magnitude of a force comes from results.csv, its line of action from the geometry of the frame.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from tkamb.errors import ComputationError
from tkamb.geometry.frames import Array, Mask, transform
from tkamb.geometry.surface import Surface
from tkamb.knee.chain import ChainState
from tkamb.knee.equations import KneeGeometry
from tkamb.knee.load import PointForces
from tkamb.knee.wrapping import TautPath
from tkamb.run.metrics import failed, stretches
from tkamb.run.recording import Recording
from tkamb.show.style import BLACK, FORCE_COLOURS, SIDE_COLOURS
from tkamb.show.view.drawing import (
    SLACK,
    TENDON,
    WRAPPED,
    Arrow,
    Colours,
    Marker,
    Strand,
    activation_colours,
    rgb,
    strain_colours,
)
from tkamb.units import MILLIMETRE

if TYPE_CHECKING:
    from tkamb.knee.found_patella import FoundPatella
    from tkamb.knee.ligaments import Ligament
    from tkamb.run.results import Results

NOTHING = np.full(3, np.nan)


# m: radius of the sphere at a centre of pressure. Chosen by eye.
CONTACT_POINT_RADIUS = 0.6 * MILLIMETRE


def force_arrows(
    results: "Results", geometries: Sequence[KneeGeometry], friction: float
) -> tuple[Arrow, ...]:
    """Return arrows of the modelled forces: ground reaction, hip, extensor mechanism, contact.

    The arrow of a condyle is its contact force on the insert, friction included. The two arrows
    add up to the contact force of results.csv.
    """
    columns = {
        "ground reaction": _vector(results, "ground_reaction_{}_N"),
        "hip": _vector(results, "hip_force_{}_N"),
    }
    result = [
        _arrow(
            "ground reaction",
            geometries,
            centre_of_pressure,
            columns["ground reaction"],
            "on the foot",
        ),
        _arrow("hip", geometries, _hip, columns["hip"], "on the femur, at the hip"),
        *_extensor(results, geometries),
        *_condyles(results, geometries, friction),
    ]
    return tuple(arrow for arrow in result if np.isfinite(arrow.forces).any())


def contact_markers(geometries: Sequence[KneeGeometry]) -> tuple[Marker, ...]:
    """Return balls at the contact points of the condyles and of the patella."""
    result = {
        f"{side} contact point": [_condyle_point(one, side) for one in geometries]
        for side in ("medial", "lateral")
    }
    patella = "patellofemoral contact point"
    result[patella] = [
        one.extensor.contact_point if one.extensor else NOTHING for one in geometries
    ]
    return tuple(
        Marker(
            name,
            "patella" if name == patella else "contact points",
            BLACK,
            np.stack(points),
            CONTACT_POINT_RADIUS,
        )
        for name, points in result.items()
        if np.isfinite(points).any()
    )


def _arrow(
    name: str,
    geometries: Sequence[KneeGeometry],
    point: Callable[[KneeGeometry], Array],
    forces: Array,
    meaning: str,
) -> Arrow:
    points = np.stack([point(one) for one in geometries])
    return Arrow(name, FORCE_COLOURS[name], points, forces, name == "hip", meaning)


def centre_of_pressure(geometry: KneeGeometry) -> Array:
    """Return the point of application (3,) of the ground reaction, m, or NaN without a reaction."""
    return geometry.ground.points[0] if geometry.ground else NOTHING


def _hip(geometry: KneeGeometry) -> Array:
    return geometry.state.point("hip", np.zeros(3))


def _extensor(results: "Results", geometries: Sequence[KneeGeometry]) -> list[Arrow]:
    arrows = []
    for name, column, meaning in (
        ("quadriceps", "quadriceps_N", "on the patella"),
        ("patellar ligament", "patellar_ligament_N", "on the tibia"),
    ):
        ends = [_distal_end(one, name) for one in geometries]
        points = np.stack([point for point, _ in ends])
        forces = results[column][:, None] * np.stack([pull for _, pull in ends])
        arrows.append(Arrow(name, FORCE_COLOURS[name], points, forces, False, meaning))
    normal, across, points = (
        np.stack(rows) for rows in zip(*map(_patella, geometries), strict=True)
    )
    forces = (
        results["patellofemoral_N"][:, None] * normal
        + results["patellofemoral_tangential_N"][:, None] * across
    )
    name = "patellofemoral"
    arrows.append(Arrow(name, FORCE_COLOURS[name], points, -forces, True, "on the femur"))
    return arrows


def _distal_end(geometry: KneeGeometry, name: str) -> tuple[Array, Array]:
    """Return the distal end (3,) of a tendon, m, and its force (3,) there per N of tension."""
    if geometry.extensor is None:
        return NOTHING, NOTHING
    released = geometry.extensor.released
    if released is not None:
        assert released.heads is not None
        on_tibia = next(load for load in released.lines if load.link == "tibia")
        return _resultant(released.heads if name == "quadriceps" else on_tibia)
    (muscle,) = geometry.muscles
    loads = muscle.loads if name == "quadriceps" else geometry.extensor.patellar_ligament
    end: PointForces = loads[1]
    return end.points[0], end.forces[0]


def _resultant(load: PointForces) -> tuple[Array, Array]:
    """Return the mean point (3,) of parallel pulls, m, and the direction (3,) of their sum."""
    sizes, total = np.linalg.norm(load.forces, axis=1), load.forces.sum(axis=0)
    return np.average(load.points, axis=0, weights=sizes), total / np.linalg.norm(total)


def _patella(geometry: KneeGeometry) -> tuple[Array, Array, Array]:
    extensor = geometry.extensor
    if extensor is None:
        return NOTHING, NOTHING, NOTHING
    tangent = np.cross(geometry.state.pose("femur")[:3, 2], extensor.contact_normal)
    return extensor.contact_normal, tangent, extensor.contact_point


def _condyles(
    results: "Results", geometries: Sequence[KneeGeometry], friction: float
) -> list[Arrow]:
    if not any(one.condyles for one in geometries):
        forces = np.stack(
            [
                results["force_ap_N"],
                -results["force_si_N"],
                results["force_ml_N"],
            ],
            axis=1,
        )
        points = np.stack([one.state.pose("femur")[:3, 3] for one in geometries])
        return [Arrow("knee", FORCE_COLOURS["knee"], points, forces, True, "on the tibia")]
    arrows = []
    for side in ("medial", "lateral"):
        points = np.stack([_condyle_point(one, side) for one in geometries])
        directions = np.stack(
            [
                one.condyles[side].direction(friction) if side in one.condyles else NOTHING
                for one in geometries
            ]
        )
        forces = -results[f"{side}_force_equilibrium_N"][:, None] * directions
        name = f"{side} condyle"
        arrows.append(Arrow(name, FORCE_COLOURS[name], points, forces, True, "on the insert"))
    return arrows


def _condyle_point(geometry: KneeGeometry, side: str) -> Array:
    return geometry.condyles[side].point if side in geometry.condyles else NOTHING


def _vector(results: "Results", pattern: str) -> Array:
    return np.stack([results[pattern.format(axis)] for axis in ("ap", "si", "ml")], axis=1)


BUNDLE, TENDON_RADIUS, PATH = 1.0 * MILLIMETRE, 1.5 * MILLIMETRE, 0.35 * MILLIMETRE
"""m: radii of ligament bundles, tendons and paths of centres of pressure. The radius of a bundle is
halved if there are more than `many_bundles` bundles."""


# m: radius of a muscle's tube. Chosen by eye.
MUSCLE_RADIUS = 2.0 * MILLIMETRE
# N: a tendon or muscle with a smaller force is grey. This force is negligible.
SLACK_FORCE = 1.0
# 1: smallest upper end of the colour scale of activations. Small activations then
# look small.
LEAST_ACTIVATION = 0.1
# Number of ligament bundles above which their radius is halved. Thick bundles would
# cover each other.
MANY_BUNDLES = 20


def ligament_strands(
    recording: Recording, states: Sequence[ChainState], results: "Results"
) -> tuple[tuple[Strand, ...], float]:
    """Return the bundles, coloured by strain, and the upper end of the colour scale.

    The bundles of a failed frame are grey and do not affect the scale.
    """
    bundles = recording.ligaments
    if not bundles:
        return (), 0.0
    links = {link for one in bundles for link in one.links}
    poses = {link: np.stack([state.pose(link) for state in states]) for link in links}
    failures = failed(results)
    strains = [np.where(failures, np.nan, one.strain(one.length(poses))) for one in bundles]
    limit = float(np.max(strains, initial=0.01, where=np.isfinite(strains)))
    radius = BUNDLE * (0.5 if len(bundles) > MANY_BUNDLES else 1.0)
    strands = []
    for bundle, strain in zip(bundles, strains, strict=True):
        points = bundle.points(poses)
        colours = np.repeat(strain_colours(strain, limit)[:, None], points.shape[1], axis=1)
        strands.append(Strand(bundle.name, "ligaments", points, colours, radius))
    return tuple(strands), limit


def extensor_strands(
    recording: Recording, geometries: Sequence[KneeGeometry], results: "Results"
) -> tuple[Strand, ...]:
    """Return muscle and patellar ligament. Their parts on the bone have another colour.

    A strand with less than `slack_force` is grey. A released patella has its heads and ligaments.
    """
    extensor, states = recording.extensor, [one.state for one in geometries]
    if extensor is None:
        return ()
    if recording.knee.patella is not None:
        method = recording.knee.patella
        loads = [one.extensor.released if one.extensor else None for one in geometries]
        return released_strands(
            [head.name for head in method.heads],
            method.carried,
            [one.paths if one else {} for one in loads],
            [one.found if one else None for one in loads],
        )
    paths: list[tuple[TautPath | None, ...]] = []
    for state in states:
        try:
            paths.append(extensor.lines.paths(state))
        except ComputationError:
            paths.append((None, None))
    muscle, ligament = (list(result) for result in zip(*paths, strict=True))
    name = extensor.lines.muscle.name.replace("_", " ")
    slack = [results[f"{one}_N"] < SLACK_FORCE for one in ("quadriceps", "patellar_ligament")]
    return (
        _tendon(name, muscle, slack[0]),
        _tendon("patellar ligament", ligament, slack[1]),
    )


def released_strands(
    heads: Sequence[str],
    bundles: "Sequence[Ligament]",
    paths: Sequence[Mapping[str, TautPath]],
    equilibria: "Sequence[FoundPatella | None]",
) -> tuple[Strand, ...]:
    """Return heads and ligaments of a released patella; hidden where it was not found.

    Args:
        heads: names of the heads.
        bundles: ligaments with an end on the patella.
        paths: for each frame, head -> its path; empty: not found.
        equilibria: for each frame the patella; None: not found.
    """
    result = []
    for head in heads:
        lines = [one.get(head) for one in paths]
        result.append(_tendon(head.replace("_", " "), lines, np.zeros(len(lines), bool)))
    hidden = dict.fromkeys(("femur", "tibia", "patella"), np.full((4, 4), np.nan))
    poses = {
        link: np.stack([each.poses[link] if each else hidden[link] for each in equilibria])
        for link in hidden
    }
    for bundle in bundles:
        points = bundle.points(poses)
        pulls = np.array([each.tensions[bundle.name] if each else 0.0 for each in equilibria])
        colours = np.broadcast_to(rgb(TENDON), points.shape).copy()
        colours[pulls < SLACK_FORCE] = rgb(SLACK)
        name = bundle.name.replace("_", " ")
        result.append(Strand(name, "extensor lines", points, colours, 0.5 * TENDON_RADIUS))
    return tuple(result)


def muscle_strands(geometries: Sequence[KneeGeometry]) -> tuple[tuple[Strand, ...], float]:
    """Return the muscles across the knee, coloured by activation, and the upper end of the scale.

    A strand runs from the last point on shank or foot to the first point on thigh or pelvis. It is
    grey if the muscle's force is below `slack_force`. Frames without a solution have no strands.
    """
    shares = [one.share if one.share and one.share.status == "ok" else None for one in geometries]
    first = next((share for share in shares if share), None)
    if first is None:
        return (), 0.0
    count = len(first.crossing)
    ends = np.full((len(shares), count, 2, 3), np.nan)
    activation, force = np.zeros((2, len(shares), count))
    for k, (one, share) in enumerate(zip(geometries, shares, strict=True)):
        if share is not None:
            ends[k, :, 0] = transform(one.state.pose("tibia"), share.lines.shank)
            ends[k, :, 1] = transform(one.state.pose("femur"), share.lines.thigh)
            activation[k], force[k] = share.activation[share.crossing], share.force[share.crossing]
    finite = np.isfinite(activation)
    limit = float(np.max(activation, initial=LEAST_ACTIVATION, where=finite))
    colours = activation_colours(np.where(force < SLACK_FORCE, 0.0, activation), limit)
    strands = tuple(
        Strand(
            first.muscles[muscle],
            "muscles",
            ends[:, i],
            np.repeat(colours[:, i, None], 2, axis=1),
            MUSCLE_RADIUS,
        )
        for i, muscle in enumerate(first.crossing)
    )
    return strands, limit


def _tendon(name: str, paths: list[TautPath | None], slack: Mask) -> Strand:
    """Return the strand of a tendon along its taut paths, one path per frame.

    The strand is grey in frames where `slack` (f,) is True. A corner at which the colour changes
    occurs twice.
    """
    lines = [_colour_path(path) for path in paths]
    most = max(len(points) for points, _ in lines)
    points = np.stack([np.pad(p, ((0, most - len(p)), (0, 0)), mode="edge") for p, _ in lines])
    colours = np.stack([np.pad(c, ((0, most - len(c)), (0, 0)), mode="edge") for _, c in lines])
    colours[slack] = rgb(SLACK)
    return Strand(name, "extensor lines", points, colours, TENDON_RADIUS)


def _colour_path(path: TautPath | None) -> tuple[Array, Colours]:
    """Return points and colours of a path. Its part on the bone has another colour."""
    free, wrapped = rgb(TENDON), rgb(WRAPPED)
    if path is None or not np.isfinite(path.points).all():
        return np.full((2, 3), np.nan), np.stack([free, free])
    corners = path.points[1:-1]
    if len(corners) < 2:
        return path.points, np.repeat(free[None], len(path.points), axis=0)
    points = np.concatenate([path.points[:2], corners, path.points[-2:]])
    colours = np.repeat(wrapped[None], len(points), axis=0)
    colours[[0, 1, -2, -1]] = free
    return points, colours


def centres_of_pressure(results: "Results", insert: Surface) -> dict[str, Array]:
    """Return side -> centre of pressure (f, 3) on the undeformed insert, m; NaN if outside."""
    rays, top = insert.rays, float(insert.bounds[1, 1]) + MILLIMETRE
    result = {}
    for side in SIDE_COLOURS:
        x, z = (results[f"{side}_cop_{axis}_mm"] * MILLIMETRE for axis in ("ap", "ml"))
        points = np.column_stack([x, np.full(len(x), top), z])
        finite = np.isfinite(points).all(axis=1)
        points[~finite] = np.nan
        down, _ = rays.first(points[finite], np.array([0.0, -1.0, 0.0]))
        points[finite, 1] -= np.where(np.isfinite(down), down, np.nan)
        result[side] = points
    return result


def path_strands(centres: dict[str, Array]) -> tuple[Strand, ...]:
    """Return the path of each centre of pressure, interrupted where it is missing or jumps."""
    strands = []
    for side, points in centres.items():
        for number, stretch in enumerate(stretches(points)):
            part = points[stretch] + np.array([0.0, 2.0 * PATH, 0.0])
            colours = np.repeat(rgb(SIDE_COLOURS[side])[None], len(part), axis=0)
            name = f"{side} path {number}"
            strands.append(Strand(name, "load paths", part[None], colours[None], PATH))
    return tuple(strands)


def centre_markers(centres: dict[str, Array]) -> tuple[Marker, ...]:
    """Return a ball at each centre of pressure."""
    return tuple(
        Marker(
            f"{side} centre of pressure",
            "load paths",
            SIDE_COLOURS[side],
            points,
            0.9 * MILLIMETRE,
        )
        for side, points in centres.items()
    )
