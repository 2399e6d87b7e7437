"""What is wrong with a request is answered with a status and one sentence, before it costs anything."""

from __future__ import annotations

import io
import stat
import struct
import zipfile

import numpy as np
import pytest

from data.exr import write_exr
from tests.trainer.serving.running import EXR, Running, exr, limits, small_wskp, zipped

ZIP = {"Content-Type": "application/zip"}


@pytest.fixture(scope="module")
def service():
    with Running(small_wskp()) as running:
        yield running
        assert running.service.readers.deaths == 0
        assert running.client.get("/health").status_code == 200


@pytest.fixture(scope="module")
def content(tmp_path_factory):
    return exr(tmp_path_factory.mktemp("frame"))


def detail(answer, status=422):
    """Return the text of a refusal, which tells nothing about the machine."""
    assert answer.status_code == status, answer.text
    text = answer.json()["detail"]
    assert "/tmp" not in text
    assert "Traceback" not in text
    return text


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        (b"", "the body is empty"),
        (b"hello", "not an OpenEXR file"),
        (b"\x89PNG\r\n\x1a\n" + bytes(50), "8-bit image"),
        (b"\x76\x2f\x31\x01", "truncated"),
        (b"\x76\x2f\x31\x01\x02\x08\x00\x00" + bytes(50), "deep EXR"),
        (b"PK\x05\x06" + bytes(18), "holds no files"),
        (b"PK\x03\x04" + bytes(100), "ZIP file"),
    ],
)
def test_what_is_no_exr_file_is_refused(service, body, expected):
    assert expected in detail(service.post(body))


