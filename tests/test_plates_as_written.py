"""Force plates in recordings of laboratories: units, calibration, baselines, drift, gaps."""

import numpy as np
import pytest

from recordings import AMTI_CORNERS, standing_markers, write_c3d
from test_c3d import COUNT, RATIO, Z0, A, B, plate_signals, pushes
from tkamb.errors import InputError
from tkamb.io.recordings.c3d import read_c3d
from tkamb.io.recordings.ground_reaction import load_ground_reaction
from tkamb.io.recordings.laboratory import GivenUnits, metres, newton_metres, newtons
from tkamb.io.recordings.recording_tables import GroundReactionTable
from tkamb.run.plausibility.movement import drift_questions

ORIGIN = np.array([0.003, -0.002, -0.03])
PER_UNIT = {"mm": 1e3, "m": 1.0}


def wrench():
    """Return the wrench of `pushes`: force and moment about the file's origin (k, 6)."""
    force, point, free = pushes()
    moment = np.cross(point, force)
    moment[:, 2] += free
    return np.concatenate([force, moment], axis=1)


def recorded(folder, kind=2, units=None, signals=None, markers=None, **more):
    """Write a recording of one plate under `pushes`."""
    origin = more.pop("origin", ORIGIN if kind != 1 else np.zeros(3))
    if signals is None:
        signals = plate_signals(2, AMTI_CORNERS, origin)
    plate = {"type": kind, "channels": list(range(1, len(signals) + 1)), "origin": origin}
    return write_c3d(
        folder / "a.c3d",
        standing_markers(COUNT) if markers is None else markers,
        analog={f"c{k}": s for k, s in enumerate(signals)},
        units=units or ["N"] * 3 + ["Nmm"] * 3,
        plates=[plate | more.pop("plate", {})],
        **more,
    )


@pytest.mark.parametrize("force", ["N", "nt", "Newtons", "newton", " N ", "NT"])
@pytest.mark.parametrize("moment", ["Nmm", "ntmm", "N-mm", "NMM", "N.mm", "N*mm", "Newton-mm"])
def test_spellings_of_newtons_and_newton_millimetres_are_read(tmp_path, force, moment):
    path = recorded(tmp_path, units=[force] * 3 + [moment] * 3)
    np.testing.assert_allclose(read_c3d(path).plates[0].wrench, wrench(), atol=1e-3)


@pytest.mark.parametrize(
    ("word", "read", "value"),
    [
        *((word, metres, 1e-3) for word in ("mm", "MM", "Millimeters", "mill", "mm ")),
        *((word, metres, 1.0) for word in ("m", "M", "mete", "Meters", "metres")),
        *((word, metres, 1e-2) for word in ("cm", "Centimeter", "cent")),
        *((word, metres, 0.0254) for word in ("in", "inches")),
        *((word, metres, None) for word in ("", "V", "mmm", "N", "min")),
        *((word, newtons, 1.0) for word in ("N", "nt", "Newtons")),
        *((word, newtons, 1e3) for word in ("kN", "KN")),
        *((word, newtons, 4.4482216) for word in ("lbf", "lb", "LBS", "pounds")),
        *((word, newtons, 9.80665) for word in ("kgf", "kiloponds")),
        *((word, newtons, None) for word in ("V", "mV", "kg", "", "Nmm", "N/kg")),
        *((word, newton_metres, 1.0) for word in ("Nm", "N.m", "N·m", "ntm", "Newton-meters")),
        *((word, newton_metres, 1e-3) for word in ("NMM", "ntmm", "N-mm")),
        *((word, newton_metres, 1e-2) for word in ("Ncm", "N cm")),
        *((word, newton_metres, 0.11298483) for word in ("in-lb", "lbf.in", "inch pounds")),
        *((word, newton_metres, 1.3558179) for word in ("ft-lb", "lbft", "foot-pounds")),
        *((word, newton_metres, None) for word in ("N", "mm", "V", "", "Nm/kg", "mN", "mN.m")),
    ],
)
def test_a_unit_word_has_its_factor_to_si(word, read, value):
    assert read(word) == (None if value is None else pytest.approx(value))


