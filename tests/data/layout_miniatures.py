"""Builders of small data sets as the Tungsten family of layouts really has them: names, ranges, oddities."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import h5py
import numpy as np
from PIL import Image as Picture

from data.exr import write_exr
from tests.data.miniature import Crop, bmfr_matrix, camera_header, sample_crop, write_rgb

Shot = dict[str, np.ndarray]


def shot(seed: int, height: int = 20, width: int = 24, spp: int = 32) -> Shot:
    """Return the buffers of a render: gamma noise with fireflies around a smooth image.

    The albedo is 0 on a lamp and on the background, the depth 0 there too; some normals are NaN and the
    reconstruction filter left some radiance below 0, both as Tungsten writes them.
    """
    rng = np.random.default_rng([7, seed])
    rows, columns = np.mgrid[0:height, 0:width].astype(np.float32)
    size = (height, width)
    normal = np.stack([np.sin(columns / 9), np.cos(rows / 7), 0.6 + 0 * rows], -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    albedo = np.broadcast_to(0.2 + 0.6 * rng.random(3), (*size, 3)).copy()
    depth = (3 + rows / 5 + columns / 11)[..., None]
    light = 1 + np.sin(columns / 6)[..., None] ** 2
    made = {
        "converged_diffuse": albedo * light,
        "converged_specular": 0.3 * light * np.ones((1, 1, 3)),
        "albedo": albedo,
        "normal": normal,
        "depth": depth,
        "visibility": rng.random((*size, 1)),
    }
    lamp, sky = (slice(0, 3), slice(0, 4)), (slice(0, 3), slice(5, 9))
    for where in (lamp, sky):
        albedo[where] = 0
    depth[sky] = normal[sky] = 0
    for half in "AB":
        for part in ("diffuse", "specular"):
            noise = rng.gamma(spp / 8, 8 / spp, (*size, 3))
            made[f"{part}{half}"] = made[f"converged_{part}"] * noise
        made[f"diffuse{half}"][5, 5] = 250.0
        made[f"specular{half}"][7, 7] = -0.01
        made[f"color{half}"] = made[f"diffuse{half}"] + made[f"specular{half}"]
        for feature in ("albedo", "normal", "depth", "visibility"):
            sign = 0.01 if half == "A" else -0.01
            made[f"{feature}{half}"] = made[feature] + sign * (made[feature] != 0)
    for name in ("diffuse", "specular", "color"):
        made[name] = (made[f"{name}A"] + made[f"{name}B"]) / 2
    for name in ("diffuse", "specular", "color", "albedo", "normal", "depth", "visibility"):
        made[f"{name}Variance"] = ((made[f"{name}A"] - made[f"{name}B"]) / 2) ** 2
    made["normal"] = normal.copy()
    made["normal"][9, 9] = np.nan
    made["converged_color"] = made["converged_diffuse"] + made["converged_specular"]
    return {name: array.astype(np.float32) for name, array in made.items()}


def write_one(path: Path, image: np.ndarray, letter: str = "Z") -> Path:
    """Write one buffer as the only one of a file: R, G, B, or one channel."""
    letters = "RGB" if image.shape[2] == 3 else letter
    write_exr(path, {c: image[..., i].copy() for i, c in enumerate(letters)})
    return path


def write_merged(path: Path, groups: Mapping[str, np.ndarray]) -> Path:
    """Write groups of channels into one file: `default` without a prefix, others `.R .G .B` or `.Z`."""
    channels = {}
    for group, image in groups.items():
        prefix = "" if group == "default" else f"{group}."
        letters = "RGB" if image.shape[2] == 3 else "Z"
        channels |= {f"{prefix}{c}": image[..., i].copy() for i, c in enumerate(letters)}
    write_exr(path, channels)
    return path


def acfm(root: Path, scenes: tuple[str, ...] = ("bathroom2", "house"), crops: int = 2) -> Path:
    """Write training crops, with the albedo called texture."""
    for at, scene in enumerate(scenes):
        for crop in range(crops):
            made = shot(10 * at + crop)
            prefix = root / scene / f"{scene}-{crop:04d}-x128"
            noisy = {name: made[name] for name in ("normal", "depth", "diffuse", "specular", "visibility")}
            noisy |= {"texture": made["albedo"], "color": made["color"]}
            noisy |= {"variance": made["colorVariance"].mean(-1, keepdims=True)}
            converged = {name: made[f"converged_{name}"] for name in ("diffuse", "specular", "color")}
            converged |= {"texture": made["albedo"]}
            for spp, files in (("00032", noisy), ("32768", converged)):
                for role, image in files.items():
                    write_one(Path(f"{prefix}-{spp}spp_{role}.exr"), image)
    return root


def acfm_test(root: Path, spps: tuple[int, ...] = (4, 32)) -> Path:
    """Write test scenes, with the albedo called albedo, no color, and one reference per scene."""
    for at, scene in enumerate(("car", "living-room-2")):
        for spp in spps:
            made = shot(20 + at, spp=spp)
            for role in ("normal", "depth", "albedo", "diffuse", "specular"):
                write_one(root / f"{scene}_{spp}_{role}.exr", made[role])
        write_one(root / f"{scene}.exr", made["converged_color"])
    return root


def afgsa_folders(root: Path, scenes: tuple[str, ...] = ("bathroom2", "room3"), shots: int = 2) -> Path:
    """Write the folders 32spp and 32768spp."""
    for at, scene in enumerate(scenes):
        for number in range(shots):
            made = shot(30 + 10 * at + number)
            for role in ("color", "diffuse", "specular", "normal", "depth", "albedo"):
                write_one(root / "32spp" / f"{scene}_{number}_32_{role}.exr", made[role])
            for role in ("color", "diffuse", "specular"):
                image = made[f"converged_{role}"]
                write_one(root / "32768spp" / f"{scene}_{number}_32768_{role}.exr", image)
    return root


def patch_arrays(count: int, size: int = 32) -> dict[str, np.ndarray]:
    """Return the data sets of a file of patches; the depth is normalised, the normal is not."""
    made = [shot(50 + i, size, size) for i in range(count)]
    stacked = {name: np.stack([m[name] for m in made]) for name in made[0]}
    depth = stacked["depth"] / stacked["depth"].max()
    return {
        "noisy": stacked["color"],
        "gt": stacked["converged_color"],
        "spec": stacked["specular"],
        "diff": stacked["diffuse"],
        "spec_gt": stacked["converged_specular"],
        "diff_gt": stacked["converged_diffuse"],
        "aux": np.concatenate([stacked["normal"], depth, stacked["albedo"]], -1),
    }


def afgsa_h5(
    root: Path, count: int = 3, files: tuple[str, ...] = ("train", "val", "test_4"), size: int = 32
) -> Path:
    """Write files of patches, compressed and growable as the authors' are, which are of 128 pixels."""
    root.mkdir(parents=True, exist_ok=True)
    arrays = patch_arrays(count, size)
    for name in files:
        with h5py.File(root / f"{name}.h5", "w") as file:
            for key, array in arrays.items():
                shape = (None, *array.shape[1:])
                file.create_dataset(key, data=array, maxshape=shape, compression="gzip", chunks=True)
    return root


