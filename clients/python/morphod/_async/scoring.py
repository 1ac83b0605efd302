"""The part of the client that scores bodies, and shows them walking."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

from ..bodies import (BodyLike, OnFault, Repair, designs_of, packed, requests_of, warn_of_lost)
from ..errors import MorphodError
from ..player import Player
from ..scenes import MEDIA_TYPE, Environments, Scene
from .._wire import WAIT_S, Request, given as _given, without_none
from .connection import AsyncConnection
from .evaluations import AsyncEvaluation
from .jobs import interrupted
from .showing import player, world_of

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import NDArray

Physics = Mapping[str, Any] | Literal["paper"]
"""Physics settings of a request: some of them, or all of those of the paper."""
DESIGNS_MAX = 10000
_LARGE_MAX = 1000000
_LOOK_UP_S = 5.0
"""How long an interrupted call looks for the job that continues."""


def _measures(measures: Literal[True] | Sequence[str] | None) -> Any:
    """In the form that the service accepts; it refuses a single text."""
    return measures if measures is None or isinstance(measures, (bool, str)) else list(measures)


class Scoring:
    """Methods of the client."""

    _connection: AsyncConnection

    async def evaluate(self, bodies: Iterable[BodyLike] | NDArray[Any],
                       environments: Environments = "paper-test", *,
                       controller: str = "default",
                       record: Sequence[str] = (), record_stride: int = 10,
                       physics: Physics | None = None,
                       precision: Literal["float32", "float64"] = "float32",
                       priority: Literal["interactive", "batch"] | None = None,
                       weight: float = 1.0, device: Literal["auto", "cpu", "cuda"] = "auto",
                       label: str | None = None, experiment: str | None = None,
                       verify: bool = False, best: int | None = None, error: bool = False,
                       measures: Literal[True] | Sequence[str] | None = None,
                       tolerance: float | None = None,
                       repair: Repair | None = None, on_fault: OnFault = "refuse",
                       wait: bool = True) -> AsyncEvaluation:
        """Scores up to 1,000,000 bodies (see `Body.of`; an array (n, 6, 6, 4) is fastest). With
        more than 10,000, no body is skipped or repaired, ids need an orientation, nothing is
        recorded, and `table()` reads the results in pages. To score random bodies without sending
        them, see `evaluate_random`.

        `wait=False` returns as soon as the evaluation is durable. `record` accepts "com" and
        "masses", which are recorded every `record_stride` steps. `physics` overrides single
        settings, such as `{"dt_s": 0.001, "n_steps": 4000}`, or is "paper" for those of the paper.
        `repair="largest"` keeps the largest piece of bodies that are not in one piece.
        `on_fault="skip"` skips invalid bodies; their results have a `fault` and NaN. `best=10`
        computes complete scores only for the ten best; the others are cut short, and have lower
        bounds. `error=True` estimates the error of each score, at six times the cost: see
        `Result.error`. `tolerance=0.01` chooses time step and precision for each design, so that
        its score has at most that estimated error: see `Result.tolerance`. `measures` requests
        numbers that describe each rollout, such as `["displacement_m", "work_j"]`, or all with
        True: see `measures` of the evaluation and of `Result`. An id without an orientation is
        scored in the orientation with the best stored score, or else in the canonical one;
        `Result.orientation` says which.
        """
        designs, lost, faults = requests_of(bodies, on_fault)
        if not 0 < len(designs) <= _LARGE_MAX:
            raise ValueError(f"an evaluation needs 1 to {_LARGE_MAX} bodies, got {len(designs)}")
        is_large = len(designs) > DESIGNS_MAX
        if is_large:
            designs = packed(designs)
            warn_of_lost(lost)  # results in pages do not have it
        value: dict[str, Any] = {
            "designs": designs, "environments": environments, "controller": controller,
            "precision": precision, "weight": weight, "device": device, "verify": verify,
            "on_fault": on_fault,
            **_given(physics=physics, priority=priority, label=label, experiment=experiment,
                     repair=repair, best=best, error=error or None, tolerance=tolerance,
                     measures=_measures(measures)),
        }
        if record:
            value.update(record=list(record), record_stride=record_stride)
        request = Request.submit("/v1/evaluations", value, wait_s=WAIT_S if wait else 0)
        try:
            data = await self._connection.json(request)
        except KeyboardInterrupt:
            raise await self._interrupted(request) from None
        evaluation = AsyncEvaluation(self._connection, data, lost, faults)
        if wait:
            await evaluation.wait()
            if not is_large and "results" in evaluation.data:
                evaluation._check(designs)
        return evaluation

    async def _interrupted(self, request: Request) -> KeyboardInterrupt:
        """Returns the exception for an interrupted submission. The key finds the job, if there is
        one."""
        connection = copy.copy(self._connection)
        connection.retry_s, request.timeout_s = 0.0, _LOOK_UP_S
        request.headers.pop("Prefer", None)
        try:
            found = AsyncEvaluation(connection, await connection.json(request))
            return interrupted(found)
        except MorphodError:
            return KeyboardInterrupt("if the evaluation was accepted, it continues: client.jobs() "
                                     "or morphoctl job list shows it")
        finally:
            await connection.close()

    async def suite(self, bodies: Iterable[BodyLike] | NDArray[Any], *, held_out: bool = False,
                    controller: str = "default", physics: Physics | None = None,
                    weight: float = 1.0, device: Literal["auto", "cpu", "cuda"] = "auto",
                    label: str | None = None, experiment: str | None = None) -> pd.DataFrame:
        """Scores bodies in all tasks of the suite morpho-12 (docs/suite.md), as one evaluation.
        Returns its `suite_table()`: the mean values in the unit of each task, higher is better, and
        the mean loss. `held_out` uses the 64 held-out worlds of each task, for reports, instead of
        the ten selection worlds. To submit it without waiting, use
        `evaluate(bodies, "morpho-12", wait=False)`; for a campaign's champions, the campaign's
        `evaluate_champions("morpho-12")`."""
        done = await self.evaluate(bodies, "morpho-12-held-out" if held_out else "morpho-12",
                                   controller=controller, physics=physics, weight=weight,
                                   device=device, label=label, experiment=experiment)
        return await done.suite_table()

    async def evaluate_random(self, count: int, seed: int = 1, *, first: int = 0,
                              environments: Environments = "paper-test",
                              controller: str = "default",
                              physics: Physics | None = None,
                              precision: Literal["float32", "float64"] = "float32",
                              weight: float = 1.0, device: Literal["auto", "cpu", "cuda"] = "auto",
                              label: str | None = None, experiment: str | None = None,
                              best: int | None = None, error: bool = False,
                              measures: Literal[True] | Sequence[str] | None = None,
                              tolerance: float | None = None,
                              wait: bool = True) -> AsyncEvaluation:
        """Scores the bodies of `random_bodies(count, seed, first=first)` without sending them: up
        to 1,000,000 in one evaluation, with one `best` for all. The service first draws and stores
        them; until then the evaluation is queued. `error`, `tolerance` and `measures` as in
        `evaluate`.

        With more than 10,000 bodies, `table()` reads the results in pages; `table(whole=True)`
        reads only those that are not lower bounds.
        """
        value: dict[str, Any] = {
            "random": {"count": count, "seed": seed, "first": first},
            "environments": environments, "controller": controller, "precision": precision,
            "weight": weight, "device": device,
            **_given(physics=physics, label=label, experiment=experiment, best=best,
                     error=error or None, tolerance=tolerance, measures=_measures(measures)),
        }
        request = Request.submit("/v1/evaluations", value, wait_s=WAIT_S if wait else 0)
        try:
            data = await self._connection.json(request)
        except KeyboardInterrupt:
            raise await self._interrupted(request) from None
        evaluation = AsyncEvaluation(self._connection, data)
        if wait:
            await evaluation.wait()
        return evaluation

    async def evaluation(self, id: str | int) -> AsyncEvaluation:
        """Returns the evaluation with an id."""
        data = await self._connection.json(Request.get(f"/v1/evaluations/{id}"))
        return AsyncEvaluation(self._connection, data)

    async def rollouts(self, bodies: Iterable[BodyLike] | NDArray[Any],
                       environments: Environments = "paper-test", *,
                       controller: str = "default", record: Sequence[str] = ("masses", ),
                       record_stride: int = 10, physics: Physics | None = None,
                       precision: Literal["float32", "float64"] = "float32",
                       repair: Repair | None = None,
                       states: Sequence[Mapping[str, Any] | None] | None = None,
                       final_states: bool = False) -> Scene:
        """Computes up to 64 rollouts and their recordings without storing them, for viewers and
        editors. The losses are the same as in an evaluation, bit for bit. A warning about the
        physics is issued as a `UserWarning`.

        With `final_states`, the scene has `states`, the state in which each rollout ends. Pass
        them as `states` to continue these rollouts in another call, bit for bit; the light and
        the task may change between the calls (docs/driving.md)."""
        request = Request.post("/v1/rollouts", without_none({
            "designs": designs_of(bodies), "environments": environments, "controller": controller,
            "record": list(record), "record_stride": record_stride, "precision": precision,
            "physics": physics, "repair": repair,
            "states": None if states is None else list(states),
            "final_states": True if final_states else None,
        }), accept=MEDIA_TYPE)
        scene = Scene((await self._connection.send(request)).content)
        for warning in scene.warnings:
            warnings.warn(warning, stacklevel=2)
        return scene

    async def show(self, bodies: Iterable[BodyLike] | NDArray[Any],
                   environments: Environments = "paper-test", *,
                   environment: int = 0, controller: str = "default",
                   physics: Physics | None = None, repair: Repair | None = None,
                   title: str = "Robots of morphod") -> Player:
        """Returns robots that walk in one environment: a player for notebooks, which `save` writes
        as one HTML file."""
        if isinstance(environments, str):
            known = await self._connection.json(Request.get(f"/v1/environment-sets/{environments}"))
            world: Mapping[str, Any] = world_of(known, environment)
        elif isinstance(environments, Mapping):
            raise MorphodError("show needs the name of a set or a list of environments; for varied "
                               "ones, evaluate first, then show the evaluation")
        elif -len(environments) <= environment < len(environments):
            world = environments[environment]
        else:
            raise MorphodError(f"there is no environment {environment}: got {len(environments)}, "
                               "counted from 0")
        scene = await self.rollouts(bodies, [world], controller=controller,
                                    record_stride=8, physics=physics, repair=repair)
        return await player(self._connection, scene, title)
