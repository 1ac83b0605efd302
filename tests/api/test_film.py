"""morphoctl film, picture and dashboard: what they write, and their errors."""

import struct

import pytest

from service import run
from ctl import CELLS, ctl  # noqa: F401

SMALL = "--size 96x64 --physics n_steps=120"


def png_size(data):
    assert data[:8] == b"\x89PNG\r\n\x1a\n" and data[-8:-4] == b"IEND"
    return struct.unpack(">II", data[16:24])


def test_a_picture(ctl, tmp_path):  # noqa: F811
    file = tmp_path / "two.png"
    assert ctl(f"picture --random 1 {SMALL} --time 0.1 --output", str(file), CELLS)[0] == 0
    assert png_size(file.read_bytes()) == (96, 64)
    short = "picture --size 96x64 --physics n_steps=3 --output"
    assert ctl(short, str(file), CELLS)[0] == 0
    for wrong, words in (("picture --output a.jpg", "name it .png"),
                         (f"picture {SMALL} --time 60 --output a.png", "the rollout ends after"),
                         ("film --time 1 --output a.y4m", "--time is not an option of film")):
        status, _, err = ctl(wrong, CELLS)
        assert status == 2 and words in err, (wrong, err)


def test_files_have_the_suffix_of_their_format(ctl, tmp_path):  # noqa: F811
    """A program that opens a file trusts its suffix. The name is checked before the request."""
    for what, words in (("export designs --output", ".csv, .ndjson"),
                        ("campaign export 1 --curve", "name it .csv"),
                        ("campaign export 1 --phylogeny", "name it .csv"),
                        ("campaign export 1 --learning", "name it .csv"),
                        ("campaign export 1 --replicates", "name it .csv"),
                        ("train export 1 --curve", "name it .csv"),
                        ("train export 1 --validations", "name it .csv"),
                        ("suite picture 1 --output", "name it .svg")):
        for name in ("g.parquet", "g.csv.gz", "g.png"):
            status, _, err = ctl(what, str(tmp_path / name))
            assert status == 2 and words in err, (what, name, err)
    assert list(tmp_path.iterdir()) == []


def test_lists_that_can_be_exported(ctl):  # noqa: F811
    """One job is not a list: the refusal names what to write."""
    for what, status, words in (("7", 2, "evaluations/7/results"),
                                ("evaluations/7", 6, "trajectories/{n}, results or environments")):
        code, out, err = ctl(f"export {what}")
        assert (code, out) == (status, "") and words in err, (what, code, err)


def test_films(ctl, tmp_path):  # noqa: F811
    """0.24 s and one more second of the last frame, at 25 frames per second."""
    stream, folder = tmp_path / "film.y4m", tmp_path / "frames"
    assert ctl(f"film {SMALL} --output", str(stream), CELLS)[0] == 0
    head, *frames = stream.read_bytes().split(b"FRAME\n")
    assert head == b"YUV4MPEG2 W96 H64 F25000:1000 Ip A1:1 C444\n"
    assert len(frames) == 31 and {len(frame) for frame in frames} == {96 * 64 * 3}
    assert frames[0] != frames[5]
    for where in ("-t walk", "-e morpho-12-walk"):
        film = tmp_path / f"{where[1]}.y4m"
        assert ctl(f"film {SMALL} {where} --output", str(film), CELLS)[0] == 0
    walk = (tmp_path / "t.y4m").read_bytes()
    assert walk == (tmp_path / "e.y4m").read_bytes() != stream.read_bytes()
    assert ctl(f"film {SMALL} --rate 5 --light --output", f"{folder}/", CELLS)[0] == 0
    assert sorted(path.name for path in folder.iterdir()) == [f"{n:05}.png" for n in range(6)]
    assert png_size((folder / "00000.png").read_bytes()) == (96, 64)


LOOKS = "--size 96x64 --rate 10"


