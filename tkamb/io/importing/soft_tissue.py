"""Import of an OpenSim model's muscles and ligaments, and reasons for those left out."""

from dataclasses import dataclass

import numpy as np

from tkamb.geometry.frames import Array, inverse, transform
from tkamb.io.importing.links import Links, body_link
from tkamb.io.opensim.model import OpenSimLigament, Path, PathPoint
from tkamb.knee.wrap_object import WrapObject

# Strain at the end of the toe region of the law "quadratic-toe": twice the 0.03 of Blankevoort
# (1991).
TOE_STRAIN = 0.06


@dataclass(frozen=True, eq=False)
class End:
    """An attachment: name of a link of the URDF, and a point in it, m, shape (3,)."""

    link: str
    point: Array


@dataclass(frozen=True, eq=False)
class Bundle:
    """A ligament strand with the law "quadratic-toe", and the surfaces on links that it wraps."""

    name: str
    proximal: End
    distal: End
    stiffness_N: float
    slack_length_m: float
    wraps: tuple[WrapObject, ...] = ()


@dataclass(frozen=True, eq=False)
class SoftTissue:
    """The imported muscles and ligaments.

    Args:
        quadriceps: origin and insertion; None without a patella or a vastus intermedius.
        patellar_ligament: ends on patella and tibia; None without a patellar ligament.
        ligament_length: length of the patellar ligament, m; NaN without a patellar ligament.
        remarks: lines for the report on imported and omitted tissue, with reasons.
    """

    quadriceps: tuple[End, End] | None
    patellar_ligament: tuple[End, End] | None
    ligament_length: float
    bundles: tuple[Bundle, ...]
    remarks: tuple[str, ...]


def soft_tissue(links: Links) -> SoftTissue:
    """Return the muscles and ligaments of a leg that the scene can describe."""
    text: list[str] = []
    quadriceps = _quadriceps(links, text)
    ligament, length = _patellar_ligament(links, text)
    bundles = _bundles(links, text)
    _name_muscles(links, text)
    return SoftTissue(quadriceps, ligament, length, bundles, tuple(text))


def _end(point: PathPoint) -> End:
    return End(body_link(point.body), point.location)


def _fixed(path: Path, bodies: tuple[str, ...]) -> list[PathPoint]:
    return [p for p in path.points if type(p) is PathPoint and p.body in bodies]


def _quadriceps(links: Links, remarks: list[str]) -> tuple[End, End] | None:
    leg = links.leg
    if leg.patella is None:
        remarks.append("no patella in the model: no quadriceps")
        return None
    for muscle in leg.model.muscles.values():
        femur, patella = _fixed(muscle.path, leg.femur), _fixed(muscle.path, (leg.patella,))
        plain = muscle.name.lower().replace("_", "")
        if "vasint" in plain and "real" not in plain and femur and patella:
            remarks.append(
                f"quadriceps: one line along {muscle.name}, from its last point on the femur to "
                "its first on the patella"
            )
            return _end(femur[-1]), _end(patella[0])
    remarks.append("no vastus intermedius from femur to patella: no quadriceps")
    remarks += [part.reason for part in leg.model.unread if "vasint" in part.name.lower()]
    return None


def _patellar_ligament(links: Links, remarks: list[str]) -> tuple[tuple[End, End] | None, float]:
    leg = links.leg
    if leg.patella is None:
        return None, np.nan
    for constraint in leg.model.constant_distances:
        points = dict(zip(constraint.bodies, constraint.points, strict=True))
        on_tibia = [body for body in constraint.bodies if body in leg.tibia]
        if leg.patella in points and on_tibia:
            length = constraint.distance
            remarks.append(
                f"patellar ligament: {length * 1e3:.1f} mm long, by the constraint "
                f"'{constraint.name}'; slack lengths of its strands are not used"
            )
            upper = End(body_link(leg.patella), points[leg.patella])
            return (upper, End(body_link(on_tibia[0]), points[on_tibia[0]])), length
    strands = [
        (patella[0], tibia[-1], ligament)
        for ligament in leg.model.ligaments.values()
        if (patella := _fixed(ligament.path, (leg.patella,)))
        and (tibia := _fixed(ligament.path, leg.tibia))
        and not _fixed(ligament.path, leg.femur)
    ]
    if not strands:
        remarks.append("no patellar ligament in the model: no quadriceps")
        return None, np.nan
    length = float(np.mean([ligament.slack_length_m for *_, ligament in strands]))
    remarks.append(
        f"patellar ligament: {length * 1e3:.1f} mm long, mean slack length of {len(strands)} "
        "strands, between their mean ends"
    )
    ends = [
        End(body_link(points[0].body), np.mean([p.location for p in points], axis=0))
        for points in ([s[0] for s in strands], [s[1] for s in strands])
    ]
    return (ends[0], ends[1]), length


