from __future__ import annotations

import dataclasses
import pickle
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from data.render.assets import (
    Assets,
    read_environment,
    read_mesh,
    read_radiance_hdr,
    read_texture,
)

CUBE = "\n".join(
    [f"v {x} {y} {z}" for x in (0, 4) for y in (0, 4) for z in (0, 4)]
    + ["f 1 2 4 3", "f 5 7 8 6", "f 1 5 6 2", "f 3 4 8 7", "f 1 3 7 5", "f 2 6 8 4"]
)


def write_obj(path: Path) -> Path:
    path.write_text(CUBE)
    return path


def write_rgbe(path: Path, rows: list[bytes], width: int) -> Path:
    header = f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {len(rows)} +X {width}\n"
    path.write_bytes(header.encode() + b"".join(rows))
    return path


def write_exr(path: Path, **channels: np.ndarray) -> Path:
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, channels).write(str(path))
    return path


class TestScan:
    def test_files_are_sorted_and_others_are_listed(self, tmp_path: Path) -> None:
        (tmp_path / "deep").mkdir()
        for name in ("b.obj", "deep/a.ply", "c.GLB", "notes.txt", "b.mtl"):
            (tmp_path / name).write_bytes(b"x")
        assets = Assets.scan(meshes=tmp_path)
        assert [p.name for p in assets.meshes] == ["b.obj", "c.GLB", "a.ply"]
        assert [p.name for p in assets.skipped] == ["b.mtl", "notes.txt"]
        assert assets.textures == ()
        assert assets.share == 0.5

    def test_folder_without_such_files_is_an_error_that_names_it(self, tmp_path: Path) -> None:
        with pytest.raises(ValueError, match=f"{tmp_path.name} holds no textures: looked for .png"):
            Assets.scan(textures=tmp_path)
        with pytest.raises(ValueError, match="nowhere is no folder"):
            Assets.scan(environments=tmp_path / "nowhere")

    def test_share_is_a_probability(self, tmp_path: Path) -> None:
        with pytest.raises(ValueError, match="from 0 to 1"):
            Assets.scan(share=1.5)

    def test_hash_follows_contents_and_not_the_folder(self, tmp_path: Path) -> None:
        for folder in ("one", "two"):
            (tmp_path / folder).mkdir()
            write_obj(tmp_path / folder / "cube.obj")
        one, two = Assets.scan(meshes=tmp_path / "one"), Assets.scan(meshes=tmp_path / "two")
        assert one.hash == two.hash
        assert dataclasses.replace(one, share=0.4).hash != one.hash
        (tmp_path / "two" / "cube.obj").write_text(CUBE.replace("v 4 4 4", "v 4 4 5"))
        assert Assets.scan(meshes=tmp_path / "two").hash != one.hash

    def test_can_be_sent_to_another_process(self, tmp_path: Path) -> None:
        write_obj(tmp_path / "cube.obj")
        assets = Assets.scan(meshes=tmp_path)
        assert pickle.loads(pickle.dumps(assets)) == assets


class TestMeshes:
    @pytest.mark.parametrize("suffix", ["obj", "ply", "glb"])
    def test_mesh_is_scaled_into_the_unit_ball_with_normals_and_coordinates(
        self, tmp_path: Path, suffix: str
    ) -> None:
        trimesh = pytest.importorskip("trimesh")
        path = tmp_path / f"cube.{suffix}"
        trimesh.creation.box((4, 2, 2)).export(path)
        mesh = read_mesh(path)
        assert np.linalg.norm(mesh.vertices, axis=1).max() == pytest.approx(1, abs=1e-5)
        np.testing.assert_allclose(mesh.vertices.min(0), -mesh.vertices.max(0), atol=1e-5)
        assert mesh.normals is not None
        np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-5)
        assert mesh.uvs is not None
        assert np.ptp(mesh.uvs) > 0
        assert len(mesh.faces) == 12

    @pytest.mark.parametrize(
        ("name", "content"),
        [
            ("cut.glb", b"glTF\x02\x00\x00\x00"),
            ("empty.obj", b""),
            ("bad.ply", b"ply\nformat ascii 1.0\nelement ver"),
        ],
    )
    def test_broken_file_is_an_error_that_names_it(self, tmp_path: Path, name: str, content: bytes) -> None:
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match=name):
            read_mesh(tmp_path / name)

    def test_mesh_without_extent_is_refused(self, tmp_path: Path) -> None:
        (tmp_path / "point.obj").write_text("v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n")
        with pytest.raises(ValueError, match=r"point\.obj"):
            read_mesh(tmp_path / "point.obj")


