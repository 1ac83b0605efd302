"""Atlases with measures: what bodies have, the order of a measure, histograms and maps, compared
with a plain reading of the file."""

import itertools
import json
import math
import struct

import pytest

from atlases import INFINITY, MEASURES, Plain, file_of
from ctl import ctl  # noqa: F401
from test_atlases import put, tau

SOME = ("displacement_m", "mean_speed_m_per_s", "work_j")
SPEED = "mean_speed_m_per_s"
OF = "/v1/atlases/measured"


@pytest.fixture(scope="module")
def plain():
    return Plain(file_of(levels=20, measures=SOME))


@pytest.fixture(scope="module", autouse=True)
def atlas(service):
    assert put(service, "measured", file_of(levels=20, measures=SOME)).status in (200, 201)


def known(plain, among=None):
    values = plain.measures[SPEED]
    return [i for i in (range(len(values)) if among is None else among)
            if not math.isnan(values[i])]


def test_bodies_have_them(service, plain):
    shown = service.get(OF)
    assert shown["measures"] == list(SOME) and shown["best"] == plain.body(plain.order[0])
    without = 0
    for position in (0, 1, 2, *range(3, 124, 9), plain.order[-1]):
        body = service.get(f"{OF}/body?position={position}")
        assert {key: body[key] for key in plain.body(position)} == plain.body(position)
        assert body["of_size"]["measures"] == pytest.approx(
            {name: plain.percentile(name, position) for name in SOME})
        without += body["measures"]["work_j"] is None
    assert without > 0
    for what in ("neighbors?position=40", "ascent?position=40", "similar?position=40", "best",
                 "footprints", "optima"):
        for item in service.get(f"{OF}/{what}")["items"]:
            item = item.get("best", item)
            assert item["measures"] == plain.body(item["position"])["measures"]


@pytest.mark.parametrize("order", ("descending", "ascending", None))
@pytest.mark.parametrize("voxels", (None, 4))
def test_in_the_order_of_a_measure(service, plain, order, voxels):
    """Pages, and ranges; bodies without a value come last."""
    among = plain.size(voxels) if voxels else range(124)
    expected = plain.by(SPEED, order != "ascending", among)
    values = plain.measures[SPEED]
    path = f"{OF}/best?measure={SPEED}" + (f"&order={order}" if order else "") + (
        f"&voxels={voxels}" if voxels else "")
    found, cursor = [], "0"
    while cursor is not None:
        page = service.get(f"{path}&limit=10&cursor={cursor}")
        assert page["bodies"] == len(among)
        found += [item["position"] for item in page["items"]]
        cursor = page["next_cursor"]
    assert found == expected
    for lo, hi in ((-4, 6), (-1.5, 2), (-1, -0.5), (6, 7)):
        inside = [i for i in expected if lo <= values[i] < hi]
        page = service.get(f"{path}&lo={lo}&hi={hi}&limit=1000")
        assert [item["position"] for item in page["items"]] == inside
        assert page["bodies"] == len(inside)
    # Without an end of the range there, those without a value follow.
    last = {"ascending": "lo=-1"}.get(order, "hi=2")
    inside = [i for i in expected if math.isnan(values[i]) or (
        values[i] >= -1 if order == "ascending" else values[i] < 2)]
    assert [item["position"] for item in service.get(f"{path}&{last}&limit=1000")["items"]
            ] == inside


@pytest.mark.parametrize("order", ("descending", "ascending"))
@pytest.mark.parametrize("score_lo, score_hi", [(None, 0.5), (0.25, None), (0.25, 0.5), (2, 3)])
def test_with_a_range_of_scores(service, plain, order, score_lo, score_hi):
    """A part of the map: the page and its number of bodies are of this part."""
    values, scores = plain.measures[SPEED], plain.scores
    ends = "".join(f"&{name}={end}" for name, end in (("score_lo", score_lo),
                                                      ("score_hi", score_hi)) if end is not None)
    for range_of_values in ("", "&lo=-1.5&hi=2"):
        expected = [i for i in plain.by(SPEED, order != "ascending", range(124))
                    if (score_lo or 0) <= scores[i] < (score_hi or INFINITY) and
                    (not range_of_values or -1.5 <= values[i] < 2)]
        found, cursor = [], "0"
        while cursor is not None:
            page = service.get(f"{OF}/best?measure={SPEED}&order={order}{ends}{range_of_values}"
                               f"&limit=7&cursor={cursor}")
            assert page["bodies"] == len(expected)
            found += [item["position"] for item in page["items"]]
            cursor = page["next_cursor"]
        assert found == expected


def test_histogram_of_a_measure(service, plain):
    values = plain.measures[SPEED]
    shown = service.get(f"{OF}/histogram?measure={SPEED}&bins=7")
    edges = shown["edges"]
    assert edges[0] == min(values[i] for i in known(plain))
    assert edges[-1] > max(values[i] for i in known(plain))
    for n, counts, outside in zip(shown["sizes"], shown["counts"], shown["outside"]):
        inside = known(plain, plain.size(n))
        assert sum(counts) == len(inside) and outside == len(plain.size(n)) - len(inside)
    some = service.get(f"{OF}/histogram?measure={SPEED}&bins=3&lo=-1&hi=2&voxels=5")
    for i in range(3):
        assert some["counts"][0][i] == sum(i - 1 <= values[k] < i for k in plain.size(5))


