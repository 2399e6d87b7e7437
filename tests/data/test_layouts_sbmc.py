import pickle
import resource
import struct
import subprocess
import sys
import tracemalloc

import lz4.frame
import numpy as np
import pytest

from data.frames import FrameSet
from data.layouts import likeliest, sbmc
from data.layouts.sbmc_tile import read_header, read_tile
from data.manifest import load_manifest
from tests.data import layout_samples
from tests.data.layout_samples import (
    SBMC_HEADER,
    sbmc_arrays,
    sbmc_blocks,
    sbmc_header,
    sbmc_tile,
)
from trainer.cli import main

ORDER = {
    "offset": (0, 2),
    "time": (4, 5),
    "diffuse": (5, 8),
    "specular": (8, 11),
    "first_normal": (11, 14),
    "normal": (14, 17),
    "visibility": (19, 20),
    "hit": (20, 21),
    "first_albedo": (21, 24),
    "diffuse_albedo": (24, 27),
    "path_probability": (27, 51),
    "light_direction": (51, 63),
}


def last(array):
    return np.moveaxis(array, -3, -1)


@pytest.mark.parametrize("version", [20181212, 20190401])
def test_every_plane_of_a_tile_has_its_place(tmp_path, version):
    pixels, floats, flags = sbmc_tile(tmp_path / "s" / "t.bin", 1, version=version)
    frame = next(sbmc.frames(tmp_path))
    assert (frame.scene, frame.spp, frame.notes["reference_spp"]) == ("s", 3, 4096)
    for name, (first, end) in ORDER.items():
        assert np.array_equal(frame.samples.get(name), last(floats[:, first:end])), name
    assert np.array_equal(frame.samples.get("radiance"), last(floats[:, 5:8] + floats[:, 8:11]))
    assert np.array_equal(frame.buffers["reference"], last(pixels[0:3] + pixels[3:6]))
    assert np.array_equal(frame.buffers["reference_diffuse"], last(pixels[0:3]))
    bounce = frame.samples.get("bounce")
    for bit in range(5):
        for vertex in range(6):
            assert np.array_equal(bounce[..., bit * 6 + vertex], (flags[:, vertex] >> bit) & 1)


def test_lens_positions_are_in_the_unit_disc_and_misses_have_no_depth(tmp_path):
    _, floats, _ = sbmc_tile(tmp_path / "s" / "t.bin")
    frame = next(sbmc.frames(tmp_path))
    assert np.allclose(frame.samples.get("lens"), last(floats[:, 2:4]) / 0.25, atol=1e-6)
    depth = frame.samples.get("depth")
    assert (depth[:, 0, 0] == 0).all()
    assert np.array_equal(depth[:, 1:], last(floats[:, 18:19])[:, 1:])
    assert frame.buffers["depth"][0, 0] == 0
    assert "clipped" not in frame.notes
    assert frame.notes["normalised"] == ["depth", "first_depth"]
    assert "camera space" in frame.notes["assumed"]["normal"]


def test_images_are_means_and_variances_of_the_mean_over_the_samples(tmp_path):
    _, floats, _ = sbmc_tile(tmp_path / "s" / "t.bin")
    frame = next(sbmc.frames(tmp_path))
    radiance = last(floats[:, 5:8] + floats[:, 8:11]).astype(np.float64)
    assert np.allclose(frame.buffers["color"], radiance.mean(0), atol=1e-6)
    assert np.allclose(frame.buffers["color_variance"], radiance.var(0, ddof=1) / 3, atol=1e-6)
    assert np.allclose(frame.buffers["normal"], last(floats[:, 14:17]).mean(0), atol=1e-6)
    assert np.allclose(frame.buffers["depth"][1:], last(floats[:, 18:19]).mean(0)[1:], atol=1e-6)


def test_lens_and_scene_are_in_the_notes_and_a_pinhole_has_no_focus(tmp_path):
    sbmc_tile(tmp_path / "a" / "t.bin")
    sbmc_tile(tmp_path / "b" / "t.bin", aperture_radius=0.0, focus_distance=float("nan"))
    thick, thin = list(sbmc.frames(tmp_path))
    assert thick.notes["camera"] == {
        "focus_distance": 0.125,
        "aperture_radius": 0.25,
        "fov": 45.0,
        "scene_radius": 12.5,
    }
    assert (thin.notes["camera"]["focus_distance"], thin.notes["camera"]["aperture_radius"]) == (0, 0)


