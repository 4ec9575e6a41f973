"""The addresses of the page's interface, each with the method of :class:`survey.workbench.session.Workbench` it is."""

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import TYPE_CHECKING

from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from survey.folder.locking import BusyError
from survey.folder.text import suggestion
from survey.report.language import message
from survey.workbench.bodies import (
    DECISIONS,
    JOBS,
    VIEWS,
    Asked,
    Body,
    BodyError,
    distance_of,
    json_of,
    run_of,
    size_of,
    whole_of,
)
from survey.workbench.guard import LONGEST_BODY, TooLongError
from survey.workbench.work import Work

if TYPE_CHECKING:
    from survey.detection import ImageReport

_MOST_ROWS = 200_000  # of image points at once, where not all are asked for
_NEW_PROJECT = ("init", "show")  # jobs after which the page shows another project
_Handler = Callable[[Work, Request], Awaitable[Response]]


@frozen
class Way:
    """An address of the interface. calls: what of ``survey.Workbench`` it is; changes: whether files may change.

    signs_in: whether its answer brings the cookie that images and the socket are asked with.
    """

    method: str
    path: str
    calls: tuple[str, ...]
    handler: _Handler
    changes: bool = False
    signs_in: bool = False


async def answered(work: Work, way: Way, request: Request) -> Response:
    """The answer at an address; what its owner can mend is one of one line."""
    if way.changes and work.shown.read_only:
        return JSONResponse({"error": message("the project is open for reading only")}, 403)
    try:
        return await way.handler(work, request)
    except SurveyError as error:
        from survey.workbench.situation import CancelledError, ChangedError

        kind = {"cancelled": True} if isinstance(error, CancelledError) else {}
        kind |= {"retry": True} if isinstance(error, ChangedError | BusyError) else {}
        return JSONResponse({"error": message(str(error)), "version": work.shown.version, **kind}, 409)
    except OSError as error:
        return JSONResponse({"error": f"{error.filename}: {error.strerror}"}, 409)
    except (BodyError, ClientDisconnect) as error:
        return JSONResponse({"error": message(f"not understood: {error}")}, 400)
    except TooLongError:
        return JSONResponse({"error": f"more than {LONGEST_BODY} bytes"}, 413)


# reading


async def _state(work: Work, _: Request) -> Response:
    work.asked.set()
    found = await asyncio.to_thread(work.shown.state)
    return JSONResponse(found | {"running": work.running})


def _view(view: Asked) -> _Handler:
    async def answering(work: Work, request: Request) -> Response:
        return JSONResponse(await work.run(view.what, lambda: view.run(work.bench, request)))

    return answering


async def _points(work: Work, request: Request) -> Response:
    camera, _, epoch = request.query_params.get("image", "").partition("/")
    known, most = whole_of(request, "layout"), min(whole_of(request, "worst") or 0, _MOST_ROWS)
    data = await work.run("view", lambda: work.bench.points(camera, epoch, most, known))
    return Response(data, media_type="application/octet-stream")


async def _statistics(work: Work, request: Request) -> Response:
    from survey.solution.records import solution_json

    found = await work.run("statistics", lambda: work.bench.statistics_part(request.path_params["part"]))
    return Response(solution_json(found), media_type="application/json")


async def _halves(work: Work, request: Request) -> Response:
    from survey.folder.plain import plain

    distance, bench = distance_of(request), work.bench
    found = await asyncio.to_thread(bench.cross_validate, distance)  # of values that nobody changes: others go on
    told = {"version": bench.version, "cameras": [c.summary() | c.pixels() for c in found.cameras],
            "notes": [message(note) for note in found.notes]}  # fmt: skip
    return JSONResponse(plain(found.summary() | told))


async def _image(work: Work, request: Request) -> Response:
    from survey.workbench import pictures

    key, size = (request.path_params["camera"], request.path_params["epoch"]), size_of(request)
    project = work.bench.situation.everything
    if key not in project.images:
        return JSONResponse({"error": message("no such image")}, 404)
    tag = pictures.etag(project.detected.get(key), project.images[key], size)
    kept = {"ETag": tag, "Cache-Control": "private, no-cache"}
    if request.headers.get("if-none-match") == tag:
        return Response(status_code=304, headers=kept)
    data, kind = await asyncio.to_thread(work.bench.picture, *key, size)
    return Response(data, media_type=kind, headers=kept)


