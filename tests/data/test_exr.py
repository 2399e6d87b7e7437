import errno
import os
import resource
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image as Picture

from data.camera import Camera
from data.exr import RadianceWarning, looks_encoded, read_exr, read_frame, write_exr, write_frame
from data.exr_image import exr_channels
from data.frame import Frame
from data.repair import repair
from tests.data.miniature import sample_crop, write_rgb

RNG = np.random.default_rng(0)


def noise(height=20, width=24, channels=3):
    return RNG.gamma(0.5, 2.0, (height, width, channels)).astype(np.float32)


def window(left, top, right, bottom):
    return (np.array([left, top], np.int32), np.array([right, bottom], np.int32))


def raw(path, header, channels):
    OpenEXR.File({"type": OpenEXR.scanlineimage, **header}, channels).write(str(path))
    return path


def test_half_and_float_channels_round_trip_bit_for_bit(tmp_path):
    half, single = noise()[..., 0].astype(np.float16), noise()[..., 1]
    write_exr(tmp_path / "a.exr", {"color.R": half, "depth.Z": single}, {"owner": "me", "count": 3})
    image = read_exr(tmp_path / "a.exr")
    assert np.array_equal(image.channels["color.R"], half.astype(np.float32))
    assert np.array_equal(image.channels["depth.Z"], single)
    assert image.precision == {"color.R": "half", "depth.Z": "float"}
    assert (image.attributes["owner"], image.attributes["count"], image.size) == ("me", 3, (20, 24))


def test_writing_does_not_modify_the_given_channels(tmp_path):
    channels = {"Z": noise()[..., 0]}
    write_exr(tmp_path / "a.exr", channels)
    assert isinstance(channels["Z"], np.ndarray)


def test_a_small_data_window_is_placed_into_the_display_window(tmp_path):
    pixels = noise(4, 6)[..., 0].copy() + 1
    header = {"dataWindow": window(12, 7, 17, 10), "displayWindow": window(10, 5, 29, 14)}
    image = read_exr(raw(tmp_path / "a.exr", header, {"Z": pixels}))
    assert image.size == (10, 20)
    assert np.array_equal(image.channels["Z"][2:6, 2:8], pixels)
    assert image.channels["Z"].sum() == pytest.approx(pixels.sum(), rel=1e-6)
    assert (~image.outside["Z"]).sum() == 24


def test_a_large_data_window_is_cropped_to_the_display_window(tmp_path):
    pixels = noise(20, 20)[..., 0].copy()
    header = {"dataWindow": window(-5, -5, 14, 14), "displayWindow": window(0, 0, 9, 9)}
    image = read_exr(raw(tmp_path / "a.exr", header, {"Z": pixels}))
    assert np.array_equal(image.channels["Z"], pixels[5:15, 5:15])
    assert not image.outside


def test_pixels_outside_the_data_window_are_no_hit_in_a_frame(tmp_path):
    header = {"dataWindow": window(0, 0, 3, 3), "displayWindow": window(0, 0, 7, 3)}
    channels = {f"albedo.{c}": np.full((4, 4), 0.5, np.float32) for c in "RGB"}
    frame = read_frame(raw(tmp_path / "a.exr", header, channels))
    assert (frame.buffers["albedo"][:, 4:] == 1).all()
    assert frame.notes["outside_data_window"] == {"albedo": 16}


def test_parts_are_joined_and_bare_channels_take_the_name_of_their_part(tmp_path):
    color, depth = noise(), noise()[..., 0].copy()
    parts = [
        OpenEXR.Part({}, {c: np.ascontiguousarray(color[..., i]) for i, c in enumerate("RGB")}, name="color"),
        OpenEXR.Part({}, {"Z": depth}, name="depth"),
    ]
    OpenEXR.File(parts).write(str(tmp_path / "parts.exr"))
    frame = read_frame(tmp_path / "parts.exr")
    assert np.array_equal(frame.buffers["color"], color)
    assert np.array_equal(frame.buffers["depth"][..., 0], depth)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.exr"):
        read_exr(tmp_path / "none.exr")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "the file is empty"),
        (b"hello, this is text", "not an OpenEXR file"),
        (b"\x76\x2f\x31\x01\x02", "truncated"),
        (b"\x76\x2f\x31\x01" + (0x802).to_bytes(4, "little") + b"x" * 50, "deep EXR images"),
    ],
)
def test_a_file_that_is_no_image_is_refused_by_name(tmp_path, content, message):
    (tmp_path / "bad.exr").write_bytes(content)
    with pytest.raises(ValueError, match=rf"bad\.exr: .*{message}|bad\.exr: {message}"):
        read_exr(tmp_path / "bad.exr")


