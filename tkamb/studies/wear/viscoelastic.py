"""Linear viscoelastic polyethylene: a Prony series, alone and on the lattice.

On the lattice all springs relax by the same series M(t)/M_0, so Poisson's ratio is constant in
time. The surface displacement u and the nodal forces f then obey, with the elastic compliance C_0,

    C_0 f(t) = integral of M(t - s)/M_0 du(s)

at every node. Nodes that the femoral component has left carry no force and recover by the same
equation. Over a step in which u is linear in time it reads

    C_0 f' = slope u' + memory

where `PronySeries.response` gives the slope and how the memory evolves. A step is therefore an
elastic contact with the compliance C_0/slope, on a surface that is already displaced by
-memory/slope. The solver of `lattice-linear` solves it.

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
        fractions: g_i, positive, below 1 together.
        times: tau_i, s.
    """

    fractions: tuple[float, ...]
    times: tuple[float, ...]

    def __post_init__(self) -> None:
        shares = all(math.isfinite(g) and g > 0 for g in self.fractions)
        if not shares or sum(self.fractions) >= 1 or len(self.fractions) != len(self.times):
            raise InputError(
                f"fractions {self.fractions} and times {self.times} are no Prony series",
                "viscoelastic",
                "as many positive fractions, below 1 together, as times",
            )
        if not all(math.isfinite(tau) and tau > 0 for tau in self.times):
            raise InputError(f"times {self.times}", "viscoelastic", "give seconds above 0")

    @property
    def equilibrium(self) -> float:
        """M(infinity)/M_0."""
        return 1.0 - sum(self.fractions)

    def relaxation(self, time: float) -> float:
        """Return M(t)/M_0 at a time (s)."""
        pairs = zip(self.fractions, self.times, strict=True)
        return self.equilibrium + sum(g * math.exp(-time / tau) for g, tau in pairs)

    def response(self, step: float) -> tuple[float, Array, Array]:
        """Return how the stress follows from the strain over a step of `step` s.

        With the strain linear in time over the step the hereditary integral is exact:

            q_i' = a_i q_i + b_i (eps' - eps),    sigma'/M_0 = equilibrium eps' + sum q_i'

        Returns:
            Slope d sigma'/d eps' relative to M_0, factors a (i,) and b (i,).
        """
        ratio = step / np.array(self.times)
        decay = np.exp(-ratio)
        weights = np.array(self.fractions) * -np.expm1(-ratio) / ratio
        return self.equilibrium + float(weights.sum()), decay, weights

    def stress(self, time: Array, strain: Array) -> Array:
        """Return the stress relative to M_0 (f, ...) of strains (f, ...), linear between times.

        The strain jumps from nothing to its first value at the first time.

        Args:
            time: (f,) s, rising.
            strain: (f, ...).
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
    """The contact after a step. Arrays are per contact node, insert frame.

    Args:
        pose: (4, 4) pose_femoral_in_insert, y as found.
        pressure: (c,) Pa, force over the node's own area.
        force: (c, 3) N on the insert.
        displacement: (c, 3) m, of the contact nodes, in contact or not.
    """

    pose: Array
    pressure: Array
    force: Array
    displacement: Array


class ViscoelasticLattice:
    """An insert of springs and dampers under a rigid femoral component, step by step.

    Limits: linear (small strain, no yield), frictionless, Poisson's ratio constant: modulus and
    compressibility relax alike.

    Args:
        model: the linear lattice, with its resolution.
        pair: both bodies; the material's modulus is the instantaneous one, M_0.
        series: how every spring relaxes.

    Attributes:
        points: (c, 3) m, contact nodes, undeformed.
    """

    def __init__(self, model: LinearLattice, pair: ContactPair, series: PronySeries) -> None:
        self._series, self._settings = series, model.settings
        self._state = model.prepare(pair)
        self.points = self._state.problem.surface_points
        self._moved = np.zeros_like(self.points)
        self._memory = np.zeros((len(series.times), *self.points.shape))

    def press(self, load: float, pose: Array, step: float) -> ViscoelasticContact:
        """Go on by `step` s to a load (N along -y) at a pose whose y is free.

        Raises:
            InputError: a load that cannot be, or the femoral component is not over the insert.
            ComputationError: the contact does not converge.
        """
        check_load(load)
        return self._step(load, pose, step)

    def hold(self, pose: Array, step: float) -> ViscoelasticContact:
        """Go on by `step` s to a pose (4, 4); see `press`."""
        return self._step(None, pose, step)

    def _step(self, load: float | None, pose: Array, step: float) -> ViscoelasticContact:
        if not step > 0:
            raise InputError(f"a step of {step:g} s", "viscoelastic", "give seconds above 0")
        slope, decay, weights = self._series.response(step)
        relaxed = np.tensordot(decay, self._memory, 1) - weights.sum() * self._moved
        pose, force = self._contact(load, np.array(pose, float), slope, -relaxed / slope)
        problem = self._state.problem
        applied = np.zeros_like(problem.solid.nodes)
        applied[problem.contact_nodes] = force
        elastic = problem.operator.solve(applied)[problem.contact_nodes]
        displacement = (elastic - relaxed) / slope
        change = np.multiply.outer(weights, displacement - self._moved)
        self._memory = (self._memory.T * decay).T + change
        self._moved = displacement
        pressure = np.linalg.norm(force, axis=1) / self._state.surface.area
        return ViscoelasticContact(pose, pressure, force, displacement)

    def _contact(
        self, load: float | None, pose: Array, slope: float, offset: Array
    ) -> tuple[Array, Array]:
        """Return the pose and the forces (c, 3) N of a step.

        Args:
            load: N; None: the pose is given.
            pose: (4, 4).
            slope: stiffness of the springs over a step, relative to the instantaneous one.
            offset: (c, 3) m, displacement of the nodes without contact forces.
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
        rest: tuple[Array, TangentPlanes],
        slope: float,
        offset: Array,
    ) -> Solution:
        """Solve with growing sets of candidates until they cover the approach."""
        (gaps, planes), state = rest, self._state
        sunk = -float(offset[:, 1].min())  # crept nodes lie deeper than their gaps
        depth = -float(gaps.min())
        if load is not None:
            depth = guessed_depth(state.problem, gaps, state.surface.area, load / slope) + sunk
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
    """Return the initial guess of the solver on softer, already displaced springs."""
    response = replace(guess.response, compliance=guess.response.compliance / np.float32(slope))
    return replace(guess, response=response, offset=offset[guess.candidates])
