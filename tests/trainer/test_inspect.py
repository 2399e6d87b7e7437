import argparse
import hashlib
import json
import re
import zlib
from pathlib import Path

import numpy as np
import pytest

import data
import models
import trainer
from data.exr import write_exr, write_frame
from data.shards.index import Index
from data.shards.write import ShardWriter
from tests.data.miniature import bmfr_scene, ingested, penumbra_scene, sample_crop
from tests.data.remote_servers import WebServer
from trainer.commands import inspect as command


def call(*arguments):
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    return command.run(parser.parse_args([str(a) for a in arguments]))


def found(path, capsys, code=0):
    assert call(path, "--json") == code
    return json.loads(capsys.readouterr().out)


def test_a_file_is_described_buffer_by_buffer(tmp_path, capsys):
    frame = sample_crop("classroom", 2)
    write_frame(frame, tmp_path / "x.exr", ["color", "depth", "normal"])
    report = found(tmp_path / "x.exr", capsys)
    assert (report["kind"], report["scene"], report["frame"], report["spp"]) == ("file", "classroom", 2, 1)
    assert report["camera"]["world_to_pixel"] == frame.camera.world_to_pixel.tolist()
    color = report["buffers"]["color"]
    assert color["channels"] == ["color.R", "color.G", "color.B"]
    assert color["type"] == "half"
    assert color["max"] == pytest.approx(float(frame.buffers["color"].max()))
    assert color["median"] == pytest.approx(float(np.median(frame.buffers["color"])))
    black = 100 * (frame.buffers["color"] == 0).all(-1).mean()
    assert color["no_hit_percent"] == pytest.approx(black)
    assert report["buffers"]["depth"]["type"] == "float"


def test_broken_pixels_and_unknown_channels_are_reported(tmp_path, capsys):
    image = np.ones((10, 10), np.float32)
    image[0, :3] = np.nan
    channels = {f"color.{c}": image for c in "RGB"} | {"crypto.R": image}
    write_exr(tmp_path / "x.exr", channels)
    report = found(tmp_path / "x.exr", capsys)
    assert report["buffers"]["color"]["non_finite_percent"] == 3
    assert report["ignored"] == ["crypto.R"]


def test_the_table_of_a_file_names_channels_and_numbers(tmp_path, capsys):
    write_frame(sample_crop("classroom", 2), tmp_path / "x.exr", ["color"])
    assert call(tmp_path / "x.exr") == 0
    text = capsys.readouterr().out
    assert "scene classroom, frame 2, spp 1, exposure 2.275, camera yes" in text
    assert "NaN/Inf %" in text
    assert "half" in text


def test_the_sample_is_described_with_splits_credits_and_checksums(capsys):
    assert call("sample:bmfr") == 0
    text = capsys.readouterr().out
    assert "train: cbox-glossy, living-room-2; validation: none; test: classroom" in text
    assert "checksums: all files match" in text
    assert "NovaZeeke" in text
    assert "derived: irradiance = color / albedo" in text


def test_an_unknown_sample_is_named():
    with pytest.raises(ValueError, match="there is no sample 'kpcn'; there is bmfr"):
        call("sample:kpcn")


def test_a_data_set_with_an_altered_file_is_reported_and_fails(tmp_path, capsys):
    root = ingested(tmp_path)
    report = found(root, capsys)
    assert report["problems"] == []
    assert report["scenes"]["classroom"]["frames"] == 2
    assert report["first_frames"]["classroom"]["buffers"]["irradiance"]["type"] == "derived"
    (root / "classroom" / "f001.exr").write_bytes(b"x")
    report = found(root, capsys, code=1)
    assert "f001.exr has 1 bytes" in report["problems"][0]
    assert call(root) == 1
    assert "problem: " in capsys.readouterr().out


def test_the_manifest_itself_can_be_named(tmp_path, capsys):
    assert found(ingested(tmp_path) / "manifest.json", capsys)["kind"] == "data set"


def test_a_raw_layout_is_recognised(tmp_path, capsys):
    bmfr_scene(tmp_path / "b", "classroom")
    penumbra_scene(tmp_path / "p", "classroom")
    report = found(tmp_path / "b", capsys)
    assert (report["kind"], report["layout"], report["frames"], report["depth"]) == ("layout", "bmfr", 2, "z")
    assert report["scenes"]["classroom"]["thresholds"]["position_limit_squared"] == 0.01
    assert found(tmp_path / "p", capsys)["layout"] == "penumbra"
    assert call(tmp_path / "b") == 0
    assert "position_limit_squared 0.01" in capsys.readouterr().out


