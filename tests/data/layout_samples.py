"""Builders of miniatures in the layouts of denoisers and renderers: OIDN, SBMC, layers, Blender, Mitsuba."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np

from data.exr import write_exr

SIZE = (10, 14)
RGB, XYZ = "RGB", "XYZ"


def picture(seed: int, size: tuple[int, int] = SIZE) -> dict[str, np.ndarray]:
    """Return a small scene with a corner that no ray hits: radiance, noisy and converged, and features."""
    random = np.random.default_rng(seed)
    height, width = size
    normal = random.normal((0, 0, 2), 1, (*size, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    albedo = random.uniform(0.05, 0.9, (*size, 3))
    light = random.uniform(0.2, 4, (height, width, 1))
    position = random.uniform((-3, -3, -9), (3, 3, -3), (*size, 3))
    depth = np.linalg.norm(position, axis=-1, keepdims=True)
    images = {
        "color": albedo * light * random.gamma(2, 0.5, (*size, 3)),
        "reference": albedo * light,
        "albedo": albedo,
        "normal": normal,
        "depth": depth,
        "position": position,
    }
    for name in ("albedo", "normal", "depth", "position"):
        images[name][:2, :3] = 0
    return {name: image.astype(np.float32) for name, image in images.items()}


def half(channels: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return channels as files of renderers often have them, in half precision."""
    return {name: image.astype(np.float16) for name, image in channels.items()}


def lettered(layer: str, image: np.ndarray, letters: str) -> dict[str, np.ndarray]:
    """Return `<layer>.<letter>` → plane, or the letters alone without a layer."""
    return {
        f"{layer}.{c}" if layer else c: np.ascontiguousarray(image[..., i]) for i, c in enumerate(letters)
    }


def oidn_view(folder: Path, name: str, versions: Sequence[str], seed: int = 1, encoded: bool = False) -> None:
    """Write one image in several versions; the last one is converged."""
    images = picture(seed)
    for version in versions:
        color = images["reference" if version == versions[-1] else "color"]
        normal = (images["normal"] + 1) / 2 if encoded else images["normal"]
        stem = f"{name}_{version}" if version else name
        for feature, image in (("hdr", color), ("alb", images["albedo"]), ("nrm", normal)):
            write_exr(folder / f"{stem}.{feature}.exr", half(lettered("", image, RGB)))


def oidn(root: Path) -> Path:
    """Write the tree of OIDN's documentation."""
    oidn_view(root / "scene1", "view1", ("0001", "0004", "8192"))
    oidn_view(root / "scene1", "view2", ("0001", "8192"), seed=2)
    oidn_view(root, "scene2", ("000008spp", "000064spp", "reference"), seed=3)
    return root


SBMC_HEADER = {
    "version": 20190401,
    "tile_size": 8,
    "image_width": 16,
    "image_height": 8,
    "sample_count": 3,
    "gt_sample_count": 4096,
    "sample_features": 27,
    "pixel_features": 30,
    "path_depth": 6,
    "focus_distance": 0.125,
    "aperture_radius": 0.25,
    "fov": 45.0,
    "scene_radius": 12.5,
    "block_x": 0,
    "block_y": 0,
}


