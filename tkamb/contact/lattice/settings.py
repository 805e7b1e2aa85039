"""The settings of the lattice's contact solver."""

from dataclasses import dataclass


@dataclass(frozen=True)
class LatticeSolverSettings:
    """When the contact iteration stops, and what it may leave out."""

    force_tolerance: float = 2e-3
    """Largest residual force of the displaced solid, relative to the contact forces (Euclidean
    norms over the free unknowns). Smaller: more passes. The factor in 16-bit integers leaves up
    to 1e-3 spread over the whole solid, which moves an approach by 1e-7 of itself; so it is no
    smaller than twice that."""
    work_tolerance: float = 3e-4
    """Largest work of the residual force on the displacement, relative to the work of the contact
    forces, times the softening: an estimate of the relative error of the approach (the energy
    criterion of Bathe & Cimento, J Struct Div ASCE 106:1377, 1980). Smaller: more passes, mostly
    under heavy loads. Measured errors are half of it."""
    gap_tolerance: float = 2.5e-4
    """Largest distance of an active node from the femoral surface, relative to the largest
    displacement of an active node. At a rim, where the normal turns, a peak is off by up to three
    times as much. The last pass accepts four times as much."""
    max_passes: int = 40
    """Passes before the solution counts as not converged; knees take 1 to 8."""
    anderson_depth: int = 6
    """Differences that Anderson's method keeps. More: fewer passes of a softened contact, more
    memory."""
    region_tolerance: float = 0.05
    """Residual force that elements outside of the region may add, relative to `force_tolerance`.
    Larger: cheaper passes, more measurements of the whole solid."""
    candidate_margin: float = 0.25
    """Share of the expected approach by which nodes beyond it are candidates for contact too.
    Larger: larger condensed systems, fewer solutions that are repeated."""
    max_expansions: int = 8
    """How often the candidates may be extended before the press has failed."""


LATTICE_SOLVER = LatticeSolverSettings()
