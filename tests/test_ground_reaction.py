"""Ground reaction: axes, centre of pressure, swing, left foot, and the unchanged wrench."""

import numpy as np
import pytest

from tkamb.errors import InputError
from tkamb.geometry.frames import MIRROR
from tkamb.io.recordings.ground_reaction import load_ground_reaction
from tkamb.io.recordings.recording_tables import GroundReactionTable

STAMPS = np.arange(2401) / 1200
AT = np.linspace(0.2, 1.8, 33)
NAMES = ["time", *(f"{what}_{k}" for what in ("force", "point", "moment") for k in (1, 2, 3))]


def step(t):
    """Return force, centre of pressure and vertical free moment (n, 3) of a step, 0.4 to 1.4 s."""
    on = np.clip((t - 0.4) / 1.0, 0, 1)
    load = np.sin(np.pi * on) ** 2
    force = np.stack([-60 * np.sin(2 * np.pi * on) * load, 700 * load, 30 * load], axis=1)
    point = np.stack([0.3 + 0.2 * on, np.full_like(t, 0.02), 0.1 + 0.03 * on], axis=1)
    return force, point, np.stack([0 * t, 5 * load, 0 * t], axis=1)


def write(path, force, point, moment, stamps=STAMPS):
    rows = np.column_stack([stamps, force, point, moment])
    lines = [",".join(NAMES), *(",".join(f"{v:.15g}" for v in row) for row in rows)]
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


def plate(file, **changes):
    return GroundReactionTable(**({"file": file, "length_unit": "m", "cutoff_Hz": 50.0} | changes))


def about_origin(reaction):
    return np.cross(reaction.point, reaction.force) + reaction.moment


def test_loaded_foot_is_reproduced(tmp_path):
    reaction = load_ground_reaction(plate(write(tmp_path / "g.csv", *step(STAMPS))), AT, "right")
    force, point, moment = step(AT)
    on = force[:, 1] > 100
    assert (reaction.loaded == (force[:, 1] >= 20)).all()
    np.testing.assert_allclose(reaction.force, force, atol=0.2)
    np.testing.assert_allclose(reaction.point[on], point[on], atol=1e-4)
    np.testing.assert_allclose(reaction.moment[on], moment[on], atol=0.02)
    np.testing.assert_allclose(reaction.moment[reaction.loaded][:, [0, 2]], 0, atol=1e-9)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("quantity", [0, 1, 2])
def test_an_infinite_cell_is_refused(tmp_path, quantity):
    measured = [values.copy() for values in step(STAMPS)]
    measured[quantity][7, 0] = np.inf
    with pytest.raises(InputError, match="line 9 holds 'inf', which is not finite"):
        load_ground_reaction(plate(write(tmp_path / "g.csv", *measured)), AT, "right")


def test_centres_of_pressure_of_an_unloaded_plate_have_no_influence(tmp_path):
    """Points of the swing phase may be wild, zero or missing."""
    force, point, moment = step(STAMPS)
    swing = force[:, 1] < 20
    results = []
    for garbage in (1e3, 0.0, np.nan):
        wild = point.copy()
        wild[swing] = garbage
        table = plate(write(tmp_path / "g.csv", force, wild, moment))
        results.append(load_ground_reaction(table, AT, "right"))
    for result in results[1:]:
        np.testing.assert_array_equal(result.point, results[0].point)
        np.testing.assert_array_equal(result.moment, results[0].moment)
    low, high = point[~swing].min(axis=0), point[~swing].max(axis=0)
    assert (results[0].point >= low - 1e-3).all()
    assert (results[0].point <= high + 1e-3).all()


def test_the_wrench_is_filtered_about_a_fixed_point(tmp_path):
    """The origin of the plate has no influence on force, moment and centre of pressure."""
    force, point, moment = step(STAMPS)
    shift = np.array([5.0, 0.0, -3.0])
    unshifted, shifted = (
        load_ground_reaction(
            plate(write(tmp_path / "g.csv", force, point + s, moment), cutoff_Hz=5.0), AT, "right"
        )
        for s in (0.0, shift)
    )
    np.testing.assert_allclose(shifted.force, unshifted.force, atol=1e-9)
    np.testing.assert_allclose(shifted.point - shift, unshifted.point, atol=1e-9)
    np.testing.assert_allclose(shifted.moment, unshifted.moment, atol=1e-9)


def test_the_point_of_an_unloaded_plate_does_not_change_the_wrench(tmp_path):
    file = write(tmp_path / "g.csv", *step(STAMPS))
    low, high = (
        load_ground_reaction(plate(file, unloaded_N=n, cutoff_Hz=5.0), AT, "right")
        for n in (20.0, 100.0)
    )
    assert high.loaded.sum() < low.loaded.sum()
    np.testing.assert_array_equal(low.force, high.force)
    moment_change = np.linalg.norm(about_origin(low) - about_origin(high), axis=1)
    assert moment_change.max() < 0.5  # N·m, from holding the recorded points of 20 to 100 N


def test_laboratory_axes_and_a_left_foot_give_the_same_reaction(tmp_path):
    force, point, moment = step(STAMPS)
    right = load_ground_reaction(
        plate(write(tmp_path / "r.csv", force, point, moment)), AT, "right"
    )
    turn = np.diag([-1.0, 1.0, -1.0])
    file = write(tmp_path / "t.csv", force @ turn, point @ turn, moment @ turn)
    turned = load_ground_reaction(plate(file, laboratory_axes="-x,+y,-z"), AT, "right")
    file = write(tmp_path / "l.csv", force @ MIRROR, point @ MIRROR, -moment @ MIRROR)
    left = load_ground_reaction(plate(file), AT, "left")
    for other in (turned, left):
        np.testing.assert_allclose(other.force, right.force, atol=1e-10)
        np.testing.assert_allclose(other.point, right.point, atol=1e-12)
        np.testing.assert_allclose(other.moment, right.moment, atol=1e-10)


