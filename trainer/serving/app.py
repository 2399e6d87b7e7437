"""The HTTP interface and its description."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Annotated, Any, Literal

from fastapi import FastAPI, Query, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import HTMLResponse, JSONResponse, Response
from prometheus_client import CONTENT_TYPE_LATEST
from pydantic import BaseModel, Field

from data.buffers import BUFFERS
from trainer.export.description import DISTRIBUTION, installed_version
from trainer.serving.answers import Counting, Problem, described
from trainer.serving.limits import Refusal
from trainer.serving.service import Service
from trainer.serving.upload import FIELD, FORM
from trainer.serving.work import EXR, ZIP, Wish

MAPPING = r"^[^:,]{0,100}:[a-z_]{1,40}(,[^:,]{0,100}:[a-z_]{1,40}){0,31}$"
"""`LAYER:BUFFER,…`"""

_BINARY = {"type": "string", "format": "binary"}


class Health(BaseModel):
    """Whether the server takes requests."""

    status: Literal["ok", "ending", "failed"]
    model: str


class Problem_(BaseModel):  # noqa: N801  # `Problem` is the answer that carries it
    """What is wrong, what was expected and what to do."""

    model_config = {"title": "Problem"}
    detail: str


def create_app(service: Service) -> FastAPI:
    """Return the application of a service, which it closes at its end."""

    @asynccontextmanager
    async def life(app: FastAPI) -> AsyncIterator[None]:
        yield
        service.close()

    app = FastAPI(
        title="Penumbra",
        summary="Denoises frames of a path tracer.",
        version=installed_version(DISTRIBUTION),
        lifespan=life,
        redoc_url=None,
    )
    app.add_middleware(Counting, metrics=service.metrics, crowded=lambda: service.crowded())
    app.add_exception_handler(RequestValidationError, _invalid)
    app.add_exception_handler(Refusal, _refused)
    _add_pages(app, service)
    _add_denoise(app, service)
    described_by_default = app.openapi

    def openapi() -> dict[str, Any]:
        return _completed(described_by_default(), service)

    app.openapi = openapi  # type: ignore[method-assign]  # FastAPI's own way of changing it
    return app


def _add_pages(app: FastAPI, service: Service) -> None:
    @app.get("/", response_class=HTMLResponse, summary="How to use it")
    async def landing() -> str:
        return _landing(service)

    @app.get("/health", summary="Whether the server takes requests", responses=_not_ok(503, Health))
    async def health() -> Response:
        status = "ending" if service.draining else "ok" if service.batcher.alive else "failed"
        content = {"status": status, "model": service.loaded.source.reference}
        return JSONResponse(content, 200 if status == "ok" else 503)

    @app.get(
        "/metrics",
        summary="Figures for Prometheus",
        responses={
            200: {"content": {"text/plain": {"schema": {"type": "string"}}}},
            **_unauthorized(service),
        },
        response_class=Response,
    )
    async def metrics(request: Request) -> Response:
        service.authorize(request)
        return Response(service.metrics.text(), media_type=CONTENT_TYPE_LATEST)


def _add_denoise(app: FastAPI, service: Service) -> None:
    @app.post(
        "/denoise",
        summary="Denoise a frame, or a sequence",
        description=_description(service),
        response_class=Response,
        responses=_answers(service),
        openapi_extra={"requestBody": _body()},
    )
    async def denoise(
        request: Request,
        exposure: Annotated[
            Annotated[float, Field(gt=0, le=1e12, allow_inf_nan=False)] | Literal["auto"] | None,
            Query(
                description="Factor that brings radiance to a displayable level; `auto`: measured; by "
                "default the frame's own, measured where it has none."
            ),
        ] = None,
        channels: Annotated[
            str | None,
            Query(
                pattern=MAPPING,
                max_length=1000,
                description="What layers of the file are, where their names do not say it: `LAYER:BUFFER,…`, "
                "such as `Beauty:color,N:normal`; no layer stands for plain R, G, B.",
            ),
        ] = None,
        precision: Annotated[
            Literal["auto", "float"],
            Query(description="`auto`: half precision where it holds the result's range; `float`: single."),
        ] = "auto",
    ) -> Response:
        service.authorize(request)
        return await service.answer(request, Wish(exposure, _layers(channels), precision == "float"))


def _layers(text: str | None) -> dict[str, str]:
    """Return layer → buffer."""
    layers: dict[str, str] = {}
    for entry in text.split(",") if text else ():
        layer, _, name = entry.rpartition(":")
        if name not in BUFFERS:
            raise Refusal(422, f"channels: {name!r} is no buffer; expected {', '.join(list(BUFFERS)[:12])} …")
        if layer in layers or name in layers.values():
            raise Refusal(422, f"channels: {entry!r} names a layer or a buffer for the second time")
        layers[layer] = name
    return layers


async def _invalid(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    first = error.errors()[0]
    place = next((str(part) for part in first["loc"][1:2]), "request")
    return Problem(Refusal(422, f"{place}: {first['msg']}"))


async def _refused(request: Request, error: Exception) -> Response:
    assert isinstance(error, Refusal)
    return Problem(error)


def _not_ok(status: int, model: type[BaseModel]) -> dict[int | str, dict[str, Any]]:
    return {
        200: {"model": model},
        status: {"model": model, "description": "The server is ending, or its model's thread has failed."},
    }


def _unauthorized(service: Service) -> dict[int | str, dict[str, Any]]:
    if service.token is None:
        return {}
    return described(401, "The token is missing or wrong.", {"WWW-Authenticate": "`Bearer`."})


def _answers(service: Service) -> dict[int | str, dict[str, Any]]:
    limits = service.limits
    headers = {
        "X-Penumbra-Exposure": {"description": "That of the first frame.", "schema": {"type": "number"}},
        "X-Penumbra-Notes": {
            "description": "What `trainer denoise` would remark.", "schema": {"type": "string"}
        },
    }  # fmt: skip
    found = {
        "description": "The denoised frame in channels color.R, color.G, color.B; a ZIP of them for a ZIP.",
        "content": {kind: {"schema": _BINARY} for kind in (EXR, ZIP)},
        "headers": headers,
    }
    retry = {"Retry-After": "Seconds."}
    return {
        200: found,
        **described(400, "The request or its form is malformed."),
        **_unauthorized(service),
        **described(
            408, f"The body came too slowly: {limits.read:g} s, or {limits.idle:g} s without a byte."
        ),
        **described(
            413,
            f"The body has more than {limits.upload / 1e6:g} MB, or takes more than {limits.disk / 1e6:g} MB "
            "with what it unpacks to and its results.",
        ),
        **described(415, "The media type is none of those listed, or the body is compressed."),
        **described(422, "The file cannot be denoised, or an option is wrong; the text says why."),
        **described(500, "The server failed; its log says why."),
        **described(
            503,
            "Too many requests wait, their files take all room, or the server is ending or has failed.",
            retry,
        ),
        **described(504, f"The result took longer than {limits.compute:g} s."),
    }


def _body() -> dict[str, Any]:
    form = {"type": "object", "required": [FIELD], "properties": {FIELD: _BINARY}}
    return {
        "required": True,
        "content": {EXR: {"schema": _BINARY}, ZIP: {"schema": _BINARY}, FORM: {"schema": form}},
    }


def _completed(schema: dict[str, Any], service: Service) -> dict[str, Any]:
    """Add the form of errors, and the token where there is one, to FastAPI's description."""
    components = schema.setdefault("components", {})
    schemas = components.setdefault("schemas", {})
    schemas["Problem"] = Problem_.model_json_schema()
    for name in ("HTTPValidationError", "ValidationError"):
        schemas.pop(name, None)
    if service.token is not None:
        components["securitySchemes"] = {"token": {"type": "http", "scheme": "bearer"}}
        for path, method in (("/denoise", "post"), ("/metrics", "get")):
            schema["paths"][path][method]["security"] = [{"token": []}]
    return schema


def _description(service: Service) -> str:
    limits = service.limits
    model = service.loaded.model
    return (
        f"Takes an EXR file with the buffers {', '.join(model.inputs)}, or what they are derived from, "
        f"up to {limits.megapixels:g} megapixels; or a ZIP file with the EXR files of a sequence, up to "
        f"{limits.frames}. The picture is that of `trainer denoise`."
    )


def _landing(service: Service) -> str:
    import html

    token = ' -H "Authorization: Bearer $TOKEN"' if service.token else ""
    return (
        "<!doctype html><meta charset=utf-8><title>Penumbra</title>"
        f"<h1>Penumbra</h1><p>Denoises with {html.escape(service.loaded.source.reference)}. Try:</p>"
        f'<pre>curl --fail-with-body{token} -H "Content-Type: image/x-exr" --data-binary @frame.exr '
        "-o denoised.exr http://THIS_HOST/denoise</pre>"
        '<p><a href="docs">docs</a> · <a href="health">health</a> · <a href="metrics">metrics</a></p>'
    )
