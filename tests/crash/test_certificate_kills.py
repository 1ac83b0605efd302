"""A certificate has the same report, whatever killed its process, and however many threads it
had."""
import random

from daemon import Daemon, bodies, open_database
from test_disk import fill

# Trials of one part, of two with different widths, and in both precisions.
REQUEST = {
    "designs": bodies(5, 12), "axes": ["step", "chance", "friction"], "chance": 8, "seed": 3,
    "levels": [0.8, 1.25], "physics": {"n_steps": 400}
}
TRIALS = 6
ROLLOUTS = 12 * (10 + 2 * 10 + 80 + 2 * 10)


def certificate(one, job):
    return one.json(f"/v1/certificates/{job}")["certificate"]


def done(one, job):
    return certificate(one, job)["rollouts_done"]


def computed(one):
    return one.counted("morphod_certificate_rollouts_total")


def report(one, job, form=""):
    reply = one.get(f"/v1/certificates/{job}/report{form}")
    assert reply.status_code == 200, reply.text
    return reply.content


def undisturbed(daemon):
    """Returns the bytes of both reports of a certificate that nothing interrupted."""
    with daemon("undisturbed", workers=2) as quiet:
        job = quiet.submit(REQUEST, "certificates")
        quiet.succeed(job, "certificates")
        assert computed(quiet) == ROLLOUTS
        expected = report(quiet, job), report(quiet, job, ".csv")
        quiet.end()
    return job, expected


def resume_failed(one, job):
    """Resumes the job if it has failed, as it does after three kills without a stored loss."""
    now = one.json(f"/v1/jobs/{job}")
    if now["state"] == "failed":
        assert "killed" in now["error"]["detail"]
        one.act(job, "resume")


def test_kill_at_random_moments(daemon, soak, seed):
    """Killed several times, with a different number of workers in each process. Nothing that was
    stored is recomputed. Every second process lives until it has stored a loss, so that the job
    ends on any machine."""
    print(f"seed {seed}")
    generator = random.Random(seed)
    n_kills = 60 if soak else 8
    same, expected = undisturbed(daemon)
    victim = daemon("victim", workers=1).start()
    job, kills, seen = victim.submit(REQUEST, "certificates"), 0, []
    assert job == same, "the report has the id"
    while kills < n_kills:
        resume_failed(victim, job)
        least = computed(victim) + generator.uniform(0, 2 * ROLLOUTS / n_kills)
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
    victim.succeed(job, "certificates", attempts=3)
    print(f"{kills} kills, at {seen} of {ROLLOUTS} rollouts")
    assert (report(victim, job), report(victim, job, ".csv")) == expected
    assert kills >= 3 and seen == sorted(seen), "a stored loss was lost"
    now = certificate(victim, job)
    assert (now["trials_done"], now["rollouts_done"]) == (TRIALS, ROLLOUTS)
    victim.end()
    database = open_database(victim.state)
    assert database.execute("SELECT count(*) FROM scores").fetchone() == (0, )
    database.close()


def test_progress_forgives(daemon):
    """More stored losses reset the count of attempts."""
    with daemon("one", workers=1) as one:
        job = one.submit(REQUEST, "certificates")
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
        one.succeed(job, "certificates", attempts=0)
        one.end()


def test_losses_of_other_code(daemon):
    """Losses of other code are not mixed with new ones: all are computed again, as the log says."""
    same, expected = undisturbed(daemon)
    with daemon("one", workers=1) as one:
        job = one.submit(REQUEST, "certificates")
        assert job == same
        one.until(lambda: done(one, job) > 0)
        one.act(job, "pause")
        one.end()
        database = open_database(one.state)
        database.execute("UPDATE fingerprints SET text='other float64' WHERE text LIKE '%float64%'")
        database.commit()
        database.close()
        one.start()
        one.act(job, "resume")
        one.succeed(job, "certificates")
        assert computed(one) == ROLLOUTS
        assert "computed by different code" in one.log.read_text()
        assert report(one, job) == expected[0]
        one.end()


def test_full_disk(small_disk, daemon):
    """The job waits while there is no room, reports it, and continues when there is."""
    same, expected = undisturbed(daemon)
    with Daemon(small_disk / "d", small_disk.parent, workers=2) as one:
        job = one.submit(REQUEST, "certificates")
        assert job == same
        one.until(lambda: done(one, job) > 0)
        filler = fill(small_disk)
        waiting = one.awaited(f"/v1/jobs/{job}", lambda now: now["state"] == "paused")
        assert "no space" in waiting["reason"] and "will continue" in waiting["reason"], waiting
        assert waiting["certificate"]["phase"] == "waiting"
        filler.unlink()
        one.succeed(job, "certificates")
        assert report(one, job) == expected[0]
        one.end()
