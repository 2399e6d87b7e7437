from __future__ import annotations

import json
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from data.augment import Augmentation, Turn, reordered, turned
from data.augment_samples import changed
from data.frames import FrameSet
from data.shards.batch import Batches, Order
from data.shards.index import INDEX, Index
from data.shards.prepare import prepare
from data.shards.read import CorruptSampleError, ShardReader
from tests.data.small_sets import CHANNELS, OPTIONS, write_shards, write_stills

NAMES = ("color", "irradiance", "albedo", "normal", "depth", "history", "reference")


@pytest.fixture(scope="module")
def index(tmp_path_factory: pytest.TempPathFactory) -> Index:
    return write_shards(tmp_path_factory.mktemp("shards"))


def copy(index: Index, target: Path) -> Path:
    target.mkdir()
    for path in index.root.iterdir():
        (target / path.name).write_bytes(path.read_bytes())
    return target


def flip_byte(path: Path, offset: int) -> None:
    data = bytearray(path.read_bytes())
    data[offset] ^= 1
    path.write_bytes(data)


def test_whole_test_frames_come_back_as_they_were_ingested(index: Index):
    frames = FrameSet(index.root.parent / "frames")
    batches = Batches(ShardReader(index, "test"), NAMES, temporal=True)
    for number, record in enumerate(frames.frames("cave")):
        batch = batches[Order(0, (number,))].unpack()
        frame = frames.read("cave", record.index)
        for name in ("color", "albedo", "normal", "depth", "reference"):
            expected = torch.from_numpy(frame.buffers[name]).permute(2, 0, 1)[None]
            assert torch.equal(batch[name], expected), name
        assert (batch["scene"], batch["frame"].tolist()) == (["cave"], [record.index])
        assert batch["exposure"].tolist() == [0.5 + record.index]
        assert batch["depth_range"].tolist() == [[1.0, 48.0 * 40.0]]


def test_patches_carry_the_depth_range_and_exposure_of_their_whole_frame(index: Index):
    batches = Batches(ShardReader(index, "train"), NAMES, temporal=True)
    batch = batches[Order(0, tuple(range(len(batches))))].unpack()
    assert (batch["depth_range"] == torch.tensor([1.0, 1920.0])).all()
    assert torch.equal(batch["exposure"], 0.5 + batch["frame"])
    assert batch["color"].dtype == torch.float32
    assert batch["color"].shape[1:] == (3, 16, 16)


def test_patches_are_cut_where_the_description_says(index: Index):
    reader = ShardReader(index, "train")
    for number in range(len(reader)):
        shard, place = reader.locate(number)
        path = index.root / reader.shards[shard].file
        start = reader.shards[shard].samples[place].offset + 512
        meta = json.loads(path.read_bytes()[start : start + 2000].split(b"\0")[0])
        depth = reader.array(number, "depth")[0]
        assert depth[0, 0] == 1 + meta["y"] * 48 + meta["x"]
        assert depth[15, 15] - depth[0, 0] == 15 * 48 + 15


def test_stored_irradiance_is_the_running_mean_and_history_its_length(index: Index):
    frames = FrameSet(index.root.parent / "frames")
    batches = Batches(ShardReader(index, "test"), NAMES, temporal=True)
    single = [frames.read("cave", i).buffers["irradiance"] for i in range(3)]
    for number in range(3):
        batch = batches[Order(0, (number,))].unpack()
        mean = np.mean(single[: number + 1], axis=0).transpose(2, 0, 1)
        assert np.allclose(batch["irradiance"][0].numpy(), mean, rtol=2e-3, atol=1e-4)
        assert (batch["history"] == number + 1).all()


def test_a_net_without_history_gets_the_irradiance_of_the_frame_alone(index: Index):
    batches = Batches(ShardReader(index, "test"), NAMES, temporal=False)
    batch = batches[Order(0, (2,))].unpack()
    assert torch.equal(batch["irradiance"], batch["color"] / batch["albedo"])


