"""`tkamb.Knee`: a total knee replacement on any Pinocchio model.

    knee = tkamb.Knee(model, side="right", implant=..., ligaments=[...], contact=..., friction=0.05)
    tau = pin.rnea(model, data, q, v, a, knee.external_forces(q, v))

All units are SI; arguments and results are NumPy arrays and Pinocchio types. No call reads a file,
prints, or changes the result of the next call. A `KneeData`, which the caller creates and passes,
saves time.
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
    """Result of `Knee.equilibrium`.

    Args:
        q: (nq,) configuration of the user's model in equilibrium.
        coordinates: (6,) knee coordinates there, as those of a right knee, m and rad.
        loads: loads of the knee there.
        contact: the contact there; None: no equilibrium was found.
        residual: N (moments are divided by 25 mm), largest residual force on a released
            coordinate.
        stiffness: (n, n) N/m, of the n released coordinates, with rotations times 25 mm.
        problem: why no equilibrium was found, in words; empty: one was found.
        search: details of the search.
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

    The knee lies between the frames "femur" and "tibia" of the model. There may be any joints
    between them, above and below. Its parts are placed by these frames, which are found by their
    names or given by `frames`:

    - `femur`, `tibia`: needed; attachment points may lie on any frame that is fixed to them;
    - `femoral`: axes of the femoral component's mesh, fixed to the femur. Default: `femur`;
    - `insert`: axes of the insert's mesh, fixed to the tibia. Default: the placement of a joint
      "knee_ap" on the tibia, or `tibia`;
    - `patella`: a body that moves against the femur. Default: the equilibrium of the extensor
      mechanism gives the place of the patella;
    - `hip`: hip centre, fixed to the femur. Default: the joint that carries the femur.

    A part that is not given is not modelled, and its code is not imported.

    Args:
        model: any Pinocchio model; it is not changed.
        side: "right" or "left".
        implant: meshes, material and bearing of the implant.
        ligaments: ligament bundles with slack lengths.
        extensor: quadriceps, patella and patellar ligament.
        contact: a contact model (`tkamb.contact_model`), its name, or the `contact` of another knee
            with the same implant, which is prepared already; None: no contact.
        friction: Coulomb coefficient of the femorotibial contact.
        muscles: straight lines of given tension between any frames of the model.
        frames: part of the knee -> name of its frame in the model.
        joints: names of the joints between tibia and femur, which are checked; empty: no check.
        cache: whether a lattice keeps its prepared operators on disk for the next time.

    Raises:
        InputError: the arguments do not fit together.
    """

    def external_forces(
        self,
        q: Array,
        v: Array,
        tensions: Mapping[str, float] | float | None = None,
        data: KneeData | None = None,
    ) -> Any:
        """Return the forces of contact, ligaments and muscles on the bodies at q and v.

        The contact follows from the overlap of the bodies at q, and its friction from v. The
        patella is massless here: it transmits the quadriceps' tension to patellar ligament and
        femur.

        Args:
            q: (nq,) configuration.
            v: (nv,) velocity.
            tensions: muscle -> N, or a number, the tension of the quadriceps. Other muscles are
                slack. If "patellar_ligament" is given beside the quadriceps, as in
                `KneeLoads.tensions`, the patellofemoral force balances these two tensions.
            data: from `create_data`, to save time.

        Returns:
            `pin.StdVec_Force`, one per joint in its joint's frame: `fext` of `pin.rnea` and
            `pin.aba`.

        Raises:
            InputError: q or v of the wrong size, or an unknown muscle.
            ComputationError: the contact model is out of its range, or the patella is not found.
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
        """Return the loads of the extensor mechanism, and of ligaments that end on the patella."""
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

        The wrench on the insert is the sum of contact, friction and ligaments between femur and
        tibia: force (N) and moment about the insert's origin (N·m). The displacement of the femoral
        component against the insert is that of its point at the insert's origin (m) and its
        rotation (rad). Both are in the insert frame; v is constant.

        Args:
            q: (nq,) configuration.
            v: (nv,) velocity.
            data: from `create_data`, to save time.
            exact: False: a tangent of the contact model is used even if it is approximate, as that
                of the lattices with a softening material.

        Raises:
            ComputationError: as `external_forces`.
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

        As `stiffness`, but the derivative by the femur's velocity against the insert (m/s, rad/s).
        Only friction depends on the velocity.
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
        """Return the loads of the knee in a given motion.

        They solve the equations of motion of shank and patella (docs/equilibrium.md). Ligaments and
        given muscles are known loads. Contact points are the closest points of the undeformed
        bodies, or the resultants of `contact`.

        Args:
            q: (nq,) configuration.
            v: (nv,) velocity.
            a: (nv,) acceleration.
            external: forces on the joints, each in its joint's frame, as `fext` of `pin.rnea`: the
                ground reaction and all other external forces. None: there are none.
            tensions: muscle of `muscles` -> N. The quadriceps is unknown and cannot be given.
            contact: a contact from `press` or `evaluate`; None: closest points.
            data: from `create_data`, to save time.

        Returns:
            The loads. Without a solution they are NaN, and `problems` says why.

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
        """Return the contact under a load, at the rotations, AP and ML of q.

        Args:
            q: (nq,) configuration.
            load: N, compressive force along the insert's y axis, 0 or more.
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
        """Return the same as `press`, and the warm start of the next press near by.

        Args:
            q: (nq,) configuration.
            load: N, as for `press`.
            start: warm start that the last press returned, to save time.
        """
        contact = self._need_contact()
        if not (np.isfinite(load) and load >= 0):
            raise InputError(f"load {load} N", "press", "give a load of 0 or more")
        place = self._kinematics(self.create_data_for_kinematics(), q)
        return contact.model.press_from(contact.state, float(load), place.pose, start)

    def evaluate(self, q: Array, guess: "Guess | None" = None) -> "ContactResult":
        """Return the contact at q: pressure, area and forces from the overlap of the bodies.

        The result is as that of `press`, but the height is that of q.
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

        Flexion and the coordinates that are not released stay as in q. The superior-inferior
        position is always released. The motion of the shank is that of q, v and a. The released
        coordinates are quasi-static (docs/equilibrium.md).

        Args:
            q: (nq,) configuration, the initial guess.
            v: (nv,) velocity.
            a: (nv,) acceleration.
            external: as for `inverse_dynamics`.
            released: names of "ap", "ml", "axial_rotation", "adduction"; "si" is always released.
            tensions: as for `inverse_dynamics`.
            data: from `create_data`, to save time.

        Raises:
            InputError: an unknown coordinate, no contact model, or too few degrees of freedom
                between tibia and femur to reach the pose.
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

        It adds implant, ligaments, lines, force arrows and the pressure map below the viewer's root
        node. `tkamb.knee.show.show_knee` describes the options.
        """
        from tkamb.knee.show import show_knee

        show_knee(self, viewer, q, **options)

    def live(self, q: Array, load: float = 1000.0, folder: Any = None) -> Any:
        """Serve a page on which the knee is moved and loaded by hand (docs/live.md).

        The load acts along the insert's y axis, beside the ligaments between femur and tibia. The
        page does not change this object.

        Args:
            q: (nq,) configuration, or (f, nq) for the slider "recorded frame".
            load: N, first value of the load.
            folder: folder for saved scenes; None: out/live.

        Returns:
            The server. Its address is `url`; it answers until `close()`.

        Raises:
            InputError: no contact model, or a model that was not made by `tkamb.contact_model`.
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
        """Return the knee at one instant, on which its equations and searches work.

        Args:
            q: (nq,) configuration.
            v: (nv,) velocity.
            a: (nv,) acceleration.
            external: as for `inverse_dynamics`.
            tensions: as for `inverse_dynamics`.
            data: from `create_data`, to save time.
            patella: finds the patella; None: its place is that of q, or of equilibrium if q has
                none.
            muscles: muscles of the leg that share the load; None: the quadriceps alone acts.

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
        """Return the contact at a place; the caller's data store the last one."""
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
        """Return the loads of a geometry, and their forces on the user's joints."""
        geometry, loads = instant.solved(geometry)
        return knee_loads(geometry, loads, self.friction, self.bridge, data.data)

    def _rest(self, search: Any, instant: Instant, points: dict[str, Array]) -> "KneeEquilibrium":
        """Return the knee in equilibrium, with first touch at the pose of q as initial guess."""
        from tkamb.knee.starts import InitialPoses

        pair = self._need_contact().pair
        if not np.isfinite(pair.first_touch_height(knee_pose(instant.coordinates))):
            raise ComputationError("the femoral component does not lie over the insert", "q")
        return InitialPoses(search, pair, None).rest(instant, (), points)
