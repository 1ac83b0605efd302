"""Results that need no further requests: the scores of a design, and controllers."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from .bodies import Body, dropped
from .errors import counted, reading
from .frames import frame
from .weights import read_safetensors, torch_module

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import NDArray


class ScoreError:
    """The estimated error of a score, from additional rollouts.

    The limit is the score that the same robot has in the same environments with vanishing time
    steps and without rounding. With the paper's settings, it is between `low` and `high` for at
    least 90 % of designs.
    `discretization` is the estimated distance between the score and the limit. `rounding` is the
    largest change of the score if the robot starts 1e-7, 2e-7 or 3e-7 m higher. `standard_error` is
    the standard error of the mean over environments (NaN for one environment). `bifurcates` lists
    the environments in which these higher starts lead to clearly different distances from the light
    at the end, so that rounding determines the loss. All numbers are NaN if a rollout diverged.
    """

    @reading()
    def __init__(self, data: Mapping[str, Any]) -> None:
        self.data = data
        self.low, self.high, self.discretization, self.rounding, self.standard_error = (
            float("nan") if data[name] is None else float(data[name])
            for name in ("low", "high", "discretization", "rounding", "standard_error"))
        self.bifurcates = tuple(int(place) for place in data["bifurcates"])

    def __repr__(self) -> str:
        return f"<ScoreError {self.low:.6g} to {self.high:.6g}>"


class Climb:
    """The settings that a tolerance chose for a design.

    `reached` says whether `estimated_error` is at most the tolerance that was `asked`. If not, the
    score is the one with the least estimated error. `bifurcates` says whether smaller time steps
    would not help either, because rounding decides or the error has stopped falling. The score was
    computed with steps of `dt_s` and numbers of `precision` (both None if there was no body).
    `estimated_error` is NaN if there was no body, or if rollouts diverged with all settings.
    `rungs` has what each of the settings that were tried gave, as in the reply.
    """

    @reading()
    def __init__(self, data: Mapping[str, Any]) -> None:
        self.data = data
        self.asked = float(data["asked"])
        self.reached, self.bifurcates = bool(data["reached"]), bool(data["bifurcates"])
        found = data["estimated_error"]
        self.estimated_error = float("nan") if found is None else float(found)
        self.dt_s: float | None = data["dt_s"]
        self.precision: str | None = data["precision"]
        self.rungs: tuple[Mapping[str, Any], ...] = tuple(data["rungs"])

    def __repr__(self) -> str:
        return (f"<Climb {'reached' if self.reached else 'missed'} {self.asked:.6g}: "
                f"{self.estimated_error:.6g}>")


def losses_of(rows: Sequence[Sequence[Any]]) -> NDArray[np.float64]:
    """(rows, environments): the losses of entries that are losses or, with tasks, objects."""
    return np.array([[entry["loss"] if isinstance(entry, dict) else entry for entry in row]
                     for row in rows], dtype=np.float64)


def values_of(rows: Sequence[Sequence[Any]]) -> NDArray[np.float64]:
    """The same for values. Where there are no tasks, the value is 1 minus the loss."""
    losses = losses_of(rows)
    for place, row in enumerate(rows):
        losses[place] = [entry["value"] if isinstance(entry, dict) else 1 - losses[place, k]
                         for k, entry in enumerate(row)]
    return losses


def units_of(row: Sequence[Any]) -> list[str]:
    """The units of one row's values."""
    return [entry["unit"] if isinstance(entry, dict) else "" for entry in row]


def measures_of(rows: Sequence[Sequence[Any]]) -> dict[str, NDArray[np.float64]]:
    """(rows, environments) for each measure that was requested; NaN where it has no value."""
    first = rows[0][0] if rows else None
    names = list(first.get("measures", ())) if isinstance(first, dict) else []
    return {name: np.array([[entry["measures"][name] for entry in row] for row in rows],
                           dtype=np.float64) for name in names}


