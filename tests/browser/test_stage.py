"""The stage: what it shows agrees with the recording; what is saved from it is right."""

import json
import shlex
import struct

import pytest

from service import DESIGN

PIXELS_PER_M = 260


def test_masses_are_where_the_recording_has_them(service, browser):
    """Seen from above without perspective, the outline of a robot is that of its masses."""
    browser.open("stage?environment=2")
    browser.until_walking()
    browser.run("""
        const { player } = document.querySelector('.stage');
        player.setPlaying(false);
        const { stage } = player;
        Object.assign(stage, { sideBySide: false, follow: false, shadows: false, scale: 1 });
        player.setRobots(stage.robots.slice(0, 1));
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
        width, height, step, _ = with_robot
        changed = [(x, y) for y in range(height) for x in range(width)
                   if max(abs(with_robot[3][y][x * step + c] - without[3][y][x * step + c])
                          for c in range(3)) > 24]
        assert changed, "the robot is not seen"
        scale = width / browser.run("return document.querySelector('.stage canvas').width")
        assert scale == 1
        for axis, side in ((0, 1), (1, -1)):
            places = [side * ((at[axis] + 0.5) - (width, height)[axis] / 2) / PIXELS_PER_M +
                      middle[axis] for at in changed]
            for best, seen in ((min, min(places)), (max, max(places))):
                told = best(row[axis] for row in rows)
                assert seen == pytest.approx(told, abs=0.01), (time, axis)


def test_a_model_for_other_programs(service, browser):
    """GLB: at least 25 frames a second, and every mass within 1 mm at every frame."""
    browser.open("stage")
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
    blob, n, frame_s, track = bytes(data[0]), *data[1:]
    magic, version, length, size, kind = struct.unpack_from("<4sIII4s", blob)
    assert (magic, version, length, kind) == (b"glTF", 2, len(blob), b"JSON")
    header = json.loads(blob[20:20 + size])
    start = 20 + size + 8

    def read(index):
        accessor = header["accessors"][index]
        view = header["bufferViews"][accessor["bufferView"]]
        width = {"SCALAR": 1, "VEC3": 3}[accessor["type"]]
        form = {5126: "f", 5123: "H"}[accessor["componentType"]]
        return struct.unpack_from(f"<{accessor['count'] * width}{form}", blob,
                                  start + view["byteOffset"])

    primitive = header["meshes"][0]["primitives"][0]
    base = read(primitive["attributes"]["POSITION"])
    sampler = header["animations"][0]["samplers"][0]
    times, weights = read(sampler["input"]), read(sampler["output"])
    targets = [read(target["POSITION"]) for target in primitive["targets"]]
    assert (len(times) - 1) / times[-1] >= 25 - 1e-6
    for i, time in enumerate(times):
        frame = round(time / frame_s)
        expected = track[frame * n * 3:(frame + 1) * n * 3]
        row = weights[i * len(targets):(i + 1) * len(targets)]
        for k in range(n * 3):
            place = base[k] + sum(w * t[k] for w, t in zip(row, targets) if w)
            assert abs(place - expected[k]) < 0.001
    assert max(read(primitive["indices"])) < n


def test_a_page_of_its_own(service, browser, tmp_path):
    """The saved page needs no service: it walks from a file."""
    browser.open("stage")
    browser.until_walking()
    text = browser.driver.execute_async_script("""
        const done = arguments[arguments.length - 1];
        const folder = document.querySelector('script[type=module]').src.replace(/app.js$/, '');
        import(folder + 'export/page.js').then(async ({ toPage }) => {
          const { stage } = document.querySelector('.stage').player;
          done(await (await toPage(stage.robots, 'A </script><b>race</b>')).text());
        });
    """)
    file = tmp_path / "race.html"
    file.write_text(text)
    browser.driver.get(file.as_uri())
    browser.until("document.querySelector('canvas').height > 50")
    browser.until("document.getElementById('time').value > 0.02")
    assert browser.run("return window.faults") == []
    assert browser.run("return document.title") == "A </script><b>race</b>"
    first = browser.pixels()
    assert len({row for row in first[3]}) > 20, "the page draws nothing"


def test_a_link_holds_the_view(service, browser):
    design = service.evaluate({"designs": [DESIGN]}).json()["results"][0]["id"]
    view = "2.50_2.40_0.20_1.00_0.50_1.80"
    browser.open(f"stage?designs={design}&environment=4&show=springs,trails&view={view}")
    browser.until_walking()
    state = browser.run("""
        const { player, player: { stage } } = document.querySelector('.stage');
        return [player.shown(), stage.camera.toText(), stage.follow, stage.robots.length];
    """)
    assert state == [["springs", "trails"], view, False, 1]
    assert f"designs={design}" in browser.driver.current_url


def test_commands_to_copy_are_safe_to_paste(service, browser):
    """What an address brings is one word of a shell, or is not taken at all."""
    browser.open("stage?designs=$(touch%20x)&controller=a';b;'")
    browser.click("Copy")
    browser.until("document.querySelector('dialog[open] pre')")
    curl, film = browser.texts("dialog pre")
    assert "touch" not in curl + film
    words = shlex.split(film)
    assert words[words.index("--controller") + 1] == "a';b;'"
