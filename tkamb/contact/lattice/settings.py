"""The settings of the lattice's contact solver."""

from dataclasses import dataclass


@dataclass(frozen=True)
class LatticeSolverSettings:
    """When the contact iteration stops, and which elements and nodes it evaluates.

    A contact model's option `tolerance` multiplies the first four fields by `tolerance`/1e-3.
    """

    force_tolerance: float = 2e-3
    """1: largest residual force of the displaced solid, relative to the contact forces (Euclidean
    norms over the free unknowns). Above the rounding residual: if `tolerance` is 1e-3 or more, the
    factor is stored in 16-bit integers. Their rounding leaves a residual of 4e-4 (2 mm) to 1.2e-3
    (1 mm) on the shipped knee, which passes on the region cannot remove. The work of this residual
    is below 1e-5. Where it is above the tolerance (2.6e-3 at 16 kN and 1 mm), passes on the whole
    solid remove it.
    """
    work_tolerance: float = 3e-4
    """1: largest work of the residual force on the displacement, relative to the work of the
    contact forces, times the softening. It estimates the relative error of the approach (energy
    criterion of Bathe & Cimento, J Struct Div ASCE 106:1377, 1980). Measured: errors of the
    approach are half of it.
    """
    gap_tolerance: float = 2.5e-4
    """1: largest distance of an active node from the femoral surface, or penetration of another
    node, relative to the largest displacement of an active node. Measured: the error of a peak at a
    rim is up to three times the gap.
    """
    peak_tolerance: float = 1e-3
    """1: largest relative growth of the largest nodal force if the residual forces were added to
    the contact forces. It estimates the relative error of the peak pressure. Measured: the error of
    a peak is about this value.
    """
    max_passes: int = 40
    """Largest number of passes, and of steps of the full Newton iteration. Knees take 1 to 8
    passes.
    """
    anderson_depth: int = 6
    """Number of differences that Anderson's method uses. Larger: fewer passes of a softened
    contact, more memory.
    """
    region_tolerance: float = 0.05
    """1: residual force that elements outside of the region may add, relative to `force_tolerance`.
    Larger: faster passes, more measurements of the whole solid.
    """
    candidate_margin: float = 0.25
    """1: the femoral component meets the candidates within the expected approach plus this share of
    it. Larger: larger condensed systems, but fewer presses that are repeated with more candidates.
    """
    max_expansions: int = 8
    """Largest number of candidate sets, which grow while the approach of a press goes beyond them.
    Smaller: a press fails (out of range) if its expected approach was far too small.
    """


LATTICE_SOLVER = LatticeSolverSettings()
