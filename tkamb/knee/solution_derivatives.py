"""Derivatives of a press and of an equilibrium, by the implicit function theorem.

A solution x of r(x, p) = 0 depends on a parameter p by

    dx/dp = -(dr/dx)^-1 dr/dp.

For a press, x is the height y of the femur, and r the difference of load and reaction; for an
equilibrium, x are the released coordinates, and r the forces on them. The contact is not solved
again: its exact tangent at the converged state gives its change. A plane patella and the lines of
its mechanism are solved again at displaced poses, each from its neighbour. For a released patella
the theorem holds, too: its stiffness in equilibrium gives its change.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from tkamb.errors import InputError
from tkamb.geometry.frames import SIDES, Array, displaced, knee_axes, knee_pose
from tkamb.knee.contact import DifferenceSettings

if TYPE_CHECKING:
    from tkamb.contact.model import ProbedContact
    from tkamb.contact.pair import ContactPair
    from tkamb.knee.instant import Instant
    from tkamb.knee.ligaments import Ligament
    from tkamb.knee.patella_frame import PatellaMethod
    from tkamb.knee.released import KneeEquilibrium, ReleasedKnee
    from tkamb.knee.released_forces import JointEquilibrium

PRESS_ROWS = ("medial_force", "lateral_force", "approach", "height")
"""Rows of `PressDerivatives`."""
TOUCH_DIFFERENCE = DifferenceSettings(step=1e-9)
"""Steps of the central differences of the height of first touch, which is exact for triangles."""
EQUILIBRIUM_DIFFERENCE = DifferenceSettings(step=1e-6)
"""Steps of the central differences of patella and lines in an equilibrium."""


@dataclass(frozen=True, eq=False)
class PressDerivatives:
    """Derivatives of a press: the rows are `PRESS_ROWS`, N and m.

    Args:
        by_load: derivative by the load, (4,), 1 and m/N.
        by_pose: derivative by a displacement of the femur at the pressed pose, (4, 6): the
            translation (m) of its point at the insert's origin, then the rotation (rad), in the
            insert frame. The press then changes the height; the translation along y has no effect.
    """

    by_load: Array
    by_pose: Array


def exact_tangent(contact: "ProbedContact", name: str) -> None:
    """Raise an InputError, which names the model, unless a contact has the exact tangent."""
    if not (contact.known and contact.tangent and contact.exact):
        raise InputError(
            f"contact model '{name}' has no exact tangent",
            "derivatives",
            "take the foundation or a lattice",
        )


def press_derivatives(
    pair: "ContactPair", pose: Array, contact: "ProbedContact"
) -> PressDerivatives:
    """Return the derivatives of a press.

    `pose` (4, 4) and `contact`, with its exact tangent, are those after the press.
    """
    slopes = condyle_slopes(contact)
    # The reaction is the force on the insert along -y.
    reaction = -sum(
        (one.stiffness[1] for one in contact.loads if one.stiffness is not None), np.zeros(6)
    )
    by_height = float(reaction[1])
    height_by_load = 1.0 / by_height if by_height else np.nan
    height_by_pose = -reaction * height_by_load
    # The height of the femoral origin also changes by the displacement itself.
    origin = np.zeros(6)
    origin[1], origin[3], origin[5] = 1.0, -pose[2, 3], pose[0, 3]
    by_load = np.zeros(len(PRESS_ROWS))
    by_pose = np.zeros((len(PRESS_ROWS), 6))
    by_load[:2], by_load[2], by_load[3] = (
        slopes[:, 1] * height_by_load,
        -height_by_load,
        height_by_load,
    )
    by_pose[:2] = slopes + np.outer(slopes[:, 1], height_by_pose)
    by_pose[3] = origin + height_by_pose
    by_pose[2] = _touch_slope(pair, pose) - by_pose[3]
    # The press determines the height, whatever it was before.
    by_pose[:, 1] = 0.0
    return PressDerivatives(by_load, by_pose)


def condyle_slopes(contact: "ProbedContact") -> Array:
    """Return the derivative (2, 6) of the condyles' forces by a displacement."""
    slopes = np.zeros((2, 6))
    for k, side in enumerate(SIDES):
        if side in contact.condyles:
            slopes[k] = contact.condyles[side].force_slope
    return slopes


