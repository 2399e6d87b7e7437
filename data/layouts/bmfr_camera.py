"""Camera headers of the BMFR data set: C source with matrices, pixel offsets and reprojection thresholds.

    const float position_limit_squared = 0.001600;
    const float camera_matrices[60][4][4] = { { {…}, {…}, {…}, {…} }, // frame 0
    const float pixel_offsets[60][2] = { {0.5, 0.5}, …

Matrices are for row vectors, `[x, y, z, 1] @ M`, and map to clip space with y in the direction of image rows:
`pixel = (clip.xy / clip.w + 1) / 2 * (width, height)`. WSKP keeps one `<scene>.h` per scene, which may hold
matrices only.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from data.camera import Camera

_COMMENT = re.compile(r"//[^\n]*|/\*.*?\*/", re.DOTALL)
_ASSIGNMENT = re.compile(r"(\w+)\s*(?:\[[^\]=]*\]\s*)*=\s*([^;=]*)")
_NUMBER = re.compile(r"(?<![\w.])[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")


@dataclass(frozen=True)
class BmfrCameras:
    """Content of one camera header.

    Attributes:
        matrices: World to clip space for row vectors (N, 4, 4).
        pixel_offsets: Sample position within the pixel (N, 2), y from the bottom edge; None where absent.
        position_limit_squared: Threshold of the reprojection, None where absent.
        normal_limit_squared: Threshold of the reprojection, None where absent.
    """

    matrices: NDArray[np.float64]
    pixel_offsets: NDArray[np.float64] | None = None
    position_limit_squared: float | None = None
    normal_limit_squared: float | None = None

    def camera(self, index: int, width: int, height: int) -> Camera:
        """Return the camera of a frame for an image size.

        Raises:
            ValueError: The header has no such frame.
        """
        if not 0 <= index < len(self.matrices):
            raise ValueError(f"the camera header has {len(self.matrices)} matrices, none for frame {index}")
        x, y, z, w = self.matrices[index].T
        offset = (0.5, 0.5)
        if self.pixel_offsets is not None:
            right, up = self.pixel_offsets[index]
            offset = (float(right), 1 - float(up))
        return Camera(np.stack([(x + w) * width / 2, (y + w) * height / 2, z, w]), offset=offset)


def read_cameras(path: str | Path) -> BmfrCameras:
    """Read a camera header.

    Raises:
        OSError: It cannot be opened.
        ValueError: No matrices, or a number of values that makes no 4x4 matrices or no pairs of offsets.
    """
    path = Path(path)
    text = _COMMENT.sub(" ", path.read_text(encoding="utf-8", errors="replace"))
    values = {name: _numbers(body) for name, body in _ASSIGNMENT.findall(text)}
    numbers = next((v for n, v in values.items() if "matri" in n.lower()), None)
    if numbers is None:
        numbers = np.array([]) if values else _numbers(text)
    if numbers.size == 0 or numbers.size % 16:
        raise ValueError(
            f"{path}: expected `camera_matrices[N][4][4] = {{…}}` with 16 numbers per frame, "
            f"found {numbers.size} numbers"
        )
    matrices = numbers.reshape(-1, 4, 4)
    offsets = next((v for n, v in values.items() if "offset" in n.lower()), None)
    if offsets is not None and offsets.size != 2 * len(matrices):
        raise ValueError(
            f"{path}: {len(matrices)} matrices, but {offsets.size} numbers of pixel_offsets, "
            f"expected {2 * len(matrices)}"
        )
    return BmfrCameras(
        matrices,
        None if offsets is None else offsets.reshape(-1, 2),
        _limit(path, values, "position_limit_squared"),
        _limit(path, values, "normal_limit_squared"),
    )


def _numbers(text: str) -> NDArray[np.float64]:
    return np.array([float(n) for n in _NUMBER.findall(text)], np.float64)


def _limit(path: Path, values: dict[str, NDArray[np.float64]], name: str) -> float | None:
    if name not in values:
        return None
    if values[name].size != 1 or not values[name][0] > 0:
        raise ValueError(f"{path}: {name} is not one positive number")
    return float(values[name][0])