async def _capture(work: Work, _: Request) -> Response:
    return JSONResponse(await asyncio.to_thread(work.shown.capture_status))


async def _captured(work: Work, request: Request) -> Response:
    camera, size = request.path_params["camera"], size_of(request)
    data, kind = await asyncio.to_thread(work.shown.capture_picture, camera, size)
    return Response(data, media_type=kind)


# acting


async def _preview(work: Work, request: Request) -> Response:
    excluded, included = Body(await json_of(request)).changes()
    names, out = (excluded, True) if excluded else (included, False)
    return JSONResponse(await work.run("view", lambda: work.bench.preview(*names, excluded=out)))


async def _cancel(work: Work, _: Request) -> Response:
    work.bench.cancel()
    return JSONResponse({})


def _decision(decision: Asked) -> _Handler:
    async def answering(work: Work, request: Request) -> Response:
        body = Body(await json_of(request))
        await work.run("adjust", lambda: decision.run(work.bench, body, request))
        state = await asyncio.to_thread(work.bench.state)
        return JSONResponse(state | VIEWS["changes"].run(work.bench, request))

    return answering


async def _pin(work: Work, request: Request) -> Response:
    number, pinned = run_of(request), Body(await json_of(request)).flag("pinned")
    run = await work.run("pin", lambda: work.bench.pin(number, pinned))
    return JSONResponse(run.as_dict())


async def _save(work: Work, _: Request) -> Response:
    said = (await work.run("save", work.bench.save)).summary()
    from survey.workbench.views.project import in_words

    told = {"summary": in_words(said["summary"]), "warnings": [*map(message, said["warnings"])]}
    return JSONResponse(said | told)


def _job(name: str) -> _Handler:
    """A job: what it said, and the state after it."""

    async def answering(work: Work, request: Request) -> Response:
        from survey.workbench.pictures import found_in

        body = Body(await json_of(request))
        bench = work.shown if name in _NEW_PROJECT else work.bench

        def found(report: "ImageReport") -> None:
            work.live.post({"type": "detected"} | found_in(report))

        told = await work.run(name, lambda: JOBS[name].run(bench, body, found))
        if name in _NEW_PROJECT:
            await work.run("adjust", lambda: work.show(Path(told.summary["folder"])))
        return JSONResponse(told.as_dict() | {"state": await asyncio.to_thread(work.bench.state)})

    return answering


async def _no_job(_: Work, request: Request) -> Response:
    name = request.path_params["name"]
    raise SurveyError(f"there is no job {name!r}; {suggestion(name, JOBS)}")


WAYS: tuple[Way, ...] = (
    Way("GET", "/api/state", ("state",), _state, signs_in=True),
    Way("GET", "/api/points", ("points",), _points),
    Way("GET", "/api/image/{camera}/{epoch}", ("picture",), _image),
    *(Way("GET", f"/api/{path}", view.calls, _view(view)) for path, view in VIEWS.items()),
    Way("GET", "/api/capture", ("capture_status",), _capture),
    Way("GET", "/api/capture/{camera}", ("capture_picture",), _captured),
    Way("GET", "/api/halves", ("cross_validate",), _halves),
    Way("GET", "/api/statistics/{part}", ("statistics_part",), _statistics),
    Way("POST", "/api/preview", ("preview",), _preview),
    Way("POST", "/api/cancel", ("cancel",), _cancel),
    *(Way("POST", f"/api/{path}", decision.calls, _decision(decision), decision.changes)
      for path, decision in DECISIONS.items()),
    Way("POST", "/api/save", ("save",), _save, True),
    Way("POST", "/api/runs/{number}/pin", ("pin",), _pin, True),
    *(Way("POST", f"/api/jobs/{name}", job.calls, _job(name), job.changes) for name, job in JOBS.items()),
    Way("POST", "/api/jobs/{name}", (), _no_job),
)  # fmt: skip
"""All addresses of the interface."""