def shards(root, broken=False):
    """Write two samples of 4x4 as prepared shards."""
    root.mkdir()
    arrays = {
        "color": np.arange(48, dtype="<f2").reshape(3, 4, 4),
        "depth": np.full((1, 4, 4), 2, "<f4"),
    }
    meta = {"scene": "hall", "width": 4, "height": 4, "exposure": 1.0, "accumulated": False}
    with ShardWriter(root / "train-00000.tar", "train", "hall") as writer:
        for number in range(2):
            writer.add_stored({**meta, "frame": number, "depth_range": [2.0, 2.0]}, arrays)
        shard = writer.finish()
    Index(root, "ab" * 32, {}, {"patch": 4}, (shard,)).write()
    if broken:
        path = root / "train-00000.tar"
        path.write_bytes(path.read_bytes()[:-7])
    return root


def test_shards_are_described_from_their_index_and_a_few_samples(tmp_path, capsys):
    report = found(shards(tmp_path / "s"), capsys)
    train = report["splits"]["train"]
    assert (report["kind"], train["samples"], train["shards"]) == ("shards", 2, 1)
    assert train["buffers"]["color"]["max"] == 47
    assert train["buffers"]["color"]["type"] == "half"
    assert train["buffers"]["depth"]["median"] == 2
    assert report["splits"]["test"]["samples"] == 0
    assert call(tmp_path / "s") == 0
    assert "train: 2 samples in 1 shards" in capsys.readouterr().out


def test_a_truncated_shard_is_reported_and_fails(tmp_path, capsys):
    report = found(shards(tmp_path / "s", broken=True), capsys, code=1)
    assert "does not match its checksum" in report["problems"][0]


@pytest.mark.parametrize("name", ["../train-00000.tar", "..", "", "sub/train-00000.tar", "/dev/zero"])
def test_an_index_cannot_name_files_outside_its_folder(tmp_path, name):
    root = shards(tmp_path / "s")
    (tmp_path / "train-00000.tar").write_bytes((root / "train-00000.tar").read_bytes())
    index = json.loads((root / "index.json").read_text())
    index["shards"][0]["file"] = name
    (root / "index.json").write_text(json.dumps(index))
    with pytest.raises(ValueError, match="is no name of a file in this folder"):
        call(root)


@pytest.mark.parametrize("change", [{"size": 10**13}, {"offset": -5}, {"offset": 10**13}])
def test_a_place_beyond_the_shard_is_refused(tmp_path, change):
    root = shards(tmp_path / "s")
    index = json.loads((root / "index.json").read_text())
    index["shards"][0]["samples"][0] |= change
    (root / "index.json").write_text(json.dumps(index))
    with pytest.raises(ValueError, match="expected a whole number from"):
        call(root)


def test_names_inside_a_tar_are_never_paths(tmp_path, capsys):
    root = shards(tmp_path / "s")
    path = root / "train-00000.tar"
    content = bytearray(path.read_bytes())
    index = json.loads((root / "index.json").read_text())
    record = index["shards"][0]
    for sample in record["samples"]:
        start = sample["offset"]
        content[start : start + 30] = b"../../outside.json".ljust(30, b"\0")
        sample["crc32"] = zlib.crc32(content[start : start + sample["size"]])
    path.write_bytes(content)
    record["sha256"] = hashlib.sha256(content).hexdigest()
    (root / "index.json").write_text(json.dumps(index))
    before = sorted(p for p in tmp_path.rglob("*"))
    assert found(root, capsys)["splits"]["train"]["buffers"]
    assert sorted(p for p in tmp_path.rglob("*")) == before


def test_nothing_in_the_code_unpacks_archives_into_folders():
    """Shards are read by offset, checkpoints and exported files by their libraries; none is extracted."""
    for package in (data, models, trainer):
        for path in Path(package.__file__).parent.rglob("*.py"):
            assert not re.search(r"extractall|unpack_archive|\.extract\(", path.read_text("utf-8")), path


@pytest.mark.parametrize("text", ["{", "[]", '{"format": "other"}', '{"format": "penumbra-shards"}'])
def test_a_damaged_index_is_refused(tmp_path, text):
    (tmp_path / "index.json").write_text(text)
    with pytest.raises(ValueError, match=r"index\.json is not an index of shards .*trainer prepare FRAMES"):
        call(tmp_path)


def test_paths_that_hold_nothing_known_are_refused_with_what_was_expected(tmp_path):
    with pytest.raises(FileNotFoundError, match="none does not exist"):
        call(tmp_path / "none")
    with pytest.raises(ValueError, match="is neither an EXR file, an ingested data set"):
        call(tmp_path)
    (tmp_path / "x.exr").write_bytes(b"text")
    with pytest.raises(ValueError, match="not an OpenEXR file"):
        call(tmp_path / "x.exr")
    (tmp_path / "set" / ".partial").mkdir(parents=True)
    with pytest.raises(ValueError, match="is an unfinished ingestion; run the same `trainer ingest` command"):
        call(tmp_path / "set")


