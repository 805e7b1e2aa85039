"""Stress-strain laws."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tkamb.contact.materials import MATERIALS, RambergOsgood, material, tabulated_material
from tkamb.errors import InputError

STRAIN = np.concatenate([[0.0], np.logspace(-12, 1, 400)])


def test_ramberg_osgood_is_inverted_to_rounding():
    polyethylene = material("polyethylene")
    ratio = polyethylene.stress(STRAIN) / 561.5e6
    power = 0.0389 * (polyethylene.stress(STRAIN) / 8.4194e6) ** 3.5485
    assert np.allclose(ratio * (1 + power), STRAIN, rtol=5e-15, atol=0)


def test_polyethylene_yields_at_the_published_stress():
    """At sigma0 = 8.4194 MPa the strain is (1 + alpha) sigma0/E."""
    strain = 8.4194 / 561.5 * 1.0389
    assert material("polyethylene").stress(strain) == pytest.approx(8.4194e6, rel=1e-12)


@pytest.mark.parametrize("name", sorted(MATERIALS))
def test_curves_are_odd_and_start_with_young_s_modulus(name):
    chosen = material(name)
    assert np.array_equal(chosen.stress(-STRAIN), -chosen.stress(STRAIN))
    assert np.array_equal(chosen.tangent(-STRAIN), chosen.tangent(STRAIN))
    assert chosen.tangent(0.0) == chosen.secant(0.0) == chosen.young_modulus
    assert np.isnan(chosen.stress(np.nan))


def tabulated():
    return tabulated_material("measured", [0, 0.01, 0.03, 0.06], [0, 5e6, 11e6, 14e6], 0.45)


@pytest.mark.parametrize("make", [*(lambda n=n: material(n) for n in sorted(MATERIALS)), tabulated])
def test_tangent_is_the_derivative(make):
    chosen = make()
    strain = np.array([-0.2, -0.05, -0.003, 1e-5, 0.004, 0.02, 0.055, 0.3])
    step = 1e-6
    slope = (chosen.stress(strain + step) - chosen.stress(strain - step)) / (2 * step)
    assert np.allclose(chosen.tangent(strain), slope, rtol=1e-5)


def test_a_table_is_interpolated_monotonically_and_continued_straight():
    chosen = tabulated()
    assert np.allclose(chosen.stress([0.01, 0.03, 0.06, -0.03]) / 1e6, [5, 11, 14, -11])
    assert (np.diff(chosen.stress(np.linspace(-0.2, 0.2, 999))) > 0).all()
    beyond = chosen.stress([0.06, 0.1, 0.14])
    assert np.diff(beyond, 2) == pytest.approx(0, abs=1)


def test_changed_young_modulus_scales_the_linear_part():
    soft = material("polyethylene", young_modulus=300e6, poisson_ratio=0.4)
    assert soft.tangent(0.0) == 300e6
    assert soft.shear_modulus == pytest.approx(300e6 / 2.8)
    assert soft.bulk_modulus == pytest.approx(300e6 / 0.6)
    assert soft.confined_modulus == pytest.approx(soft.bulk_modulus + 4 / 3 * soft.shear_modulus)


@given(
    alpha=st.floats(0, 10),
    exponent=st.floats(1, 30),
    reference=st.floats(1e5, 1e9),
    strain=st.floats(-2, 2),
)
def test_any_ramberg_osgood_law_is_inverted(alpha, exponent, reference, strain):
    law = RambergOsgood(alpha, reference, exponent)
    stress = float(law.stress(np.asarray(strain), 5e8))
    share = alpha * (abs(stress) / reference) ** (exponent - 1)
    assert stress / 5e8 * (1 + share) == pytest.approx(strain, rel=1e-12, abs=1e-300)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: material("steel"), "there are: polyethylene"),
        (lambda: material("polyethylene-linear", alpha=1.0), "has no 'alpha'"),
        (lambda: material("polyethylene", young_modulus=-1.0), "Young"),
        (lambda: material("polyethylene", young_modulus=float("nan")), "Young"),
        (lambda: material("polyethylene", poisson_ratio=0.5), "Poisson"),
        (lambda: material("polyethylene", exponent=0.5), "Ramberg-Osgood"),
        (lambda: tabulated_material("t", [0, 0.1], [0, -1.0], 0.4), "stress-strain table"),
        (lambda: tabulated_material("t", [0.1, 0.2], [1.0, 2.0], 0.4), "stress-strain table"),
        (lambda: tabulated_material("t", [0, 0.1, 0.1], [0, 1.0, 2.0], 0.4), "table"),
    ],
)
def test_bad_materials_are_input_errors(call, words):
    with pytest.raises(InputError, match=words):
        call()