def _bundles(links: Links, remarks: list[str]) -> tuple[Bundle, ...]:
    leg = links.leg
    bundles: list[Bundle] = []
    omitted: dict[str, list[str]] = {}
    ignored: dict[str, list[str]] = {}
    for ligament in leg.model.ligaments.values():
        femur, tibia = _fixed(ligament.path, leg.femur), _fixed(ligament.path, leg.tibia)
        if not (femur and tibia):
            continue
        reason = _omission_reason(ligament, len(femur) + len(tibia))
        if reason or ligament.stiffness_N is None:
            omitted.setdefault(reason, []).append(ligament.name)
            continue
        bundles.append(
            Bundle(
                ligament.name,
                _end(femur[0]),
                _end(tibia[-1]),
                ligament.stiffness_N,
                ligament.slack_length_m,
                _wraps(links, ligament, ignored),
            )
        )
    if bundles:
        wrapped = sum(bool(bundle.wraps) for bundle in bundles)
        remarks.append(
            f"{len(bundles)} femorotibial ligament strands imported, {wrapped} of them over "
            "surfaces of the model, the others as straight lines"
        )
    for reason, names in ignored.items():
        remarks.append(f"surfaces left out, {reason}: {some_names(names)}")
    for reason, names in omitted.items():
        remarks.append(f"ligaments left out, {reason}: {some_names(names)}")
    return tuple(bundles)


def _wraps(
    links: Links, ligament: OpenSimLigament, ignored: dict[str, list[str]]
) -> tuple[WrapObject, ...]:
    """Return a strand's surfaces, and add reason -> strand of those left out."""
    from tkamb.knee.taut_strings import inside  # imports numba

    result = []
    for use in ligament.path.wraps:
        wrap = links.leg.model.wrap_objects[use.wrap_object]
        reason = "" if wrap.active else "switched off in the model"
        if wrap.body not in (*links.leg.femur, *links.leg.tibia):
            reason = "which belong neither to femur nor to tibia"
        elif wrap.shape == "torus" or wrap.quadrant is not None:
            reason = "a torus or half of a surface, which the scene does not have"
        for point in ligament.path.points:
            if isinstance(point, PathPoint) and point.body == wrap.body:
                place = transform(inverse(wrap.pose), point.location)
                within = inside(wrap, place[None])[0]
                if wrap.shape == "ellipsoid":
                    within = np.linalg.norm(place / np.array(wrap.dimensions)) < 1.0
                if within:
                    reason = "inside which an end is fixed, so that OpenSim ignores them, too"
        if reason:
            ignored.setdefault(reason, []).append(ligament.name)
        else:
            result.append(wrap.on(body_link(wrap.body), np.eye(4)))
    return tuple(result)


def _omission_reason(ligament: OpenSimLigament, fixed: int) -> str:
    if not ligament.enabled:
        return "switched off in the model"
    if fixed != 2 or len(ligament.path.points) != 2:
        return "which have more than two path points"
    if ligament.stiffness_N is None:
        return f"of class {ligament.kind}, whose law the scene does not have"
    if ligament.transition_strain is None or abs(ligament.transition_strain - TOE_STRAIN) > 1e-6:
        return f"whose toe does not end at a strain of {TOE_STRAIN}"
    return ""


def _name_muscles(links: Links, remarks: list[str]) -> None:
    leg = links.leg
    across = [
        muscle.name
        for muscle in leg.model.muscles.values()
        if {p.body for p in muscle.path.points} & {*leg.tibia, *leg.foot}
        and {p.body for p in muscle.path.points} & {*leg.femur, leg.pelvis}
    ]
    if across:
        remarks.append(
            f"{len(across)} muscles cross the knee and act only with --muscles; without it only "
            f"the quadriceps line acts: {some_names(across)}"
        )


def some_names(names: list[str]) -> str:
    """Return the first eight names, and the number of further names."""
    more = f" and {len(names) - 8} more" if len(names) > 8 else ""
    return ", ".join(names[:8]) + more