def test_dropped_history_leaves_the_irradiance_of_the_frame_alone_with_a_history_of_one(index: Index):
    reader = ShardReader(index, "train")
    names = ("irradiance", "history", "color", "albedo", "normal")
    orders = Order(0, tuple(range(len(reader))))
    always = Augmentation("none", drop_history=1.0)
    dropped = Batches(reader, names, True, augmentation=always)[orders].unpack()
    assert torch.equal(dropped["irradiance"], dropped["color"] / dropped["albedo"])
    assert (dropped["history"] == 1).all()
    kept = Batches(reader, names, True, augmentation=Augmentation("none"))[orders].unpack()
    assert not torch.equal(kept["irradiance"], dropped["irradiance"])
    assert torch.equal(kept["albedo"], dropped["albedo"])


def test_albedo_of_zero_gives_no_irradiance_instead_of_nan(index: Index, monkeypatch: pytest.MonkeyPatch):
    reader = ShardReader(index, "train")
    read = reader.array

    def black(number: int, name: str) -> torch.Tensor:
        return torch.zeros_like(read(number, name)) if name == "albedo" else read(number, name)

    monkeypatch.setattr(reader, "array", black)
    batch = Batches(reader, ("irradiance",), temporal=False)[Order(0, (0, 1))].unpack()
    assert (batch["irradiance"] == 0).all()


def test_permuted_samples_keep_radiance_equal_to_irradiance_times_albedo(index: Index):
    reader = ShardReader(index, "train")
    batches = Batches(reader, ("irradiance", "color", "albedo", "normal"), False,
                      augmentation=Augmentation("dihedral", seed=4, permute=True))  # fmt: skip
    batch = batches[Order(3, tuple(range(len(reader))))].unpack()
    assert torch.allclose(batch["irradiance"] * batch["albedo"], batch["color"], rtol=1e-5, atol=1e-7)
    lengths = torch.linalg.vector_norm(batch["normal"], dim=1)
    plain = Batches(reader, ("normal",), True)[Order(0, tuple(range(len(reader))))].unpack()["normal"]
    expected = torch.linalg.vector_norm(plain, dim=1)
    assert torch.allclose(lengths.flatten(1).sort()[0], expected.flatten(1).sort()[0], atol=1e-6)


def test_a_temporal_net_that_reads_color_gets_it_accumulated(index: Index):
    reader = ShardReader(index, "test")
    batch = Batches(reader, NAMES, temporal=True, inputs=("color",))[Order(0, (2,))].unpack()
    assert torch.equal(batch["color"], batch["irradiance"] * batch["albedo"])


def test_training_samples_are_turned_as_the_augmentation_says(index: Index):
    reader = ShardReader(index, "train")
    augmentation = Augmentation("dihedral", exposure_stops=1, seed=9)
    numbers = tuple(range(24))
    plain = Batches(reader, NAMES, True)[Order(3, numbers)].unpack()
    made = Batches(reader, NAMES, True, augmentation=augmentation)[Order(3, numbers)].unpack()
    turns = [augmentation.turn(3, number) for number in numbers]
    assert len(set(turns)) == len(Turn(0) | Turn(7)) or len(set(turns)) > 5
    for row, turn in enumerate(turns):
        for name in NAMES:
            assert np.array_equal(made[name][row].numpy(), turned(plain[name][row].numpy(), turn)), name
    factors = made["exposure"] / plain["exposure"]
    assert torch.allclose(factors, torch.tensor([augmentation.exposure_factor(3, n) for n in numbers]))


def test_a_reader_can_be_sent_to_another_process(index: Index):
    reader = ShardReader(index, "train")
    before = reader.array(5, "depth")
    sent = pickle.loads(pickle.dumps(reader))
    assert torch.equal(sent.array(5, "depth"), before)


def test_a_missing_buffer_names_the_sample_and_what_it_holds(index: Index):
    with pytest.raises(
        ValueError, match=r"train-00000\.tar, sample \S+ has no buffer 'motion'; it holds color"
    ):
        ShardReader(index, "train").array(0, "motion")