def test_truncated_frames_are_refused(service, content):
    for size in (9, 100, 400, len(content) // 2, len(content) - 1):
        detail(service.post(content[:size]))


def test_a_frame_that_the_model_cannot_use_is_refused_with_what_is_missing(service, tmp_path):
    write_exr(tmp_path / "a.exr", {f"color.{c}": np.ones((20, 20), np.float32) for c in "RGB"})
    assert "albedo" in detail(service.post((tmp_path / "a.exr").read_bytes()))


def test_too_many_pixels_or_channels_are_refused_by_the_header(service, tmp_path):
    wide = {"color.R": np.zeros((240, 240), np.float16)}
    write_exr(tmp_path / "wide.exr", wide)
    assert "240x240" in detail(service.post((tmp_path / "wide.exr").read_bytes()))
    many = {f"c{i}.R": np.zeros((160, 160), np.float16) for i in range(64)}
    write_exr(tmp_path / "many.exr", many)
    assert "64 channels" in detail(service.post((tmp_path / "many.exr").read_bytes()))


def window(content: bytes, size: int) -> bytes:
    """Return the file with a header that claims so many rows and columns."""
    for name in (b"dataWindow\0box2i\0", b"displayWindow\0box2i\0"):
        place = content.index(name) + len(name) + 4 + 8
        content = (
            content[:place] + (size - 1).to_bytes(4, "little", signed=size < 1) * 2 + content[place + 8 :]
        )
    return content


@pytest.mark.parametrize("size", [0, 5_000, 200_000, 2**31])
def test_a_header_that_lies_about_its_size_costs_nothing(service, content, size):
    detail(service.post(window(content, size)))


@pytest.mark.parametrize(
    ("query", "expected"),
    [
        ({"exposure": "0"}, "exposure"),
        ({"exposure": "nan"}, "exposure"),
        ({"exposure": "x"}, "exposure"),
        ({"channels": "a"}, "channels"),
        ({"channels": "a:beauty"}, "no buffer"),
        ({"channels": "a:color,a:albedo"}, "second time"),
        ({"precision": "half"}, "precision"),
    ],
)
def test_wrong_options_are_refused_by_name(service, content, query, expected):
    assert expected in detail(service.post(content, **query))


@pytest.mark.parametrize(
    "kind", [None, "text/plain", "application/x-www-form-urlencoded", "x" * 500, "multipart/mixed"]
)
def test_other_media_types_are_refused(service, content, kind):
    assert "expected image/x-exr" in detail(
        service.post(content, {"Content-Type": kind} if kind else {}), 415
    )


def test_compressed_bodies_are_refused(service, content):
    detail(service.post(content, EXR | {"Content-Encoding": "gzip"}), 415)


FORM = {"Content-Type": "multipart/form-data; boundary=xyz"}
PART = b'--xyz\r\nContent-Disposition: form-data; name="file"; filename="a.exr"\r\n\r\n'


@pytest.mark.parametrize(
    ("header", "body", "status"),
    [
        ({"Content-Type": "multipart/form-data"}, b"", 400),
        ({"Content-Type": "multipart/form-data; boundary=" + "x" * 300}, b"", 400),
        (FORM, b"no boundary", 400),
        (FORM, PART + b"abc", 400),
        (FORM, PART + b"abc\r\n--xyz\r\n" + PART[7:] + b"abc\r\n--xyz--\r\n", 400),
        (FORM, b"--xyz\r\nX: " + b"y" * 100_000 + b"\r\n\r\n\r\n--xyz--\r\n", 400),
        (FORM, (b"--xyz\r\nContent-Disposition: form-data; name=a\r\n\r\n1\r\n") * 40 + b"--xyz--\r\n", 400),
        (FORM, PART.replace(b'"file"', b'"image"') + b"abc\r\n--xyz--\r\n", 422),
        (FORM, PART + b"\r\n--xyz--\r\n", 422),
        (FORM, PART.replace(b"a.exr", b"../../a.exr") + b"abc\r\n--xyz--\r\n", 422),
    ],
)
def test_malformed_forms_are_refused(service, header, body, status):
    detail(service.post(body, header), status)


def member(name: str, content: bytes = b"x", **attributes) -> bytes:
    """Return a ZIP file with one member with attributes of `zipfile.ZipInfo`."""
    info = zipfile.ZipInfo(name)
    for key, value in attributes.items():
        setattr(info, key, value)
    memory = io.BytesIO()
    with zipfile.ZipFile(memory, "w") as archive:
        archive.writestr(info, content)
    return memory.getvalue()


LARGE = {f"{i}.exr": np.random.default_rng(i).bytes(20_000) * 120 for i in range(3)}


def encrypted() -> bytes:
    content = bytearray(member("a.exr"))
    content[6] |= 1
    content[content.index(b"PK\x01\x02") + 8] |= 1
    return bytes(content)


def outside() -> bytes:
    """Return a ZIP file whose only member lies far behind the end of the file."""
    content = member("a.exr")
    start, end = content.index(b"PK\x01\x02"), content.index(b"PK\x05\x06")
    place = struct.pack("<HHQ", 1, 8, 2**62)
    directory = bytearray(content[start:end] + place)
    directory[30:32] = struct.pack("<H", len(place))
    directory[42:46] = b"\xff" * 4
    last = bytearray(content[end:])
    last[12:16] = struct.pack("<I", len(directory))
    return content[:start] + bytes(directory) + bytes(last)


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        (member("../a.exr"), "leads out"),
        (member("/etc/a.exr"), "leads out"),
        (member("a\\..\\..\\b.exr"), "leads out"),
        (member("C:a.exr"), "leads out"),
        (member("a.exr", external_attr=(stat.S_IFLNK | 0o777) << 16), "no plain file"),
        (encrypted(), "encrypted"),
        (member("a.txt"), "nothing but EXR"),
        (member("a.exr").replace(b"a.exr", b"\0.exr"), "nothing but EXR"),
        (outside(), "damaged ZIP file"),
        (member("a.zip", zipped({"a.exr": b"x"})), "nothing but EXR"),
        (member("a.exr", zipped({"a.exr": b"x"})), "not an OpenEXR file"),
        (zipped({"a/f.exr": b"x", "b/f.exr": b"y"}), "twice"),
        (zipped({f"{i}.exr": b"x" for i in range(6)}), "holds 6 files, at most 5"),
        (zipped({f"folder{i}/": b"" for i in range(9)}), "no files"),
        (zipped({"a.exr": bytes(5_000_000)}, zipfile.ZIP_DEFLATED), "1000 times"),
        (zipped(LARGE, zipfile.ZIP_DEFLATED), "unpacks to"),
        (zipped({"a.exr": b"x"}, zipfile.ZIP_LZMA), "unusual way"),
    ],
)  # fmt: skip
def test_hostile_archives_are_refused(service, body, expected):
    assert expected in detail(service.post(body, ZIP))


