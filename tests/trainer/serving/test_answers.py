"""What the service returns is what `trainer denoise` writes."""

from __future__ import annotations

import argparse
import io
import re
import zipfile
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import OpenEXR
import pytest
import torch

from data.exr import read_frame, write_exr
from tests.trainer.serving.running import EXR, Running, exr, frame, limits, picture, small_wskp, zipped
from trainer.commands import denoise as command

ZIP = {"Content-Type": "application/zip"}


@pytest.fixture(scope="module")
def service():
    with Running(small_wskp(), limits(queue=32)) as running:
        yield running


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    """The same network as a checkpoint of `trainer fit`."""
    net = small_wskp()
    arguments = {"layers": 2, "width": 6, "kernel_sizes": [3, 5], "temporal": False}
    path = tmp_path_factory.mktemp("run") / "net.ckpt"
    tree = {"net": {"class_path": "models.WSKP", "init_args": arguments}}
    weights = {f"net.{name}": value for name, value in net.state_dict().items()}
    torch.save({"hyper_parameters": tree, "state_dict": weights}, path)
    return path


def denoised(checkpoint, output, *paths):
    """Return name → colour of what `trainer denoise` writes."""
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    given = ["--model", str(checkpoint), *map(str, paths), "--output", str(output)]
    assert command.run(parser.parse_args(given)) == 0
    return {path.name: read_frame(path).buffers["color"] for path in output.glob("*.exr")}


@pytest.fixture
def one(tmp_path):
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield tmp_path
    torch.set_num_threads(threads)


def test_a_frame_is_denoised_as_the_command_does_bit_for_bit(service, checkpoint, one):
    content = exr(one)
    answer = service.post(content)
    assert answer.status_code == 200
    assert answer.headers["content-type"] == "image/x-exr"
    expected = denoised(checkpoint, one / "out", one / "f0.exr")
    np.testing.assert_array_equal(picture(answer.content, one), expected["f0.exr"])
    stored = read_frame(one / "answer.exr")
    assert stored.notes["denoised"]["model"] == "models:/net/1"
    assert float(answer.headers["x-penumbra-exposure"]) == stored.exposure


def test_a_form_and_a_body_in_chunks_give_the_same_file(service, one):
    content = exr(one)
    whole = picture(service.post(content).content, one)
    form = service.client.post("/denoise", files={"file": ("f0.exr", content)}, data={"other": "field"})
    chunked = service.post(iter([content[:1000], content[1000:]]))
    assert form.headers["content-disposition"] == 'attachment; filename="f0.exr"'
    for answer in (form, chunked):
        assert answer.status_code == 200
        np.testing.assert_array_equal(picture(answer.content, one), whole)


def test_a_zip_of_a_sequence_is_denoised_in_the_order_of_its_numbers(service, checkpoint, one):
    members = {f"shots/f{i}.exr": exr(one, seed=i) for i in (2, 10, 9)}
    answer = service.post(zipped(members | {"__MACOSX/shots/._f2.exr": b"x"}), ZIP)
    assert answer.headers["content-type"] == "application/zip"
    with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
        assert archive.namelist() == ["f2.exr", "f9.exr", "f10.exr"]
        found = {name: picture(archive.read(name), one) for name in archive.namelist()}
    (one / "answer.exr").unlink()
    expected = denoised(checkpoint, one / "out", *one.glob("*.exr"))
    for name, image in found.items():
        np.testing.assert_array_equal(image, expected[name])


def test_tiles_of_many_requests_are_joined_and_give_what_each_gives_alone(one):
    names = [exr(one, 48, 64, seed) for seed in range(6)]
    with Running(small_wskp(), limits(queue=32), tile=32, most=1) as alone:
        expected = [picture(alone.post(content).content, one) for content in names]
    with Running(small_wskp(), limits(queue=32), tile=32) as joined, ThreadPoolExecutor(6) as pool:
        answers = [future.result() for future in [pool.submit(joined.post, content) for content in names * 3]]
        calls, tiles = joined.metric("penumbra_batches_total"), joined.metric("penumbra_tiles_total")
    assert tiles == 18 * 4
    assert calls < tiles
    for answer, image in zip(answers, expected * 3, strict=True):
        difference = np.abs(picture(answer.content, one) - image)
        assert (
            difference <= 2**-10 * np.abs(image) + 1e-6
        ).all()  # one step of the half precision of the file


def test_the_exposure_can_be_given_or_measured(service, one):
    content = exr(one)
    assert service.post(content, exposure="2.5").headers["x-penumbra-exposure"] == "2.5"
    measured = service.post(content).headers["x-penumbra-exposure"]
    assert service.post(content, exposure="auto").headers["x-penumbra-exposure"] == measured


