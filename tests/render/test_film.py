"""Films, read back by other programs where available."""

import subprocess
import sys

import numpy as np
import pytest

from command_line import invoke
from small_runs import ball, write_run
from warp_lcp.render.film import Film, check_rate, film_suffix
from warp_lcp.render.image_content import RenderError

Image = pytest.importorskip(
    "PIL.Image", reason="films need Pillow, which comes with the extra `render`"
)
WIDTH, HEIGHT = 320, 241  # an odd height, which H.264 cannot have


@pytest.fixture
def encoder():
    return pytest.importorskip(
        "imageio_ffmpeg", reason="MP4 films need imageio-ffmpeg, the extra `render`"
    )


def picture(number: int) -> "Image.Image":
    """Return a white image with a square of its own color and place."""
    pixels = np.full((HEIGHT, WIDTH, 3), 255, dtype=np.uint8)
    pixels[100:140, 20 * number : 20 * number + 40] = (200, 40 + 10 * number, 30)
    return Image.fromarray(pixels)


def shoot(file, count, rate):
    with Film(file, (WIDTH, HEIGHT), rate) as film:
        for number in range(count):
            film.add(lambda number=number: picture(number))
    return file


def test_a_gif_holds_the_images_their_times_and_repeats(encoder, tmp_path):
    with Image.open(shoot(tmp_path / "film.gif", 12, 30.0)) as film:
        assert film.n_frames == 12
        assert film.size == (WIDTH, HEIGHT)
        assert film.info["loop"] == 0
        durations = []
        for number in range(12):
            film.seek(number)
            durations.append(film.info["duration"])
            np.testing.assert_allclose(
                np.asarray(film.convert("RGB"), dtype=int), np.asarray(picture(number)), atol=8
            )
    # Milliseconds: 12 images at 30 per second, though a GIF resolves only hundredths of a second.
    assert sum(durations) == 400
    assert set(durations) == {30, 40}


def test_images_that_do_not_change_stay(encoder, tmp_path):
    with Film(tmp_path / "still.gif", (WIDTH, HEIGHT), 10.0) as film:
        for _ in range(5):
            film.add(lambda: picture(3))
    with Image.open(tmp_path / "still.gif") as read:
        assert sum(int(read.seek(n) or read.info["duration"]) for n in range(read.n_frames)) == 500
        np.testing.assert_allclose(
            np.asarray(read.convert("RGB"), dtype=int), np.asarray(picture(3)), atol=8
        )


def test_a_gif_leaves_out_what_viewers_cannot_play(encoder, tmp_path):
    drawn = []
    with Film(tmp_path / "fast.gif", (WIDTH, HEIGHT), 120.0) as film:
        for number in range(12):
            film.add(lambda number=number: drawn.append(number) or picture(number))
    assert drawn == [0, 3, 6, 9]
    with Image.open(tmp_path / "fast.gif") as read:
        assert read.n_frames == 4


def test_an_mp4_holds_the_images(encoder, tmp_path):
    file = shoot(tmp_path / "film.mp4", 10, 24.0)
    assert file.read_bytes()[4:8] == b"ftyp"
    count, seconds = encoder.count_frames_and_secs(str(file))
    assert count == 10
    assert seconds == pytest.approx(10 / 24, abs=0.02)
    command = [
        encoder.get_ffmpeg_exe(),
        "-v",
        "error",
        "-i",
        str(file),
        "-f",
        "rawvideo",
        "-pix_fmt",
        "rgb24",
        "-",
    ]
    raw = subprocess.run(command, capture_output=True, check=True).stdout
    frames = (
        np.frombuffer(raw, dtype=np.uint8).reshape(10, HEIGHT + 1, WIDTH, 3).astype(int)[:, :HEIGHT]
    )
    for number, pixels in enumerate(frames):
        assert np.abs(pixels - np.asarray(picture(number))).mean() < 2.0  # H.264 loses a little


