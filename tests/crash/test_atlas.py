"""An atlas has the same bytes, whatever killed its builder, and however many threads it had."""
import random

import pytest

from daemon import Daemon, open_database
from test_disk import fill

REQUEST = {
    "voxels": 5, "name": "all", "physics": {"n_steps": 800},
    "environments": [{"task": "walk"}, {"light_xy_m": [4, 2.5], "terrain_sigma_m": 0.05, "seed": 3}]
}
BODIES = 124


def file_of(one):
    return one.state / "atlases" / "all.atlas"


def done(one, job):
    return one.json(f"/v1/jobs/{job}")["atlas"]["bodies_done"]


def computed(one):
    return one.counted("morphod_atlas_rollouts_total")


def resume_failed(one, job):
    """Resumes the job if it has failed, as it does after three kills without a durable body."""
    now = one.json(f"/v1/jobs/{job}")
    if now["state"] == "failed":
        assert "killed" in now["error"]["detail"]
        one.act(job, "resume")


@pytest.mark.parametrize("more", ({}, {"measures": ["displacement_m", "work_j"]}),
                         ids=("plain", "measured"))
def test_kill_at_random_moments(daemon, soak, seed, more):
    """Killed several times, with a different number of workers in each process. Nothing durable is
    recomputed, so all processes together do little more work than one would. Every second process
    lives until it has added a body, so that the job ends on any machine."""
    print(f"seed {seed}")
    generator = random.Random(seed)
    n_kills = 60 if soak else 8
    with daemon("undisturbed", workers=2) as quiet:
        job = quiet.submit(REQUEST | more, "atlases")
        quiet.succeed(job, "jobs")
        rollouts = computed(quiet)
        expected = file_of(quiet).read_bytes()
        assert quiet.json(f"/v1/jobs/{job}")["atlas"]["rollouts_done"] == rollouts
        quiet.end()

    victim = daemon("victim", workers=1).start()
    job, kills, seen = victim.submit(REQUEST | more, "atlases"), 0, []
    while kills < n_kills:
        resume_failed(victim, job)
        least = computed(victim) + generator.uniform(0, 2 * rollouts / n_kills)
        before = done(victim, job) if kills % 2 == 1 else -1
        state = victim.until(lambda: victim.json(f"/v1/jobs/{job}")["state"], holds=lambda state: (
            state not in ("queued", "running") or
            (computed(victim) >= least and done(victim, job) > before)))
        if state == "succeeded":
            break
        victim.kill()
        kills += 1
        victim.settings["workers"] = generator.choice((1, 2, 7))
        victim.start()
        seen.append(done(victim, job))
    resume_failed(victim, job)
    victim.succeed(job, "jobs", attempts=3)
    print(f"{kills} kills, at {seen} of {BODIES} bodies")
    assert file_of(victim).read_bytes() == expected
    assert kills >= 3 and seen == sorted(seen), "a durable body was lost"
    now = victim.json(f"/v1/jobs/{job}")["atlas"]
    assert (now["bodies_done"], now["rollouts_done"]) == (BODIES, rollouts)
    victim.end()
    database = open_database(victim.state)
    assert database.execute("SELECT count(*) FROM scores").fetchone() == (0, )
    database.close()
    assert [path.name for path in (victim.state / "atlases").iterdir()] == ["all.atlas"]


def test_killed_when_the_file_is_complete(daemon):
    """The file has its name, but the job does not know it yet."""
    with daemon("one") as one:
        job = one.submit(REQUEST | {"voxels": 2}, "atlases")
        one.succeed(job, "jobs")
        content = file_of(one).read_bytes()
        one.end()
        database = open_database(one.state)
        database.execute("UPDATE jobs SET state=1, finished_us=0")
        database.execute("UPDATE atlases SET bodies_done=1, rollouts_done=2")
        database.commit()
        database.close()
        one.start()
        again = one.succeed(job, "jobs")
        assert again["atlas"]["bodies_done"] == 3 and again["atlas"]["rollouts_done"] == 2 * 4
        assert file_of(one).read_bytes() == content
        one.end()


