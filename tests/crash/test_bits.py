"""The same bits for any number of workers, alone or among others, in any order, before and after a
restart."""
import random

from daemon import bodies, stored_scores

PHYSICS = {"n_steps": 200}
N_FEW = 12


def few(seed):
    return bodies(seed, N_FEW)


def by_voxels(evaluation):
    return {
        result["genotype"]: (result["score"], result["losses"], result["diverged"])
        for result in evaluation["results"]
    }


def test_number_of_workers(daemon, seed):
    print(f"seed {seed}")
    runs = {}
    for workers in (1, 2, 7):
        for precision in ("float32", "float64"):
            one = daemon(f"{workers} {precision}", workers=workers)
            with one:
                runs[workers, precision] = by_voxels(
                    one.score({"designs": few(seed), "physics": PHYSICS, "precision": precision}))
                assert one.stop()[0] == 0
            runs[workers, precision, "stored"] = stored_scores(one.state)
    for precision in ("float32", "float64"):
        for workers in (2, 7):
            assert runs[workers, precision] == runs[1, precision]
            assert runs[workers, precision, "stored"] == runs[1, precision, "stored"]
    assert runs[1, "float32"] != runs[1, "float64"]


def test_alone_and_among_others(daemon, seed):
    print(f"seed {seed}")
    designs = few(seed)
    alone = {}
    one = daemon("alone")
    with one:
        for design in designs:
            alone.update(by_voxels(one.score({"designs": [design], "physics": PHYSICS})))
        assert one.stop()[0] == 0
    crowd = designs + bodies(seed + 1, 1000 - N_FEW)
    random.Random(seed).shuffle(crowd)
    two = daemon("crowd")
    with two:
        among = by_voxels(two.score({"designs": crowd, "physics": PHYSICS}))
        # Again, from the store, in another order; and recomputed after a restart.
        again = by_voxels(two.score({"designs": crowd[::-1], "physics": PHYSICS}))
        assert two.stop()[0] == 0
    two.start()
    verified = two.score({"designs": designs, "physics": PHYSICS, "verify": True})
    two.end()
    for voxels, result in alone.items():
        assert among[voxels] == result
    assert again == among
    assert by_voxels(verified) == {voxels: among[voxels] for voxels in by_voxels(verified)}
    assert all(result["agrees"] is True for result in verified["results"])
    stored_alone, stored_crowd = stored_scores(one.state), stored_scores(two.state)
    for key, value in stored_alone.items():
        assert stored_crowd[key] == value