@pytest.mark.parametrize("option", ["moment", "both"])
def test_an_unknown_unit_word_needs_the_option_of_the_unit(tmp_path, option):
    force = "N" if option == "moment" else "kiloponds?"
    path = recorded(tmp_path, units=[force] * 3 + ["huh"] * 3)
    with pytest.raises(InputError, match=r"'(huh|kiloponds\?)'.*--(force|moment)-unit"):
        read_c3d(path).plate(1)
    units = GivenUnits(force="N" if option == "both" else None, moment="Nmm")
    np.testing.assert_allclose(read_c3d(path, units).plates[0].wrench, wrench(), atol=1e-3)
    with pytest.raises(InputError, match="correct moment_unit"):
        read_c3d(recorded(tmp_path), GivenUnits(moment="Nm")).plate(1)


def test_an_unknown_unit_of_length_is_refused_for_plates(tmp_path):
    path = recorded(tmp_path, point_unit="furlong", plate={"corners": AMTI_CORNERS * 1e3})
    recording = read_c3d(path)
    assert recording.length_unit is None and len(recording.channels) == 6
    with pytest.raises(InputError, match=r"'furlong'.*--length-unit"):
        recording.plate(1)
    with pytest.raises(InputError, match="is in mm by its own header"):
        read_c3d(recorded(tmp_path), GivenUnits(length="cm"))


@pytest.mark.parametrize("unit", ["mm", "m", "MM", "Meters"])
@pytest.mark.parametrize("kind", [4, 5])
def test_a_calibration_gives_moments_in_the_unit_of_length(tmp_path, unit, kind):
    """The calibration matrix of six or eight channels in volts has crosstalk."""
    per_metre = {"mm": 1e3, "m": 1.0}["m" if metres(unit) == 1.0 else "mm"]
    signals = plate_signals(2, AMTI_CORNERS, ORIGIN)
    signals[3:] *= 1e-3 * per_metre
    channels = 6 if kind == 4 else 8
    matrix = np.random.default_rng(1).normal(0.0, 1.0, (6, channels)) + 3 * np.eye(6, channels)
    volts = np.linalg.pinv(matrix) @ signals
    corners = AMTI_CORNERS * per_metre
    plate = {"matrix": matrix, "corners": corners, "origin": ORIGIN * per_metre}
    # the writer scales metres only for the words mm and m
    path = recorded(
        tmp_path, kind, ["V"] * channels, volts, point_unit=unit, plate=scaled(plate, unit)
    )
    result = read_c3d(path).plates[0].wrench
    np.testing.assert_allclose(result, wrench(), atol=5e-3)  # single precision, times the matrix


def scaled(plate, unit):
    """Return a plate with lengths for `write_c3d`, which scales for the words mm and m."""
    by = {"mm": 1e3, "m": 1.0}.get(unit, 1.0)
    return plate | {key: plate[key] / by for key in ("corners", "origin")}


def test_the_unit_of_a_moment_channel_precedes_the_unit_of_length(tmp_path):
    """The plate has type 4, a unit matrix and channels in N·mm in a file in metres."""
    signals = plate_signals(2, AMTI_CORNERS, ORIGIN)
    plate = {"matrix": np.eye(6)}
    path = recorded(tmp_path, 4, None, signals, point_unit="m", plate=plate)
    np.testing.assert_allclose(read_c3d(path).plates[0].wrench, wrench(), atol=1e-3)


def offset_signals(level=12.0):
    """Return channels that are unloaded in the first six frames, without and with offsets."""
    signals = plate_signals(2, AMTI_CORNERS, ORIGIN)
    signals[:, : 6 * RATIO] = 0.0
    return signals, signals + level * np.array([[1.0, -0.5, 1.0, 30.0, -20.0, 10.0]]).T


