import numpy as np
import pytest

from data.exr import read_frame, write_exr, write_frame
from data.frame import Frame, Samples
from data.ingestion import write_record

RNG = np.random.default_rng(3)


def samples(count=3, height=5, width=4):
    shape = (count, height, width)
    return Samples.of(
        {
            "radiance": RNG.gamma(0.5, 2.0, (*shape, 3)).astype(np.float16).astype(np.float32),
            "depth": RNG.uniform(1, 9, (*shape, 1)).astype(np.float32),
            "lens": RNG.uniform(-1, 1, (*shape, 2)).astype(np.float16).astype(np.float32),
        }
    )


def frame(**changes):
    kept = samples()
    return Frame({"color": kept.get("radiance").mean(0)}, "box", 2, samples=kept, **changes)


def test_samples_come_back_from_a_file_bit_for_bit(tmp_path):
    written = frame()
    write_frame(written, tmp_path / "a.exr")
    read = read_frame(tmp_path / "a.exr")
    assert read.samples.channels == written.samples.channels
    assert np.array_equal(read.samples.values, written.samples.values)
    assert np.array_equal(read.samples.get("depth"), written.samples.get("depth"))
    assert set(read.buffers) == {"color"}


def test_writing_chosen_buffers_leaves_samples_out(tmp_path):
    write_frame(frame(), tmp_path / "a.exr", only=["color"])
    assert read_frame(tmp_path / "a.exr").samples is None


def test_a_file_with_samples_alone_has_their_mean_as_colour(tmp_path):
    values = RNG.uniform(0, 2, (2, 6, 7, 3)).astype(np.float32)
    channels = {f"s{s:02d}.radiance.{c}": values[s, ..., i] for s in range(2) for i, c in enumerate("RGB")}
    write_exr(tmp_path / "a.exr", channels)
    assert np.allclose(read_frame(tmp_path / "a.exr").buffers["color"], values.mean(0))


def test_foreign_reflectances_of_samples_get_their_names(tmp_path):
    plane = np.full((4, 4), 0.5, np.float32)
    layers = {"radiance": "RGB", "albedo": "RGB", "specular": "RGB"}
    write_exr(tmp_path / "a.exr", {f"s00.{n}.{c}": plane for n, cs in layers.items() for c in cs})
    assert read_frame(tmp_path / "a.exr").samples.names == ("radiance", "diffuse_albedo", "specular_albedo")


def test_a_sample_without_a_channel_that_others_have_is_refused(tmp_path):
    plane = np.zeros((4, 4), np.float32)
    channels = {f"s{s:02d}.radiance.{c}": plane for s in range(2) for c in "RGB"}
    del channels["s01.radiance.G"]
    write_exr(tmp_path / "a.exr", channels)
    with pytest.raises(ValueError, match=r"sample 1 has no channel radiance\.G"):
        read_frame(tmp_path / "a.exr")


def test_values_of_samples_that_are_not_finite_are_replaced_and_counted(tmp_path):
    plane = np.ones((4, 4), np.float32)
    broken = plane.copy()
    broken[1, 2], broken[3, 3] = np.nan, np.inf
    write_exr(
        tmp_path / "a.exr", {"s00.radiance.R": broken, "s00.radiance.G": plane, "s00.radiance.B": plane}
    )
    read = read_frame(tmp_path / "a.exr")
    assert read.notes["repaired"]["samples"] == 2
    assert read.samples.values[0, 1, 2, 0] == 0
    assert np.isfinite(read.samples.values).all()


def test_samples_of_another_size_than_the_buffers_are_refused():
    with pytest.raises(ValueError, match="samples are 4x5, the buffers 6x6"):
        Frame({"color": np.zeros((6, 6, 3), np.float32)}, "box", 0, samples=samples())


def test_a_record_lists_quantities_view_and_checks(tmp_path):
    notes = {"view": 4, "reference_spp": 64, "checks": {"energy_z": 1.5}}
    record = write_record(frame(exposure=1.0, spp=3, notes=notes), tmp_path)
    assert record.samples == ["radiance", "depth", "lens"]
    assert (record.view, record.reference_spp, record.checks) == (4, 64, {"energy_z": 1.5})
