"""Login to the fleet page: sessions in memory, limits against guessing, and the token of each session."""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import logging
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

from agent.commanding.allowance import Allowance
from agent.monitor.users import LONGEST_PASSWORD, User, Users, UsersError, password_is

SESSION_S = 12 * 3600.0  # s that a login lasts: a working day
SESSIONS_MAX = 1000  # the oldest ends when there are more
LARGEST_LOGIN = 4096  # bytes of a request
# Attempts to log in: some at once, then one in so many seconds. A user's password can be guessed 2,900 times a day.
OF_ADDRESS = (10, 1 / 10)
OF_USER = (10, 1 / 30)
ADDRESSES_MAX = 10_000
AT_ONCE = 2  # passwords that are checked at the same time, each in 64 MiB
WAITING_MAX = 8
TOKEN = "x-csrf-token"
_log = logging.getLogger(__name__)


class _Login(msgspec.Struct, forbid_unknown_fields=True):
    name: str
    password: str


@dataclass(frozen=True, slots=True)
class Session:
    """A user who has logged in. `hashed`: the password then. `token`: every request that changes something has it."""

    user: str
    hashed: str
    token: str
    ends_s: float


class Allowances:
    """A rate limit for each of many names; the limits of at most `most` names are kept."""

    def __init__(self, burst: int, rate_hz: float, most: int) -> None:
        self._limit, self._most = (burst, rate_hz), most
        self._by_name: dict[str, Allowance] = {}

    def passes(self, name: str, now_s: float) -> bool:
        """Whether one more attempt under this name may pass; it is counted then."""
        allowance = self._by_name.pop(name, None) or Allowance(*self._limit)
        self._by_name[name] = allowance  # the newest last
        if len(self._by_name) > self._most:
            del self._by_name[next(iter(self._by_name))]
        return allowance.passes(now_s)


class Access:
    """Who may read and command. Without a file of users everybody may read, and nobody may command."""

    def __init__(self, users: Path | None) -> None:
        self._users = Users(users) if users is not None else None
        self._sessions: dict[bytes, Session] = {}  # by the SHA-256 of the cookie
        self._of_address = Allowances(*OF_ADDRESS, ADDRESSES_MAX)
        self._of_user = Allowances(*OF_USER, ADDRESSES_MAX)
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

    def user(self, request: Request) -> tuple[User, Session]:
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
            raise HTTPException(403, f"{user.name} has no right to send {verb!r:.20}")
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
        """Begin a session: 401 for a wrong name or password, 429 for too many attempts."""
        try:
            asked = msgspec.json.decode(await body_of(request, LARGEST_LOGIN), type=_Login)
        except (msgspec.DecodeError, ValueError, RecursionError):
            raise HTTPException(400, "not a login") from None
        user = self._now().get(asked.name)
        now_s = time.monotonic()
        passes = self._of_address.passes(_network(request), now_s)
        if not passes or not self._of_user.passes(asked.name[:LONGEST_PASSWORD], now_s):
            _log.warning("too many attempts to log in, from %s", _network(request))
            raise HTTPException(429, "too many attempts to log in; wait a minute", {"Retry-After": "60"})
        if self._checking.statistics().tasks_waiting > WAITING_MAX:
            raise HTTPException(503, "too many logins at the same time; try again")
        right = len(asked.password) <= LONGEST_PASSWORD and await anyio.to_thread.run_sync(
            password_is, user, asked.password, limiter=self._checking
        )
        if not right or user is None:
            _log.warning("a wrong password or user name, from %s", _network(request))
            raise HTTPException(401, "the name or the password is wrong")
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
        session = Session(user.name, user.hashed, token, time.monotonic() + SESSION_S)
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
