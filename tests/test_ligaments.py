"""Ligament laws, slack lengths from a reference strain, and equal and opposite forces."""

import numpy as np
import pytest

from tkamb.body.ligaments import (
    TOE_STRAIN,
    build_ligaments,
    quadratic_toe_force,
    strain_table,
    two_line_force,
)
from tkamb.body.load import total_wrench
from tkamb.errors import InputError
from tkamb.geometry.frames import knee_pose
from tkamb.scene import LigamentTable

SLACK = 0.05
FLEXION = np.deg2rad(np.arange(0.0, 101.0, 5.0))
POSES = {
    "femur": knee_pose(np.column_stack([np.zeros((len(FLEXION), 5)), FLEXION])),
    "tibia": np.eye(4),
}


def table(**changes: object) -> LigamentTable:
    content = {
        "name": "MCL_anterior",
        "proximal": {"link": "femur", "point_mm": (5.0, 10.0, -40.0)},
        "distal": {"link": "tibia", "point_mm": (10.0, -60.0, -25.0)},
        "law": "two-line",
        "stiffness_N_per_mm": 90.0,
        "reference_strain": 0.04,
    }
    return LigamentTable.model_validate({**content, **changes})


@pytest.mark.parametrize(
    ("law", "stiffness", "terminal"),
    [(two_line_force, 9e4, 9e4 * SLACK), (quadratic_toe_force, 2750.0, 2750.0)],
)
def test_laws(law: object, stiffness: float, terminal: float) -> None:
    """Slack carries nothing, both branches meet at 2 eps1, the terminal slope is k."""
    strain = np.array([-0.5, 0.0, 2 * TOE_STRAIN * (1 - 1e-12), 2 * TOE_STRAIN * (1 + 1e-12), 0.1])
    force = law(SLACK * (1 + strain), SLACK, stiffness)
    assert force[0] == 0.0
    assert force[1] == 0.0
    assert force[2] == pytest.approx(force[3], rel=1e-9)
    assert force[2] == pytest.approx(terminal * TOE_STRAIN)
    assert (force[4] - force[3]) / (0.1 - 2 * TOE_STRAIN) == pytest.approx(terminal)


def test_quadratic_toe_has_no_kink() -> None:
    e, h = 2 * TOE_STRAIN, 1e-7
    f = quadratic_toe_force(SLACK * (1 + np.array([e - h, e, e + h])), SLACK, 1.0)
    assert (f[1] - f[0]) / h == pytest.approx((f[2] - f[1]) / h, rel=1e-4)


def test_reference_strain_holds_at_the_reference_frame() -> None:
    (bundle,) = build_ligaments([table(reference_flexion_deg=31.0)], POSES, FLEXION)
    strain = bundle.strain(bundle.length(POSES))
    assert strain[6] == pytest.approx(0.04)
    assert np.ptp(strain) > 0.01


def test_forces_are_equal_and_opposite() -> None:
    (bundle,) = build_ligaments([table()], POSES, FLEXION)
    tension, loads = bundle.loads({"femur": POSES["femur"][0], "tibia": np.eye(4)})
    assert tension == pytest.approx(0.5 * 9e4 * 0.04 * bundle.slack_length)
    assert np.abs(total_wrench(loads, np.array([0.3, 0.1, 0.2]))).max() < 1e-12 * tension
    assert loads[0].forces[0, 1] < 0.0  # the femur is pulled down


def test_slack_length_is_taken_as_given() -> None:
    (bundle,) = build_ligaments(
        [table(reference_strain=None, slack_length_mm=80.0)], POSES, FLEXION
    )
    assert bundle.slack_length == pytest.approx(0.08)


def test_strain_table_shows_what_was_not_reached() -> None:
    bundles = build_ligaments([table()], POSES, FLEXION[:14])
    strains = strain_table(
        bundles, {"femur": POSES["femur"][:14], "tibia": np.eye(4)}, FLEXION[:14]
    )
    assert strains["MCL_anterior"][0] == pytest.approx(0.04)
    assert np.isfinite(strains["MCL_anterior"][1])
    assert np.isnan(strains["MCL_anterior"][2])


def test_unknown_link_is_one_clear_line() -> None:
    with pytest.raises(InputError, match="fibula") as error:
        build_ligaments([table(distal={"link": "fibula", "point_mm": (0, 0, 0)})], POSES, FLEXION)
    assert "MCL_anterior" in str(error.value)
