"""A connection to the service: sends requests, and repeats those that may be repeated."""

from __future__ import annotations

import json
import os
import time
import pathlib
from collections.abc import Iterator
from typing import Any

import httpx

from .._wire import Address, Reply, Request, Retries, refusal
from ..errors import UnreachableError


class Connection:
    """Keeps connections open between requests. Close it when it is no longer needed."""

    def __init__(self, server: str | None, token: str | None, retry_s: float) -> None:
        self.address = Address.of(server)
        self.retry_s = retry_s
        token = token or os.environ.get("MORPHOD_TOKEN")
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        unix = self.address.unix
        transport = httpx.HTTPTransport(uds=unix) if unix is not None else None
        # No proxy from the environment between a laboratory and its own machine.
        self._client = httpx.Client(base_url=self.address.url, headers=headers,
                                         transport=transport, trust_env=False)

    def close(self) -> None:
        self._client.close()

    def send(self, request: Request) -> Reply:
        """The reply to a request. While the service is away, busy or full, a request that may be
        repeated is repeated, for `retry_s` seconds. Raises `ApiError` and `UnreachableError`."""
        retries = Retries(request, self.retry_s)
        while True:
            try:
                response = self._client.request(
                    request.method, request.path, params=request.params, content=request.content,
                    headers=request.headers, timeout=request.timeout_s)
            except httpx.TransportError as error:
                # Without a connection nothing was sent, whatever the request is.
                request.repeatable |= isinstance(error, (httpx.ConnectError, httpx.ConnectTimeout))
                delay = retries.delay(None)
                if delay is None:
                    raise UnreachableError(
                        f"no reply from {self.address.unix or self.address.url}: "
                        f"{error or type(error).__name__}; is the service running?") from error
            else:
                if response.status_code < 400:
                    return Reply(response.status_code, response.headers, response.content)
                delay = retries.delay(response.status_code, response.headers.get("Retry-After"))
                if delay is None:
                    raise refusal(response.status_code, response.content)
            time.sleep(delay)

    def save(self, request: Request, path: pathlib.Path) -> None:
        """Writes a long reply into a file. It takes the place of `path` when it is whole."""
        retries = Retries(request, self.retry_s)
        part = path.with_name(path.name + ".part")
        while True:
            delay: float | None
            try:
                with self._client.stream(
                        request.method, request.path, params=request.params,
                        headers=request.headers, timeout=request.timeout_s) as response:
                    if response.status_code < 400:
                        # A write to the page cache is shorter than a change of threads.
                        with open(part, "wb") as file:  # noqa: ASYNC230
                            for piece in response.iter_bytes():
                                file.write(piece)
                        part.replace(path)
                        return
                    content = response.read()
                    delay = retries.delay(response.status_code, response.headers.get("Retry-After"))
                    if delay is None:
                        raise refusal(response.status_code, content)
            except httpx.TransportError as error:
                delay = retries.delay(None)
                if delay is None:
                    raise UnreachableError(f"the reply broke off: {error}") from error
            finally:
                part.unlink(missing_ok=True)
            time.sleep(delay)

    def json(self, request: Request) -> Any:
        return (self.send(request)).json()

    def pages(self, path: str, limit: int = 1000, **params: Any) -> Iterator[Any]:
        """The items of a list, page after page."""
        cursor = None
        while True:
            page = self.json(Request.get(path, limit=limit, cursor=cursor, **params))
            for item in page["items"]:
                yield item
            cursor = page["next_cursor"]
            if cursor is None:
                return

    def events(self, after: str | None, job: str | None) -> Iterator[dict[str, Any]]:
        """Events, one after the other; goes on behind the last one when the connection breaks.
        Where events were lost, one of the type "reset" comes."""
        retries = None
        while True:
            request = Request.get("/v1/events", accept="text/event-stream", after=after, job=job)
            retries = retries or Retries(request, self.retry_s)
            delay: float | None
            try:
                with self._client.stream(
                        "GET", request.path, params=request.params, headers=request.headers,
                        timeout=httpx.Timeout(request.timeout_s)) as response:
                    if response.status_code >= 400:
                        content = response.read()
                        delay = retries.delay(response.status_code,
                                              response.headers.get("Retry-After"))
                        if delay is None:
                            raise refusal(response.status_code, content)
                    else:
                        kind, delay = "", 0.0
                        for line in response.iter_lines():
                            name, _, value = line.rstrip("\n").partition(": ")
                            if name == "event":
                                kind = value
                            elif name == "data":
                                retries = None
                                event = json.loads(value)
                                after = event.get("id", after)
                                yield {**event, "type": event.get("type", kind)}
            except httpx.TransportError as error:
                retries = retries or Retries(request, self.retry_s)
                delay = retries.delay(None)
                if delay is None:
                    raise UnreachableError(f"the stream of events broke: {error}") from error
            time.sleep(delay)
