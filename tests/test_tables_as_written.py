"""Tables as programs write them: .trc headers, forces and their moments, states, angles, clocks."""

import numpy as np
import pytest

from pendulum_leg import changed, moving_leg, pendulum_osim, recorded_leg
from plane_leg import plane_leg
from tkamb.cli import main
from tkamb.errors import InputError
from tkamb.io.importing.plates import table_forces
from tkamb.io.opensim.kinematics import Kinematics
from tkamb.io.opensim.motion import angle_lines, read_coordinates
from tkamb.io.opensim.read import read_osim
from tkamb.io.recordings.tables import Table, read_table
from tkamb.io.scene import load_scene
from tkamb.io.scene.case import load_case
from tkamb.show.storage import write_storage, write_trc

HEAD = "PathFileType\t4\t(X/Y/Z)\ta.trc\nDataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\n"
ROWS = ["1\t0.00\t1\t2\t3\t4\t5\t6", "2\t0.01\t1.5\t2\t3\t\t\t", "3\t0.02\t2\t2\t3\t4\t5\t6"]
BLANK_ROWS = [row.replace("\t\t\t", "\t0\t0\t0").replace("\t", "   ") for row in ROWS]
AXES = "\t\tX1\tY1\tZ1\tX2\tY2\tZ2"
COUNTS = "100\t100\t3\t2\tmm"


def trc(folder, labels, axes=AXES, rows=ROWS, counts=COUNTS):
    path = folder / "a.trc"
    path.write_text(HEAD + "\n".join([counts, labels, axes, "", *rows]) + "\n", encoding="utf-8")
    return read_table(path)


@pytest.mark.parametrize(
    "labels",
    [
        "Frame#\tTime\tR.Heel\t\t\tR.Toe\t\t",
        "Frame#\tTime\tR.Heel\t\t\tR.Toe",
        "Frame#\tTime\tR.Heel\tR.Toe",
        "Frame#\tTime            R.Heel                  R.Toe      ",
        "Frame#  Time  R.Heel  R.Toe",
        "Frame# Time R.Heel R.Toe",
        "Frame#\tTime\tR.Heel       \t  \t  \tR.Toe  \t \t ",
    ],
)
@pytest.mark.parametrize("rows", [ROWS, BLANK_ROWS], ids=["tabs", "blanks"])
@pytest.mark.parametrize("counts", [COUNTS, "  100.0   100.0   3  2 mm "], ids=["tabs", "blanks"])
def test_a_trc_with_blanks_instead_of_tabs_is_read(tmp_path, labels, rows, counts):
    table = trc(tmp_path, labels, rows=rows, counts=counts)
    assert table.length_unit == "mm" and table.notices == ()
    np.testing.assert_array_equal(table.column("R.Heel_x"), [1.0, 1.5, 2.0])
    np.testing.assert_array_equal(table.column("R.Toe_z"), [6.0, np.nan, 6.0])


STORAGE = "Coordinates\nnRows={rows}\nnColumns=2\ninDegrees={degrees}\n{more}endheader\n"


def storage(folder, rows="2", degrees="yes", more="", encoding="utf-8"):
    text = STORAGE.format(rows=rows, degrees=degrees, more=more) + "time\tknee\n0\t1\n0.1\t2\n"
    (folder / "a.mot").write_bytes(text.encode(encoding))
    return read_table(folder / "a.mot")


def test_a_header_that_states_another_number_of_rows_is_noticed(tmp_path):
    assert storage(tmp_path).notices == ()
    for rows in ("1", "5"):
        (notice,) = storage(tmp_path, rows).notices
        assert f"has 2 rows, but its header says {rows}" in notice
    labels = "Frame#\tTime\tA\t\t\tB\t\t"
    (notice,) = trc(tmp_path, labels, counts="100\t100\t9\t2\tmm").notices
    assert "has 3 rows, but its header says 9" in notice


