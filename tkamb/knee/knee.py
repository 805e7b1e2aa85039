"""`tkamb.Knee`: a total knee replacement on any Pinocchio model.

    knee = tkamb.Knee(model, side="right", implant=..., ligaments=[...], contact=..., friction=0.05)
    tau = pin.rnea(model, data, q, v, a, knee.external_forces(q, v))

All units are SI. Arguments and results are NumPy arrays and Pinocchio types. A call reads no files,
prints nothing, and does not change the result of the next call.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from tkamb.errors import ComputationError, InputError, names_among, real_number
from tkamb.geometry.frames import (
    KNEE_COORDINATES,
    PATELLA_BODY_COORDINATES,
    SIDES,
    Array,
    knee_pose,
)
from tkamb.knee.assembled import AssembledKnee, KneeData
from tkamb.knee.canonical import KneePose, mirrored_spatial, summed
from tkamb.knee.equations import KneeGeometry
from tkamb.knee.instant import NO_CONTACT, Instant, PatellaAt, PatellaFinder, SharingMuscles
from tkamb.knee.load import PointForces
from tkamb.knee.loads import KneeLoads, knee_loads
from tkamb.units import DEGREE, MILLIMETRE

if TYPE_CHECKING:
    from tkamb.contact.model import ProbedContact
    from tkamb.contact.result import ContactResult, WarmStart
    from tkamb.knee.balance import BalanceStatus
    from tkamb.knee.patella_equilibrium import PatellaEquilibrium
    from tkamb.knee.pressed import KneeContactResult, KneePatellaResult
    from tkamb.knee.released import KneeEquilibrium
    from tkamb.knee.solution_derivatives import EquilibriumDerivatives, PressDerivatives


@dataclass(frozen=True, eq=False)
class Equilibrium:
    """Result of `Knee.equilibrium`.

    Args:
        q: configuration of the user's model in equilibrium, shape (nq,).
        coordinates: knee coordinates in equilibrium, as `Knee.coordinates`, shape (6,), m and rad.
        loads: loads of the knee in equilibrium.
        contact: the contact in equilibrium, as `Knee.evaluate`; None: no equilibrium.
        residual: largest residual force on a released coordinate, N (moments divided by 25 mm).
        stiffness: stiffness of the n released coordinates, shape (n, n), N/m (rotations times
            25 mm).
        reason: why there is no equilibrium, in a sentence; empty: there is an equilibrium.
        search: details of the search, which is that of a right knee.
        derivatives: derivatives of the equilibrium; None: not asked for, or no equilibrium.
    """

    q: Array
    coordinates: Array
    loads: KneeLoads
    contact: "KneeContactResult | None"
    residual: float
    stiffness: Array
    reason: str
    search: "KneeEquilibrium"
    derivatives: "EquilibriumDerivatives | None" = None

    @property
    def failed(self) -> bool:
        """Whether there is no equilibrium."""
        return bool(self.reason)

    @property
    def status(self) -> "BalanceStatus":
        """How the search ended."""
        return self.search.balance.status

    def __repr__(self) -> str:
        """Return pose, forces and residual in three lines."""
        if self.failed:
            return f"<tkamb.Equilibrium: failed: {self.reason}>"
        millimetres = self.coordinates[:3] / MILLIMETRE
        degrees = self.coordinates[3:] / DEGREE
        places = [
            f"{name} {value:.3g} {unit}"
            for name, value, unit in zip(
                KNEE_COORDINATES, (*millimetres, *degrees), ["mm"] * 3 + ["deg"] * 3, strict=True
            )
        ]
        forces = ", ".join(f"{side} {f:.0f} N" for side, f in self.loads.normal_force.items())
        return (
            f"<tkamb.Equilibrium: {', '.join(places)};\n  {forces}; residual {self.residual:.2g} N>"
        )


class Knee(AssembledKnee):
    """A total knee replacement on a user's Pinocchio model.

    The knee lies between the frames "femur" and "tibia" of the model. The model may have any joints
    between, above and below these frames. Frames of the model give the poses of the knee's parts.
    If a frame has another name than its part, name it in the argument `frames`. The parts are:

    - `femur`, `tibia`: required. Attachment points may lie on any frame that is fixed to one of
      them.
    - `femoral`: axes of the femoral component's mesh, fixed to the femur. Default: `femur`.
    - `insert`: axes of the insert's mesh, fixed to the tibia. Default: the placement of a joint
      "knee_ap" on the tibia, or `tibia`.
    - `patella`: a body that moves relative to the femur. Default: the equilibrium of the extensor
      mechanism gives the pose of the patella.
    - `hip`: hip centre, fixed to the femur. Default: the parent joint of the femur.

    A part whose argument is missing is not modelled, and its code is not imported.

    Args:
        model: any Pinocchio model; it is not changed.
        side: "right" or "left".
        implant: meshes, material and bearing of the implant.
        ligaments: ligament bundles with slack lengths.
        extensor: quadriceps, patella and patellar ligament.
        contact: a contact model (`tkamb.contact_model`), its name, or the prepared `contact` of
            another knee with the same implant; None: no contact.
        friction: Coulomb coefficient of the femorotibial contact.
        muscles: straight lines of given tension between any frames of the model.
        frames: part of the knee -> name of its frame in the model; None: the part's default. A
            joint's frame is not taken for a part unless it is named here.
        joints: expected names of the joints between tibia and femur; empty: no check.
        cache: whether a lattice stores its prepared operators on disk for later runs.
        patellofemoral_contact: contact model of button and femoral component, or its name; None:
            the button is rigid. It needs `extensor` and a closed button with a flat back.
        released_patella: released coordinates of the patella, as `patella_equilibrium`: "ap",
            "si", "flexion" and perhaps "shift", "tilt", "rotation". Its forces then act in all
            results. Empty: the patella moves in its plane.
        head_shares: head of the quadriceps -> its share of the tension where that is unknown, or
            given as one number; None: the quadriceps of `extensor` is the only head.

    Raises:
        InputError: the arguments do not fit together.
    """

    def __repr__(self) -> str:
        """Return side, model, contact and lines in three lines."""
        contact = "no contact"
        if self.contact is not None:
            model = self.contact.model
            contact = f"{model.name} at {getattr(model, 'resolution', 0.0) / MILLIMETRE:g} mm"
        lines = f"{len(self.ligaments)} ligaments, {len(self._lines)} muscles"
        return (
            f"<tkamb.Knee: {self.side} knee on '{self.model.name}' (nq {self.model.nq}, nv "
            f"{self.model.nv})\n  {contact}, friction {self.friction:g}\n  {lines}, "
            f"{'no ' if self.extensor is None else ''}extensor mechanism>"
        )

    def external_forces(
        self,
        q: Array,
        v: Array,
        tensions: Mapping[str, float] | float | None = None,
        data: KneeData | None = None,
    ) -> Any:
        """Return the forces of contact, ligaments and muscles on the bodies at q and v.

        The overlap of the bodies at q gives the contact force, and v its friction. The patella is
        massless here: it transmits the quadriceps' tension to patellar ligament and femur.

        Args:
            q: configuration, shape (nq,); or (n, nq) for n configurations.
            v: velocity, shape (nv,); or (n, nv).
            tensions: muscle -> tension, N; or the tension of the quadriceps alone, N. Muscles
                without a tension are slack. With a released patella its heads are such muscles, and
                a number is the tension of all heads. If "patellar_ligament" is given with the
                quadriceps, as in `KneeLoads.tensions` of a plane patella, the patellofemoral force
                balances these two tensions.
            data: data from `create_data`, to save time.

        Returns:
            `pin.StdVec_Force`, one per joint in its joint's frame: `fext` of `pin.rnea` and
            `pin.aba`. For n configurations an array (n, njoints, 6). A released patella passes all
            its forces on to femur and tibia, so that none acts on its joint.

        Raises:
            InputError: q or v has the wrong size, or a muscle is unknown.
            ComputationError: the contact model is out of its range, or the patella is not found.
        """
        data = self._data(data)
        if np.ndim(q) == 2:
            from tkamb.knee.pressed import forces_of_all

            return forces_of_all(self, q, v, tensions, data)
        kinematics = self._kinematics(data, q, v)
        on_insert = np.zeros(6)
        if self.contact is None:
            self._check_place(kinematics.pose)
        else:
            contact = self._contact_at(data, kinematics)
            on_insert = self.contact.wrench(contact, self.bridge.twist(data.data))
        if self._crossing is not None:
            on_insert = on_insert + self._crossing.wrench(kinematics.pose)
        muscle_tensions = self._tensions(tensions)
        heads = {} if self.patella is None else self._take_heads(muscle_tensions)
        links = summed(self._loads_beside_contact(data, kinematics, muscle_tensions))
        if heads:
            from tkamb.knee.patella_equilibrium import pulled_tibia

            on_insert = on_insert + pulled_tibia(self, kinematics, heads, data)[0]
        for link, sign in (("tibia", 1.0), ("femur", -1.0)):
            links[link] = links.get(link, np.zeros(6)) + sign * on_insert
        return self._with_lines(data, muscle_tensions, self.bridge.joint_forces(data.data, links))

    def _take_heads(self, tensions: dict[str, float]) -> dict[str, float]:
        """Take the heads of a released patella that pull out of the tensions."""
        assert self.patella is not None
        heads = {head.name: tensions.pop(head.name, 0.0) for head in self.patella.heads}
        return heads if any(heads.values()) else {}

    def _loads_beside_contact(
        self, data: KneeData, kinematics: KneePose, muscle_tensions: Mapping[str, float]
    ) -> list[PointForces]:
        if not self._loads_patella(muscle_tensions):
            return []
        patella = None if self.extensor_lines is None else self._find_patella(kinematics, data)
        return self._loads_beside(kinematics, patella, muscle_tensions)

    def condyle_forces(self, q: Array, data: KneeData | None = None) -> tuple[Array, Array]:
        """Return the contact forces (2,), N, of medial and lateral condyle, and their derivative.

        A force is the magnitude of the condyle's resultant, without friction, at the overlap of q.
        The derivative (2, nv) by q is in the tangent space, N/m and N/rad.

        Raises:
            InputError: the knee has no contact model, or the model has no exact tangent.
            ComputationError: the contact model is out of its range.
        """
        contact, data = self._need_contact(), self._data(data)
        twists = self.relative_jacobian(q, data)
        twists = mirrored_spatial(twists.T).T if self.left else twists
        probed = self._contact_at(data, self._kinematics(data, q))
        probed = contact.with_exact_tangent(data.probe, probed)
        if not (probed.tangent and probed.exact):
            raise InputError(f"{contact.model.name} has no exact tangent", "condyle_forces")
        forces, slopes = np.zeros(2), np.zeros((2, self.model.nv))
        for k, side in enumerate(SIDES):
            if side in probed.condyles:
                forces[k] = probed.condyles[side].force
                slopes[k] = probed.condyles[side].force_slope @ twists
        return forces, slopes

    def condyle_pressures(self, q: Array, data: KneeData | None = None) -> Array:
        """Return the smooth peak pressures (2,), Pa, of medial and lateral condyle at q.

        `tkamb.knee.smooth_peak` has the equation.

        Raises:
            InputError: the knee has no contact model.
            ComputationError: the contact model is out of its range.
        """
        from tkamb.knee.smooth_peak import smooth_peaks

        contact, data = self._need_contact(), self._data(data)
        kinematics = self._kinematics(data, q)
        probed = self._contact_at(data, kinematics)
        return smooth_peaks(contact, data.probe, probed, kinematics.pose)

    def condyle_pressure_slopes(self, q: Array, data: KneeData | None = None) -> Array:
        """Return the derivative (2, nv) of `condyle_pressures` by q, Pa/m and Pa/rad.

        It is in the tangent space.

        Raises:
            InputError: see `condyle_pressures`; or the forces of the contact model jump from facet
                to facet (`hertz`).
            ComputationError: see `condyle_pressures`.
        """
        from tkamb.knee.smooth_peak import smooth_peak_slopes

        contact, data = self._need_contact(), self._data(data)
        twists = self.relative_jacobian(q, data)
        twists = mirrored_spatial(twists.T).T if self.left else twists
        kinematics = self._kinematics(data, q)
        probed = self._contact_at(data, kinematics)
        return smooth_peak_slopes(contact, data.probe, probed, kinematics.pose) @ twists

    def stiffness(
        self, q: Array, v: Array, data: KneeData | None = None, exact: bool = True
    ) -> Array:
        """Return the derivative (6, 6) of the femorotibial wrench by the relative displacement.

        The wrench on the insert is the sum of contact, friction and ligaments between femur and
        tibia: force (N) and moment about the insert's origin (N·m). The displacement is that of the
        femoral component relative to the insert: translation at the insert's origin (m), then
        rotation (rad). All vectors are in the insert frame. v is constant.

        Args:
            q: configuration, shape (nq,).
            v: velocity, shape (nv,).
            data: data from `create_data`, to save time.
            exact: False: use a tangent of the contact model even if it is approximate. The lattices
                with a softening material have an approximate tangent.

        Raises:
            ComputationError: the contact model is out of its range.
        """
        data = self._data(data)
        kinematics = self._kinematics(data, q, v)
        total = np.zeros((6, 6))
        if self.contact is not None:
            twist = self.bridge.twist(data.data)
            contact = self._contact_at(data, kinematics)
            total += self.contact.stiffness(data.probe, kinematics.pose, contact, twist, exact)
        total += self._crossing_stiffness(kinematics)
        return self._mirrored_matrix(total)

    def damping(self, q: Array, v: Array, data: KneeData | None = None) -> Array:
        """Return the derivative (6, 6) of the femorotibial wrench by the relative twist.

        The twist is the velocity of the femur relative to the insert (m/s, rad/s), in the
        conventions of `stiffness`. Only friction depends on the velocity.
        """
        data = self._data(data)
        kinematics = self._kinematics(data, q, v)
        if self.contact is None:
            return np.zeros((6, 6))
        contact = self._contact_at(data, kinematics)
        return self._mirrored_matrix(self.contact.damping(contact, self.bridge.twist(data.data)))

    def external_forces_derivatives(
        self,
        q: Array,
        v: Array,
        tensions: Mapping[str, float] | float | None = None,
        data: KneeData | None = None,
    ) -> tuple[Array, Array]:
        """Return the derivatives of `external_forces` by q and by v.

        The equations are in `tkamb.knee.derivatives`. The derivative is total: it contains the
        rotation of the forces with the bodies. Use it with `pin.computeABADerivatives`, which holds
        the forces constant in the joints' frames.

        Args:
            q: configuration, shape (nq,).
            v: velocity, shape (nv,).
            tensions: muscle tensions, see `external_forces`.
            data: data from `create_data`, to save time.

        Returns:
            df_dq and df_dv, each (njoints, 6, nv), in the tangent space of q: derivative of each
            joint's force in its joint's frame, N and N·m per m, rad, m/s or rad/s.

        Raises:
            InputError: see `external_forces`; or the forces of the contact model jump from facet to
                facet (`hertz`).
            ComputationError: see `external_forces`.
        """
        from tkamb.knee.derivatives import forces_and_derivatives

        return forces_and_derivatives(self, q, v, tensions, self._data(data))[1:]

    def forward_dynamics(
        self,
        q: Array,
        v: Array,
        tau: Array,
        fext: Any = None,
        tensions: Mapping[str, float] | float | None = None,
        data: KneeData | None = None,
    ) -> Array:
        """Return the acceleration (nv,): `pin.aba` with the forces of `external_forces`.

        Args:
            q: configuration, shape (nq,).
            v: velocity, shape (nv,).
            tau: torques and forces of the joints, shape (nv,), N·m and N.
            fext: other external forces on the joints, as `fext` of `pin.aba`; None: zero.
            tensions: muscle tensions, see `external_forces`.
            data: data from `create_data`, to save time.

        Raises:
            InputError: see `external_forces`.
            ComputationError: see `external_forces`.
        """
        data = self._data(data)
        forces = self._with_external(self.external_forces(q, v, tensions, data), fext)
        return np.array(pin.aba(self.model, data.data, q, v, self._check_tau(tau), forces))

    def forward_dynamics_derivatives(
        self,
        q: Array,
        v: Array,
        tau: Array,
        fext: Any = None,
        tensions: Mapping[str, float] | float | None = None,
        data: KneeData | None = None,
    ) -> tuple[Array, Array, Array]:
        """Return da_dq, da_dv and da_dtau (nv, nv) of `forward_dynamics`, in the tangent space.

        `fext` is constant in the joints' frames. The arguments are those of `forward_dynamics`.

        Raises:
            InputError: see `external_forces`.
            ComputationError: see `external_forces`.
        """
        data = self._data(data)
        model, pin_data = self.model, data.data
        forces, change, rate = self._generalised_derivatives(q, v, fext, tensions, data)
        pin.computeABADerivatives(model, pin_data, q, v, self._check_tau(tau), forces)
        inverse_mass = np.array(pin_data.Minv)
        return (
            pin_data.ddq_dq + inverse_mass @ change,
            pin_data.ddq_dv + inverse_mass @ rate,
            inverse_mass,
        )

    def inverse_dynamics_derivatives(
        self,
        q: Array,
        v: Array,
        a: Array,
        fext: Any = None,
        tensions: Mapping[str, float] | float | None = None,
        data: KneeData | None = None,
    ) -> tuple[Array, Array, Array]:
        """Return the derivatives of `pin.rnea` with the forces of `external_forces`.

        The joint torques are tau = pin.rnea(model, data, q, v, a, fext), with the knee's forces.

        Args:
            q: configuration, shape (nq,).
            v: velocity, shape (nv,).
            a: acceleration, shape (nv,).
            fext: other external forces, constant in the joints' frames; None: zero.
            tensions: muscle tensions, see `external_forces`.
            data: data from `create_data`, to save time.

        Returns:
            dtau_dq, dtau_dv and dtau_da, each (nv, nv), in the tangent space of q.

        Raises:
            InputError: see `external_forces`.
            ComputationError: see `external_forces`.
        """
        data = self._data(data)
        model, pin_data = self.model, data.data
        forces, change, rate = self._generalised_derivatives(q, v, fext, tensions, data)
        a = self._check(a, "a", model.nv)
        by_q, by_v, by_a = pin.computeRNEADerivatives(model, pin_data, q, v, a, forces)
        mass = np.triu(by_a) + np.triu(by_a, 1).T
        return by_q - change, by_v - rate, mass

    def _generalised_derivatives(
        self, q: Array, v: Array, fext: Any, tensions: Any, data: KneeData
    ) -> tuple[Any, Array, Array]:
        """Return the forces with `fext`, and the derivatives (nv, nv) of sum_j J_j^T f_j."""
        from tkamb.knee.derivatives import forces_and_derivatives, generalised

        forces, *changes = forces_and_derivatives(self, q, v, tensions, data)
        total = generalised(self.model, data.data, np.concatenate(changes, axis=2))
        nv = self.model.nv
        return self._with_external(forces, fext), total[:, :nv], total[:, nv:]

    def _with_external(self, forces: Any, fext: Any) -> Any:
        if fext is None:
            return forces
        self._check_fext(fext)
        return pin.StdVec_Force([f + e for f, e in zip(forces, fext, strict=True)])

    def _check_tau(self, tau: Array) -> Array:
        return self._check(tau, "tau", self.model.nv)

    def inverse_dynamics(
        self,
        q: Array,
        v: Array,
        a: Array,
        fext: Any = None,
        tensions: Mapping[str, float] | None = None,
        contact: "ContactResult | None" = None,
        data: KneeData | None = None,
    ) -> KneeLoads:
        """Return the loads of the knee in a given motion.

        The loads solve the equations of motion of shank and patella (docs/equilibrium.md). The
        forces of ligaments and given muscles are known. Contact points are the closest points of
        the undeformed bodies, or the resultants of `contact`.

        Args:
            q: configuration, shape (nq,).
            v: velocity, shape (nv,).
            a: acceleration, shape (nv,).
            fext: ground reaction and all other external forces on the joints, each in its joint's
                frame, as `fext` of `pin.rnea`; None: zero.
            tensions: muscle of `muscles` -> tension, N. The tension of the quadriceps is unknown
                and cannot be given.
            contact: a contact from `press` or `evaluate`; None: closest points.
            data: data from `create_data`, to save time.

        Returns:
            The loads. Without a solution they are NaN, and `problems` states the reasons.

        Raises:
            InputError: an argument has the wrong size, a muscle is unknown, or a contact is given
                to a knee without a contact model, or is that of a knee of the other side.
        """
        data = self._data(data, contact=False)
        instant = self._instant(q, v, a, fext, tensions, data)
        self._check_place(knee_pose(instant.coordinates))
        geometry, points = instant.geometry(), NO_CONTACT
        if contact is not None:
            from tkamb.contact.model import condyle_wrenches
            from tkamb.knee.pressed import contact_of_equations

            pressed = contact_of_equations(contact, self.left)
            wrenches = condyle_wrenches(pressed, self._need_contact().pair.split)
            geometry = instant.touching(geometry, instant.coordinates, wrenches, {})
        elif self.contact is not None:
            points = instant.contact_points(self._query, knee_pose(instant.coordinates))
            geometry = replace(geometry, condyles=points.condyles, lifted=points.lifted)
        geometry = replace(geometry, problems=points.problems + geometry.problems)
        return self._solved(instant, geometry, data)

    def press(
        self,
        q: Array,
        load: float | Array,
        data: KneeData | None = None,
        derivatives: bool = False,
    ) -> Any:
        """Return the contact under a load, at the rotations, AP and ML of q.

        Args:
            q: configuration, shape (nq,); or (n, nq) for n poses.
            load: compressive force along the insert's y axis, 0 or more, N; or one per pose, (n,).
            data: data from `create_data`; the last contact is the warm start.
            derivatives: whether the derivatives by load and pose are returned, too.

        Returns:
            A `tkamb.knee.pressed.KneeContactResult`: pressure, area and forces of both condyles in
            the insert frame. With derivatives, it and
            `tkamb.knee.solution_derivatives.PressDerivatives`. For n poses a
            `tkamb.knee.pressed.PressBatch`.

        Raises:
            InputError: the knee has no contact model, the load is negative or not finite, or
                derivatives are asked of a contact model without an exact tangent.
        """
        from tkamb.knee.pressed import contact_of_user

        data = self._data(data, contact=False)
        if np.ndim(q) == 2:
            from tkamb.knee.pressed import press_all

            return press_all(self, q, load, data, derivatives)
        if np.ndim(load):
            raise InputError(
                f"shape {np.shape(load)}", "load", "one q has one load; or give (n, nq)"
            )
        result, start = self._press_from(q, load, data)
        of_user = contact_of_user(result, self.left)
        return (of_user, self._press_slopes(result, start)) if derivatives else of_user

    def _press_slopes(self, result: "ContactResult", start: "WarmStart") -> "PressDerivatives":
        """Return the derivatives of a press from its result in the equations and its warm start."""
        from tkamb.knee.solution_derivatives import exact_tangent, press_derivatives

        contact = self._need_contact()
        if result.failed:
            raise ComputationError(result.reason, "press")
        probe = contact.probe(start)
        probed = contact.with_exact_tangent(probe, probe.seen(result, start))
        exact_tangent(probed, contact.model.name)
        slopes = press_derivatives(contact.pair, result.pose, probed)
        return replace(slopes, by_pose=mirrored_spatial(slopes.by_pose)) if self.left else slopes

    def _press_from(self, q: Array, load: Any, data: KneeData) -> "tuple[ContactResult, WarmStart]":
        """Return the contact of the equations and its warm start, which `data` stores, too."""
        contact = self._need_contact()
        load = real_number(load, "press: load", "give a load of 0 or more")
        if not (np.isfinite(load) and load >= 0):
            raise InputError(f"load {load} N", "press", "give a load of 0 or more")
        pose = self._kinematics(data, q).pose
        result, start = contact.model.press_from(contact.state, load, pose, data.start)
        # A failed press has no pressures to start from.
        if not result.failed:
            data.start = start
        return result, start

    def press_patella(
        self, q: Array, force: float, data: KneeData | None = None
    ) -> "KneePatellaResult":
        """Return the contact of the patellar button under a patellofemoral force.

        The patella has the pose of q, or that of its equilibrium if q has none. The force acts
        along the contact normal of the extensor mechanism, as `KneeLoads.patellofemoral`. The
        button is pressed along its axis (`tkamb.knee.button`).

        Args:
            q: configuration, shape (nq,).
            force: patellofemoral force, positive, N.
            data: data from `create_data`; the last contact is the warm start.

        Raises:
            InputError: the knee has no patellofemoral contact model, or the force is not positive
                or not finite.
            ComputationError: the patella is lost, or the contact model is out of its range.
        """
        from tkamb.knee.pressed import patella_of_user

        if self.button_contact is None:
            raise InputError(
                "has no patellofemoral contact model", "Knee", "give patellofemoral_contact="
            )
        force = real_number(force, "press_patella: force", "give a positive force")
        if not (np.isfinite(force) and force > 0):
            raise InputError(f"force {force} N", "press_patella", "give a positive force")
        data = self._data(data, contact=False)
        kinematics = self._kinematics(data, q)
        patella = self._find_patella(kinematics, data)
        poses = self._link_poses(kinematics, patella)
        press = self.button_contact.pressed(
            poses["femur"], poses["patella"], force * patella.contact_normal, data.button_start
        )
        if press.problem:
            raise ComputationError(press.problem, "press_patella")
        data.button_start = press.start
        return patella_of_user(press, poses, self.button_contact.in_patella, self.left)

    def patella_equilibrium(
        self,
        q: Array,
        tensions: Mapping[str, float] | float,
        released: Sequence[str] = PATELLA_BODY_COORDINATES,
        data: KneeData | None = None,
    ) -> "PatellaEquilibrium":
        """Return the patella in equilibrium in six degrees of freedom, at the femur's pose of q.

        The heads of the quadriceps are the quadriceps of `extensor` and the muscles of `muscles`
        that insert on the patella; all wrap the outline that the quadriceps wraps. The strands of
        the patellar ligament and the retinacula are the ligaments with an end on the patella. The
        inextensible ligament of `extensor` only gives the initial guess: the plane patella.

        Args:
            q: configuration, shape (nq,).
            tensions: head -> tension, N; or the tension of the quadriceps alone, N.
            released: some of "ap", "si", "shift", "flexion", "tilt", "rotation"
                (`tkamb.knee.patella_body`). The others keep the values of the plane patella,
                pressed on the femur: zero out of the plane.
            data: data from `create_data`; the last equilibrium is the initial guess.

        Raises:
            InputError: the knee has no patellofemoral contact model or no ligament from patella to
                tibia, no head pulls, another muscle has a tension, or a name is unknown.
            ComputationError: the plane patella is lost, or its button cannot be pressed.
        """
        from tkamb.knee.patella_equilibrium import find_equilibrium

        data = self._data(data, contact=False)
        given = self._tensions(tensions)
        return find_equilibrium(self, q, given, released, data)

    def evaluate(self, q: Array, data: KneeData | None = None) -> "KneeContactResult":
        """Return the contact at q: pressure, area and forces from the overlap of the bodies.

        The result has the form of `press`, but the height of the femur is that of q.

        Args:
            q: configuration, shape (nq,).
            data: data from `create_data`; the last contact is the warm start.
        """
        from tkamb.knee.pressed import contact_of_user

        contact, data = self._need_contact(), self._data(data, contact=False)
        pose = self._kinematics(data, q).pose
        self._check_place(pose)
        result = contact.model.evaluate(contact.state, pose, data.start)
        if not result.failed:
            data.start = result
        return contact_of_user(result, self.left)

    def equilibrium(
        self,
        q: Array,
        v: Array,
        a: Array,
        fext: Any = None,
        released: Sequence[str] = ("ap", "ml", "axial_rotation", "adduction"),
        tensions: Mapping[str, float] | None = None,
        data: KneeData | None = None,
        derivatives: bool = False,
    ) -> Equilibrium:
        """Return the pose at which the released coordinates are in equilibrium, with its loads.

        Flexion and the coordinates that are not released keep their values of q. The
        superior-inferior position is always released. The motion of the shank is that of q, v and
        a. The released coordinates are quasi-static (docs/equilibrium.md).

        Args:
            q: configuration, the initial guess, shape (nq,).
            v: velocity, shape (nv,).
            a: acceleration, shape (nv,).
            fext: external forces, see `inverse_dynamics`.
            released: some of "ap", "ml", "axial_rotation", "adduction"; "si" is always released.
            tensions: muscle tensions, see `inverse_dynamics`.
            data: data from `create_data`, to save time.
            derivatives: whether the result has the derivatives of coordinates and condyle forces by
                load, prescribed coordinates, slack lengths and stiffnesses
                (`tkamb.knee.solution_derivatives`).

        Raises:
            InputError: a coordinate is unknown, the knee has no contact model, the joints between
                tibia and femur have too few degrees of freedom for the pose, or derivatives are
                asked of a contact model without an exact tangent.
            ComputationError: the femur does not lie over the insert.
        """
        from tkamb.knee.pressed import contact_of_user
        from tkamb.knee.released import ReleasedKnee

        contact, allowed = self._need_contact(), [n for n in KNEE_COORDINATES if n != "flexion"]
        released = names_among(released, allowed, "released", "coordinate")
        if derivatives and self.button_contact is not None and self.patella is not None:
            self.button_contact.contact.check_differentiable()
        data = self._data(data)
        instant = self._instant(q, v, a, fext, tensions, data)
        probe = data.probe if data.probe is not None else contact.probe()
        search = ReleasedKnee(probe, released)
        points = {} if len(search.released) == 5 else self._nearest_points(instant.coordinates)
        knee, sign = self._knee_in_equilibrium(search, instant, points), self._coordinate_signs
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
        slopes = None
        if derivatives and not knee.problem:
            slopes = self._equilibrium_derivatives(search, instant, knee, points)
        released_signs = sign[list(search.released)]
        return Equilibrium(
            q_end,
            sign * knee.coordinates,
            loads,
            None if result is None else contact_of_user(result, self.left),
            knee.residual,
            released_signs[:, None] * knee.balance.stiffness * released_signs,
            knee.problem,
            knee,
            slopes,
        )

    def _equilibrium_derivatives(
        self, search: Any, instant: Instant, knee: "KneeEquilibrium", points: dict[str, Array]
    ) -> "EquilibriumDerivatives":
        from tkamb.knee.solution_derivatives import (
            EquilibriumDerivatives,
            ImplicitEquilibrium,
            exact_tangent,
        )

        model = self._need_contact()
        contact = model.with_exact_tangent(model.probe(), knee.contact)
        exact_tangent(contact, model.model.name)
        knee = replace(knee, contact=contact)
        equations = ImplicitEquilibrium(search, instant, knee, points, self.ligaments)
        slopes = equations.derivatives()
        if self.left:
            signs = self._coordinate_signs
            rows = np.append(signs, [1.0, 1.0])[:, None]
            slopes = EquilibriumDerivatives(
                rows * mirrored_spatial(slopes.by_load),
                rows * slopes.by_coordinate * signs,
                rows * slopes.by_slack_length,
                rows * slopes.by_stiffness,
            )
        return slopes

    def show(self, viewer: Any, q: Array, **options: Any) -> None:
        """Draw the knee at q in a user's `pin.visualize.MeshcatVisualizer`.

        Implant, ligaments, muscle lines, force arrows and the pressure map appear below the
        viewer's root node. `tkamb.knee.show.show_knee` describes the options.
        """
        from tkamb.knee.show import show_knee

        show_knee(self, viewer, q, **options)

    def _instant(
        self,
        q: Array,
        v: Array,
        a: Array,
        fext: Any = None,
        tensions: Mapping[str, float] | None = None,
        data: KneeData | None = None,
        patella: PatellaFinder | None = None,
        muscles: SharingMuscles | None = None,
    ) -> Instant:
        """Return the knee at one instant, the input of its equations and searches.

        Args:
            q: configuration, shape (nq,).
            v: velocity, shape (nv,).
            a: acceleration, shape (nv,).
            fext: external forces, see `inverse_dynamics`.
            tensions: muscle tensions, see `inverse_dynamics`.
            data: data from `create_data`, to save time.
            patella: object that finds the patella; None: the patella of q, or its equilibrium if q
                has none.
            muscles: muscles of the leg that share the load; None: the quadriceps alone acts.

        Raises:
            InputError: an argument has the wrong size, or a muscle is unknown.
        """
        data = self._data(data, contact=False)
        q = self._check_q(q)
        v, a = self._check(v, "v", self.model.nv), self._check(a, "a", self.model.nv)
        self._check_fext(fext)
        muscle_tensions = self._tensions(tensions)
        if self._pulls(muscle_tensions):
            raise InputError(
                "the tension of the quadriceps is unknown", "tensions", "give other muscles alone"
            )
        bridge, pin_data, lines = self.bridge, data.data, self.extensor_lines
        pin.forwardKinematics(self.model, pin_data, q, v, a)
        fext = self._with_lines(data, muscle_tensions, fext)
        motion = bridge.motion(pin_data, lines is not None)
        if lines is not None and patella is None:
            patella_coordinates = None if self._finds_patella else motion.joints[0, 6:]
            assert self.extensor is not None
            patella = PatellaAt(
                lines, knee_pose(motion.joints[0, :6]), patella_coordinates, self.extensor.solved
            )
        return Instant(
            self.chain,
            motion,
            bridge.shank_needs(pin_data),
            bridge.external_on(self.anatomy.femur, pin_data, fext),
            bridge.external_on(self.anatomy.patella, pin_data, fext),
            self._instant_ligaments,
            patella,
            self.friction,
            self.contact is not None and self.contact.pair.split is not None,
            None if fext is None else bridge.on_shank(pin_data, fext),
            muscles,
            self.patella,
        )

    def _check_fext(self, fext: Any) -> None:
        if fext is not None and len(fext) != self.model.njoints:
            raise InputError(
                f"{len(fext)} forces", "fext", f"give one per joint, {self.model.njoints}"
            )
        if fext is not None and not all(isinstance(force, pin.Force) for force in fext):
            raise InputError(
                f"holds {type(fext[0]).__name__}", "fext", "give a pin.Force per joint, as pin.rnea"
            )

    def _contact_at(self, data: KneeData, kinematics: KneePose) -> "ProbedContact":
        key = kinematics.pose.tobytes()
        if data.seen is None or data.seen[0] != key:
            assert self.contact is not None
            self._check_place(kinematics.pose)
            data.seen = key, self.contact.at(data.probe, kinematics.pose)
        return data.seen[1]

    def _crossing_stiffness(self, kinematics: KneePose) -> Array:
        if self._crossing is None:
            return np.zeros((6, 6))
        return self._crossing.tangent(kinematics.pose)

    def _mirrored_matrix(self, matrix: Array) -> Array:
        if not self.left:
            return matrix
        return mirrored_spatial(mirrored_spatial(matrix).T).T

    def _solved(self, instant: Instant, geometry: KneeGeometry, data: KneeData) -> KneeLoads:
        geometry, loads = instant.solved(geometry)
        return knee_loads(geometry, loads, self.friction, self.bridge, data.data)

    def _knee_in_equilibrium(
        self, search: Any, instant: Instant, points: dict[str, Array]
    ) -> "KneeEquilibrium":
        """Return the knee in equilibrium. The initial guess is first touch at the pose of q."""
        from tkamb.knee.starts import InitialPoses

        pair = self._need_contact().pair
        if not np.isfinite(pair.first_touch_height(knee_pose(instant.coordinates))):
            raise ComputationError("the femoral component does not lie over the insert", "q")
        return InitialPoses(search, pair, None).equilibrium(instant, (), points)