def afgsa_merged(root: Path, names: tuple[str, ...] = ("veach-ajar", "bathroom_32")) -> Path:
    """Write inference files; the reference of `bathroom_32.exr` is called `bathroom_gt.exr`."""
    for at, name in enumerate(names):
        made = shot(70 + at)
        groups = {"default": made["color"]} | {g: made[g] for g in ("normal", "depth", "albedo")}
        write_merged(root / f"{name}.exr", groups)
        write_merged(root / f"{name.partition('_')[0]}_gt.exr", {"default": made["converged_color"]})
    return root


def kpcn(
    root: Path, variances: str = "Z", halves: bool = False, scenes: tuple[str, ...] = ("car", "house")
) -> Path:
    """Write merged files; variances in one channel (`Z`) or three (`RGB`), halves as groups with A and B."""
    for at, scene in enumerate(scenes):
        for view in range(2):
            made = shot(80 + 10 * at + view)
            features = ("diffuse", "specular", "albedo", "normal", "depth", "visibility")
            groups = {"default": made["color"]} | {g: made[g] for g in features}
            for name in ("color", "diffuse", "specular", "albedo", "normal", "depth"):
                variance = made[f"{name}Variance"]
                groups[f"{name}Variance"] = variance.mean(-1, keepdims=True) if variances == "Z" else variance
                if halves:
                    groups |= {f"{name}{half}": made[f"{name}{half}"] for half in "AB"}
            stem = root / scene / f"{1000 + view}"
            write_merged(Path(f"{stem}-00128spp.exr"), groups)
            converged = {g: made[f"converged_{g}"] for g in ("diffuse", "specular")}
            write_merged(Path(f"{stem}-08192spp.exr"), {"default": made["converged_color"], **converged})
    return root