@pytest.mark.parametrize(
    ("word", "degrees"), [("yes", True), ("TRUE", True), ("0", False), ("No", False), ("?", None)]
)
def test_several_words_for_degrees_are_read(tmp_path, word, degrees):
    assert storage(tmp_path, degrees=word).in_degrees is degrees


@pytest.mark.parametrize("encoding", ["latin-1", "utf-8", "utf-8-sig", "utf-16"])
def test_remarks_in_any_encoding_are_accepted(tmp_path, encoding):
    table = storage(tmp_path, more="gemessen für Müller, 20 °C\n", encoding=encoding)
    np.testing.assert_array_equal(table.column("knee"), [1.0, 2.0])


def test_a_storage_file_of_vectors_is_refused_as_such(tmp_path):
    with pytest.raises(InputError, match=r"values of the type vec3.*DataType=double"):
        storage(tmp_path, more="DataType=Vec3\n")


def test_quoted_cells_of_a_csv_are_read(tmp_path):
    (tmp_path / "a.csv").write_text('"time","x"\n"0","1.5"\n"0.1","2"\n', encoding="utf-8")
    np.testing.assert_array_equal(read_table(tmp_path / "a.csv").column("x"), [1.5, 2.0])


LABELS = "Frame#\tTime\tR.Heel\t\t\tR.Toe\t\t"


def as_spreadsheet(line, separator):
    """Return a line with another separator, padded to the width of the table."""
    return separator.join((line.split("\t") + [""] * 8)[:8])


@pytest.mark.parametrize("separator", [",", ";"])
@pytest.mark.parametrize("quoted", [False, True])
def test_tables_that_a_spreadsheet_saved_with_other_separators_are_read(
    tmp_path, separator, quoted
):
    plain = trc(tmp_path, LABELS)
    lines = (tmp_path / "a.trc").read_text().splitlines()
    lines = [as_spreadsheet(line, separator) for line in lines]
    if quoted:
        lines = [separator.join(f'"{cell}"' for cell in line.split(separator)) for line in lines]
    (tmp_path / "a.trc").write_text("\n".join(lines), encoding="utf-8")
    table = read_table(tmp_path / "a.trc")
    word = {",": "commas", ";": "semicolons"}[separator]
    assert len(table.notices) == 1 + quoted and f"has {word} between" in table.notices[-1]
    assert table.length_unit == "mm" and table.columns.keys() == plain.columns.keys()
    for name, values in plain.columns.items():
        np.testing.assert_array_equal(table.column(name), values)
    text = (STORAGE.format(rows=2, degrees="no", more="") + "time\tknee\n0\t1\n0.1\t2\n").split(
        "\n"
    )
    (tmp_path / "a.mot").write_text("\n".join(as_spreadsheet(t, separator)[:-6] for t in text))
    table = read_table(tmp_path / "a.mot")
    assert table.in_degrees is False and len(table.notices) == 1
    np.testing.assert_array_equal(table.column("knee"), [1.0, 2.0])


@pytest.mark.parametrize("part", ["all", "header", "names", "rows"])
def test_quotes_and_tabs_around_the_cells_of_a_storage_file_are_left_out(tmp_path, part):
    rows = {"header": (0, 5), "names": (5, 6), "rows": (6, 8), "all": (0, 8)}[part]
    lines = (STORAGE.format(rows=2, degrees="no", more="") + "time\tknee\n0\t1\n0.1\t2").split("\n")
    assert lines[4] == "endheader" and len(lines) == 8
    for k in range(*rows):
        lines[k] = "\t".join(f'"{cell}"' for cell in lines[k].split("\t")) + "\t\t"
    (tmp_path / "a.mot").write_text("\n".join(lines), encoding="utf-8")
    table = read_table(tmp_path / "a.mot")
    assert table.in_degrees is False and "has quotes around" in table.notices[0]
    np.testing.assert_array_equal(table.column("knee"), [1.0, 2.0])


