"""The asyncio client: the same requests, concurrently."""

import asyncio

import morphod
import numpy as np
import pytest
from service import DESIGN

SHORT = {"n_steps": 20}
WORLD = [{"light_xy_m": [4.5, 2.5], "terrain_sigma_m": 0.05, "seed": 7}]


def test_many_at_once(service, campaign):
    async def body():
        async with morphod.AsyncClient(f"http://{service.host}:{service.port}") as m:
            evaluations = await asyncio.gather(*(
                m.evaluate([DESIGN], WORLD, physics={"n_steps": 20 + n}, record=["com"])
                for n in range(5)))
            assert len({evaluation.scores[0] for evaluation in evaluations}) == 5
            assert (await evaluations[0].recordings("com")).shape == (1, 1, 3, 3)
            assert "const DATA" in (await evaluations[0].show()).html
            scores = await m.objective(environments=WORLD, physics=SHORT)(np.ones((2, 144)))
            assert scores.shape == (2, )
            assert len(await m.curves(label="for tests")) == 12
            own = await m.get_campaign(campaign[0])
            assert len(await own.phylogeny()) == 24 * 6
            types = []
            async for event in m.events(after=0, job=evaluations[0].id):
                types.append(event["type"])
                if event["type"] == "job.finished":
                    break
            assert types[0] == "job.created"
            scene = await m.rollouts([DESIGN], WORLD, physics=SHORT, final_states=True)
            scene = await m.rollouts([DESIGN], WORLD, physics=SHORT, states=scene.states,
                                     final_states=True)
            assert scene[0].state["time_s"] == pytest.approx(0.08)
            with pytest.raises(morphod.NotFoundError):
                await m.evaluation(10**9)

    asyncio.run(body())


def test_a_wait_can_be_cancelled(service):
    async def body():
        async with morphod.AsyncClient(f"http://{service.host}:{service.port}") as m:
            group = await m.campaign("zero-shot", preset="demo", generations=1000)
            with pytest.raises(asyncio.TimeoutError):
                await asyncio.wait_for(group[0].live(), 0.5)
            await group[0].cancel()
            assert group[0].ended

    asyncio.run(body())
