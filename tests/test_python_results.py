"""Results in Python: representation in notebooks, data frames, PyVista and ParaView."""

import importlib
import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

import tkamb
from kept_runs import keep
from synthetic_run import make_run
from tkamb.cli import main
from tkamb.errors import InputError
from tkamb.io.recordings.meshes import read_triangles

RUN = make_run("gait", frames=11)


def test_the_package_lists_its_public_names_and_its_version():
    assert dir(tkamb) == sorted(tkamb.__all__)
    assert tkamb.__version__ == importlib.metadata.version("tkamb")
    with pytest.raises(AttributeError, match="simulat"):
        _ = tkamb.simulat


def test_the_representation_of_a_run_is_one_line():
    text = repr(make_run("bend", frames=5, maps=False))
    assert "5 frames, synthetic" in text and "no maps" in text and "\n" not in text
    assert f"maps of {len(RUN.maps.points_m)} points" in repr(RUN)


def test_the_data_frame_has_the_columns():
    pandas = pytest.importorskip("pandas", reason="pandas is not installed")
    frame = RUN.to_dataframe()
    assert isinstance(frame, pandas.DataFrame)
    assert list(frame.columns) == list(RUN.columns) and len(frame) == 11
    np.testing.assert_array_equal(frame["force_total_N"], RUN["force_total_N"])
    assert list(frame["status"]) == RUN.status


@pytest.mark.parametrize(
    ("package", "call"),
    [("pandas", RUN.to_dataframe), ("pyvista", RUN.maps.to_pyvista)],
)
def test_a_missing_extra_is_refused_with_its_installation(monkeypatch, package, call):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(InputError, match=r"not installed; pip install 'tkamb\[notebook\]'"):
        call()


def test_pyvista_has_one_block_per_frame_with_the_pressure():
    pytest.importorskip("pyvista", reason="PyVista is not installed")
    blocks = RUN.maps.to_pyvista()
    assert len(blocks) == 11
    block = blocks["frame 4"]
    np.testing.assert_array_equal(block.point_data["pressure_Pa"], RUN.maps.pressure_Pa[4])
    assert block.n_cells == len(RUN.maps.triangles)
    assert block.field_data["time_s"][0] == RUN["time_s"][4]


def test_the_time_series_for_paraview_has_a_file_for_each_map(tmp_path, capsys):
    maps = make_run("gait", frames=11).maps
    maps.pressure_Pa[3] = np.nan  # like a failed frame
    keep(RUN, tmp_path / "run", maps)
    out = tmp_path / "vtk"
    assert main(["export", str(tmp_path / "run"), "--vtp", "--out", str(out)]) == 0
    assert "10 of 11 frames" in capsys.readouterr().out
    sets = ElementTree.parse(out / "contact.pvd").getroot().findall("Collection/DataSet")
    times = [float(item.get("timestep")) for item in sets]
    assert times == [t for k, t in enumerate(RUN["time_s"]) if k != 3]
    for item in sets:
        _, faces = read_triangles(out / item.get("file"))
        np.testing.assert_array_equal(faces, maps.triangles)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--vtp"], "--vtp: needs --out"),
        (["--sto", "a.sto", "--out", "b"], "--out: needs --vtp or --figures or --deck"),
        (["--deck", "ccx", "--out", "a.inp"], "--deck: needs --frame"),
        (["--deck", "ccx", "--frame", "0", "--out", "a.feb"], "is not a .inp file"),
    ],
)
def test_options_that_do_not_belong_together_are_refused(tmp_path, capsys, arguments, words):
    assert main(["export", str(tmp_path), *arguments]) == 2
    output = capsys.readouterr().err
    assert words in output and output.count("\n") == 1


def test_titles_legends_and_plots_do_not_overlap():
    """With measured forces the legend has several rows."""
    measured = {
        f"measured_{name}_N": RUN["force_total_N"] for name in ("total", "medial", "lateral")
    }
    figure = tkamb.plot(type(RUN)(RUN.columns | measured, RUN.summary))
    figure.draw_without_rendering()
    boxes = [
        part.get_window_extent()
        for axes in figure.axes
        if axes.get_legend()
        for part in (axes._left_title, axes.get_legend(), axes.patch)
    ]
    for k, item in enumerate(boxes):
        assert not any(item.overlaps(other) for other in boxes[k + 1 :] if not touches(item, other))
    assert len(boxes) >= 9


def touches(item, other):
    """Return whether two boxes share an edge only."""
    return min(item.y1, other.y1) - max(item.y0, other.y0) < 0.5


def test_representations_of_reports_results_maps_and_scenes_are_short():
    from tkamb.run.press import press_meshes

    files = Path(tkamb.__file__).parent / "io" / "starter" / "files"
    report = press_meshes(
        files / "femoral_component.stl",
        files / "insert.stl",
        1500.0,
        pose=(-6.9, 30.7, 0, 0, 0, 0),
        contact="foundation",
        resolution_mm=4.0,
    )
    for item in (report, report.result, RUN.maps, tkamb.load_scene(files / "scene.toml")):
        assert repr(item).startswith(f"<tkamb.{type(item).__name__}: ")
        assert len(repr(item)) < 250
    assert f"medial {report.result.medial.force:.0f} N" in repr(report)