@pytest.mark.parametrize("where", ["all", "rows", "labels"])
def test_a_tab_before_each_row_of_a_trc_is_left_out(tmp_path, where):
    plain = trc(tmp_path, LABELS)
    labels = LABELS if where == "rows" else "\t" + LABELS
    rows = ROWS if where == "labels" else ["\t" + row for row in ROWS]
    counts = "\t" + COUNTS if where == "all" else COUNTS
    table = trc(tmp_path, labels, rows=rows, counts=counts)
    assert len(table.notices) == (where != "labels")
    for name, values in plain.columns.items():
        np.testing.assert_array_equal(table.column(name), values)
    unnumbered = trc(tmp_path, LABELS, rows=[row[1:] for row in ROWS])  # the frames lack numbers
    np.testing.assert_array_equal(unnumbered.column("R.Heel_x"), plain.column("R.Heel_x"))


def test_decimal_commas_are_no_separators(tmp_path):
    for rows in (
        ["1\t0,00\t1\t2\t3\t4\t5\t6"],
        [";".join(["1", "0,00", "1", "2", "3", "4", "5", "6"])],
    ):
        labels = LABELS.replace("\t", ";") if ";" in rows[0] else LABELS
        with pytest.raises(InputError, match="a decimal point, not a comma"):
            trc(tmp_path, labels, rows=rows)


def test_labels_with_blanks_in_them_between_tabs_or_many_blanks(tmp_path):
    for labels in ("Frame#\tTime\tR heel\t\t\tR toe\t\t", "Frame#   Time   R heel    R toe"):
        np.testing.assert_array_equal(trc(tmp_path, labels).column("R heel_y"), 2.0)


def test_unlabelled_columns_of_a_trc_are_kept_apart(tmp_path):
    rows = [row + "\t7\t8\t9" for row in ROWS]
    for labels in ("Frame#\tTime\tA\t\t\t\t\t\tC\t\t", "Frame#\tTime\tA\t\t\t\t\t\tC"):
        table = trc(tmp_path, labels, AXES + "\tX3\tY3\tZ3", rows, "100\t100\t3\t3\tmm")
        np.testing.assert_array_equal(table.column("C_x"), 7.0)
        assert "1 marker(s) without a label" in table.notices[0]


def test_columns_behind_the_last_label_are_unlabelled_markers(tmp_path):
    rows = [row + "\t7\t8\t9" for row in ROWS]
    table = trc(tmp_path, "Frame#\tTime\tA\t\t\tB\t\t", AXES, rows)
    np.testing.assert_array_equal(table.column("B_x"), [4.0, np.nan, 4.0])
    assert "without a label" in table.notices[0]


def test_equal_labels_of_a_trc_are_refused_only_where_needed(tmp_path):
    rows = [row + "\t7\t8\t9" for row in ROWS]
    table = trc(tmp_path, "Frame#\tTime\tA\t\t\tA\t\t\tC\t\t", AXES + "\tX3\tY3\tZ3", rows)
    np.testing.assert_array_equal(table.column("C_x"), 7.0)
    assert table.notices == ("has two markers 'A'; neither is used",)
    with pytest.raises(InputError, match="two columns named 'A_x'"):
        table.column("A_x")


def test_labels_that_are_too_few_for_their_columns_are_refused_with_both_numbers(tmp_path):
    with pytest.raises(InputError, match="names 1 markers in line 4, but has columns for 2"):
        trc(tmp_path, "Frame# Time R.Heel")