class TestTextures:
    def test_srgb_is_decoded(self, tmp_path: Path) -> None:
        Image.fromarray(np.full((4, 6, 3), 128, np.uint8)).save(tmp_path / "grey.png")
        picture = read_texture(tmp_path / "grey.png")
        assert picture.pixels.shape == (4, 6, 3)
        np.testing.assert_allclose(picture.pixels, ((128 / 255 + 0.055) / 1.055) ** 2.4, rtol=1e-5)

    def test_white_becomes_a_reflectance(self, tmp_path: Path) -> None:
        Image.fromarray(np.full((4, 4), 255, np.uint8)).save(tmp_path / "white.png")
        assert read_texture(tmp_path / "white.png").pixels.max() == pytest.approx(0.9)

    def test_large_ones_are_averaged_down(self, tmp_path: Path) -> None:
        Image.fromarray(np.zeros((20, 3000), np.uint8)).save(tmp_path / "wide.png")
        assert read_texture(tmp_path / "wide.png").pixels.shape == (6, 1000, 3)

    def test_broken_file_is_an_error_that_names_it(self, tmp_path: Path) -> None:
        (tmp_path / "cut.png").write_bytes(b"\x89PNG\r\n\x1a\n\x00\x00")
        with pytest.raises(ValueError, match=r"cut\.png: cannot be read as a texture"):
            read_texture(tmp_path / "cut.png")


class TestEnvironments:
    def test_exr_is_read_as_it_is(self, tmp_path: Path) -> None:
        plane = np.linspace(0, 9, 32, dtype=np.float32).reshape(4, 8)
        path = write_exr(tmp_path / "sky.exr", R=plane, G=plane * 2, B=plane * 3)
        np.testing.assert_allclose(read_environment(path).pixels, plane[..., None] * [1, 2, 3])

    def test_missing_channels_are_named(self, tmp_path: Path) -> None:
        path = write_exr(tmp_path / "sky.exr", Y=np.ones((4, 8), np.float32))
        with pytest.raises(ValueError, match=r"sky\.exr.*found Y"):
            read_environment(path)

    def test_other_projections_are_refused(self, tmp_path: Path) -> None:
        plane = np.ones((8, 8), np.float32)
        path = write_exr(tmp_path / "ball.exr", R=plane, G=plane, B=plane)
        with pytest.raises(ValueError, match="twice as wide as high"):
            read_environment(path)

    def test_plain_rgbe_is_decoded(self, tmp_path: Path) -> None:
        pixel = bytes([128, 64, 0, 129])
        path = write_rgbe(tmp_path / "sky.hdr", [pixel * 2], 2)
        np.testing.assert_allclose(read_radiance_hdr(path), [[[1, 0.5, 0]] * 2])

    def test_run_length_coded_rgbe_is_decoded(self, tmp_path: Path) -> None:
        width = 16
        row = bytes([2, 2, 0, width])
        row += bytes([128 + 16, 128])  # red: a run
        row += bytes([16, *range(16)])  # green: as it is
        row += bytes([128 + 8, 0, 8, *[128] * 8])  # blue: half a run
        row += bytes([128 + 16, 129])
        pixels = read_radiance_hdr(write_rgbe(tmp_path / "sky.hdr", [row] * 8, width))
        assert pixels.shape == (8, 16, 3)
        np.testing.assert_allclose(pixels[3, :, 0], 1)
        np.testing.assert_allclose(pixels[3, :, 1], np.arange(16) / 128)
        np.testing.assert_allclose(pixels[3, :, 2], np.repeat([0, 1], 8))
        assert read_environment(tmp_path / "sky.hdr").pixels.shape == (8, 16, 3)

    @pytest.mark.parametrize(
        ("rows", "said"),
        [
            ([bytes([2, 2, 0, 16, 144, 1])], "cut off"),
            ([bytes([2, 2, 0, 16, 160, 1, 144, 1, 144, 1, 144, 1])], "damaged"),
            ([bytes([2, 2, 0, 16, 0, 1, 144, 1])], "damaged"),
            ([bytes([9, 9])], "cut off"),
        ],
    )
    def test_damaged_rgbe_is_an_error_that_names_the_file(
        self, tmp_path: Path, rows: list[bytes], said: str
    ) -> None:
        with pytest.raises(ValueError, match=rf"sky\.hdr: .*{said}"):
            read_radiance_hdr(write_rgbe(tmp_path / "sky.hdr", rows, 16))

    @pytest.mark.parametrize(
        "data",
        [b"", b"PNG", b"#?RADIANCE\n", b"#?RADIANCE\n\n+Y 2 +X 2\n", b"#?RADIANCE\n\n-Y 999999 +X 999999\n"],
    )
    def test_wrong_header_is_an_error_that_names_the_file(self, tmp_path: Path, data: bytes) -> None:
        (tmp_path / "sky.hdr").write_bytes(data)
        with pytest.raises(ValueError, match=r"sky\.hdr"):
            read_radiance_hdr(tmp_path / "sky.hdr")