def test_a_folder_is_refused(tmp_path):
    with pytest.raises(ValueError, match="is a folder, expected an EXR file"):
        read_exr(tmp_path)


@pytest.mark.parametrize("fraction", [0.02, 0.3, 0.7, 0.999])
def test_a_truncated_file_is_refused_wherever_it_ends(tmp_path, fraction):
    write_exr(tmp_path / "a.exr", {"Z": noise(80, 60)[..., 0]})
    content = (tmp_path / "a.exr").read_bytes()
    (tmp_path / "a.exr").write_bytes(content[: int(len(content) * fraction)])
    with pytest.raises(ValueError, match=r"a\.exr: .*truncated"):
        read_exr(tmp_path / "a.exr")


def test_damaged_pixels_are_refused_and_nothing_is_printed_to_standard_output(tmp_path, capfd):
    smooth = np.repeat(np.arange(64, dtype=np.float32)[:, None], 64, 1)
    write_exr(tmp_path / "a.exr", {"Z": smooth})
    content = bytearray((tmp_path / "a.exr").read_bytes())
    content[-100:-20] = bytes(80)
    (tmp_path / "a.exr").write_bytes(content)
    with pytest.raises(ValueError, match=r"a\.exr: truncated or damaged"):
        read_exr(tmp_path / "a.exr")
    assert capfd.readouterr().out == ""


@pytest.mark.parametrize("kind", ["PNG", "JPEG", "TIFF"])
def test_eight_bit_formats_are_refused_whatever_they_are_called(tmp_path, kind):
    Picture.fromarray(np.zeros((8, 8, 3), np.uint8)).save(tmp_path / "color.exr", format=kind)
    with pytest.raises(ValueError, match=f"is a {kind} file: 8-bit image, radiance needed"):
        read_frame(tmp_path / "color.exr")


def full_frame():
    frame = sample_crop("classroom", 3)
    frame.notes["accumulation"] = "position"
    return frame


def test_a_frame_round_trips_with_everything_that_it_carries(tmp_path):
    frame = full_frame()
    frame.camera = Camera(frame.camera.world_to_pixel, frame.camera.origin, (0.25, 0.5))
    precision = write_frame(frame, tmp_path / "x.exr", ["color", "albedo", "normal", "position", "depth"])
    copy = read_frame(tmp_path / "x.exr")
    assert precision["color"] == "half"
    assert precision["depth"] == "float"
    for name in precision:
        assert np.array_equal(copy.buffers[name], frame.buffers[name]), name
    assert np.array_equal(copy.camera.world_to_pixel, frame.camera.world_to_pixel)
    assert np.array_equal(copy.camera.centre(), frame.camera.centre())
    assert copy.camera.offset == (0.25, 0.5)
    assert (copy.scene, copy.index, copy.exposure, copy.spp) == ("classroom", 3, frame.exposure, 1)
    assert copy.accumulated is False
    assert copy.notes["accumulation"] == "position"


def test_an_accumulated_frame_says_so_after_reading(tmp_path):
    frame = full_frame()
    frame.accumulated = True
    write_frame(frame, tmp_path / "x.exr", ["irradiance"])
    assert read_frame(tmp_path / "x.exr").accumulated is True


def test_values_over_half_precision_are_stored_in_float(tmp_path):
    bright = np.full((4, 4, 3), 70000, np.float32)
    assert write_frame(Frame({"color": bright}, "s", 0), tmp_path / "x.exr") == {"color": "float"}
    assert (read_frame(tmp_path / "x.exr").buffers["color"] == 70000).all()


def test_very_dark_images_are_stored_in_float(tmp_path):
    dark = noise() * np.float32(1e-6)
    write_frame(Frame({"color": dark}, "s", 0), tmp_path / "x.exr")
    assert np.array_equal(read_frame(tmp_path / "x.exr").buffers["color"], dark)


