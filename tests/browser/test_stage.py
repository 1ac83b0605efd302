"""The stage: it agrees with the recording, and its exports are correct."""

import json
import re
import shlex
import struct
import subprocess

import numpy
import pytest

from service import DESIGN
from test_tray import module

PIXELS_PER_M = 260


def test_masses_are_where_the_recording_has_them(service, browser):
    """Seen from above without perspective, the outline of a robot equals that of its masses."""
    browser.open("stage?environment=2")
    browser.until_walking()
    browser.run("""
        const { player } = document.querySelector('.stage');
        player.setPlaying(false);
        player.held = true; // only this test draws
        const { stage } = player;
        Object.assign(stage, { sideBySide: false, follow: false, shadows: false, scale: 1 });
        player.setRobots(stage.robots.slice(0, 1));
        player.held = true;
        stage.sideBySide = false;
        stage.show = { skin: true, springs: false, trails: false, contacts: false };
        const above = { pitch: Math.PI / 2, yaw: 0, distanceM: 8, pixelsPerM: arguments[0] };
        Object.assign(stage.camera, above);
        window.drawAt = (time) => { stage.timeS = time; player.setPlaying(false); stage.draw(); };
    """, PIXELS_PER_M)
    for time in (0, 1.0, 3.2):
        masses = browser.run("""
            const { stage } = document.querySelector('.stage').player;
            drawAt(arguments[0]);
            const robot = stage.robots[0];
            const frame = Math.round(stage.frameOf(robot));
            const n = robot.body.nMasses;
            return [...robot.track.subarray(frame * n * 3, (frame + 1) * n * 3)];
        """, time)
        rows = [masses[i:i + 3] for i in range(0, len(masses), 3)]
        middle = [sum(row[axis] for row in rows) / len(rows) for axis in range(2)]
        browser.run("""const { stage } = document.querySelector('.stage').player;
            stage.camera.target = [arguments[0], arguments[1], 0];
            drawAt(arguments[2]);""", *middle, time)
        with_robot = browser.pixels(".stage canvas")
        browser.run("const { stage } = document.querySelector('.stage').player;"
                    "stage.show.skin = false; stage.draw(); stage.show.skin = true;")
        without = browser.pixels(".stage canvas")
        height, width, _ = with_robot.shape
        apart = abs(with_robot[:, :, :3].astype(int) - without[:, :, :3]).max(axis=2)
        changed = numpy.argwhere(apart > 24)[:, ::-1]  # x, y
        assert len(changed), "the robot is not visible"
        scale = width / browser.run("return document.querySelector('.stage canvas').width")
        assert scale == 1
        for axis, side in ((0, 1), (1, -1)):
            places = side * (changed[:, axis] + 0.5 - (width, height)[axis] / 2) / PIXELS_PER_M
            for best, seen in ((min, places.min()), (max, places.max())):
                reported = best(row[axis] for row in rows)
                assert seen + middle[axis] == pytest.approx(reported, abs=0.01), (time, axis)


def test_what_springs_do_and_what_touches_the_ground(service, browser):
    """The stage has the channels of the recording, and they affect the drawing."""
    browser.open("stage?environment=2")
    browser.until_walking()
    shapes = browser.run("""
        const { player, player: { stage } } = document.querySelector('.stage');
        player.setPlaying(false);
        player.held = true;
        Object.assign(stage, { sideBySide: false, shadows: false, scale: 1, timeS: 2 });
        stage.show = { skin: false, springs: true, trails: false, contacts: false };
        return stage.robots.map(({ body, frames, actuation, contacts }) => [
          actuation.length === frames * body.nSprings, contacts.length === frames * body.nMasses,
          actuation.some((output) => Math.abs(output) > 60), contacts.some(Boolean)]);
    """)
    assert shapes and all(row == [True] * 4 for row in shapes)

    def drawn(script):
        browser.run("const { stage } = document.querySelector('.stage').player;" + script +
                    "stage.draw();")
        return browser.pixels(".stage canvas").tobytes()

    by_strain = drawn("")
    by_actuation = drawn("stage.show.actuation = true;")
    assert by_strain != by_actuation
    passive = drawn(
        "stage.robots.forEach((robot) => { robot.gpu.actuation = stage.noActuation; });")
    assert by_actuation != passive
    touching = drawn("stage.show.contacts = true;")
    assert touching != passive
    lifted = drawn("stage.robots.forEach((robot) => { robot.gpu.contacts = stage.noContacts; });")
    assert lifted == passive, "a ring where the recording has no contact"