class Result:
    """The scores of one design in all environments of its evaluation.

    `robot` is the scored design in the orientation that was simulated (ID@K), and `genotype` has
    its voxels. `id` stands for the design in all orientations, which have separate scores.
    `orientation` says how the orientation was chosen for an id without one: "best" stored score, or
    "canonical" because there was none. It is None if the orientation was given. `lost` says what
    the conversion and the repair of the body left out. `fault` is None, or why there was no body to
    score: then `id`, `robot` and `genotype` are empty, and the score is NaN. `lower_bound` is true
    if the score is a lower bound, because the design cannot be among the `best` that were
    requested. `error` is the estimated error of the score, and `tolerance` has the settings that
    were chosen for it; both are None if they were not requested. `measures` has the means of the
    requested measures over the environments, by name (NaN if a rollout has none), and `flags` marks
    what real bodies cannot do: "overstrained" and "inverted" if that happens in any of the
    rollouts.
    """

    @reading()
    def __init__(self, data: Mapping[str, Any], lost: tuple[str, ...],
                 fault: str | None = None) -> None:
        self.data = data
        self.lost = lost + dropped(data["repaired"])
        found = data["fault"]
        self.fault: str | None = fault if found and fault else found and str(found["detail"])
        self.id = str(data["id"] or "")
        self.robot = str(data["robot"] or "")
        self.orientation: str | None = data["orientation"]
        self.genotype = str(data["genotype"] or "")
        score = data["score"]
        self.score = float("nan") if score is None else float(score)
        self.lower_bound = bool(data["lower_bound"])
        error = data.get("error")
        self.error = None if error is None else ScoreError(error)
        self.measures = {str(name): float("nan") if mean is None else float(mean)
                         for name, mean in data.get("measures", {}).items()}
        self.flags = tuple(str(flag) for flag in data.get("flags", ()))
        climb = data.get("tolerance")
        self.tolerance = None if climb is None else Climb(climb)

    @property
    @reading()
    def body(self) -> Body:
        """The body that was simulated."""
        return Body.of(self.genotype)

    @property
    @reading()
    def losses(self) -> NDArray[np.float64]:
        """One per environment; NaN if the rollout diverged, or was not needed."""
        return losses_of([self.data["losses"]]).ravel()

    @property
    @reading()
    def values(self) -> NDArray[np.float64]:
        """One per environment: the score in the unit of the task, higher is better; for `photo`,
        1 minus the loss."""
        return values_of([self.data["losses"]]).ravel()

    @property
    @reading()
    def measured(self) -> dict[str, NDArray[np.float64]]:
        """The requested measures of each rollout: by name, one per environment; NaN where a measure
        has no value, or the rollout diverged or was not needed."""
        return {name: row.ravel() for name, row in measures_of([self.data["losses"]]).items()}

    def __repr__(self) -> str:
        return f"<Result {self.robot}: score {self.score:.6g}>"


class Batch:
    """A batch of a study: its children by position, with scores.

    `number` is the number of the batch, `numbers` has those of the designs (None if skipped),
    `notes` says what was skipped or repaired, and `data` is the whole reply of the service.
    """

    @reading()
    def __init__(self, data: Mapping[str, Any]) -> None:
        self.data = data
        self.number = int(data["batch"])
        self.notes: Sequence[Mapping[str, Any]] = data["notes"]
        skipped = sum(note["fault"] is not None for note in self.notes)
        self.rows: list[Mapping[str, Any] | None] = [None] * (len(data["children"]) + skipped)
        for row in data["children"]:
            self.rows[row["child"]] = row
        self.numbers = [None if row is None else int(row["number"]) for row in self.rows]

    def __len__(self) -> int:
        return len(self.rows)

    @property
    @reading()
    def scores(self) -> NDArray[np.float64]:
        """(children,): mean losses, or the study's own score; lower is better. NaN if skipped, or
        if a rollout diverged."""
        return np.array([None if row is None else row["score"] for row in self.rows],
                        dtype=np.float64)

    @property
    @reading()
    def losses(self) -> NDArray[np.float64]:
        """(children, environments); NaN if skipped, diverged, or computed by another version."""
        rows = [(row or {}).get("losses") or () for row in self.rows]
        table = np.full((len(rows), max(map(len, rows), default=0)), np.nan)
        for place, row in enumerate(rows):
            table[place, :len(row)] = losses_of([row])[0]
        return table

    @property
    @reading()
    def measures(self) -> dict[str, NDArray[np.float64]]:
        """The measures that the service computes for the study, by name, each (children,
        environments); NaN where a measure has no value, or where `losses` is NaN. Empty if the
        study names none."""
        rows = [(row or {}).get("losses") or () for row in self.rows]
        measured = [place for place, row in enumerate(rows) if len(row) > 0]
        found = measures_of([rows[place] for place in measured])
        table = {}
        for name, values in found.items():
            table[name] = np.full((len(rows), values.shape[1]), np.nan)
            table[name][measured] = values
        return table

    @property
    @reading()
    def bodies(self) -> list[Body | None]:
        """The body that was scored; None if it was skipped."""
        return [None if row is None else Body.of(row["genotype"]) for row in self.rows]

    @reading()
    def frame(self) -> pd.DataFrame:
        """Returns a table with a row per child that was born."""
        return frame(self.data["children"])

    def __repr__(self) -> str:
        return f"<Batch {self.number}: {len(self)} children>"


