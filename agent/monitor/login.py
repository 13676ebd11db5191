"""Login to the fleet page: sessions in memory, limits against guessing, and the token of each session."""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import logging
import math
import secrets
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path

import anyio
import msgspec
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from agent.delivery.seldom import Seldom
from agent.monitor.users import LONGEST_PASSWORD, User, Users, UsersError, password_is

SESSION_S = 12 * 3600.0  # s that a login lasts: a working day
SESSIONS_MAX = 1000  # the oldest ends when there are more
LARGEST_LOGIN = 4096  # bytes of a request
# Wrong passwords that cost no delay: of one user from one address, and of one address under any names. Each further one
# doubles the delay, from 1 s on. A user at another address does not wait, so that nobody can lock a user out.
FREE_OF_USER, FREE_OF_ADDRESS = 3, 10
LONGEST_DELAY_S = 30.0  # 2,900 attempts a day from one address
FORGOTTEN_S = 900.0  # s after the last wrong password, from which the next one counts as the first
NAMES_MAX = 10_000  # users and addresses whose wrong passwords are remembered; the newest stay
AT_ONCE = 2  # passwords that are checked at the same time, each in 64 MiB
WAITING_MAX = 8
TOKEN = "x-csrf-token"
LOG_S = 60.0  # s between two lines of the log about logins that must wait
_log = logging.getLogger(__name__)


class _Login(msgspec.Struct, forbid_unknown_fields=True):
    name: str
    password: str


@dataclass(frozen=True, slots=True)
class LoginSession:
    """A user who has logged in. `hashed`: the password then. `token`: every request that changes something has it."""

    user: str
    hashed: str
    token: str
    ends_s: float


@dataclass(frozen=True, slots=True)
class _Failed:
    """Wrong attempts under a name. `at_s`: of the last one; `next_s`: when the next one may be made (monotonic, s)."""

    count: int
    at_s: float
    next_s: float


class Delays:
    """How long an attempt under each of many names must wait after wrong ones. The caller gives the time, in s.

    `free`: wrong attempts without delay. An attempt that must wait changes nothing, so it does not make others wait.
    """

    def __init__(self, free: int) -> None:
        self._free = free
        self._failed: dict[str, _Failed] = {}  # the newest last

    def wait_s(self, name: str, now_s: float) -> float:
        """Time in s until the next attempt under this name may be made; 0 if it may be now."""
        failed = self._failed.get(name)
        return max(0.0, failed.next_s - now_s) if failed is not None else 0.0

    def begin(self, name: str, now_s: float) -> None:
        """An attempt is made. It counts as wrong until `right`, so that many at the same time count too."""
        before = self._failed.pop(name, None)
        count = 1 + (before.count if before is not None and now_s - before.at_s < FORGOTTEN_S else 0)
        doubled = min(count - self._free, 10)  # so that no number of attempts gives a large power
        delay_s = min(2.0**doubled, LONGEST_DELAY_S) if count >= self._free else 0.0
        self._failed[name] = _Failed(count, now_s, now_s + delay_s)
        if len(self._failed) > NAMES_MAX:
            del self._failed[next(iter(self._failed))]

    def right(self, name: str, *, forget: bool) -> None:
        """The attempt was right: it is no wrong one; with `forget` those before it do not count any more either."""
        failed = self._failed.pop(name, None)
        if failed is not None and not forget and failed.count > 1:
            self._failed[name] = _Failed(failed.count - 1, failed.at_s, failed.at_s)


