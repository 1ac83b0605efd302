"""The savings of an evaluation of the best designs (src/evolution/best.c): N random bodies, with
all scores and with those of the K best, each in its own state folder."""
import math
import sqlite3
import struct
import tempfile
import time

PLANS = ((1, 2, 7), (1, 3, 6), (2, 3, 5), (2, 8), (4, 6), (1,) * 10)  # waves of ten environments


def evaluate(daemon, value):
    begin = time.monotonic()
    status = daemon.score(value, timeout_s=86400)
    return status, time.monotonic() - begin


def read_losses(folder):
    """Returns the losses of every body, in the order of the request."""
    connection = sqlite3.connect(f"file:{folder}/state/morphod.db?mode=ro", uri=True)
    rows = connection.execute(
        "SELECT s.losses,length(c.environments)/8 FROM job_designs d"
        " JOIN scores s ON s.genotype=d.genotype JOIN conditions c ON c.id=s.condition"
        " ORDER BY d.position").fetchall()
    connection.close()
    return [struct.unpack(f"<{n}d", losses[:8 * n]) for losses, n in rows]


def worst_of_best(scores, k):
    return sorted(scores)[k - 1] if len(scores) >= k else math.inf


def estimate(designs, k, waves, hardest_first):
    """Returns the share of the rollouts that a race in rounds computes, and the share of its time
    on a core, if a block costs as much as its rollouts plus two."""
    n, m = len(designs), len(designs[0])
    n_few = min(max(n // 16, 4), 64)
    few = [i * n // n_few for i in range(n_few)]
    order = sorted(range(m), key=lambda e: -sum(designs[i][e] for i in few)) if hardest_first else [
        *range(m)]
    known = [set(range(m)) if i in set(few) else set() for i in range(n)]
    bounds = [sum(losses) if len(known[i]) == m else 0.0 for i, losses in enumerate(designs)]
    cost, end = n_few * (m + 2), 0

    def compute(places, environments):
        nonlocal cost
        for i in places:
            more = environments - known[i]
            cost += len(more) + 2 * bool(more)
            known[i] |= more
            bounds[i] = sum(designs[i][e] for e in known[i])

    def alive():
        bound = worst_of_best([bounds[i] for i in range(n) if len(known[i]) == m], k)
        return sorted((i for i in range(n) if len(known[i]) < m and bounds[i] <= bound),
                      key=lambda i: (bounds[i], i))

    for size in waves:
        left = alive()
        compute(left, set(order[end:end + size] if len(left) > n_few else range(m)))
        end += size
        compute(alive()[:k + k // 2 + n_few], set(range(m)))
    return sum(map(len, known)) / (n * m), cost / (n * (m + 2))


def ceiling(designs, k):
    """Returns the share that would be needed even if the bound, and the worst environment of each
    body, were known."""
    m = len(designs[0])
    bound = worst_of_best([sum(losses) for losses in designs], k)
    needed = 0
    for losses in designs:
        total = 0.0
        for loss in sorted(losses, reverse=True):
            needed += 1
            total += loss
            if total > bound:
                break
    return needed / (len(designs) * m)


def is_exact(raced, full, k):
    """Returns whether the best designs and their equals are the same, and whether all bounds
    hold."""
    def score(row):
        return math.inf if row["score"] is None else row["score"]

    worst = worst_of_best([score(row) for row in full], k)
    return all(worst < score(a) <= score(b) if a["lower_bound"] else a == b
               for a, b in zip(raced, full))


def measure(options, start):
    """start: starts a daemon in a folder. Returns the exit status."""
    found = {}
    for best in (None, options.best):
        with tempfile.TemporaryDirectory(prefix="morphod-racing-") as folder:
            with start(options, folder) as daemon:
                bodies = daemon.post("/v1/bodies/random", {"count": options.designs,
                                                           "seed": options.seed})["items"]
                value = {"designs": [{"voxels": body["genotype"]} for body in bodies]}
                status, seconds = evaluate(daemon, value | ({"best": best} if best else {}))
                daemon.stop()
            if best is None:
                designs = read_losses(folder)
        rollouts = status["rollouts_total"] - status["rollouts_cut"]
        cores = status["core_seconds"] + status["device_seconds"]
        found[best] = (rollouts, seconds, cores, status["results"])
        print(f"{f'best {best}' if best else 'all':9} {rollouts:9} rollouts, {seconds:8.2f} s,"
              f" {cores:8.2f} s of cores and devices", flush=True)
    (rollouts, seconds, cores, full), (raced_rollouts, raced_seconds, raced_cores,
                                       raced) = found.values()
    exact = is_exact(raced, full, options.best)
    print(f"share     {raced_rollouts / rollouts:9.3f} of the rollouts,"
          f" {raced_seconds / seconds:.3f} of the time,"
          f" {raced_cores / cores:.3f} of that of cores and devices;"
          f" {'exact' if exact else 'NOT EXACT'};"
          f" ceiling {ceiling(designs, options.best):.3f} of the rollouts")
    print("estimated rollouts (and time of a core), by order of the environments:")
    print("waves        hardest first    as in the set")
    for waves in PLANS:
        if sum(waves) == len(designs[0]):
            one, other = (estimate(designs, options.best, waves, first) for first in (True, False))
            print(f"{'+'.join(map(str, waves)) if len(set(waves)) > 1 else 'single':11}"
                  f"{one[0]:8.3f} ({one[1]:.3f}){other[0]:9.3f} ({other[1]:.3f})")
    return 0 if exact else 1