@pytest.mark.parametrize(
    ("first_frame", "zero"), [(0, [1, 5]), (0, [0, 5]), (217, [218, 222]), (217, [1, 5])]
)
def test_the_frames_of_parameter_zero_give_the_baseline(tmp_path, first_frame, zero):
    clean, offset = offset_signals()
    path = recorded(tmp_path, signals=offset, first_frame=first_frame)
    with_zero(path, zero)
    with_offset = read_c3d(path).plates[0]
    reference = read_c3d(recorded(tmp_path, signals=clean)).plates[0]
    np.testing.assert_allclose(with_offset.wrench, reference.wrench, atol=2e-3)
    assert with_offset.notices == ()


@pytest.mark.parametrize("zero", [[1, 0], [0, 0], [900, 910]])
def test_impossible_frames_of_parameter_zero_are_ignored(tmp_path, zero):
    _, offset = offset_signals()
    path = recorded(tmp_path, signals=offset)
    before = read_c3d(path).plates[0].wrench
    np.testing.assert_array_equal(read_c3d(with_zero(path, zero)).plates[0].wrench, before)


def test_a_plate_that_is_loaded_in_the_frames_of_zero_has_no_baseline(tmp_path):
    path = with_zero(recorded(tmp_path), [1, 10])
    plate = read_c3d(path).plates[0]
    np.testing.assert_allclose(plate.wrench, wrench(), atol=1e-3)
    assert "no baseline is subtracted" in plate.notices[0]


def with_zero(path, zero):
    """Write FORCE_PLATFORM:ZERO into a file."""
    import ezc3d

    file = ezc3d.c3d(str(path))
    first = file["header"]["points"]["first_frame"]
    file.add_parameter("FORCE_PLATFORM", "ZERO", zero)
    file["header"]["points"]["first_frame"] = first
    file.write(str(path))
    return path


def two_plates(folder, level):
    """Write two drifting plates, with a foot on plate 1 from frame 6."""
    clean, _ = offset_signals()
    unloaded = np.zeros_like(clean)
    signals = np.concatenate([clean, unloaded])
    signals[[2, 8]] += level
    distant_corners = AMTI_CORNERS + np.array([1.5, 0.0, 0.0])
    plates = [
        {"type": 2, "channels": range(1, 7), "origin": ORIGIN},
        {"type": 2, "channels": range(7, 13), "corners": distant_corners},
    ]
    return write_c3d(
        folder / "two.c3d",
        standing_markers(COUNT),
        analog={f"c{k}": s for k, s in enumerate(signals)},
        units=(["N"] * 3 + ["Nmm"] * 3) * 2,
        plates=plates,
    )


@pytest.mark.parametrize("level", [0.0, 5.0, -7.0, 28.0])
def test_an_unloaded_plate_is_left_out_of_the_sum_and_its_drift_is_reported(tmp_path, level):
    table = GroundReactionTable(
        file=two_plates(tmp_path, level),
        plates=(1, 2),
        laboratory_axes="+x,+z,-y",
        cutoff_Hz="none",
    )
    time = read_c3d(table.file).analog_time
    ground = load_ground_reaction(table, time, "right")
    first = load_ground_reaction(table.model_copy(update={"plates": (1,)}), time, "right")
    np.testing.assert_allclose(ground.force, first.force, atol=1e-6)
    np.testing.assert_allclose(ground.moment, first.moment, atol=1e-6)
    assert np.abs(ground.force[:5]).max() < 1e-9  # nobody stands on the plates
    expected = {} if level == 0 else {2: level}  # plate 1 is unloaded for too short a time
    assert ground.drift == pytest.approx(expected, abs=1e-3)
    case = type("Case", (), {"ground": ground})
    questions = [str(question.text) for question in drift_questions(case)]
    assert len(questions) == (level != 0) and all("set to zero" in text for text in questions)


def test_light_loads_in_all_frames_are_no_drift(tmp_path):
    """A plate with 25 to 60 N in all frames is loaded."""
    signals = plate_signals(2, AMTI_CORNERS, ORIGIN)
    signals *= np.linspace(25.0, 60.0, COUNT * RATIO) / signals[2]
    path = recorded(tmp_path, signals=signals)
    table = GroundReactionTable(
        file=path, plates=(1,), laboratory_axes="+x,+z,-y", cutoff_Hz="none"
    )
    ground = load_ground_reaction(table, read_c3d(path).analog_time, "right")
    np.testing.assert_allclose(ground.force[:, 1], signals[2], atol=1e-3)
    assert ground.drift == {}


