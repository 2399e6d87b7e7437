from __future__ import annotations

import hashlib
import io
import json
import tarfile
import zlib
from pathlib import Path

import numpy as np
import pytest

from data.shards.write import ShardWriter, encode, half_fits
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


def test_an_array_that_overflows_half_is_stored_in_float32_beside_others_in_half():
    described, payload = encode({"color": image(1e6), "albedo": image(0.5)})
    assert [entry["dtype"] for entry in described] == ["<f4", "<f2"]
    color = np.frombuffer(payload, "<f4", 60, described[0]["offset"])
    assert (color == 1e6).all()


def test_arrays_are_channel_first_and_aligned():
    source = np.arange(60, dtype=np.float32).reshape(4, 5, 3)
    described, payload = encode({"depth": image(2, 1), "normal": source})
    assert all(entry["offset"] % 64 == 0 for entry in described)
    stored = np.frombuffer(payload, "<f2", 60, described[1]["offset"]).reshape(3, 4, 5)
    assert np.array_equal(stored, source.transpose(2, 0, 1))


def test_values_that_are_not_finite_are_refused_by_name():
    with pytest.raises(ValueError, match="'albedo' has values that are not finite"):
        encode({"color": image(1), "albedo": image(np.nan)})


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