def test_progress_forgives(daemon):
    """More durable bodies reset the count of attempts."""
    with daemon("one", workers=1) as one:
        job = one.submit(REQUEST, "atlases")
        one.until(lambda: done(one, job) > 0)
        one.act(job, "pause")
        one.end()
        database = open_database(one.state)
        database.execute("UPDATE jobs SET attempts=2")
        database.commit()
        database.close()
        one.start()
        assert one.json(f"/v1/jobs/{job}")["attempts"] == 2
        one.act(job, "resume")
        one.succeed(job, "jobs", attempts=0)
        one.end()


def test_left_over(daemon):
    """Unfinished files of ended jobs are removed. Those of unfinished jobs stay, and those of which
    no job is known, as after the restore of an older database."""
    with daemon("one", workers=1) as one:
        job = one.submit(REQUEST, "atlases")
        one.until(lambda: done(one, job) > 0)
        one.act(job, "pause")
        one.end()
        folder = file_of(one).parent
        (folder / "nobody.atlas.part").write_bytes(b"unfinished")
        (folder / ".tmp-1").write_bytes(b"unfinished")
        (folder / "other.atlas").write_bytes(b"somebody's")
        one.start()
        kept = ["nobody.atlas.part", "other.atlas"]
        assert sorted(path.name for path in folder.iterdir()) == ["all.atlas.part", *kept]
        assert one.act(job, "cancel")["state"] == "cancelled"
        one.until(lambda: not (folder / "all.atlas.part").exists())
        one.end()
        (folder / "all.atlas.part").write_bytes(b"unfinished")
        one.start()
        assert sorted(path.name for path in folder.iterdir()) == kept
        one.end()


def test_full_disk(small_disk, daemon):
    """The job waits while there is no room, reports it, and continues when there is."""
    with daemon("roomy", workers=2) as quiet:
        quiet.succeed(quiet.submit(REQUEST, "atlases"), "jobs")
        expected = file_of(quiet).read_bytes()
        quiet.end()
    with Daemon(small_disk / "d", small_disk.parent, workers=2) as one:
        job = one.submit(REQUEST, "atlases")
        one.until(lambda: done(one, job) > 0)
        filler = fill(small_disk)
        waiting = one.awaited(f"/v1/jobs/{job}", lambda now: now["state"] == "paused")
        assert "no space" in waiting["reason"] and "will continue" in waiting["reason"], waiting
        assert waiting["atlas"]["phase"] == "waiting"
        filler.unlink()
        one.succeed(job, "jobs")
        assert file_of(one).read_bytes() == expected
        one.end()


def test_files_of_others(daemon):
    """An unfinished file of other code is built again from the start, which the log says. A
    complete file that somebody put there stays, and the job fails."""
    with daemon("one", workers=1) as one:
        job = one.submit(REQUEST, "atlases")
        one.until(lambda: done(one, job) > 0)
        one.act(job, "pause")
        one.end()
        part = file_of(one).with_name("all.atlas.part")
        content = bytearray(part.read_bytes())
        content[232] ^= 1  # of the fingerprint
        part.write_bytes(content)
        one.start()
        one.act(job, "resume")
        one.succeed(job, "jobs")
        assert "was computed by different code" in one.log.read_text()
        expected = file_of(one).read_bytes()
        again = one.submit(REQUEST | {"name": "again"}, "atlases")
        one.succeed(again, "jobs")
        assert file_of(one).with_name("again.atlas").read_bytes() == expected
        foreign = one.submit(REQUEST | {"name": "foreign"}, "atlases")
        one.act(foreign, "pause")
        one.end()
        path = file_of(one).with_name("foreign.atlas")
        path.write_bytes(b"somebody's")
        one.start()
        one.act(foreign, "resume")
        failed = one.finish(foreign, "jobs")
        assert failed["state"] == "failed" and "another atlas" in failed["error"]["detail"], failed
        assert path.read_bytes() == b"somebody's"
        one.end()