def test_a_force_too_large_for_a_foot_is_refused_with_its_column_and_row(tmp_path):
    force, point, moment = step(STAMPS)
    force[1200, 0] = -3e4
    file = write(tmp_path / "g.csv", force, point, moment)
    with pytest.raises(InputError, match=r"column 'force_1' runs from -3e\+04 .* row 1201\)"):
        load_ground_reaction(plate(file, laboratory_axes="-z,+y,+x"), AT, "right")


def test_force_on_the_plate_is_the_opposite_of_that_on_the_foot(tmp_path):
    """Newton's third law: force and free moment change their signs, the point does not."""
    force, point, moment = step(STAMPS)
    foot = write(tmp_path / "foot.csv", force, point, moment)
    on_foot = load_ground_reaction(plate(foot), AT, "left")
    file = write(tmp_path / "plate.csv", -force, point, -moment)
    on_plate = load_ground_reaction(plate(file, force="on the plate"), AT, "left")
    for name in ("force", "point", "moment", "loaded"):
        np.testing.assert_array_equal(getattr(on_plate, name), getattr(on_foot, name))
    with pytest.raises(InputError, match='say force = "on the plate"'):
        load_ground_reaction(plate(file), AT, "left")
    with pytest.raises(InputError, match="leave out the key force"):
        load_ground_reaction(plate(foot, force="on the plate"), AT, "left")


def test_millimetres_and_an_absent_free_moment_are_read(tmp_path):
    force, point, moment = step(STAMPS)
    metres = load_ground_reaction(
        plate(write(tmp_path / "m.csv", force, point, 0 * moment)), AT, "right"
    )
    rows = np.column_stack([STAMPS, force, point * 1e3])
    lines = [",".join(NAMES[:7]), *(",".join(f"{v:.15g}" for v in row) for row in rows)]
    file = tmp_path / "mm.csv"
    file.write_text("\n".join(lines), encoding="utf-8")
    result = load_ground_reaction(plate(file, length_unit="mm"), AT, "right")
    np.testing.assert_allclose(result.point, metres.point, atol=1e-12)
    np.testing.assert_allclose(result.moment, metres.moment, atol=1e-9)


def test_a_plate_that_is_never_loaded_has_finite_points(tmp_path):
    force, point, moment = step(STAMPS)
    reaction = load_ground_reaction(
        plate(write(tmp_path / "g.csv", 0.01 * force, np.nan * point, 0 * moment)), AT, "right"
    )
    assert not reaction.loaded.any()
    assert np.isfinite(reaction.point).all()
    assert np.abs(reaction.moment).max() < 1e-9


def refused(tmp_path, message, force, point, moment, **changes):
    file = write(tmp_path / "g.csv", force, point, moment)
    with pytest.raises(InputError, match=message):
        load_ground_reaction(plate(file, **changes), AT, "right")


def test_invalid_plate_files_are_refused(tmp_path):
    force, point, moment = step(STAMPS)
    lost = point.copy()
    lost[1000] = np.nan
    refused(tmp_path, r"centre of pressure is missing at 0\.833333 s", force, lost, moment)
    stairs = point + np.array([0, 1, 0]) * STAMPS[:, None]
    refused(tmp_path, "leaves the plate's level", force, stairs, moment)
    refused(tmp_path, "half the sampling rate", force, point, moment, cutoff_Hz=700.0)
    refused(tmp_path, "unknown role 'fx'", force, point, moment, columns={"fx": "force_1"})
    refused(tmp_path, "no column 'vy'", force, point, moment, columns={"force_2": "vy"})
    gap = force.copy()
    gap[len(STAMPS) // 2, 0] = np.nan
    refused(tmp_path, "not a number at", gap, point, moment)
    file = write(tmp_path / "g.csv", force, point, moment)
    with pytest.raises(InputError, match="covers 0 to 2 s, but"):
        load_ground_reaction(plate(file), AT + 1, "right")


def test_the_height_of_a_plate_may_be_missing(tmp_path):
    """The plate is then at the height 0; a missing horizontal column is refused."""
    force, point, moment = step(STAMPS)
    point[:, 1] = 0.0
    complete = write(tmp_path / "given.csv", force, point, moment)
    rows = [line.split(",") for line in complete.read_text(encoding="utf-8").splitlines()]
    expected = load_ground_reaction(plate(complete), AT, "right")
    for role, file in (("point_2", "height.csv"), ("point_3", "side.csv")):
        remaining = [k for k, name in enumerate(rows[0]) if name != role]
        text = "\n".join(",".join(row[k] for k in remaining) for row in rows)
        (tmp_path / file).write_text(text, encoding="utf-8")
    result = load_ground_reaction(plate(tmp_path / "height.csv"), AT, "right")
    np.testing.assert_array_equal(result.point, expected.point)
    np.testing.assert_array_equal(result.moment, expected.moment)
    assert result.level_assumed and not expected.level_assumed
    with pytest.raises(InputError, match="has no column 'point_3'"):
        load_ground_reaction(plate(tmp_path / "side.csv"), AT, "right")