def test_tiles_that_cover_an_image_are_joined_by_block_position(tmp_path):
    parts = {}
    for x in (0, 8):
        for y in (0, 8):
            path = tmp_path / "s" / f"{x:04d}_{y:04d}.bin"
            parts[x, y] = sbmc_tile(path, x + 2 * y, image_height=16, block_x=x, block_y=y)
    scene = sbmc.describe(tmp_path)[0]
    assert scene.indices == (0,)
    frame = scene.read(0)
    assert (frame.width, frame.height) == (16, 16)
    for (x, y), (pixels, floats, _) in parts.items():
        place = (slice(y, y + 8), slice(x, x + 8))
        assert np.array_equal(frame.buffers["reference"][place], last(pixels[0:3] + pixels[3:6]))
        assert np.array_equal(frame.samples.get("time")[:, *place], last(floats[:, 4:5]))


def test_an_incomplete_image_is_a_frame_per_tile(tmp_path):
    for x in (8, 0, 16):
        sbmc_tile(tmp_path / "s" / f"{x}.bin", x, image_width=32, block_x=x)
    scene = sbmc.describe(tmp_path)[0]
    assert scene.indices == (0, 1, 2)
    assert [scene.read(i).notes["block"] for i in scene.indices] == [[0, 0], [16, 0], [8, 0]]


def test_an_image_beyond_the_limit_stays_tiles(tmp_path, monkeypatch):
    source = layout_samples.sbmc(tmp_path)
    monkeypatch.setattr(sbmc, "MAX_FRAME_BYTES", 1000)
    assert sbmc.describe(source)[0].indices == (0, 1)


def test_a_list_chooses_tiles_of_its_folder(tmp_path):
    layout_samples.sbmc(tmp_path)
    path = tmp_path / "list.txt"
    path.write_text("kitchen/0008_0000.bin\n\ntrain/spheres/0008_0000.bin\n")
    scenes = sbmc.describe(path)
    assert [(s.name, s.indices) for s in scenes] == [("kitchen", (1,)), ("train-spheres", (0,))]
    assert scenes[0].read(1).notes["block"] == [8, 0]
    assert sbmc.likeness(path) == 1


@pytest.mark.parametrize("entry", ["../other/a.bin", "/etc/a.bin", "kitchen/../../a.bin"])
def test_a_list_may_not_leave_its_folder(tmp_path, entry):
    (tmp_path / "list.txt").write_text(f"{entry}\n")
    with pytest.raises(ValueError, match=r"list\.txt: .* is outside the list's folder"):
        sbmc.describe(tmp_path / "list.txt")


def test_a_list_of_missing_tiles_names_the_first(tmp_path):
    (tmp_path / "list.txt").write_text("kitchen/a.bin\n")
    with pytest.raises(FileNotFoundError, match=r"list\.txt lists .*a\.bin"):
        sbmc.describe(tmp_path / "list.txt")


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("version", 20180101),
        ("tile_size", -8),
        ("tile_size", 1 << 20),
        ("image_width", 0),
        ("image_height", 1 << 30),
        ("sample_count", -1),
        ("sample_count", 1 << 30),
        ("gt_sample_count", -4),
        ("sample_features", 29),
        ("pixel_features", 1 << 30),
        ("path_depth", 5),
        ("focus_distance", float("nan")),
        ("aperture_radius", -0.5),
        ("fov", float("inf")),
        ("scene_radius", -1.0),
        ("block_x", -8),
        ("block_y", 1 << 30),
    ],
)
def test_an_implausible_header_names_file_and_field(tmp_path, field, value):
    path = tmp_path / "s" / "t.bin"
    path.parent.mkdir()
    path.write_bytes(sbmc_header({**SBMC_HEADER, field: value}) + bytes(1000))
    with pytest.raises(ValueError, match=rf"t\.bin: {field} is {value}"):
        sbmc.describe(tmp_path)