@pytest.mark.parametrize("word", ["mm", "MM", "Millimeters", "m", "Meters", "cm"])
def test_unit_words_of_a_trc_are_read(tmp_path, word):
    unit = {"m": "mm", "M": "mm"}[word[0]] if word.lower().startswith(("mm", "mill")) else word[0]
    unit = {"m": "m", "M": "m", "c": "cm"}.get(unit, unit)
    labels = "Frame#\tTime\tA\t\t\tB\t\t"
    assert trc(tmp_path, labels, counts=f"100\t100\t3\t2\t{word}").length_unit == unit


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.csv", "time,x,y\n0,0,1,5,2,5\n0,1,1,5,2,5\n", "not commas"),
        ("a.csv", "time,x,y\n0.0,1.5,2.5,7.5,8.5\n", "give every column a name"),
        ("a.sto", "endheader\ntime\tx\n0,01\t2\n", "a decimal point, not a comma"),
        ("a.mot", "endheader\ntime\tx\n0.01\t2\t3\n", "give every column a name"),
    ],
)
def test_an_error_names_decimal_commas_only_if_they_are_possible(tmp_path, name, text, words):
    (tmp_path / name).write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=words):
        read_table(tmp_path / name)


# Forces of a table

FORCES = {
    "ground_force_1_v{}": "ground_torque_1_{}",
    "ground_force_2_v{}": "ground_moment_2_m{}",
    "1_ground_force_v{}": "1_ground_torque_{}",
    "ground_force_r_v{}": "ground_torque_r_{}",
    "ground_force_calcn_r_v{}": "ground_force_calcn_r_m{}",
    "ground_force_v{}": "ground_moment_{}",
    "FP1_v{}": "FP1_t{}",
    "r_ground_force_v{}": "r_free_moment_{}",
    "grf_r_v{}": "grm_r_{}",
    "F{}1": "M{}1",
    "f1_{}": "m1_{}",
}


def force_table(folder, columns):
    time = np.arange(10) / 10.0
    table = {name: np.full(10, value) for name, value in columns.items()}
    return Table(folder / "g.mot", {"time": time, **table})


@pytest.mark.parametrize("force", FORCES)
def test_moments_are_found_by_the_name_of_their_force(tmp_path, force):
    point = force.replace("v{}", "p{}").replace("F{}", "P{}").replace("f1", "p1")
    names = [p.format(a) for p in (force, point, FORCES[force]) for a in "xyz"]
    (force_columns,) = table_forces(force_table(tmp_path, dict.fromkeys(names, 1.0)))
    roles = [f"{kind}_{k}" for kind in ("force", "point", "moment") for k in (1, 2, 3)]
    assert force_columns.columns == dict(zip(roles, names, strict=True))


def test_one_axis_of_the_moment_alone_is_used(tmp_path):
    names = [f"ground_force_{kind}{a}" for kind in "vp" for a in "xyz"]
    (force_columns,) = table_forces(
        force_table(tmp_path, dict.fromkeys([*names, "ground_torque_y"], 1.0))
    )
    assert (
        force_columns.moments == ("ground_torque_y",)
        and force_columns.columns["moment_2"] == "ground_torque_y"
    )


@pytest.mark.parametrize(
    "stranger", ["torsion_y", "free_9_y", "vertical_torque", "ground_torque_3_y"]
)
def test_a_moment_column_of_no_force_is_refused_by_its_name(tmp_path, stranger):
    names = [f"ground_force_{n}_{kind}{a}" for n in (1, 2) for kind in "vp" for a in "xyz"]
    with pytest.raises(InputError, match=stranger):
        table_forces(force_table(tmp_path, dict.fromkeys([*names, stranger], 1.0)))


def foot_path(tmp_path, frames=60):
    """Return the middle (frames, 3) m of the right foot's markers of the moving leg."""
    _, markers = moving_leg(pendulum_osim(tmp_path / "plain.osim"), frames)
    return np.mean([path for name, path in markers.items() if "foot_r" in name], axis=0)