def test_a_truncated_shard_is_found_when_the_index_is_opened(index: Index, tmp_path: Path):
    root = copy(index, tmp_path / "copy")
    shard = root / index.shards[1].file
    shard.write_bytes(shard.read_bytes()[:-2000])
    with pytest.raises(ValueError, match=rf"{shard.name} has \d+ bytes.*says \d+.*copy the shard again"):
        Index.read(root)
    shard.unlink()
    with pytest.raises(ValueError, match=f"{shard.name} is missing"):
        Index.read(root)


def test_a_shard_truncated_afterwards_names_shard_and_sample(index: Index, tmp_path: Path):
    root = copy(index, tmp_path / "copy")
    reader = ShardReader(Index.read(root), "train")
    shard = root / reader.shards[0].file
    shard.write_bytes(shard.read_bytes()[: reader.shards[0].samples[2].offset + 100])
    reader.sample(1)
    with pytest.raises(
        CorruptSampleError, match=r"train-00000\.tar, sample train-00000-00002: the file ends"
    ):
        reader.sample(2)


def test_an_altered_byte_anywhere_in_a_sample_is_found(index: Index, tmp_path: Path):
    record = index.of("train")[0].samples[1]
    for number, place in enumerate((0, 600, record.size // 2, record.size - 1)):
        root = copy(index, tmp_path / str(number))
        flip_byte(root / "train-00000.tar", record.offset + place)
        reader = ShardReader(Index.read(root), "train")
        reader.sample(0)
        with pytest.raises(
            CorruptSampleError, match=f"sample {record.key}: its checksum differs.*on_corrupt"
        ):
            reader.sample(1)


def test_skipping_puts_the_next_sample_in_place_while_training(index: Index, tmp_path: Path):
    root = copy(index, tmp_path / "copy")
    flip_byte(root / "train-00000.tar", index.of("train")[0].samples[1].offset + 700)
    batches = Batches(
        ShardReader(Index.read(root), "train"),
        NAMES,
        True,
        augmentation=Augmentation("none"),
        on_corrupt="skip",
    )
    packed = batches[Order(0, (0, 1))]
    assert [key for _, _, key in packed.samples] == ["train-00000-00000", "train-00000-00002"]
    assert [name.endswith("sample train-00000-00001") for name, _ in packed.corrupt] == [True]


def test_skipping_leaves_the_sample_out_in_evaluation(index: Index, tmp_path: Path):
    root = copy(index, tmp_path / "copy")
    flip_byte(root / "validation-00000.tar", 700)
    batches = Batches(ShardReader(Index.read(root), "validation"), NAMES, True, on_corrupt="skip")
    packed = batches[Order(0, (0, 1))]
    assert len(packed.samples) == 1
    assert not batches[Order(0, (0,))].samples


def test_samples_of_different_size_need_a_batch_of_one(index: Index):
    reader = ShardReader(index, "test")
    reader.sample(1)
    reader._samples[1] = reader.sample(1)._replace(height=16)
    with pytest.raises(ValueError, match="different size in one batch: 48x16, 48x40"):
        Batches(reader, NAMES, True)[Order(0, (0, 1))]


@pytest.mark.parametrize(
    "change", [{"version": 2}, {"version": 3}, {"format": "other"}, {"shards": [{"file": "x"}]}]
)
def test_an_index_of_another_kind_is_refused(index: Index, tmp_path: Path, change: dict):
    record = json.loads((index.root / INDEX).read_text())
    (tmp_path / INDEX).write_text(json.dumps({**record, **change}))
    with pytest.raises(ValueError, match=r"index\.json is not an index of shards that this version reads"):
        Index.read(tmp_path)


@pytest.fixture(scope="module")
def sampled(tmp_path_factory: pytest.TempPathFactory) -> Index:
    folder = tmp_path_factory.mktemp("sampled")
    return prepare(write_stills(folder / "frames", 2, (4,), samples=True), folder / "shards", OPTIONS)


def test_samples_come_back_as_they_were_rendered_with_the_names_of_their_channels(sampled: Index):
    frames = FrameSet(sampled.root.parent / "frames")
    reader = ShardReader(sampled, "train")
    assert reader.array(0, "samples").dtype == torch.float16
    batch = Batches(reader, ("samples", "depth"), False)[Order(0, (0, 3, len(reader) - 1))].unpack()
    assert batch["samples"].shape == (3, 4, len(CHANNELS), 16, 16)
    assert batch["samples"].dtype == torch.float32
    assert batch["sample_channels"] == list(CHANNELS)
    for row, (scene, number) in enumerate(zip(batch["scene"], batch["frame"].tolist(), strict=True)):
        place = int(batch["depth"][row, 0, 0, 0]) - 1
        y, x = divmod(place, 48)
        samples = frames.read(scene, number).samples
        assert samples is not None
        expected = samples.values[:, y : y + 16, x : x + 16].transpose(0, 3, 1, 2)
        assert np.array_equal(batch["samples"][row], expected)


def test_batches_without_samples_name_no_channels(sampled: Index):
    batch = Batches(ShardReader(sampled, "train"), ("color",), False)[Order(0, (0, 1))].unpack()
    assert "sample_channels" not in batch


@pytest.mark.parametrize(
    "augmentation", [Augmentation("dihedral", seed=3), Augmentation("none", permute=True)]
)
def test_samples_change_as_their_reference_does(sampled: Index, augmentation: Augmentation):
    reader = ShardReader(sampled, "train")
    plain = Batches(reader, ("samples", "reference"), False)
    changing = Batches(reader, ("samples", "reference"), False, augmentation=augmentation)
    seen = set()
    for number in range(len(reader)):
        change = augmentation.change(1, number)
        before, after = (batches[Order(1, (number,))].unpack() for batches in (plain, changing))
        expected = np.empty_like(before["samples"][0].numpy())
        changed(before["samples"][0].numpy(), CHANNELS, change, expected)
        assert np.array_equal(after["samples"][0], expected)
        image = turned(reordered(before["reference"][0].numpy(), "reference", change), change.turn)
        assert np.array_equal(after["reference"][0], image)
        seen.add(change[:4])
    assert len(seen) > 1


def test_a_subset_of_the_samples_is_kept_the_same_number_for_a_whole_batch(sampled: Index):
    reader = ShardReader(sampled, "train")
    batches = Batches(reader, ("samples",), False, augmentation=Augmentation("none", samples=(1, 3)))
    counts = set()
    for first in range(len(reader) - 1):
        found = batches[Order(2, (first, first + 1))].unpack()["samples"]
        counts.add(found.shape[1])
        for row, number in enumerate((first, first + 1)):
            held = [sample.tobytes() for sample in reader.array(number, "samples").float().numpy()]
            kept = [held.index(sample.numpy().tobytes()) for sample in found[row]]
            assert len(set(kept)) == found.shape[1]
    assert counts == {1, 2, 3}


def test_different_sample_counts_in_one_batch_are_named_unless_all_have_enough(sampled: Index):
    reader = ShardReader(sampled, "train")
    reader.sample(1)
    stored = reader._samples[1].buffers["samples"]
    fewer = stored._replace(shape=(2, *stored.shape[1:]))
    reader._samples[1] = reader.sample(1)._replace(buffers={**reader.sample(1).buffers, "samples": fewer})
    with pytest.raises(
        ValueError, match=r"\(\w+/frame \d has 4 of .*, \w+/frame \d has 2 of .*--data.sample_counts"
    ):
        Batches(reader, ("samples",), False)[Order(0, (0, 1))]
    some = Batches(reader, ("samples",), False, augmentation=Augmentation("none", samples=(1, 8)))
    assert some[Order(0, (0, 1))].unpack()["samples"].shape[1] <= 2