def _touch_slope(pair: "ContactPair", pose: Array) -> Array:
    """Return the derivative (6,) of the femoral origin's height at first touch."""
    slope = np.zeros(6)
    for k in (0, 2, 3, 4, 5):
        size = TOUCH_DIFFERENCE.step / (TOUCH_DIFFERENCE.arm if k > 2 else 1.0)
        heights = []
        for sign in (1.0, -1.0):
            moved = displaced(pose, sign * size * np.eye(6)[k])
            moved[1, 3] = 0.0
            touch = pair.first_touch.either(moved)
            heights.append(np.nan if touch is None else -touch.travel)
        slope[k] = (heights[0] - heights[1]) / (2.0 * size)
    return slope


@dataclass(frozen=True, eq=False)
class EquilibriumDerivatives:
    """Derivatives of an equilibrium: eight rows. Six are `Equilibrium.coordinates` (m and rad),
    then the forces (N) of medial and lateral condyle.

    Args:
        by_load: by a wrench on the tibia about the insert's origin, (8, 6), N and N·m, in
            addition to `external`, in the insert frame.
        by_coordinate: by the knee coordinates that are not released, (8, 6), m and rad. The
            columns of released coordinates are zero.
        by_slack_length: by the slack length of each ligament of the knee, (8, m), per m.
        by_stiffness: by the stiffness of each ligament of the knee, (8, m), per unit of its law.
    """

    by_load: Array
    by_coordinate: Array
    by_slack_length: Array
    by_stiffness: Array


