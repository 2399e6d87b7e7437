"""Which variant of Mitsuba renders: `llvm_ad_rgb` with a usable LLVM library, else `scalar_rgb`.

The LLVM variant needs a shared library that no Python package brings. An unsuitable one may end the process
inside C code, where nothing can be caught (LLVM 15 starts, then aborts at the first render), so a candidate
is tried in a child process that traces a few samples, and the verdict is kept in the cache folder.
"""

from __future__ import annotations

import glob
import hashlib
import importlib.metadata
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

LIBRARY = "DRJIT_LIBLLVM_PATH"
"""The environment variable that names the LLVM library; Dr.Jit reads it once, when it is imported."""

OLDEST = 15
_FOLDERS = (
    "/usr/lib/*-linux-gnu",
    "/usr/lib64",
    "/usr/lib",
    "/usr/local/lib",
    "/usr/lib/llvm*/lib",
    "/usr/lib64/llvm*/lib",
    "/opt/homebrew/opt/llvm*/lib",
    "/usr/local/opt/llvm*/lib",
)
_INSTALL = (
    f"install a package with libLLVM 16 or newer, such as libllvm19, or set {LIBRARY} to the file of one"
)
_SLOWER = "3 to 5 times slower for radiance alone, 100 to 300 times with guides"
_SECONDS = 300


@dataclass(frozen=True)
class Variant:
    """A variant of Mitsuba that works on this machine.

    Attributes:
        name: `llvm_ad_rgb` compiles for whole wavefronts of samples, `scalar_rgb` traces one at a time.
        library: File of the LLVM library, None for the scalar variant.
        reason: One sentence for the user: what was chosen, why, and what it costs.
    """

    name: Literal["llvm_ad_rgb", "scalar_rgb"]
    library: str | None
    reason: str


def choose(prefer: str | None = None) -> Variant:
    """Return the fastest variant that works here.

    Args:
        prefer: `llvm_ad_rgb` or `scalar_rgb` to ask for one of them.

    Raises:
        ValueError: Mitsuba is not installed, the preference is unknown, or `llvm_ad_rgb` was asked for and no
            LLVM library works.
    """
    _require()
    if prefer not in (None, "llvm_ad_rgb", "scalar_rgb"):
        raise ValueError(f"unknown Mitsuba variant {prefer!r}; known: llvm_ad_rgb, scalar_rgb")
    if prefer == "scalar_rgb":
        return Variant("scalar_rgb", None, f"scalar_rgb, as asked ({_SLOWER} than llvm_ad_rgb)")
    rejected = []
    for library in candidates():
        verdict = probe(library)
        if verdict is None:
            return Variant("llvm_ad_rgb", library, f"llvm_ad_rgb with {library}")
        rejected.append(f"{library}: {verdict}")
    found = f"no LLVM library works ({'; '.join(rejected)})" if rejected else "no LLVM library was found"
    if prefer == "llvm_ad_rgb":
        raise ValueError(f"llvm_ad_rgb cannot be used: {found}; {_INSTALL}")
    return Variant(
        "scalar_rgb", None, f"scalar_rgb ({_SLOWER} than llvm_ad_rgb), because {found}; {_INSTALL}"
    )


def activate(variant: Variant, threads: int | None = None) -> None:
    """Make a variant the one of this process.

    Args:
        variant: What `choose` returned.
        threads: Threads that render; None: all cores.

    Raises:
        ValueError: Mitsuba is not installed, or this process already uses another LLVM library.
    """
    _require()
    if variant.library is not None:
        if "drjit" in sys.modules and os.environ.get(LIBRARY) != variant.library:
            raise ValueError(f"Dr.Jit is already loaded; {LIBRARY} must be set before: {variant.library}")
        os.environ[LIBRARY] = variant.library
    import drjit
    import mitsuba

    mitsuba.set_variant(variant.name)
    mitsuba.set_log_level(mitsuba.LogLevel.Error)
    drjit.set_thread_count(threads or os.cpu_count() or 1)


def is_scalar() -> bool:
    """Return whether the active variant traces one sample at a time."""
    import mitsuba

    return str(mitsuba.variant()).startswith("scalar")


