"""Requests, replies, and when to retry. Knows HTTP, but does not send anything itself."""

from __future__ import annotations

import dataclasses
import email.utils
import json
import math
import os
import random
import sys
import time
import uuid
from collections.abc import Mapping, Sequence, Set
from typing import Any

import numpy as np

from .errors import ApiError, MorphodError, api_error, printable

DEFAULT_SERVER = "http://127.0.0.1:8765"
WAIT_S = 50
"""How long one request waits for a job; the service allows up to 60 s."""

_BACKOFF_S = 0.1
_BACKOFF_MAX_S = 5.0
_RESTART_ATTEMPTS = 6
"""These attempts take about five seconds."""


def given(**values: Any) -> dict[str, Any]:
    """Returns the values that are not None."""
    return {name: value for name, value in values.items() if value is not None}


def without_none(value: Any) -> Any:
    """Returns a request without the members that are None. In a list, None stays."""
    if isinstance(value, Mapping):
        return {name: without_none(item) for name, item in value.items() if item is not None}
    if isinstance(value, (list, tuple)):
        return [without_none(item) for item in value]
    return value


def plain(value: Any) -> Any:
    """Converts a NumPy scalar or array, or another mapping or sequence, to what JSON supports."""
    if isinstance(value, (np.generic, np.ndarray)):
        return value.tolist()
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, (Sequence, Set)):
        return list(value)
    raise TypeError(f"{type(value).__name__} cannot be sent: {value!r:.80} is not JSON")


def encoded(value: Mapping[str, Any]) -> bytes:
    """Returns the JSON of a request."""
    try:
        return json.dumps(value, separators=(",", ":"), default=plain, allow_nan=False).encode()
    except ValueError as error:
        raise ValueError(f"{_not_finite(value) or 'the request'} cannot be sent: {error}") from None


def _not_finite(value: Any, place: str = "") -> str | None:
    """Returns the JSON pointer of the first number that is not finite, and the number."""
    if isinstance(value, (np.generic, np.ndarray)):
        value = value.tolist()
    if isinstance(value, float) and not math.isfinite(value):
        return f"{place}: {value}"
    items = value.items() if isinstance(value, Mapping) else (
        enumerate(value) if isinstance(value, (list, tuple)) else ())
    return next((found for name, item in items
                 if (found := _not_finite(item, f"{place}/{name}"))), None)


@dataclasses.dataclass(frozen=True)
class Address:
    """Where the service is: the URL that requests begin with, and the path of its unix socket."""

    url: str
    unix: str | None

    @classmethod
    def of(cls, server: str | None) -> Address:
        """`http://host:port`, `https://…`, `unix:/path`, or None for $MORPHOD_SERVER and then the
        default address."""
        server = server or os.environ.get("MORPHOD_SERVER") or DEFAULT_SERVER
        if server.startswith("unix:"):
            return cls("http://localhost", server[len("unix:"):])
        if server.startswith(("http://", "https://")):
            return cls(server.rstrip("/"), None)
        raise MorphodError(f'server "{server}" is not http://host:port or unix:/path')


@dataclasses.dataclass
class Request:
    """One request. `repeatable`: sending it twice has the same effect as sending it once."""

    method: str
    path: str
    params: dict[str, Any] = dataclasses.field(default_factory=dict)
    content: bytes | None = None
    headers: dict[str, str] = dataclasses.field(default_factory=dict)
    repeatable: bool = True
    timeout_s: float = 60.0

    @classmethod
    def get(cls, path: str, accept: str = "application/json", wait_s: int = 0,
            **params: Any) -> Request:
        """Returns a GET, without params that are None."""
        plain_params = {name: plain(value) if isinstance(value, np.generic) else value
                        for name, value in given(**params).items()}
        request = cls("GET", path, plain_params, headers={"Accept": accept})
        return request.waiting(wait_s)

    @classmethod
    def submit(cls, path: str, value: Mapping[str, Any], wait_s: int = 0) -> Request:
        """Returns a POST of JSON that creates a job. A unique key makes it safe to repeat."""
        request = cls.post(path, without_none(value))
        request.headers["Idempotency-Key"] = uuid.uuid4().hex
        return request.waiting(wait_s)

    @classmethod
    def post(cls, path: str, value: Mapping[str, Any] | None = None,
             accept: str = "application/json", method: str = "POST") -> Request:
        """Returns a POST or a PATCH that can be repeated safely."""
        request = cls(method, path, headers={"Accept": accept})
        if value is not None:
            request.content = encoded(value)
            request.headers["Content-Type"] = "application/json"
        return request

    def waiting(self, seconds: int) -> Request:
        if seconds > 0:
            self.headers["Prefer"] = f"wait={seconds}"
            self.timeout_s += seconds
        return self


@dataclasses.dataclass(frozen=True)
class Reply:
    """A successful reply."""

    status: int
    headers: Mapping[str, str]
    content: bytes

    def json(self) -> Any:
        try:
            return json.loads(self.content)
        except (ValueError, RecursionError):
            raise MorphodError("the reply is not JSON: is this a morphod service?") from None


def refusal(status: int, content: bytes) -> ApiError:
    """Returns the exception for a reply with a status from 400 on."""
    try:
        problem = json.loads(content)
    except (ValueError, RecursionError):
        problem = None
    if not isinstance(problem, dict):
        problem = {"detail": content[:200].decode(errors="replace")}
    return api_error(status, problem)


def undecodable(error: Exception) -> MorphodError:
    """Returns the exception for a reply with a wrong content coding."""
    return MorphodError(f"the reply cannot be decoded: {printable(error)}; is this a morphod "
                        "service?")


class Retries:
    """Decides how long to wait before a request is retried, within a time limit."""

    def __init__(self, request: Request, within_s: float) -> None:
        self.request = request
        self.deadline = time.monotonic() + within_s
        self.within_s = within_s
        self.attempt = 0
        self.is_reported = False

    def report(self, problem: str, answered: bool) -> None:
        """Reports once on standard error that requests are being retried: immediately if the
        service has never replied, otherwise when the attempts take longer than a restart."""
        if not self.is_reported and (not answered or self.attempt >= _RESTART_ATTEMPTS):
            self.is_reported = True
            left_s = max(0.0, self.deadline - time.monotonic())
            print(f"morphod: {problem} Trying again for {left_s:.0f} s (retry_s="
                  f"{self.within_s:g}).", file=sys.stderr)

    def delay(self, status: int | None, retry_after: str | None = None) -> float | None:
        """Returns the seconds until the next attempt, or None to give up. status None: the
        connection broke, or could not be made."""
        if status is None:
            repeat = self.request.repeatable
        else:
            # The service accepted nothing, so any request can be repeated.
            repeat = status in (429, 503, 507)
        seconds: float = min(_BACKOFF_S * 2.0**self.attempt, _BACKOFF_MAX_S)
        seconds *= random.uniform(0.5, 1)
        if retry_after is not None:
            seconds = max(seconds, _seconds_of(retry_after))
        self.attempt += 1
        if not repeat or time.monotonic() + seconds > self.deadline:
            return None
        return seconds


def _seconds_of(retry_after: str) -> float:
    """Parses a `Retry-After`, in seconds or as a date."""
    if retry_after.isascii() and retry_after.isdigit():
        return float(retry_after)
    try:
        return max(0.0, email.utils.parsedate_to_datetime(retry_after).timestamp() - time.time())
    except (ArithmeticError, TypeError, ValueError):
        return 0.0