def two_forces(tmp_path, moments=True, at="pressure", rate=60.0, span=(0.0, 1.0)):
    """Write a table of two forces: number 2 under the foot, number 1 a metre beside it."""
    time = np.arange(span[0], span[1], 1.0 / rate)
    foot = foot_path(tmp_path)
    foot_point = np.stack(
        [np.interp(time, np.arange(60) / 60.0, foot[:, k]) for k in range(3)], axis=1
    )
    foot_point[:, 1] = 0.0
    force = np.stack([20 * np.sin(6 * time), 400 + 50 * np.cos(5 * time), 0 * time + 8.0], axis=1)
    columns = {"time": time}
    for number, point in ((1, foot_point + np.array([0.0, 0.0, 1.0])), (2, foot_point)):
        moment = np.zeros_like(force)
        moment[:, 1] = 4.0 if moments else 0.0
        place = point
        if at != "pressure":
            place = np.zeros_like(point)
            if at == "plate":
                place = place + foot_point[30] + [0.05, 0.0, 0.02]
            moment = moment + np.cross(point - place, force)
        for k, axis in enumerate("xyz"):
            columns[f"ground_force_{number}_v{axis}"] = force[:, k]
            if at != "file":
                columns[f"ground_force_{number}_p{axis}"] = place[:, k]
            columns[f"ground_moment_{number}_m{axis}"] = moment[:, k]
    write_storage(tmp_path / "g.mot", columns, in_degrees=False)
    return str(tmp_path / "g.mot")


@pytest.mark.parametrize("at", ["pressure", "plate", "file"])
def test_a_tables_force_is_assigned_to_the_foot_at_its_point_of_application(tmp_path, capsys, at):
    """Forces at the centre of pressure, the plate's origin or the file's origin give one wrench."""
    arguments = recorded_leg(tmp_path)
    assert main(changed(arguments, grf=two_forces(tmp_path, at=at))) == 0
    assert "ground_force_2_v*" in capsys.readouterr().out
    ground = load_case(load_scene(tmp_path / "out" / "scene.toml")).ground
    assert np.abs(ground.force[:, 1] - 400).max() < 51
    np.testing.assert_allclose(ground.moment[3:-3, 1], 4.0, atol=0.05)
    np.testing.assert_allclose(ground.moment[:, [0, 2]], 0.0, atol=1e-6)


def test_several_forces_under_one_foot_are_summed(tmp_path):
    arguments = recorded_leg(tmp_path)
    path = two_forces(tmp_path)
    arguments_of_two = changed(arguments, grf=path, grf_force="ground_force_1,ground_force_2")
    assert main(arguments_of_two) == 2  # Their sum acts half a metre from the ankle.
    single = changed(arguments, grf=path, grf_force="ground_force_2")
    assert main(single) == 0
    case = load_case(load_scene(tmp_path / "out" / "scene.toml"))
    table = read_table(tmp_path / "g.mot")
    halved = dict(table.columns)
    for name in table.columns:
        if name.startswith(("ground_force_2_v", "ground_moment_2")):
            halved[name] = table.columns[name] / 2
        if name.startswith(("ground_force_1", "ground_moment_1")):
            halved[name] = table.columns[name.replace("_1_", "_2_")]
            if "_v" in name or "_m" in name.partition("_1")[2]:
                halved[name] = halved[name] / 2
    write_storage(tmp_path / "halves.mot", halved, in_degrees=False)
    arguments_of_two = changed(
        arguments,
        grf=str(tmp_path / "halves.mot"),
        grf_force="ground_force_1,ground_force_2",
        out=str(tmp_path / "sum"),
    )
    assert main(arguments_of_two) == 0
    summed = load_case(load_scene(tmp_path / "sum" / "scene.toml"))
    np.testing.assert_allclose(summed.ground.force, case.ground.force, atol=1e-5)
    np.testing.assert_allclose(summed.ground.moment, case.ground.moment, atol=1e-5)