def candidates() -> list[str]:
    """Return the files of LLVM libraries to try: the one of the environment, then newest first."""
    found: dict[str, int] = {}
    for name in (*_in_folders(), *_known_to_the_linker()):
        version = _version(name)
        if version is not None and version >= OLDEST and os.path.isfile(name):
            found.setdefault(os.path.realpath(name), version)
    listed = sorted(found, key=lambda name: (-found[name], name))
    given = os.environ.get(LIBRARY)
    return listed if not given else [given, *(name for name in listed if name != os.path.realpath(given))]


def probe(library: str) -> str | None:
    """Try an LLVM library in a child process, or look up what came of it before.

    Returns:
        None if it works, else what went wrong in a few words.
    """
    path = Path(library)
    if not path.is_file():
        return "no such file"
    record = _cache() / f"llvm-{_key(path)}.json"
    try:
        verdict = json.loads(record.read_text())["verdict"]
    except (OSError, ValueError, KeyError, TypeError):
        verdict = _try(library)
        if verdict is None or "signal" in verdict or "too old" in verdict:
            # Any other failure may be of the moment: a full disk, a broken installation.
            _remember(record, {"library": library, "verdict": verdict})
    return None if verdict is None else str(verdict)


def _try(library: str) -> str | None:
    environment = {
        **os.environ,
        LIBRARY: library,
        "PYTHONPATH": os.pathsep.join(p for p in sys.path if p),
    }
    try:
        child = subprocess.run(
            [sys.executable, "-m", "data.render.probe"],
            env=environment,
            capture_output=True,
            text=True,
            timeout=_SECONDS,
            cwd=Path(__file__).parents[2],
        )
    except subprocess.TimeoutExpired:
        return f"a small render did not end within {_SECONDS} s"
    if child.returncode == 0 and child.stdout.strip().endswith("works"):
        return None
    lines = [line.strip() for line in child.stderr.splitlines() if line.strip()]
    told = next((x for x in lines if "too old" in x or "LLVM ERROR" in x), lines[-1] if lines else "")
    ended = f"signal {-child.returncode}" if child.returncode < 0 else f"exit code {child.returncode}"
    return f"a small render ended with {ended}" + (f" ({told[:120]})" if told else "")


def _remember(record: Path, content: dict[str, str | None]) -> None:
    """Keep a verdict; a cache that cannot be written only costs the next run a few seconds."""
    temporary = record.with_name(f"{record.name}.{os.getpid()}.tmp")
    try:
        record.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_text(json.dumps(content))
        temporary.replace(record)
    except OSError:
        temporary.unlink(missing_ok=True)


def _key(path: Path) -> str:
    status = path.stat()
    parts = (path.resolve(), status.st_mtime_ns, status.st_size, importlib.metadata.version("mitsuba"))
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:24]


def _cache() -> Path:
    return Path(os.environ.get("PENUMBRA_CACHE") or Path.home() / ".cache" / "penumbra").absolute()


def _require() -> None:
    if importlib.util.find_spec("mitsuba") is None:
        raise ValueError(
            "rendering needs Mitsuba 3, which is not installed: pip install penumbra-denoise[render]"
        )


def _version(name: str) -> int | None:
    """Return the major version in a library's file name, such as libLLVM-15.so.1 or libLLVM.so.19.1."""
    match = re.search(r"libLLVM(?:-|\.so\.|\.)(\d+)", Path(os.path.realpath(name)).name)
    match = match or re.search(r"llvm-?@?(\d+)", name)
    return int(match[1]) if match else None


def _in_folders() -> Iterable[str]:
    for folder in _FOLDERS:
        for pattern in ("libLLVM*.so*", "libLLVM*.dylib"):
            yield from glob.glob(f"{folder}/{pattern}")


def _known_to_the_linker() -> Iterable[str]:
    tool = shutil.which("ldconfig") or "/sbin/ldconfig"
    if not os.path.isfile(tool):
        return []
    listing = subprocess.run([tool, "-p"], capture_output=True, text=True, check=False).stdout
    return [
        line.split("=>")[1].strip() for line in listing.splitlines() if "libLLVM" in line and "=>" in line
    ]