class ImplicitEquilibrium:
    """The equations of an equilibrium near its solution, with a linear contact.

    With a released patella the tension Q of the quadriceps is one more unknown, and the moment that
    would have to hold flexion one more equation. The patella's wrench on the tibia is linear in the
    displacement and in Q. Its six coordinates have been eliminated (`PulledTibiaSlopes`).

    Args:
        search: the search that found the equilibrium.
        instant: its instant.
        knee: its result, with the exact tangent of the contact.
        points: side -> point where an unloaded condyle is nearest to the insert.
        ligaments: ligaments of the derivatives, with those of a released patella.
    """

    def __init__(
        self,
        search: "ReleasedKnee",
        instant: "Instant",
        knee: "KneeEquilibrium",
        points: dict[str, Array],
        ligaments: "Sequence[Ligament]",
    ) -> None:
        self._search, self._instant, self._knee, self._points = search, instant, knee, points
        self._ligaments = ligaments
        self._pull = _patella_pull(instant, knee)
        self._slack = False
        if self._pull is not None:
            # The released patella replaces the mechanism of the plane patella.
            self._instant = replace(instant, extensor=None, patella=None)
        else:
            here = [
                np.abs(self._forces(knee.coordinates, slack=slack)).max() for slack in (False, True)
            ]
            # The search does not store whether the extensor mechanism was slack: residuals tell.
            self._slack = bool(here[1] < here[0])

    def derivatives(self) -> EquilibriumDerivatives:
        """Return the derivatives."""
        knee, rows = self._knee, list(self._search.released)
        settings = EQUILIBRIUM_DIFFERENCE
        sizes = np.full(6, settings.step)
        sizes[3:] /= settings.arm
        by_coordinate = self._slopes(
            [
                (knee.coordinates + move, knee.coordinates - move, size)
                for move, size in zip(np.diag(sizes), sizes, strict=True)
            ]
        )
        gain, unknowns = self._gain(), by_coordinate[:, rows]
        if self._pull is not None:
            unknowns = np.column_stack([unknowns, gain @ self._pull.by_tension()])
        # The implicit function theorem: the unknowns restore zero forces.
        inverse = np.linalg.inv(unknowns)[: len(rows)]
        held = [k for k in range(6) if k not in rows]
        held_columns = np.zeros((8, 6))
        held_columns[:, held] = self._rows(-inverse @ by_coordinate[:, held], np.eye(6)[:, held])
        return EquilibriumDerivatives(
            self._rows(-inverse @ gain),
            held_columns,
            self._rows(-inverse @ self._by_ligament("slack_length", gain)),
            self._rows(-inverse @ self._by_ligament("stiffness", gain)),
        )

    def _rows(self, released: Array, held: Array | None = None) -> Array:
        """Return (8, m) for changes of the released coordinates (n, m)."""
        knee = self._knee
        coordinates = np.zeros((6, released.shape[1])) if held is None else held.copy()
        coordinates[list(self._search.released)] += released
        twists = knee_axes(knee.coordinates).T @ coordinates
        return np.vstack([coordinates, condyle_slopes(knee.contact) @ twists])

    def _slopes(self, ends: list[tuple[Array, Array, float]]) -> Array:
        """Return the slopes (n, m) of the forces between pairs of coordinates."""
        columns = [
            (self._forces(ahead) - self._forces(behind)) / (2.0 * size)
            for ahead, behind, size in ends
        ]
        return np.array(columns).T

    def _by_ligament(self, name: Literal["slack_length", "stiffness"], gain: Array) -> Array:
        """Return the slopes (n, m) of the forces by a parameter of each ligament.

        Args:
            gain: result of `_gain`.
        """
        columns, crossing = [], {bundle.name for bundle in self._instant.ligaments}
        for bundle in self._ligaments:
            value = getattr(bundle if name == "slack_length" else bundle.law, name)
            size, ends = 1e-6 * value, []
            for sign in (1.0, -1.0):
                if name == "slack_length":
                    ends.append(replace(bundle, slack_length=value + sign * size))
                else:
                    law = bundle.law.stiffened((value + sign * size) / value)
                    ends.append(replace(bundle, law=law))
            if bundle.name in crossing:
                ahead, behind = (self._forces(self._knee.coordinates, end) for end in ends)
                columns.append((ahead - behind) / (2.0 * size))
            elif self._pull is not None:
                columns.append(gain @ self._pull.between(*ends) / (2.0 * size))
            else:
                columns.append(np.zeros(len(gain)))
        return np.array(columns).reshape(len(columns), len(gain)).T

    def _gain(self) -> Array:
        """Return the slopes (n, 6) of the forces by a wrench on the tibia."""
        coordinates = self._knee.coordinates
        joint, _ = self._joint(coordinates, self._slack, self._instant)
        gain = joint.contact_gain(coordinates)
        if self._pull is None:
            return np.asarray(gain)
        return np.vstack([gain, joint.reaction_gain(coordinates)[-1]])

    def _forces(
        self, coordinates: Array, changed: "Ligament | None" = None, slack: bool | None = None
    ) -> Array:
        """Return the forces (n,) on the released coordinates at displaced coordinates (6,).

        With a released patella the moment that holds flexion is the last of them.

        Args:
            coordinates: knee coordinates, (6,).
            changed: ligament that replaces that of its name.
            slack: whether the extensor mechanism carries no load; None: as in the equilibrium.
        """
        instant, slack = self._instant, self._slack if slack is None else slack
        if changed is not None:
            others = (changed if one.name == changed.name else one for one in instant.ligaments)
            instant = replace(instant, ligaments=tuple(others))
        joint, contact = self._joint(coordinates, slack, instant)
        forces = self._search.forces(instant, joint, coordinates, contact)
        wrench = forces.wrench_at(coordinates, contact)
        if self._pull is None:
            return joint.residual(coordinates, wrench)
        wrench = wrench + self._pull.wrench_after(self._displacement(coordinates))
        moment = joint.reactions(coordinates, wrench)[-1]
        return np.append(joint.residual(coordinates, wrench), moment)

    def _joint(
        self, coordinates: Array, slack: bool, instant: "Instant"
    ) -> "tuple[JointEquilibrium, ProbedContact]":
        knee, patella = self._knee, None
        contact = moved_contact(knee.contact, self._displacement(coordinates))
        if instant.extensor is not None:
            patella = instant.extensor.patella(knee_pose(coordinates), knee.patella)
        geometry = instant.geometry(coordinates, patella)
        return self._search.joint_at(instant, geometry, contact, self._points, slack), contact

    def _displacement(self, coordinates: Array) -> Array:
        """Return the displacement (6,) of the femur to near coordinates (6,)."""
        at = self._knee.coordinates
        return np.asarray(knee_axes(at).T @ (coordinates - at))


