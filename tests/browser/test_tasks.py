"""Tasks in the dashboard: chosen in a form, drawn on the stage, and scored in meters."""

from conftest import CAMPAIGN
from service import DESIGN, run
from test_tray import module

WALK = CAMPAIGN | {"label": "on foot", "environments": [{"task": "walk"}]}
STAGE = "document.querySelector('.stage').player.stage"


def test_a_form_offers_tasks(service, browser):
    """A task is chosen by its picture; it becomes the environments of the request and of its
    commands, and counts in the estimate."""
    browser.open("overview")
    browser.click("New campaign")
    browser.until("document.querySelector('dialog[open] form')")
    names = browser.run("return [...document.querySelectorAll('.tasks input')].map((e) => e.value)")
    assert names == ["photo", "walk", "climb", "circle", "path", "shuttle", "pursue", "efficient",
                     "jump"]
    assert browser.run("return document.querySelectorAll('.tasks svg').length") == len(names)
    browser.run("document.querySelector('.tasks input[value=walk]').click()")
    browser.run("const form = document.querySelector('dialog form');"
                "form.elements.preset.value = 'demo';"
                "form.elements.preset.dispatchEvent(new Event('change', { bubbles: true }))")
    browser.until("document.querySelector('dialog').innerText.includes("
                  "'Up to 7,936 rollouts')")  # 64 × 31 designs, 4 environments
    browser.click("Copy as a command", "dialog button")
    browser.until("document.querySelectorAll('dialog[open] pre').length === 3")
    curl, shell, python = browser.texts("dialog pre")
    for text in (curl, shell, python):
        assert '"task":"walk"' in text.replace(": ", ":")
    assert shell.startswith("echo ") and "--environments -" in shell
    browser.run("document.querySelectorAll('dialog').forEach((one) => one.close())")
    browser.until("!document.querySelector('dialog')")
    browser.click("New campaign")
    browser.until("document.querySelector('dialog[open] form')")
    browser.run("""
        const { elements } = document.querySelector('dialog[open] form');
        document.querySelector('dialog[open] .tasks input[value=climb]').click();
        Object.assign(elements.population, { value: 4 });
        Object.assign(elements.generations, { value: 1 });""")
    browser.click("Start", "dialog button")
    browser.until("/^#.campaigns.\\d/.test(location.hash)")
    id = browser.run("return location.hash.split('/')[2]")
    worlds = service.get(f"/v1/campaigns/{id}/environments")["items"]
    assert [world["task"]["objective"] for world in worlds] == ["climb", "climb"]
    assert worlds[0]["terrain_heights_m"][7] == 0.5  # 5 m at 1 in 10
    service.act(id, "cancel")
    assert browser.faults() == []


def check_ground(service, browser, terrain, height_of):
    """Compares the ground that the stage draws with the recorded masses, which stand on it, and
    with the given heights; height_of: computes the drawn height where number k of them is."""
    job = service.evaluate({
        "designs": [DESIGN], "record": ["masses"], "record_stride": 5,
        "physics": {"n_steps": 200}, "environments": [{"task": "walk", "terrain": terrain}]}).json()
    browser.open(f"stage?evaluation={job['id']}&rows=0")
    browser.until_walking()
    lowest, off = module(browser, "stage/math.js", f"""
        const {{ heightAt }} = of;
        const {{ world, track }} = {STAGE}.robots[0];
        let lowest = Infinity;
        for (let i = 0; i < track.length; i += 3) {{
          lowest = Math.min(lowest, track[i + 2] - heightAt(world, track[i], track[i + 1]));
        }}
        const off = world.heights.map((h, k) => {height_of} - h);
        done([lowest, Math.max(...off.map(Math.abs))]);""")
    assert -1e-5 < lowest < 0.01 and off < 1e-6
    assert browser.faults() == []


def test_the_stage_draws_profiles(service, browser):
    """Also where the ground is not level."""
    check_ground(service, browser, {"kind": "profile", "spacing_m": 0.25,
                                    "heights_m": [0.1 * (k % 3) for k in range(24)]},
                 "heightAt(world, k * world.spacing, 9)")


def test_the_stage_draws_grids(service, browser):
    """Rows are along y, and the middle is at the start."""
    rows = [[round(0.02 * ((3 * i + 5 * j) % 7), 2) for i in range(30)] for j in range(20)]
    check_ground(service, browser, {"kind": "grid", "spacing_m": 0.25, "heights_m": rows},
                 "heightAt(world, 2.5 + (k % 30 - 14.5) * 0.25, "
                 "2.5 + (Math.floor(k / 30) - 9.5) * 0.25)")


def test_a_campaign_shows_meters(service, browser):
    """The curve and the champions of a task that is measured in meters have that unit; on the
    stage, the light leads, and the waypoints are there."""
    id = run(service, "campaigns", WALK)["id"]
    browser.open(f"campaigns/{id}")
    browser.until("document.body.innerText.includes('Meters walked')")
    browser.until("document.querySelectorAll('.card .number').length > 0")
    best = service.get(f"/v1/campaigns/{id}")["newest"]["score"]["quantiles"]["p0"]
    shown = browser.texts(".card .number")
    assert all(text.endswith(" m") for text in shown), shown
    job = service.evaluate({"designs": [DESIGN], "environments": WALK["environments"],
                            "physics": WALK["physics"]}).json()
    assert 0 < best <= job["results"][0]["score"] * 2
    browser.until_walking()
    lights = browser.run(f"const [robot] = {STAGE}.robots; return [...robot.lights];")
    com = browser.run(f"""
        const [{{ track, body }}] = {STAGE}.robots;
        let sum = 0;
        for (let mass = 0; mass < body.nMasses; mass++) sum += track[3 * mass];
        return sum / body.nMasses;""")
    assert abs(lights[0] - com - 1.5) < 1e-4
    assert browser.texts(".stage .tag .number, .stage .number")[0].endswith(" m")
    path = service.evaluate({"designs": [DESIGN], "environments": [{"task": "path"}],
                             "physics": {"n_steps": 60}, "record": ["masses"]}).json()
    browser.open(f"stage?evaluation={path['id']}&rows=0")
    browser.until_walking()
    assert browser.run(f"return {STAGE}.robots[0].world.points") == [
        [3.5, 2.5], [3.5, 3.5], [2.5, 3.5]]
    browser.open(f"designs?evaluation={path['id']}")
    browser.until("document.querySelector('.card .number')")
    assert browser.texts(".card .number") == [f"{path['results'][0]['value']:.3f} m"]
    assert browser.faults() == []
