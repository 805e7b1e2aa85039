"""The patch test with uniform strain, rigid modes and spring stiffnesses of the cells."""

import numpy as np
import pytest
import scipy.sparse.linalg as linalg

from lattice_blocks import block, uniform_strain
from tkamb.contact.lattice.bbar import BbarHexahedra
from tkamb.contact.lattice.calibrated import (
    CalibratedNetwork,
    body_diagonal_stiffness,
    box_corners,
    deviatoric_matrices,
    spring_families,
    spring_matrix,
)
from tkamb.contact.lattice.meshing.cells import PAIRS, gauss_gradients, mean_gradient
from tkamb.contact.lattice.solid import DEVIATORIC, strain_matrix
from tkamb.contact.lattice.source_springs import SourceNetwork, source_factor
from tkamb.contact.materials import Material

MM = 1e-3
RATIOS = [0.0, 0.25, 0.35, 0.45, 0.49, 0.4999]
BOXES = [(1.0, 1.0, 1.0), (1.0, 1.2, 0.9), (1.0, 1.4, 1.2), (1.4, 1.0, 1.4)]
STRAIN = np.array([0.7, -1.1, 0.4, 0.3, -0.5, 0.6]) * 1e-3


def material(nu):
    return Material("m", 561.5e6, nu)


def cell_of(corners, edges):
    """Return K_d (s, 24, 24), g (s, 24) and V (s,) of cells with these corners."""
    gradients, volume = mean_gradient(corners)
    springs = spring_families(edges, body_diagonal_stiffness(edges))
    matrices = deviatoric_matrices(corners, gradients, volume, springs, PAIRS)
    return matrices, gradients.reshape(-1, 24), volume


def sheared(edges, count=20):
    """Return corners (count, 8, 3) of boxes, moved at random."""
    corners = np.repeat(box_corners(edges)[None], count, axis=0)
    return corners + np.random.default_rng(5).normal(size=corners.shape) * 0.1 * edges.min()


def test_the_compiled_stiffness_agrees_with_its_formula():
    """K_d = V Bᵀ (2 I_dev) B + Pᵀ K_spr P is evaluated with matrices for sheared cells."""
    edges = np.array([1.0, 1.2, 0.9]) * MM
    corners = sheared(edges)
    at_points, weights = gauss_gradients(corners)
    volume = weights.sum(axis=1)
    gradients = np.einsum("cp,cpni->cni", weights, at_points) / volume[:, None, None]
    strain = strain_matrix(gradients)
    mean = volume[:, None, None] * (np.swapaxes(strain, 1, 2) @ DEVIATORIC @ strain)
    projection = np.eye(8) - corners @ np.swapaxes(gradients, 1, 2)
    projection = np.stack([np.kron(matrix, np.eye(3)) for matrix in projection])
    springs = spring_matrix(corners, spring_families(edges, body_diagonal_stiffness(edges)))
    matrices, g, v = cell_of(corners, edges)
    assert v == pytest.approx(volume, rel=1e-12)
    assert g == pytest.approx(gradients.reshape(-1, 24), rel=1e-9, abs=1e-12 / MM)
    exact = mean + np.swapaxes(projection, 1, 2) @ springs @ projection
    assert np.abs(matrices - exact).max() < 1e-12 * np.abs(exact).max()


@pytest.mark.parametrize("nu", [0.3, 0.4999])
@pytest.mark.parametrize("kind", [CalibratedNetwork, BbarHexahedra])
def test_forces_summed_cell_by_cell_are_those_of_the_assembled_stiffness(kind, nu):
    edges = np.array([1.0, 1.2, 0.9]) * MM
    nodes, _, cells, _ = block((3, 2, 3), edges, 0.3)
    solid = kind(nodes, cells, edges, material(nu))
    u = np.random.default_rng(6).normal(size=nodes.shape)
    force = solid.stiffness @ u.ravel()
    error = np.abs(solid.linear_force(u).ravel() - force).max()
    assert error < 1e-7 * np.abs(force).max()


def boundary_of(index):
    """Return the mask of nodes on the boundary of a block."""
    return ((index == 0) | (index == index.max(axis=0))).any(axis=1)


@pytest.mark.parametrize("kind", [CalibratedNetwork, BbarHexahedra])
@pytest.mark.parametrize("nu", RATIOS)
@pytest.mark.parametrize("edges", BOXES)
def test_free_uniaxial_patch_is_exact_on_boxes(kind, nu, edges):
    """With free sides, the only forces are E eps A on the two ends."""
    nodes, index, cells, _ = block((3, 2, 3), np.array(edges) * MM)
    solid = kind(nodes, cells, np.array(edges) * MM, material(nu))
    u = uniform_strain(nodes, [-nu * 1e-3, 1e-3, -nu * 1e-3, 0, 0, 0])
    force = (solid.stiffness @ u.ravel()).reshape(-1, 3)
    area = np.prod((np.ptp(nodes, axis=0))[[0, 2]])
    scale = 561.5e6 * 1e-3 * area
    top = index[:, 1] == index[:, 1].max()
    ends = top | (index[:, 1] == 0)
    assert abs(force[top, 1].sum() / scale - 1) < 1e-10
    assert np.abs(force[~ends]).max() < 1e-10 * scale
    assert np.abs(force[ends][:, [0, 2]]).max() < 1e-10 * scale