def sbmc_arrays(seed: int, header: dict[str, Any]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pixel data, the samples' floats and their flags, with the ranges of the authors' renderer."""
    random = np.random.default_rng(seed)
    size, count = header["tile_size"], header["sample_count"]
    pixels = random.uniform(0, 2, (30, size, size)).astype(np.float32)
    floats = random.uniform(0, 1, (count, 63, size, size)).astype(np.float32)
    floats[:, 2:4] = random.uniform(-0.7, 0.7, (count, 2, size, size)) * header["aperture_radius"]
    floats[:, 11:17] = random.uniform(-0.5, 0.5, (count, 6, size, size))
    floats[:, 17:19] *= 0.3
    floats[:, 20] = 1
    floats[:, 27:51] = np.log(random.uniform(0, 1, (count, 24, size, size)) + 1e-8) / 30
    floats[:, 51:] = random.uniform(-1, 1, (count, 12, size, size))
    # A ray that left the scene: depth -1 divided by ten radii, everything else 0.
    floats[:, 11:, 0, 0] = 0
    floats[:, 17:19, 0, 0] = -1 / (10 * header["scene_radius"])
    flags = random.integers(0, 32, (count, 6, size, size)).astype(np.int16)
    return pixels, floats, flags


def sbmc_tile(path: Path, seed: int = 1, **changes: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Write one tile and return its arrays."""
    header = {**SBMC_HEADER, **changes}
    arrays = sbmc_arrays(seed, header)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(sbmc_header(header) + b"".join(sbmc_blocks(*arrays)))
    return arrays


def sbmc_header(header: dict[str, Any]) -> bytes:
    """Return the bytes of a header."""
    return struct.pack("<9i4f2i", *header.values())


def sbmc_blocks(pixels: np.ndarray, floats: np.ndarray, flags: np.ndarray) -> list[bytes]:
    """Return the blocks of a tile with their lengths."""
    contents = [pixels.tobytes(), *(f.tobytes() + g.tobytes() for f, g in zip(floats, flags, strict=True))]
    blocks = [lz4.frame.compress(content) for content in contents]
    return [struct.pack("<i", len(block)) + block for block in blocks]


def sbmc(root: Path) -> Path:
    """Write a scene of two tiles that make an image, and one with a single tile of a larger image."""
    sbmc_tile(root / "kitchen" / "0000_0000.bin", 1)
    sbmc_tile(root / "kitchen" / "0008_0000.bin", 2, block_x=8)
    sbmc_tile(root / "train" / "spheres" / "0008_0000.bin", 3, block_x=8, version=20181212)
    return root


LAYER_SHAPE = (2, 3, 6, 8)


def layer_arrays(seed: int = 1) -> dict[str, np.ndarray]:
    """Return the data sets of an input file: 2 frames of 3 samples, 8x6 pixels, float16."""
    random = np.random.default_rng(seed)
    frames, samples, height, width = LAYER_SHAPE
    low = {"normals_depth": -0.5, "uvt": 0.0, "motionvecs": -0.1}
    high = {"color": 3.0, "normals_depth": 0.5, "motionvecs": 0.1}
    sizes = {"color": 3, "normals_depth": 4, "albedo": 3, "specular": 4, "uvt": 3, "motionvecs": 3}
    arrays = {
        name: random.uniform(low.get(name, 0), high.get(name, 1), (frames, samples, count, height, width))
        for name, count in sizes.items()
    }
    arrays["normals_depth"][:, :, 3] = np.abs(arrays["normals_depth"][:, :, 3]) + 0.1
    return {name: array.astype(np.float16) for name, array in arrays.items()}


def layer_pair(folder: Path, name: str, rank: int = 4, suffix: str = "input") -> dict[str, np.ndarray]:
    """Write input and reference and return all arrays, the reference as `reference`."""
    import h5py

    folder.mkdir(parents=True, exist_ok=True)
    arrays = layer_arrays()
    reference = arrays["color"].mean(1).astype(np.float16)
    with h5py.File(folder / f"{name}_{suffix}.h5", "w") as file:
        for key, array in arrays.items():
            file.create_dataset(key, data=array, compression="gzip")
    with h5py.File(folder / f"{name}_ref.h5", "w") as file:
        file["color"] = reference if rank == 4 else reference[:, None]
    return {**arrays, "reference": reference}


def layerdenoise(root: Path) -> Path:
    """Write the small validation set."""
    layer_pair(root, "validation")
    return root


def blender_channels(
    images: dict[str, np.ndarray], layer: str = "ViewLayer", color: str = "color"
) -> dict[str, Any]:
    """Return the channels of a file that Blender wrote, in float32, with alpha and background depth."""
    albedo, total = images["albedo"], images[color]
    light = np.where(albedo > 0, 0.25, 0).astype(np.float32)
    depth = np.where(images["depth"] > 0, images["depth"], np.float32(1e10))
    missed = (albedo == 0).all(-1, keepdims=True)
    vector = np.zeros((*albedo.shape[:2], 4), np.float32)
    vector[..., :2] = (1.5, -0.25)
    passes = {
        "Combined": (np.concatenate([total * np.float32(0.9), np.ones_like(depth)], -1), "RGBA"),
        "Noisy Image": (np.concatenate([total, np.ones_like(depth)], -1), "RGBA"),
        "Denoising Albedo": (np.minimum(albedo + np.where(missed, 0, np.float32(0.04)), 1), RGB),
        "Denoising Normal": (images["normal"], XYZ),
        "Denoising Depth": (images["depth"], "Z"),
        "Depth": (depth, "Z"),
        "Normal": (images["normal"], XYZ),
        "Position": (images["position"], XYZ),
        "Vector": (vector, "XYZW"),
        "DiffDir": (light, RGB),
        "DiffInd": (light * np.float32(0.5), RGB),
        "DiffCol": (albedo * np.float32(0.8), RGB),
        "GlossCol": (np.where(missed, 0, np.full_like(albedo, 0.04)), RGB),
        "Emit": (np.zeros_like(albedo), RGB),
        "Env": (np.where(missed, total, 0), RGB),
        "IndexOB": (np.ones_like(depth), "X"),
    }
    channels: dict[str, Any] = {}
    for name, (image, letters) in passes.items():
        channels |= lettered(f"{layer}.{name}", image.astype(np.float32), letters)
    return channels


def blender_file(path: Path, seed: int, spp: int, layer: str = "ViewLayer", color: str = "color") -> None:
    """Write one frame."""
    attributes = {"Frame": path.stem, f"cycles.{layer}.samples": str(spp)}
    write_exr(path, blender_channels(picture(seed), layer, color), attributes)


def blender(root: Path) -> Path:
    """Write an animation of three frames with references in a folder."""
    for number in (1, 2, 3):
        blender_file(root / "shot" / f"{number:04d}.exr", number, 16)
        blender_file(root / "shot" / "ref" / f"{number:04d}.exr", number, 4096, color="reference")
    return root


def mitsuba_channels(images: dict[str, np.ndarray], color: str = "color") -> dict[str, np.ndarray]:
    """Return what 3.9 writes for `aa:albedo,dd:depth,nn:sh_normal,gn:geo_normal,pos:position,…`."""
    flat = np.zeros((*images["depth"].shape[:2], 2), np.float32)
    albedo = images["albedo"].copy()
    albedo[-1, -1] = (3.5, 0.5, 2.0)
    alpha = np.concatenate([images[color], np.ones_like(images["depth"])], -1)
    return half(
        lettered("", images[color], RGB)
        | lettered("img", alpha, "RGBA")
        | lettered("aa", albedo, RGB)
        | lettered("dd", images["depth"] * np.float32(0.99), "T")
        | lettered("nn", images["normal"], XYZ)
        | lettered("gn", -images["normal"], XYZ)
        | lettered("pos", images["position"], XYZ)
        | lettered("uv", flat, "UV")
        | lettered("si", flat[..., :1], "I")
    )


def mitsuba(root: Path) -> Path:
    """Write two scenes, one with its reference beside it, one in a folder."""
    for seed, (noisy, converged) in enumerate(
        (("cbox_16spp.exr", "cbox_ref.exr"), ("bathroom/0001.exr", "bathroom/reference/0001.exr"))
    ):
        images = picture(seed + 5)
        write_exr(root / noisy, mitsuba_channels(images))
        write_exr(root / converged, mitsuba_channels(images, "reference"))
    return root
