"""The data that the benchmark of the dashboard shows: real designs, and more than evolve in
minutes."""

import json
import random
import sqlite3
import struct

from contract import SOURCE
from service import Service, run

ONE_ENVIRONMENT = [{"light_xy_m": [4.0, 3.0], "terrain_sigma_m": 0.05, "seed": 3}]
# About 300 designs within seconds: each walks for a tenth of a usual rollout.
POPULATION = {
    "mode": "zero-shot", "population": 64, "generations": 8, "physics": {"n_steps": 100},
    "exclude_pretraining": False, "label": "population", "environments": ONE_ENVIRONMENT
}
# Its robots walk for as long as usual, in the paper's environments.
RUN = {"mode": "zero-shot", "population": 16, "generations": 2, "exclude_pretraining": False,
       "label": "run"}
PHYLOGENY = {**POPULATION, "population": 8, "generations": 1, "label": "a million"}
GENERATIONS, BORN_FIRST, BORN_EACH = 162, 8192, 6144  # a population of 8192, 75 % of it replaced
N_DESIGNS = BORN_FIRST + GENERATIONS * BORN_EACH  # 1,003,520
N_JOBS = 1000
DRIVEN_MAX = 40  # voxels
CROSSOVER, MUTATION, RANDOM = 4, 3, 0
NONE = 2**32 - 1


def rows_of_designs(generator):
    """Yields a phylogeny like one made by selection, as rows of campaign_designs without job and
    genotype: (number, operator, parent, other parent, born, died, score, size). The best of parents
    and children survive; a child is a little better or worse than its parents."""
    scores, died, rows = [], [], []
    living = []
    for generation in range(GENERATIONS + 1):
        n = BORN_EACH if generation else BORN_FIRST
        children = []
        for _ in range(n):
            number = len(scores)
            parents = (None, None)
            score = generator.gauss(1.0, 0.05)
            operator = RANDOM
            if generation:
                operator = MUTATION if generator.random() < 0.25 else CROSSOVER
                first = generator.choice(living)
                second = generator.choice(living) if operator == CROSSOVER else None
                if first == second:
                    operator, second = MUTATION, None
                parents = (first, second)
                score = scores[first] * generator.gauss(1.003, 0.01)
            scores.append(score)
            died.append(None)
            rows.append((number, operator, *parents, generation))
            children.append(number)
        everyone = sorted(living + children, key=scores.__getitem__)
        living = everyone[:BORN_FIRST]
        for number in everyone[BORN_FIRST:]:
            died[number] = generation
    size = 60 + (20 << 16) + (6 << 26) + (5 << 36)
    for row, end, score in zip(rows, died, scores):
        yield (*row, end, struct.pack("<d", score), size)


def write_phylogeny(state, campaign):
    """Replaces the designs of a campaign with a million. They get the bodies of the campaign in
    turn: the picture needs no bodies, and a click shows a real one."""
    with sqlite3.connect(state / "morphod.db") as database:
        bodies = [row[0] for row in database.execute(
            "SELECT genotype FROM campaign_designs WHERE job=? ORDER BY number", (campaign, ))]
        for table in ("campaign_designs", "campaign_populations"):
            database.execute(f"DELETE FROM {table} WHERE job=?", (campaign, ))
        births, newest = [b""] * (GENERATIONS + 1), b""

        def rows():
            nonlocal newest
            for row in rows_of_designs(random.Random(1)):
                number, operator, *parents, born, died, score, _ = row
                births[born] += struct.pack(
                    "<B2I", operator, *(NONE if parent is None else parent for parent in parents))
                if died is None:
                    newest += struct.pack("<I", number) + score
                yield (campaign, bodies[number % len(bodies)], *row)

        database.executemany(
            "INSERT INTO campaign_designs(job,genotype,number,operator,parent,other_parent,born,"
            "died,score,size) VALUES(?,?,?,?,?,?,?,?,?,?)", rows())
        database.executemany(
            "INSERT INTO campaign_populations(job,generation,births,population) VALUES(?,?,?,?)",
            ((campaign, generation, birth, newest if generation == GENERATIONS else b"")
             for generation, birth in enumerate(births)))
        database.execute(
            "UPDATE campaigns SET n_designs=?, generation=?, generations=? WHERE job=?",
            (N_DESIGNS, GENERATIONS, GENERATIONS, campaign))
    database.close()


class Filled:
    """A daemon with this data. Parts are made when they are first requested."""
    def __init__(self, state, *flags):
        self.state, self.flags = state, flags
        self.service = Service(*flags, state=state)
        designs = [{"cells": json.loads(file.read_text())["cells"]}
                   for file in sorted((SOURCE / "data" / "designs").glob("*.json"))]
        scored = self.service.evaluate({"designs": designs, "label": "champions"}).json()["results"]
        # Robots to drive: the largest first.
        self.driven = [row["robot"] for row in sorted(scored, key=lambda row: -row["voxels"])
                       if row["voxels"] <= DRIVEN_MAX]
        run(self.service, "campaigns", POPULATION)
        self.run = run(self.service, "campaigns", RUN)["id"]
        self.phylogeny = None

    def with_phylogeny(self):
        """The daemon is stopped while the database is modified."""
        if self.phylogeny is None:
            self.phylogeny = run(self.service, "campaigns", PHYLOGENY)["id"]
            self.service.close()
            write_phylogeny(self.state, int(self.phylogeny))
            self.service = Service(*self.flags, state=self.state)
        return self.phylogeny

    def with_jobs(self):
        """Evaluations of one design. All except the first find their score in the store."""
        design = {"cells": [[2, 2, 0], [3, 2, 0], [2, 3, 0], [2, 2, 1]]}
        connection = self.service.connection()
        n = len(self.service.pages("/v1/jobs"))
        for i in range(n, N_JOBS):
            self.service.request("POST", "/v1/evaluations",
                                 {"designs": [design], "label": f"job {i}"}, connection=connection)
        connection.close()

    def close(self):
        self.service.close()