@pytest.mark.parametrize("kind", [CalibratedNetwork, BbarHexahedra])
@pytest.mark.parametrize("nu", RATIOS)
@pytest.mark.parametrize("stretch", [0.0, 0.8])
@pytest.mark.parametrize("size", [0.25, 1.0, 4.0])
def test_patch_reproduces_any_uniform_strain(kind, nu, stretch, size):
    """With prescribed displacements on the boundary, inner nodes follow, also in sheared cells."""
    edges = np.array([1.0, 1.1, 0.9]) * size * MM
    nodes, index, cells, _ = block((4, 3, 4), edges, stretch)
    solid = kind(nodes, cells, edges, material(nu))
    exact = uniform_strain(nodes, STRAIN)
    held = np.repeat(boundary_of(index), 3)
    k = solid.stiffness
    inner = linalg.spsolve(k[~held][:, ~held].tocsc(), -k[~held][:, held] @ exact.ravel()[held])
    assert np.abs(inner - exact.ravel()[~held]).max() < 1e-10 * np.abs(exact).max()


@pytest.mark.parametrize("nu", RATIOS)
@pytest.mark.parametrize("edges", BOXES)
@pytest.mark.parametrize("shear", [0.0, 0.4])
def test_cell_has_six_rigid_modes_and_no_other(nu, edges, shear):
    """Six eigenvalues are zero, and the other eighteen are well above zero."""
    edges = np.array(edges) * MM
    corners = box_corners(edges)[None].copy()
    corners[0, [2, 3, 6, 7], 1] += shear * edges[1] * np.array([1.0, 0.0, 0.6, 0.3])
    deviatoric, g, volume = cell_of(corners, edges)
    m = material(nu)
    k = m.shear_modulus * deviatoric[0] + m.bulk_modulus * volume[0] * np.outer(g[0], g[0])
    values = np.linalg.eigvalsh(k) / (m.shear_modulus * edges.mean())
    assert np.abs(values[:6]).max() < 1e-9
    assert values[6] > 0.1


@pytest.mark.parametrize("edges", BOXES)
def test_springs_alone_are_the_isotropic_solid_with_lambda_equal_mu(edges):
    """This holds for any body diagonal. With the default one no spring is negative."""
    edges = np.array(edges)
    default = body_diagonal_stiffness(edges)
    for body in (0.0, 0.5 * default, default):
        k = spring_matrix(box_corners(edges)[None], spring_families(edges, body))[0]
        u = uniform_strain(box_corners(edges), STRAIN).ravel()
        e = STRAIN
        trace, square = e[:3].sum(), (e[:3] ** 2).sum() + 2 * (e[3:] ** 2).sum()
        assert u @ k @ u == pytest.approx(np.prod(edges) * (trace**2 + 2 * square), rel=1e-12)
    assert spring_families(edges, default).min() >= 0


def test_stiffness_of_a_box_is_that_of_its_springs_without_bulk():
    """This holds for forces under normal strain, and for the energy of every uniform strain."""
    edges = np.array([1.0, 1.2, 0.9])
    k_b = body_diagonal_stiffness(edges)
    deviatoric, g, volume = cell_of(box_corners(edges)[None], edges)
    springs = spring_matrix(box_corners(edges)[None], spring_families(edges, k_b))[0]
    springs -= 5 / 3 * volume[0] * np.outer(g[0], g[0])
    u = uniform_strain(box_corners(edges), [1, 2, 3, 0, 0, 0]).ravel()
    assert deviatoric[0] @ u == pytest.approx(springs @ u, abs=1e-12)
    u = uniform_strain(box_corners(edges), STRAIN).ravel()
    assert u @ deviatoric[0] @ u == pytest.approx(u @ springs @ u, rel=1e-12)


def test_source_calibration_on_a_cube():
    """k = E a/2.7 on a cube of edge a."""
    assert source_factor(np.full(3, 1.5 * MM)) == pytest.approx(1.5 * MM / 2.7, rel=1e-12)


@pytest.mark.parametrize(("count", "excess"), [(2, 0.78), (4, 0.36), (8, 0.18), (12, 0.12)])
def test_source_lattice_is_too_stiff_with_free_sides(count, excess):
    """The excess stiffness of a cube between frictionless plates falls with more cells."""
    nodes, index, cells, springs = block((count,) * 3, np.full(3, MM))
    solid = SourceNetwork(nodes, cells, np.full(3, MM), material(0.35), springs)
    top, bottom = index[:, 1] == count, index[:, 1] == 0
    held = np.zeros((len(nodes), 3), bool)
    held[top | bottom, 1] = True
    held[index[:, 0] * 2 == count, 0] = True
    held[index[:, 2] * 2 == count, 2] = True
    u = np.zeros((len(nodes), 3))
    u[top, 1] = -1e-3 * count * MM
    fixed = held.ravel()
    k = solid.stiffness
    u.ravel()[~fixed] = linalg.spsolve(
        k[~fixed][:, ~fixed].tocsc(), -k[~fixed][:, fixed] @ u.ravel()[fixed]
    )
    reaction = -(k @ u.ravel()).reshape(-1, 3)[top, 1].sum()
    exact = 561.5e6 * 1e-3 * (count * MM) ** 2
    assert reaction / exact - 1 == pytest.approx(excess, abs=0.015)