class Asked:
    """Bodies that a study suggests: `bodies`, with their `parents` and `operators`."""

    @reading()
    def __init__(self, data: Mapping[str, Any]) -> None:
        self.batch = int(data["batch"])
        self.bodies = [Body.of(child["body"]["voxels"]) for child in data["children"]]
        self.parents: list[list[int]] = [child["parents"] for child in data["children"]]
        self.operators: list[str] = [child["operator"] for child in data["children"]]

    def __len__(self) -> int:
        return len(self.bodies)

    def __repr__(self) -> str:
        return f"<Asked: {counted(len(self), 'body', 'bodies')} for batch {self.batch}>"


def children_of(designs: Sequence[Mapping[str, str]], parents: Sequence[Sequence[int]] | None,
                operator: str | Sequence[str] | None,
                measures: Mapping[str, Iterable[float]] | None,
                scores: Iterable[float] | None = None) -> list[dict[str, Any]]:
    """Returns the children of a batch in the format of the service."""
    columns: dict[str, Sequence[Any]] = {"body": designs}
    if parents is not None:
        columns["parents"] = [[int(number) for number in row] for row in parents]
    if operator is not None:
        columns["operator"] = [operator] * len(designs) if isinstance(operator, str) else operator
    if measures:
        named = {name: [_finite(f"measure {name!r}", value, "numbers must be finite; NaN means "
                                "no value") for value in values]
                 for name, values in measures.items()}
        if len(set(map(len, named.values()))) != 1:
            raise ValueError("measures have different numbers of children")
        columns["measures"] = [dict(zip(named, row)) for row in zip(*named.values())]
    if scores is not None:
        columns["score"] = [_finite("a score", score, "leave the body out, or give it a "
                                    "score worse than all others") for score in scores]
    for name, column in columns.items():
        if len(column) != len(designs):
            raise ValueError(f"{name}: {len(column)} for {len(designs)} children")
    return [dict(zip(columns, row)) for row in zip(*columns.values())]


def _finite(what: str, value: float, advice: str) -> float | None:
    """Returns a number to send. NaN becomes None: there is no number."""
    if math.isinf(value):
        raise ValueError(f"{what} is {value}: {advice}")
    return None if math.isnan(value) else float(value)


class Controller:
    """A controller: its file, and information about it.

    `data` is the service's information about it, `content` the bytes of its safetensors file.
    """

    @reading()
    def __init__(self, data: Mapping[str, Any], content: bytes) -> None:
        self.data = data
        self.content = content
        self.name: str | None = data["name"]

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """The tensors by name: net.0.weight, net.0.bias, …"""
        return read_safetensors(self.content)[0]

    @property
    def metadata(self) -> dict[str, str]:
        """The metadata of the file: sensor, parent, settings, …"""
        return read_safetensors(self.content)[1]

    @property
    def control_period_s(self) -> float | None:
        """Seconds for which its outputs are held; None: it computes them in every step."""
        text = self.metadata.get("control_period_s")
        return None if text is None else float(text)

    def torch(self) -> Any:
        """Returns the controller as a `torch.nn.Module`. Needs torch."""
        return torch_module(self.arrays)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the safetensors file."""
        with open(path, "wb") as file:
            file.write(self.content)

    def __repr__(self) -> str:
        return f"<Controller {self.name or self.data.get('sha256', 'without a name')}>"


class Svg(str):
    """The text of an SVG file. Notebooks show the picture."""

    def _repr_svg_(self) -> str:
        return str(self)
