"""Linear viscoelastic polyethylene: a Prony series, for one point and for the lattice.

On the lattice all springs relax with the same series M(t)/M_0, so Poisson's ratio is constant in
time. With the elastic compliance C_0, the surface displacement u and the nodal forces f satisfy

    C_0 f(t) = integral of M(t - s)/M_0 du(s)

at every node. Nodes outside the contact have no force and recover by the same equation. For a step
in which u is linear in time the equation at the end of the step is

    C_0 f' = slope u' + memory

`PronySeries.response` gives slope and memory. A step is therefore an elastic contact with the
compliance C_0/slope and the initial displacement -memory/slope, which `lattice-linear` solves.

Reference: Lee & Radok, J Appl Mech 27:438 (1960), doi:10.1115/1.3644020.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from tkamb.contact.lattice.initial_guess import InitialGuess, guessed_depth, initial_guess
from tkamb.contact.lattice.model import COVERED_APPROACH, LEAST_OVERLAP, LinearLattice
from tkamb.contact.lattice.problem import TangentPlanes, undeformed
from tkamb.contact.lattice.solver import Solution, solve
from tkamb.contact.pair import ContactPair
from tkamb.contact.pressing import check_load
from tkamb.errors import ComputationError, InputError
from tkamb.geometry.frames import Array


@dataclass(frozen=True)
class PronySeries:
    """Relaxation of a modulus, relative to its instantaneous value.

        M(t)/M_0 = 1 - sum g_i + sum g_i exp(-t/tau_i)

    Args:
        fractions: positive fractions g_i with a sum below 1.
        times: relaxation times tau_i, s.
    """

    fractions: tuple[float, ...]
    times: tuple[float, ...]

    def __post_init__(self) -> None:
        positive = all(math.isfinite(g) and g > 0 for g in self.fractions)
        if not positive or sum(self.fractions) >= 1 or len(self.fractions) != len(self.times):
            raise InputError(
                f"fractions {self.fractions} and times {self.times} are not a Prony series",
                "viscoelastic",
                "give one positive fraction for each time, with a sum below 1",
            )
        if not all(math.isfinite(tau) and tau > 0 for tau in self.times):
            raise InputError(f"times {self.times}", "viscoelastic", "give seconds above 0")

    @property
    def equilibrium(self) -> float:
        """Relaxed modulus over the instantaneous one, M(infinity)/M_0."""
        return 1.0 - sum(self.fractions)

    def relaxation(self, time: float) -> float:
        """Return M(t)/M_0 at a time, s."""
        pairs = zip(self.fractions, self.times, strict=True)
        return self.equilibrium + sum(g * math.exp(-time / tau) for g, tau in pairs)

    def response(self, step: float) -> tuple[float, Array, Array]:
        """Return the coefficients of the stress after a step of `step` s.

        Primes denote the end of the step, and q_i is the stress of term i. For a strain that is
        linear in time over the step the hereditary integral is exactly

            q_i' = a_i q_i + b_i (eps' - eps),    sigma'/M_0 = equilibrium eps' + sum q_i'

        Returns:
            Slope d sigma'/d eps' over M_0, and the factors a and b of the terms of the series.
        """
        ratio = step / np.array(self.times)
        decay = np.exp(-ratio)
        weights = np.array(self.fractions) * -np.expm1(-ratio) / ratio
        return self.equilibrium + float(weights.sum()), decay, weights

    def stress(self, time: Array, strain: Array) -> Array:
        """Return the stress over M_0 for a strain that is linear between times, shape (f, ...).

        At the first time the strain jumps from zero to its first value.

        Args:
            time: increasing times, s, shape (f,).
            strain: strain at these times, shape (f, ...).
        """
        strain = np.asarray(strain, float)
        memory = np.multiply.outer(np.array(self.fractions), strain[0])
        result = [self.equilibrium * strain[0] + memory.sum(axis=0)]
        for step, before, after in zip(np.diff(time), strain[:-1], strain[1:], strict=True):
            _, decay, weights = self.response(float(step))
            memory = (memory.T * decay).T + np.multiply.outer(weights, after - before)
            result.append(self.equilibrium * after + memory.sum(axis=0))
        return np.array(result)


@dataclass(frozen=True, eq=False)
class ViscoelasticContact:
    """Contact after a step. Arrays have one entry per contact node, in the insert frame.

    Args:
        pose: pose_femoral_in_insert, shape (4, 4), with the y of the deformed contact.
        pressure: force over tributary area, Pa, shape (c,).
        force: force on the insert, N, shape (c, 3).
        displacement: displacement of the contact nodes, also outside the contact, m, shape (c, 3).
    """

    pose: Array
    pressure: Array
    force: Array
    displacement: Array


class ViscoelasticLattice:
    """A viscoelastic insert under a rigid femoral component, computed in time steps.

    Limits: small strain, no yield, no friction, and constant Poisson's ratio.

    Args:
        pair: both bodies. Young's modulus of the material is the instantaneous one.
        series: relaxation of all springs.

    Attributes:
        points: undeformed contact nodes, m, shape (c, 3).
    """

    def __init__(self, model: LinearLattice, pair: ContactPair, series: PronySeries) -> None:
        self._series, self._settings = series, model.settings
        self._state = model.prepare(pair)
        self.points = self._state.problem.surface_points
        self._displacement = np.zeros_like(self.points)
        self._memory = np.zeros((len(series.times), *self.points.shape))

    def press(self, load: float, pose: Array, step: float) -> ViscoelasticContact:
        """Advance by `step` s to a load along -y, N, at a pose (4, 4); its y follows from the load.

        Raises:
            InputError: the load is invalid, or the femoral component is not above the insert.
            ComputationError: the contact does not converge.
        """
        check_load(load)
        return self._step(load, pose, step)

    def hold(self, pose: Array, step: float) -> ViscoelasticContact:
        """Advance by `step` s to a prescribed pose (4, 4); see `press`."""
        return self._step(None, pose, step)

    def _step(self, load: float | None, pose: Array, step: float) -> ViscoelasticContact:
        if not step > 0:
            raise InputError(f"a step of {step:g} s", "viscoelastic", "give seconds above 0")
        slope, decay, weights = self._series.response(step)
        memory = np.tensordot(decay, self._memory, 1) - weights.sum() * self._displacement
        pose, force = self._contact(load, np.array(pose, float), slope, -memory / slope)
        problem = self._state.problem
        applied = np.zeros_like(problem.solid.nodes)
        applied[problem.contact_nodes] = force
        elastic = problem.operator.solve(applied)[problem.contact_nodes]
        displacement = (elastic - memory) / slope
        change = np.multiply.outer(weights, displacement - self._displacement)
        self._memory = (self._memory.T * decay).T + change
        self._displacement = displacement
        pressure = np.linalg.norm(force, axis=1) / self._state.surface.area
        return ViscoelasticContact(pose, pressure, force, displacement)

    def _contact(
        self, load: float | None, pose: Array, slope: float, offset: Array
    ) -> tuple[Array, Array]:
        """Return the pose and the nodal forces of a step, N, shape (c, 3).

        Args:
            load: load along -y, N; None: the pose is prescribed.
            pose: pose_femoral_in_insert, shape (4, 4).
            slope: stiffness of the springs in the step over the instantaneous stiffness.
            offset: displacement of the nodes without contact forces, m, shape (c, 3).
        """
        gaps, planes = undeformed(self._state.problem, pose)
        lowest, force = float(gaps.min()), np.zeros_like(offset)
        if not np.isfinite(lowest):
            raise InputError("the femoral component does not lie over the insert", "viscoelastic")
        if load == 0 or (load is None and lowest >= -LEAST_OVERLAP):
            return pose, force
        if load is not None:
            pose[1, 3] -= lowest
            gaps, planes = gaps - lowest, planes.raised(-lowest)
        result = self._solved(load, pose, (gaps, planes), slope, offset)
        pose[1, 3] -= result.forces.approach if load is not None else 0.0
        force[result.candidates] = result.forces.force[:, None] * result.planes.normals
        return pose, force

    def _solved(
        self,
        load: float | None,
        pose: Array,
        undeformed_gaps: tuple[Array, TangentPlanes],
        slope: float,
        offset: Array,
    ) -> Solution:
        """Solve with larger sets of candidates until none outside can touch."""
        (gaps, planes), state = undeformed_gaps, self._state
        creep_depth = -float(offset[:, 1].min())  # the undeformed gaps do not include creep
        depth = -float(gaps.min())
        if load is not None:
            guess_depth = guessed_depth(state.problem, gaps, state.surface.area, load / slope)
            depth = guess_depth + creep_depth
        for _ in range(self._settings.max_expansions):
            guess = initial_guess(state.compliance, gaps, planes, depth, load is None)
            result = solve(state.problem, pose, load, _softer(guess, slope, offset), self._settings)
            if not result.converged:
                break
            covered = load is None or len(guess.candidates) == np.isfinite(gaps).sum()
            if covered or result.forces.approach * COVERED_APPROACH <= guess.reach:
                return result
            depth = 1.1 * result.forces.approach
        raise ComputationError("the contact does not converge", "viscoelastic")


def _softer(guess: InitialGuess, slope: float, offset: Array) -> InitialGuess:
    response = replace(guess.response, compliance=guess.response.compliance / np.float32(slope))
    return replace(guess, response=response, offset=offset[guess.candidates])
