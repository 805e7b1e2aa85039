"""Nonlinear cells follow the material's curve, and their tangent is the derivative."""

import numpy as np
import pytest
import scipy.sparse.linalg as linalg

from lattice_blocks import block
from tkamb.contact.lattice.bbar import BbarHexahedra
from tkamb.contact.lattice.calibrated import CalibratedNetwork
from tkamb.contact.lattice.solid import ShearCurve
from tkamb.contact.lattice.source_springs import SourceNetwork
from tkamb.contact.materials import material, tabulated_material

MM = 1e-3
SOLIDS = [CalibratedNetwork, BbarHexahedra]
STRAINS = [-0.2, -0.1, -0.05, -0.02, -0.005, 0.005, 0.02, 0.05, 0.1, 0.2]
TABLE = tabulated_material(
    "table", [0, 0.01, 0.03, 0.08, 0.2, 0.4], [0, 5e6, 11e6, 17e6, 24e6, 33e6], 0.4
)


def pressed_block(kind, mat, strain, confined):
    """Return the mean axial stress of a block between frictionless plates."""
    nodes, index, cells, _ = block((2, 3, 2), np.array([1.0, 1.1, 0.9]) * MM)
    solid = kind(nodes, cells, np.array([1.0, 1.1, 0.9]) * MM, mat)
    held = np.zeros((len(nodes), 3), bool)
    top = index[:, 1] == index[:, 1].max()
    held[top | (index[:, 1] == 0), 1] = True
    sides = (0, 2)
    for axis in sides:
        held[(index[:, axis] == 0) | (confined & (index[:, axis] == 2)), axis] = True
    free = ~held.ravel()
    u = np.zeros((len(nodes), 3))
    u[top, 1] = strain * np.ptp(nodes[:, 1])
    for _ in range(60):
        force = solid.internal_force(u).ravel()
        step = linalg.spsolve(solid.tangent(u)[free][:, free].tocsc(), force[free])
        u.ravel()[free] -= step
        if np.abs(step).max() < 1e-14:
            break
    area = np.ptp(nodes[:, 0]) * np.ptp(nodes[:, 2])
    return solid.internal_force(u)[top, 1].sum() / area


@pytest.mark.parametrize("kind", SOLIDS)
@pytest.mark.parametrize("strain", STRAINS)
@pytest.mark.parametrize("nu", [0.0, 0.25, 0.45, 0.4999])
def test_free_block_follows_the_curve(kind, strain, nu):
    mat = material("polyethylene", poisson_ratio=nu)
    assert pressed_block(kind, mat, strain, False) == pytest.approx(mat.stress(strain), rel=1e-6)


@pytest.mark.parametrize("strain", [-0.15, -0.02, 0.06])
def test_free_block_follows_a_table(strain):
    stress = pressed_block(CalibratedNetwork, TABLE, strain, False)
    assert stress == pytest.approx(TABLE.stress(strain), rel=1e-4)


@pytest.mark.parametrize("kind", SOLIDS)
@pytest.mark.parametrize("strain", [-0.1, -0.02, 0.02])
@pytest.mark.parametrize("nu", [0.0, 0.45])
def test_confined_block_follows_bulk_and_curve(kind, strain, nu):
    """The stress is K eps + (2/3) q(2|eps|/3), with elastic bulk and shear by q(e)."""
    mat = material("polyethylene", poisson_ratio=nu)
    e = 2 * abs(strain) / 3
    q = 3 * ShearCurve.of(mat).modulus(np.array([e]))[0] * e
    exact = mat.bulk_modulus * strain + np.sign(strain) * 2 * q / 3
    assert pressed_block(kind, mat, strain, True) == pytest.approx(exact, rel=1e-7)


@pytest.mark.parametrize("strain", [0.003, 0.02, 0.08, 0.2, 0.4])
def test_shear_curve_gives_the_uniaxial_stress(strain):
    """q(e) = sigma at e = eps - sigma/(9 K)."""
    mat = material("polyethylene")
    sigma = mat.stress(strain)
    e = np.array([strain - sigma / (9 * mat.bulk_modulus)])
    assert 3 * ShearCurve.of(mat).modulus(e)[0] * e[0] == pytest.approx(sigma, rel=1e-8)


@pytest.mark.parametrize("kind", SOLIDS)
@pytest.mark.parametrize("stretch", [0.0, 0.6])
def test_tangent_is_the_derivative_of_the_forces(kind, stretch):
    edges = np.full(3, MM)
    nodes, _, cells, _ = block((3, 2, 2), edges, stretch)
    solid = kind(nodes, cells, edges, material("polyethylene"))
    generator = np.random.default_rng(4)
    u, d = generator.normal(size=(2, *nodes.shape)) * 3e-5
    numeric = (solid.internal_force(u + 1e-4 * d) - solid.internal_force(u - 1e-4 * d)) / 2e-4
    exact = (solid.tangent(u) @ d.ravel()).reshape(-1, 3)
    assert np.abs(numeric - exact).max() < 1e-6 * np.abs(exact).max()
    tangent = solid.tangent(u)
    assert abs(tangent - tangent.T).max() < 1e-12 * abs(tangent).max()


def test_force_of_a_stretched_source_spring_follows_the_curve():
    """The force is f = sigma(eps) C L0."""
    edges = np.full(3, MM)
    nodes, _, cells, springs = block((1, 1, 1), edges)
    mat = material("polyethylene")
    solid = SourceNetwork(nodes, cells, edges, mat, springs[:1])
    a, b = springs[0]
    u = np.zeros_like(nodes)
    u[b] = 0.07 * (nodes[b] - nodes[a])
    force = solid.internal_force(u)
    length = np.linalg.norm(nodes[b] - nodes[a])
    assert np.linalg.norm(force[b]) == pytest.approx(mat.stress(0.07) * solid.factor * length)
    assert force[a] == pytest.approx(-force[b])


def test_linear_material_has_no_nonlinear_residual():
    edges = np.full(3, MM)
    nodes, _, cells, _ = block((2, 2, 2), edges)
    for kind in SOLIDS:
        solid = kind(nodes, cells, edges, material("polyethylene-linear"))
        assert not solid.residual_force(np.ones_like(nodes)).any()
        assert not solid.nonlinear_residual(np.ones_like(nodes)).any()
