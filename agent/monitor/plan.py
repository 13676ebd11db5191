"""The plan: a picture of the structure and where sensors are on it, kept in the database of the monitor."""

from __future__ import annotations

import hashlib
from typing import Any

import anyio
import msgspec
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from agent.config.files import read_file
from agent.delivery.keys import CHUNK
from agent.monitor.engines import DatabaseEngine
from agent.monitor.fleet import SENSORS_MAX
from agent.monitor.login import Access, body_of
from agent.monitor.pictures import PictureError, picture_of
from agent.monitor.rights import PLAN
from agent.monitor.settings import PICTURES, FloorPlan

LARGEST_PICTURE = 8_000_000  # bytes
LARGEST_CONFIGURED = 32 << 20
LARGEST_POSITION = 4096  # bytes of a request
_TABLES = (
    "CREATE TABLE IF NOT EXISTS plan_picture (id INTEGER PRIMARY KEY, media_type TEXT NOT NULL, sha256 TEXT NOT NULL,"
    " data {bytes} NOT NULL)",
    "CREATE TABLE IF NOT EXISTS plan_position (place TEXT PRIMARY KEY, x DOUBLE PRECISION NOT NULL,"
    " y DOUBLE PRECISION NOT NULL)",
)
_THE_ONE = 1  # id of the only picture


class Position(msgspec.Struct, forbid_unknown_fields=True):
    """Where a sensor (`<site>/<gateway>/<sensor>`) is: fractions of width and height; `at` None takes it off."""

    place: str
    at: tuple[float, float] | None


class Plans:
    """The plan that people made on the page; where there is none, that of the configuration.

    The engine has the tables of Database already. Raises sqlite3.Error or DatabaseError where it cannot be used.
    """

    def __init__(self, engine: DatabaseEngine, access: Access, configured: FloorPlan | None = None) -> None:
        self._engine, self._access, self._configured = engine, access, configured
        with engine.transaction() as run:
            engine.make_tables(run, [statement.format(bytes=engine.BYTES) for statement in _TABLES])

    def positions(self, _: Request) -> Response:
        """`picture`: its version, "" where there is none; `positions` by sensor, as fractions."""
        with self._engine.transaction() as run:
            versions = run("SELECT sha256 FROM plan_picture")
            positions = {place: (x, y) for place, x, y in run("SELECT place, x, y FROM plan_position ORDER BY place")}
        version = versions[0][0] if versions else "configured" if self._configured is not None else ""
        stated = {} if self._configured is None else dict(self._configured.positions)
        return JSONResponse({"picture": version, "positions": positions if versions else stated | positions})

    def picture(self, _: Request) -> Response:
        """The bytes of the picture, with the type that its content has."""
        with self._engine.transaction() as run:
            rows = run("SELECT media_type, data FROM plan_picture")
        if rows:
            return Response(bytes(rows[0][1]), 200, None, rows[0][0])
        if self._configured is None:
            return Response("there is no plan; put a picture on the page", 404)
        try:
            data = read_file(self._configured.picture, LARGEST_CONFIGURED)
        except OSError as error:
            return Response(f"the picture cannot be read: {error.strerror}", 404)
        return Response(data, 200, None, PICTURES[self._configured.picture.suffix.lower()])

    async def put_picture(self, request: Request) -> Response:
        """POST of a picture in the place of the one before. Positions stay: they are fractions."""
        self._access.commanding(request, PLAN)
        stated = request.headers.get("content-length", "")
        if stated.isdecimal() and int(stated[:12]) > LARGEST_PICTURE:
            raise HTTPException(413, f"a picture has at most {LARGEST_PICTURE // 10**6} MB; make it smaller")
        data = await body_of(request, LARGEST_PICTURE)
        try:
            found = picture_of(data)
        except PictureError as error:
            raise HTTPException(400, str(error)) from None
        await anyio.to_thread.run_sync(self.keep, found.media_type, data)
        return Response(status_code=204)

    async def put_position(self, request: Request) -> Response:
        """POST of one Position as JSON, so that two people at two sensors do not undo what the other one does."""
        self._access.commanding(request, PLAN)
        try:
            asked = msgspec.json.decode(await body_of(request, LARGEST_POSITION), type=Position)
        except (msgspec.DecodeError, ValueError, RecursionError):
            raise HTTPException(400, "not a position") from None
        names = asked.place.split("/")
        inside = asked.at is None or all(0.0 <= part <= 1.0 for part in asked.at)
        if len(names) != 3 or not all(map(CHUNK.fullmatch, names)) or not inside:
            raise HTTPException(400, "not a position of a sensor: two numbers from 0 to 1")
        await anyio.to_thread.run_sync(self.place, asked)
        return Response(status_code=204)

    def keep(self, media_type: str, data: bytes) -> None:
        """Keep a picture in the place of the one before."""
        kept: dict[str, Any] = {"media_type": media_type, "sha256": hashlib.sha256(data).hexdigest(), "data": data}
        with self._engine.transaction() as run:
            run(
                "INSERT INTO plan_picture (id, media_type, sha256, data) VALUES (:id, :media_type, :sha256, :data)"
                " ON CONFLICT (id) DO UPDATE SET media_type = excluded.media_type, sha256 = excluded.sha256,"
                " data = excluded.data",
                id=_THE_ONE, **kept,
            )  # fmt: skip

    def place(self, asked: Position) -> None:
        """Put a sensor on the plan, or take it off. Raises HTTPException where there are SENSORS_MAX."""
        with self._engine.transaction() as run:
            if asked.at is None:
                run("DELETE FROM plan_position WHERE place = :place", place=asked.place)
                return
            ((count,),) = run("SELECT count(*) FROM plan_position")
            if count >= SENSORS_MAX:
                raise HTTPException(409, f"{SENSORS_MAX} sensors are on the plan; take one off first")
            run(
                "INSERT INTO plan_position (place, x, y) VALUES (:place, :x, :y) ON CONFLICT (place)"
                " DO UPDATE SET x = excluded.x, y = excluded.y",
                place=asked.place, x=asked.at[0], y=asked.at[1],
            )  # fmt: skip