def test_a_page_is_written_and_its_place_and_findings_printed(tmp_path, capsys):
    target = tmp_path / "report.html"
    assert call(ingested(tmp_path), "--html", target, "--processes", 1) == 0
    printed = capsys.readouterr()
    assert "warning: 2 scenes do not state a licence" in printed.out
    assert f"{target}: " in printed.out
    assert "open it in a browser" in printed.out
    assert "frames: 4 of 4" in printed.err
    assert target.read_text(encoding="utf-8").startswith("<!doctype html>")


def test_findings_are_printed_as_json_alone_on_standard_output(tmp_path, capsys):
    assert call(ingested(tmp_path), "--html", tmp_path / "r.html", "--json", "--processes", 1) == 0
    printed = capsys.readouterr()
    levels = {f["level"]: f["text"] for f in json.loads(printed.out)}
    assert "licence" in levels["warning"]
    assert "open it in a browser" in printed.err


def test_a_page_of_a_set_with_a_damaged_frame_is_written_and_the_command_fails(tmp_path, capsys):
    root = ingested(tmp_path)
    (root / "classroom" / "f001.exr").write_bytes(b"x")
    assert call(root, "--html", tmp_path / "r.html", "--processes", 1) == 1
    assert "problem: 1 frame cannot be read" in capsys.readouterr().out
    assert "f001.exr has 1 bytes" in (tmp_path / "r.html").read_text(encoding="utf-8")


def test_an_existing_page_is_replaced_only_with_force(tmp_path):
    root, target = ingested(tmp_path), tmp_path / "r.html"
    target.write_text("mine")
    with pytest.raises(ValueError, match=r"already there .*--force replaces"):
        call(root, "--html", target)
    assert target.read_text() == "mine"
    assert call(root / "manifest.json", "--html", target, "--force", "--processes", 1) == 0
    assert target.read_text(encoding="utf-8") != "mine"


def test_a_page_is_refused_for_what_is_no_data_set_with_the_way_to_one(tmp_path):
    target = ("--html", tmp_path / "r.html")
    with pytest.raises(ValueError, match=r"holds shards.*name the one that they were prepared from"):
        call(shards(tmp_path / "s"), *target)
    penumbra_scene(tmp_path / "p", "classroom")
    with pytest.raises(ValueError, match=r"has the layout penumbra.*ingest it first, with --layout penumbra"):
        call(tmp_path / "p", *target)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match=r"is no data set \(it has no manifest\.json\)"):
        call(tmp_path / "empty", *target)
    with pytest.raises(FileNotFoundError, match="none does not exist"):
        call(tmp_path / "none", *target)
    with pytest.raises(ValueError, match="--processes is 0"):
        call(tmp_path, "--processes", 0, *target)
    assert not (tmp_path / "r.html").exists()


@pytest.mark.parametrize("option", [("--force",), ("--processes", 2)])
def test_options_of_the_page_are_refused_without_it(tmp_path, option):
    with pytest.raises(ValueError, match=f"{option[0]} is for --html"):
        call(tmp_path, *option)


def test_samples_kept_apart_are_listed_with_their_quantities(capsys):
    assert call("sample:layers") == 0
    assert "samples: 8 per pixel, each with radiance, normal, depth" in capsys.readouterr().out


def test_shards_at_a_url_are_described_and_their_sizes_compared(tmp_path, capsys):
    root = shards(tmp_path / "s")
    with WebServer(tmp_path) as web:
        report = found(f"{web.url}/s", capsys)
        assert (report["kind"], report["path"], report["checked"]) == ("shards", f"{web.url}/s", "sizes")
        assert report["splits"] == found(root, capsys)["splits"]
        assert web.asked["GET /s/train-00000.tar"] == 2, "only the samples are read"
        assert call(f"{web.url}/s") == 0
        assert "sizes: all files match" in capsys.readouterr().out
        with pytest.raises(ValueError, match="--html shows frames on this machine"):
            call(f"{web.url}/s", "--html", tmp_path / "x.html")
        (root / "train-00000.tar").unlink()
        assert "train-00000.tar is missing" in found(f"{web.url}/s", capsys, code=1)["problems"][0]
        with pytest.raises(
            FileNotFoundError, match=r"/none holds no shards .*trainer prepare FRAMES --output"
        ):
            call(f"{web.url}/none")
