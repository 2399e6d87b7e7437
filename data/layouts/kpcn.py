"""Layout of KPCN's data: all buffers of a frame merged in one EXR file, the reference in a second one.

The groups are default (or color), diffuse, specular, albedo, normal as `.R`, `.G`, `.B`, depth.Z,
visibility.Z; their variances `colorVariance`, `diffuseVariance` … as `.Z` or `.R`, `.G`, `.B`; halves with
the suffixes A, B. Normals are named R, G, B. What is a scene and how a reference is found says
`data.layouts.merged`.

Variances count as those of the mean, as the renderer writes them. A file of ACFM's or AFGSA's set merged
that way is read alike.

Source: Bako et al. 2017, doi:10.1145/3072959.3073708.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from data.frame import Frame
from data.layouts import merged
from data.layouts.scene import Scene, all_frames, require_folder

NEEDED = ("color", "diffuse", "specular", "diffuse_albedo", "normal", "depth")


def likeness(root: Path) -> float:
    """Return the fraction of the first merged files that have the groups of this layout."""
    groups = {"diffuse", "specular", "albedo", "normal", "depth"}
    return merged.share(merged.views(root), groups, {"roughness", "motion"})


def describe(root: str | Path) -> list[Scene]:
    """Return the scenes below a root.

    Raises:
        OSError: The root does not exist or a file cannot be opened.
        ValueError: No EXR file, or a buffer is missing and cannot be derived; the message names the file, the
            buffer and the channels found.
    """
    root = Path(root)
    require_folder(root)
    scenes = merged.scenes("kpcn", root, NEEDED, "", "KPCN-style merged EXR files")
    if not scenes:
        raise ValueError(
            f"{root}: no scene of the layout `kpcn` found, expected merged EXR files such as "
            "<scene>/<view>-00128spp.exr and <scene>/<view>-08192spp.exr, or <view>.exr and <view>_gt.exr"
        )
    return scenes


def frames(root: str | Path) -> Iterator[Frame]:
    """Read all frames below a root, one at a time."""
    return all_frames(describe(root))
