"""A knee at one instant, at the pose of q or near it: input of a search for equilibrium.

The shank moves as q, v and a say, whatever the knee coordinates of the search. The wrench that the
knee must exert on it is therefore computed once.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from tkamb.errors import ComputationError
from tkamb.geometry.frames import SIDES, Array, cross, knee_pose, knee_twist
from tkamb.knee.canonical import canonical_state
from tkamb.knee.chain import Chain, ChainMotion
from tkamb.knee.contact_points import CondylePoint
from tkamb.knee.equations import KneeGeometry
from tkamb.knee.load import PointForces

if TYPE_CHECKING:
    from tkamb.contact.probe import CondyleWrench
    from tkamb.knee.extensor import ExtensorLines
    from tkamb.knee.ligaments import Ligament
    from tkamb.knee.patella import PatellaState


@dataclass(frozen=True, eq=False)
class PatellaAt:
    """Finds the patella with the femur at a pose.

    Args:
        lines: the extensor mechanism.
        pose: (4, 4) of the femur in the insert frame, by q.
        coordinates: (3,) of the patella by q; None where the model has none.
        solved: whether it is solved again at other poses; if not, it stays fixed to the femur.
    """

    lines: "ExtensorLines"
    pose: Array
    coordinates: Array | None
    solved: bool

    def patella(self, k: int, pose: Array, guess: "PatellaState | None" = None) -> "PatellaState":
        """Return the patella with the femur at a pose (4, 4); `k` has no meaning."""
        if self.coordinates is None:
            return self.lines.solved(pose, guess)
        if not self.solved or np.array_equal(pose, self.pose):
            return self.lines.given(pose, self.coordinates)
        return self.lines.solved(pose, guess, self.coordinates)


@dataclass(frozen=True, eq=False)
class Instant:
    """A knee at one instant; has what `tkamb.knee.equilibrium.released.ReleasedKnee` asks of a
    body.

    Args:
        chain: the canonical chain.
        motion: how it moves.
        shank: (6,) wrench that the knee must exert on the shank, insert frame.
        thigh: (6,) external wrench on the thigh, insert frame.
        on_patella: (6,) external wrench on the patella, insert frame.
        ligaments: the bundles, on links of the chain.
        extensor: the extensor mechanism; None: not modelled.
        friction: Coulomb coefficient.
        two_condyles: whether there are two.
    """

    chain: Chain
    motion: ChainMotion
    shank: Array
    thigh: Array
    on_patella: Array
    ligaments: "tuple[Ligament, ...]"
    extensor: PatellaAt | None
    friction: float
    two_condyles: bool
    muscles: None = None

    @property
    def sides(self) -> set[str]:
        """Names of the condyles that may carry load."""
        return set(SIDES) if self.two_condyles else {"medial"}

    @property
    def coordinates(self) -> Array:
        """Knee coordinates (6,) of q, m and rad."""
        return self.motion.joints[0, :6]

    def geometry(
        self, k: int, coordinates: Array | None = None, patella: "PatellaState | None" = None
    ) -> KneeGeometry:
        """Return the knee without its contact, perhaps at other coordinates than those of q.

        Args:
            k: without meaning here.
            coordinates: (6,) m and rad; None: those of q.
            patella: where the patella is; None: as the extensor mechanism finds it.
        """
        place = self.coordinates if coordinates is None else coordinates
        motion = self.motion
        joints = motion.joints.copy()
        joints[0, :6] = place
        failure = ""
        if self.extensor is not None:
            if patella is None:
                patella = self.extensor.patella(k, knee_pose(place))
            if patella.status.found:
                joints[0, 6:] = patella.coordinates
            else:
                failure = f"patella lost: {patella.status.value}"
        state = canonical_state(
            self.chain, replace(motion, joints=joints), self.shank, self.thigh, self.on_patella
        )
        tensions, pulls = self._pulls(state)
        geometry = KneeGeometry(state, None, pulls, coordinates=place, tensions=tensions)
        if failure:
            return replace(geometry, problems=(failure,))
        if self.extensor is None:
            return geometry
        assert patella is not None
        try:
            extensor, muscle = self.extensor.lines.loads(place[5], state, patella)
        except ComputationError as error:
            return replace(geometry, problems=(str(error),))
        return replace(geometry, extensor=extensor, muscles=(muscle,))

    def _pulls(self, state: object) -> tuple[dict[str, float], tuple[PointForces, ...]]:
        if not self.ligaments:
            return {}, ()
        from tkamb.knee.ligaments import ligament_loads

        links = {end.link for one in self.ligaments for end in (one.proximal, one.distal)}
        poses = {link: state.pose(link) for link in links}  # type: ignore[attr-defined]
        tensions, loads = ligament_loads(self.ligaments, poses)
        names = [bundle.name for bundle in self.ligaments]
        return dict(zip(names, tensions.tolist(), strict=True)), loads

    def sliding(self, k: int, coordinates: Array, point: Array) -> Array:
        """Return the velocity (3,) m/s of the femur's point (3,) relative to the insert's."""
        velocity, spin = knee_twist(coordinates, self.motion.joints[1, :6])
        return np.asarray(velocity + cross(spin, point - coordinates[:3]))

    def resultants(
        self, k: int, coordinates: Array, condyles: "Mapping[str, CondyleWrench]"
    ) -> dict[str, CondylePoint]:
        """Return the resultants of a contact as the contact points of the equations."""
        return {
            side: CondylePoint(
                condyle.point, condyle.normal, self.sliding(k, coordinates, condyle.point), 0.0
            )
            for side, condyle in condyles.items()
        }

    def post_loads(
        self, k: int, coordinates: Array, post: "CondyleWrench | None"
    ) -> Sequence[PointForces]:
        """Return the loads of a cam on a post: none is modelled here."""
        return ()