@pytest.fixture(scope="module")
def model(service, browser, tmp_path_factory):
    """A robot as a GLB file, its number of masses, the time of a frame, and its recording."""
    design = service.evaluate({"designs": [DESIGN]}).json()["results"][0]["id"]
    browser.open(f"stage?designs={design}")
    browser.until_walking()
    data = browser.driver.execute_async_script("""
        const done = arguments[arguments.length - 1];
        const folder = document.querySelector('script[type=module]').src.replace(/app.js$/, '');
        import(folder + 'export/glb.js').then(({ toGlb }) => {
          const robot = document.querySelector('.stage').player.stage.robots[0];
          const n = robot.body.nMasses;
          done([[...toGlb(robot)], n, robot.frameS, [...robot.track]]);
        });
    """)
    file = tmp_path_factory.mktemp("model") / "robot.glb"
    file.write_bytes(bytes(data[0]))
    return file, *data[1:]


class Glb:
    """Reads a file of glTF 2.0 with one mesh."""
    def __init__(self, file):
        blob = file.read_bytes()
        magic, version, length, size, kind = struct.unpack_from("<4sIII4s", blob)
        assert (magic, version, length, kind) == (b"glTF", 2, len(blob), b"JSON")
        self.blob, self.start = blob, 20 + size + 8
        self.header = json.loads(blob[20:20 + size])
        [mesh] = self.header["meshes"]
        [self.primitive] = mesh["primitives"]
        self.base = self.read(self.primitive["attributes"]["POSITION"])
        self.targets = [self.read(target["POSITION"]) for target in self.primitive["targets"]]

    def read(self, index):
        accessor = self.header["accessors"][index]
        view = self.header["bufferViews"][accessor["bufferView"]]
        width = {"SCALAR": 1, "VEC3": 3}[accessor["type"]]
        form = {5126: "f", 5123: "H"}[accessor["componentType"]]
        return struct.unpack_from(f"<{accessor['count'] * width}{form}", self.blob,
                                  self.start + view["byteOffset"])

    def shape(self, weights):
        """Returns the positions of the masses with these weights of the targets, as a flat list."""
        used = [(weight, target) for weight, target in zip(weights, self.targets) if weight]
        return [place + sum(weight * target[k] for weight, target in used)
                for k, place in enumerate(self.base)]


def test_a_model_for_other_programs(model):
    """GLB: at least 25 frames per second, and every mass within 1 mm at every frame."""
    file, n, frame_s, track = model
    glb = Glb(file)
    sampler = glb.header["animations"][0]["samplers"][0]
    times, weights = glb.read(sampler["input"]), glb.read(sampler["output"])
    assert (len(times) - 1) / times[-1] >= 25 - 1e-6
    for i, time in enumerate(times):
        frame = round(time / frame_s)
        shown = glb.shape(weights[i * len(glb.targets):(i + 1) * len(glb.targets)])
        assert shown == pytest.approx(track[frame * n * 3:(frame + 1) * n * 3], abs=0.001)
    assert max(glb.read(glb.primitive["indices"])) < n


