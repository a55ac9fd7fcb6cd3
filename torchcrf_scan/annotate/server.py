"""The server of the page: bokeh's, on this machine alone, for requests that name it and come from its own pages."""

from __future__ import annotations

import asyncio
from typing import Any

from bokeh.application import Application
from bokeh.application.handlers import FunctionHandler
from bokeh.document import Document as BokehDocument
from bokeh.server.server import BaseServer
from bokeh.server.tornado import BokehTornado
from bokeh.server.util import bind_sockets
from tornado.httpserver import HTTPServer
from tornado.httputil import HTTPServerRequest
from tornado.ioloop import IOLoop
from tornado.routing import Matcher, Rule, RuleRouter

from torchcrf_scan.annotate.desk import Desk
from torchcrf_scan.annotate.page import Page

ADDRESS = "127.0.0.1"


class OwnRequests(Matcher):
    """Requests whose Host is one of some names, with an Origin that is one of them or none; others get status 404."""

    def __init__(self, names: list[str]) -> None:
        self._hosts, self._origins = set(names), {f"http://{name}" for name in names}

    def match(self, request: HTTPServerRequest) -> dict[str, Any] | None:
        """Whether the request is answered: no arguments for the handler, or None."""
        origins = request.headers.get_list("Origin")
        return {} if request.host in self._hosts and self._origins.issuperset(origins) else None


def make_server(desk: Desk, port: int = 0) -> tuple[BaseServer, int]:
    """The server of a desk, not yet started, and its port. port: 0: any that is free.

    Raises:
        OSError: the port is taken.
    """
    pages: list[Page] = []

    def changed(by: Page) -> None:
        for page in pages:
            if page is not by:
                page.doc.add_next_tick_callback(page.draw)

    def open_page(doc: BokehDocument) -> None:
        page = Page(doc, desk, changed)
        pages.append(page)
        doc.on_session_destroyed(lambda _: pages.remove(page))

    asyncio.set_event_loop(asyncio.new_event_loop())  # there is none unless one is set, from Python 3.14 on
    loop = IOLoop.current()
    sockets, port = bind_sockets(ADDRESS, port)
    names = [f"{ADDRESS}:{port}", f"localhost:{port}"]
    application = BokehTornado(Application(FunctionHandler(open_page)), extra_websocket_origins=names)
    http = HTTPServer(RuleRouter([Rule(OwnRequests(names), application)]))
    http.add_sockets(sockets)
    return BaseServer(loop, application, http), port


def serve(server: BaseServer) -> None:
    """Answers until the process is interrupted."""
    server.start()
    try:
        server.io_loop.start()
    finally:
        server.stop()