@pytest.mark.usefixtures("only_new_objects")
@pytest.mark.parametrize("suffix", [".gif", ".mp4"])
def test_images_are_drawn_one_at_a_time(encoder, tmp_path, suffix):
    """Images of a film, drawn one at a time.

    An image is requested after the one before was used, and none stays in memory.
    """
    import gc
    import weakref

    alive: list[weakref.ref] = []

    def draw(number):
        gc.collect()
        assert sum(reference() is not None for reference in alive) <= 1
        image = picture(number)
        alive.append(weakref.ref(image))
        return image

    with Film(tmp_path / f"film{suffix}", (WIDTH, HEIGHT), 30.0) as film:
        for number in range(12):
            film.add(lambda number=number: draw(number))
    assert len(alive) == 12


@pytest.mark.parametrize("suffix", [".gif", ".mp4"])
def test_a_film_that_is_not_finished_leaves_nothing(encoder, tmp_path, suffix):
    file = tmp_path / f"film{suffix}"
    file.write_bytes(b"an older film")
    with pytest.raises(KeyError), Film(file, (WIDTH, HEIGHT), 30.0) as film:
        film.add(lambda: picture(1))
        raise KeyError
    assert file.read_bytes() == b"an older film"
    assert [entry.name for entry in tmp_path.iterdir()] == [file.name]


@pytest.mark.parametrize("suffix", [".gif", ".mp4"])
def test_a_film_that_cannot_be_written(encoder, tmp_path, suffix):
    (tmp_path / "file").write_text("")
    with pytest.raises(RenderError, match="cannot be written"):
        shoot(tmp_path / "file" / f"film{suffix}", 2, 30.0)


@pytest.mark.parametrize("suffix", [".gif", ".mp4"])
def test_without_an_encoder_the_command_says_what_to_install(dots, tmp_path, monkeypatch, suffix):
    pytest.importorskip("pyvista")
    folder = write_run(tmp_path / "run", [[ball([0.5, 0.5], 0.2)]])
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    result = invoke("render", folder, "--film", tmp_path / f"film{suffix}")
    assert result.exit_code == 2
    assert "pip install 'imageio-ffmpeg" in result.stderr
    assert not (tmp_path / f"film{suffix}").exists()
    assert not list(tmp_path.glob(".film*"))


def test_kinds_and_rates(tmp_path):
    assert film_suffix(tmp_path / "a.GIF") == ".gif"
    assert check_rate(None) is None
    for name in ("a.avi", "a", "a.mp4.png"):
        with pytest.raises(RenderError, match=r"must end in \.mp4 or \.gif"):
            film_suffix(tmp_path / name)
    (tmp_path / "b.mp4").mkdir()
    with pytest.raises(RenderError, match="is a folder"):
        film_suffix(tmp_path / "b.mp4")
    for rate in (0.0, -3.0, 1000.0, float("nan")):
        with pytest.raises(RenderError, match="frames a second"):
            check_rate(rate)


@pytest.mark.default_cases(1)
@pytest.mark.parametrize("suffix", ["gif", "mp4"])
def test_the_command_films_a_run(encoder, dots, tmp_path, suffix):
    pytest.importorskip("pyvista")
    folder = write_run(
        tmp_path / "run", [[ball([0.2 + 0.1 * number, 0.5], 0.15)] for number in range(5)]
    )
    film = tmp_path / "new" / f"film.{suffix}"
    result = invoke("render", folder, "--film", film, "--size", "320x240")
    assert result.exit_code == 0, result.stderr
    assert f"{film}: 5 frames" in result.stdout
    if suffix == "mp4":
        # The scene's frames per second.
        assert encoder.count_frames_and_secs(str(film)) == (5, pytest.approx(5 / 20, abs=0.02))
        return
    with Image.open(film) as read:
        assert read.n_frames == 5
        assert read.info["duration"] == 50
    assert (
        invoke("render", folder, "--film", film, "--size", "320x240", "--fps", "5").exit_code == 0
    )
    with Image.open(film) as read:
        assert read.info["duration"] == 200


@pytest.mark.parametrize("arguments", [["--frame", "1"], ["--sheet"], ["--out", "x"]])
def test_options_that_a_film_does_not_have(dots, tmp_path, arguments):
    folder = write_run(tmp_path / "run", [[ball([0.5, 0.5], 0.2)]])
    result = invoke("render", folder, "--film", tmp_path / "film.gif", *arguments)
    assert result.exit_code == 2
    assert "cannot be combined with --frame, --frames, --sheet or --out" in result.stderr.replace(
        "\n", " "
    )
