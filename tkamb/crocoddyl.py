"""Optimal control of a model with a knee, by Crocoddyl (`pip install "tkamb[control]"`).

`KneeDynamics` is a differential action model: its acceleration is `Knee.forward_dynamics`, and its
derivatives are exact. Contact on polyethylene is stiff: an explicit integrator needs steps below a
millisecond. `KneeStep` integrates it by implicit Euler, so that steps of 10 to 50 ms are
stable near equilibrium:

    v' = v + h a(q', v', u),    q' = integrate(q, h v').

By the implicit function theorem, with J0 and J1 of `pin.dIntegrate`,

    (I - h a_v - h² a_q J1) dv' = dv + h a_q J0 dq + h a_u du.

Out of the model's range, or without convergence of Newton's method, the next state is NaN, and the
solver shortens its step. The models are Python objects: set `nthreads = 1` in a `ShootingProblem`
(more threads were not tested). Crocoddyl must fit the installed Pinocchio (`tkamb.crocoddyl_pair`).

Reference: Mastalli et al., Crocoddyl: an efficient and versatile framework for multi-contact
optimal control, ICRA (2020), doi:10.1109/ICRA40945.2020.9196673.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
import pinocchio as pin

from tkamb.crocoddyl_pair import checked
from tkamb.errors import ComputationError, InputError
from tkamb.geometry.frames import Array
from tkamb.knee.knee import Knee

try:
    import crocoddyl
except ImportError as error:
    raise InputError(
        "needs Crocoddyl, which is not installed",
        "tkamb.crocoddyl",
        'install it: pip install "tkamb[control]"',
    ) from error
checked(crocoddyl.__version__, pin.__version__)


class KneeDynamics(crocoddyl.DifferentialActionModelAbstract):
    """Forward dynamics of a model with a knee, with costs by the user.

    The control u is that of the actuation, then one tension (N) per muscle of `muscles`.

    Args:
        state: `crocoddyl.StateMultibody` of `knee.model`.
        actuation: any actuation model of that state.
        knee: the knee.
        costs: `crocoddyl.CostModelSum`; its nu is the number of all controls.
        muscles: names of muscles whose tensions are controls.
        tensions: muscle -> constant tension, N.
        fext: constant external forces, one `pin.Force` per joint in the joint's frame, as those of
            `pin.aba`; None: zero.

    Raises:
        InputError: the state is that of another model, the costs have another number of controls,
            or a muscle is a head of a released patella.
    """

    def __init__(
        self,
        state: Any,
        actuation: Any,
        knee: Knee,
        costs: Any,
        muscles: Sequence[str] = (),
        tensions: Mapping[str, float] | None = None,
        fext: Any = None,
    ) -> None:
        count = actuation.nu + len(muscles)
        if state.nv != knee.model.nv or state.pinocchio != knee.model:
            raise InputError("belongs to another model", "state", "give that of knee.model")
        if costs.nu != count:
            raise InputError(
                f"nu is {costs.nu}", "costs", f"give {count}: the actuation, then the muscles"
            )
        if knee.patella is not None and knee._pulls(dict.fromkeys(muscles, 1.0)):
            words = "a head of a released patella is no control: its forces are not linear in it"
            raise InputError(words, "muscles", "give its tension in tensions=")
        super().__init__(state, count, costs.nr)
        knee._tensions(dict.fromkeys(muscles, 0.0) | dict(tensions or {}))
        self.knee, self.actuation, self.costs = knee, actuation, costs
        self.muscles, self.tensions, self.fext = tuple(muscles), dict(tensions or {}), fext

    def createData(self) -> "KneeDynamicsData":
        """Return new data."""
        return KneeDynamicsData(self)

    def calc(self, data: "KneeDynamicsData", x: Array, u: Array | None = None) -> None:
        """Set acceleration and cost; without u, the cost alone."""
        self.calc_cost(data, x, u)
        if u is not None:
            data.xout = self.acceleration(data, x, u)

    def calcDiff(self, data: "KneeDynamicsData", x: Array, u: Array | None = None) -> None:
        """Set the derivatives of acceleration and cost; without u, those of the cost alone."""
        self.calc_cost_derivatives(data, x, u)
        if u is not None:
            data.Fx, data.Fu = self.acceleration_derivatives(data, x, u)

    def acceleration(self, data: "KneeDynamicsData", x: Array, u: Array) -> Array:
        """Return the acceleration (nv,); NaN if the contact model is out of its range."""
        q, v = x[: self.state.nq], x[self.state.nq :]
        self.actuation.calc(data.actuation, x, u[: self.actuation.nu])
        tensions = self._tensions(u)
        if not np.isfinite(x).all() or not all(tension >= 0.0 for tension in tensions.values()):
            return np.full(self.state.nv, np.nan)
        try:
            return self.knee.forward_dynamics(
                q, v, data.actuation.tau, self.fext, tensions, data.knee
            )
        except ComputationError:
            return np.full(self.state.nv, np.nan)

    def acceleration_derivatives(
        self, data: "KneeDynamicsData", x: Array, u: Array
    ) -> tuple[Array, Array]:
        """Return the derivatives of the acceleration by x (nv, ndx) and by u (nv, nu)."""
        q, v, count = x[: self.state.nq], x[self.state.nq :], self.actuation.nu
        self.actuation.calc(data.actuation, x, u[:count])
        self.actuation.calcDiff(data.actuation, x, u[:count])
        tensions = self._tensions(u)
        by_q, by_v, by_tau = self.knee.forward_dynamics_derivatives(
            q, v, data.actuation.tau, self.fext, tensions, data.knee
        )
        by_x = np.hstack([by_q, by_v]) + by_tau @ data.actuation.dtau_dx
        by_u = np.zeros((self.state.nv, self.nu))
        by_u[:, :count] = by_tau @ np.reshape(data.actuation.dtau_du, (self.state.nv, count))
        if self.muscles:
            here = self._force(data, q, v, tensions)
            for k, name in enumerate(self.muscles, count):
                # The forces are linear in the tensions.
                more = self._force(data, q, v, tensions | {name: tensions[name] + 1.0})
                by_u[:, k] = by_tau @ (more - here)
        return by_x, by_u

    def calc_cost(self, data: "KneeDynamicsData", x: Array, u: Array | None) -> None:
        """Set the cost."""
        self._place(data, x)
        if u is None:
            self.costs.calc(data.costs, x)
        else:
            self.actuation.calc(data.actuation, x, u[: self.actuation.nu])
            self.costs.calc(data.costs, x, u)
        data.cost = data.costs.cost

    def calc_cost_derivatives(self, data: "KneeDynamicsData", x: Array, u: Array | None) -> None:
        """Set the derivatives of the cost."""
        self._place(data, x)
        pin.computeJointJacobians(self.state.pinocchio, data.pinocchio, x[: self.state.nq])
        pin.jacobianCenterOfMass(self.state.pinocchio, data.pinocchio, x[: self.state.nq])
        if u is None:
            self.costs.calcDiff(data.costs, x)
        else:
            self.costs.calcDiff(data.costs, x, u)

    def _place(self, data: "KneeDynamicsData", x: Array) -> None:
        model, q, v = self.state.pinocchio, x[: self.state.nq], x[self.state.nq :]
        pin.forwardKinematics(model, data.pinocchio, q, v)
        pin.updateFramePlacements(model, data.pinocchio)
        pin.centerOfMass(model, data.pinocchio, q, v)

    def _tensions(self, u: Array) -> dict[str, float]:
        controls = u[self.actuation.nu :].tolist()
        return self.tensions | dict(zip(self.muscles, controls, strict=True))

    def _force(self, data: "KneeDynamicsData", q: Array, v: Array, tensions: Any) -> Array:
        forces = self.knee.external_forces(q, v, tensions, data.knee)
        jacobians, total = data.knee.data, np.zeros(self.state.nv)
        pin.computeJointJacobians(self.knee.model, jacobians, q)
        for joint in range(1, self.knee.model.njoints):
            local = pin.getJointJacobian(
                self.knee.model, jacobians, joint, pin.ReferenceFrame.LOCAL
            )
            total += local.reshape(6, -1).T @ forces[joint].vector
        return total


class KneeDynamicsData(crocoddyl.DifferentialActionDataAbstract):
    """Data of `KneeDynamics`: those of the knee, Pinocchio, the actuation and the costs."""

    def __init__(self, model: KneeDynamics) -> None:
        super().__init__(model)
        self.knee = model.knee.create_data()
        self.pinocchio = pin.Data(model.state.pinocchio)
        self.actuation = model.actuation.createData()
        self.collector = crocoddyl.DataCollectorActMultibody(self.pinocchio, self.actuation)
        self.costs = model.costs.createData(self.collector)
        self.costs.shareMemory(self)


class KneeStep(crocoddyl.ActionModelAbstract):
    """One step of `KneeDynamics` by implicit Euler; the equations are those of this module.

    The cost is that of the differential model at x and u, times the step. With a step of zero the
    state does not change, and the cost is not multiplied: this is the terminal model.

    Args:
        dynamics: the differential model.
        step: time step, s.
    """

    velocity_tolerance = 1e-9
    """m/s and rad/s: residual at which Newton's method has converged. Chosen far below any speed of
    a knee, because the derivatives are those of the converged step."""
    jump_tolerance = 1e-5
    """m/s and rad/s: largest Newton step that converges although its residual does not fall. The
    contact force of a foundation jumps by 1e-5 of itself where a column's ray goes from facet to
    facet. If the solution lies on a jump, the residual stays at 2e-3 m/s, and the velocities of its
    two sides differ by 1e-6 m/s (measured on a planar leg with steps of 50 ms)."""
    largest_travel = 1.0
    """m and rad: a step that travels farther has no next state. Chosen because a solver's first
    trials turn a joint many times, and a knee refuses angles beyond a turn. Not studied."""
    max_newton_steps = 25
    """Maximum number of Newton steps. Not studied."""

    def __init__(self, dynamics: KneeDynamics, step: float) -> None:
        if not (np.isfinite(step) and step >= 0.0):
            raise InputError(f"step {step} s", "KneeStep", "give 0 or more")
        super().__init__(dynamics.state, dynamics.nu, dynamics.nr)
        self.dynamics, self.step = dynamics, float(step)

    def createData(self) -> "KneeStepData":
        """Return new data."""
        return KneeStepData(self)

    def calc(self, data: "KneeStepData", x: Array, u: Array | None = None) -> None:
        """Set the next state and the cost."""
        self.dynamics.calc_cost(data.differential, x, u)
        data.cost = data.differential.cost * (self.step or 1.0)
        if u is None or not self.step:
            data.xnext = x
            return
        end = self._next(data, x, u)
        data.xnext = np.full(len(x), np.nan) if end is None else end

    def calcDiff(self, data: "KneeStepData", x: Array, u: Array | None = None) -> None:
        """Set the derivatives of the next state and of the cost."""
        inner, factor, size = data.differential, self.step or 1.0, self.state.nv
        self.dynamics.calc_cost_derivatives(inner, x, u)
        data.Lx, data.Lxx = factor * np.array(inner.Lx), factor * np.array(inner.Lxx)
        if u is not None:
            data.Lu, data.Luu = factor * np.array(inner.Lu), factor * np.array(inner.Luu)
            data.Lxu = factor * np.array(inner.Lxu)
        if u is None or not self.step:
            data.Fx, data.Fu = np.eye(2 * size), np.zeros((2 * size, self.nu))
            return
        end, h = data.xnext, self.step
        if not np.isfinite(end).all():  # an error in a callback would end the process
            data.Fx, data.Fu = (
                np.full((2 * size,) * 2, np.nan),
                np.full((2 * size, self.nu), np.nan),
            )
            return
        by_x, by_u = self.dynamics.acceleration_derivatives(inner, end, u)
        q, travel = x[: self.state.nq], h * end[self.state.nq :]
        first, second = pin.dIntegrate(self.dynamics.knee.model, q, travel)
        by_q, by_v = by_x[:, :size], by_x[:, size:]
        matrix = np.eye(size) - h * by_v - h**2 * by_q @ second
        right = np.hstack([h * by_q @ first, np.eye(size), h * by_u])
        velocity = np.linalg.solve(matrix, right)
        position = h * second @ velocity
        position[:, :size] += first
        both = np.vstack([position, velocity])
        data.Fx, data.Fu = both[:, : 2 * size], both[:, 2 * size :]

    def _next(self, data: "KneeStepData", x: Array, u: Array) -> Array | None:
        """Return the next state; None: Newton's method does not converge."""
        model, inner, h, nq = self.dynamics.knee.model, data.differential, self.step, self.state.nq
        q, v = x[:nq], x[nq:]
        if not (np.isfinite(x).all() and np.isfinite(u).all()):
            return None

        def residual(velocity: Array) -> tuple[Array, Array]:
            if not float(np.abs(h * velocity).max()) <= self.largest_travel:  # true for NaN
                return np.full(len(x), np.nan), np.full(len(v), np.nan)
            at = np.concatenate([pin.integrate(model, q, h * velocity), velocity])
            return at, velocity - v - h * self.dynamics.acceleration(inner, at, u)

        # The guesses depend on x alone: with those of earlier calls, so would the next state.
        for guess in (v, np.zeros_like(v)):
            end = self._converged(inner, residual, guess, q, u)
            if end is not None:
                return end
        return None

    def _converged(
        self, inner: "KneeDynamicsData", residual: Any, guess: Array, q: Array, u: Array
    ) -> Array | None:
        """Return the next state by Newton's method from a guess of its velocity, or None."""
        model, h, nq, count = self.dynamics.knee.model, self.step, self.state.nq, self.state.nv
        end, error = residual(guess)
        for _ in range(self.max_newton_steps):
            size = float(np.abs(error).max())
            if not np.isfinite(size):
                return None
            if size < self.velocity_tolerance:
                return end
            by_x, _ = self.dynamics.acceleration_derivatives(inner, end, u)
            _, second = pin.dIntegrate(model, q, h * end[nq:])
            matrix = np.eye(count) - h * by_x[:, count:] - h**2 * by_x[:, :count] @ second
            change = np.linalg.solve(matrix, error)
            for share in (1.0, 0.5, 0.25, 0.1, 0.03):
                trial, trial_error = residual(end[nq:] - share * change)
                if float(np.abs(trial_error).max()) < size:  # false for NaN
                    break
            else:
                if float(np.abs(change).max()) < self.jump_tolerance:
                    return end
            end, error = trial, trial_error
        return None


