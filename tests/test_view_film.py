"""Films of a run: refused requests, colours of a GIF, number of frames."""

import io
import shutil

import numpy as np
import pytest
from matplotlib import colormaps
from PIL import Image

from tkamb.errors import InputError
from tkamb.show.view import page as film
from tkamb.show.view.run import open_run
from tkamb.show.view.show import Show
from viewed import shipped_run


def test_a_film_needs_its_suffix_and_a_browser(tmp_path, monkeypatch):
    with pytest.raises(InputError, match=r"'a.mp4' does not end with .gif"):
        film.check_film(tmp_path / "a.mp4", "--gif")
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with pytest.raises(InputError, match="--gif: no browser found; install chromium"):
        film.check_film(tmp_path / "a.gif", "--gif")


def test_a_gif_keeps_the_colours_of_the_scales(tmp_path):
    """A choice of colours by frequency would change this strip of viridis by 36 of 255."""
    grey = np.linspace(225, 255, 400).repeat(300).reshape(400, 300)
    picture = np.repeat(grey[..., None], 3, axis=2).astype(np.uint8)
    strip = (255 * colormaps["viridis"](np.linspace(0, 1, 256))[:, :3]).astype(np.uint8)
    picture[:256, :8] = strip[:, None]
    frames = []
    for shade in (0, 40):
        picture[300:, 100:] = shade
        buffer = io.BytesIO()
        Image.fromarray(picture).save(buffer, "PNG")
        frames.append(buffer.getvalue())
    film._write_gif(iter(frames), tmp_path / "a.gif", 4.0)
    found = Image.open(tmp_path / "a.gif")
    assert found.n_frames == 2
    assert found.info["duration"] == 250
    for k, shade in enumerate((0, 40)):
        found.seek(k)
        drawn = np.asarray(found.convert("RGB")).astype(int)
        assert np.abs(drawn[:256, 4] - strip).max() < 20
        assert np.abs(drawn[350, 200] - shade).max() < 10


@pytest.mark.slow
def test_a_film_has_every_frame_at_the_motions_speed(tmp_path):
    if shutil.which("chromium") is None:
        pytest.skip("chromium is not installed")
    show = Show([open_run(shipped_run())])
    film.write_film(show, tmp_path / "a.gif")
    found = Image.open(tmp_path / "a.gif")
    times = show.drawings[0].times
    assert found.n_frames == len(times)
    expected = 1e3 * (times[-1] - times[0]) / (len(times) - 1)
    assert found.info["duration"] == pytest.approx(min(expected, 1000.0), abs=6)
    pytest.importorskip("imageio_ffmpeg")
    film.write_film(show, tmp_path / "a.mp4")
    assert b"ftyp" in (tmp_path / "a.mp4").read_bytes()[:12]