def external_loads(tmp_path, body="foot_r", number=2, root=True, frame="ground", datafile="g.mot"):
    """Write a list of external loads: one force on the foot, and one on another body."""
    entries = "".join(
        f'<ExternalForce name="F{k}"><applied_to_body>{b}</applied_to_body>'
        f"<force_expressed_in_body>{frame}</force_expressed_in_body>"
        f"<force_identifier>ground_force_{k}_v</force_identifier>"
        f"<point_identifier>ground_force_{k}_p</point_identifier>"
        f"<torque_identifier>ground_moment_{k}_m</torque_identifier></ExternalForce>"
        for k, b in ((3 - number, "pelvis"), (number, body))
    )
    text = f"<objects>{entries}</objects><datafile>{datafile}</datafile>"
    text = f'<ExternalLoads name="x">{text}</ExternalLoads>'
    if root:
        text = f'<?xml version="1.0"?><OpenSimDocument Version="40000">{text}</OpenSimDocument>'
    (tmp_path / "loads.xml").write_text(text)
    return str(tmp_path / "loads.xml")


@pytest.mark.parametrize(
    "options", [{}, {"root": False}, {"body": "/bodyset/foot_r"}, {"frame": "/ground"}]
)
def test_a_list_of_external_loads_says_which_force_is_the_foots(tmp_path, options):
    arguments = recorded_leg(tmp_path)
    table = two_forces(tmp_path)
    assert main(changed(arguments, grf=table, grf_force="ground_force_2")) == 0
    listed = changed(arguments, grf=external_loads(tmp_path, **options), out=str(tmp_path / "x"))
    assert main(listed) == 0
    cases = [load_case(load_scene(tmp_path / name / "scene.toml")) for name in ("out", "x")]
    for part in ("force", "point", "moment"):
        np.testing.assert_array_equal(*(getattr(case.ground, part) for case in cases))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"body": "tibia_r"}, "applies no force to the foot .foot_r., but to pelvis, tibia_r"),
        ({"frame": "foot_r"}, "in the frame 'foot_r', which is not read"),
        ({"datafile": "h.mot"}, "h.mot"),
        ({"number": 1}, ""),
        ({"number": 5}, "names columns 'ground_force_5_v…'"),
    ],
)
def test_a_list_of_external_loads_that_names_no_force_of_the_foot_is_refused(
    tmp_path, capsys, options, words
):
    arguments = recorded_leg(tmp_path)
    two_forces(tmp_path)
    status = main(changed(arguments, grf=external_loads(tmp_path, **options)))
    error = capsys.readouterr().err
    if options == {"number": 1}:  # the force is a metre beside the foot
        assert status == 2 and "from the ankle" in error
        return
    assert status == 2 and words.replace(".foot_r.", "(foot_r)") in error


@pytest.mark.parametrize("span", [(0.0009, 0.99), (0.1, 0.8), (-0.3, 0.7)])
def test_only_the_common_time_of_motion_and_force_is_used(tmp_path, capsys, span):
    arguments = recorded_leg(tmp_path)
    path = two_forces(tmp_path, rate=600.0, span=span)
    arguments = changed(arguments, grf=path, grf_force="ground_force_2")
    assert main(arguments) == 0
    assert "ATTENTION: the ground reaction was recorded from" in capsys.readouterr().out
    text = (tmp_path / "out" / "scene.toml").read_text()
    time = load_case(load_scene(tmp_path / "out" / "scene.toml")).motion.time
    assert time[0] >= span[0] and time[-1] <= span[1] and np.ptp(time) > 0.5
    # Without an interval in the scene, the common part is used too.
    whole = "\n".join(line for line in text.splitlines() if "interval_s" not in line)
    (tmp_path / "out" / "scene.toml").write_text(whole)
    time = load_case(load_scene(tmp_path / "out" / "scene.toml")).motion.time
    assert time[0] >= span[0] and time[-1] <= span[1] and np.ptp(time) > 0.5


def walking_leg(tmp_path):
    """Write a leg that stands from 0.4 to 0.7 s between two steps; return its import and foot."""
    arguments = recorded_leg(tmp_path)
    table = read_table(tmp_path / "leg.trc")
    time = np.arange(60) / 60.0
    forward = np.interp(time, [0.2, 0.4, 0.7, 0.9], [0.0, 0.7, 0.7, 1.4])
    labels = [name[:-2] for name in table.columns if name.endswith("_x")]
    markers = {
        name: np.stack([table.columns[f"{name}_{axis}"] for axis in "xyz"], axis=1)
        * table.unit_scale(None, "")
        + np.outer(forward, [1.0, 0.0, 0.0])
        for name in labels
    }
    write_trc(tmp_path / "leg.trc", time, markers, 60.0)
    return arguments, time, np.mean([markers[n] for n in labels if "foot_r" in n], axis=0)


