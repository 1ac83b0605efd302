"""The progress of a job, on a terminal or in a notebook; uses tqdm if it is installed."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from types import TracebackType
from typing import TYPE_CHECKING, Any

from .errors import printable

if TYPE_CHECKING:
    from typing_extensions import Self


class Bar:
    """A tqdm bar on a terminal and in a notebook; elsewhere, and without tqdm, a line on standard
    error every few seconds."""

    EVERY_S = 5.0

    def __init__(self, title: str, total: int, unit: str) -> None:
        self._title = title
        self._printed_s = -self.EVERY_S
        self._text = ""
        self._bar: Any = None
        if not sys.stderr.isatty() and "ipykernel" not in sys.modules:
            return
        try:
            from tqdm.auto import tqdm
        except ImportError:
            return
        self._bar = tqdm(total=total, desc=title, unit=unit)

    def update(self, done: int, total: int, doing: str = "", **more: Any) -> None:
        """`doing` describes the job's current activity, and `more` are additional numbers; those
        that are None are omitted."""
        known = {name: value for name, value in more.items() if value is not None}
        if self._bar is not None:
            self._bar.total = total
            self._bar.n = done
            self._bar.set_description_str(f"{self._title}: {doing}" if doing else self._title,
                                          refresh=False)
            self._bar.set_postfix(known, refresh=False)
            self._bar.refresh()
            return
        text = f"{self._title}: {done} of {total}"
        text += f", {doing}" if doing else ""
        text += "".join(f", {name} {value:.4g}" for name, value in known.items())
        is_due = time.monotonic() - self._printed_s >= self.EVERY_S or done == total
        if is_due and text != self._text:
            self._printed_s = time.monotonic()
            self._text = text
            print(text, file=sys.stderr)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        if self._bar is not None:
            self._bar.close()


def doing(job: Mapping[str, Any]) -> str:
    """Describes what a job does while no step is completed: "drawing the pretraining bodies, 2 %,
    2:20 left"; empty if it has ended."""
    phase, progress = job.get("phase"), job.get("progress") or {}
    if job["state"] == "queued" and job.get("n_waiting"):
        stored = job["n_designs"] - job["n_waiting"]
        why = f", {printable(job['reason'])}" if job.get("reason") else ""
        return f"{stored} of {job['n_designs']} designs stored{why}"
    if job["state"] in ("queued", "paused"):
        return ", ".join(map(printable, filter(None, (job["state"], job.get("reason")))))
    if job["state"] != "running" or not phase or phase == "idle":
        return ""
    words = [printable(phase)]
    if progress.get("total"):
        words = [_PHASES.get(phase, words[0])]
        words.append(f"{100 * progress['done'] / progress['total']:.0f} %")
    if progress.get("seconds_left") is not None:
        words.append(f"{clock(progress['seconds_left'])} left")
    return ", ".join(words)


_PHASES = {"preparing": "drawing the pretraining bodies", "replaying": "drawing earlier bodies"}


def clock(seconds: float) -> str:
    """Formats seconds as 2:20, or 1:02:20."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
