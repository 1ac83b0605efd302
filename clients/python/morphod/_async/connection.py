"""A connection to the service: sends requests, and retries those that can be repeated safely."""

from __future__ import annotations

import json
import os
import pathlib
from collections.abc import AsyncIterator
from typing import Any

import anyio
import anyio.lowlevel
import httpx

from .._wire import Address, Reply, Request, Retries, refusal, undecodable
from ..errors import MorphodError, UnreachableError, printable, reading

_REOPEN_S = 0.1
"""Pause between two streams of events."""

_inherited: list[httpx.AsyncClient] = []
"""Clients of the process that this one was forked from. Do not close or use them here."""


class AsyncConnection:
    """Keeps connections open between requests. Close it when it is no longer needed.

    Each process and each event loop has its own: a forked child never reads the replies of its
    parent. A copy or an unpickled one opens its own connections.
    """

    def __init__(self, server: str | None, token: str | None, retry_s: float) -> None:
        self.address = Address.of(server)
        self.token = token
        self.retry_s = retry_s
        self.answered = False
        """True once the service has replied."""
        self._pid = os.getpid()
        self._clients: dict[object, httpx.AsyncClient] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {"address": self.address, "token": self.token, "retry_s": self.retry_s}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, answered=False, _pid=os.getpid(), _clients={})

    @property
    def _client(self) -> httpx.AsyncClient:
        """The connections of this process and this event loop."""
        if self._pid != os.getpid():
            _inherited.extend(self._clients.values())
            self._pid, self._clients = os.getpid(), {}
        loop = anyio.lowlevel.current_token()
        client = self._clients.get(loop)
        if client is None:
            for other in [other for other in self._clients if _has_ended(other)]:
                del self._clients[other]
            token = self.token or os.environ.get("MORPHOD_TOKEN")
            headers = {"Authorization": f"Bearer {token}"} if token else {}
            unix = self.address.unix
            transport = httpx.AsyncHTTPTransport(uds=unix) if unix is not None else None
            # Ignore proxies from the environment: the service is usually on the local network.
            client = httpx.AsyncClient(base_url=self.address.url, headers=headers,
                                       transport=transport, trust_env=False)
            client = self._clients.setdefault(loop, client)
        return client

    async def close(self) -> None:
        """Closes the connections of this event loop; the others end with their loops."""
        if self._pid == os.getpid():
            client = self._clients.pop(anyio.lowlevel.current_token(), None)
            if client is not None:
                await client.aclose()

    async def send(self, request: Request) -> Reply:
        """Returns the reply to a request. While the service is unavailable, busy or full, a request
        that can be repeated safely is retried for `retry_s` seconds. Raises `ApiError` and
        `UnreachableError`."""
        retries = Retries(request, self.retry_s)
        while True:
            try:
                response = await self._client.request(
                    request.method, request.path, params=request.params, content=request.content,
                    headers=request.headers, timeout=request.timeout_s)
            except httpx.DecodingError as error:
                raise undecodable(error) from None
            except httpx.TransportError as error:
                # Without a connection nothing was sent, so any request can be retried.
                request.repeatable |= isinstance(error, (httpx.ConnectError, httpx.ConnectTimeout))
                delay = retries.delay(None)
                if delay is None:
                    raise self._unreachable(error) from error
                retries.report(str(self._unreachable(error)), self.answered)
            else:
                self.answered = True
                if response.status_code < 400:
                    return Reply(response.status_code, response.headers, response.content)
                delay = retries.delay(response.status_code, response.headers.get("Retry-After"))
                if delay is None:
                    raise refusal(response.status_code, response.content)
            await anyio.sleep(delay)

    def _unreachable(self, error: httpx.TransportError) -> UnreachableError:
        return UnreachableError(f"no reply from {self.address.unix or self.address.url}: "
                                f"{printable(error) or type(error).__name__}; is the service "
                                "running?")

    async def save(self, request: Request, path: pathlib.Path) -> None:
        """Writes a long reply to a file, which replaces `path` once it is complete."""
        retries = Retries(request, self.retry_s)
        part = path.with_name(path.name + ".part")
        while True:
            delay: float | None
            try:
                async with self._client.stream(
                        request.method, request.path, params=request.params,
                        headers=request.headers, timeout=request.timeout_s) as response:
                    if response.status_code < 400:
                        # Writing to the page cache is faster than switching threads.
                        with open(part, "wb") as file:  # noqa: ASYNC230
                            async for piece in response.aiter_bytes():
                                file.write(piece)
                        part.replace(path)
                        return
                    content = await response.aread()
                    delay = retries.delay(response.status_code, response.headers.get("Retry-After"))
                    if delay is None:
                        raise refusal(response.status_code, content)
            except httpx.DecodingError as error:
                raise undecodable(error) from None
            except httpx.TransportError as error:
                delay = retries.delay(None)
                if delay is None:
                    raise UnreachableError(f"the reply broke off: {printable(error)}") from error
            finally:
                part.unlink(missing_ok=True)
            await anyio.sleep(delay)

    async def json(self, request: Request) -> dict[str, Any]:
        """Returns the JSON object of a reply."""
        value = (await self.send(request)).json()
        if not isinstance(value, dict):
            raise MorphodError(f"expected a JSON object, got {type(value).__name__}: is this "
                               "a morphod service?")
        return value

    async def pages(self, path: str, limit: int = 1000, **params: Any) -> AsyncIterator[Any]:
        """Yields the items of a list, page by page."""
        cursor = None
        seen = set()
        while True:
            page = await self.json(Request.get(path, limit=limit, cursor=cursor, **params))
            with reading():
                items, cursor = list(page["items"]), page["next_cursor"]
                if not all(isinstance(item, dict) for item in items):
                    raise TypeError("an item in the list is not an object")
                if cursor in seen:
                    raise ValueError(f"the list does not end: its cursor {cursor!r} repeats")
                seen.add(cursor)
            for item in items:
                yield item
            if cursor is None:
                return

    async def events(self, after: str | None, job: str | None) -> AsyncIterator[dict[str, Any]]:
        """Yields events. After a lost connection it continues after the last event. If events were
        lost, an event of type "reset" takes their place."""
        retries = None
        while True:
            request = Request.get("/v1/events", accept="text/event-stream", after=after, job=job)
            retries = retries or Retries(request, self.retry_s)
            delay: float | None
            pid = os.getpid()
            try:
                async with self._client.stream(
                        "GET", request.path, params=request.params, headers=request.headers,
                        timeout=httpx.Timeout(request.timeout_s)) as response:
                    if response.status_code >= 400:
                        content = await response.aread()
                        delay = retries.delay(response.status_code,
                                              response.headers.get("Retry-After"))
                        if delay is None:
                            raise refusal(response.status_code, content)
                    elif "text/event-stream" not in response.headers.get("Content-Type", ""):
                        raise MorphodError("the reply is not an event stream: is this a morphod "
                                           "service?")
                    else:
                        kind, delay = "", _REOPEN_S
                        async for line in response.aiter_lines():
                            retries = None
                            name, _, value = line.rstrip("\n").partition(": ")
                            if name == "event":
                                kind = value
                            elif name == "data":
                                with reading():
                                    event = json.loads(value)
                                    after = event.get("id", after)
                                    event = {**event, "type": event.get("type", kind)}
                                yield event
                                if os.getpid() != pid:  # the stream belongs to the parent
                                    break
                        if retries is not None:  # it ended before any data arrived
                            delay = retries.delay(None)
                            if delay is None:
                                raise UnreachableError("the event stream ended immediately")
            except httpx.DecodingError as error:
                raise undecodable(error) from None
            except httpx.TransportError as error:
                retries = retries or Retries(request, self.retry_s)
                delay = retries.delay(None)
                if delay is None:
                    raise UnreachableError(
                        f"the event stream broke off: {printable(error)}") from error
            await anyio.sleep(delay)


def _has_ended(loop: object) -> bool:
    """Returns whether an event loop is closed, with all its connections."""
    is_closed = getattr(getattr(loop, "native_token", loop), "is_closed", None)
    return is_closed is not None and bool(is_closed())