def test_assimp_loads_the_model(model):
    """assimp finds one mesh with every mass, a target per frame, and the animation. The file that
    it saves also has every mass within 1 mm."""
    file, n, frame_s, track = model
    info = subprocess.run(["assimp", "info", file], capture_output=True, text=True, check=True)
    reported = dict(re.findall(r"^(\w+): +(\d+)$", info.stdout, re.M))
    faces = len(Glb(file).read(Glb(file).primitive["indices"])) // 3
    counts = {"Meshes": 1, "Animations": 1, "Vertices": n, "Faces": faces}
    assert {name: int(reported[name]) for name in counts} == counts
    saved = file.with_name("saved.glb")
    subprocess.run(["assimp", "export", file, saved, "-fglb2"], capture_output=True, check=True)
    glb = Glb(saved)
    every = round(0.04 / frame_s)
    frames = range(0, len(track) // (3 * n), every)
    assert len(glb.base) == 3 * n and len(glb.targets) == len(frames) - 1
    for i, frame in enumerate(frames):
        shown = glb.shape([target == i - 1 for target in range(len(glb.targets))])
        assert shown == pytest.approx(track[frame * n * 3:(frame + 1) * n * 3], abs=0.001)


@pytest.mark.parametrize("is_race, ghosts", [(False, False), (True, False), (True, True)])
def test_a_page_of_its_own(service, browser, tmp_path, is_race, ghosts):
    """The saved page needs no service: the robots walk from a file, side by side, in lanes, or as
    ghosts, of which the leader is opaque."""
    ids = [row["robot"] for row in service.evaluate(
        {"designs": [DESIGN, {"cells": [[0, 0, 0], [1, 0, 0]]}]}).json()["results"]]
    browser.open(f"stage?designs={','.join(ids)}")
    browser.until_walking()
    text = browser.driver.execute_async_script("""
        const [isRace, ghosts, done] = arguments;
        const folder = document.querySelector('script[type=module]').src.replace(/app.js$/, '');
        import(folder + 'export/page.js').then(async ({ toPage }) => {
          const { stage } = document.querySelector('.stage').player;
          const page = await toPage(stage.robots, 'A </script><b>race</b>', isRace, ghosts);
          done(await page.text());
        });
    """, is_race, ghosts)
    leaders = module(browser, "stage/race.js", """
        const { stage: { robots } } = document.querySelector('.stage').player;
        const race = of.raceOf(robots);
        done(Array.from({ length: robots[0].frames }, (_, frame) =>
          robots.indexOf(of.orderAt(race, frame * robots[0].frameS)[0].robot)));""")
    if not ghosts:
        leaders = []  # only among ghosts does the leader look different
    assert f'"leaders":{json.dumps(leaders, separators=(",", ":"))},' in text
    file = tmp_path / "race.html"
    file.write_text(text)
    browser.driver.get(file.as_uri())
    browser.until("document.querySelector('canvas').height > 50")
    browser.until("document.getElementById('time').value > 0.02")
    assert browser.run("return window.faults") == []
    assert browser.run("return document.title") == "A </script><b>race</b>"
    first = browser.pixels()
    assert len({row.tobytes() for row in first}) > 20, "the page draws nothing"
    side = "return document.getElementById('side').getAttribute('aria-pressed')"
    assert browser.run(side) == str(not is_race).lower()
    assert ('"areGhosts":true' in text) == ghosts
    browser.run("document.getElementById('side').click()")
    browser.until(f"document.getElementById('side').getAttribute('aria-pressed') === '{is_race}'"
                  .replace("True", "true").replace("False", "false"))
    assert browser.run("return window.faults") == []


def test_a_link_holds_the_view(service, browser):
    design = service.evaluate({"designs": [DESIGN]}).json()["results"][0]["id"]
    view = "2.500_2.400_0.200_1.000_0.500_1.800"
    browser.open(f"stage?designs={design}&environment=4&show=springs,trails&view={view}")
    browser.until_walking()
    state = browser.run("""
        const { player, player: { stage } } = document.querySelector('.stage');
        return [player.shown(), stage.camera.toText(), stage.follow, stage.robots.length];
    """)
    assert state == [["springs", "trails"], view, False, 1]
    assert f"designs={design}" in browser.driver.current_url


def test_a_race_and_its_link(service, browser):
    """Robots in lanes, each with its name and color. The link shows the same again."""
    ids = [row["robot"] for row in service.evaluate(
        {"designs": [DESIGN, {"cells": [[0, 0, 0], [1, 0, 0]]}]}).json()["results"]]
    browser.open(f"stage?designs={','.join(ids)}&environment=2")
    browser.until_walking()
    browser.click("Race")
    browser.click("Springs")
    browser.run("""
        const { player } = document.querySelector('.stage');
        [...player.names.querySelectorAll('.rows button')]
          .find((row) => row.title.startsWith(arguments[0])).click();
        player.speedSelect.value = '0.25';
        player.speedSelect.dispatchEvent(new Event('change'));
        player.slider.value = '1.5';
        player.slider.dispatchEvent(new Event('input'));
        player.canvas.focus();
        player.canvas.dispatchEvent(new KeyboardEvent('keydown', { key: 'ArrowLeft' }));
    """, ids[1])
    tags = """
      const { player, player: { stage } } = document.querySelector('.stage');
      stage.draw();
      player.tags.place(stage, player.standings.order);
      return [...document.querySelectorAll('.tag')].map((e) => {
        const { x, y } = e.getBoundingClientRect();
        return [e.children[1].innerText, getComputedStyle(e).borderLeftColor, Math.round(x),
          Math.round(y)];
    })"""
    state = """
        const { player, player: { stage } } = document.querySelector('.stage');
        return { ...player.view(), side: stage.sideBySide, followed: stage.followed,
          views: stage.views().length, playing: player.playing };
    """
    browser.until("/time=1.50/.test(location.hash) && /follow=1/.test(location.hash)")
    link, reported, named = browser.driver.current_url, browser.run(state), browser.run(tags)
    assert reported["views"] == 1 and not reported["side"] and not reported["playing"]
    names = module(browser, "lib/names.js", "done(arguments[1].map(of.nameOf))", ids)
    assert [name for name, *_ in named] == names
    titles = browser.run("return [...document.querySelectorAll('.names .rows button')]"
                         ".map((e) => e.title)")
    assert sorted(titles) == sorted(f"{id}: follow this robot" for id in ids)
    assert len({color for _, color, *_ in named}) == 2
    browser.open(link.split("#/")[1])
    browser.until_walking()
    browser.until("document.querySelector('.stage').player.speed === 0.25")
    assert browser.run(state) == reported
    browser.until("document.querySelectorAll('.tag').length === 2")
    for (*before, x, y), (*after, also_x, also_y) in zip(named, browser.run(tags)):
        assert before == after and abs(x - also_x) <= 1 and abs(y - also_y) <= 1
    assert browser.faults() == []


def test_recordings_of_an_evaluation(service, browser):
    """Reached from the page of the evaluation. The stage has exactly the recorded numbers."""
    job = service.evaluate({
        "designs": [DESIGN, {"cells": [[0, 0, 0], [1, 0, 0]]}], "physics": {"n_steps": 50},
        "record": ["masses", "contacts"], "record_stride": 5,
        "environments": [{"light_xy_m": [4.0, y], "terrain_sigma_m": 0.05, "seed": 3}
                         for y in (1.0, 3.0)]
    }).json()
    path = f"/v1/evaluations/{job['id']}/trajectories"
    best = min((0, 1), key=lambda row: job["results"][row]["score"])
    browser.open(f"designs?evaluation={job['id']}")
    browser.click("Show recordings")
    tracks = ("const { stage } = document.querySelector('.stage').player;"
              "return stage.robots.map(({ track }) => [...track])")
    browser.until_walking()
    assert browser.run("return document.querySelector('.world a').hash") == (
        f"#/evaluations/{job['id']}")
    for environment in (0, 1):
        browser.until_walking()
        reported = [service.request("GET", f"{path}/{row}/file?environment={environment}").body
                for row in (best, 1 - best)]
        reported = [list(struct.unpack(f"<{len(one) // 4}f", one)) for one in reported]
        browser.until(f"location.hash.includes('environment={environment}')")
        assert browser.run(tracks) == reported
        browser.run("const e = [...document.querySelectorAll('.stage select')].at(-1);"
                    "e.value = '1'; e.dispatchEvent(new Event('change'))")
        browser.until(
            "document.querySelector('.stage').player.stage.robots[0].world.light[1] === 3")
    browser.open(browser.driver.current_url.split("#/")[1])  # the link shows the same again
    browser.until_walking()
    assert browser.run(tracks) == reported and browser.faults() == []
    service.request("DELETE", path)
    browser.open(f"designs?evaluation={job['id']}")
    browser.until("/recordings were removed/.test(document.querySelector('main').innerText)")
    assert "Show recordings" not in browser.texts("main button:not([hidden])")


def test_commands_to_copy_are_safe_to_paste(service, browser):
    """A value from an address is one word of a shell, or is refused."""
    browser.open("stage?designs=$(touch%20x)")
    assert "$(touch x) is not a design" in browser.texts("main .error")[0]
    assert browser.texts("main button, pre, canvas") == []
    browser.open("stage?controller=a';b;'")
    browser.click("Commands")
    browser.until("document.querySelector('dialog[open] pre')")
    curl, film, python = browser.texts("dialog pre")
    assert "touch" not in curl + film + python
    words = shlex.split(film)
    assert words[words.index("--controller") + 1] == "a';b;'"