class _PatellaPull:
    """The wrench of a released patella on the tibia near an equilibrium of the knee.

    Args:
        method: how the patella is found.
        poses: link -> pose (4, 4) of femur and tibia in the insert frame.
        tension: tension of the quadriceps, N.
        coordinates: coordinates of the patella, (6,).
    """

    def __init__(
        self, method: "PatellaMethod", poses: dict[str, Array], tension: float, coordinates: Array
    ) -> None:
        from tkamb.knee.patella_equilibrium import PulledTibiaSlopes

        self._method, self._poses, self._tension = method, poses, tension
        self._slopes = PulledTibiaSlopes.of(self._body(), coordinates, method.released)
        self._by_displacement = self._slopes.by_displacement()

    def _body(self, changed: "Ligament | None" = None, tension: float | None = None) -> Any:
        """Return the forces on the patella with another ligament, or another tension, N."""
        method = self._method
        if changed is not None:
            lines = (changed if one.name == changed.name else one for one in method.lines)
            method = replace(method, lines=tuple(lines))
        tensions = method.head_tensions(self._tension if tension is None else tension)
        return method.body_of_heads(self._poses, tensions)

    def wrench_after(self, displacement: Array) -> Array:
        """Return the wrench (6,) after a small displacement (6,) of the femur."""
        return np.asarray(self._slopes.wrench + self._by_displacement @ displacement)

    def by_tension(self) -> Array:
        """Return the derivative (6,) of the wrench by the tension; heads pull in proportion."""
        ends = (self._body(tension=factor * self._tension) for factor in (1.5, 0.5))
        return self._slopes.between(*ends) / self._tension

    def between(self, ahead: "Ligament", behind: "Ligament") -> Array:
        """Return the change (6,) of the wrench from one ligament to another of its name."""
        return self._slopes.between(self._body(ahead), self._body(behind))


def _patella_pull(instant: "Instant", knee: "KneeEquilibrium") -> _PatellaPull | None:
    """Return the pull of a released patella in an equilibrium; None: no released patella pulls."""
    extensor = knee.geometry.extensor
    if instant.patella is None or extensor is None or extensor.released is None:
        return None
    state, released = knee.geometry.state, extensor.released
    poses = {link: state.pose(link) for link in ("femur", "tibia")}
    return _PatellaPull(instant.patella, poses, released.tension, released.coordinates)


def moved_contact(contact: "ProbedContact", displacement: Array) -> "ProbedContact":
    """Return a contact after a small displacement (6,) of the femur, by its tangent."""

    def moved(load: Any) -> Any:
        centre = load.centre
        if load.centre_slope is not None:
            centre = centre + load.centre_slope @ displacement
        return replace(load, wrench=load.wrench + load.stiffness @ displacement, centre=centre)

    condyles = {side: moved(load) for side, load in contact.condyles.items()}
    return replace(
        contact, condyles=condyles, post=None if contact.post is None else moved(contact.post)
    )
