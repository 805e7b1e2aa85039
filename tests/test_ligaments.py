"""Ligament laws, slack lengths from a reference strain, and equal and opposite forces."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import trimesh
from pydantic import ValidationError

from tkamb.errors import InputError
from tkamb.geometry.frames import inverse, knee_pose
from tkamb.geometry.surface import Surface
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import load_case
from tkamb.io.scene.parts import ligament
from tkamb.io.scene.tables import LigamentTable
from tkamb.knee.ligament_laws import (
    TOE_STRAIN,
    LigamentLaw,
    QuadraticToe,
    StackedLaws,
    TwoLine,
    law_name,
    ligament_law,
)
from tkamb.knee.ligaments import (
    Ligament,
    build_ligaments,
    condylar_axis,
    generic_ligaments,
    ligament_loads,
    strain_table,
)
from tkamb.knee.load import LinkPoint, total_wrench

SLACK = 0.05
FLEXION = np.deg2rad(np.arange(0.0, 101.0, 5.0))
POSES = {
    "femur": knee_pose(np.column_stack([np.zeros((len(FLEXION), 5)), FLEXION])),
    "tibia": np.eye(4),
}


def bundle_of(**changes: object) -> Ligament:
    content = {
        "name": "MCL_anterior",
        "proximal": {"link": "femur", "point_mm": (5.0, 10.0, -40.0)},
        "distal": {"link": "tibia", "point_mm": (10.0, -60.0, -25.0)},
        "law": "two-line",
        "stiffness_N_per_mm": 90.0,
        "reference_strain": 0.04,
    }
    return ligament(LigamentTable.model_validate({**content, **changes}))


@pytest.mark.parametrize(
    ("law", "stiffness", "terminal"),
    [(TwoLine, 9e4, 9e4 * SLACK), (QuadraticToe, 2750.0, 2750.0)],
)
def test_laws(law: type, stiffness: float, terminal: float) -> None:
    """A slack ligament has no tension. Both branches meet at twice the toe strain."""
    strain = np.array(
        [
            -0.5,
            0.0,
            2 * TOE_STRAIN * (1 - 1e-12),
            2 * TOE_STRAIN * (1 + 1e-12),
            0.1,
        ]
    )
    lengths = SLACK * (1 + strain)
    force = law(stiffness).tension(lengths, SLACK)
    assert force[0] == 0.0
    assert force[1] == 0.0
    assert force[2] == pytest.approx(force[3], rel=1e-9)
    assert force[2] == pytest.approx(terminal * TOE_STRAIN)
    assert (force[4] - force[3]) / (0.1 - 2 * TOE_STRAIN) == pytest.approx(terminal)


@dataclass(frozen=True)
class Cubic(LigamentLaw):
    """A law of another package."""

    unit = "N per strain"
    words, source = "F = k eps^3", "a test"
    offset: float = 0.0

    def tension(self, length, slack_length):
        return self.stiffness * np.maximum(np.asarray(length) / slack_length - 1.0, 0.0) ** 3

    def slope(self, length, slack_length):
        strain = np.maximum(np.asarray(length) / slack_length - 1.0, 0.0)
        return 3.0 * self.stiffness * strain**2 / slack_length


LAWS = [TwoLine(9e4), Cubic(5e5), QuadraticToe(2750.0), TwoLine(4e4), Cubic(2e5, 1.0)]


@pytest.mark.parametrize("law", LAWS)
def test_the_slope_of_a_law_is_the_derivative_of_its_tension(law: LigamentLaw) -> None:
    lengths, h = SLACK * (1 + np.array([-0.1, 0.01, 0.05, 0.07, 0.2])), 1e-8
    slope = (law.tension(lengths + h, SLACK) - law.tension(lengths - h, SLACK)) / (2 * h)
    np.testing.assert_allclose(law.slope(lengths, SLACK), slope, rtol=1e-5)
    # A larger knee of the same tissue: size squared times the tension at the same strain.
    larger = law.scaled(1.2).tension(1.2 * lengths, 1.2 * SLACK)
    np.testing.assert_allclose(larger, 1.44 * law.tension(lengths, SLACK), rtol=1e-12)


def test_laws_together_are_those_of_each_bundle() -> None:
    slack = SLACK * np.linspace(0.9, 1.1, len(LAWS))
    length = slack * np.array([[1.05], [1.10]])
    stacked = StackedLaws.of(LAWS)
    for name in ("tension", "slope"):
        single = [getattr(law, name)(length[:, k], slack[k]) for k, law in enumerate(LAWS)]
        np.testing.assert_array_equal(getattr(stacked, name)(length, slack), np.array(single).T)


def test_laws_are_found_by_name_and_impossible_numbers_are_refused() -> None:
    assert ligament_law("two-line", 9e4) == TwoLine(stiffness=9e4)
    assert law_name(QuadraticToe(1.0)) == "quadratic-toe" and law_name(Cubic(1.0)) == "Cubic"
    with pytest.raises(InputError, match=r"no ligament law 'two-lines'; did you mean two-line\?"):
        ligament_law("two-lines", 9e4)
    with pytest.raises(InputError, match=r"stiffness -3.0; give .* above 0, in N/m"):
        TwoLine(-3.0)
    ends = LinkPoint("femur", np.zeros(3)), LinkPoint("tibia", np.ones(3))
    with pytest.raises(InputError, match=r"'linear' is no law; .*two-line, quadratic-toe"):
        Ligament("MCL", *ends, "linear")
    with pytest.raises(InputError, match=r"TwoLine\(stiffness=...\), stiffness in N/m"):
        Ligament("MCL", *ends, "two-line")
    with pytest.raises(ValidationError, match="no ligament law 'linear'"):
        bundle_of(law="linear")


def test_quadratic_toe_has_no_kink() -> None:
    e, h = 2 * TOE_STRAIN, 1e-7
    f = QuadraticToe(1.0).tension(SLACK * (1 + np.array([e - h, e, e + h])), SLACK)
    assert (f[1] - f[0]) / h == pytest.approx((f[2] - f[1]) / h, rel=1e-4)


def test_reference_strain_holds_at_the_reference_frame() -> None:
    (bundle,) = build_ligaments([bundle_of(reference_flexion_deg=31.0)], POSES, FLEXION)
    strain = bundle.strain(bundle.length(POSES))
    assert strain[6] == pytest.approx(0.04)
    assert np.ptp(strain) > 0.01


def test_forces_are_equal_and_opposite() -> None:
    (bundle,) = build_ligaments([bundle_of()], POSES, FLEXION)
    (tension,), loads = ligament_loads([bundle], {"femur": POSES["femur"][0], "tibia": np.eye(4)})
    assert tension == pytest.approx(0.5 * 9e4 * 0.04 * bundle.slack_length)
    assert np.abs(total_wrench(loads, np.array([0.3, 0.1, 0.2]))).max() < 1e-12 * tension
    assert loads[0].forces[0, 1] < 0.0  # the femur is pulled down


def test_gathered_loads_are_those_of_the_bundles() -> None:
    toe = {"law": "quadratic-toe", "stiffness_N_per_mm": None, "stiffness_N_per_strain": 2750.0}
    tables = [
        bundle_of(),
        bundle_of(name="LCL", **toe),
        bundle_of(name="slack", reference_strain=-0.1),
    ]
    bundles = build_ligaments(tables, POSES, FLEXION)
    poses = {"femur": POSES["femur"][0], "tibia": np.eye(4)}
    tension, loads = ligament_loads(bundles, poses)
    single_loads = [ligament_loads([bundle], poses) for bundle in bundles]
    assert tension == pytest.approx(
        [float(bundle.force(bundle.length(poses))) for bundle in bundles]
    )
    assert tension[2] == 0.0
    assert len(loads) == 2
    for load in loads:
        parts = [part for _, pair in single_loads for part in pair if part.link == load.link]
        point = np.array([0.1, 0.2, 0.3])
        assert total_wrench([load], point) == pytest.approx(total_wrench(parts, point))


def test_slack_length_is_taken_as_given() -> None:
    (bundle,) = build_ligaments(
        [bundle_of(reference_strain=None, slack_length_mm=80.0)], POSES, FLEXION
    )
    assert bundle.slack_length == pytest.approx(0.08)


def test_strain_table_shows_what_was_not_reached() -> None:
    bundles = build_ligaments([bundle_of()], POSES, FLEXION[:14])
    strains = strain_table(
        bundles, {"femur": POSES["femur"][:14], "tibia": np.eye(4)}, FLEXION[:14]
    )
    assert strains["MCL_anterior"][0] == pytest.approx(0.04)
    assert np.isfinite(strains["MCL_anterior"][1])
    assert np.isnan(strains["MCL_anterior"][2])


def test_unknown_link_is_one_clear_line() -> None:
    with pytest.raises(InputError, match="fibula") as error:
        build_ligaments(
            [bundle_of(distal={"link": "fibula", "point_mm": (0, 0, 0)})], POSES, FLEXION
        )
    assert "MCL_anterior" in str(error.value)


def cylinder(radius: float, width: float) -> Surface:
    mesh = trimesh.creation.cylinder(radius, width, sections=180)
    mesh.apply_translation([0.004, -0.002, 0.001])
    return Surface(np.asarray(mesh.vertices), np.asarray(mesh.faces), "femoral")


def slab(width: float) -> Surface:
    mesh = trimesh.creation.box(extents=(0.05, 0.01, width))
    return Surface(np.asarray(mesh.vertices), np.asarray(mesh.faces), "insert")


def test_condylar_axis_is_the_circles_centre() -> None:
    axis = condylar_axis(cylinder(0.02, 0.07))
    assert axis == pytest.approx([0.004, -0.002, 0.001], abs=5e-6)


def test_generic_set_scales_with_the_implant() -> None:
    """An implant of twice the size has twice the distances and the same strains."""
    small = generic_ligaments(cylinder(0.02, 0.07), slab(0.075), np.eye(4), ("MCL", "LCL"))
    large = generic_ligaments(cylinder(0.04, 0.14), slab(0.15), np.eye(4), ("MCL", "LCL"))
    assert [bundle.name for bundle in small] == [
        "generic_MCL_anterior",
        "generic_MCL_oblique",
        "generic_MCL_deep",
        "generic_LCL",
    ]
    axis = condylar_axis(cylinder(0.02, 0.07))
    for first, second in zip(small, large, strict=True):
        reach = first.proximal.position - axis
        assert second.proximal.position - axis == pytest.approx(2 * reach, abs=1e-5)
        assert second.distal.position == pytest.approx(2 * first.distal.position)
    with pytest.raises(InputError, match="ITB"):
        generic_ligaments(cylinder(0.02, 0.07), slab(0.075), np.eye(4), ("ITB",))


def test_generic_ends_scale_with_the_half_width_of_their_part() -> None:
    """The deep MCL ends at the insert's medial edge, the LCL beyond the lateral one."""
    bundles = {
        bundle.name.removeprefix("generic_"): bundle
        for bundle in generic_ligaments(cylinder(0.02, 0.07), slab(0.075), np.eye(4))
    }
    assert bundles["MCL_deep"].distal.position[2] == pytest.approx(-0.0375)
    assert bundles["LCL"].distal.position[2] == pytest.approx(1.10 * 0.0375)
    middle = 0.001  # of the component's width
    assert bundles["MCL_anterior"].proximal.position[2] - middle == pytest.approx(-1.20 * 0.035)


def test_generic_set_is_plausible_on_the_shipped_knee() -> None:
    """Collateral strains stay within 12 % from 0 to 90 deg, and the PCL tightens with flexion."""
    case = load_case(
        load_scene(Path(__file__).parents[1] / "models" / "deep_knee_bend" / "scene.toml")
    )
    assert case.femoral is not None
    assert case.insert is not None
    frame = case.chain.insert_in_tibia
    generic = generic_ligaments(case.femoral, case.insert, frame)
    poses = {"femur": knee_pose(case.motion.coordinates), "tibia": inverse(frame)}
    flexion = case.motion.coordinates[:, 5]
    strains = strain_table(build_ligaments(generic, poses, flexion), poses, flexion)
    for name, values in strains.items():
        assert np.isfinite(values).all()
        if "CL_" not in name or "MCL" in name:
            assert np.abs(values).max() < 0.12
    assert strains["generic_PCL_anterolateral"][2] > strains["generic_PCL_anterolateral"][0] + 0.1
