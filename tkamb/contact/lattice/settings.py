"""The settings of the lattice's contact solver."""

from dataclasses import dataclass


@dataclass(frozen=True)
class LatticeSolverSettings:
    """When the contact iteration stops, and what it may leave out.

    A contact model's option `tolerance` multiplies the first three fields by `tolerance`/1e-3.
    """

    force_tolerance: float = 2e-3
    """1: largest residual force of the displaced solid, relative to the contact forces (Euclidean
    norms over the free unknowns). Smaller: more passes. Larger: fewer passes, nodal forces less
    accurate. The factor in 16-bit integers, kept for `tolerance` of 1e-3 or more, leaves a residual
    of up to 1e-3, spread over the whole solid. It moves an approach by 1e-7 of itself. The default
    is twice that."""
    work_tolerance: float = 3e-4
    """1: largest work of the residual force on the displacement, relative to the work of the
    contact forces, times the softening: an estimate of the relative error of the approach (the
    energy criterion of Bathe & Cimento, J Struct Div ASCE 106:1377, 1980). Smaller: more passes,
    mostly under heavy loads. Larger: fewer passes, the approach less accurate. Measured errors of
    the approach are half of it."""
    gap_tolerance: float = 2.5e-4
    """1: largest distance of an active node from the femoral surface (penetration of the others),
    relative to the largest displacement of an active node. Smaller: more passes where the femoral
    normal turns quickly. Larger: fewer passes, peaks at such places less accurate: at a rim a peak
    is off by up to three times the gap."""
    max_passes: int = 40
    """Passes, and steps of the full Newton iteration, after which each stops; knees take 1 to 8
    passes. Smaller: presses that converge slowly stop earlier, and take the slow full Newton
    iteration or end as not converged. Larger: more of them converge; a press that cannot converge
    takes longer. Presses that converge earlier do not change."""
    anderson_depth: int = 6
    """Differences that Anderson's method keeps. Smaller: more passes of a softened contact. Larger:
    fewer passes, more memory."""
    region_tolerance: float = 0.05
    """1: residual force that elements outside of the region may add, relative to `force_tolerance`.
    Smaller: a larger region, passes that take longer. Larger: cheaper passes, more measurements of
    the whole solid."""
    candidate_margin: float = 0.25
    """1: candidates are the nodes that the femoral component reaches at the expected approach plus
    this share of it. Smaller: more presses are repeated because too few nodes were candidates.
    Larger: larger condensed systems, fewer repetitions."""
    max_expansions: int = 8
    """Largest number of sets of candidates that are tried. A press whose approach reaches nodes
    that are no candidates is repeated with more of them. Smaller: a press whose expected approach
    was far too small fails (out of range). Larger: it is repeated more often first. Presses that
    need fewer sets do not change."""


LATTICE_SOLVER = LatticeSolverSettings()