def test_a_film_of_an_evaluation(ctl, tmp_path):  # noqa: F811
    """Frame by frame, it equals a film that was computed without storing."""
    one, other = tmp_path / "one.y4m", tmp_path / "other.y4m"
    physics = "--physics n_steps=120"
    assert ctl(f"film {LOOKS} {physics} --environment 3 --output", str(one), CELLS)[0] == 0
    status, out, said = ctl(f"eval {LOOKS} {physics} --environment 3 --record-stride 10 --film",
                            str(other), CELLS)
    assert status == 0 and "12 frames" in said and len(out.splitlines()) == 2, said
    assert other.read_bytes() == one.read_bytes() and len(one.read_bytes()) > 12 * 96 * 64 * 3
    folder, paths = tmp_path / "frames", tmp_path / "paths"
    status, _, said = ctl(f"eval {LOOKS} --physics n_steps=40 --random 17 --record com --film",
                          f"{folder}/", "--output", str(paths))
    assert status == 0 and "the 16 best of 17 designs" in said, said
    assert len(list(folder.iterdir())) == 11 and (folder / "00010.png").exists()
    assert len(list(paths.glob("*-masses.npy"))) == len(list(paths.glob("*-com.npy"))) == 170


def test_recordings_that_are_gone(ctl, service):  # noqa: F811
    evaluation = service.evaluate({"designs": [{"cells": [[0, 0, 0]]}], "record": ["com"],
                                   "physics": {"n_steps": 20}}).json()["id"]
    status, out, _ = ctl(f"job prune {evaluation}")
    assert status == 0 and out.startswith(f"evaluation {evaluation}: recordings deleted, 0.0")
    assert ctl("job prune 999999")[0] == 3


def test_a_film_of_champions(ctl, service, tmp_path):  # noqa: F811
    campaign = run(service, "campaigns", {
        "mode": "zero-shot", "population": 8, "generations": 1, "physics": {"n_steps": 20},
        "exclude_pretraining": False
    })["id"]
    film, folder = tmp_path / "champions.y4m", tmp_path / "paths"
    before = len(service.get("/v1/evaluations?limit=1000")["items"])
    status, out, said = ctl(f"campaign champions {campaign} --count 3 {LOOKS} --film", str(film))
    assert status == 0 and len(out.splitlines()) == 4, said
    assert film.read_bytes().startswith(b"YUV4MPEG2 W96 H64 F10000:1000")
    newest, = service.get("/v1/evaluations?limit=1")["items"]
    assert newest["record"] == ["masses"] and newest["n_designs"] == 3
    status, _, said = ctl(f"campaign champions {campaign} --count 2 {LOOKS} --light --film",
                          str(film), "--output", str(folder))
    assert status == 0, said
    assert {path.name.split("-")[-1] for path in folder.iterdir()
            } == {"evaluation.json", "com.npy", "masses.npy"}
    assert len(service.get("/v1/evaluations?limit=1000")["items"]) == before + 2


@pytest.mark.parametrize("command, words", (
    ("eval --film -", "a folder that ends with /"), ("eval --film x.y4m --no-wait", "--wait"),
    ("eval --film x.y4m --size 1x1", "WIDTHxHEIGHT"), ("eval --light", "--light needs --film"),
    ("eval --film x.y4m --environment 64", "--environment"),
    ("campaign champions 1 --film x.y4m --generation 0", "newest generation"),
    ("campaign champions 1 --rate 9", "--rate needs --film")))
def test_films_are_refused_first(ctl, service, command, words):  # noqa: F811
    before = service.get("/v1/evaluations?limit=1")["items"]
    status, _, said = ctl(command, input_text=CELLS)
    assert status == 2 and words in said
    assert service.get("/v1/evaluations?limit=1")["items"] == before, "it was computed anyway"


def test_a_film_needs_ffmpeg(ctl, service):  # noqa: F811
    before = service.get("/v1/evaluations?limit=1")["items"]
    status, _, said = ctl("eval --film x.mp4", input_text=CELLS, PATH="/nonexistent")
    assert status == 1 and "ffmpeg is not installed" in said
    assert service.get("/v1/evaluations?limit=1")["items"] == before
    status, _, said = ctl(f"film {SMALL} --output x.mp4", CELLS, PATH="/nonexistent")
    assert status == 1 and "ffmpeg is not installed" in said


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
