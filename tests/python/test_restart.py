"""The service is killed and restarted while the package uses it."""

import signal
import threading
import time

import morphod
import numpy as np
from service import BINARY, BOOTSTRAP, until


def all_succeeded(client, seconds=300):
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        jobs = client.jobs()
        if not jobs.empty and set(jobs["state"]) == {"succeeded"}:
            return jobs
        time.sleep(0.1)
    raise AssertionError(f"not all jobs have ended: {jobs}")


def test_kill_and_restart_under_a_client(start, tmp_path):
    """Submissions, waits and events continue, nothing is created twice, and no event is lost."""
    state, socket = tmp_path / "state", tmp_path / "socket"

    def run():
        return start(listen=("127.0.0.1:0", f"unix:{socket}"), state=state)

    service = run()
    stop = threading.Event()
    kills = []

    def killer():
        nonlocal service
        while len(kills) < 8 and not stop.wait(1.5):  # so that a slow machine also gets to the end
            service.stop(signal.SIGKILL)
            socket.unlink(missing_ok=True)  # nothing listens until the next one has started
            service = run()
            kills.append(time.monotonic())

    thread = threading.Thread(target=killer)
    seen = []
    with morphod.Client(f"unix:{socket}", retry_s=600) as m:
        events = m.events(after=0)
        watcher = threading.Thread(target=lambda: seen.extend(
            event for event, _ in zip(events, iter(lambda: stop.is_set(), True))))
        thread.start()
        watcher.start()
        bodies = np.random.default_rng(5).random((4, 20, 6, 6, 4)) > 0.4
        evaluations = [m.evaluate(batch, repair="largest", physics={"n_steps": 200 + n})
                       for n, batch in enumerate(bodies)]
        campaign = m.campaign("zero-shot", preset="demo", population=8, generations=6,
                              physics={"n_steps": 200})
        campaign.live()
        until(lambda: len(kills) >= 2)
        stop.set()
        thread.join()
        jobs = all_succeeded(m)
        assert len(jobs) == 5 and len(campaign[0].curve()) == 7
        m.evaluate([[[0, 0, 0]]], physics={"n_steps": 5})  # an event, which ends the watcher
        watcher.join(300)
        again = m.evaluate(bodies[3], repair="largest", physics={"n_steps": 203}, verify=True)
        assert (again.losses == evaluations[3].losses).all()
        assert all(row["agrees"] for row in again.data["results"])
    kept = service.get("/v1/events?format=json&after=0&limit=1000")["items"]
    numbers = [int(event["id"]) for event in seen]
    assert len(numbers) > 10 and numbers == [int(event["id"]) for event in kept][:len(numbers)], \
        "an event was lost or came twice"


def test_local_starts_continues_and_ends(tmp_path):
    options = {"binary": BINARY, "default_controller": BOOTSTRAP, "devices": "none", "workers": 1}
    with morphod.local(tmp_path / "state", **options) as m:
        first = m.evaluate([[[0, 0, 0]]], physics={"n_steps": 20})
        process, url = m._process, m.url
        assert morphod.Client(url).version() == m.version()
    assert process.poll() == 0
    with morphod.local(tmp_path / "state", **options) as m:
        assert (m.evaluation(first.id).losses == first.losses).all()
    with morphod.local(**options) as m:
        folder = m.state_dir
        assert m.jobs().empty and folder.exists()
    assert not folder.exists()


def test_local_says_why_it_did_not_start(tmp_path):
    for wrong, said in (({"binary": tmp_path / "nothing"}, "not found"),
                        ({"binary": BINARY, "workers": "many"}, "workers")):
        try:
            morphod.local(**wrong)
        except morphod.MorphodError as error:
            assert said in str(error)
        else:
            raise AssertionError(f"{wrong} was accepted")
