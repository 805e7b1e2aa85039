"""Muscles in the viewer: their lines and colours."""

from dataclasses import replace

import numpy as np

from knees import UP, bent_knee
from shared_trials import SHANK, THIGH, two_flexors
from tkamb.geometry.frames import transform
from tkamb.knee.load import PointForces
from tkamb.run.muscles.shared_muscles import SharedMuscles
from tkamb.show.view.drawing import SLACK, activation_scale, pressure_scale, rgb, strain_scale
from tkamb.show.view.lines import LEAST_ACTIVATION, SLACK_FORCE, muscle_strands


def frames():
    """Return the bent knee with active flexors, with slack ones, and without a solution."""
    ground = PointForces("tibia", np.array([[0.06, -0.45, 0.0]]), 700 * UP[None])
    knee = replace(bent_knee(), ground=ground)
    active, _ = SharedMuscles(two_flexors(1, least=0.0)).frame(0).solve(knee, 0.05)
    zero = 0.0 * active.share.force
    slack = replace(active, share=replace(active.share, force=zero, activation=zero))
    return [
        active,
        slack,
        replace(active, share=replace(active.share, status="failed: for a test")),
    ]


def test_lines_connect_shank_and_thigh_and_are_nan_without_a_solution():
    geometries = frames()
    strands, _ = muscle_strands(geometries)
    assert [strand.name for strand in strands] == ["hamstring", "gastrocnemius"]
    for k, strand in enumerate(strands):
        assert strand.layer == "muscles"
        start = transform(geometries[0].state.pose("tibia"), SHANK[k])
        end = transform(geometries[0].state.pose("femur"), THIGH[k])
        np.testing.assert_allclose(strand.points[:2], [[start, end]] * 2)
        assert np.isnan(strand.points[2]).all()


def test_colours_follow_the_activation_and_slack_muscles_are_grey():
    geometries = frames()
    strands, limit = muscle_strands(geometries)
    share = geometries[0].share
    assert share.force[1:].min() > SLACK_FORCE
    assert limit == max(share.activation[1:].max(), LEAST_ACTIVATION)
    for strand, activation in zip(strands, share.activation[1:], strict=True):
        wanted = activation_scale()[int(activation / limit * 255)]
        np.testing.assert_array_equal(strand.colours[0], [wanted, wanted])
        np.testing.assert_array_equal(strand.colours[1], [rgb(SLACK)] * 2)


def test_the_activation_scale_differs_from_other_scales_and_darkens():
    scale = activation_scale().astype(int)
    for other in (pressure_scale(), strain_scale(), rgb(SLACK)[None]):
        difference = np.abs(scale[:, None] - other[None].astype(int)).max(axis=2)
        assert difference.min() > 8
    light = scale @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(light) <= 0.5).all()
    assert light[0] - light[-1] > 100


def test_without_muscles_there_are_no_strands():
    assert muscle_strands([bent_knee()]) == ((), 0.0)