def test_positions_are_stored_in_half_only_without_loss(tmp_path):
    exact, general = np.full((4, 4, 3), 0.5, np.float32), noise(4, 4)
    assert write_frame(Frame({"position": exact}, "s", 0), tmp_path / "x.exr") == {"position": "half"}
    assert write_frame(Frame({"position": general}, "s", 0), tmp_path / "x.exr") == {"position": "float"}


def test_a_missing_or_non_finite_buffer_is_not_written(tmp_path):
    frame = Frame({"color": noise()}, "s", 0)
    with pytest.raises(ValueError, match="missing buffer normal"):
        write_frame(frame, tmp_path / "x.exr", ["normal"])
    frame.buffers["color"][0, 0, 0] = np.nan
    with pytest.raises(ValueError, match="s/frame 0: buffer 'color' holds NaN or Inf"):
        write_frame(frame, tmp_path / "x.exr")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("stem", "name"),
    [
        ("color12", "color"),
        ("albedo0", "albedo"),
        ("shading_normal3", "normal"),
        ("world_position59", "position"),
    ],
)
def test_plain_rgb_takes_its_meaning_from_the_file_name(tmp_path, stem, name):
    write_rgb(tmp_path / f"{stem}.exr", noise())
    frame = read_frame(tmp_path / f"{stem}.exr")
    assert list(frame.buffers) == [name]
    assert frame.index == int("".join(c for c in stem if c.isdigit()))


def test_plain_rgb_can_be_named_by_the_caller(tmp_path):
    write_rgb(tmp_path / "color0.exr", noise())
    assert list(read_frame(tmp_path / "color0.exr", only="irradiance").buffers) == ["irradiance"]


def layered(path, **layers):
    letters = {1: "Z", 2: "XY", 3: "RGB"}
    channels = {
        f"{n}.{c}": np.ascontiguousarray(a[..., i])
        for n, a in layers.items()
        for i, c in enumerate(letters[a.shape[2]])
    }
    write_exr(path, channels)
    return path


def test_halves_and_variances_of_other_renderers_are_understood(tmp_path):
    path = layered(tmp_path / "a.exr", colorA=noise(), colorB=noise(), colorVariance=noise(), normal=noise())
    assert set(read_frame(path).buffers) == {"color_a", "color_b", "color_variance", "normal"}


def test_a_foreign_albedo_with_zeros_is_reflectance_and_not_a_divisor(tmp_path):
    zeros = noise()
    zeros[0, 0] = 0
    assert "diffuse_albedo" in read_frame(layered(tmp_path / "a.exr", color=noise(), albedo=zeros)).buffers
    positive = layered(tmp_path / "b.exr", color=noise(), albedo=noise() + 0.1)
    assert "albedo" in read_frame(positive).buffers


def test_channels_without_a_meaning_are_listed_and_left_out(tmp_path):
    frame = read_frame(layered(tmp_path / "a.exr", color=noise(), crypto=noise()))
    assert list(frame.buffers) == ["color"]
    assert frame.notes["ignored"] == ["crypto.B", "crypto.G", "crypto.R"]


def test_an_unknown_naming_lists_what_was_found_and_what_is_known(tmp_path):
    path = layered(tmp_path / "a.exr", beauty=noise(), foo=noise(channels=1))
    with pytest.raises(
        ValueError, match=r"a\.exr: unknown channel naming: beauty\.B.*foo\.Z.*Known: <buffer>\.R"
    ):
        read_frame(path)


def test_an_incomplete_buffer_is_named(tmp_path):
    write_exr(tmp_path / "a.exr", {"color.R": noise()[..., 0], "color.G": noise()[..., 1]})
    with pytest.raises(
        ValueError, match=r"buffer 'color' needs the channels RGB, found only color\.G, color\.R"
    ):
        read_frame(tmp_path / "a.exr")


def test_a_damaged_header_of_ours_is_refused(tmp_path):
    channels = {f"color.{c}": noise()[..., 0] for c in "RGB"}
    write_exr(tmp_path / "a.exr", channels, {"penumbra": "1", "penumbra.camera": "{nonsense"})
    with pytest.raises(ValueError, match=r"a\.exr: cannot understand the file's header"):
        read_frame(tmp_path / "a.exr")


