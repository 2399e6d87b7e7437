"""The user's own meshes, textures and environments, mixed into random scenes."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from data.exr_image import read_exr
from data.render.spec import Mesh, Picture
from data.render.surfaces import box_uvs, build, normalised, unit

MESHES = (".obj", ".ply", ".glb", ".gltf")
TEXTURES = (".png", ".jpg", ".jpeg")
ENVIRONMENTS = (".exr", ".hdr")
MAX_TRIANGLES = 100_000
"""Of one mesh: 75 of them have to fit into a scene."""

MAX_PIXELS = 2**26
TEXTURE_SIDE = 1024
ENVIRONMENT_WIDTH = 1024
_HEAD = 65536


@dataclass(frozen=True)
class Assets:
    """Files of the user; paths are sorted, so that the same folders give the same scenes.

    Attributes:
        meshes: OBJ, PLY, glTF and GLB files.
        textures: PNG and JPEG files.
        environments: EXR and Radiance HDR files in latitude-longitude projection.
        share: Probability with which a file is taken rather than a procedural one.
        skipped: Files of other kinds that lie in the folders.
    """

    meshes: tuple[Path, ...] = ()
    textures: tuple[Path, ...] = ()
    environments: tuple[Path, ...] = ()
    share: float = 0.5
    skipped: tuple[Path, ...] = field(default=(), compare=False)

    @staticmethod
    def scan(
        meshes: Path | None = None,
        textures: Path | None = None,
        environments: Path | None = None,
        share: float = 0.5,
    ) -> Assets:
        """Return the files in folders and their subfolders; None: nothing of that kind.

        Raises:
            ValueError: A folder is none or has no file of its kind; `share` is outside [0, 1].
        """
        if not 0 <= share <= 1:
            raise ValueError(f"the share of your own assets is {share}; give a number from 0 to 1")
        found: list[tuple[Path, ...]] = []
        skipped: list[Path] = []
        for folder, kinds, what in (
            (meshes, MESHES, "meshes"),
            (textures, TEXTURES, "textures"),
            (environments, ENVIRONMENTS, "environments"),
        ):
            files, others = _listed(folder, kinds, what)
            found.append(files)
            skipped += others
        return Assets(found[0], found[1], found[2], share, tuple(skipped))

    @cached_property
    def hash(self) -> str:
        """Hash of what decides about a scene: names, sizes, the first 64 KiB of every file, `share`."""
        digest = hashlib.sha256(f"{self.share}".encode())
        for group in (self.meshes, self.textures, self.environments):
            digest.update(f"{len(group)}\n".encode())
            for path in group:
                with path.open("rb") as file:
                    head = hashlib.sha256(file.read(_HEAD)).hexdigest()
                digest.update(f"{path.name} {path.stat().st_size} {head}\n".encode())
        return digest.hexdigest()


def file_hash(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _listed(folder: Path | None, kinds: tuple[str, ...], what: str) -> tuple[tuple[Path, ...], list[Path]]:
    if folder is None:
        return (), []
    if not folder.is_dir():
        raise ValueError(f"{folder} is no folder; give the folder that holds your {what}")
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    chosen = tuple(p for p in files if p.suffix.lower() in kinds)
    if not chosen:
        raise ValueError(f"{folder} holds no {what}: looked for {', '.join(kinds)} in it and its subfolders")
    return chosen, [p for p in files if p.suffix.lower() not in kinds]


def read_mesh(path: Path) -> Mesh:
    """Return a mesh in the unit ball, with normals and texture coordinates (made where the file has none).

    Raises:
        ValueError: trimesh is not installed, or the file is broken, empty, too large, or not finite.
    """
    try:
        import trimesh
    except ImportError:
        raise ValueError(
            f"{path}: reading meshes needs trimesh; install it with `pip install penumbra-denoise[render]`"
        ) from None
    try:
        loaded = trimesh.load(path, force="mesh", process=False)
    except Exception as error:  # trimesh raises whatever its parsers do
        raise ValueError(f"{path}: cannot be read as a mesh: {error}") from error
    if not isinstance(loaded, trimesh.Trimesh) or len(loaded.faces) == 0:
        raise ValueError(f"{path}: holds no triangles")
    if len(loaded.faces) > MAX_TRIANGLES:
        raise ValueError(f"{path}: {len(loaded.faces)} triangles; reduce it to at most {MAX_TRIANGLES}")
    vertices, faces = np.asarray(loaded.vertices, np.float64), np.asarray(loaded.faces, np.int64)
    if not np.isfinite(vertices).all() or np.ptp(vertices, axis=0).max() <= 0:
        raise ValueError(f"{path}: vertices that are not finite, or all at one place")
    normals = None
    if "vertex_normals" in loaded._cache:
        normals = np.asarray(loaded.vertex_normals, np.float64)
    return normalised(_mapped(vertices, faces, normals, getattr(loaded.visual, "uv", None), path))


def _mapped(
    vertices: NDArray[np.float64],
    faces: NDArray[np.int64],
    normals: NDArray[np.float64] | None,
    uvs: NDArray[np.float64] | None,
    path: Path,
) -> Mesh:
    """Return the mesh with what a file gave, made good where it is unusable."""
    if normals is not None and not np.isfinite(normals).all():
        normals = None
    mesh = build(vertices, faces, None, None if normals is None else unit(normals))
    if len(mesh.faces) == 0:
        raise ValueError(f"{path}: all triangles have no area")
    if uvs is None or len(uvs) != len(vertices) or not np.isfinite(uvs).all():
        return box_uvs(mesh, 1.0 / max(float(np.ptp(vertices, axis=0).max()), 1e-12))
    return Mesh(mesh.vertices, mesh.faces, mesh.normals, np.asarray(uvs, np.float32))


def _reduced(pixels: NDArray[np.float32], factor: int) -> NDArray[np.float32]:
    """Return means over squares of `factor` pixels; a rest at the lower and right edge is cut off."""
    if factor <= 1:
        return pixels
    height, width = (n // factor for n in pixels.shape[:2])
    part = pixels[: height * factor, : width * factor]
    return part.reshape(height, factor, width, factor, -1).mean((1, 3), dtype=np.float32)


def read_texture(path: Path) -> Picture:
    """Return an image as linear reflectance (H, W, 3) within [0.02, 0.9], at most 1024 pixels wide or high.

    Raises:
        ValueError: The file is broken or larger than 64 megapixels.
    """
    from PIL import Image

    try:
        with Image.open(path) as image:
            if image.width * image.height > MAX_PIXELS:
                raise ValueError(f"{image.width} x {image.height} pixels; at most {MAX_PIXELS} are read")
            encoded = np.asarray(image.convert("RGB"), np.float32) / 255
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise ValueError(f"{path}: cannot be read as a texture: {error}") from error
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    linear = _reduced(linear.astype(np.float32), -(-max(linear.shape[:2]) // TEXTURE_SIDE))
    return Picture(np.clip(linear, 0.02, 0.9))


def read_environment(path: Path) -> Picture:
    """Return a latitude-longitude picture (H, W, 3) in linear radiance, at most 1024 pixels wide.

    Raises:
        ValueError: The file is broken, lacks R, G, B, is not finite, black, or not twice as wide as high.
    """
    if path.suffix.lower() == ".hdr":
        pixels = read_radiance_hdr(path)
    else:
        channels = read_exr(path).channels
        if not {"R", "G", "B"} <= set(channels):
            names = ", ".join(sorted(channels)) or "none"
            raise ValueError(f"{path}: an environment needs channels R, G and B; found {names}")
        pixels = np.stack([channels[c] for c in "RGB"], -1)
    height, width = pixels.shape[:2]
    if not 1.8 <= width / height <= 2.2:
        raise ValueError(f"{path}: {width} x {height} pixels; an environment is twice as wide as high")
    if not np.isfinite(pixels).all() or pixels.max() <= 0:
        raise ValueError(f"{path}: pixels that are not finite, or all black")
    return Picture(_reduced(np.maximum(pixels, 0), -(-width // ENVIRONMENT_WIDTH)))


def read_radiance_hdr(path: Path) -> NDArray[np.float32]:
    """Return the pixels (H, W, 3) of a Radiance HDR file (RGBE, plain or run-length coded).

    Reference: G. Ward, Real pixels, Graphics Gems II, 1991, DOI 10.1016/B978-0-08-050754-5.50025-6.

    Raises:
        ValueError: The file is broken, cut off, of another orientation, or larger than 64 megapixels.
    """
    data = path.read_bytes()
    if not data.startswith((b"#?RADIANCE", b"#?RGBE")):
        raise ValueError(f"{path}: no Radiance HDR file (it begins with {data[:10]!r})")
    end = data.find(b"\n\n")
    line = data[end + 2 : data.find(b"\n", end + 2)].split() if end > 0 else []
    if len(line) != 4 or line[0] != b"-Y" or line[2] != b"+X" or not (line[1] + line[3]).isdigit():
        raise ValueError(f"{path}: the header has no line `-Y height +X width`; save it in that orientation")
    if b"FORMAT=32-bit_rle_xyze" in data[:end]:
        raise ValueError(f"{path}: XYZE colours; save it as RGBE")
    height, width = int(line[1]), int(line[3])
    if height * width == 0 or height * width > MAX_PIXELS:
        raise ValueError(f"{path}: {width} x {height} pixels; at most {MAX_PIXELS} are read")
    start = data.find(b"\n", end + 2) + 1
    rgbe = _rgbe(np.frombuffer(data, np.uint8, offset=start), height, width, path)
    scale = np.where(rgbe[..., 3:] > 0, np.ldexp(1.0, rgbe[..., 3:].astype(int) - 136), 0.0)
    return (rgbe[..., :3] * scale).astype(np.float32)


def _rgbe(data: NDArray[np.uint8], height: int, width: int, path: Path) -> NDArray[np.uint8]:
    """Return decoded bytes (H, W, 4)."""
    coded = len(data) >= 4 and data[0] == 2 and data[1] == 2 and (int(data[2]) << 8 | int(data[3])) == width
    if not coded:
        if len(data) < height * width * 4:
            raise ValueError(f"{path}: cut off, {len(data)} of {height * width * 4} bytes")
        return data[: height * width * 4].reshape(height, width, 4)
    result, at = np.zeros((height, 4, width), np.uint8), 0
    for y in range(height):
        if at + 4 > len(data) or data[at] != 2 or data[at + 1] != 2:
            raise ValueError(f"{path}: cut off or damaged in row {y}")
        at += 4
        for channel in range(4):
            at = _run(data, at, result[y, channel], path, y)
    return np.ascontiguousarray(result.transpose(0, 2, 1))


def _run(data: NDArray[np.uint8], at: int, row: NDArray[np.uint8], path: Path, y: int) -> int:
    """Decode one channel of one row; return where the next begins."""
    x, width = 0, len(row)
    while x < width:
        if at + 1 >= len(data):
            raise ValueError(f"{path}: cut off in row {y}")
        count = int(data[at])
        same = count > 128
        count = count - 128 if same else count
        length = 1 if same else count
        if count == 0 or x + count > width or at + 1 + length > len(data):
            raise ValueError(f"{path}: cut off or damaged in row {y}")
        row[x : x + count] = data[at + 1 : at + 1 + length]
        x, at = x + count, at + 1 + length
    return at
