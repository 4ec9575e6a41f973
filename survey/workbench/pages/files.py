"""The page's own files: what lies in ``web``, beside the modules that the reports have too."""

from collections.abc import Sequence
from pathlib import Path

from starlette.requests import Request
from starlette.responses import JSONResponse, Response

_KINDS = {".html": "text/html", ".css": "text/css", ".js": "text/javascript", ".json": "application/json",
          ".svg": "image/svg+xml", ".png": "image/png", ".woff2": "font/woff2"}  # fmt: skip


class Files:
    """All that lies in some folders, by its address. The first page is their ``index.html``."""

    def __init__(self, folders: Sequence[Path]) -> None:
        self._paths = {f"/{p.relative_to(at).as_posix()}": p for at in folders for p in at.rglob("*")
                       if p.suffix in _KINDS}  # fmt: skip

    async def serve(self, request: Request) -> Response:
        """What is asked for."""
        path = self._paths.get("/index.html" if request.url.path == "/" else request.url.path)
        if path is None:
            return JSONResponse({"error": "no such page"}, 404)
        data = self._page(path) if path.suffix == ".html" else path.read_bytes()
        return Response(data, media_type=_KINDS[path.suffix])

    def _page(self, path: Path) -> bytes:
        """A page names all modules: they come at once and not one after the other has named it."""
        modules = sorted(name[1:] for name in self._paths if name.endswith(".js") and name != "/report.js")
        named = (f'<link rel="modulepreload" href="{name}">\n' for name in modules)
        return path.read_text(encoding="utf-8").replace("</head>", "".join(named) + "</head>").encode()