def test_an_archive_that_lies_about_the_size_of_its_file_is_refused(service):
    content = bytearray(zipped({"a.exr": b"x" * 100_000}, zipfile.ZIP_DEFLATED))
    for mark, offset in ((b"PK\x03\x04", 22), (b"PK\x01\x02", 24)):
        place = content.index(mark) + offset
        content[place : place + 4] = (1000).to_bytes(4, "little")
    detail(service.post(bytes(content), ZIP))


def test_a_directory_of_very_many_names_is_refused(service):
    memory = io.BytesIO()
    with zipfile.ZipFile(memory, "w") as archive:
        for i in range(20_000):
            archive.writestr(f"{i}.exr", b"")
    assert "20000 files" in detail(service.post(memory.getvalue(), ZIP))


def test_a_broken_frame_in_a_sequence_is_named(service, content):
    body = zipped({"f1.exr": content, "f2.exr": content[: len(content) // 2]})
    assert "f2.exr" in detail(service.post(body, ZIP))


def test_an_announced_length_over_the_limit_is_refused_before_the_body(service):
    head = b"POST /denoise HTTP/1.1\r\nHost: x\r\nContent-Type: image/x-exr\r\nContent-Length: 99999999\r\n"
    with service.raw(head + b"Expect: 100-continue\r\n\r\n") as connection:
        assert connection.recv(4096).startswith(b"HTTP/1.1 413")


def test_a_body_over_the_limit_is_refused_though_it_announces_no_length(service):
    answer = service.post(bytes(100_000) for _ in range(40))
    assert "more than 3 MB" in detail(answer, 413)


TYPED = b"POST /denoise HTTP/1.1\r\nHost: x\r\nContent-Type: image/x-exr\r\n"


@pytest.mark.parametrize(
    "head",
    [
        b"GARBAGE\r\n\r\n",
        b"POST /denoise HTTP/1.1\r\nHost: x\r\nContent-Length: 5\r\nContent-Length: 6\r\n\r\n",
        b"POST /denoise HTTP/1.1\r\nHost: x\r\nContent-Length: -5\r\n\r\n",
        TYPED + b"Transfer-Encoding: chunked\r\n\r\nZZ\r\n",
        b"GET /" + b"a" * 100_000 + b" HTTP/1.1\r\n\r\n",
        b"\x16\x03\x01" + bytes(200),
    ],
)
def test_malformed_http_is_answered_with_400(service, head):
    with service.raw(head) as connection:
        assert connection.recv(4096).startswith(b"HTTP/1.1 400")


def test_unknown_pages_and_methods_are_refused(service):
    assert service.client.get("/nothing").status_code == 404
    assert service.client.get("/denoise").status_code == 405
    assert service.client.get("/../../etc/passwd").status_code == 404


def test_a_result_that_is_not_finite_is_no_failure_of_the_server(tmp_path):
    import torch

    from models.denoiser import Denoised, Denoiser

    class Broken(Denoiser):
        inputs = ("color",)

        def forward(self, buffers):
            return Denoised(torch.full_like(buffers["color"], float("nan")))

    with Running(Broken(), limits()) as service:
        assert "NaN" in detail(service.post(exr(tmp_path)))