def test_tiles_outside_their_image_or_of_different_kinds_are_named(tmp_path):
    sbmc_tile(tmp_path / "s" / "a.bin", block_x=9)
    with pytest.raises(
        ValueError, match=r"a\.bin: the tile of 8 pixels at block_x 9, block_y 0 is not inside"
    ):
        sbmc.describe(tmp_path)
    sbmc_tile(tmp_path / "s" / "a.bin")
    sbmc_tile(tmp_path / "s" / "b.bin", block_x=8, sample_count=2)
    with pytest.raises(ValueError, match=r"b\.bin: sample_count is 2, but 3 in a\.bin"):
        sbmc.describe(tmp_path)
    sbmc_tile(tmp_path / "s" / "b.bin")
    with pytest.raises(ValueError, match=r"b\.bin: block_x, block_y \(0, 0\) is also in a\.bin"):
        sbmc.describe(tmp_path)


def hostile(path, blocks, **changes):
    header = {**SBMC_HEADER, **changes}
    path.write_bytes(sbmc_header(header) + b"".join(blocks))
    return path


def test_a_truncated_tile_is_named_with_the_block(tmp_path):
    path = tmp_path / "t.bin"
    sbmc_tile(path)
    whole = path.read_bytes()
    for cut, what in ((40, "header"), (62, "pixel data"), (500, "pixel data"), (-10, "sample 2")):
        path.write_bytes(whole[:cut])
        with pytest.raises(ValueError, match=rf"t\.bin: .*({what}|cannot hold)"):
            read_tile(path)


def test_a_block_with_truncated_or_damaged_content_is_named(tmp_path):
    blocks = sbmc_blocks(*sbmc_arrays(1, SBMC_HEADER))
    short = blocks[1][4:-100]
    path = hostile(tmp_path / "t.bin", [blocks[0], struct.pack("<i", len(short)) + short, *blocks[2:]])
    with pytest.raises(ValueError, match=r"t\.bin: the block of sample 0"):
        read_tile(path)
    noise = struct.pack("<i", 400) + b"\xab" * 400
    with pytest.raises(ValueError, match=r"t\.bin: the block of the pixel data is damaged"):
        read_tile(hostile(path, [noise, *blocks[1:]]))


@pytest.mark.parametrize("length", [-1, 0, -(1 << 31), (1 << 31) - 1])
def test_an_implausible_length_of_a_block_is_refused(tmp_path, length):
    blocks = sbmc_blocks(*sbmc_arrays(1, SBMC_HEADER))
    path = hostile(tmp_path / "t.bin", [struct.pack("<i", length) + blocks[0][4:], *blocks[1:]])
    with pytest.raises(ValueError, match=rf"the block of the pixel data has {length} bytes"):
        read_tile(path)


@pytest.mark.parametrize("extra", [-4, 4])
def test_a_block_of_another_size_than_the_header_says_is_refused(tmp_path, extra):
    pixels, floats, flags = sbmc_arrays(1, SBMC_HEADER)
    content = pixels.tobytes()
    frame = lz4.frame.compress(content[:extra] if extra < 0 else content + bytes(extra))
    blocks = [struct.pack("<i", len(frame)) + frame, *sbmc_blocks(pixels, floats, flags)[1:]]
    with pytest.raises(ValueError, match=r"the block of the pixel data has .* bytes, expected 7680"):
        read_tile(hostile(tmp_path / "t.bin", blocks))


def bomb(path, store_size=True):
    """Write a tile whose first block decompresses to 2 GiB."""
    context = lz4.frame.create_compression_context()
    parts = [lz4.frame.compress_begin(context, source_size=1 << 31 if store_size else 0)]
    megabyte = bytes(1 << 20)
    parts += [lz4.frame.compress_chunk(context, megabyte) for _ in range(1 << 11)]
    parts += [lz4.frame.compress_flush(context)]
    frame = b"".join(parts)
    return hostile(path, [struct.pack("<i", len(frame)) + frame])


