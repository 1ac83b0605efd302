"""morphoctl film, picture and dashboard: what they write, and what they say when they cannot."""

import struct

import pytest

from test_morphoctl import CELLS, ctl  # noqa: F401

SMALL = "--size 96x64 --physics n_steps=60"


def png_size(data):
    assert data[:8] == b"\x89PNG\r\n\x1a\n" and data[-8:-4] == b"IEND"
    return struct.unpack(">II", data[16:24])


def test_a_picture(ctl, tmp_path):  # noqa: F811
    file = tmp_path / "two.png"
    assert ctl(f"picture --random 1 {SMALL} --time 0.1 --output", str(file), CELLS)[0] == 0
    assert png_size(file.read_bytes()) == (96, 64)
    short = "picture --size 96x64 --physics n_steps=3 --output"
    assert ctl(short, str(file), CELLS)[0] == 0


def test_films(ctl, tmp_path):  # noqa: F811
    """0.24 s and one second of the last frame, at 25 frames a second."""
    stream, folder = tmp_path / "film.y4m", tmp_path / "frames"
    assert ctl(f"film {SMALL} --output", str(stream), CELLS)[0] == 0
    head, *frames = stream.read_bytes().split(b"FRAME\n")
    assert head == b"YUV4MPEG2 W96 H64 F25000:1000 Ip A1:1 C444\n"
    assert len(frames) == 31 and {len(frame) for frame in frames} == {96 * 64 * 3}
    assert frames[0] != frames[5]
    assert ctl(f"film {SMALL} --rate 5 --light --output", f"{folder}/", CELLS)[0] == 0
    assert sorted(path.name for path in folder.iterdir()) == [f"{n:05}.png" for n in range(6)]
    assert png_size((folder / "00000.png").read_bytes()) == (96, 64)


@pytest.mark.parametrize("options, words", (
    ("--output x.png --size 10x10", "WIDTHxHEIGHT"), ("--output x.png --size 96", "WIDTHxHEIGHT"),
    ("--output x.png --size 4294967424x128", "WIDTHxHEIGHT"),
    ("--output x.png --environment 11", "--environment"), ("--output x.png --pitch 91", "--pitch"),
    ("", "--output is missing"), ("--output x.png --random 17", "--random")))
def test_what_cannot_be_drawn(ctl, options, words):  # noqa: F811
    status, _, said = ctl(f"picture {options}", CELLS)
    assert status == 2 and words in said


def test_where_the_dashboard_is(ctl, service):  # noqa: F811
    assert ctl("dashboard")[1].strip() == service.addresses[0] + "/"
    shown = ctl("dashboard", MORPHOD_TOKEN="a-token/of-20&more")[1]
    assert shown.strip() == service.addresses[0] + "/#token=a-token%2Fof-20%26more"