class KneeStepData(crocoddyl.ActionDataAbstract):
    """Data of `KneeStep`."""

    def __init__(self, model: KneeStep) -> None:
        super().__init__(model)
        self.differential = model.dynamics.createData()


class _CondyleResidual(crocoddyl.ResidualModelAbstract):
    """Residual of one value per condyle, medial and lateral, that depends on q alone.

    The values are NaN if the contact model is out of its range, and for a state that is not finite.
    """

    def __init__(self, state: Any, knee: Knee, nu: int) -> None:
        super().__init__(state, 2, nu, True, False, False)
        self.knee = knee
        self._data = knee.create_data()

    def calc(self, data: Any, x: Array, u: Array | None = None) -> None:
        data.r = np.full(2, np.nan)
        if np.isfinite(x).all():  # not the state after a `KneeStep` that has not converged
            with suppress(ComputationError):
                data.r = self._values(x[: self.state.nq])

    def calcDiff(self, data: Any, x: Array, u: Array | None = None) -> None:
        by_q = np.full((2, self.state.nv), np.nan)
        if np.isfinite(x).all():
            with suppress(ComputationError):
                by_q = self._slopes(x[: self.state.nq])
        data.Rx[:, :] = np.hstack([by_q, np.zeros((2, self.state.nv))])

    def _values(self, q: Array) -> Array:
        raise NotImplementedError

    def _slopes(self, q: Array) -> Array:
        raise NotImplementedError


class CondyleForces(_CondyleResidual):
    """Residual: the contact forces of the medial and the lateral condyle, N, (2,).

    The contact model needs an exact tangent, as foundation and lattices have. The arguments are
    those of `CondylePressures`.
    """

    _last: tuple[Array, Array] | None = None
    """The last q, and the derivative there."""

    def _values(self, q: Array) -> Array:
        forces, by_q = self.knee.condyle_forces(q, self._data)
        self._last = np.array(q), by_q
        return forces

    def _slopes(self, q: Array) -> Array:
        if self._last is None or not np.array_equal(self._last[0], q):
            self._values(q)
        assert self._last is not None
        return self._last[1]


class CondylePressures(_CondyleResidual):
    """Residual: smooth peak pressures of the medial and the lateral condyle, Pa, (2,).

    `tkamb.knee.smooth_peak` has the equation.

    Args:
        state: `crocoddyl.StateMultibody` of `knee.model`.
        knee: a knee with a contact model.
        nu: number of controls.
    """

    def _values(self, q: Array) -> Array:
        return self.knee.condyle_pressures(q, self._data)

    def _slopes(self, q: Array) -> Array:
        return self.knee.condyle_pressure_slopes(q, self._data)