def tungsten(root: Path, scenes: tuple[str, ...] = ("kitchen", "staircase"), reference: bool = True) -> Path:
    """Write the renderer's own files: every output with A, B and Variance, one channel called Y."""
    for at, scene in enumerate(scenes):
        made = shot(100 + at, spp=64)
        for output in ("color", "albedo", "normal", "depth", "visibility"):
            for part in ("", "A", "B", "Variance"):
                write_one(root / scene / f"{output}{part}.exr", made[f"{output}{part}"], "Y")
        if reference:
            write_one(root / scene / "reference.exr", made["converged_color"])
        outputs = [{"type": "color", "two_buffer_variance": True, "sample_variance": True}]
        (root / scene / "scene.json").write_text(
            json.dumps({"renderer": {"spp": 64, "output_buffers": outputs}})
        )
    return root


def nbgd(
    root: Path,
    kind: str = "accumulated",
    scenes: tuple[str, ...] = ("classroom", "cbox-glossy"),
    frames: int = 2,
) -> Path:
    """Write scenes of the layout: `accumulated` light in half precision, or 64 spp in `inputs/`.

    `positions` is as `accumulated`, with world positions and cameras as BMFR has them.
    """
    crop = Crop()
    for scene in scenes:
        matrices = []
        for index in range(frames):
            frame = sample_crop(scene, index, crop)
            b = frame.buffers
            roles = {"albedo": b["albedo"], "shading_normal": b["normal"], "reference": b["reference"]}
            if kind == "64spp":
                roles["color"] = b["irradiance"]
            if kind == "positions":
                roles["world_position"] = b["position"]
            for role, image in roles.items():
                write_rgb(root / scene / "inputs" / f"{role}{index}.exr", image)
            if kind != "64spp":
                half = {c: b["irradiance"][..., i].astype(np.float16) for i, c in enumerate("RGB")}
                write_exr(root / scene / "radiance_accum" / f"accum_color_noabd{index}.exr", half)
            depth = b["depth"][..., 0]
            scaled = (depth - depth.min()) / (depth.max() - depth.min())
            (root / scene / "depth_normalized").mkdir(exist_ok=True)
            picture = Picture.fromarray(np.round(scaled * 255).astype(np.uint8))
            picture.save(root / scene / "depth_normalized" / f"{index}.png")
            matrices.append(bmfr_matrix(frame.camera, crop.width, crop.height))
        if kind == "positions":
            header = camera_header(matrices, offsets=[(0.5, 0.5)] * frames)
            (root / scene / "inputs" / "camera_matrices.h").write_text(header)
    return root


MINIATURES = {
    "acfm": acfm,
    "acfm test": acfm_test,
    "afgsa": afgsa_folders,
    "afgsa h5": afgsa_h5,
    "afgsa merged": afgsa_merged,
    "kpcn": kpcn,
    "tungsten": tungsten,
    "nbgd": nbgd,
}
"""Title, beginning with the layout → builder of a miniature in a folder."""
