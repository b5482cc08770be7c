# SPDX-License-Identifier: Apache-2.0
"""The page of a live fleet: how every twin is, and a button that opens the page of one."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Mapping
from typing import TypedDict

from aiohttp import web

from suspension_twin.addons.view.server import Site, check_origin
from suspension_twin.errors import InputError, SuspensionTwinError

__all__ = ["FleetServer", "TwinRow"]


class TwinRow(TypedDict, total=False):
    """One twin on the page: rate in Hz, its gap in words (empty: not known), a complaint, whether it is an error."""

    name: str
    rate: float
    gap: str
    text: str
    failing: bool


class FleetServer(Site):
    """Serves the list of twins.

    ``on_open(name)`` is called when the page of a twin is asked for, in a thread of the server; it returns the port of
    that page. ``tell`` hands over how the twins are.
    """

    page = "fleet.html"

    def __init__(
        self,
        names: list[str],
        on_open: Callable[[str], int],
        *,
        host: str = "127.0.0.1",
        port: int = 8080,
        token: str = "",
    ) -> None:
        self._rows: list[TwinRow] = [{"name": name} for name in names]
        self._names, self._on_open = frozenset(names), on_open
        self._opening = threading.Lock()
        super().__init__(host=host, port=port, token=token)

    def update(self, rows: Mapping[str, TwinRow]) -> None:
        """Values of each twin by its name."""
        self._rows = [{"name": row["name"], **rows.get(row["name"], {})} for row in self._rows]

    def _add_routes(self, app: web.Application) -> None:
        app.router.add_get("/twins", self._twins)
        app.router.add_post("/open", self._open)

    async def _twins(self, _request: web.Request) -> web.StreamResponse:
        return web.json_response(self._rows, headers={"Cache-Control": "no-store"})

    async def _open(self, request: web.Request) -> web.StreamResponse:
        check_origin(request)
        name = await request.text()
        try:
            port = await asyncio.to_thread(self._opened, name)
        except SuspensionTwinError as error:
            raise web.HTTPBadRequest(text=f"{error}\n") from None
        return web.json_response({"port": port, "token": self.token})

    def _opened(self, name: str) -> int:
        if name not in self._names:
            raise InputError("request", "asks for a twin that there is not")
        with self._opening:  # one at a time: two clicks open one page
            return self._on_open(name)
