"""`tkamb.Knee`: a total knee replacement on any Pinocchio model.

    knee = tkamb.Knee(model, side="right", implant=..., ligaments=[...], contact=..., friction=0.05)
    tau = pin.rnea(model, data, q, v, a, knee.external_forces(q, v))

SI units; NumPy arrays and Pinocchio types in and out. No file is read, nothing is printed, and no
call changes the next: what may save time is a `KneeData` that the caller makes and hands over.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from tkamb.errors import ComputationError, InputError, names_near
from tkamb.geometry.frames import (
    KNEE_COORDINATES,
    Array,
    knee_pose,
)
from tkamb.knee.assembled import PATELLAR_LIGAMENT, AssembledKnee, KneeData
from tkamb.knee.canonical import KneePlace, mirrored_spatial, summed
from tkamb.knee.contact_points import NO_CONTACT
from tkamb.knee.equations import KneeGeometry
from tkamb.knee.instant import Instant, PatellaAt, PatellaFinder, SharingMuscles
from tkamb.knee.load import PointForces
from tkamb.knee.loads import KneeLoads, knee_loads

if TYPE_CHECKING:
    from tkamb.contact.model import ProbedContact
    from tkamb.contact.result import ContactResult, Guess, WarmStart
    from tkamb.knee.released import KneeEquilibrium


@dataclass(frozen=True, eq=False)
class Equilibrium:
    """A knee whose released coordinates are in equilibrium.

    Args:
        q: (nq,) configuration of the user's model; the joints of the knee have moved.
        coordinates: (6,) knee coordinates there, those of a right knee, m and rad.
        loads: the knee's loads there.
        contact: the contact there; None where there is no equilibrium.
        residual: N, the largest force (moments over 25 mm) left on a released coordinate.
        stiffness: (n, n) of the released coordinates, scaled alike, N/m.
        problem: why this is no equilibrium, or empty.
        search: all about the search.
    """

    q: Array
    coordinates: Array
    loads: KneeLoads
    contact: "ContactResult | None"
    residual: float
    stiffness: Array
    problem: str
    search: "KneeEquilibrium"


class Knee(AssembledKnee):
    """A total knee replacement on a user's Pinocchio model.

    The knee lies between the frames "femur" and "tibia" of the model, whatever joints are between
    them, above and below. Its parts stand in these frames, found by name or given by `frames`:

    - `femur`, `tibia`: needed; attachment points may lie on any frame that is fixed to them;
    - `femoral`: axes of the femoral component's mesh, fixed to the femur; else `femur`;
    - `insert`: axes of the insert's mesh, fixed to the tibia; else the placement of a joint
      "knee_ap" on the tibia; else `tibia`;
    - `patella`: a body that moves against the femur; else the extensor mechanism finds its place;
    - `hip`: hip centre, fixed to the femur; else the joint that carries the femur.

    What is not given is not modelled, not imported and not computed.

    Args:
        model: any Pinocchio model; it is not changed.
        side: of the body, "right" or "left".
        implant: meshes, see `Implant`.
        ligaments: bundles, with slack lengths.
        extensor: quadriceps, patella and patellar ligament.
        contact: a contact model (`tkamb.contact_model`), its name, or a model with what it has
            prepared for this implant (`Knee.contact` of another knee); None: no contact.
        friction: Coulomb coefficient of the femorotibial contact.
        muscles: lines of given tension between any frames of the model, straight from point to
            point.
        frames: part of the knee -> name of its frame in the model.
        joints: names of the knee's joints, for a check; they are found in the tree.
        cache: whether a lattice keeps its prepared operators on disk for the next time.

    Raises:
        InputError: what is given does not fit together, in one line.
    """

    def external_forces(
        self,
        q: Array,
        v: Array,
        tensions: Mapping[str, float] | float | None = None,
        data: KneeData | None = None,
    ) -> Any:
        """Return what contact, ligaments and muscles do to the bodies at q and v.

        The contact follows from the overlap of the bodies at q, its friction from v. The patella
        has no mass here: it passes the quadriceps' tension on to patellar ligament and femur.

        Args:
            q: (nq,).
            v: (nv,).
            tensions: muscle -> N; a number alone is the quadriceps'. Muscles that are not named
                are slack. With "patellar_ligament" -> N beside the quadriceps, as in
                `KneeLoads.tensions`, the patellofemoral force balances these two tensions.
            data: from `create_data`, to save time.

        Returns:
            `pin.StdVec_Force`, one per joint in its joint's frame: `fext` of `pin.rnea` and
            `pin.aba`.

        Raises:
            InputError: q or v of the wrong size, or an unknown muscle.
            ComputationError: the contact model is out of its range, or there is no place for the
                patella.
        """
        data = self.create_data() if data is None else data
        place = self._kinematics(data, q, v)
        on_insert = np.zeros(6)
        if self.contact is not None:
            contact = self._contact_at(data, place)
            on_insert = self.contact.wrench(contact, self.bridge.twist(data.data))
        if self._crossing is not None:
            on_insert = on_insert + self._crossing.wrench(place.pose)
        pulled = self._tensions(tensions)
        links = summed(self._beside_the_contact(data, place, pulled))
        for link, sign in (("tibia", 1.0), ("femur", -1.0)):
            links[link] = links.get(link, np.zeros(6)) + sign * on_insert
        return self._with_lines(data, pulled, self.bridge.joint_forces(data.data, links))

    def _beside_the_contact(
        self, data: KneeData, place: KneePlace, pulled: Mapping[str, float]
    ) -> list[PointForces]:
        """Return what ligaments off the femorotibial gap and the extensor mechanism do."""
        pulls, patella = self._pulls(pulled), None
        if not self._others and not pulls:
            return []
        if self.extensor_lines is not None:
            patella = self._find_patella(place, data)
        poses, total = self._link_poses(place, patella), list[PointForces]()
        if self._others:
            from tkamb.knee.ligaments import ligament_loads

            total += ligament_loads(self._others, poses)[1]
        if pulls:
            assert patella is not None and self.extensor_lines is not None
            quadriceps = pulled[self._extensor_names[0]]
            total += self.extensor_lines.pull(
                poses, patella, place.coordinates[5], quadriceps, pulled.get(PATELLAR_LIGAMENT)
            )
        return total

    def stiffness(
        self, q: Array, v: Array, data: KneeData | None = None, exact: bool = True
    ) -> Array:
        """Return the derivative (6, 6) of the femorotibial wrench by the relative twist.

        The wrench is that of contact, its friction and ligaments between femur and tibia on the
        insert: force (N), moment about the insert's origin (N·m). The displacement is that of
        the femoral component against the insert: its point at the insert's origin (m), then its
        rotation (rad). Both are in the insert frame; v stays. Positive: pressed in, the femur
        pushes the insert with more force that way.

        Args:
            q: (nq,).
            v: (nv,).
            data: from `create_data`, to save time.
            exact: False: the tangent that the contact model brings, where it brings one, even
                where it is a guide only (the softened lattice's).

        Raises:
            ComputationError: see `external_forces`.
        """
        data = self.create_data() if data is None else data
        place = self._kinematics(data, q, v)
        total = np.zeros((6, 6))
        if self.contact is not None:
            twist = self.bridge.twist(data.data)
            contact = self._contact_at(data, place)
            total += self.contact.stiffness(data.probe, place.pose, contact, twist, exact)
        total += self._ligament_stiffness(place)
        return self._mirrored_matrix(total)

    def damping(self, q: Array, v: Array, data: KneeData | None = None) -> Array:
        """Return the derivative (6, 6) of the femorotibial wrench by the rate of the twist.

        As `stiffness`, by the femur's velocity against the insert (m/s, rad/s): of friction,
        which alone depends on it.
        """
        data = self.create_data() if data is None else data
        place = self._kinematics(data, q, v)
        if self.contact is None:
            return np.zeros((6, 6))
        contact = self._contact_at(data, place)
        return self._mirrored_matrix(self.contact.damping(contact, self.bridge.twist(data.data)))

    def inverse_dynamics(
        self,
        q: Array,
        v: Array,
        a: Array,
        external: Any = None,
        tensions: Mapping[str, float] | None = None,
        contact: "ContactResult | None" = None,
        data: KneeData | None = None,
    ) -> KneeLoads:
        """Return the loads of the knee that a motion asks for.

        The shank's and the patella's equations of motion, for as many unknown loads (see
        docs/equilibrium.md). Ligaments and given muscles are known, contact points are the
        closest points of the undeformed bodies.

        Args:
            q: (nq,).
            v: (nv,).
            a: (nv,).
            external: forces on the joints, each in its joint's frame, as `fext` of `pin.rnea`:
                the ground reaction, and all else that acts on the shank. None: nothing does.
            tensions: muscle of `muscles` -> N. The quadriceps is what is sought.
            contact: its resultants take the place of the closest points.
            data: from `create_data`, to save time.

        Returns:
            The loads; a state without a solution holds NaN and says why in `problems`.

        Raises:
            InputError: an argument of the wrong size, an unknown muscle, or a contact given to a
                knee without a contact model.
        """
        data = self.create_data_for_kinematics() if data is None else data
        instant = self.instant(q, v, a, external, tensions, data)
        geometry, points = instant.geometry(), NO_CONTACT
        if contact is not None:
            from tkamb.contact.model import condyle_wrenches

            wrenches = condyle_wrenches(contact, self._need_contact().pair.split)
            geometry = instant.touching(geometry, instant.coordinates, wrenches, {})
        elif self.contact is not None:
            points = instant.contact_points(self.query, knee_pose(instant.coordinates))
            geometry = replace(geometry, condyles=points.condyles, lifted=points.lifted)
        geometry = replace(geometry, problems=points.problems + geometry.problems)
        return self._solved(instant, geometry, data)

    def press(
        self,
        q: Array,
        load: float,
        guess: "Guess | None" = None,
    ) -> "ContactResult":
        """Return the contact when the femur carries a load, at the rotation, AP and ML of q.

        Args:
            q: (nq,).
            load: N, along the insert's y axis, pressing; not negative.
            guess: an earlier result or warm start, to save time.

        Returns:
            Pressure, area and forces of both condyles, in the insert frame of a right knee: a
            left knee is computed as its mirror image (z to -z).

        Raises:
            InputError: no contact model, or a load that is negative or not finite.
        """
        return self.press_from(q, load, guess)[0]

    def press_from(
        self, q: Array, load: float, start: "Guess | None" = None
    ) -> "tuple[ContactResult, WarmStart]":
        """Return what `press` does, and the warm start of a press near by.

        Args:
            q: (nq,).
            load: N, as of `press`.
            start: the warm start that the last press returned; it saves time.
        """
        contact = self._need_contact()
        if not (np.isfinite(load) and load >= 0):
            raise InputError(f"load {load} N", "press", "give a load of 0 or more")
        place = self._kinematics(self.create_data_for_kinematics(), q)
        return contact.model.press_from(contact.state, float(load), place.pose, start)

    def evaluate(self, q: Array, guess: "Guess | None" = None) -> "ContactResult":
        """Return the contact at q: pressure, area and forces by the overlap of the bodies there.

        As `press`, but for the height, which is that of q.
        """
        contact = self._need_contact()
        place = self._kinematics(self.create_data_for_kinematics(), q)
        return contact.model.evaluate(contact.state, place.pose, guess)

    def equilibrium(
        self,
        q: Array,
        v: Array,
        a: Array,
        external: Any = None,
        released: Sequence[str] = ("ap", "ml", "axial_rotation", "adduction"),
        tensions: Mapping[str, float] | None = None,
        data: KneeData | None = None,
    ) -> Equilibrium:
        """Return the pose at which the released coordinates are in equilibrium, with its loads.

        Flexion stays as in q, and so do the coordinates that are not released; the
        superior-inferior position always follows from the contact. The shank moves as q, v and a
        say, and the search is quasi-static for the released coordinates (docs/equilibrium.md).

        Args:
            q: (nq,), where the search begins.
            v: (nv,).
            a: (nv,).
            external: see `inverse_dynamics`.
            released: of "ap", "ml", "axial_rotation", "adduction" ("si" is understood).
            tensions: see `inverse_dynamics`.
            data: from `create_data`, to save time.

        Raises:
            InputError: an unknown coordinate, no contact model, or a knee of the model with too
                few degrees of freedom to reach the pose.
            ComputationError: the femur does not lie over the insert.
        """
        from tkamb.knee.released import ReleasedKnee

        contact, allowed = self._need_contact(), [n for n in KNEE_COORDINATES if n != "flexion"]
        for name in released:
            if name not in allowed:
                raise InputError(f"no coordinate '{name}'", "released", names_near(name, allowed))
        data = self.create_data() if data is None else data
        instant = self.instant(q, v, a, external, tensions, data)
        probe = data.probe if data.probe is not None else contact.probe()
        search = ReleasedKnee(probe, released)
        points = {} if len(search.released) == 5 else self.nearest_points(instant.coordinates)
        knee = self._rest(search, instant, points)
        result, q_end = None, np.array(q, float)
        geometry = replace(knee.geometry, problems=(knee.problem,))
        if not knee.problem:
            q_end = self.bridge.configuration(q, knee_pose(knee.coordinates))
            pin.forwardKinematics(self.model, data.data, q_end)
            result = contact.model.evaluate(contact.state, knee_pose(knee.coordinates))
            geometry = instant.touching(
                knee.geometry, knee.coordinates, knee.contact.condyles, points
            )
        loads = self._solved(instant, geometry, data)
        return Equilibrium(
            q_end,
            knee.coordinates,
            loads,
            result,
            knee.residual,
            knee.balance.stiffness,
            knee.problem,
            knee,
        )

    def show(self, viewer: Any, q: Array, **options: Any) -> None:
        """Draw the knee at q in a user's `pin.visualize.MeshcatVisualizer`.

        Adds implant, ligaments, lines, force arrows and the pressure map below the viewer's root
        node; see `tkamb.knee.show.show_knee` for the options.
        """
        from tkamb.knee.show import show_knee

        show_knee(self, viewer, q, **options)

    def live(self, q: Array, load: float = 1000.0, folder: Any = None) -> Any:
        """Serve a page on which the knee is pressed and moved by hand; see docs/live.md.

        The load acts along the insert's y axis; ligaments between femur and tibia pull. Nothing
        that is done there changes this object.

        Args:
            q: (nq,), or (f, nq) for the slider "recorded frame".
            load: N, at first.
            folder: for what is kept; None: out/live.

        Returns:
            The server: its address is `url`, and it answers until `close()`.

        Raises:
            InputError: no contact model, or one without a name (`tkamb.contact_model`).
        """
        return import_module("tkamb.show.view.live_window").live_knee(self, q, load, folder)

    def instant(
        self,
        q: Array,
        v: Array,
        a: Array,
        external: Any = None,
        tensions: Mapping[str, float] | None = None,
        data: KneeData | None = None,
        patella: PatellaFinder | None = None,
        muscles: SharingMuscles | None = None,
    ) -> Instant:
        """Return the knee at one instant: what its equations and a search for equilibrium ask.

        Args:
            q: (nq,).
            v: (nv,).
            a: (nv,).
            external: see `inverse_dynamics`.
            tensions: see `inverse_dynamics`; among what is external.
            data: from `create_data`, to save time.
            patella: finds the patella; None: it is where q says, or found where q has none.
            muscles: those of the leg that share the load; None: the quadriceps alone acts.

        Raises:
            InputError: an argument of the wrong size, or an unknown muscle.
        """
        data = self.create_data_for_kinematics() if data is None else data
        q = self._check(q, "q", self.model.nq)
        v, a = self._check(v, "v", self.model.nv), self._check(a, "a", self.model.nv)
        if external is not None and len(external) != self.model.njoints:
            raise InputError(
                f"{len(external)} forces", "external", f"give one per joint, {self.model.njoints}"
            )
        pulled = self._tensions(tensions)
        if self._pulls(pulled):
            raise InputError(
                "the quadriceps is what is sought", "tensions", "give other muscles' alone"
            )
        bridge, pin_data, lines = self.bridge, data.data, self.extensor_lines
        pin.forwardKinematics(self.model, pin_data, q, v, a)
        external = self._with_lines(data, pulled, external)
        motion = bridge.motion(pin_data, lines is not None)
        if lines is not None and patella is None:
            own = None if self._finds_patella else motion.joints[0, 6:]
            assert self.extensor is not None
            patella = PatellaAt(lines, knee_pose(motion.joints[0, :6]), own, self.extensor.solved)
        return Instant(
            self.chain,
            motion,
            bridge.shank_needs(pin_data),
            bridge.external_on(self.anatomy.femur, pin_data, external),
            bridge.external_on(self.anatomy.patella, pin_data, external),
            self.ligaments,
            patella,
            self.friction,
            self.contact is not None and self.contact.pair.split is not None,
            None if external is None else bridge.on_shank(pin_data, external),
            muscles,
        )

    def _contact_at(self, data: KneeData, place: KneePlace) -> "ProbedContact":
        """Return the contact at a place; the last one is remembered in the caller's data."""
        key = place.pose.tobytes()
        if data.seen is None or data.seen[0] != key:
            assert self.contact is not None
            data.seen = key, self.contact.at(data.probe, place.pose)
        return data.seen[1]

    def _ligament_stiffness(self, place: KneePlace) -> Array:
        """Return the derivative (6, 6) of the wrench of the bundles between femur and tibia."""
        if self._crossing is None:
            return np.zeros((6, 6))
        from tkamb.knee.contact import DifferenceSettings, batch_differences

        return batch_differences(self._crossing.wrench, place.pose, DifferenceSettings(step=1e-7))

    def _mirrored_matrix(self, matrix: Array) -> Array:
        if not self.left:
            return matrix
        return mirrored_spatial(mirrored_spatial(matrix).T).T

    def _solved(self, instant: Instant, geometry: KneeGeometry, data: KneeData) -> KneeLoads:
        """Return the loads of a geometry, and what they do to the user's joints."""
        geometry, loads = instant.solved(geometry)
        return knee_loads(geometry, loads, self.friction, self.bridge, data.data)

    def _rest(self, search: Any, instant: Instant, points: dict[str, Array]) -> "KneeEquilibrium":
        """Return the knee at rest, from first touch at the other coordinates of q."""
        from tkamb.knee.starts import InitialPoses

        pair = self._need_contact().pair
        if not np.isfinite(pair.first_touch_height(knee_pose(instant.coordinates))):
            raise ComputationError("the femoral component does not lie over the insert", "q")
        return InitialPoses(search, pair, None).rest(instant, (), points)
