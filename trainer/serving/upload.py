"""A request's body → a file, counted while it comes in: nothing is believed about its length."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from email.message import Message
from typing import BinaryIO, NamedTuple

from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser
from starlette.requests import Request

from trainer.serving.archive import plain_name
from trainer.serving.limits import Limits, Refusal
from trainer.serving.room import Place

RAW = (
    "image/x-exr",
    "image/aces",
    "application/zip",
    "application/x-zip-compressed",
    "application/octet-stream",
)
FORM = "multipart/form-data"
FIELD = "file"

_MAX_PARTS = 16
_MAX_BOUNDARY = 200


class Announced(NamedTuple):
    """What the headers of a request say: media type, boundary of a form, bytes (0 where they do not say)."""

    kind: str
    boundary: str
    length: int


async def receive(request: Request, place: Place, limits: Limits) -> str:
    """Write the file that a request brings into its folder for uploads and return its name there.

    Args:
        request: Whose body is an EXR or ZIP file, or a form with one in the field `file`.
        place: Of the request.
        limits: Of a request.

    Raises:
        Refusal: 400 a malformed form, 408 too slow, 413 too large, 415 another type, 422 nothing in it, 503
            no room.
        ClientDisconnect: The client went away.
        OSError: The file cannot be written.
    """
    kind, boundary, _ = check_headers(request, limits)
    body = place.upload / "body"
    with body.open("wb") as file:
        sink = _Form(file, boundary) if kind == FORM else _Raw(file)
        size = 0
        async for piece in _paced(request.stream(), limits):
            size += len(piece)
            if size > limits.upload:
                raise too_large(limits)
            place.take(len(piece))
            sink.write(piece)
        name = sink.finish()
    body.rename(place.upload / name)
    return name


def check_headers(request: Request, limits: Limits) -> Announced:
    """Return what the headers say; raises as `receive`, before a byte is read."""
    header = Message()
    header["content-type"] = request.headers.get("content-type", "")
    kind = header.get_content_type() if request.headers.get("content-type") else ""
    if kind not in (*RAW, FORM):
        raise Refusal(
            415,
            f"Content-Type {ascii(kind[:60]) if kind else 'is missing'}: expected {RAW[0]} or {RAW[2]} with "
            f"the file as the body, or {FORM} with the file in the field '{FIELD}'",
        )
    if request.headers.get("content-encoding", "identity").lower() != "identity":
        raise Refusal(415, "Content-Encoding: expected none; EXR and ZIP files are compressed already")
    text = request.headers.get("content-length", "")
    length = int(text[:16]) if text.isascii() and text.isdigit() else 0
    if length > limits.upload:
        raise too_large(limits)
    boundary = str(header.get_param("boundary") or "")
    if kind == FORM and not 0 < len(boundary) <= _MAX_BOUNDARY:
        raise Refusal(
            400, "the form has no boundary in its Content-Type; expected multipart/form-data; boundary=…"
        )
    return Announced(kind, boundary, length)


def too_large(limits: Limits) -> Refusal:
    """Return the answer to a body that is too large."""
    return Refusal(413, f"the body has more than {limits.upload / 1e6:g} MB, which is the most that is taken")


async def _paced(stream: AsyncIterator[bytes], limits: Limits) -> AsyncIterator[bytes]:
    """Pass on the pieces of a body while they come in time.

    Raises:
        Refusal: None came for a while, or all together take too long.
    """
    until = asyncio.get_running_loop().time() + limits.read
    pieces = stream.__aiter__()
    while True:
        try:
            left = until - asyncio.get_running_loop().time()
            piece = await asyncio.wait_for(anext(pieces), max(0.0, min(left, limits.idle)))
        except StopAsyncIteration:
            return
        except TimeoutError:
            raise Refusal(
                408,
                f"the body came too slowly: expected all of it within {limits.read:g} seconds and no pause "
                f"of {limits.idle:g} seconds",
            ) from None
        yield piece


class _Raw:
    """The body is the file."""

    def __init__(self, file: BinaryIO) -> None:
        self.file = file

    def write(self, piece: bytes) -> None:
        self.file.write(piece)

    def finish(self) -> str:
        if not self.file.tell():
            raise Refusal(422, "the body is empty; expected an EXR file, or a ZIP file of a sequence")
        return "frame.exr"


class _Form:
    """The file is a part of a form; the other parts are passed over."""

    def __init__(self, file: BinaryIO, boundary: str) -> None:
        self.file, self.parts, self.ended = file, 0, False
        self.name: str | None = None
        self._inside = False
        self._field, self._value = bytearray(), bytearray()
        self._headers: dict[str, str] = {}
        callbacks: dict[str, Callable[..., None]] = {
            "on_part_begin": self._begin,
            "on_header_field": lambda data, start, end: self._field.extend(data[start:end]),
            "on_header_value": lambda data, start, end: self._value.extend(data[start:end]),
            "on_header_end": self._header,
            "on_headers_finished": self._opened,
            "on_part_data": self._data,
            "on_end": self._end,
        }
        try:
            self._parser = MultipartParser(boundary, callbacks)  # type: ignore[arg-type]  # a TypedDict
        except (FormParserError, UnicodeError) as error:
            raise Refusal(400, "the boundary of the form is malformed") from error

    def write(self, piece: bytes) -> None:
        try:
            self._parser.write(piece)
        except (FormParserError, UnicodeError) as error:
            raise Refusal(400, f"the form is malformed: {str(error)[:100]}") from error

    def finish(self) -> str:
        if not self.ended:
            raise Refusal(400, "the form is malformed: it ends before its last boundary")
        if self.name is None or not self.file.tell():
            raise Refusal(
                422, f"the form has no file in the field '{FIELD}'; expected an EXR or ZIP file there"
            )
        return plain_name(self.name or "frame")

    def _begin(self) -> None:
        self.parts += 1
        if self.parts > _MAX_PARTS:
            raise Refusal(400, f"the form has more than {_MAX_PARTS} fields; expected one, '{FIELD}'")
        self._headers = {}

    def _header(self) -> None:
        name = self._field.decode("latin-1").lower()
        self._headers[name] = self._value.decode("utf-8", "replace")
        self._field, self._value = bytearray(), bytearray()

    def _opened(self) -> None:
        header = Message()
        header["content-disposition"] = self._headers.get("content-disposition", "").replace("\n", " ")
        field = header.get_param("name", header="content-disposition")
        self._inside = field == FIELD
        if self._inside:
            if self.name is not None:
                raise Refusal(
                    400, f"the form has several fields '{FIELD}'; expected one, a ZIP for a sequence"
                )
            self.name = (header.get_filename() or "frame").replace("\\", "/").rpartition("/")[2]

    def _data(self, data: bytes, start: int, end: int) -> None:
        if self._inside:
            self.file.write(data[start:end])

    def _end(self) -> None:
        self.ended = True
