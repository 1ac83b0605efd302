"""Everything that can go wrong, as exceptions. All of them are a `MorphodError`."""

from __future__ import annotations

import contextlib
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from typing import Any


def counted(n: int, thing: str, things: str = "") -> str:
    """Returns "1 voxel" or "3 voxels", for a message."""
    return f"{n} {thing if n == 1 else things or thing + 's'}"


def printable(text: object) -> str:
    """Escapes control characters in a text from the service, and characters that change the writing
    direction, so that a terminal that prints an error does not interpret them."""
    return "".join(letter if unicodedata.category(letter) not in _CONTROLS else
                   letter.encode("unicode_escape").decode() for letter in str(text))


_CONTROLS = ("Cc", "Cf", "Cs", "Zl", "Zp")


class MorphodError(Exception):
    """Base class of every error of this package."""


class BodyError(MorphodError, ValueError):
    """Something is not a body that the service can simulate; the text says what and where."""


class UnreachableError(MorphodError, ConnectionError):
    """The service did not reply in time, although the request was retried."""


class JobError(MorphodError):
    """A job failed, or was cancelled, while the caller waited for its result.

    `job` is the job as last reported by the service; `job["error"]` says why.
    """

    def __init__(self, message: str, job: Mapping[str, Any]) -> None:
        super().__init__(message)
        self.job = job


    def __reduce__(self) -> Any:
        return type(self), (str(self), self.job), self.__dict__


class WaitError(MorphodError, TimeoutError):
    """The time limit of a wait has passed; the job continues."""


class ApiError(MorphodError):
    """The service refused a request. The text lists every fault that the service found.

    `status` is the HTTP status, `problem` the problem detail (RFC 9457), `faults` its list of
    errors with `pointer`, `parameter` or `header`, and `request_id` the id to look for in the log.
    """

    def __init__(self, status: int, problem: Mapping[str, Any]) -> None:
        self.status = status
        self.problem = problem
        errors = problem.get("errors")
        self.faults: Sequence[Mapping[str, Any]] = [
            fault for fault in (errors if isinstance(errors, list) else ())
            if isinstance(fault, Mapping)]
        self.request_id: str | None = problem.get("request_id")
        text = printable(problem.get("detail") or problem.get("title") or f"HTTP status {status}")
        for fault in self.faults:
            place = fault.get("pointer") or fault.get("parameter") or fault.get("header")
            detail = printable(fault.get("detail"))
            line = f"{printable(place)}: {detail}" if place else detail
            if line not in text:
                text += f"\n  {line}"
        super().__init__(f"{status}: {text}")

    def __reduce__(self) -> Any:
        return type(self), (self.status, self.problem), self.__dict__


class InvalidError(ApiError):
    """The request is invalid (400, 413, 415 or 422)."""


class AccessError(ApiError):
    """No valid token, or one without the right for this request (401 or 403)."""


class NotFoundError(ApiError):
    """The requested item does not exist (404)."""


class ConflictError(ApiError):
    """The state of the item does not allow this (409)."""


class BusyError(ApiError):
    """The service was too busy, starting, or out of space during all retries (429, 503, 507)."""


_BY_STATUS: dict[int, type[ApiError]] = {
    400: InvalidError,
    401: AccessError,
    403: AccessError,
    404: NotFoundError,
    409: ConflictError,
    413: InvalidError,
    415: InvalidError,
    422: InvalidError,
    429: BusyError,
    503: BusyError,
    507: BusyError,
}


def api_error(status: int, problem: Mapping[str, Any]) -> ApiError:
    """Returns the exception for a refusal."""
    return _BY_STATUS.get(status, ApiError)(status, problem)


@contextlib.contextmanager
def reading() -> Iterator[None]:
    """Wraps code that reads a reply: an unexpected format raises a `MorphodError`."""
    try:
        yield
    except MorphodError:
        raise
    except (ArithmeticError, AttributeError, LookupError, RecursionError, TypeError,
            ValueError) as error:
        raise MorphodError(
            "this version of the package cannot read the reply "
            f"({type(error).__name__}: {printable(error)[:200]}): is this a morphod service?"
        ) from error