def test_map(service, plain):
    shown = service.get(f"{OF}/map?measure={SPEED}&bins=5")
    inside = known(plain)
    pairs = [(plain.scores[i], plain.measures[SPEED][i]) for i in inside]
    assert shown["name"] == "measured" and shown["measure"] == SPEED
    assert shown["bodies"] == len(inside) and shown["without_value"] == 124 - len(inside)
    assert shown["outside"] == 0 and shown["kendall_tau"] == pytest.approx(tau(pairs))
    assert sum(map(sum, shown["counts"])) == len(inside)
    for i, k in itertools.product(range(5), repeat=2):
        assert shown["counts"][i][k] == sum(
            shown["edges_score"][i] <= score < shown["edges_score"][i + 1] and
            shown["edges_measure"][k] <= value < shown["edges_measure"][k + 1]
            for score, value in pairs)


def test_scores_are_in_other_order(service, plain):
    """A measure changes nothing of what goes by the score."""
    assert put(service, "plain", file_of(levels=20)).status in (200, 201)
    for what in ("best?limit=1000", "histogram?bins=9", "neighbors?position=50"):
        measured, other = service.get(f"{OF}/{what}"), service.get(f"/v1/atlases/plain/{what}")
        for item in measured.get("items", []):
            del item["measures"]
        assert measured == other


@pytest.mark.parametrize("path,parameter,words", [
    ("measured/best?measure=tilt_rad", "measure", "displacement_m"),
    ("measured/best?measure=speed", "measure", "work_j"),
    ("measured/best?order=descending", "order", "needs a measure"),
    ("measured/best?measure=work_j&order=up", "order", "ascending"),
    ("measured/best?score_lo=0.5", "score_lo", "needs a measure"),
    ("measured/best?score_hi=0.5", "score_hi", "needs a measure"),
    ("measured/best?measure=work_j&score_lo=1&score_hi=0", "score_lo", "must be below score_hi"),
    ("measured/histogram?measure=tilt_rad", "measure", "mean_speed_m_per_s"),
    ("measured/map", "measure", "one of the atlas's measures"),
    ("measured/map?measure=work_j&bins=0", "bins", "1"),
    ("bare/map?measure=work_j", "measure", "has no measures"),
    ("bare/best?measure=work_j", "measure", "has no measures")])
def test_what_is_refused(service, path, parameter, words):
    assert put(service, "bare", file_of(voxels=3)).status in (200, 201)
    reply = service.request("GET", f"/v1/atlases/{path}")
    assert reply.status == 400, reply.body
    error, = reply.json()["errors"]
    assert error["parameter"] == parameter and words in error["detail"]


def test_damaged_measures(service):
    """A wrong set of measures, and a number that cannot be, are refused."""
    data = file_of(levels=20, measures=SOME)
    for at, byte in ((296, 0xff), (len(data) - 12, 0x40), (300, 1)):
        changed = bytearray(data)
        changed[at] ^= byte
        assert put(service, "damaged", bytes(changed)).status == 422
    assert struct.unpack_from("<I", data, 20) == (2, ) and len(MEASURES) == 20


def test_commands(service, plain, ctl):  # noqa: F811
    def run(command):
        code, out, err = ctl("atlas " + command)
        assert code == 0, err
        return out

    assert ", ".join(SOME) in run("show measured")
    value = plain.body(40)["measures"]["work_j"]
    line, = [line for line in run("body measured --position 40").splitlines()
             if line.startswith("work_j")]
    assert f" {value:.6g}, above {plain.percentile('work_j', 40):.2f} % of its size" in line
    lines = run(f"best measured --measure {SPEED} --order ascending --voxels 5 -n 7").splitlines()
    assert lines[0].split()[0] == SPEED
    expected = plain.by(SPEED, False, plain.size(5))[:7]
    assert [line.split()[-1] for line in lines[1:]] == [plain.body(i)["id"] for i in expected]
    assert [float(line.split()[0]) for line in lines[1:]] == pytest.approx(
        [plain.measures[SPEED][i] for i in expected])
    lines = run(f"best measured --measure {SPEED} --score-lo 0.25 --score-hi=0.5 --lo -1.5 "
                "-n 200").splitlines()[1:]
    expected = [i for i in known(plain, plain.by(SPEED, True, range(124)))
                if 0.25 <= plain.scores[i] < 0.5 and plain.measures[SPEED][i] >= -1.5]
    assert [line.split()[-1] for line in lines] == [plain.body(i)["id"] for i in expected]
    code, _, err = ctl("atlas best measured --score-lo 0.25")
    assert code == 6 and "needs a measure" in err
    shown = run(f"histogram measured --measure {SPEED} --bins 7").splitlines()
    assert len(shown) == 8 and shown[-1].endswith("without a value")
    found = json.loads(run(f"map measured {SPEED} --bins 4 --json"))
    assert found == service.get(f"{OF}/map?measure={SPEED}&bins=4")
    shown = run(f"map measured {SPEED} --bins 4")
    assert f"Kendall's tau  {found['kendall_tau']:.4f}" in shown
    assert f"{found['bodies']} with a value; {found['without_value']} without" in shown