def test_layers_with_other_names_can_be_mapped(service, one):
    shown = frame()
    write_exr(
        one / "named.exr",
        {
            **{
                f"Beauty.{c}": np.ascontiguousarray(shown.buffers["color"][..., i])
                for i, c in enumerate("RGB")
            },
            **{
                f"Alb.{c}": np.ascontiguousarray(shown.buffers["albedo"][..., i]) for i, c in enumerate("RGB")
            },
            **{
                f"normal.{c}": np.ascontiguousarray(shown.buffers["normal"][..., i])
                for i, c in enumerate("XYZ")
            },
            "Z.Z": np.ascontiguousarray(shown.buffers["depth"][..., 0]),
        },
    )
    content = (one / "named.exr").read_bytes()
    refused = service.post(content)
    assert refused.status_code == 422
    assert "color" in refused.json()["detail"]
    mapped = service.post(content, channels="Beauty:color,Alb:albedo,Z:depth")
    assert mapped.status_code == 200, mapped.text
    write_exr(one / "missing.exr", {"Beauty.R": np.ones((16, 16), np.float32)})
    missing = service.post((one / "missing.exr").read_bytes(), channels="N:normal")
    assert missing.json()["detail"] == "frame.exr: there is no layer 'N'; the layers are Beauty"


def test_the_precision_of_the_answer_can_be_single(service, one):
    content = exr(one)
    for precision, kind in (("auto", np.float16), ("float", np.float32)):
        (one / "a.exr").write_bytes(service.post(content, precision=precision).content)
        with OpenEXR.File(str(one / "a.exr"), separate_channels=True) as file:
            assert file.parts[0].channels["color.R"].pixels.dtype == kind


def test_remarks_of_the_reader_come_with_the_answer(service, one):
    shown = frame()
    planes = {"R": 0, "G": 1, "B": 2}
    color = shown.buffers["color"].copy()
    color[3, 4] = np.nan
    channels = {f"color.{c}": np.ascontiguousarray(color[..., i]) for c, i in planes.items()}
    for name, letters in (("albedo", "RGB"), ("normal", "XYZ"), ("depth", "Z")):
        for i, c in enumerate(letters):
            channels[f"{name}.{c}"] = np.ascontiguousarray(shown.buffers[name][..., i])
    write_exr(one / "nan.exr", channels)
    notes = service.post((one / "nan.exr").read_bytes()).headers["x-penumbra-notes"]
    assert "1 pixel of color was NaN or Inf" in notes


def test_metrics_count_answers_tiles_and_megapixels(service, one):
    before = {n: service.metric(n) for n in ("penumbra_megapixels_total", "penumbra_tiles_total")}
    service.post(exr(one, 20, 30))
    service.post(b"nothing")
    assert service.metric("penumbra_megapixels_total") == pytest.approx(
        before["penumbra_megapixels_total"] + 600e-6
    )
    assert service.metric("penumbra_tiles_total") == before["penumbra_tiles_total"] + 1
    assert service.metric('penumbra_requests_total{path="/denoise",status="422"}') >= 1
    assert service.metric("process_resident_memory_bytes") > 1e6
    text = service.client.get("/metrics").text
    assert re.search(r'penumbra_model_info\{.*reference="models:/net/1"', text)


def test_pages_say_how_to_use_the_service(service):
    assert "curl" in service.client.get("/").text
    assert service.client.get("/health").json() == {"status": "ok", "model": "models:/net/1"}
    description = service.client.get("/openapi.json").json()["paths"]["/denoise"]["post"]
    assert set(description["requestBody"]["content"]) == {
        "image/x-exr",
        "application/zip",
        "multipart/form-data",
    }
    assert set(description["responses"]) == {"200", "400", "408", "413", "415", "422", "500", "503", "504"}
    assert service.client.get("/docs").status_code == 200


def test_a_token_is_asked_for_except_by_pages_and_health(one):
    token = "0123456789abcdef"
    content = exr(one)
    with Running(small_wskp(), token=token) as service:
        for path in ("/", "/health", "/openapi.json"):
            assert service.client.get(path).status_code == 200
        for given in ({}, {"Authorization": "Bearer wrong"}, {"Authorization": f"Basic {token}"},
                      {"Authorization": "Bearer \xff"}):  # fmt: skip
            headers = [(name.encode(), value.encode("latin-1")) for name, value in (EXR | given).items()]
            answer = service.client.post("/denoise", content=content, headers=headers)
            assert (answer.status_code, answer.headers["www-authenticate"]) == (401, "Bearer")
            assert service.client.get("/metrics", headers=headers[1:]).status_code == 401
        right = {"Authorization": f"Bearer {token}"}
        assert service.client.get("/metrics", headers=right).status_code == 200
        assert service.post(content, EXR | right).status_code == 200
        assert "401" in service.client.get("/openapi.json").json()["paths"]["/denoise"]["post"]["responses"]