@pytest.mark.parametrize("where", ["tail", "head", "middle"])
def test_nan_samples_are_refused_only_between_the_frames(tmp_path, where):
    signals = plate_signals(2, AMTI_CORNERS, ORIGIN)
    gap = {"tail": slice(-40, None), "head": slice(0, 30), "middle": slice(95, 97)}[where]
    signals[:, gap] = np.nan
    table = GroundReactionTable(
        file=recorded(tmp_path, signals=signals),
        plates=(1,),
        laboratory_axes="+x,+z,-y",
        cutoff_Hz="none",
    )
    frames = np.linspace(0.04, 0.15, 30)
    if where == "middle":
        with pytest.raises(InputError, match=r"not a number at 0\.09"):
            load_ground_reaction(table, frames, "right")
        return
    ground = load_ground_reaction(table, frames, "right")
    time = np.arange(COUNT * RATIO) / 1000.0
    np.testing.assert_allclose(
        ground.force[:, 1], np.interp(frames, time, pushes()[0][:, 2]), atol=0.05
    )
    assert "a.c3d: used from" in ground.remarks[0] and "not numbers" in ground.remarks[0]


def mistaken(folder, kind, factor, **more):
    """Write a plate whose lengths in moments are multiplied by a factor, and its units kept."""
    a, b, z0 = A, B, Z0
    origin = {1: np.zeros(3), 3: np.array([a, b, z0])}.get(kind, ORIGIN)
    signals = plate_signals(kind if kind in (1, 3) else 2, AMTI_CORNERS, origin)
    plate, units = {}, {1: ["N"] * 3 + ["mm"] * 2 + ["Nmm"], 3: ["N"] * 8}.get(kind)
    if kind in (1, 2):
        signals[3 : 5 if kind == 1 else 6] *= factor
    elif kind == 3:
        plate["origin"] = origin * factor
    else:
        channels = 6 if kind == 4 else 8
        matrix = np.random.default_rng(1).normal(0.0, 1.0, (6, channels)) + 3 * np.eye(6, channels)
        signals = np.linalg.pinv(matrix) @ signals
        matrix[3:] *= factor
        plate["matrix"], units = matrix, ["V"] * channels
    return recorded(folder, kind, units, signals, origin=origin, plate=plate, **more)


@pytest.mark.parametrize(
    ("factor", "unit"), [(1.0, None), (1e-3, "m"), (1e3, None), (10.0, None), (0.1, None)]
)
@pytest.mark.parametrize("kind", [1, 2, 3, 4, 5])
def test_a_unit_that_takes_the_pressure_off_the_plate_is_contradicted(tmp_path, kind, factor, unit):
    """Moments in N·m that say N·mm are read. Errors that no usual unit explains are named."""
    plate = read_c3d(mistaken(tmp_path, kind, factor)).plate(1)
    if factor == 1.0 or unit:
        np.testing.assert_allclose(plate.wrench, wrench(), atol=5e-3)
    assert len(plate.notices) == (factor not in (1.0, 0.1))  # a tenth is on the plate, too
    if unit:
        assert ("m puts" if kind in (1, 3) else "N·m puts") in plate.notices[0]
    elif plate.notices:
        assert "lies beside the plate" in plate.notices[0]


