from __future__ import annotations

import hashlib
import io
import json
import tarfile
import zlib
from pathlib import Path

import numpy as np
import pytest

from data.patches import Position, cut
from data.shards.planes import Planes, half_fits
from data.shards.write import ShardWriter, record_of
from tests.data.small_sets import write_shards

META = {"scene": "a", "frame": 0}


def image(value: float, channels: int = 3) -> np.ndarray:
    return np.full((4, 5, channels), value, np.float32)


@pytest.mark.parametrize(
    ("name", "value", "half"),
    [
        ("color", 65504.0, True),
        ("color", 65505.0, False),  # would round to 65504 in one reader and overflow in another
        ("color", 1e6, False),
        ("color", 0.0, True),
        ("color", 1e-5, False),  # a scene in tiny units: subnormal in half precision
        ("depth", 1.0, False),
    ],
)
def test_half_precision_only_where_range_and_vocabulary_allow(name: str, value: float, half: bool):
    assert half_fits(name, image(value)) is half


def stored(images: dict[str, np.ndarray]) -> tuple[list[dict], bytes]:
    """Return what a sample's JSON says of its arrays, and their bytes."""
    record = record_of(
        "a", META, {name: Planes.of(name, array).cut(None, 0) for name, array in images.items()}
    )
    with tarfile.open(fileobj=io.BytesIO(bytes(record))) as tar:
        json_file, buffers = (tar.extractfile(entry) for entry in tar)
        assert json_file is not None
        assert buffers is not None
        return json.loads(json_file.read())["buffers"], buffers.read()


def test_an_array_that_overflows_half_is_stored_in_float32_beside_others_in_half():
    described, payload = stored({"color": image(1e6), "albedo": image(0.5)})
    assert [entry["dtype"] for entry in described] == ["<f4", "<f2"]
    color = np.frombuffer(payload, "<f4", 60, described[0]["offset"])
    assert (color == 1e6).all()


def test_arrays_are_channel_first_and_aligned():
    source = np.arange(60, dtype=np.float32).reshape(4, 5, 3)
    described, payload = stored({"depth": image(2, 1), "normal": source})
    assert all(entry["offset"] % 64 == 0 for entry in described)
    normal = np.frombuffer(payload, "<f2", 60, described[1]["offset"]).reshape(3, 4, 5)
    assert np.array_equal(normal, source.transpose(2, 0, 1))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_are_refused_by_name(value: float):
    spoilt = image(1)
    spoilt[3, 2, 1] = value
    with pytest.raises(ValueError, match="'albedo' has values that are not finite"):
        stored({"color": image(1), "albedo": spoilt})


def test_each_patch_is_stored_as_precisely_as_if_it_were_alone():
    generator = np.random.default_rng(5)
    whole = generator.uniform(-1, 1, (24, 24, 3)).astype(np.float32)
    whole[8:16, 8:16] *= 2.0**-9  # subnormal on its own
    whole[8, 8] = 0
    whole[20, 20] = 1e6  # does not fit
    whole[16:, :8] = 0
    whole[12, :8] = 0  # a row that says nothing of the others
    planes = Planes.of("color", whole)
    types = {}
    for y in range(0, 24, 8):
        for x in range(0, 24, 8):
            piece = np.ascontiguousarray(whole[y : y + 8, x : x + 8])
            found = planes.cut(Position(x, y), 8)
            types[x, y] = found.dtype
            assert (found.dtype == np.float16) is half_fits("color", piece)
            assert np.array_equal(found, piece.transpose(2, 0, 1).astype(found.dtype))
    assert [place for place, kind in types.items() if kind == np.float32] == [(8, 8), (16, 16)]
    assert planes.cut(None, 0).dtype == np.float32


def test_patches_are_cut_as_images_are_beyond_the_border_too():
    whole = np.random.default_rng(5).uniform(0.1, 1, (20, 24, 3)).astype(np.float32)
    for position in (Position(-5, 3), Position(19, 15), Position(3, -7), Position(-8, -8), Position(4, 2)):
        expected = cut(whole, position, 8).transpose(2, 0, 1).astype(np.float16)
        assert np.array_equal(Planes.of("color", whole).cut(position, 8), expected)


def test_a_shard_appears_only_when_it_is_finished(tmp_path: Path):
    path = tmp_path / "train-00000.tar"
    with ShardWriter(path, "train", "a") as writer:
        writer.add(META, {"color": image(1)})
        assert not path.exists()
        writer.finish()
        assert path.exists()
    with ShardWriter(tmp_path / "train-00001.tar", "train", "a") as writer:
        writer.add(META, {"color": image(1)})
    assert [p.name for p in tmp_path.iterdir()] == ["train-00000.tar"]


def test_a_full_disk_names_the_shard_and_leaves_nothing(tmp_path: Path):
    with ShardWriter(tmp_path / "train-00000.tar", "train", "a") as writer:
        writer.temporary.symlink_to("/dev/full")
        writer.add(META, {"color": image(1)})
        with pytest.raises(OSError, match=r"No space left.*finished are kept.*train-00000\.tar"):
            writer.finish()
    assert not any(tmp_path.iterdir())


def test_records_describe_the_bytes(tmp_path: Path):
    index = write_shards(tmp_path)
    for shard in index.shards:
        data = (index.root / shard.file).read_bytes()
        assert len(data) == shard.bytes
        assert hashlib.sha256(data).hexdigest() == shard.sha256
        for sample in shard.samples:
            part = data[sample.offset : sample.offset + sample.size]
            assert zlib.crc32(part) == sample.crc32
            with tarfile.open(fileobj=io.BytesIO(part)) as tar:
                assert tar.getnames() == [f"{sample.key}.json", f"{sample.key}.buffers"]


def test_headers_hold_no_trace_of_machine_or_time(tmp_path: Path):
    index = write_shards(tmp_path)
    with tarfile.open(index.root / index.shards[0].file) as tar:
        for entry in tar:
            assert (entry.mtime, entry.uid, entry.gid, entry.uname, entry.gname) == (0, 0, 0, "", "")


def test_the_webdataset_library_reads_the_shards(tmp_path: Path):
    from webdataset.tariterators import group_by_keys, tar_file_expander

    index = write_shards(tmp_path)
    shard = index.of("train")[0]
    with (index.root / shard.file).open("rb") as stream:
        read = list(group_by_keys(tar_file_expander([{"url": shard.file, "stream": stream}])))
    assert [sample["__key__"] for sample in read] == [sample.key for sample in shard.samples]
    meta = json.loads(read[0]["json"])
    assert (meta["scene"], meta["frame"], meta["exposure"]) == ("hall", 0, 0.5)
    entry = next(e for e in meta["buffers"] if e["name"] == "depth")
    depth = np.frombuffer(read[0]["buffers"], entry["dtype"], 256, entry["offset"]).reshape(16, 16)
    assert depth[0, 0] == 1 + meta["y"] * 48 + meta["x"]
