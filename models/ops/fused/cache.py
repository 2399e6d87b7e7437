"""Where compiled kernels are kept."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from numba import config


def folder() -> Path:
    """Return the folder for the code of these very sources.

    Numba compiles a function again when the file it stands in has changed, but not when a function that it
    calls has, in another file. So what is kept is kept by the contents of all files of this package.
    """
    here = Path(__file__).parent
    digest = hashlib.sha256(b"".join(source.read_bytes() for source in sorted(here.glob("*.py"))))
    return here / "__pycache__" / f"kernels-{digest.hexdigest()[:12]}"


@contextmanager
def kept_apart() -> Iterator[None]:
    """Keep the code of functions that are defined in the block in `folder`.

    Where that cannot be written Numba uses the user's own cache folder, as it always does. A folder that the
    user has chosen (`NUMBA_CACHE_DIR`) is left alone.
    """
    settings = vars(config)
    chosen = settings["CACHE_DIR"]
    settings["CACHE_DIR"] = chosen or str(folder())
    try:
        yield
    finally:
        settings["CACHE_DIR"] = chosen