@pytest.mark.parametrize("shift", [0.0, 0.02, 0.25, -0.2, 0.4])
@pytest.mark.parametrize("named", [True, False])
def test_force_and_motion_on_two_clocks_are_refused_with_the_shift(tmp_path, capsys, shift, named):
    """The foot is loaded while it stands; the force's clock is late by `shift`."""
    arguments, time, foot = walking_leg(tmp_path)
    columns, stands = {"time": time + shift}, (time >= 0.4) & (time <= 0.7)
    for k, axis in enumerate("xyz"):
        columns[f"ground_force_1_v{axis}"] = np.where(stands, [10.0, 400.0, 5.0][k], 0.0)
        columns[f"ground_force_1_p{axis}"] = foot[:, k] * (k != 1)
        columns[f"ground_force_2_v{axis}"] = np.where(stands, [10.0, 300.0, 5.0][k], 0.0)
        columns[f"ground_force_2_p{axis}"] = foot[:, k] * (k != 1) + (k == 2)
    write_storage(tmp_path / "g.mot", columns, in_degrees=False)
    options = {"grf_force": "ground_force_1"} if named else {}
    status = main(changed(arguments, grf=str(tmp_path / "g.mot"), **options))
    error = capsys.readouterr().err
    if abs(shift) < 0.1:
        assert status == 0, error
        return
    assert status == 2 and "force and motion are on two clocks" in error
    assert f"{-shift:+.3f} s is added" in error and "write the times of leg.trc into it" in error


def test_files_without_a_common_time_are_refused(tmp_path, capsys):
    path = two_forces(tmp_path, span=(5.0, 6.0))
    arguments = changed(recorded_leg(tmp_path), grf=path, grf_force="ground_force_2")
    assert main(arguments) == 2
    assert "give files of one trial" in capsys.readouterr().err


# Labels under several prefixes


def twice_prefixed(tmp_path):
    arguments = recorded_leg(tmp_path)
    _, markers = moving_leg(tmp_path / "plain.osim")
    arguments_of_two = {
        f"{who}:{name}": path for who in ("S", "Model") for name, path in markers.items()
    }
    write_trc(tmp_path / "leg.trc", np.arange(60) / 60.0, arguments_of_two, 60.0)
    return arguments


def test_markers_under_two_prefixes_ask_which(tmp_path, capsys):
    assert main(twice_prefixed(tmp_path)) == 2
    assert "under several prefixes: S, Model; say which with --marker-prefix" in (
        capsys.readouterr().err
    )


@pytest.mark.parametrize("prefix", ["S", "Model", "Model:"])
def test_only_markers_with_the_requested_prefix_are_used(tmp_path, prefix):
    assert main(changed(twice_prefixed(tmp_path), marker_prefix=prefix)) == 0
    text = (tmp_path / "out" / "scene.toml").read_text()
    other = "Model:" if prefix == "S" else "S:"
    assert f'"{prefix.rstrip(":")}:' in text and f'"{other}' not in text
    case = load_case(load_scene(tmp_path / "out" / "scene.toml"))
    assert case.motion.markers.rms["segments"].max() < 1e-5


def test_an_unknown_prefix_is_refused_with_the_existing_ones(tmp_path, capsys):
    assert main(changed(twice_prefixed(tmp_path), marker_prefix="Static")) == 2
    assert "its prefixes: S, Model" in capsys.readouterr().err


# States and angles