def test_broken_radiance_becomes_the_mean_of_its_finite_neighbours(tmp_path):
    color = noise(6, 6)
    expected = color.copy()
    color[2, 2, 1] = np.nan
    color[0, 0] = np.inf
    expected[2, 2] = np.delete(color[1:4, 1:4].reshape(9, 3), 4, 0).mean(0)
    expected[0, 0] = (color[0, 1] + color[1, 0] + color[1, 1]) / 3
    write_rgb(tmp_path / "color0.exr", color)
    frame = read_frame(tmp_path / "color0.exr")
    assert np.allclose(frame.buffers["color"], expected, rtol=1e-6)
    assert frame.notes["repaired"] == {"color": 2}


def test_radiance_without_finite_neighbours_becomes_black():
    repaired, counts = repair({"color": np.full((3, 3, 3), np.nan, np.float32)})
    assert (repaired["color"] == 0).all()
    assert counts == {"color": 9}


def test_broken_features_become_no_hit():
    albedo, normal = noise(4, 4), noise(4, 4)
    albedo[1, 1, 0] = normal[2, 2, 2] = -np.inf
    repaired, counts = repair({"albedo": albedo, "normal": normal})
    assert repaired["albedo"][1, 1].tolist() == [1, 1, 1]
    assert repaired["normal"][2, 2].tolist() == [0, 0, 0]
    assert counts == {"albedo": 1, "normal": 1}


def test_finite_buffers_pass_through_repair_untouched():
    color = noise()
    repaired, counts = repair({"color": color})
    assert repaired["color"] is color
    assert counts == {}


def srgb_to_linear(code):
    return np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)


@pytest.mark.parametrize("decode", [lambda v: v, srgb_to_linear, lambda v: v**2.2])
def test_an_image_from_eight_bits_is_reported(tmp_path, decode):
    picture = decode(RNG.integers(0, 256, (32, 32, 3)) / 255).astype(np.float16)
    write_exr(tmp_path / "color0.exr", {c: picture[..., i].copy() for i, c in enumerate("RGB")})
    with pytest.warns(RadianceWarning, match=r"color0\.exr: buffer 'color' has only \d+ levels.*8-bit"):
        read_frame(tmp_path / "color0.exr")


def test_a_clipped_image_is_reported(tmp_path):
    write_rgb(tmp_path / "color0.exr", np.minimum(noise() * 2, 1))
    with pytest.warns(RadianceWarning, match="clipped at 1"):
        read_frame(tmp_path / "color0.exr")


def test_real_radiance_albedo_and_constant_images_are_not_reported():
    frame = sample_crop("cbox-glossy", 0)
    assert looks_encoded(frame.buffers["color"]) is None
    assert looks_encoded(np.clip(frame.buffers["reference"], 0, 0.5)) is None
    assert looks_encoded(np.full((32, 32, 3), 0.5, np.float32)) is None
    assert looks_encoded(noise() / 100) is None


def test_writing_where_a_file_is_in_the_way_of_a_folder_fails_clearly(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError):
        write_exr(tmp_path / "file" / "a.exr", {"Z": noise()[..., 0]})


def test_a_missing_permission_is_a_clear_error_and_leaves_nothing(tmp_path, monkeypatch):
    def denied(*_):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    monkeypatch.setattr("data.exr_image.os.replace", denied)
    with pytest.raises(OSError, match=r"a\.exr: cannot write the file: Permission denied; check permissions"):
        write_exr(tmp_path / "a.exr", {"Z": noise()[..., 0]})
    assert list(tmp_path.iterdir()) == []


def test_a_disk_that_fills_up_is_a_clear_error_and_keeps_the_old_file(tmp_path):
    write_exr(tmp_path / "a.exr", {"Z": noise()[..., 0]})
    before = (tmp_path / "a.exr").read_bytes()
    script = textwrap.dedent(f"""
        import resource, numpy as np
        from data.exr import write_exr
        resource.setrlimit(resource.RLIMIT_FSIZE, (20000, {resource.RLIM_INFINITY}))
        try:
            write_exr({str(tmp_path / "a.exr")!r}, {{"Z": np.random.rand(400, 400).astype("f")}})
        except OSError as error:
            print(error)
    """)
    root = Path(__file__).parents[2]
    result = subprocess.run(
        [sys.executable, "-c", script], cwd=root, capture_output=True, text=True, check=True
    )
    assert "a.exr: cannot write the file" in result.stdout
    assert [p.name for p in tmp_path.iterdir()] == ["a.exr"]
    assert (tmp_path / "a.exr").read_bytes() == before


