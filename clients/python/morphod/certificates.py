"""The report of a certificate (docs/trust.md defines its numbers)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from .bodies import Body
from .errors import printable, reading
from .frames import frame

if TYPE_CHECKING:
    import pandas as pd

Interval = tuple[float, float]
"""The ends of a 95 % confidence interval; NaN, NaN if it is unknown."""
_NAN = float("nan")


class CertificateLevel:
    """All designs at one level of one axis; the first one of a report is the base.

    `level` says by how much the axis is changed (NaN: the axis has no levels). `tau` is Kendall's
    tau-b between the scores of the designs here and in the base, and `tau_interval` its interval.
    `top_score` is the mean score here of the base's best designs, and `regret` is how much that
    exceeds the mean score of the designs that are best here. `mean_score` leaves out the
    `diverged_designs`. Unknown numbers are NaN. `fingerprint` is the class of code and hardware
    that computed the losses.
    """

    @reading()
    def __init__(self, data: Mapping[str, Any]) -> None:
        self.data = data
        self.axis, self.precision = str(data["axis"]), str(data["precision"])
        self.fingerprint = str(data["fingerprint"])
        self.environments = int(data["environments"])
        self.diverged_designs = int(data["diverged_designs"])
        self.level, self.mean_score, self.tau, self.regret, self.top_score = (
            _number(data[name]) for name in ("level", "mean_score", "tau", "regret", "top_score"))
        self.tau_interval = _interval(data["tau_interval"])

    @property
    def name(self) -> str:
        """The axis and the level, such as "friction 0.7"."""
        return printable(self.axis) + ("" if self.level != self.level else f" {self.level:g}")

    def __repr__(self) -> str:
        return f"<CertificateLevel {self.name}: tau {self.tau:.2f}, regret {self.regret:.4g}>"


class CertifiedScore:
    """A design at one level: `score` and its `interval`, the `change` from the base and its
    `change_interval`, its `rank` among the designs, and how many rollouts `diverged`. If any did,
    the score and the change are NaN."""

    @reading()
    def __init__(self, data: Mapping[str, Any]) -> None:
        self.data = data
        self.score, self.change = _number(data["score"]), _number(data["change"])
        self.interval = _interval(data["interval"])
        self.change_interval = _interval(data["change_interval"])
        self.rank, self.diverged = int(data["rank"]), int(data["diverged"])

    def __repr__(self) -> str:
        return f"<CertifiedScore {self.score:.6g}, rank {self.rank}>"


class CertifiedDesign:
    """One design of a certificate, with its `verdict` in words.

    `id` stands for the design in all orientations, `robot` for the one that was scored (ID@K).
    `score`, `interval` and `rank` are those of the base, as are `flags` (those of any rollout),
    `peak_strain` and `inverted_voxels` (the largest of the rollouts; NaN: unknown). `levels` has
    its scores, in the order of the report's levels. `verdict_class` is the verdict in brief
    (no_score, in_doubt, depends or holds), and `worse` has the axes at whose levels it is worse.
    """

    @reading()
    def __init__(self, data: Mapping[str, Any]) -> None:
        self.data = data
        self.id, self.robot = str(data["id"]), str(data["design"])
        self.verdict = printable(data["verdict"])
        self.verdict_class = str(data["class"])
        self.worse = tuple(str(axis) for axis in data["worse"])
        self.rank, self.score = int(data["rank"]), _number(data["score"])
        self.interval = _interval(data["interval"])
        self.flags = tuple(str(flag) for flag in data["flags"])
        self.peak_strain, self.inverted_voxels = (
            _number(data[name]) for name in ("peak_strain", "inverted_voxels"))
        self.levels = tuple(CertifiedScore(level) for level in data["levels"])

    @property
    def body(self) -> Body:
        """The body, in the orientation that was scored."""
        return Body.of(self.robot)

    def __repr__(self) -> str:
        return f"<CertifiedDesign {printable(self.robot)}: rank {self.rank}, {self.score:.6g}>"


class CertificateReport:
    """What a certificate says: its `verdict` in words, the `levels`, and the `designs` in the order
    of the request (those of a campaign or an evaluation: best first).

    `complete` is false while levels are missing. `top` is the number of designs that the regret is
    for. `left_out` has the requested axes that do not apply, with the reasons,
    and `axis_notes` caveats for single axes. `data` is the reply, with the names of the
    contract.
    """

    @reading()
    def __init__(self, data: Mapping[str, Any]) -> None:
        self.data = data
        self.id, self.verdict = str(data["id"]), printable(data["verdict"])
        self.complete, self.top = bool(data["complete"]), int(data["top"])
        self.levels = tuple(CertificateLevel(level) for level in data["levels"])
        self.designs = tuple(CertifiedDesign(design) for design in data["designs"])
        self.left_out = {str(row["axis"]): printable(row["reason"]) for row in data["left_out"]}
        self.axis_notes = {str(row["axis"]): printable(row["note"]) for row in data["axis_notes"]}
        if any(len(design.levels) != len(self.levels) for design in self.designs):
            raise ValueError("a design and the report have different numbers of levels")

    @reading()
    def frame(self) -> pd.DataFrame:
        """Returns a table with a row for each design and level: certificate, design, id, axis,
        level, environments, precision, score, low, high, change, change_low, change_high, rank,
        diverged."""
        return frame((
            {"design": design.robot, "id": design.id, "axis": level.axis, "level": level.level,
             "environments": level.environments, "precision": level.precision,
             "score": score.score, "low": score.interval[0], "high": score.interval[1],
             "change": score.change, "change_low": score.change_interval[0],
             "change_high": score.change_interval[1], "rank": score.rank,
             "diverged": score.diverged}
            for design in self.designs for level, score in zip(self.levels, design.levels)
        ), certificate=self.id)

    @reading()
    def level_frame(self) -> pd.DataFrame:
        """Returns a table with a row for each level: certificate, axis, level, environments,
        precision, tau, tau_low, tau_high, regret, top_score, mean_score, diverged_designs."""
        return frame((
            {"axis": level.axis, "level": level.level, "environments": level.environments,
             "precision": level.precision, "tau": level.tau, "tau_low": level.tau_interval[0],
             "tau_high": level.tau_interval[1], "regret": level.regret,
             "top_score": level.top_score, "mean_score": level.mean_score,
             "diverged_designs": level.diverged_designs}
            for level in self.levels), certificate=self.id)

    def __repr__(self) -> str:
        state = "" if self.complete else " (not complete)"
        return f"<CertificateReport {self.id}{state}: {self.verdict}>"


def _number(value: Any) -> float:
    return _NAN if value is None else float(value)


def _interval(value: Any) -> Interval:
    if value is None:
        return _NAN, _NAN
    low, high = value
    return float(low), float(high)