class Access:
    """Who may read and command. Without a file of users everybody may read, and nobody may command."""

    def __init__(self, users: Path | None) -> None:
        self._users = Users(users) if users is not None else None
        self._sessions: dict[bytes, LoginSession] = {}  # by the SHA-256 of the cookie
        self._of_user, self._of_address = Delays(FREE_OF_USER), Delays(FREE_OF_ADDRESS)
        self._told = Seldom(_log, LOG_S)
        self._checking = anyio.CapacityLimiter(AT_ONCE)

    def reading(self, answer: Callable[[Request], Response]) -> Callable[[Request], Response]:
        """The endpoint `answer`, for those who may read."""

        def checked(request: Request) -> Response:
            if self._users is not None:
                self.user(request)
            return answer(request)

        return checked

    def reading_async(
        self, answer: Callable[[Request], Awaitable[Response]]
    ) -> Callable[[Request], Awaitable[Response]]:
        """The same for a coroutine."""

        async def checked(request: Request) -> Response:
            if self._users is not None:
                self.user(request)
            return await answer(request)

        return checked

    def user(self, request: Request) -> tuple[User, LoginSession]:
        """The user who asks, with the rights that the file states now. Raises HTTPException 401 where there is none."""
        key = hashlib.sha256(request.cookies.get(_cookie(request), "").encode()).digest()
        session = self._sessions.get(key)
        user = self._now().get(session.user) if session is not None else None
        if session is None or user is None or user.hashed != session.hashed or time.monotonic() > session.ends_s:
            self._sessions.pop(key, None)
            raise HTTPException(401, "log in first")
        return user, session

    def commanding(self, request: Request, verb: str) -> User:
        """The user who sends a command. Raises HTTPException 401 without login, 403 without right or token."""
        user, session = self.user(request)
        if not hmac.compare_digest(request.headers.get(TOKEN, "").encode(), session.token.encode()):
            raise HTTPException(403, "the request has not the token of this session; load the page again")
        if verb not in user.verbs:
            raise HTTPException(403, f"{user.name} has not the right {verb!r:.20}")
        return user

    def me(self, request: Request) -> Response:
        """Whether a login is needed, and who is logged in."""
        told: dict[str, object] = {"needs_login": self._users is not None, "user": "", "verbs": [], "token": ""}
        try:
            user, session = self.user(request)
            told |= {"user": user.name, "verbs": user.verbs, "token": session.token}
        except HTTPException:
            pass
        return JSONResponse(told)

    async def log_in(self, request: Request) -> Response:
        """Begin a session: 401 for a wrong name or password, 429 where the next attempt must wait."""
        try:
            asked = msgspec.json.decode(await body_of(request, LARGEST_LOGIN), type=_Login)
        except (msgspec.DecodeError, ValueError, RecursionError):
            raise HTTPException(400, "not a login") from None
        user = self._now().get(asked.name)
        address, now_s = _network(request), time.monotonic()
        name = f"{asked.name[:LONGEST_PASSWORD]} {address}"
        wait_s = max(self._of_user.wait_s(name, now_s), self._of_address.wait_s(address, now_s))
        if wait_s > 0:
            self._told.warning("a login from %s must wait after wrong passwords", address)
            wait = str(math.ceil(wait_s))
            raise HTTPException(429, f"wait {wait} s after so many wrong passwords", {"Retry-After": wait})
        if self._checking.statistics().tasks_waiting > WAITING_MAX:
            raise HTTPException(503, "too many logins at the same time; try again")
        self._of_user.begin(name, now_s)
        self._of_address.begin(address, now_s)
        right = len(asked.password) <= LONGEST_PASSWORD and await anyio.to_thread.run_sync(
            password_is, user, asked.password, limiter=self._checking
        )
        if not right or user is None:
            _log.warning("a wrong password or user name, from %s", address)
            raise HTTPException(401, "the name or the password is wrong")
        self._of_user.right(name, forget=True)
        self._of_address.right(address, forget=False)  # of a guesser who is a user too
        return self._begin(request, user)

    def log_out(self, request: Request) -> Response:
        """End the session of this browser."""
        cookie = request.cookies.get(_cookie(request), "")
        self._sessions.pop(hashlib.sha256(cookie.encode()).digest(), None)
        answer = Response(status_code=204)
        answer.delete_cookie(_cookie(request), secure=_secure(request), httponly=True, samesite="strict")
        return answer

    def _begin(self, request: Request, user: User) -> Response:
        cookie, token = secrets.token_urlsafe(32), secrets.token_urlsafe(32)
        session = LoginSession(user.name, user.hashed, token, time.monotonic() + SESSION_S)
        self._sessions[hashlib.sha256(cookie.encode()).digest()] = session
        if len(self._sessions) > SESSIONS_MAX:
            del self._sessions[next(iter(self._sessions))]
        answer = Response(status_code=204)
        answer.set_cookie(_cookie(request), cookie, secure=_secure(request), httponly=True, samesite="strict")
        return answer

    def _now(self) -> dict[str, User]:
        if self._users is None:
            return {}
        try:
            return self._users.now()
        except UsersError as error:
            _log.warning("nobody is logged in while the file of users is bad: %s", error)
            return {}


async def body_of(request: Request, most: int) -> bytes:
    """The body of a request. Raises HTTPException 413 where it has more than `most` bytes."""
    body = b""
    async for part in request.stream():
        body += part
        if len(body) > most:
            raise HTTPException(413, f"more than {most} bytes")
    return body


def _secure(request: Request) -> bool:
    return bool(request.scope["scheme"] == "https")


def _cookie(request: Request) -> str:
    """The name of the cookie; with `__Host-` a browser takes it from this very host alone, and over HTTPS alone."""
    return "__Host-fieldcal" if _secure(request) else "fieldcal"


def _network(request: Request) -> str:
    """The sender's IPv4 address, or the /64 network of its IPv6 address, in which one sender has all addresses."""
    try:
        address = ipaddress.ip_address(request.client.host if request.client else "")
    except ValueError:
        return ""
    return str(ipaddress.ip_network((address, 64), strict=False) if address.version == 6 else address)
