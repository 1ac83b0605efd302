"""How far a job is, on a terminal or in a notebook: by tqdm where it is installed."""

from __future__ import annotations

import sys
import time
from types import TracebackType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from typing_extensions import Self


class Bar:
    """A bar of tqdm, or without tqdm a line on standard error every few seconds."""

    EVERY_S = 5.0

    def __init__(self, title: str, total: int, unit: str) -> None:
        self._title = title
        self._told_s = -self.EVERY_S
        self._bar: Any = None
        try:
            from tqdm.auto import tqdm
        except ImportError:
            return
        self._bar = tqdm(total=total, desc=title, unit=unit)

    def update(self, done: int, total: int, **more: Any) -> None:
        """`more` are numbers beside it; those that are None are left out."""
        known = {name: value for name, value in more.items() if value is not None}
        if self._bar is not None:
            self._bar.total = total
            self._bar.n = done
            self._bar.set_postfix(known, refresh=False)
            self._bar.refresh()
        elif time.monotonic() - self._told_s >= self.EVERY_S or done == total:
            self._told_s = time.monotonic()
            text = "".join(f", {name} {value:.4g}" for name, value in known.items())
            print(f"{self._title}: {done} of {total}{text}", file=sys.stderr)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        if self._bar is not None:
            self._bar.close()
