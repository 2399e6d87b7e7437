"""`trainer serve`: denoise over HTTP."""

from __future__ import annotations

import argparse
import importlib.util
import os
import re
import socket
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from trainer.commands.denoise import size_in_bytes

if TYPE_CHECKING:
    from trainer.loading import Loaded
    from trainer.serving.batching import Batching
    from trainer.serving.limits import Limits

HELP = "denoise over HTTP"
TOKEN = "PENUMBRA_TOKEN"
_EXTRA = ("fastapi", "uvicorn", "python_multipart", "prometheus_client")
_SHORTEST = 16


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the options."""
    add = parser.add_argument
    add(
        "--model", required=True, metavar="MODEL",
        help="as for trainer denoise: MLflow URI (models:/NAME@ALIAS …), checkpoint, run folder, exported "
        "file, or class name of a denoiser without parameters",
    )  # fmt: skip
    add("--option", action="append", default=[], metavar="KEY=VALUE",
        help="option of a method that is named by its class; may be repeated")  # fmt: skip
    add("--fill", action="append", default=[], metavar="QUANTITY=VALUE",
        help="constant that stands for a quantity where samples lack it; may be repeated")  # fmt: skip
    add(
        "--host",
        default="127.0.0.1",
        help="address to listen on (default: 127.0.0.1; 0.0.0.0: all of this machine)",
    )
    add("--port", type=_whole(0, 65535), default=8080, help="port; 0: any that is free (default: 8080)")
    add(
        "--token-file", type=Path, metavar="FILE",
        help=f"file with the token that clients must show for /denoise and /metrics (or variable {TOKEN})",
    )  # fmt: skip
    add("--max-megapixels", type=_positive, default=10.0, metavar="N",
        help="largest frame, with up to 32 channels; with more channels less (default: 10)")  # fmt: skip
    add("--max-upload-mb", type=_positive, default=256.0, metavar="N",
        help="largest upload in MB (default: 256)")  # fmt: skip
    add("--disk", type=size_in_bytes, default=size_in_bytes("2GB"), metavar="SIZE",
        help="room in the temporary folder (TMPDIR) for all requests together: uploads, what ZIP files "
        "unpack to, results (default: 2GB)")  # fmt: skip
    add("--max-frames", type=_whole(1, 100_000), default=64, metavar="N",
        help="frames of a ZIP file (default: 64)")  # fmt: skip
    add("--queue", type=_whole(0, 10_000), default=16, metavar="N",
        help="requests that may wait; more are answered with 503 (default: 16)")  # fmt: skip
    add("--timeout", type=_positive, default=120.0, metavar="SECONDS",
        help="time for a result, waiting included (default: 120)")  # fmt: skip
    add("--upload-timeout", type=_positive, default=60.0, metavar="SECONDS",
        help="time for an upload to come in (default: 60)")  # fmt: skip
    add("--tile", type=_whole(16, 1 << 16), default=512, metavar="PIXELS",
        help="largest side of a tile; work stops between tiles (default: 512)")  # fmt: skip
    add("--batch", type=_whole(1, 256), default=4, metavar="N",
        help="tiles of different requests that are denoised at once, on a CPU small ones only "
        "(default: 4)")  # fmt: skip
    add("--memory", type=size_in_bytes, default=size_in_bytes("2GB"), metavar="SIZE",
        help="memory that the model may take for a batch (default: 2GB)")  # fmt: skip
    add("--threads", type=_whole(1, 1024), metavar="N", help="threads of PyTorch (default: one per core)")
    add("--device", default="cpu", metavar="DEVICE", help="cpu, cuda, cuda:1 … (default: cpu)")
    add("--quiet", action="store_true", help="print no line for each request")


def run(args: argparse.Namespace) -> int:
    """Serve until SIGTERM; returns the exit code.

    Raises:
        UsageError: A package or an option is missing or wrong.
        ValueError: The model or the token file is.
        OSError: The address cannot be listened on.
    """
    _need_packages()
    token = _token(args.token_file)
    listening = _listen(args.host, args.port)
    with listening:
        import torch

        from trainer.commands.denoise import check_device
        from trainer.denoising import Settings
        from trainer.serving.batching import CPU_PIXELS, Batching
        from trainer.serving.server import make_server
        from trainer.serving.service import Service

        check_device(args.device)
        if args.threads is not None:
            torch.set_num_threads(args.threads)
        loaded = _model(args)
        settings = Settings(memory=args.memory, device=args.device, tile=args.tile)
        pixels = CPU_PIXELS if args.device == "cpu" else None
        batching = Batching(args.batch, args.memory, pixels, args.threads)
        limits = _limits(args)
        service = Service(loaded, settings, limits, batching, token)
        _warn(limits, batching)
        _announce(args, listening, loaded, token)
        level = "warning" if args.quiet else "info"
        make_server(service, access_log=not args.quiet, log_level=level).run(sockets=[listening])
    return 0


def _limits(args: argparse.Namespace) -> Limits:
    from trainer.serving.limits import Limits

    return Limits(
        megapixels=args.max_megapixels,
        upload=int(args.max_upload_mb * 1e6),
        disk=args.disk,
        frames=args.max_frames,
        queue=args.queue,
        read=args.upload_timeout,
        compute=args.timeout,
    )


def _warn(limits: Limits, batching: Batching) -> None:
    """Say where requests may take more than there is."""
    from trainer.serving.memory import shortages

    for text in shortages(limits, batching, Path(tempfile.gettempdir())):
        print(f"warning: {text}", file=sys.stderr, flush=True)


def _model(args: argparse.Namespace) -> Loaded:
    """Return the model under a name that tells clients nothing about this machine."""
    from dataclasses import replace

    from trainer.loading import resolve
    from trainer.samples import fill

    print(f"loading {args.model} …", file=sys.stderr, flush=True)
    loaded = resolve(args.model, args.device, options=args.option)
    fill(loaded.model, args.fill)
    if Path(args.model).exists():
        path = Path(args.model).resolve()
        loaded = replace(loaded, source=replace(loaded.source, reference=path.name))
    return loaded


def _announce(args: argparse.Namespace, listening: socket.socket, loaded: Loaded, token: str | None) -> None:
    host, port = listening.getsockname()[:2]
    shown = f"[{host}]" if ":" in host else host
    guarded = "with a token" if token else "without a token"
    print(
        f"serving {loaded.source.reference} at http://{shown}:{port} ({guarded}); /docs describes it",
        file=sys.stderr,
        flush=True,
    )
    if token is None and not (host.startswith("127.") or host == "::1"):
        print(
            f"warning: whoever reaches {shown}:{port} may use it; set {TOKEN} or --token-file",
            file=sys.stderr,
            flush=True,
        )


def _token(file: Path | None) -> str | None:
    """Return the token.

    Raises:
        ValueError: The file cannot be used, or the token is no token.
    """
    if file is None:
        token, place = os.environ.get(TOKEN, ""), TOKEN
    else:
        try:
            token, place = file.read_text("ascii").strip(), f"--token-file {file}"
        except (OSError, UnicodeError) as error:
            reason = getattr(error, "strerror", None) or "it is not plain ASCII text"
            raise ValueError(f"--token-file {file}: {reason}") from error
    if not token and file is None:
        return None
    if len(token) < _SHORTEST or re.fullmatch(r"[!-~]+", token) is None:
        raise ValueError(
            f"{place}: expected a token of at least {_SHORTEST} letters, digits or signs without spaces, "
            "such as that of `openssl rand -hex 32`"
        )
    return token


def _listen(host: str, port: int) -> socket.socket:
    """Return a socket that listens, before a model is loaded in vain."""
    try:
        family, kind, number, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listening = socket.socket(family, kind, number)
    except OSError as error:
        raise OSError(f"--host {host}: {error.strerror or error}") from error
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind(address)
    except OSError as error:
        listening.close()
        raise OSError(
            f"cannot listen on {host} port {port}: {error.strerror}; choose another --port (0: any free one)"
        ) from error
    return listening


def _need_packages() -> None:
    from trainer.configs import UsageError

    missing = [name for name in _EXTRA if importlib.util.find_spec(name) is None]
    if missing:
        raise UsageError(f'trainer serve needs {", ".join(missing)}: pip install "penumbra-denoise[serve]"')


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is no positive number")
    return value


class _whole:  # noqa: N801  # reads as a type in the options
    """A whole number between two others."""

    def __init__(self, low: int, high: int) -> None:
        self.low, self.high = low, high

    def __call__(self, text: str) -> int:
        if not text.isascii() or not text.isdigit() or not self.low <= int(text) <= self.high:
            raise argparse.ArgumentTypeError(f"{text!r} is no whole number from {self.low} to {self.high}")
        return int(text)