@pytest.mark.parametrize("store_size", [True, False])
def test_a_block_that_decompresses_to_gigabytes_takes_no_memory(tmp_path, store_size):
    path = bomb(tmp_path / "t.bin", store_size)
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=r"the block of the pixel data has more bytes, expected 7680"):
            read_tile(path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 64 << 20


def test_a_process_with_little_memory_survives_hostile_tiles(tmp_path):
    bomb(tmp_path / "bomb.bin")
    blocks = sbmc_blocks(*sbmc_arrays(1, SBMC_HEADER))
    hostile(tmp_path / "many.bin", blocks, sample_count=1 << 14)
    hostile(tmp_path / "large.bin", blocks, tile_size=4096, image_width=4096, image_height=4096)
    code = (
        "import resource, sys; from pathlib import Path; import lz4.frame, data.layouts.sbmc_tile as t\n"
        "used = int(open('/proc/self/statm').read().split()[0]) * resource.getpagesize()\n"
        "resource.setrlimit(resource.RLIMIT_AS, (used + (256 << 20),) * 2)\n"
        "for path in sys.argv[1:]:\n"
        "    try: t.read_tile(Path(path))\n"
        "    except ValueError as error: print(error)\n"
    )
    paths = [str(tmp_path / name) for name in ("bomb.bin", "many.bin", "large.bin")]
    done = subprocess.run([sys.executable, "-c", code, *paths], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) == 3
    assert all(path in line for path, line in zip(paths, lines, strict=True))
    assert resource.getrlimit(resource.RLIMIT_AS)[0] != 0


def test_a_tile_has_the_lens_of_its_camera_in_its_own_units(tmp_path):
    sbmc_tile(tmp_path / "s" / "t.bin")
    assert next(sbmc.frames(tmp_path)).thin_lens == (0.25, 0.125, 45.0)


def test_broken_and_impossible_values_of_samples_are_counted(tmp_path):
    pixels, floats, flags = sbmc_arrays(1, SBMC_HEADER)
    floats[0, 5, 3, 3] = np.nan
    floats[1, 8, 4, 4] = -3
    pixels[0, 2, 2] = np.inf
    (tmp_path / "s").mkdir()
    hostile(tmp_path / "s" / "t.bin", sbmc_blocks(pixels, floats, flags))
    frame = next(sbmc.frames(tmp_path))
    assert frame.notes["dropped"] == [1, 1, 0]
    assert frame.notes["repaired"] == {"reference": 1, "reference_diffuse": 1}
    assert frame.notes["clipped"]["samples.specular"] == 1
    gone = np.isnan(frame.samples.values)
    assert gone[0, 3, 3].all()
    assert gone.sum() == gone[0, 3, 3].sum()
    others = frame.samples.get("radiance")[1:, 3, 3].mean(0)
    assert np.allclose(frame.buffers["color"][3, 3], others)
    assert all(np.isfinite(b).all() for b in frame.buffers.values())


def test_without_lz4_the_error_names_the_extra(tmp_path, monkeypatch):
    sbmc_tile(tmp_path / "s" / "t.bin")
    assert read_header(tmp_path / "s" / "t.bin").tile_size == 8
    monkeypatch.setitem(sys.modules, "lz4.frame", None)
    with pytest.raises(ValueError, match=r"penumbra-denoise\[layouts\]"):
        next(sbmc.frames(tmp_path))


def test_a_folder_without_tiles_says_what_is_expected(tmp_path):
    (tmp_path / "a.exr").write_bytes(b"x")
    with pytest.raises(ValueError, match=r"no tile of the layout `sbmc` found, expected <scene>/\*\.bin"):
        sbmc.describe(tmp_path)
    with pytest.raises(ValueError, match=r"a\.exr is a file, expected a folder of scenes or a \.txt list"):
        sbmc.describe(tmp_path / "a.exr")


def test_other_binary_files_are_not_taken_for_tiles(tmp_path):
    (tmp_path / "weights.bin").write_bytes(bytes(100))
    assert sbmc.likeness(tmp_path) == 0


def test_the_miniature_is_recognised_pickled_and_ingested(tmp_path, monkeypatch):
    source = layout_samples.sbmc(tmp_path / "source")
    assert likeliest(source) == "sbmc"
    scenes = pickle.loads(pickle.dumps(sbmc.describe(source)))
    assert [(s.name, s.indices) for s in scenes] == [("kitchen", (0,)), ("train-spheres", (0,))]
    original = scenes[0].read(0)
    output = tmp_path / "set"
    arguments = ["trainer", "ingest", source, "--layout", "sbmc", "--output", output, "--processes", 1]
    monkeypatch.setattr("sys.argv", [str(a) for a in arguments])
    assert main() == 0
    record = load_manifest(output).scenes["kitchen"].frames[0]
    assert (record.spp, record.reference_spp, record.width) == (3, 4096, 16)
    stored = FrameSet(output).read("kitchen", 0)
    assert stored.samples.names == original.samples.names
    assert np.allclose(stored.samples.values, original.samples.values, rtol=1e-3, atol=1e-6)