@pytest.mark.parametrize(("stated", "true"), [("Nm", "mm"), ("Nmm", "m"), ("Ncm", "m")])
def test_the_unit_of_a_moment_is_read_from_the_plate_if_the_word_is_impossible(
    tmp_path, stated, true
):
    signals = plate_signals(2, AMTI_CORNERS, ORIGIN)
    signals[3:] *= {"mm": 1.0, "m": 1e-3}[true]
    path = recorded(tmp_path, signals=signals, units=["N"] * 3 + [stated] * 3)
    plate = read_c3d(path).plate(1)
    if stated == "Ncm":  # the pressure would move by 2 mm, which is not impossible
        assert plate.notices == ()
        return
    np.testing.assert_allclose(plate.wrench, wrench(), atol=1e-3)
    assert f"N·{true} puts it under a foot" in plate.notices[0]
    path = recorded(tmp_path, signals=signals, units=["N"] * 3 + ["huh"] * 3)
    kept = read_c3d(path, GivenUnits(moment=stated)).plate(1)
    assert "check units, CORNERS and ORIGIN" in kept.notices[0]


@pytest.mark.parametrize(
    ("name", "value", "count"),
    [
        ("FPCOPPOLY", np.full((6, 2, 1), 1e-6), 1),
        ("FPCOPPOLY", np.zeros((6, 2, 1)), 0),
        ("GAIN", [2.0], 1),
        ("TRANSLATION", np.ones((3, 1)), 1),
        ("MODEL", ["OR6-7"], 0),
        ("CHANNEL2", [1.0], 0),
    ],
)
def test_parameters_of_plates_that_are_not_understood_are_named(tmp_path, name, value, count):
    import ezc3d

    path = recorded(tmp_path)
    file = ezc3d.c3d(str(path))
    file.add_parameter("FORCE_PLATFORM", name, value)
    file.write(str(path))
    notices = read_c3d(path).all_notices
    assert len(notices) == count and all(f"FORCE_PLATFORM:{name}" in n for n in notices)


BAD_PLATES = {
    "unknown type": {"type": 21},
    "no surface": {"corners": 0 * AMTI_CORNERS},
    "channel that is not there": {"channels": [1, 2, 3, 4, 5, 99]},
    "one channel twice": {"channels": [1, 2, 3, 4, 5, 5]},
}


@pytest.mark.parametrize("fault", BAD_PLATES)
def test_a_bad_plate_is_refused_only_if_it_is_needed(tmp_path, fault):
    path = recorded(tmp_path, plate=BAD_PLATES[fault])
    recording = read_c3d(path)
    assert recording.plates == () and np.isfinite(recording.points).all()
    assert recording.all_notices
    with pytest.raises(InputError, match="force plate 1"):
        recording.plate(1)


@pytest.mark.parametrize("name", ["arm", "", "J:arm"])
def test_equal_labels_are_refused_only_if_they_are_needed(tmp_path, name):
    import ezc3d

    from tkamb.io.recordings.markers import marker_trajectories
    from tkamb.io.recordings.tables import read_table

    markers = standing_markers() | {"x": np.ones((20, 3)), "y": 2 * np.ones((20, 3))}
    path = write_c3d(tmp_path / "a.c3d", markers)
    file = ezc3d.c3d(str(path))
    file["parameters"]["POINT"]["LABELS"]["value"] = [*list(markers)[:3], name, name]
    file.write(str(path))
    table = read_table(path)
    heel = marker_trajectories(table, ["RHeel"], 1.0)
    np.testing.assert_allclose(heel[:, 0], markers["JW:RHeel"], atol=1e-6)
    if name:
        assert "two markers" in table.notices[0]
        with pytest.raises(InputError, match="two columns named"):
            marker_trajectories(table, [name], 1.0)


def test_equal_channels_are_refused_only_if_they_are_needed(tmp_path):
    import ezc3d

    time = np.arange(200) / 1000.0
    signals = {f"c{k}": np.sin(k + 9 * time) for k in range(3)}
    path = write_c3d(tmp_path / "a.c3d", standing_markers(), analog=signals, units=["V"] * 3)
    file = ezc3d.c3d(str(path))
    file["parameters"]["ANALOG"]["LABELS"]["value"] = ["soleus", "free", "free"]
    file.write(str(path))
    recording = read_c3d(path)
    np.testing.assert_allclose(recording.channel("soleus"), signals["c0"], atol=1e-6)
    with pytest.raises(InputError, match="two channels 'free'"):
        recording.channel("free")
