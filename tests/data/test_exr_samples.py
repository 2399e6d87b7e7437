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


def broken_file(path):
    """Three samples: one NaN at (1, 2), one infinite at (3, 3), all NaN at (0, 0), an infinite depth."""
    values = RNG.uniform(0.5, 2, (3, 4, 4, 4)).astype(np.float16).astype(np.float32)
    values[0, 1, 2, 1], values[2, 3, 3, 0], values[:, 0, 0, 2] = np.nan, np.inf, np.nan
    values[1, 2, 2, 3] = np.inf
    names = ("radiance.R", "radiance.G", "radiance.B", "depth.Z")
    write_exr(path, {f"s{s:02d}.{n}": values[s, ..., i] for s in range(3) for i, n in enumerate(names)})
    return values


def test_samples_that_are_not_finite_are_marked_as_a_whole_and_counted(tmp_path):
    values = broken_file(tmp_path / "a.exr")
    read = read_frame(tmp_path / "a.exr")
    gone = np.isnan(read.samples.values)
    expected = ~np.isfinite(values[..., :3]).all(-1)
    assert np.array_equal(gone, np.broadcast_to(expected[..., None], gone.shape))
    assert read.notes["dropped"] == [5, 3, 1]
    assert read.notes["repaired"] == {"samples": 1, "color": 1}
    assert read.samples.get("depth")[1, 2, 2] == 0  # an infinite distance: the ray left the scene
    kept = ~gone
    assert np.array_equal(read.samples.values[kept][:40], np.where(np.isinf(values), 0, values)[kept][:40])


def test_colour_is_the_mean_of_the_samples_that_count_and_of_the_neighbours_where_none_does(tmp_path):
    values = broken_file(tmp_path / "a.exr").astype(np.float64)
    color = read_frame(tmp_path / "a.exr").buffers["color"]
    assert np.allclose(color[1, 2], values[1:, 1, 2, :3].mean(0))
    assert np.allclose(color[3, 3], values[:2, 3, 3, :3].mean(0))
    assert np.allclose(color[2, 2], values[:, 2, 2, :3].mean(0))
    assert np.allclose(color[0, 0], (color[0, 1] + color[1, 0] + color[1, 1]) / 3)


def test_marked_samples_come_back_from_a_file_and_others_that_are_not_finite_are_refused(tmp_path):
    broken_file(tmp_path / "a.exr")
    first = read_frame(tmp_path / "a.exr")
    write_frame(first, tmp_path / "b.exr")
    again = read_frame(tmp_path / "b.exr")
    assert np.array_equal(again.samples.values, first.samples.values, equal_nan=True)
    assert again.notes["dropped"] == [5, 3, 1]
    first.samples.values[1, 1, 1, 2] = np.nan
    with pytest.raises(ValueError, match=r"channel radiance\.B holds NaN or Inf where other channels"):
        write_frame(first, tmp_path / "b.exr")


def test_names_and_letters_of_others_are_understood(tmp_path):
    plane = np.full((4, 4), 0.5, np.float32)
    layers = {
        "color": "RGB",
        "diffuse": "RGB",
        "specular": "RGB",
        "normal": "RGB",
        "depth": "R",
        "lens": "UV",
    }
    channels = {f"sample_{s}.{n}.{c}": plane * s for s in range(2) for n, cs in layers.items() for c in cs}
    write_exr(
        tmp_path / "a.exr",
        channels | {"sample_0.shadow.R": plane, "sample_0.time": plane} | {"sample_1.time": plane},
    )
    read = read_frame(tmp_path / "a.exr")
    assert read.samples.names == ("radiance", "diffuse", "specular", "normal", "depth", "lens", "time")
    assert read.samples.count == 2
    assert read.samples.get("depth")[1].mean() == 0.5
    assert read.notes["ignored"] == ["sample_0.shadow.R"]


def test_samples_of_unknown_quantities_are_refused_with_what_is_known(tmp_path):
    write_exr(tmp_path / "a.exr", {"s00.shadow.R": np.zeros((4, 4), np.float32)})
    with pytest.raises(ValueError, match=r"a\.exr: samples of each pixel .* named like s00\.radiance\.R"):
        read_frame(tmp_path / "a.exr")


def test_the_lens_comes_back_from_a_file_and_impossible_ones_are_refused(tmp_path):
    write_frame(frame(thin_lens=(0.1, 2.5, 40.0)), tmp_path / "a.exr")
    assert read_frame(tmp_path / "a.exr").thin_lens == (0.1, 2.5, 40.0)
    with pytest.raises(ValueError, match=r"box/frame 2: thin_lens is .*expected numbers >= 0"):
        frame(thin_lens=(-0.1, 2.5, 40.0))


def test_samples_of_another_size_than_the_buffers_are_refused():
    with pytest.raises(ValueError, match="samples are 4x5, the buffers 6x6"):
        Frame({"color": np.zeros((6, 6, 3), np.float32)}, "box", 0, samples=samples())


def test_a_record_lists_quantities_view_and_checks(tmp_path):
    notes = {"view": 4, "reference_spp": 64, "checks": {"energy_z": 1.5}}
    record = write_record(frame(exposure=1.0, spp=3, notes=notes), tmp_path)
    assert record.samples == ["radiance", "depth", "lens"]
    assert (record.view, record.reference_spp, record.checks) == (4, 64, {"energy_z": 1.5})