@pytest.mark.parametrize("path", ["/jointset/knee_r/", "knee_r/", "/"])
@pytest.mark.parametrize("turned", [False, True])
def test_a_states_files_speeds_are_no_coordinates(tmp_path, path, turned):
    chain = Kinematics(plane_leg())
    value = {f"{path}knee_flexion_r/value": np.array([0.1, 0.2, 0.3])}
    speed = {f"{path}knee_flexion_r/speed": np.array([1.0, 1.0, 1.0])}
    pair = speed | value if turned else value | speed
    table = Table(tmp_path / "q.sto", {"time": np.arange(3.0), **pair}, in_degrees=False)
    q, missing = read_coordinates(chain, table)
    np.testing.assert_allclose(q[:, chain.coordinates["knee_flexion_r"]], [0.1, 0.2, 0.3])
    assert "knee_flexion_r" not in missing
    speeds_only = Table(tmp_path / "q.sto", {"time": np.arange(3.0), **speed}, in_degrees=False)
    assert "knee_flexion_r" in read_coordinates(chain, speeds_only)[1]


@pytest.mark.parametrize(
    ("in_degrees", "largest", "words"),
    [
        (None, 60.0, "inDegrees=yes"),
        (None, 1.2, "inDegrees=no"),
        (False, 60.0, "inDegrees=no, but"),
    ],
)
def test_angles_of_no_unit_or_an_impossible_one_are_refused_with_the_remedy(
    tmp_path, in_degrees, largest, words
):
    columns = {"time": np.arange(3.0), "knee_flexion_r": np.linspace(0.0, largest, 3)}
    with pytest.raises(InputError, match=words):
        read_coordinates(
            Kinematics(plane_leg()), Table(tmp_path / "q.mot", columns, in_degrees=in_degrees)
        )


@pytest.mark.parametrize(("largest", "asked"), [(1.2, 1), (60.0, 0), (0.05, 0)])
def test_degrees_that_look_like_radians_are_asked_about(tmp_path, largest, asked):
    chain = Kinematics(plane_leg())
    columns = {"time": np.arange(3.0), "knee_flexion_r": np.linspace(0.0, largest, 3)}
    table = Table(tmp_path / "q.mot", columns, in_degrees=True)
    q, _ = read_coordinates(chain, table)
    assert len(angle_lines(chain, table, q)) == asked


def motion_of_the_leg(tmp_path):
    """Write the moving leg in its model's coordinates, and return the import's arguments."""
    osim = pendulum_osim(tmp_path / "leg.osim")
    q, _ = moving_leg(osim)
    columns = {name: q[:, k] for k, name in enumerate(read_osim(osim).coordinates)}
    write_storage(tmp_path / "leg.mot", {"time": np.arange(60) / 60.0} | columns, in_degrees=False)
    arguments = ["--motion", str(tmp_path / "leg.mot"), "--side", "right", "--mass-kg", "53.5"]
    return ["import", str(osim), *arguments, "--out", str(tmp_path / "out")]


def test_a_motion_is_cut_to_the_time_of_its_force(tmp_path, capsys):
    """The model's coordinates give the foot's position, to which the force is assigned."""
    arguments = motion_of_the_leg(tmp_path)
    assert main([*arguments, "--grf", two_forces(tmp_path, span=(-0.5, 0.6))]) == 0
    output = capsys.readouterr().out
    assert "ground_force_2_v*" in output and "by their points of application" in output
    time = read_table(tmp_path / "out" / "motion.csv").column("time_s")
    assert time[0] == 0.0 and 0.5 < time[-1] <= 0.6


def test_an_interval_of_a_motion_is_cut_out(tmp_path, capsys):
    arguments = motion_of_the_leg(tmp_path)
    assert main([*arguments, "--interval", "0.25:0.75"]) == 0
    table = read_table(tmp_path / "out" / "motion.csv")
    np.testing.assert_allclose(table.column("time_s"), np.arange(15, 46) / 60.0, atol=1e-8)
    assert main([*arguments, "--interval", "3:4", "--scene", "other.toml"]) == 2
    assert "--interval" in capsys.readouterr().err