@pytest.mark.parametrize(
    ("channels", "message"),
    [
        ({}, "nothing to write"),
        ({"Z": np.zeros((4, 4))}, "channel 'Z' is float64, expected float16 or float32"),
        ({"a": np.zeros((4, 4), "f"), "b": np.zeros((4, 5), "f")}, "of one size"),
    ],
)
def test_arrays_that_cannot_be_written_are_refused(tmp_path, channels, message):
    with pytest.raises(ValueError, match=message):
        write_exr(tmp_path / "a.exr", channels)


def test_subsampled_channels_are_refused(tmp_path):
    raw(tmp_path / "a.exr", {}, {"RY": OpenEXR.Channel("RY", np.zeros((4, 4), np.float32), 2, 2)})
    with pytest.raises(ValueError, match="channel 'RY' is subsampled"):
        read_exr(tmp_path / "a.exr")


def test_strided_arrays_are_written_as_they_read(tmp_path):
    image = noise()
    write_exr(tmp_path / "a.exr", {"Z": image[::2, ::3, 1]})
    assert np.array_equal(read_exr(tmp_path / "a.exr").channels["Z"], image[::2, ::3, 1])


def claiming(path, last, what=b"dataWindow"):
    """Write a small file and let a window of its header end at another pixel."""
    write_exr(path, {"Z": noise(4, 4)[..., 0]})
    content = bytearray(path.read_bytes())
    at = content.index(what + b"\0box2i\0") + len(what) + 7 + 4
    content[at + 8 : at + 16] = b"".join(int(v).to_bytes(4, "little", signed=True) for v in last)
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("window", [b"dataWindow", b"displayWindow"])
@pytest.mark.parametrize("last", [(31622, 31622), (2**30, 0), (0, 2**30), (10**5, 10**5), (-1, -1)])
def test_a_header_that_claims_absurd_sizes_is_refused_before_pixels_are_read(
    tmp_path, monkeypatch, window, last
):
    path = claiming(tmp_path / "a.exr", last, window)
    opened = []
    library = OpenEXR.File

    def watched(*arguments, **options):
        opened.append(bool(options.get("header_only")))
        return library(*arguments, **options)

    monkeypatch.setattr("data.exr_image.OpenEXR.File", watched)
    with pytest.raises(ValueError, match=r"a\.exr: .*(damaged|at most)"):
        read_exr(path)
    assert all(opened)


def test_large_pictures_of_one_colour_are_still_read(tmp_path):
    write_exr(tmp_path / "a.exr", {c: np.zeros((2160, 3840), np.float16) for c in "RGB"})
    assert (tmp_path / "a.exr").stat().st_size < 2160 * 3840 * 12 / 1000
    assert read_exr(tmp_path / "a.exr").size == (2160, 3840)


def test_channels_are_listed_without_reading_pixels(tmp_path):
    write_exr(tmp_path / "a.exr", {"normal.R": noise()[..., 0], "Z": noise()[..., 1]})
    content = (tmp_path / "a.exr").read_bytes()
    (tmp_path / "a.exr").write_bytes(content[:-40])
    assert exr_channels(tmp_path / "a.exr") == ["Z", "normal.R"]
    parts = [OpenEXR.Part({}, {"Z": noise()[..., 0].copy()}, name=name) for name in ("depth", "alpha")]
    OpenEXR.File(parts).write(str(tmp_path / "parts.exr"))
    assert exr_channels(tmp_path / "parts.exr") == list(read_exr(tmp_path / "parts.exr").channels)


def test_our_own_files_are_not_suspected_again(tmp_path):
    sky = np.ones((20, 24, 3), np.float32)
    sky[5:, :] = noise()[5:] / 40
    write_frame(Frame({"color": sky.clip(0, 1)}, "s", 0), tmp_path / "own.exr")
    read_frame(tmp_path / "own.exr")
    write_exr(tmp_path / "other.exr", {f"color.{c}": sky[..., i].clip(0, 1) for i, c in enumerate("RGB")})
    with pytest.warns(RadianceWarning, match="clipped at 1"):
        read_frame(tmp_path / "other.exr")
